"""Localise a robot among landmarks on its log, and judge the filter against the truth where the log has one.

Writes the trajectory with its ellipses, the NEES, and estimate.tum and truth.tum, which `evo_ape tum` compares.
With --smooth every pose is corrected by what came after, backwards over the whole log, and smoothed.csv written.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

from jaxlocmap import Config, Info, consistency, plotting
from jaxlocmap.cli.console import CONSOLE, count_rows, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.cli.options import check_gate, params_or
from jaxlocmap.cli.rows import innovation_rows, pose_rows, print_verdicts
from jaxlocmap.consistency import readable
from jaxlocmap.logs import MAX_GAP, Log, Timeline, read, to_timeline, write_csv, write_tum
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.replay import landmarks as replay
from jaxlocmap.smoothing import smooth

_smoothed = jax.jit(smooth, static_argnames="config")


@dataclasses.dataclass(frozen=True)
class LocalizeConfig:
    """Localise a robot among landmarks on its log, and judge the filter where the log has the truth."""

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
        timeline = _first(timeline, replay.PIECE)
    with jax.enable_x64(True):
        params = params_or(config.params, replay.believed(log))
        offset = replay.offset_of(log.sensor_offset)
        settings = Config(dt=replay.PERIOD, motion=config.motion, gate_probability=config.gate, sensor_offset=offset)
        start = replay.first_pose(log, timeline) if config.start is None else np.array(config.start)
        prior = replay.prior_at(start)
        CONSOLE.print(f"{len(timeline.time)} steps of {log.name}; compiling takes some seconds")
        for sentence in (said := replay.time_doubts(log, timeline.counts, config.max_gap)):
            CONSOLE.print(f"careful: {sentence}")
        with progress_bar("filtering", len(timeline.time)) as progress:
            info = replay.filter_log(params, prior, timeline.inputs, log.landmarks, settings, progress)
        report = replay.judge_log(log, timeline, info, settings)
        if config.smooth:
            smoothed = _smoothed(params, info.belief, timeline.inputs, config=settings)
            report["smoothed"] = replay.judge_smoothed(timeline, smoothed)
            last = np.append(np.diff(timeline.time) > 0, True)
            stamps, poses, cov = timeline.time[last], smoothed.mean[last], smoothed.cov[last]
            write_csv(out / "smoothed.csv", stamps, np.asarray(poses), np.asarray(cov))
    report["careful"] = said
    report["params"] = params.numbers()
    _write(out, log, timeline, info, report)
    return report


def _first(timeline: Timeline, steps: int) -> Timeline:
    """The same timeline, cut short."""
    cut = jax.tree.map(lambda x: x[:steps], timeline._replace(counts={}))
    return cut._replace(counts=timeline.counts)


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
