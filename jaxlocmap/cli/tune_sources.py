"""What `tune` tunes on and what it judges the result by: a scenario, or the logs of real robots."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import Config, Gaussian, Params, simulation, tuning
from jaxlocmap.cli.console import CONSOLE, progress_bar
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.logs import MAX_GAP, Log, Timeline, read, to_timeline
from jaxlocmap.mapping.predictive import PredictiveScore
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.replay import maps
from jaxlocmap.replay.landmarks import (
    PERIOD,
    PRIOR_STD,
    believed,
    filter_log,
    first_pose,
    judge_log,
    offset_of,
    prior_at,
    time_doubts,
)
from jaxlocmap.simulation import random_room, scenario_of

Evidence = dict[str, Any]
TUNING_GATE, JUDGE_GATE = 0.9999, 0.99
_LOST_STD = (1.0, 1.0, 0.5)  # m, m, rad: how far off a window may start where no truth is known
GATE_TEMPERATURE = 2.0  # while tuning, of the squared distance; the gate itself is at 18.4, for a probability of 0.9999
_HELD_OUT_WORLDS = 64
_BLOCKS = 10  # of the scans of one map, for its standard errors

# Steps that count in a window, and steps before them in which the filter forgets its start: 30 s each on woods, where
# the filter remembers some 5 s; 45 s and 30 s on mrclam, where observations are far between.
_WINDOWS = {"woods": (300, 300), "mrclam": (3000, 2000)}


class Source(NamedTuple):
    """Sequences and settings."""

    name: str
    start: Params
    config: Config  # while tuning
    train: tuning.Batch
    validation: tuning.Batch | None
    compared: tuning.Batch  # what is tuned on, in the parts whose spread makes the standard errors
    evidence: Callable[[Params], Evidence]  # of parameters, on what is held out
    dt: float


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What the command line asks of a source."""

    losses: tuple[str, ...]
    start: Params | None
    gate: float | None  # while tuning
    judge_gate: float | None
    seed: int
    quick: bool
    max_gap: float = MAX_GAP  # s


def from_scenario(name: str, motion: str, runs: int, judge_runs: int, wanted: Wanted) -> Source:
    """Simulated drives: `runs` to tune on, a quarter as many to pick the best by, and fresh ones to judge.

    With the loss `map`, rooms are drawn anew for every run, so that those judged are not those tuned on.
    """
    scenario, noise = scenario_of(name), simulation.Noise()
    mapping = "map" in wanted.losses
    config = _tuning(scenario.config(motion=motion, gate_probability=wanted.gate, grid=mapping))
    key = jax.random.key(wanted.seed)

    def drives(i: int, count: int) -> tuning.Batch:
        drives_key, rooms_key = jax.random.split(jax.random.fold_in(key, i))
        rooms = jax.vmap(random_room)(jax.random.split(rooms_key, count)) if mapping else simulation.room()
        return tuning.simulated(drives_key, count, rooms, noise, scenario=scenario, scans=mapping, worlds=mapping)

    held_out = drives(2, min(judge_runs, _HELD_OUT_WORLDS)) if mapping else None
    study_config = scenario.config(motion=motion, gate_probability=wanted.judge_gate, grid=mapping)
    study_runs = min(judge_runs, 200) if mapping else judge_runs

    def evidence(params: Params) -> Evidence:
        fresh, room = jax.random.fold_in(key, 3), simulation.room()
        report = judged_by_study(fresh, study_runs, params, room, noise, scenario=scenario, config=study_config)
        if held_out is not None:
            report["one_scan_ahead"] = _predictive_score(params, held_out, study_config)
        return report

    train = drives(0, runs)
    # Where only the map is tuned the simulated robot knows its own noise: the map is to be judged, not the pose.
    own = simulation.own_params(noise, scenario)
    start = simulation.course_params()
    if wanted.losses == ("map",):
        start = own._replace(l_occ=start.l_occ, l_free=start.l_free)
    return Source(
        f"{name}, {motion} motion, {runs} runs",
        wanted.start or start,
        config,
        train,
        drives(1, max(runs // 4, 1)),
        train,
        evidence,
        scenario.dt,
    )


def judged_by_study(
    key: jax.Array,
    runs: int,
    params: Params,
    world: simulation.World,
    noise: simulation.Noise,
    *,
    scenario: simulation.Scenario,
    config: Config,
) -> Evidence:
    """The report of a study of fresh runs, in float32, as studies are made."""
    args = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (params, world, noise, scenario.prior()))
    return summarise(monte_carlo(Study(scenario, config), key, runs, *args).value, config)


def from_robots(
    path: Path,
    kind: str,
    robots: tuple[int, ...],
    judged: tuple[int, ...],
    motion: str,
    max_range: float | None,
    wanted: Wanted,
) -> Source:
    """Logs of robots among landmarks. woods: the first half to tune on, the second to judge. mrclam: whole robots."""
    if kind == "woods":
        log, timeline = _timeline(path, kind, None, max_range, wanted)
        half = len(timeline.time) // 2
        drives = [(log, _cut(timeline, 0, half))]
        held_out = {"second half": (log, _from_truth(_cut(timeline, half, None)))}
    else:
        if not robots or not judged or set(robots) & set(judged):
            raise ValueError(
                f"robots, judged: expected robots to tune on and others to judge, got {robots} and {judged}"
            )
        drives = [_timeline(path, kind, robot, max_range, wanted) for robot in robots]
        held_out = {f"robot {robot}": _timeline(path, kind, robot, max_range, wanted) for robot in judged}
    log = drives[0][0]
    reach = Config.max_range if max_range is None else max_range
    filter_config = Config(dt=PERIOD, motion=motion, sensor_offset=offset_of(log.sensor_offset), max_range=reach)
    config = _tuning(dataclasses.replace(filter_config, gate_probability=wanted.gate))
    start = wanted.start or believed(log)
    length, run_in = _WINDOWS[kind]
    cut = tuning.join(*(_windows(timeline, log, start, config, length, run_in) for log, timeline in drives))
    some = np.arange(len(cut.counted)) % 5 == 4
    train, validation = tuning.pick(cut, ~some), tuning.pick(cut, some) if some.any() else None
    judged_config = dataclasses.replace(filter_config, gate_probability=wanted.judge_gate)

    def evidence(params: Params) -> Evidence:
        return {name: _judged(params, *drive, judged_config) for name, drive in held_out.items()}

    said = f"{path.name}" + (f", robots {', '.join(map(str, robots))}" if kind == "mrclam" else ", first half")
    return Source(said, start, config, train, validation, train, evidence, PERIOD)


def from_scans(path: Path, resolution: float, max_range: float, wanted: Wanted) -> Source:
    """A laser log with poses: the first half of the scans to tune on, of which every fifth run of scans picks the best,
    the second half to judge, mapped onto what the first has left.
    """
    log = read(path, "carmen")
    scans = min(len(log.scan), 60) if wanted.quick else len(log.scan)
    log = log.with_scans(slice(scans))
    mapped, _, config = maps.mappable(log, resolution, max_range)
    for sentence in maps.scan_doubts(log, config.max_range):
        CONSOLE.print(sentence, soft_wrap=True)
    half = scans // 2
    whole = _scans(mapped, scans)
    first = _scans(mapped, half)
    number = np.arange(half) // max(half // 25, 1)
    train, validation = (
        first._replace(counted=(number % 5 != 4)[None]),
        first._replace(counted=(number % 5 == 4)[None]),
    )
    later = whole._replace(counted=(np.arange(scans) >= half)[None])
    return Source(
        f"{path.name}, first {half} of {scans} scans",
        wanted.start or simulation.course_params(),
        config,
        train,
        validation,
        tuning.blocks(train, min(_BLOCKS, half // 2)),
        lambda params: {"one_scan_ahead": _predictive_score(params, later, config)},
        1.0,
    )


def _tuning(config: Config) -> Config:
    """The filter's settings with a gate that weighs instead of deciding, so that gradients see what it does."""
    return dataclasses.replace(config, gate_temperature=GATE_TEMPERATURE)


def _scans(log: Log, count: int) -> tuning.Batch:
    inputs = tuning.no_observations(count)._replace(ranges=log.scan[:count])
    prior = prior_at(log.truth[0])
    return tuning.sequence(inputs, prior, beam_angles=log.beam_angles, poses=log.truth[:count])


def _timeline(
    path: Path, kind: str, robot: int | None, max_range: float | None, wanted: Wanted
) -> tuple[Log, Timeline]:
    log = read(path, kind, robot)
    if not len(log.landmarks):
        raise ValueError(f"{path}: expected landmarks to localise by, got none (format {kind})")
    if not len(log.truth_time):
        raise ValueError(f"{path}: expected a log with truth, to start from, to judge by and for some losses, got none")
    timeline = to_timeline(log, max_range=max_range, start=float(log.truth_time.min()), max_gap=wanted.max_gap)
    for sentence in time_doubts(log, timeline.counts, wanted.max_gap):
        CONSOLE.print(f"careful: {log.name}: {sentence}")
    return log, _cut(timeline, 0, 6000 if kind == "mrclam" else 2400) if wanted.quick else timeline


def _cut(timeline: Timeline, begin: int, end: int | None) -> Timeline:
    return jax.tree.map(lambda x: x[begin:end], timeline._replace(counts={}))


def _from_truth(timeline: Timeline) -> Timeline:
    """From the first step on at which the truth is known, to start from."""
    return _cut(timeline, int(np.argmax(timeline.truth_valid)), None)


def _windows(timeline: Timeline, log: Log, start: Params, config: Config, length: int, run_in: int) -> tuning.Batch:
    """Windows that start at the truth where it is known, and elsewhere roughly where the filter believes to be."""
    whole = tuning.sequence(
        timeline.inputs,
        prior_at(first_pose(log, timeline)),
        landmarks=log.landmarks,
        truth=timeline.truth,
        known=timeline.truth_valid,
    )
    mean: Any = np.where(timeline.truth_valid[:, None], timeline.truth, 0)[None]
    if not timeline.truth_valid.all():
        means = np.asarray(jax.jit(tuning.beliefs, static_argnames="config")(start, whole, config=config).mean)
        mean = np.where(timeline.truth_valid[:, None], mean, means)
    spread = np.where(timeline.truth_valid[:, None], PRIOR_STD, _LOST_STD)[None] ** 2
    cov: Any = spread[..., None] * np.eye(3)
    return tuning.windows(whole, length, run_in=run_in, beliefs=Gaussian(mean, cov))


def _judged(params: Params, log: Log, timeline: Timeline, config: Config) -> Evidence:
    prior = prior_at(first_pose(log, timeline))
    with progress_bar("filtering", len(timeline.time)) as progress:
        info = filter_log(params, prior, timeline.inputs, log.landmarks, config, progress)
    report = judge_log(log, timeline, info, config)
    return report | {"time": timeline.time}


@functools.partial(jax.jit, static_argnames="config")
def _predictive_sums(params: Params, batch: tuning.Batch, *, config: Config) -> PredictiveScore:
    """The sums over all drives, mapped where the batch says or else where the filter is."""
    poses = batch.poses if batch.poses is not None else tuning.beliefs(params, batch, config=config).mean
    each = tuning.predictive_score(params.l_occ, params.l_free, batch, poses, config=config, bins=True)
    return jax.tree.map(lambda x: jnp.sum(x, axis=0), each)


def _predictive_score(params: Params, batch: tuning.Batch, config: Config) -> Evidence:
    """Log-loss and calibration one scan ahead."""
    sums = jax.tree.map(lambda x: np.asarray(x, np.float64), _predictive_sums(params, batch, config=config))
    some = np.maximum(sums.bin_cells, 1)
    return {
        "log_loss": float(sums.log_loss / sums.cells),
        "cells": float(sums.cells),
        "calibration_error": float(np.abs(sums.bin_probability - sums.bin_hits).sum() / sums.bin_cells.sum()),
        "calibration_cells": sums.bin_cells.tolist(),
        "calibration_probability": (sums.bin_probability / some).tolist(),
        "calibration_frequency": (sums.bin_hits / some).tolist(),
    }
