"""A grid over any two parameters, all cells in one compiled program: where is the filter consistent, where accurate?

Sweep Q by R (the default) to see which noise the filter may believe in, outlier_rate by gate_probability to see what
the gate buys.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.table import Table

from jaxlocmap import plotting, simulation
from jaxlocmap.cli.compute import ComputeConfig, finish, how_computed, start, study, study_checkpoint
from jaxlocmap.cli.console import CONSOLE, output_folder, saved, write_report
from jaxlocmap.cli.options import check_gate, params_or
from jaxlocmap.consistency import readable
from jaxlocmap.consistency.study import Study
from jaxlocmap.consistency.sweep import (
    SWEPT,
    SweepStudy,
    gate_verdict,
    judged_cell,
    shown,
    verdict,
    what_the_gate_buys,
)


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """Over a grid of any two parameters: where is the filter consistent, where accurate?"""

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


def main(config: SweepConfig) -> dict[str, Any]:
    """Run the sweep, write the report and the figure."""
    out = output_folder(config.out)
    x, y = _grid(config)
    check_gate(config.gate)
    scenario = simulation.scenario_of(config.scenario)
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
        cells.append({config.x: x[j], config.y: y[i], **judged_cell(totals, settings)})
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
