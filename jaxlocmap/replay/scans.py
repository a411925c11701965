"""A filter that matches every scan of a laser log on those before, and what its matches say of themselves."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.logs import Log, Trajectory
from jaxlocmap.logs.relations import find_stamps
from jaxlocmap.matching import submaps
from jaxlocmap.matching.storage import LoadedLines
from jaxlocmap.parameters import Params
from jaxlocmap.pipeline import init, run
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.replay.pieces import in_pieces
from jaxlocmap.se2 import POSE
from jaxlocmap.types import Config, Gaussian, Info, Inputs, Matcher, State

PIECE = 91  # scans between two calls of `progress`
_ANY_SCANS = 2**30  # of a submap, whose travel ends it
_OLDER = POSE  # entry of the state at which the anchor of the map begins
_START_STD = (0.2, 0.2, 0.1)  # m, m, rad: of the start on a known map
_KNOWN_STD = (0.02, 0.005)  # m, rad: errors of a known map
_LEAST_SHARE = (0.2, 0.5)  # of a scan's points, on a map that grows and on a known one, which has every room


def in_order(log: Log) -> tuple[Log, int]:
    """The scans sorted by stamp, the first of each, and how many stamps repeated one."""
    _, first = np.unique(log.scan_time, return_index=True)
    return log.with_scans(first), len(log.scan_time) - len(first)


def at_stamps(reference: Trajectory, time: np.ndarray) -> np.ndarray:
    """The poses of a reference at the stamps of scans, (S, 3), NaN where it has none."""
    place, known = find_stamps(reference.time, time)
    return np.where(known[:, None], reference.pose[place], np.nan)


def believed(odometry: tuple[float, float, float]) -> Params:
    """Parameters of a filter that matches scans.

    Args:
        odometry: errors of the wheels along, across and in heading after a metre, m, m, rad.
    """
    return submaps.with_defaults(Params.from_std(odometry=odometry))


def settings_of(
    log: Log,
    *,
    submap_length: float | None,
    half_width: float,
    window: tuple[float, float],
    max_range: float,
    laser_offset: tuple[float, float, float],
    known: LoadedLines | None = None,
) -> Config:
    """Settings of a filter whose motion is what the odometry says between two scans.

    Args:
        log: laser scans with odometry.
        submap_length: of travel in a submap, m; None for one map without an end.
        half_width: of the map about the start, m; a submap is as wide as its scans reach.
        window: how far from the odometry a scan is searched at most, m, rad.
        max_range: ranges at or beyond are no walls, m.
        laser_offset: of the scanner, seen from the robot, m, m, rad.
        known: a map to localise on, which stays as it is.
    """
    reach = min(max_range, log.scan_max_range)
    submap: dict[str, Any] = {"submap_scans": None}
    if submap_length is not None:
        half_width, submap = reach + 2 * submap_length, {"submap_scans": _ANY_SCANS, "submap_length": submap_length}
    matcher = Matcher(
        **submap,
        resolution=0.1 if known is None else known.resolution,
        half_width=half_width if known is None else known.half_width,
        steps=20,
        window=window,
        least_share=_LEAST_SHARE[known is not None],
        known_std=None if known is None else _KNOWN_STD,
    )
    return Config(
        dt=1.0,  # a scan, whatever time it took: the noise of the odometry grows with the way
        motion="odometry",
        matcher=matcher,
        max_range=reach,
        scanner_offset=laser_offset,
    )


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def _piece(
    params: Params, state: State, inputs: Inputs, beam_angles: jax.Array, *, config: Config
) -> tuple[State, Info]:
    return run(params, state, inputs, beam_angles=beam_angles, config=config)


def match_log(
    params: Params,
    log: Log,
    config: Config,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    known: LoadedLines | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Info, State, dict[str, float]]:
    """`run` in equal pieces, so that its progress can be told; the last is filled up with scans of nothing.

    Args:
        params: as `believed` makes them.
        log: S scans with odometry, in order.
        config: as `settings_of` makes it.
        start: the pose before the first scan, m, m, rad.
        known: a map to localise on, which stays as it is.
        progress: called with the number of scans done so far.

    Returns:
        What every scan reports, the last state, and seconds: of compiling, and of a scan.
    """
    scans, angles = len(log.scan), jnp.asarray(log.beam_angles, jnp.float32)
    steps = np.concatenate([np.zeros((1, POSE)), between(log.scan_odometry[:-1], log.scan_odometry[1:])])
    fill = -scans % PIECE
    inputs = Inputs(
        dt=jnp.ones(scans + fill),
        control=jnp.asarray(np.concatenate([steps, np.zeros((fill, POSE))]), jnp.float32),
        landmark=jnp.zeros((scans + fill, 0), jnp.int32),
        z=jnp.zeros((scans + fill, 0, 2)),
        valid=jnp.zeros((scans + fill, 0), bool),
        ranges=jnp.asarray(np.concatenate([log.scan, np.full((fill, log.scan.shape[1]), np.nan)]), jnp.float32),
    )
    std = jnp.array(_START_STD if known else (0.0, 0.0, 0.0))
    state = init(Gaussian(jnp.array(start), jnp.diag(std**2)), config=config)
    if known is not None and config.matcher is not None:
        state = state._replace(submaps=submaps.known(jnp.asarray(known.lines), config.matcher, state.belief.mean.dtype))
    began = time.perf_counter()
    first = jax.tree.map(lambda x: x[:PIECE], inputs)
    program = _piece.lower(params, state, first, angles, config=config).compile()
    compiled = time.perf_counter()

    def turn(state: State, piece: Inputs) -> tuple[State, Info]:
        return program(params, state, piece, angles)

    state, info = in_pieces(turn, state, inputs, scans, PIECE, progress)
    each = 1e3 * (time.perf_counter() - compiled) / (scans + fill)
    return info, state, {"compile_s": compiled - began, "ms_per_scan": each}


def on_the_map(info: Info) -> tuple[np.ndarray, np.ndarray]:
    """The poses on the map, (S, 3): those that its lines were drawn at; and the covariances of the poses since the
    start, (S, 3, 3).
    """
    mean = np.asarray(info.belief.mean, np.float64)
    local = np.asarray(jax.vmap(lambda mean: submaps.relative_pose(mean, _OLDER)[0])(info.belief.mean), np.float64)
    poses = compose(mean[:, _OLDER : _OLDER + POSE], local)
    poses[:, 2] = wrapped(poses[:, 2])
    return poses, np.asarray(info.belief.cov, np.float64)[:, :POSE, :POSE]


def match_report(log: Log, info: Info, config: Config, poses: np.ndarray, cov: np.ndarray) -> dict[str, Any]:
    """What the matches say of themselves.

    Args:
        log: S scans.
        info: of the filter, (S, ...).
        config: of the filter.
        poses: (S, 3) m, m, rad.
        cov: (S, 3, 3) given the first pose.

    Raises:
        ValueError: a filter that matches no scans.
    """
    match, matcher = info.match, config.matcher
    if matcher is None:
        raise ValueError("config.matcher: expected a Matcher, got None")
    refused = jax.tree.map(np.asarray, submaps.refusals(match, matcher))
    tried = int(match.tried.sum())
    at = np.concatenate([[-1], np.flatnonzero(match.accepted | match.anew), [len(match.accepted)]])
    streaks = np.diff(at) - 1
    longest = int(np.argmax(streaks))
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0))
    return {
        "log": log.name,
        "scans": len(log.scan),
        "beams": log.scan.shape[1],
        "path_m": float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
        "matched": int(match.accepted.sum()),
        "tried": tried,
        "refused": {name: int(reason.sum()) for name, reason in refused._asdict().items()},
        "refused_most_in_a_row": int(streaks[longest]),
        "refused_most_from_s": float(log.scan_time[at[longest] + 1]) if streaks[longest] else None,
        "nis_mean": float(match.nis[match.accepted].mean()) if match.accepted.any() else None,
        "nis_median": float(np.median(match.nis[match.accepted])) if match.accepted.any() else None,
        "points_used": float((match.used / np.maximum(match.points, 1))[match.tried].mean()) if tried else 0.0,
        "flagged": int((~info.ok).sum()),
        "sigma_position_end_m": float(np.hypot(sigma[-1, 0], sigma[-1, 1])),
        "sigma_position_most_m": float(np.hypot(sigma[:, 0], sigma[:, 1]).max()),
        "sigma_heading_end_rad": float(sigma[-1, 2]),
    }
