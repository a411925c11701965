"""A filter that localises among landmarks, over a recorded log, and what can be said of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import consistency
from jaxlocmap.logs import Log, Timeline
from jaxlocmap.parameters import Params
from jaxlocmap.pipeline import init, run
from jaxlocmap.replay.pieces import in_pieces
from jaxlocmap.types import Config, Gaussian, Info, Inputs, State

PIECE = 2000  # steps between two calls of `progress`

# What is believed of a log that states nothing: wheel commands (spectral density 0.1 m/s and 0.1 rad/s per root
# second, over periods of 0.1 s) and a camera's landmarks.
_DEFAULT_NOISE = {"v": 0.1 / 0.1**0.5, "w": 0.1 / 0.1**0.5, "range": 0.15, "bearing": 0.05}
PERIOD = 0.1  # s, what Q refers to
PRIOR_STD = (0.05, 0.05, 0.05)  # m, m, rad, around the pose to start from


def time_doubts(log: Log, counts: Mapping[str, float], max_gap: float) -> list[str]:
    """What a user should know of the log's time, in words.

    Args:
        log: as it was read.
        counts: of its timeline.
        max_gap: the longest interval over which a command holds, s.
    """
    sentences = []
    if counts["odometry_gaps"]:
        sentences.append(
            f"the odometry pauses for more than {max_gap:g} s, {counts['odometry_gaps']} time(s): the robot is taken "
            f"to stand there, {counts['odometry_gap_seconds']:g} s in all"
        )
    for what, stamps in (("truth", len(log.truth_time)), ("odometry", len(log.odometry_time))):
        repeated = counts[f"duplicate_{what}"]
        if repeated > stamps / 2:
            sentences.append(
                f"{repeated:,} of {stamps:,} stamps of the {what} repeat another, and the last of each counts: were "
                f"they written with too few digits?"
            )
    seen = log.observation_time
    if len(seen) and not np.any((seen >= log.odometry_time.min()) & (seen <= log.odometry_time.max())):
        sentences.append(
            f"observations from {seen.min():.3f} to {seen.max():.3f} s, none in the time of the odometry, "
            f"{log.odometry_time.min():.3f} to {log.odometry_time.max():.3f} s: do their clocks differ?"
        )
    return sentences


def prior_at(pose: np.ndarray) -> Gaussian:
    """What a filter believes that starts at a pose, m, m, rad."""
    return Gaussian(jnp.asarray(pose), jnp.diag(jnp.array(PRIOR_STD) ** 2))


def first_pose(log: Log, timeline: Timeline) -> np.ndarray:
    """The true pose at the first step, m, m, rad.

    Raises:
        ValueError: it is not known.
    """
    first = np.searchsorted(timeline.time, timeline.time[0], side="right") - 1  # the last step at the first stamp
    if not timeline.truth_valid[first]:
        raise ValueError(
            f"start: {log.name} has no truth at its first step, {timeline.time[0]:.3f} s: expected a pose X Y THETA"
        )
    return timeline.truth[first]


def offset_of(offset: np.ndarray) -> tuple[float, float, float]:
    """A log's sensor offset as `Config` has it, m, m, rad."""
    dx, dy, dtheta = (float(x) for x in offset)
    return dx, dy, dtheta


def believed(log: Log) -> Params:
    """The noise that the log states, or what fits a robot with wheels and a camera."""
    stated = log.stated_variance
    deviations = _DEFAULT_NOISE if stated is None else {name: value**0.5 for name, value in stated.items()}
    return Params.from_std(**deviations)


def filter_log(
    params: Params,
    prior: Gaussian,
    inputs: Inputs,
    landmarks: np.ndarray,
    config: Config,
    progress: Callable[[int], None] = lambda done: None,
) -> Info:
    """`run` in equal pieces, so that its progress can be told. The last is filled up with steps of no time and no
    observations, which change nothing.

    Args:
        params: what the filter believes.
        prior: before the first step.
        inputs: of the log's timeline, (T, ...).
        landmarks: (L, 2) m.
        config: of the filter.
        progress: called with the number of steps done so far.

    Returns:
        What every step reports, (T, ...), as NumPy arrays.
    """
    steps = len(inputs.dt)
    fill = -steps % PIECE
    padded = jax.tree.map(lambda x: np.concatenate([x, np.zeros((fill, *x.shape[1:]), x.dtype)]), inputs)

    def turn(state: State, piece: Inputs) -> tuple[State, Info]:
        return run(params, state, piece, landmarks=jnp.asarray(landmarks), config=config)

    _, info = in_pieces(turn, init(prior, config=config), padded, steps, PIECE, progress)
    return info


def judge_log(log: Log, timeline: Timeline, info: Info, config: Config) -> dict[str, Any]:
    """The report of `consistency.judge`, and what a log adds to it.

    Args:
        log: as it was read.
        timeline: of the log; T steps.
        info: of the filter, (T, ...).
        config: of the filter.
    """
    valid, truth = np.asarray(timeline.inputs.valid), timeline.truth_valid
    report = consistency.judge(
        timeline.truth,
        np.asarray(info.belief.mean),
        np.asarray(info.belief.cov),
        time=timeline.time - timeline.time[0],
        valid=truth,
        innovations=consistency.Innovations(info.innovation, info.S, valid, info.accepted, info.row),
        gate_probability=config.gate_probability,
    )
    nees = np.array(report["nees_per_step"])
    at_observations = nees[valid.any(axis=1) & np.isfinite(nees)]
    flagged = int((~info.ok).sum())
    if not truth.any():
        report["verdict"] = "no verdict: the log has no truth to judge the covariance by"
    elif 2 * flagged > len(info.ok):
        report["verdict"] = (
            f"no verdict: {flagged} of {len(info.ok)} steps are flagged: their input, or what the filter made of it, "
            f"is no number that can be used"
        )
    return report | {
        "log": log.name,
        "duration_s": float(timeline.time[-1] - timeline.time[0]),
        "flagged_steps": flagged,
        "log_likelihood": float(info.log_likelihood.sum()),
        "counts": timeline.counts,
        "left_out": report["counts"],
        "truth_share": float(truth.mean()),
        "anees_at_observations": float(at_observations.mean()) if len(at_observations) else math.nan,
    }


def judge_smoothed(timeline: Timeline, smoothed: Gaussian) -> dict[str, Any]:
    """What `consistency.judge` says of smoothed poses, (T, ...)."""
    report = consistency.judge(
        timeline.truth,
        np.asarray(smoothed.mean),
        np.asarray(smoothed.cov),
        time=timeline.time - timeline.time[0],
        valid=timeline.truth_valid,
    )
    names = ("rmse_position_m", "rmse_yaw_rad", "anees", "nees_median", "coverage_95", "verdict")
    return {name: report[name] for name in names}
