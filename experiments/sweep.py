"""A grid over any two parameters, all cells in one compiled program: where is the filter consistent, where accurate?

Sweep Q by R (the default) to see which noise the filter may believe in, outlier_rate by gate_probability to see what
the gate buys. Every cell sees the same random numbers, so that cells differ by their parameters alone.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from common import (
    CONSOLE,
    ComputeConfig,
    check_gate,
    command_line,
    finish,
    how_computed,
    output_folder,
    params_or,
    saved,
    scenario_of,
    start,
    study,
    study_checkpoint,
    write_report,
)
from rich.table import Table

from jaxlocmap import Config, Gaussian, Params, plotting, simulation
from jaxlocmap._internal.batching import sum_over_runs
from jaxlocmap.consistency import readable
from jaxlocmap.consistency.study import Study, Totals, summarise


class Cell(NamedTuple):
    """What a cell of the grid may change."""

    params: Params
    noise: simulation.Noise


class Swept(NamedTuple):
    """A parameter that can be swept."""

    meaning: str  # on an axis
    says: str  # in a sentence, with a value
    values: tuple[float, ...]  # by default
    wanted: str  # of a value
    allows: Callable[[float], bool]
    enter: Callable[[Cell, jax.Array], Cell]  # puts a value, (), into a cell


def _scale(what: str, symbol: str, factors: np.ndarray, field: str, entry: int | None = None) -> Swept:
    """A scale of a covariance the filter believes in, or of the standard deviation of one of its two entries."""

    def enter(cell: Cell, value: jax.Array) -> Cell:
        covariance = getattr(cell.params, field)
        if entry is None:
            scaled = value * covariance
        else:
            factor = jnp.ones(2, covariance.dtype).at[entry].set(value)
            scaled = factor[:, None] * covariance * factor[None, :]
        return cell._replace(params=cell.params._replace(**{field: scaled}))

    allows = lambda value: 1e-6 <= value <= 1e6  # noqa: E731
    meaning = f"scale of {symbol}, the filter's {what} [–]"
    return Swept(meaning, symbol + " × {}", tuple(factors.tolist()), "a scale in [1e-6, 1e6]", allows, enter)


_SCALES = np.geomspace(1 / 8, 8, 9)
_FIGURES = (
    *("anees", "anees_standard_error", "anees_band_95", "nis_mean", "nis_standard_error", "nis_band_95"),
    *("gate_accept_rate", "rmse_position_m", "rmse_yaw_rad", "diverged_runs", "flagged_steps", "verdict"),
)  # of a study's report, kept of a cell

SWEPT = {
    "Q": _scale("covariance of speed and yaw rate", "Q", _SCALES, "Q"),
    "R": _scale("covariance of range and bearing", "R", _SCALES, "R"),
    "sigma_v": _scale("standard deviation of the speed", "σ_v", _SCALES**0.5, "Q", 0),
    "sigma_w": _scale("standard deviation of the yaw rate", "σ_ω", _SCALES**0.5, "Q", 1),
    "sigma_range": _scale("standard deviation of the range", "σ_range", _SCALES**0.5, "R", 0),
    "sigma_bearing": _scale("standard deviation of the bearing", "σ_bearing", _SCALES**0.5, "R", 1),
    "gate_probability": Swept(
        "gate: share of good observations it should let in [–], 1 is no gate",
        "gate {}",
        (0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 0.9999, 0.99999, 1.0),
        "a probability in (0, 1]",
        lambda value: 0 < value <= 1,
        lambda cell, value: cell._replace(params=cell.params._replace(gate_probability=value)),
    ),
    "outlier_rate": Swept(
        "share of observations that are false [–]",
        "outlier rate {}",
        (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5),
        "a share in [0, 1]",
        lambda value: 0 <= value <= 1,
        lambda cell, value: cell._replace(noise=cell.noise._replace(outlier_rate=value)),
    ),
}


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """Settings of the sweep."""

    x: str = "Q"
    """Across: Q, R, sigma_v, sigma_w, sigma_range, sigma_bearing (all scales), gate_probability or outlier_rate."""
    y: str = "R"
    """Upwards: one of the same."""
    x_values: tuple[float, ...] | None = None
    """Values across; by default nine, scales from 1/8 to 8 or the square root of that."""
    y_values: tuple[float, ...] | None = None
    """Values upwards."""
    scenario: Literal["capstone", "loop"] = "loop"
    """The drive: the course's, or two laps through free space."""
    motion: Literal["arc", "euler", "capstone"] = "euler"
    """The filter's motion model; euler is the simulated robot's own."""
    runs: int = 300
    """How many simulated runs, the same for all cells."""
    params: Path | None = None
    """JSON file of Q, R, l_occ, l_free, which stands at scale 1; the simulated robot's own noise by default."""
    gate: float | None = None
    """Probability with which a good observation passes the gate, where that is not swept; None for no gate."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/sweep")
    """Folder for report.json and sweep.png."""
    quick: bool = False
    """A run of a few seconds: every second of the default values, 50 runs."""
    compute: Annotated[ComputeConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=ComputeConfig)


@dataclasses.dataclass(frozen=True)
class SweepStudy:
    """One run of every cell of a grid. Hashable, so `monte_carlo` compiles it once, for any values of the grid."""

    study: Study
    x: str  # names in SWEPT
    y: str

    def __call__(
        self,
        key: jax.Array,
        x: jax.Array,
        y: jax.Array,
        params: Params,
        world: simulation.World,
        noise: simulation.Noise,
        prior: Gaussian,
        **how: Any,
    ) -> Totals:
        """Totals (rows, columns, ...) of the run that `key` stands for: common random numbers, the same for all cells.

        Args:
            x: (columns,). y: (rows,). The rest: as for `Study`, what the cells have in common.
        """

        def cell(x: jax.Array, y: jax.Array) -> Totals:
            here = SWEPT[self.y].enter(SWEPT[self.x].enter(Cell(params, noise), x), y)
            return self.study(key, here.params, world, here.noise, prior, **how)

        # The random numbers do not depend on the cell, so they are drawn once for all of them.
        row = jax.vmap(cell, in_axes=(0, None))
        return jax.vmap(row, in_axes=(None, 0))(x, y)

    def summed(self, key: jax.Array, counted: jax.Array, *args: Any) -> Totals:
        """As `Study.summed`."""
        return self(key, *args, add_up=functools.partial(sum_over_runs, counted=counted))


def main(config: SweepConfig) -> dict[str, Any]:
    """Run the sweep, write the report and the figure."""
    out = output_folder(config.out)
    x, y = _grid(config)
    check_gate(config.gate)
    scenario = scenario_of(config.scenario)
    if config.runs < 2:
        raise ValueError(f"runs: expected at least 2, which a band needs, got {config.runs}")
    runs = min(config.runs, 50) if config.quick else config.runs
    start(config.compute)
    detector = dataclasses.replace(scenario.detector, outliers="outlier_rate" in (config.x, config.y))
    scenario = dataclasses.replace(scenario, detector=detector)
    settings = scenario.config(motion=config.motion, gate_probability=config.gate, grid=False)
    noise = simulation.Noise()
    params = params_or(config.params, simulation.own_params(noise, scenario))
    named = {name: getattr(config, name) for name in ("x", "y", "scenario", "motion", "gate", "seed")}
    checkpoint = study_checkpoint(out, config.compute, named)
    CONSOLE.print(f"{len(x)} x {len(y)} cells, {runs} runs of {scenario.name} in each, {scenario.steps} steps")

    began = time.perf_counter()
    sweep = SweepStudy(Study(scenario, settings), config.x, config.y)
    arguments = (jnp.array(x), jnp.array(y), params, simulation.room(), noise, scenario.prior())
    result = study(sweep, jax.random.key(config.seed), runs, *arguments, config=config.compute, checkpoint=checkpoint)
    cells = []
    for i, j in np.ndindex(len(y), len(x)):
        totals = jax.tree.map(lambda total, at=(i, j): total[at], result.value)
        cells.append({config.x: x[j], config.y: y[i], **_judged(totals, settings)})
    report = {
        "x": config.x,
        "y": config.y,
        "x_values": x,
        "y_values": y,
        "scenario": scenario.name,
        "steps": scenario.steps,
        "runs": runs,
        "motion": config.motion,
        "params": params.numbers(),
        "gate_probability": config.gate,
        "verdict": verdict(config.x, config.y, cells),
        "consistent_cells": sum(cell["consistent"] for cell in cells),
        "cells": cells,
        "seed": config.seed,
        **how_computed(result, runs, began, per_run=len(cells)),
    }
    if "gate_probability" in (config.x, config.y):
        other = config.y if config.x == "gate_probability" else config.x
        report["what_the_gate_buys"] = what_the_gate_buys(other, cells)
        report["gate_verdict"] = gate_verdict(other, report["what_the_gate_buys"], runs)
    if jax.process_index() == 0:
        write_report(out, report)
        labels, ticks = (SWEPT[config.x].meaning, SWEPT[config.y].meaning), (list(map(shown, x)), list(map(shown, y)))
        plotting.sweep_figure(out / "sweep.png", report, labels, ticks)
        _print(report)
        saved(out, "report.json", "sweep.png")
    finish(checkpoint)
    return report


def _grid(config: SweepConfig) -> tuple[list[float], list[float]]:
    """Values of the columns and of the rows.

    Raises:
        ValueError: an unknown parameter, the same twice, no value or an impossible one, or a gate both given and swept.
    """
    if config.x == config.y:
        raise ValueError(f"x, y: expected two different parameters, got {config.x} twice")
    grid = []
    if "gate_probability" in (config.x, config.y) and config.gate is not None:
        raise ValueError(f"gate: swept as gate_probability: expected it not to be given, got {config.gate}")
    for axis, name, values in (("x", config.x, config.x_values), ("y", config.y, config.y_values)):
        if name not in SWEPT:
            raise ValueError(f"{axis}: expected one of {', '.join(SWEPT)}, got {name!r}")
        swept = SWEPT[name]
        if values is None:
            values = swept.values[::2] if config.quick else swept.values
        if not values:
            raise ValueError(f"{axis}_values: expected at least one value of {name}, got none")
        for value in values:
            if not swept.allows(value):
                raise ValueError(f"{axis}_values: expected {swept.wanted} for {name}, got {value:g}")
        grid.append([float(value) for value in values])
    return grid[0], grid[1]


def _judged(totals: Totals, settings: Config) -> dict[str, Any]:
    """The figures of one cell. `misfit` is how far, as a factor's logarithm, ANEES and NIS together are off."""
    report = summarise(totals, settings)
    low, high = report["anees_band_95"]
    off = [
        abs(math.log(report[name] / expected)) if report[name] > 0 else math.inf
        for name, expected in (("anees", 3), ("nis_mean", 2))
    ]
    return {name: report[name] for name in _FIGURES} | {
        "misfit": sum(off),
        "consistent": low <= report["anees"] <= high and not report["diverged_runs"],
    }


def verdict(x: str, y: str, cells: list[dict[str, Any]]) -> str:
    """How many cells are consistent, and which one fits best. Many combinations of Q and R have an ANEES of 3; the
    NIS tells them apart.
    """
    count = sum(cell["consistent"] for cell in cells)
    best = min(cells, key=lambda cell: (not cell["consistent"], cell["misfit"]))
    where = ", ".join(SWEPT[name].says.format(shown(best[name])) for name in (x, y))
    return (
        f"{count or 'none'} of {len(cells)} cells {'is' if count < 2 else 'are'} consistent; ANEES and NIS together "
        f"fit best at {where}: ANEES {readable(best['anees'], 4)}, NIS {readable(best['nis_mean'], 4)}"
    )


def what_the_gate_buys(other: str, cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each value of the other parameter: the cell of the smallest position RMSE, and that without a gate."""
    rows = []
    for value in dict.fromkeys(cell[other] for cell in cells):
        here = [cell for cell in cells if cell[other] == value]
        without = next((cell for cell in here if cell["gate_probability"] == 1), None)
        rows.append({"value": value, "best": min(here, key=_rmse), "without": without})
    return rows


def _rmse(cell: dict[str, Any]) -> float:
    return cell["rmse_position_m"] if math.isfinite(cell["rmse_position_m"]) else math.inf


def gate_verdict(other: str, rows: list[dict[str, Any]], runs: int) -> str:
    """Where the gate buys most accuracy, in words."""
    compared = [row for row in rows if row["without"] is not None]
    if not compared:
        return "no gate, which is gate 1, was not swept: nothing to compare with"
    row = max(compared, key=lambda row: _rmse(row["without"]) / _rmse(row["best"]))
    best, without = row["best"], row["without"]
    if best is without:
        return "the gate buys no accuracy here: without one, the position RMSE is smallest everywhere"
    gain = (
        f"position RMSE {_rmse(best):.3g} m with gate {shown(best['gate_probability'])}, {_rmse(without):.3g} m without"
    )
    lost = f"{best['diverged_runs']} of {runs} runs diverged, {without['diverged_runs']} without"
    return f"the gate buys most at {SWEPT[other].says.format(shown(row['value']))}: {gain}; {lost}"


def shown(value: float) -> str:
    """A swept value for people: three digits, more just below one, where a gate needs them."""
    return f"{value:.7g}" if 0.99 < value < 1 else f"{value:.3g}"


def _print(report: dict[str, Any]) -> None:
    x, y = report["x"], report["y"]
    if len(report["x_values"]) <= 9:
        title = "ANEES: 3 expected, * is consistent"
        table = Table(f"{y} by {x}", *map(shown, report["x_values"]), title=title, title_justify="left")
        cells = iter(report["cells"])
        for value in report["y_values"]:
            row = [next(cells) for _ in report["x_values"]]
            table.add_row(shown(value), *(readable(cell["anees"]) + "*" * cell["consistent"] for cell in row))
        CONSOLE.print(table)
    if "what_the_gate_buys" in report:
        _print_gate(y if x == "gate_probability" else x, report["what_the_gate_buys"])
        CONSOLE.print(report["gate_verdict"], style="bold")
    CONSOLE.print(report["verdict"], style="bold")
    speed = f"{report['runs_per_s']:.0f} runs/s, every cell's counted, after {report['compile_s']:.1f} s of compilation"
    CONSOLE.print(speed)


def _print_gate(other: str, rows: list[dict[str, Any]]) -> None:
    headers = ("best gate", "position RMSE", "ANEES", "diverged", "no gate: RMSE", "ANEES", "diverged")
    table = Table(other, *headers, title="What the gate buys", title_justify="left")
    for row in rows:
        gate = shown(row["best"]["gate_probability"])
        table.add_row(shown(row["value"]), gate, *_figures(row["best"]), *_figures(row["without"]))
    CONSOLE.print(table)


def _figures(cell: dict[str, Any] | None) -> tuple[str, str, str]:
    if cell is None:
        return "–", "–", "–"
    return f"{cell['rmse_position_m']:.4f} m", readable(cell["anees"]), str(cell["diverged_runs"])


if __name__ == "__main__":
    command_line(main, SweepConfig)
