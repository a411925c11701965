"""Localise a robot on its log, and judge the filter against the truth where the log has one."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from common import (
    CONSOLE,
    check_gate,
    command_line,
    count_rows,
    in_pieces,
    output_folder,
    params_or,
    saved,
    show,
    write_report,
)
from report_table import innovation_rows, pose_rows, print_verdicts

from jaxlocmap import Config, Gaussian, Info, Inputs, Params, State, consistency, init, plotting, run
from jaxlocmap.consistency import readable
from jaxlocmap.logs import MAX_GAP, Log, Timeline, read, to_timeline, write_csv, write_tum
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.smoothing import smooth

_PIECE = 2000  # steps between two moves of the progress bar

# What the program believes of a log that states nothing: wheel commands (spectral density 0.1 m/s and 0.1 rad/s per
# root second, over periods of 0.1 s) and a camera's landmarks.
_DEFAULT_NOISE = {"v": 0.1 / 0.1**0.5, "w": 0.1 / 0.1**0.5, "range": 0.15, "bearing": 0.05}
PERIOD = 0.1  # s, what Q refers to
PRIOR_STD = (0.05, 0.05, 0.05)  # m, m, rad, around the pose to start from


@dataclasses.dataclass(frozen=True)
class LocalizeConfig:
    """Settings of the filter, and what it reads."""

    log: tyro.conf.Positional[Path]
    """The log: a file for woods, a folder for mrclam."""
    format: Literal["woods", "mrclam"]
    """How the log is written."""
    robot: int | None = None
    """Which robot of an mrclam log."""
    params: Path | None = None
    """JSON file of Q and R; by default the variances the log states, or what fits the format."""
    motion: Literal["arc", "euler", "capstone"] = "arc"
    """The filter's motion model."""
    gate: float | None = 0.99
    """Probability with which a good observation passes the gate; None for no gate."""
    max_range: float | None = None
    """Observations at or beyond are left out, m."""
    max_gap: float = MAX_GAP
    """The longest interval over which a command holds and truth is interpolated, s. In a longer gap of the odometry
    the robot is taken to stand."""
    start: tuple[float, float, float] | None = None
    """Pose to start from, m, m, rad; by default the first true pose."""
    smooth: bool = False
    """Also correct every pose by what came after."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/localize")
    """Folder for report.json, the figures and the trajectories."""
    quick: bool = False
    """The first 2,000 steps alone."""


def main(config: LocalizeConfig) -> dict[str, Any]:
    """Run the filter over the log, write the report, the figures and the trajectories."""
    out = output_folder(config.out)
    check_gate(config.gate)
    merge_kernels()
    log = read(config.log, config.format, config.robot)
    if not len(log.landmarks):
        raise ValueError(f"{config.log}: expected landmarks to localise by, got none (format {config.format})")
    if config.start is None and not len(log.truth_time):
        raise ValueError(f"start: {config.log} has no truth to start from: expected a pose X Y THETA, got None")
    if config.start is not None and not np.all(np.isfinite(config.start)):
        raise ValueError(f"start: expected a finite pose X Y THETA, got {config.start}")
    begin = float(log.truth_time.min()) if config.start is None else None
    timeline = to_timeline(log, max_range=config.max_range, start=begin, max_gap=config.max_gap)
    if config.quick:
        timeline = _first(timeline, _PIECE)
    with jax.enable_x64(True):
        params = params_or(config.params, believed(log))
        settings = Config(
            dt=PERIOD, motion=config.motion, gate_probability=config.gate, sensor_offset=offset_of(log.sensor_offset)
        )
        start = first_pose(log, timeline) if config.start is None else np.array(config.start)
        prior = prior_at(start)
        CONSOLE.print(f"{len(timeline.time)} steps of {log.name}; compiling takes some seconds")
        for sentence in (said := time_sentences(log, timeline.counts, config.max_gap)):
            CONSOLE.print(f"careful: {sentence}")
        info = filter_log(params, prior, timeline.inputs, log.landmarks, settings)
        report = judge(log, timeline, info, settings)
        if config.smooth:
            smoothed = _smoothed(params, info.belief, timeline.inputs, config=settings)
            report["smoothed"] = judge_smoothed(timeline, smoothed)
            last = np.append(np.diff(timeline.time) > 0, True)
            stamps, poses, cov = timeline.time[last], smoothed.mean[last], smoothed.cov[last]
            write_csv(out / "smoothed.csv", stamps, np.asarray(poses), np.asarray(cov))
    report["careful"] = said
    report["params"] = params.numbers()
    _write(out, log, timeline, info, report)
    return report


def time_sentences(log: Log, counts: Mapping[str, float], max_gap: float) -> list[str]:
    """What a user should know of the log's time."""
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
    first = np.searchsorted(timeline.time, timeline.time[0], side="right") - 1  # the last step at the first stamp
    if not timeline.truth_valid[first]:
        raise ValueError(
            f"start: {log.name} has no truth at its first step, {timeline.time[0]:.3f} s: expected a pose X Y THETA"
        )
    return timeline.truth[first]


def offset_of(offset: np.ndarray) -> tuple[float, float, float]:
    dx, dy, dtheta = (float(x) for x in offset)
    return dx, dy, dtheta


def _first(timeline: Timeline, steps: int) -> Timeline:
    """The same timeline, cut short."""
    cut = jax.tree.map(lambda x: x[:steps], timeline._replace(counts={}))
    return cut._replace(counts=timeline.counts)


def believed(log: Log) -> Params:
    stated = log.stated_variance
    deviations = _DEFAULT_NOISE if stated is None else {name: value**0.5 for name, value in stated.items()}
    return Params.from_std(**deviations)


@functools.partial(jax.jit, static_argnames="config")
def _piece(params: Params, state: State, inputs: Inputs, landmarks: jax.Array, *, config: Config) -> tuple[State, Info]:
    return run(params, state, inputs, landmarks=landmarks, config=config)


def filter_log(params: Params, prior: Gaussian, inputs: Inputs, landmarks: np.ndarray, config: Config) -> Info:
    """`run`, in equal pieces so that a bar can move. The last is filled up with steps of no time and no observations,
    which change nothing.
    """
    steps = len(inputs.dt)
    fill = -steps % _PIECE
    padded = jax.tree.map(lambda x: np.concatenate([x, np.zeros((fill, *x.shape[1:]), x.dtype)]), inputs)

    def turn(state: State, piece: Inputs) -> tuple[State, Info]:
        return _piece(params, state, piece, landmarks, config=config)

    _, info = in_pieces(turn, init(prior, config=config), padded, steps, _PIECE, "filtering")
    return info


def judge(log: Log, timeline: Timeline, info: Info, config: Config) -> dict[str, Any]:
    """The report of the library's `judge`, and what a log adds to it."""
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


_smoothed = jax.jit(smooth, static_argnames="config")


def judge_smoothed(timeline: Timeline, smoothed: Gaussian) -> dict[str, Any]:
    """What the library's `judge` says of the smoothed poses."""
    report = consistency.judge(
        timeline.truth,
        np.asarray(smoothed.mean),
        np.asarray(smoothed.cov),
        time=timeline.time - timeline.time[0],
        valid=timeline.truth_valid,
    )
    names = ("rmse_position_m", "rmse_yaw_rad", "anees", "nees_median", "coverage_95", "verdict")
    return {name: report[name] for name in names}


def _write(out: Path, log: Log, timeline: Timeline, info: Info, report: dict[str, Any]) -> None:
    write_report(out, report)
    last = np.append(np.diff(timeline.time) > 0, True)  # of the steps at one stamp
    write_tum(out / "estimate.tum", timeline.time[last], info.belief.mean[last])
    files = ["report.json", "trajectory.png", "estimate.tum"]
    known = timeline.truth_valid
    judged = report["scored_steps"] > 0
    if judged:
        write_tum(out / "truth.tum", timeline.time[known], timeline.truth[known])
        plotting.judge_figure(out / "nees.png", report, timeline.truth[:, :2], log.name)
        files += ["truth.tum", "nees.png"]
    plotting.trajectory_figure(
        out / "trajectory.png",
        np.asarray(info.belief.mean),
        np.asarray(info.belief.cov),
        timeline.truth if judged else None,
        landmarks=log.landmarks,
        title=f"{log.name}: position RMSE {report['rmse_position_m']:.3f} m" if judged else log.name,
    )
    _print(report, judged)
    saved(out, *files, *(["smoothed.csv"] if "smoothed" in report else []))


def _print(report: dict[str, Any], judged: bool) -> None:
    rows = [
        ("steps, observations", f"{report['steps']}, {report['observations']}", ""),
        ("flagged steps", str(report["flagged_steps"]), "0"),
        *innovation_rows(report),
    ]
    if judged:
        rows += [
            ("steps with truth", f"{100 * report['truth_share']:.1f} %", ""),
            ("independent samples", readable(report["independent_samples"]), ""),
            ("ANEES at observations", readable(report["anees_at_observations"]), "3"),
            ("median NEES", readable(report["nees_median"]), f"{consistency.chi2_quantile(0.5, 3):.2f}"),
            *pose_rows(report),
        ]
    if judged and "smoothed" in report:
        after = report["smoothed"]
        rows += [
            ("smoothed: position RMSE", f"{after['rmse_position_m']:.3f} m", ""),
            ("smoothed: heading RMSE", f"{after['rmse_yaw_rad']:.4f} rad", ""),
            ("smoothed: average NEES", readable(after["anees"]), "3"),
        ]
    show(report["log"], rows + count_rows(report["counts"] | report["left_out"]))
    print_verdicts(report)


if __name__ == "__main__":
    command_line(main, LocalizeConfig)
