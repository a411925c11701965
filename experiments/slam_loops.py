"""Closed loops of a laser log: from what the filter's matches report to the corrected poses, and words on them."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import progress_bar

from jaxlocmap import Config, Info, Params, graph, plotting
from jaxlocmap.graph.closure import Closed, Closure, close_loops, scan_poses
from jaxlocmap.graph.trail import Trail, trail_of
from jaxlocmap.logs import Log, write_csv, write_g2o
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points, surface_points
from jaxlocmap.matching.submaps import BLOCKS
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.types import Matcher, Scanner

_KEPT = 0.5  # a loop of less weight is not kept
_FALSE = (0.4, 0.1)  # m, rad: a loop farther off the reference than this is false


class Loops(NamedTuple):
    """A log whose loops are closed. S scans."""

    trail: Trail
    closed: Closed
    poses: np.ndarray  # (S, 3) m, m, rad
    cov: np.ndarray  # (S, 3, 3) given the first pose
    online: np.ndarray  # (S, 3) as known when the submap was finished
    seconds: float  # of closing, compilation included


def closed(params: Params, log: Log, info: Info, settings: Config, config: Any) -> Loops:
    """Close the loops of a log under a bar.

    Args:
        info: of the filter, (S,) scans.
        config: the program's, with `start` and `kernel`.
    """
    matcher = settings.matcher
    if matcher is None:
        raise ValueError("settings.matcher: expected a Matcher, got None")
    began = time.perf_counter()
    trail = trail_of(info.match)
    points = surfaces(log.scan, log.beam_angles, settings)
    std, scale, _ = (jnp.asarray(params.block(block), jnp.float32) for block in BLOCKS)
    with jax.enable_x64(True), progress_bar("closing loops", trail.submaps) as progress:
        first = np.asarray(config.start, np.float64)
        found = close_loops(
            trail,
            points,
            std,
            scale,
            spec=matcher.spec,
            closure=Closure(),
            first=first,
            kernel=config.kernel,
            progress=progress,
        )
        poses, cov = scan_poses(trail, found)
    before = trail.submap < 0  # a first scan with too few points: the robot has not moved as far as is known
    poses[before], cov[before] = first, 0
    online = compose(found.online[np.maximum(trail.submap, 0)], trail.place)
    return Loops(trail, found, poses, cov, online, time.perf_counter() - began)


def surfaces(ranges: np.ndarray, beam_angles: Any, settings: Config) -> Points:
    """The points of all scans (S, B), (S, B, ...)."""
    matcher = settings.matcher or Matcher()
    scanner = settings.scanner(jnp.asarray(beam_angles, jnp.float32))
    return _surfaces(jnp.asarray(ranges, jnp.float32), scanner, matcher.range_std, matcher.gap)


@functools.partial(jax.jit, static_argnames=("std", "gap"))
def _surfaces(ranges: jax.Array, scanner: Scanner, std: float, gap: float) -> Points:
    return jax.vmap(lambda ranges: surface_points(ranges, std, scanner=scanner, gap=gap))(ranges)


def drawn(log: Log, settings: Config, poses: np.ndarray, counts: np.ndarray, half_width: float) -> np.ndarray:
    """One map of lines of all scans that count, (rows, columns, 6), about the start."""
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


def write_loops(out: Path, loops: Loops, log: Log, report: dict[str, Any]) -> list[str]:
    """The graph, the poses with their covariances and the picture; what the report says of them."""
    found, solution = loops.closed, loops.closed.solution
    accepted = found.attempts.pair[found.attempts.accepted]
    weights = np.asarray(solution.weights)[: len(accepted)]
    report["closure"] = {
        "submaps": loops.trail.submaps,
        "tried": len(found.attempts.accepted),
        "accepted": len(accepted),
        "kept": int(np.sum(weights > _KEPT)),
        "chi2": float(solution.objective),
        "converged": bool(solution.converged),
        "seconds": loops.seconds,
    }
    anchors = np.asarray(solution.poses, np.float64)
    write_g2o(out / "graph.g2o", found.graph, anchors, np.arange(len(anchors)))
    write_csv(out / "poses.csv", log.scan_time, loops.poses, loops.cov)
    with jax.enable_x64(True):
        begin = np.asarray(graph.dead_reckoning(found.graph, jnp.asarray(anchors[0])))
    trail = loops.trail
    before = compose(begin[np.maximum(trail.submap, 0)], trail.place)
    title = f"{log.name}: {trail.submaps} submaps, {len(accepted)} loops, drawn between the submaps' middles"
    plotting.graph_figure(
        out / "graph.png", loops.poses, loops.cov, trail.middle[accepted], weights, before=before, title=title
    )
    return ["graph.g2o", "poses.csv", "graph.png"]


def false_loops(loops: Loops, reference: np.ndarray) -> int:
    """How many loops that were kept disagree with reference poses by more than 0.4 m or 0.1 rad.

    A loop says how the scans of one submap lie to those of another; it is judged where they come nearest, among the
    scans that the filter let in: of others it knows the odometry alone.

    Args:
        reference: (S, 3) m, m, rad, NaN where it is not known.
    """
    trail, attempts = loops.trail, loops.closed.attempts
    accepted = np.flatnonzero(attempts.accepted)
    kept = accepted[np.asarray(loops.closed.solution.weights)[: len(accepted)] > _KEPT]
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


def loop_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Rows of the table."""
    if "closure" not in report:
        return []
    said = report["closure"]
    return [
        ("submaps", str(said["submaps"]), ""),
        ("loops tried, accepted, kept", f"{said['tried']}, {said['accepted']}, {said['kept']}", ""),
        ("closing loops", f"{said['seconds']:.1f} s", ""),
        *([("false loops kept", str(said["false_kept"]), "0")] if "false_kept" in said else []),
    ]


def loop_doubts(report: Mapping[str, Any]) -> list[str]:
    """What a user should know of the loops before trusting the result."""
    if "closure" not in report:
        return []
    said, doubts = report["closure"], []
    if not said["accepted"]:
        doubts.append("no loop was closed: the poses are those of the filter, and so is their covariance")
    if said["kept"] < 0.9 * said["accepted"]:
        doubts.append(
            f"{said['accepted'] - said['kept']} of {said['accepted']} loops do not fit the others: false ones?"
        )
    if not said["converged"]:
        doubts.append("the graph of the loops did not converge: the poses are the best on the way")
    return doubts
