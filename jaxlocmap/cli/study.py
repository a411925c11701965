"""Can the filter's covariance be believed? Thousands of simulated runs, their NEES with its band, and a verdict."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from jaxlocmap import Config, Params, init, plotting, run, simulation
from jaxlocmap.cli.compute import ComputeConfig, finish, how_computed, start, study, study_checkpoint
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.cli.options import check_gate, params_or
from jaxlocmap.cli.rows import band, innovation_rows, match_rows, pose_rows, print_verdicts
from jaxlocmap.consistency import readable
from jaxlocmap.consistency.study import RandomBuildings, Study, reference_study, summarise
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.simulation import World, scenario_of, with_known_start, world_of
from jaxlocmap.types import Matcher

_REFERENCE_RUNS = 2000, 20_000  # at least and at most
# What a study can be resumed by.
_SETTINGS = (
    *("scenario", "motion", "gate", "start", "map", "seed", "steps", "own_noise", "odometry_noise", "beams"),
    *("scan_noise", "exact_prior", "landmarks", "match", "match_every"),
)


@dataclasses.dataclass(frozen=True)
class StudyConfig:
    """Can the filter's covariance be believed? Thousands of simulated runs, their NEES, and a verdict."""

    scenario: Literal["capstone", "loop", "building", "random_building"] = "capstone"
    """The drive: the course's, two laps through free space, or rounds of a building without landmarks, the same one or
    one drawn for each run."""
    steps: int | None = None
    """How many steps of 0.1 s; by default as the scenario has it."""
    motion: Literal["arc", "euler", "capstone"] = "arc"
    """The filter's motion model."""
    runs: int = 2000
    """How many simulated runs."""
    params: Path | None = None
    """JSON file of Q, R, l_occ, l_free; the course's by default."""
    own_noise: bool = False
    """Without a file: the noise the robot has, not the one the course's filter believes in."""
    gate: float | None = 0.99
    """Probability with which a good observation passes the gate; None for no gate."""
    start: Literal["exact", "drawn"] | None = None
    """The true start: exactly the prior's mean, or drawn from the prior; by default as the scenario has it."""
    exact_prior: bool = False
    """The filter knows the start, to a millimetre and a milliradian."""
    landmarks: bool = True
    """The robot observes the landmarks."""
    odometry_noise: float = 1.0
    """How many times its usual errors the robot's odometry has."""
    beams: int = 61
    """How many its scanner has, over 137 degrees."""
    scan_noise: float = 0.03
    """Standard deviation of a range of its scanner, m."""
    match: bool = False
    """Match scans on submaps."""
    match_every: int = 5
    """Steps between two matches."""
    map: bool = True
    """Map as well, and score the map."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/study")
    """Folder for report.json, nees.png and map.png."""
    quick: bool = False
    """A run of a few seconds: 100 runs."""
    compute: Annotated[ComputeConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ComputeConfig)


def main(config: StudyConfig) -> dict[str, Any]:
    """Run the study, write the report and the figures."""
    out = output_folder(config.out)
    check_gate(config.gate)
    scenario = scenario_of(config.scenario)
    if config.start is not None:
        scenario = dataclasses.replace(scenario, exact_prior=config.start == "exact")
    if config.steps is not None:
        scenario = dataclasses.replace(scenario, steps=config.steps)
    scenario = dataclasses.replace(scenario, beams=config.beams)
    if config.exact_prior:
        scenario = with_known_start(scenario)
    noise = robot_noise(config)
    if config.runs < 1:
        raise ValueError(f"runs: expected at least 1, got {config.runs}")
    runs = min(config.runs, 100) if config.quick else config.runs
    start(config.compute)
    settings = scenario.config(motion=config.motion, gate_probability=config.gate, grid=config.map)
    world, prior = world_of(scenario), scenario.prior()
    if not config.landmarks:
        world = world._replace(landmarks=world.landmarks[:0])
    own = simulation.own_params(noise, scenario)
    params = params_or(config.params, own if config.own_noise else simulation.course_params())
    if config.match:
        settings = dataclasses.replace(settings, matcher=Matcher(period=config.match_every, gap=simulation.MATCH_GAP))
        params = with_defaults(params, std=config.scan_noise)
    key = jax.random.key(config.seed)
    named = {name: getattr(config, name) for name in _SETTINGS}
    checkpoint = study_checkpoint(out, config.compute, named)
    CONSOLE.print(f"{runs} runs of {scenario.name}, {scenario.steps} steps each")

    began = time.perf_counter()
    drawn = scenario.name == simulation.RANDOM_BUILDING.name
    one_run = (RandomBuildings if drawn else Study)(scenario, settings)
    totals = study(one_run, key, runs, params, world, noise, prior, config=config.compute, checkpoint=checkpoint)
    report = {
        "scenario": scenario.name,
        "motion": config.motion,
        "prior": "exact" if scenario.exact_prior else "drawn",
        **summarise(totals.value, settings, _reference(scenario, settings, config, world, runs)),
        "params": params.numbers(),
        "seed": config.seed,
        **how_computed(totals, runs, began),
    }
    if jax.process_index() == 0:
        write_report(out, report)
        plotting.study_figure(out / "nees.png", report, scenario.dt)
        files = ["report.json", "nees.png"]
        if config.map:
            pictured = simulation.random_building(key) if drawn else world
            _picture_of_one_run(out / "map.png", key, params, pictured, noise, scenario, settings)
            files.append("map.png")
        _print(report)
        saved(out, *files)
    finish(checkpoint)
    return report


def robot_noise(config: StudyConfig) -> simulation.Noise:
    """The errors of the simulated robot."""
    for name in ("odometry_noise", "scan_noise"):
        if not 0 < getattr(config, name) < math.inf:
            raise ValueError(f"{name}: expected a finite number > 0, got {getattr(config, name)}")
    usual, times = simulation.Noise(), config.odometry_noise
    odometry = {"v": usual.v * times, "w": usual.w * times, "heading": usual.heading * times}
    return usual._replace(**odometry, scan=config.scan_noise)


def _reference(scenario: simulation.Scenario, settings: Config, config: StudyConfig, world: World, runs: int) -> Any:
    """What this start and this gate make of a filter told the robot's own noise; None where they make nothing of it,
    and where scans are matched, which takes too long.
    """
    gated = config.gate is not None and len(world.landmarks) > 0
    if config.match or not (scenario.exact_prior or gated):
        return None
    noise, count = robot_noise(config), min(max(runs, _REFERENCE_RUNS[0]), _REFERENCE_RUNS[1])
    told, params = reference_study(scenario, settings, noise)
    key = jax.random.fold_in(jax.random.key(config.seed), 1)  # other drives, so that errors are independent
    devices = jax.local_devices()[: config.compute.devices]
    with progress_bar("simulating a filter told the robot's own noise", count) as progress:
        args = params, world, noise, scenario.prior()
        return monte_carlo(told, key, count, *args, devices=devices, progress=progress).value


def _picture_of_one_run(
    path: Path,
    key: jax.Array,
    params: Params,
    world: World,
    noise: simulation.Noise,
    scenario: simulation.Scenario,
    settings: Any,
) -> None:
    """The map and path of one more run of the same study, started at the prior's mean."""
    truth, means, log_odds = jax.tree.map(
        np.asarray, _one_run(key, params, world, noise, scenario=scenario, config=settings)
    )
    plotting.map_figure(
        path,
        log_odds,
        settings.grid,
        means,
        truth=truth,
        segments=np.asarray(world.segments),
        title=f"Map of one run of {scenario.name}, made at the estimated poses",
    )


@functools.partial(jax.jit, static_argnames=("scenario", "config"))
def _one_run(
    key: jax.Array,
    params: Params,
    world: World,
    noise: simulation.Noise,
    *,
    scenario: simulation.Scenario,
    config: Config,
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """True poses, estimated poses and the map."""
    prior = scenario.prior()
    truth, inputs = simulation.simulate(key, world, noise, prior.mean, scenario=scenario)
    state, means = run(
        params,
        init(prior, config=config),
        inputs,
        landmarks=world.landmarks,
        beam_angles=scenario.beam_angles(),
        config=config,
        collect=lambda state, info, aside: info.belief.pose.mean,
    )
    return truth.pose, means, state.log_odds


def _print(report: dict[str, Any]) -> None:
    rows = [
        *pose_rows(report),
        ("median run's average NEES", f"{report['anees_median_run']:.3g}", ""),
        (
            "ANEES of undiverged runs",
            f"{report['anees_undiverged']:.3f} {band(report, 'anees_undiverged_interval_95')}",
            "",
        ),
        (
            "steps inside the NEES band",
            f"{100 * report['nees_steps_in_band']:.1f} % {band(report, 'nees_steps_in_band_interval_95', 100)}",
            "95 %",
        ),
        *(innovation_rows(report) if report["observations"] else ()),
        ("flagged steps", str(report["flagged_steps"]), "0"),
    ]
    if "matches" in report:
        rows += match_rows(report)
    for phase in report["nees_phases"]:
        low, high = phase["band_95"]
        name = f"NEES from {phase['from_s']:.4g} to {phase['to_s']:.4g} s"
        rows.append((name, readable(phase["anees"]), f"[{low:.3g}, {high:.3g}]"))
    if "map" in report:
        known = report["map"]["brier_base_rate"]
        rows += [
            ("map entropy", f"{report['map']['entropy_bits']:.0f} bits", ""),
            ("map Brier score", f"{report['map']['brier']:.4f}", f"0 is perfect, {known:.3f} knows only how many"),
        ]
    show(f"{report['scenario']}, {report['motion']} motion, {report['runs']} runs", rows)
    print_verdicts(report)
    CONSOLE.print(
        f"{report['runs_per_s']:.0f} runs/s after {report['compile_s']:.1f} s of compilation, in chunks of "
        f"{report['chunk']} runs on {report['devices']} device(s) of {report['processes']} process(es)",
    )
