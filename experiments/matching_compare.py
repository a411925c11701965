"""Scan matching against other ways, on the same simulated drives without landmarks: how accurate, and how honest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from baselines import scan_filters
from baselines.scan_filters import ON_LINES, ON_OCCUPANCY
from evidence import replace_table

from jaxlocmap import Gaussian, Params, consistency, plotting, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.consistency import readable
from jaxlocmap.consistency.means import average
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.monte_carlo import hosts, monte_carlo
from jaxlocmap.se2 import POSE
from jaxlocmap.simulation import MATCH_GAP, with_known_start, world_of
from jaxlocmap.types import Config, Matcher

_MATCHER = Matcher(period=5, gap=MATCH_GAP)
_CHUNK = 5  # runs at once: their maps are large


@dataclasses.dataclass(frozen=True)
class MatchingConfig:
    """What to compare on."""

    runs: int = 50
    """Simulated runs of either world."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/matching_compare")
    """Folder for report.json and matching_compare.png."""
    quick: bool = False
    """A short run, most of which is compiling: four runs of 20 s, in the loop alone."""


class Way(NamedTuple):
    """One filter."""

    name: str
    filter: str  # of `scan_filters`
    law: int | None = None  # which covariance


_WAYS = (
    Way("odometry alone", "odometry"),
    *(Way(f"occupancy grid, absolute: {label}", "on_occupancy", i) for i, label in enumerate(ON_OCCUPANCY)),
    *(Way(f"map of lines, absolute: {label}", "on_lines", i) for i, label in enumerate(ON_LINES)),
    Way("point-to-line ICP on cloned keyframes", "on_keyframes"),
    Way("this library: submaps with anchor and bias", "on_submaps"),
)


class Scores(NamedTuple):
    """Of one run, after each match. T matches."""

    nees: jax.Array  # (T,)
    error: jax.Array  # (T, 3) m, m, rad


@dataclasses.dataclass(frozen=True)
class Drive:
    """One simulated run, filtered in one way and scored. Hashable, so that `monte_carlo` compiles it once."""

    scenario: simulation.Scenario
    config: Config
    filter: str  # of `scan_filters`

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        world: simulation.World,
        noise: simulation.Noise,
        prior: Gaussian,
        law: jax.Array | None,
    ) -> Scores:
        """Scores of the run that `key` stands for, the same run whatever the filter."""
        start, key = jax.random.split(key)
        state = simulation.draw_start(start, prior, scenario=self.scenario)
        truth, inputs = simulation.simulate(key, world, noise, state, scenario=self.scenario)
        belief = getattr(scan_filters, self.filter)(
            params,
            prior,
            inputs,
            scanner=self.config.scanner(self.scenario.beam_angles()),
            config=self.config,
            **({} if law is None else {"law": law}),
        )
        error = jax.vmap(consistency.pose_error)(truth.pose[:: _MATCHER.period], belief.mean)
        return Scores(jax.vmap(consistency.nees)(error, belief.cov), error)


def main(config: MatchingConfig) -> dict[str, Any]:
    """Compare, print the table, write the report and the figure."""
    out = output_folder(config.out)
    hosts.check_count("runs", config.runs, least=2)  # whose spread makes a band
    hosts.use_all_cores()
    jax.config.update("jax_disable_most_optimizations", config.quick)  # a quick run does little but compile
    runs = min(config.runs, 4) if config.quick else config.runs
    worlds = {"loop": 200} if config.quick else {"loop": 2400, "building": 7200}
    report: dict[str, Any] = {"runs": runs, "seed": config.seed, "worlds": {}}
    done = 0
    with progress_bar("simulating", runs * len(_WAYS) * len(worlds)) as progress:
        for name, steps in worlds.items():
            scenario = with_known_start(dataclasses.replace(simulation.SCENARIOS[name], steps=steps))
            report["worlds"][name] = _world(scenario, runs, config.seed, lambda more, done=done: progress(done + more))
            done += runs * len(_WAYS)
    table = _table(report)
    if config.write:
        replace_table("matching", table)
    CONSOLE.print(f"\n{table}", soft_wrap=True)
    write_report(out, report)
    plotting.matching_figure(out / "matching_compare.png", report)
    saved(out, "report.json", "matching_compare.png")
    return report


def _world(scenario: simulation.Scenario, runs: int, seed: int, progress: Callable[[int], None]) -> dict[str, Any]:
    """Every filter on the same runs."""
    world, noise = world_of(scenario), simulation.Noise()
    world = world._replace(landmarks=world.landmarks[:0])
    params = with_defaults(simulation.own_params(noise, scenario))
    settings = scenario.config(motion=simulation.own_motion(scenario), grid=False)
    settings = dataclasses.replace(settings, matcher=_MATCHER)
    devices = len(jax.local_devices())
    filters = []
    for i, way in enumerate(_WAYS):
        law = None if way.law is None else np.int32(way.law)
        scores = monte_carlo(
            Drive(scenario, settings, way.filter),
            jax.random.key(seed),
            runs,
            *(params, world, noise, scenario.prior(), law),
            chunk=min(_CHUNK, -(-runs // devices)),
            keep_runs=True,
            progress=lambda done, i=i: progress(i * runs + done),
        ).value
        filters.append({"filter": way.name, **_row(*scores)})
    return {
        "time_s": (scenario.dt * (1 + np.arange(0, scenario.steps, _MATCHER.period))).tolist(),
        "nees_band_95": consistency.chi2_band(POSE, runs),
        "filters": filters,
    }


def _row(nees: np.ndarray, error: np.ndarray) -> dict[str, Any]:
    """What a table and a figure say of one filter. (runs, T), (runs, T, 3)."""
    square = np.mean(np.asarray(error, float) ** 2, axis=(0, 1))
    nees = np.asarray(nees, float)
    anees = average(nees, POSE)
    return {
        "rmse_position_m": float(np.hypot(*np.sqrt(square[:2]))),
        "rmse_yaw_rad": float(np.sqrt(square[2])),
        "anees": anees.value,
        "anees_standard_error": anees.standard_error,
        "anees_band_95": anees.band_95,
        "coverage_95": float(np.mean(nees < consistency.chi2_quantile(0.95, POSE))),
        "flagged_moments": int(np.sum(~np.isfinite(nees))),
        "nees_per_match": np.nanmean(nees, axis=0).tolist(),
    }


def _table(report: dict[str, Any]) -> str:
    """One row a filter, four columns a world."""
    columns = ("position RMSE", "yaw RMSE", "ANEES (3)", "95 % ellipsoid holds")
    head = ["filter", *(f"{name}: {column}" for name in report["worlds"] for column in columns)]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for rows in zip(*(world["filters"] for world in report["worlds"].values()), strict=True):
        cells = [rows[0]["filter"]]
        for row in rows:
            cells += [f"{row['rmse_position_m']:.3f} m", f"{1e3 * row['rmse_yaw_rad']:.1f} mrad"]
            cells += [readable(row["anees"]), f"{100 * row['coverage_95']:.1f} %"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    command_line(main)
