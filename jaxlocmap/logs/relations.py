"""Relations: how far a robot moved between two moments, known from elsewhere, and how well a trajectory agrees."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlocmap import checks, files
from jaxlocmap.logs.text import lines, numbers
from jaxlocmap.poses import between, wrapped

_FIELDS = ("t1", "t2", "dx", "dy", "dz", "droll", "dpitch", "dyaw")
_SAME_TIME = 1e-4  # s: stamps that agree to this are of one scan; the next one may come 5 ms later
_APART = 30.0  # s between two visits of a place
_NEAR = 1.0  # m: as close are two visits of one place


class Relations(NamedTuple):
    """K pairs of moments, and how the robot moved from the first to the second, in its frame at the first."""

    time: np.ndarray  # (K, 2) s
    moved: np.ndarray  # (K, 3) m, m, rad


class RelationErrors(NamedTuple):
    """Of the relations both of whose moments a trajectory has."""

    translation: np.ndarray  # (M,) m
    rotation: np.ndarray  # (M,) rad
    apart: np.ndarray  # (M,) s between the two moments


def read_relations(path: str | Path) -> Relations:
    """Read one relation a line: `t1 t2 dx dy dz droll dpitch dyaw`, s, m and rad.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: not text, no relation, or a line with missing, extra or non-numeric fields; the message starts with
            the path and, where there is one, the line.

    Source: Kümmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss & Kleiner 2009 (the benchmark of relations).
    """
    with files.reading(path, "relations"):
        rows = []
        for number, line in lines(path):
            fields, where = line.split(), f"{path}:{number}"
            if len(fields) != len(_FIELDS):
                raise ValueError(f"{where}: expected {len(_FIELDS)} fields ({', '.join(_FIELDS)}), got {len(fields)}")
            rows.append(numbers(fields, _FIELDS, where))
        if not rows:
            raise ValueError(f"{path}: expected relations, got none")
    table = np.array(rows)
    return Relations(table[:, :2], table[:, [2, 3, 7]])


def revisits(time: np.ndarray, poses: np.ndarray) -> Relations:
    """The relations of poses less than a metre apart that more than half a minute lies between.

    Args:
        time: (T,) s.
        poses: (T, 3) m, m, rad.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("time", time, (None,))
    checks.shape("poses", poses, (len(time), 3))
    first, second = [], []
    for i in range(len(time)):
        again = np.flatnonzero((time - time[i] > _APART) & (np.hypot(*(poses[:, :2] - poses[i, :2]).T) < _NEAR))
        first += [i] * len(again)
        second += again.tolist()
    return Relations(np.stack([time[first], time[second]], axis=-1), between(poses[first], poses[second]))


def pairs(time: np.ndarray, relations: Relations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The relations whose two moments are both stamps of a trajectory.

    Args:
        time: (T,) s, increasing.
        relations: K of them.

    Returns:
        (M,) each: places of the two stamps in `time`; and (K,) bool: which relations they are of.
    """
    nearest, known = find_stamps(time, relations.time)
    there = np.all(known, axis=1)
    return *nearest[there].T, there


def find_stamps(time: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places in `time` (T,) s, increasing, of the stamps nearest to those wanted, any shape; and which are the same."""
    beyond = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    nearest = beyond - (wanted - time[beyond - 1] < time[beyond] - wanted)
    return nearest, np.abs(time[nearest] - wanted) < _SAME_TIME


def relation_errors(time: np.ndarray, poses: np.ndarray, relations: Relations) -> RelationErrors:
    """How far a trajectory disagrees with relations: the difference of the movement between its two poses and the
    relation, component by component. Relations with a moment that is not a stamp of the trajectory are left out:
    between stamps nothing is known.

        √(dx² + dy²), |dyaw|,  (dx, dy, dyaw) = P(t1)⁻¹ P(t2) - (x, y, yaw) of the relation

    Args:
        time: (T,) s, increasing.
        poses: (T, 3) m, m, rad.
        relations: K of them.

    Raises:
        ValueError: a wrong shape.

    Source: Kümmerle et al. 2009.
    """
    checks.shape("time", time, (None,))
    checks.shape("poses", poses, (len(time), 3))
    first, second, there = pairs(time, relations)
    error = between(poses[first], poses[second]) - relations.moved[there]
    return RelationErrors(
        np.hypot(error[:, 0], error[:, 1]), np.abs(wrapped(error[:, 2])), np.diff(relations.time[there])[:, 0]
    )
