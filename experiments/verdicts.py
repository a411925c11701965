"""How often is an honest filter called dishonest, and do the intervals of a study hold the truth as often as they say?

Many studies of a filter that is told the robot's own noise, by scenario, start and gate; and its single runs.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

from jaxlocmap import Gaussian, Params, consistency, init, run, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.consistency.scoring import Totals
from jaxlocmap.consistency.study import pose_means, reference_study, summarise
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.monte_carlo.hosts import check_count, merge_kernels, use_all_cores
from jaxlocmap.se2 import POSE

SCALES = (0.5, 0.8, 1.25, 2.0)  # of the covariance
_REFERENCE_RUNS = 2000
_LONG = dataclasses.replace(simulation.LOOP, name="long loop", steps=10_000)


@dataclasses.dataclass(frozen=True)
class VerdictsConfig:
    """How many studies of what size."""

    studies: int = 200
    """Studies of each scenario, start and gate."""
    runs: int = 300
    """Runs of each study."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/verdicts")
    """Folder for report.json."""
    quick: bool = False
    """Four studies of 30 runs."""


def main(config: VerdictsConfig) -> dict[str, Any]:
    """Run the studies, count, write the report and print the tables."""
    out = output_folder(config.out)
    for name in ("studies", "runs"):
        check_count(name, getattr(config, name), 2)
    count, runs = (4, 30) if config.quick else (config.studies, config.runs)
    merge_kernels()
    use_all_cores()
    key = jax.random.key(config.seed)
    rows = []
    for i, (scenario, exact, gate) in enumerate(
        itertools.product((simulation.LOOP, simulation.CAPSTONE), (False, True), (None, 0.99))
    ):
        where = dataclasses.replace(scenario, exact_prior=exact)
        rows.append(_studies(jax.random.fold_in(key, i), where, gate, count, runs))
    singles = [
        _single_runs(jax.random.fold_in(key, 100 + i), scenario, count)
        for i, scenario in enumerate(
            (_LONG, simulation.LOOP, dataclasses.replace(simulation.CAPSTONE, exact_prior=False))
        )
    ]
    report = {"studies": count, "runs": runs, "settings": rows, "single_runs": singles, "seed": config.seed}
    write_report(out, report)
    _print(report)
    saved(out, "report.json")
    return report


def _studies(
    key: jax.Array, scenario: simulation.Scenario, gate: float | None, count: int, runs: int
) -> dict[str, Any]:
    """Studies of one setting, judged with and without a reference of the same setting."""
    noise, world, prior = simulation.Noise(), simulation.room(), scenario.prior()
    settings = scenario.config(motion="euler", gate_probability=gate, grid=False)
    study, params = reference_study(scenario, settings, noise)
    args = params, world, noise, prior
    found: list[Totals] = []
    name = f"{scenario.name}, {'exact' if scenario.exact_prior else 'drawn'}" + (", gate" if gate else "")
    with progress_bar(name, count) as progress:
        for n in range(count):
            found.append(monte_carlo(study, jax.random.fold_in(key, n), runs, *args).value)
            progress(n + 1)
    references: list[Totals] = []
    disturbed = scenario.exact_prior or gate is not None
    if disturbed:  # each study beside a reference of its own, as `jaxlocmap study` has it
        with progress_bar("references", count) as progress:
            for n in range(count):
                drawn = jax.random.fold_in(key, count + n)
                references.append(monte_carlo(study, drawn, _REFERENCE_RUNS, *args).value)
                progress(n + 1)
    alone = [summarise(totals, settings)["verdict"] for totals in found]
    beside = [summarise(*pair)["verdict"] for pair in zip(found, itertools.repeat(settings), references)]
    return {
        "setting": name,
        "anees": float(np.mean([totals.average.nees / totals.scored_runs for totals in found])),
        "dishonest": _share(alone, _dishonest),
        "dishonest_unexplained": _share(alone, lambda words: _dishonest(words) and not _explained(words)),
        "dishonest_beside_reference": _share(beside, _dishonest) if beside else None,
        "unexplained_beside_reference": _share(beside, lambda words: _dishonest(words) and not _explained(words))
        if beside
        else None,
        "factor": None if gate is not None else _factor_intervals(found, references, settings),
        "intervals": _intervals(found, settings),
    }


def _share(words: list[str], which: Callable[[str], bool]) -> float:
    return sum(map(which, words)) / len(words)


def _dishonest(words: str) -> bool:
    return words.startswith(("over-", "under-", "not consistent"))


def _explained(words: str) -> bool:
    return "gate" in words or "exact start" in words


def _factor_intervals(found: list[Totals], references: list[Totals], settings: Any) -> dict[str, float]:
    """How often the interval of the factor holds the truth, by what the covariance is scaled by.

    Without a gate a covariance that is wrong by a factor leaves the gain, and so the errors, as they are.
    """
    held = {}
    for scale in SCALES:
        inside = 0
        for n, totals in enumerate(found):
            nees = pose_means(_scaled(totals, scale), settings).nees
            if references:
                relative = consistency.ratio(nees, pose_means(references[n], settings).nees)
                low, high = relative.interval_95
            else:
                low, high = (limit / POSE for limit in nees.interval_95)
            inside += low <= 1 / scale <= high
        held[f"{scale:g}"] = inside / len(found)
    return held


def _scaled(totals: Totals, scale: float) -> Totals:
    """The totals of the same filter with a covariance `scale` times as large, as far as its NEES goes."""
    average = totals.average._replace(nees=totals.average.nees / scale)
    square = totals.average_square._replace(nees=totals.average_square.nees / scale**2)
    return totals._replace(average=average, average_square=square)


def _intervals(found: list[Totals], settings: Any) -> dict[str, float]:
    """How often the 95 % intervals of shares, axes and correlations hold what all studies together say."""
    reports = [summarise(totals, settings) for totals in found]
    names = [f"coverage_{round(100 * level)}" for level in consistency.COVERAGE_LEVELS]
    rows = {name: [(r[name], *r[f"{name}_interval_95"]) for r in reports] for name in names}
    for field in ("axis_nees", "within_two_sigma"):
        for axis in consistency.AXES:
            rows[f"{field} {axis}"] = [(r[field][axis], *r[f"{field}_interval_95"][axis]) for r in reports]
    for part in ("range", "bearing"):
        measured = [(r["innovation_lag_one"][part], r["innovation_lag_one_band_95"][part]) for r in reports]
        rows[f"lag one {part}"] = [(value, value - reach, value + reach) for value, reach in measured]
    return {name: _held(np.array(values)) for name, values in rows.items()}


def _held(values: np.ndarray) -> float:
    truth = values[:, 0].mean()
    return float(np.mean((values[:, 1] <= truth) & (truth <= values[:, 2])))


@dataclasses.dataclass(frozen=True)
class Single:
    """One run, kept: truth and beliefs. Hashable, so that it compiles once."""

    scenario: simulation.Scenario

    def __call__(self, key: jax.Array, params: Params, world: Any, noise: Any, prior: Gaussian) -> Any:
        """The true poses (T, 3) and the beliefs of the run that `key` stands for."""
        config = self.scenario.config(motion="euler", gate_probability=None, grid=False)
        start_key, key = jax.random.split(key)
        start = simulation.draw_start(start_key, prior, scenario=self.scenario)
        truth, inputs = simulation.simulate(key, world, noise, start, scenario=self.scenario, scan=False)
        state = init(prior, config=config)
        beliefs = run(params, state, inputs, landmarks=world.landmarks, config=config, collect=_belief)[1]
        return truth.pose, beliefs


def _belief(state: Any, info: Any, aside: Any) -> Gaussian:
    del state, aside
    return info.belief


def _single_runs(key: jax.Array, scenario: simulation.Scenario, count: int) -> dict[str, Any]:
    """Single runs of an honest filter, each judged alone."""
    noise = simulation.Noise()
    args = simulation.own_params(noise, scenario), simulation.room(), noise, scenario.prior()
    held, verdicts, samples, mean = 0, [], [], []
    with progress_bar(f"single runs of {scenario.name}", count) as progress:
        for n in range(count):
            truth, belief = (
                jax.tree.map(lambda x: x[0], tree)
                for tree in monte_carlo(Single(scenario), jax.random.fold_in(key, n), 1, *args, keep_runs=True).value
            )
            report = consistency.judge(truth, belief.mean, belief.cov)
            low, high = report["anees_band_95"]
            held += low <= report["anees"] <= high
            verdicts.append(report["verdict"])
            samples.append(report["independent_samples"])
            mean.append(report["anees"])
            progress(n + 1)
    return {
        "scenario": scenario.name,
        "steps": scenario.steps,
        "independent_samples": float(np.median(samples)),
        "anees": float(np.mean(mean)),
        "band_holds": held / count,
        "dishonest": _share(verdicts, _dishonest),
        "undecided": _share(verdicts, lambda words: words.startswith("undecided")),
    }


def _print(report: dict[str, Any]) -> None:
    def percent(value: float | None) -> str:
        return "–" if value is None else f"{100 * value:.1f} %"

    table = Table("start, gate", "ANEES", "dishonest", "unexplained", "beside a reference", "unexplained")
    for row in report["settings"]:
        shares = [
            row[name]
            for name in (
                "dishonest",
                "dishonest_unexplained",
                "dishonest_beside_reference",
                "unexplained_beside_reference",
            )
        ]
        table.add_row(row["setting"], f"{row['anees']:.3f}", *map(percent, shares))
    CONSOLE.print(table)
    table = Table("factor held, P times", *(f"{scale:g}" for scale in SCALES), "intervals hold, least", "most")
    for row in report["settings"]:
        factors = [percent((row["factor"] or {}).get(f"{scale:g}")) for scale in SCALES]
        least, most = (f(row["intervals"], key=row["intervals"].get) for f in (min, max))
        ends = [f"{percent(row['intervals'][name])} ({name})" for name in (least, most)]
        table.add_row(row["setting"], *factors, *ends)
    CONSOLE.print(table)
    table = Table("one run of", "steps", "independent samples", "band holds", "called dishonest", "undecided")
    for row in report["single_runs"]:
        shares = [percent(row[name]) for name in ("band_holds", "dishonest", "undecided")]
        table.add_row(row["scenario"], f"{row['steps']:,}", f"{row['independent_samples']:.0f}", *shares)
    CONSOLE.print(table)


if __name__ == "__main__":
    command_line(main)
