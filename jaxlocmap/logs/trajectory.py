"""Trajectories of any filter: TUM files, and CSV files with named columns, with or without covariances."""

from __future__ import annotations

import collections
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlocmap import checks, files
from jaxlocmap.logs.text import LARGEST, lines, numbers
from jaxlocmap.logs.timeline import backward, check_overlap, interpolate, last_at_each_stamp

_TUM = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_UPPER = ("xx", "xy", "xt", "yy", "yt", "tt")  # of a covariance of x, y and theta
_ALIASES = {"time": "t", "timestamp": "t", "stamp": "t", "yaw": "theta"}
_QUATERNION = ("qx", "qy", "qz", "qw")
_ROS = re.compile(r"cov(?:ariance)?[^0-9]*([0-9]{1,2})[^0-9]*")
_ROS_ENTRIES = 36  # of x, y, z, roll, pitch, yaw
_MOST_COMPONENTS = 10  # of an innovation: their columns S{i}{j} can be told apart
_PLANE = np.array([0, 1, 5])  # x, y and yaw among them


class Trajectory(NamedTuple):
    """Poses over time, float64, in order of time."""

    time: np.ndarray  # (T,) s, increasing
    pose: np.ndarray  # (T, 3) m, m, rad; what is no number in the file is NaN here
    cov: np.ndarray | None  # (T, 3, 3) m², m rad, rad²; None where the file has none
    counts: dict[str, int]  # what was mended: `backward_stamps` (sorted), `duplicate_stamps` (the last one wins)


class Pairs(NamedTuple):
    """Estimates of N runs beside their truth, T steps of the longest; `valid` is False where a run has no more."""

    time: np.ndarray  # (T,) s since a run's first stamp, of the longest run
    truth: np.ndarray  # (N, T, 3) m, m, rad at the estimate's stamps
    mean: np.ndarray  # (N, T, 3)
    cov: np.ndarray  # (N, T, 3, 3)
    valid: np.ndarray  # (N, T) bool: the truth is known there
    stamps: tuple[np.ndarray, ...]  # s, of each run, as in its file
    counts: dict[str, int]  # of all files together; `without_truth`: stamps in a gap of the truth, or beyond it


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory, with its covariances if the file has them.

    A file whose first line holds names separated by commas is CSV: `t, x, y, theta` (or `qx, qy, qz, qw`) in s, m and
    rad, and for a covariance `xx, xy, xt, yy, yt, tt`, or the 36 entries of a ROS PoseWithCovariance, row by row, as
    `cov_0` to `cov_35` (`covariance[0]` and the like go too). `z` may be there and is not read. Any other file is TUM:
    `timestamp x y z qx qy qz qw`, and after them 6 (as above), 9 (row by row) or 36 entries of a covariance.

    Args:
        path: plain or gzipped text; blank lines and lines that start with `#` are skipped.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: no text, no row, a line with missing or extra columns, a field that is no number, a stamp that is
            not finite, a quaternion of length 0, or columns of a CSV that are missing, doubled or unknown; the message
            starts with path and line and names the column.

    Source: Sturm et al. 2012 (TUM); ROS geometry_msgs/PoseWithCovariance.
    """
    with files.reading(path, "poses"):
        return _read(path)


def _read(path: str | Path) -> Trajectory:
    rows = list(lines(path))
    if not rows:
        raise ValueError(f"{path}: expected poses, got only blank lines and comments")
    number, first = rows[0]
    if "," in first:
        names = _columns(first, f"{path}:{number}")
        table = _parsed(path, rows[1:], names, ",")
    else:
        names = _tum_columns(len(first.split()), f"{path}:{number}")
        table = _parsed(path, rows, names, None)
    rows_kept = last_at_each_stamp(table["t"])
    counts = {"backward_stamps": backward(table["t"]), "duplicate_stamps": len(table["t"]) - len(rows_kept)}
    table = {name: values[rows_kept] for name, values in table.items()}
    theta = table["theta"] if "theta" in table else _yaw(table, path)
    pose = np.column_stack([table["x"], table["y"], theta])
    return Trajectory(table["t"], pose, _covariance(table), counts)


def pair(
    truths: Sequence[Trajectory], estimates: Sequence[Trajectory], names: Sequence[str], *, max_gap: float
) -> Pairs:
    """Put estimates beside their truth, which is interpolated to their stamps, headings along the shorter way.

    Args:
        truths, estimates: one of each a run; the estimates with covariances.
        names: of the estimates, for the messages.
        max_gap: s, between two samples of the truth that are interpolated.

    Raises:
        ValueError: not as many of one as of the other, an estimate without covariance, no overlap in time, or a
            `max_gap` that is negative or no number.
    """
    if len(truths) != len(estimates) or not truths:
        raise ValueError(f"truth, estimate: expected as many of each, got {len(truths)} and {len(estimates)}")
    if not max_gap >= 0:
        raise ValueError(f"max_gap: expected seconds >= 0, got {max_gap}")
    runs, longest = len(truths), max(len(estimate.time) for estimate in estimates)
    truth, mean = np.full((2, runs, longest, 3), np.nan)
    cov, valid = np.full((runs, longest, 3, 3), np.nan), np.zeros((runs, longest), bool)
    counts: dict[str, int] = {"backward_stamps": 0, "duplicate_stamps": 0, "without_truth": 0}
    for run, (of_truth, estimate, name) in enumerate(zip(truths, estimates, names, strict=True)):
        if estimate.cov is None:
            raise ValueError(f"{name}: expected covariances to judge, got poses alone")
        check_overlap(name, of_truth.time, estimate.time, "estimate")
        steps = len(estimate.time)
        at, known = interpolate(of_truth.time, of_truth.pose, estimate.time, max_gap)
        truth[run, :steps], mean[run, :steps], cov[run, :steps] = at, estimate.pose, estimate.cov
        valid[run, :steps] = known
        counts["without_truth"] += int(np.sum(~known))
        for each in (of_truth, estimate):
            for key, count in each.counts.items():
                counts[key] += count
    time = max((estimate.time for estimate in estimates), key=len)
    return Pairs(time - time[0], truth, mean, cov, valid, tuple(e.time for e in estimates), counts)


def write_csv(path: str | Path, time: np.ndarray, pose: np.ndarray, cov: np.ndarray) -> None:
    """Write poses with covariances, one `t,x,y,theta,xx,xy,xt,yy,yt,tt` a line below those names, each number so that
    it reads back exactly.

    Args:
        path: of the file to write.
        time: (T,) s.
        pose: (T, 3) m, m, rad.
        cov: (T, 3, 3) m², m rad, rad².

    Raises:
        ValueError: a wrong shape, or no pose.
    """
    time, pose, cov = (np.asarray(x, np.float64) for x in (time, pose, cov))
    checks.shapes(time=(time, (None,)), pose=(pose, (len(time), 3)), cov=(cov, (len(time), 3, 3)))
    if not len(time):
        raise ValueError("time: expected at least one pose, got none")
    upper = cov[:, *np.triu_indices(3)]
    rows = np.column_stack([time, pose, upper]).tolist()
    names = ["t", "x", "y", "theta", *_UPPER]
    files.write(path, "".join(",".join(row) + "\n" for row in [names, *([repr(x) for x in row] for row in rows)]))


def read_innovations(path: str | Path, stamps: np.ndarray) -> dict[str, np.ndarray]:
    """Read a filter's innovations, one observation a row, into slots of the steps at given stamps.

    CSV with the columns `t`, `nu0 .. nu(m-1)` (the innovation), the upper triangle of its covariance `S00, S01 ..`,
    and, if known, `landmark` (a whole number) and `accepted` (1 or 0).

    Args:
        stamps: (T,) s, increasing, of the estimate; an observation belongs to the last stamp not after its own.

    Returns:
        The fields of `consistency.Innovations` by name, with axes (T, M, ...).

    Raises:
        FileNotFoundError, ValueError: as `read_trajectory`; ValueError also for an observation before the first stamp.
    """
    with files.reading(path, "innovations"):
        return _innovations(path, stamps)


def _innovations(path: str | Path, stamps: np.ndarray) -> dict[str, np.ndarray]:
    rows = list(lines(path))
    if len(rows) < 2:
        raise ValueError(f"{path}: expected a line of names and innovations, got {len(rows)} lines")
    where = f"{path}:{rows[0][0]}"
    names = [_ALIASES.get(name.strip(), name.strip()) for name in rows[0][1].split(",")]
    size = sum(re.fullmatch(r"nu[0-9]+", name) is not None for name in names)
    if size > _MOST_COMPONENTS:
        raise ValueError(f"{where}: expected at most {_MOST_COMPONENTS} components of an innovation, got {size}")
    upper = [(i, j) for i in range(size) for j in range(i, size)]
    needed = ["t", *(f"nu{i}" for i in range(size)), *(f"S{i}{j}" for i, j in upper)]
    _check_names(names, needed if size else [*needed, "nu0"], {"landmark", "accepted"}, where)
    table = _parsed(path, rows[1:], names, ",")
    for name, allowed, words in (
        (
            "landmark",
            lambda value: (value >= -1) & (value < 2**31) & (value == np.floor(value)),
            "a whole number >= -1",
        ),
        ("accepted", lambda value: (value == 0) | (value == 1), "0 or 1"),
    ):
        wrong = ~allowed(table.get(name, np.zeros(1)))
        if np.any(wrong):
            at = int(np.argmax(wrong))
            raise ValueError(f"{path}:{rows[1 + at][0]}: {name}: expected {words}, got {table[name][at]}")
    step = np.searchsorted(stamps, table["t"], side="right") - 1
    if np.any(step < 0):
        line = rows[1 + int(np.argmax(step < 0))][0]
        raise ValueError(f"{path}:{line}: t: expected no stamp before the estimate's first, {float(stamps[0])}")
    order = np.argsort(step, kind="stable")
    step = step[order]
    slot = np.arange(len(step)) - np.searchsorted(step, step)
    shape = len(stamps), int(slot.max()) + 1
    if math.prod(shape) * (size + size**2) * 8 > files.most_bytes():
        raise files.too_large(path, "innovations, every step having as many as the fullest,")
    nu, S = np.full((*shape, size), np.nan), np.full((*shape, size, size), np.nan)
    nu[step, slot] = np.column_stack([table[f"nu{i}"] for i in range(size)])[order]
    for i, j in upper:
        S[step, slot, i, j] = S[step, slot, j, i] = table[f"S{i}{j}"][order]
    observed = np.zeros(shape, bool)
    observed[step, slot] = True
    found: dict[str, np.ndarray] = {"innovation": nu, "S": S, "observed": observed}
    if "landmark" in table:
        found["landmark"] = np.full(shape, -1)
        found["landmark"][step, slot] = table["landmark"][order]
    if "accepted" in table:
        found["accepted"] = np.zeros(shape, bool)
        found["accepted"][step, slot] = table["accepted"][order] != 0
    return found


def _columns(line: str, where: str) -> list[str]:
    """Names of a CSV's columns as this module calls them."""
    names = [_column(name) for name in line.split(",")]
    turned = [*_QUATERNION] if set(names) & set(_QUATERNION) else ["theta"]
    entries = [name for name in names if name.startswith("cov_")]
    covariance = [f"cov_{i}" for i in range(_ROS_ENTRIES)] if entries else []
    if not entries and set(names) & set(_UPPER):
        covariance = [*_UPPER]
    _check_names(names, ["t", "x", "y", *turned, *covariance], {"z"}, where)
    return names


def _column(name: str) -> str:
    name = name.strip().strip('"')
    lower = name.lower()
    ros = _ROS.fullmatch(lower, max(lower.rfind("cov"), 0))
    return f"cov_{int(ros[1])}" if ros else _ALIASES.get(name, name)


def _check_names(names: list[str], needed: list[str], others: set[str], where: str) -> None:
    doubled = sorted(name for name, times in collections.Counter(names).items() if times > 1)
    missing = [name for name in needed if name not in names]
    unknown = [name for name in names if name not in needed and name not in others]
    for what, some in (("missing", missing), ("doubled", doubled), ("unknown", unknown)):
        if some:
            expected = ", ".join(needed if len(needed) <= 12 else [*needed[:5], "...", needed[-1]])
            shown = ", ".join(repr(name) for name in some[:5])
            raise ValueError(f"{where}: expected the columns {expected}; {what}: {shown}")


def _tum_columns(count: int, where: str) -> list[str]:
    extra = {
        0: [],
        6: list(_UPPER),
        9: ["xx", "xy", "xt", "yx", "yy", "yt", "tx", "ty", "tt"],
        _ROS_ENTRIES: [f"cov_{i}" for i in range(_ROS_ENTRIES)],
    }
    if count - len(_TUM) not in extra:
        raise ValueError(
            f"{where}: expected {' '.join(_TUM)} and none, 6, 9 or 36 entries of a covariance, got {count} columns"
        )
    return ["t", *_TUM[1:], *extra[count - len(_TUM)]]


def _parsed(
    path: str | Path, rows: list[tuple[int, str]], names: list[str], separator: str | None
) -> dict[str, np.ndarray]:
    """Columns by name. Numbers that are not finite pass, but for stamps."""
    if not rows:
        raise ValueError(f"{path}: expected rows below the names, got none")
    values = []
    for number, line in rows:
        where = f"{path}:{number}"
        fields = [field.strip() for field in line.split(separator)]
        values.append(np.array(numbers(fields, names, where, finite=False)))
        stamp = values[-1][names.index("t")]
        if not abs(stamp) <= LARGEST:
            wanted = f"stamp of a size up to {LARGEST:g}" if np.isfinite(stamp) else "finite stamp"
            raise ValueError(f"{where}: t: expected a {wanted}, got {stamp}")
    return dict(zip(names, np.array(values).T, strict=True))


def _yaw(table: dict[str, np.ndarray], path: str | Path) -> np.ndarray:
    x, y, z, w = (table[name] for name in _QUATERNION)
    with np.errstate(over="ignore", invalid="ignore"):  # what is no number is NaN in the end
        length = x * x + y * y + z * z + w * w
        if np.any(length == 0):
            raise ValueError(f"{path}: qx, qy, qz, qw: expected a rotation, got a quaternion of length 0")
        yaw = np.arctan2(2 * (w * z + x * y) / length, 1 - 2 * (y * y + z * z) / length)
    return np.where(np.isfinite(length), yaw, np.nan)


def _covariance(table: dict[str, np.ndarray]) -> np.ndarray | None:
    """(T, 3, 3), from whichever columns hold it."""
    if "cov_0" in table:
        full = np.stack([table[f"cov_{i}"] for i in range(_ROS_ENTRIES)], -1).reshape(-1, 6, 6)
        return full[:, _PLANE[:, None], _PLANE]
    if "xx" not in table:
        return None
    letters = "xyt"
    pairs = [[a + b if a + b in table else b + a for b in letters] for a in letters]
    return np.stack([np.stack([table[name] for name in row], -1) for row in pairs], -2)
