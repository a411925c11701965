"""Closed loops of a laser log: from what the filter's matches report to the corrected poses."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.graph.closure import Closed, Closure, close_loops, scan_poses
from jaxlocmap.graph.trail import Trail
from jaxlocmap.logs import Log
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points, surface_points
from jaxlocmap.matching.submaps import BLOCKS
from jaxlocmap.parameters import Params
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.types import Config, Matcher, Scanner

KEPT = 0.5  # a loop of less weight is not kept
_FALSE = (0.4, 0.1)  # m, rad: a loop farther off the reference than this is false


class Loops(NamedTuple):
    """A log whose loops are closed. S scans."""

    trail: Trail
    closed: Closed
    poses: np.ndarray  # (S, 3) m, m, rad
    cov: np.ndarray  # (S, 3, 3) given the first pose
    online: np.ndarray  # (S, 3) as known when the submap was finished
    seconds: float  # of closing, compilation included


def closed(
    params: Params,
    log: Log,
    trail: Trail,
    config: Config,
    *,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    kernel: str = "gnc",
    progress: Callable[[int], None] = lambda done: None,
) -> Loops:
    """Close the loops of a log.

    Args:
        params: of the filter.
        log: S scans.
        trail: of the submaps that the filter matched them on (`graph.trail.trail_of`).
        config: of the filter.
        start: the first pose, m, m, rad.
        kernel: how loops count that do not fit the others.
        progress: called with the number of submaps done so far.

    Raises:
        ValueError: a filter that matches no scans.
    """
    matcher = config.matcher
    if matcher is None:
        raise ValueError("config.matcher: expected a Matcher, got None")
    began = time.perf_counter()
    points = surfaces(log.scan, log.beam_angles, config)
    std, scale, _ = (jnp.asarray(params.block(block), jnp.float32) for block in BLOCKS)
    with jax.enable_x64(True):
        first = np.asarray(start, np.float64)
        found = close_loops(
            trail,
            points,
            std,
            scale,
            spec=matcher.spec,
            closure=Closure(),
            first=first,
            kernel=kernel,
            progress=progress,
        )
        poses, cov = scan_poses(trail, found)
    before = trail.submap < 0  # a first scan with too few points: the robot has not moved as far as is known
    poses[before], cov[before] = first, 0
    online = compose(found.online[np.maximum(trail.submap, 0)], trail.place)
    return Loops(trail, found, poses, cov, online, time.perf_counter() - began)


def surfaces(ranges: np.ndarray, beam_angles: Any, settings: Config) -> Points:
    """The points that scans saw, with their normals, (S, B, ...).

    Args:
        ranges: (S, B) m.
        beam_angles: (B,) rad.
        settings: of the filter.
    """
    matcher = settings.matcher or Matcher()
    scanner = settings.scanner(jnp.asarray(beam_angles, jnp.float32))
    return _surfaces(jnp.asarray(ranges, jnp.float32), scanner, matcher.range_std, matcher.gap)


@functools.partial(jax.jit, static_argnames=("std", "gap"))
def _surfaces(ranges: jax.Array, scanner: Scanner, std: float, gap: float) -> Points:
    return jax.vmap(lambda ranges: surface_points(ranges, std, scanner=scanner, gap=gap))(ranges)


def drawn(log: Log, settings: Config, poses: np.ndarray, counts: np.ndarray, half_width: float) -> np.ndarray:
    """One map of lines of the scans of a log, (rows, columns, 6), about the start.

    Args:
        log: S scans.
        settings: of the filter.
        poses: (S, 3) m, m, rad.
        counts: (S,) bool: the scans to draw.
        half_width: of the map, m.
    """
    matcher = Matcher(half_width=half_width, resolution=(settings.matcher or Matcher()).resolution)
    points = surfaces(log.scan, log.beam_angles, settings)

    @jax.jit
    def all_of(poses: jax.Array, counts: jax.Array, points: Points) -> jax.Array:
        def add(lines: jax.Array, now: Any) -> tuple[jax.Array, None]:
            pose, count, points = now
            return line_grid.add_points(lines, pose, points, spec=matcher.spec, counts=count), None

        empty = jnp.zeros((*matcher.spec.shape, line_grid.SUMS), poses.dtype)
        return jax.lax.scan(add, empty, (poses, counts, points))[0]

    return np.asarray(all_of(jnp.asarray(poses, jnp.float32), jnp.asarray(counts), points))


def false_loops(loops: Loops, reference: np.ndarray) -> int:
    """How many loops that were kept disagree with reference poses by more than 0.4 m or 0.1 rad.

    A loop says how the scans of one submap lie to those of another; it is judged where they come nearest, among the
    scans that the filter let in: of others it knows the odometry alone.

    Args:
        reference: (S, 3) m, m, rad, NaN where it is not known.
    """
    trail, attempts = loops.trail, loops.closed.attempts
    accepted = np.flatnonzero(attempts.accepted)
    kept = accepted[np.asarray(loops.closed.solution.weights)[: len(accepted)] > KEPT]
    known = np.isfinite(reference[:, 0]) & trail.drawn
    count = 0
    for k in kept:
        a, b = (np.flatnonzero((trail.submap == submap) & known) for submap in attempts.pair[k])
        if not (len(a) and len(b)):
            continue
        away = np.hypot(*np.moveaxis(reference[a, None, :2] - reference[None, b, :2], -1, 0))
        i, j = np.unravel_index(np.argmin(away), away.shape)
        moved = np.asarray(attempts.found.moved[k], np.float64)
        count += bool(is_false(trail, reference, a[i], b[j], moved))
    return count


def is_false(trail: Trail, reference: np.ndarray, a: Any, b: Any, moved: np.ndarray) -> np.ndarray:
    """Whether what loops say of how scans b lie to scans a is more than 0.4 m or 0.1 rad off reference poses, (...,).

    Args:
        reference: (S, 3) m, m, rad.
        a, b: (...,) scans of the older and the younger submap.
        moved: (..., 3) m, m, rad: the younger anchor in the frame of the older one.
    """
    off = between(reference[a], reference[b]) - between(trail.place[a], compose(moved, trail.place[b]))
    return (np.hypot(off[..., 0], off[..., 1]) > _FALSE[0]) | (np.abs(wrapped(off[..., 2])) > _FALSE[1])
