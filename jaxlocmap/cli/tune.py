"""Tune the noise a filter believes in, or the inverse sensor model of its map, from simulated drives or a real log:
params.json, the evidence on what was held out, and how sure it all is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from jaxlocmap import Params, plotting, tuning
from jaxlocmap.cli.console import CONSOLE, output_folder, saved, write_report
from jaxlocmap.cli.tune_matching import from_drawn_worlds
from jaxlocmap.cli.tune_options import TuneConfig, checked, loss_weights, tuned_parameters
from jaxlocmap.cli.tune_sources import Source, Wanted, from_robots, from_scans, from_scenario
from jaxlocmap.consistency import readable
from jaxlocmap.monte_carlo import hosts

_STEPS = {"lbfgs": 2, "adam": 20}  # an epoch
_LOSS_WORDS = {
    "innovation_nll": "negative log-likelihood of an innovation, nats",
    "pose_nll": "negative log density of the true pose, nats",
    "mse": "squared error of the pose, m²",
    "nees": "distance of the NEES from χ(3)",
    "nis": "distance of the NIS from χ(2)",
    "map": "log-loss of the next scan's cells, nats",
}


def main(config: TuneConfig) -> dict[str, Any]:
    """Tune, judge before and after, write the parameters, the report and the figures.

    Raises:
        KeyboardInterrupt: it was stopped; says what is kept, if anything.
    """
    config = checked(config)
    out = output_folder(config.out)
    kept: list[str] = []
    try:
        return hosts.waiting(lambda: _tune(config, out, kept))  # so that Ctrl-C is heard while JAX compiles
    except KeyboardInterrupt:
        raise KeyboardInterrupt(*kept[-1:]) from None


def _tune(config: TuneConfig, out: Path, kept: list[str]) -> dict[str, Any]:
    """As `main`; says in `kept` what is on disk."""
    began = time.perf_counter()
    weights = loss_weights(config)
    losses = tuple(name for name, _ in weights)
    hosts.use_all_cores()
    jax.config.update("jax_disable_most_optimizations", config.quick)  # a quick run does little but compile
    with jax.enable_x64(True):
        source = _source(config, losses)
        objective = tuning.Objective(source.config, weights)
        tuned = tuned_parameters(config)
        CONSOLE.print(f"tuning {', '.join(tuned)} on {source.name}; compiling takes some seconds")
        found = _fit(config, objective, source, tuned, out, kept)
        descent = {"source": source.name, "losses": dict(weights), **_descent(config, losses, found)}
        write_report(out, descent)
        kept.append(f"{kept[-1]}, and the descent in {out / 'report.json'}")
        CONSOLE.print("judging what was held out, before and after; standard errors")
        sure = tuning.standard_errors(objective, found.params, source.compared, tuned)
        report = {
            **descent,
            "parameters": _parameters(objective, source.start, found.params, sure),
            "correlation": dict(names=list(sure.names), matrix=sure.correlation.tolist()),
            "not_identified": list(sure.words),
            "loss": _losses(objective, source, found.params),
        }
        before, after = source.evidence(source.start), source.evidence(found.params)
    files = _figures(out, source, report, before, after)
    report["held_out"] = {"before": _for_report(before), "after": _for_report(after)}
    report |= {"seed": config.seed, "wall_s": time.perf_counter() - began}
    found.params.save(out / "params.json")
    write_report(out, report)
    _print(report)
    saved(out, "params.json", "report.json", *files)
    return report


def _source(config: Any, losses: tuple[str, ...]) -> Source:
    """Of a config with its defaults filled in, whose fields the type checker takes for None."""
    start = None if config.params is None else Params.load(config.params)
    wanted = Wanted(losses, start, config.gate, config.judge_gate, config.seed, config.quick, config.max_gap)
    if config.match:
        return from_drawn_worlds(config.motion, config.runs, config.judge_runs, wanted)
    if config.log is None:
        return from_scenario(config.scenario, config.motion, config.runs, config.judge_runs, wanted)
    if config.format == "carmen":
        return from_scans(config.log, config.resolution, config.max_range, wanted)
    kind, robots = str(config.format), config.robots
    return from_robots(config.log, kind, robots, config.judged, config.motion, config.max_range, wanted)


def _fit(
    config: Any, objective: tuning.Objective, source: Source, tuned: tuple[str, ...], out: Path, kept: list[str]
) -> tuning.Fit:
    with _bar(config.epochs, objective, tuned, out, kept) as progress:
        return tuning.fit(
            objective,
            source.start,
            source.train,
            tuned=tuned,
            optimiser=optax.adam(0.05) if config.optimiser == "adam" else None,
            epochs=config.epochs,
            steps=_STEPS[config.optimiser],
            minibatch=config.minibatch,
            key=jax.random.key(config.seed),
            validation=source.validation,
            progress=progress,
        )


@contextmanager
def _bar(
    epochs: int, objective: tuning.Objective, tuned: tuple[str, ...], out: Path, kept: list[str]
) -> Iterator[Callable[[tuning.Fit], None]]:
    """A bar with the loss and the parameters; the best so far is on disk after every epoch."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=CONSOLE, transient=True) as bar:
        task = bar.add_task("tuning", total=epochs)

        def move(fit: tuning.Fit) -> None:
            fit.params.save(out / "params.json")
            done = len(fit.losses) - 1
            kept.append(f"the best of {done} epochs is kept in {out / 'params.json'}, from which --params goes on")
            best = tuning.natural(fit.params, objective.blocks)
            values = ", ".join(f"{name} {float(best[name]):.4g}" for name in tuned)
            bar.update(task, completed=done, description=f"loss {fit.loss:.5g}: {values}")

        yield move


def _parameters(
    objective: tuning.Objective, start: Params, end: Params, sure: tuning.StandardErrors
) -> dict[str, dict[str, Any]]:
    before, after = (tuning.natural(params, objective.blocks) for params in (start, end))
    units = tuning.units_of(objective.blocks)
    return {
        name: {
            "start": float(before[name]),
            "end": float(after[name]),
            "standard_error": float(error),
            "interval_95": interval.tolist(),
            "unit": units[name],
        }
        for name, error, interval in zip(sure.names, sure.standard_error, sure.interval_95, strict=True)
    }


def _losses(objective: tuning.Objective, source: Source, end: Params) -> dict[str, dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {name: {} for name in objective.names}
    for when, params in (("before", source.start), ("after", end)):
        for which, batch in (("train", source.train), ("validation", source.validation)):
            terms = {} if batch is None else objective.judged(params, batch)[1]
            for name in rows:
                rows[name][f"{which}_{when}"] = terms.get(name)
    return rows


def _descent(config: TuneConfig, losses: tuple[str, ...], found: tuning.Fit) -> dict[str, Any]:
    trace = found.trace
    return {
        "loss_words": "; ".join(_LOSS_WORDS[name] for name in losses),
        "evaluations": int(trace.evaluations.sum()),
        "skipped_steps": int(trace.skipped.sum()),
        "stopped_early": found.stopped_early,
        "best_epoch": found.best_epoch,
        "steps_per_epoch": _STEPS[config.optimiser],
        "compile_s": found.compile_s,
        "run_s": found.run_s,
        "trace": {
            "loss": trace.loss,
            "gradient_norm": trace.gradient_norm,
            "validation": found.losses,
            "parameters": trace.params,
        },
    }


def _figures(out: Path, source: Source, report: dict[str, Any], before: Any, after: Any) -> list[str]:
    plotting.descent_figure(out / "descent.png", report | {"validated": source.validation is not None})
    files = ["descent.png"]
    if "one_scan_ahead" in after:
        plotting.calibration_figure(
            out / "calibration.png", before["one_scan_ahead"], after["one_scan_ahead"], source.name
        )
        files.append("calibration.png")
    studies = {"nees.png": (before, after)} if "nees_per_step" in after else {}
    worlds = [name for name, x in after.items() if isinstance(x, dict) and "nees_band_95" in x]
    studies |= {f"nees_{name}.png": (before[name], after[name]) for name in worlds}
    for file, pair in studies.items():
        plotting.study_before_after_figure(out / file, *pair, source.dt)
        files.append(file)
    drives = {
        name: {
            "time": after[name]["time"],
            "before": before[name],
            "after": after[name],
            "nees_before": before[name]["nees_per_step"],
            "nees_after": after[name]["nees_per_step"],
        }
        for name in after
        if isinstance(after[name], dict) and after[name].get("anees") is not None and name not in worlds
    }
    if drives:
        plotting.log_before_after_figure(out / "nees.png", drives)
        files.append("nees.png")
    return files


def _for_report(evidence: dict[str, Any]) -> dict[str, Any]:
    """Without the long arrays of a log."""
    return {
        name: {key: item for key, item in value.items() if key != "time" and "_per_step" not in key}
        if isinstance(value, dict)
        else value
        for name, value in evidence.items()
    }


_SHOWN = (
    ("anees", "ANEES (3)"),
    ("nees_median", "median NEES (2.37)"),
    ("nis_mean", "NIS (2)"),
    ("coverage_95", "95 % ellipsoid holds"),
    ("gate_accept_rate", "gate lets in"),
    ("rmse_position_m", "position RMSE, m"),
    ("rmse_yaw_rad", "yaw RMSE, rad"),
    ("log_loss", "log-loss, nats"),
    ("brier", "Brier score"),
    ("calibration_error", "calibration error"),
)


_GROUPS = {"map": "final map against the walls", "one_scan_ahead": "map, one scan ahead"}


def _print(report: dict[str, Any]) -> None:
    columns = ("parameter", "start", "end", "standard error", "95 % interval")
    table = Table(*columns, title=report["source"], title_justify="left")
    for name, value in report["parameters"].items():
        low, high = value["interval_95"]
        numbers = (f"{value['start']:.4g}", f"{value['end']:.4g}", f"{value['standard_error']:.2g}")
        table.add_row(f"{name}, {value['unit']}", *numbers, f"[{low:.4g}, {high:.4g}]")
    CONSOLE.print(table)
    table = Table("held out", "quantity", "before", "after")
    before, after = report["held_out"]["before"], report["held_out"]["after"]
    groups = {"fresh runs": (before, after)} if "anees" in after else {}
    groups |= {name: (before[name], after[name]) for name, x in after.items() if isinstance(x, dict)}
    for group, (old, new) in groups.items():
        for key, words in _SHOWN:
            values = old.get(key), new.get(key)
            if None not in values and not np.isnan(values).all():  # of what was not observed there is none
                table.add_row(_GROUPS.get(group, group), words, *(readable(value, 4) for value in values))
    CONSOLE.print(table)
    for name, rows in report["loss"].items():
        pairs = [
            f"{which}: {rows[f'{which}_before']:.4f} → {rows[f'{which}_after']:.4f}"
            for which in ("train", "validation")
            if rows[f"{which}_before"] is not None
        ]
        CONSOLE.print(f"loss {name}, {_LOSS_WORDS[name]}: {'; '.join(pairs)}")
    for sentence in report["not_identified"]:
        CONSOLE.print(f"careful: {sentence}")
    CONSOLE.print(
        f"{report['evaluations']} evaluations in {report['run_s']:.1f} s after {report['compile_s']:.1f} s of "
        f"compilation; {report['skipped_steps']} steps skipped as not finite",
    )
