"""Real robots, tuned on one part of a log and judged on another, by loss: a table of experiments/README.md.

Innovations alone do not cure errors that are correlated in time; the truth does. On mrclam every choice of three of the
five robots is tuned on and the other two are judged.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from evidence import replace_table

from jaxlocmap import tuning
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.cli.tune_sources import JUDGE_GATE, TUNING_GATE, Source, Wanted, from_robots, from_scans
from jaxlocmap.consistency import readable
from jaxlocmap.monte_carlo import hosts

_ROBOTS = (1, 2, 3, 4, 5)
# What `nees` is tuned by, which tells no more than two: on the first half its loss falls from 28 to 0.06 by these, to
# 16 or more by v and w or mixed pairs.
_TWO = ("range", "bearing")


@dataclasses.dataclass(frozen=True)
class RobotsConfig:
    """Where the logs are, and how much of them to use."""

    data: Path
    """Folder with lost_in_the_woods/, mrclam/ and carmen/."""
    splits: int = 10
    """How many of the ten ways to split the robots of mrclam."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/tune_robots")
    """Folder for report.json."""
    quick: bool = False
    """Short pieces of woods and intel, few steps."""


def main(config: RobotsConfig) -> dict[str, Any]:
    """Tune on every log, judge, print the table and write the report."""
    out = output_folder(config.out)
    hosts.check_count("splits", config.splits, most=10)
    hosts.use_all_cores()
    jax.config.update("jax_disable_most_optimizations", config.quick)  # a quick run does little but compile
    jobs = list(_jobs(config))
    rows = []
    with jax.enable_x64(True), progress_bar("logs", len(jobs)) as progress:
        for i, (what, loss, source) in enumerate(jobs):
            rows.append(_tuned(what, loss, source(), config.quick))
            write_report(out, {"rows": rows})  # what is there is not lost
            progress(i + 1)
    rows += list(_summaries(rows))
    table = _table([row for row in rows if not row["one_of_many"]])
    if config.write:
        replace_table("robots", table)
    CONSOLE.print(f"\n{table}", soft_wrap=True)
    report = {"rows": rows}
    write_report(out, report)
    saved(out, "report.json")
    return report


def _jobs(config: RobotsConfig) -> Iterator[tuple[str, str, Any]]:
    def wanted(loss: str) -> Wanted:
        return Wanted((loss,), None, TUNING_GATE, JUDGE_GATE, config.seed, config.quick)

    woods, mrclam = config.data / "lost_in_the_woods" / "dataset2.mat", config.data / "mrclam" / "MRCLAM_Dataset6"
    for loss in ("pose_nll",) if config.quick else ("innovation_nll", "mse", "nees", "pose_nll"):
        yield "woods", loss, lambda loss=loss: from_robots(woods, "woods", (), (), "euler", 5.0, wanted(loss))
    splits = list(itertools.combinations(_ROBOTS, 3))[: config.splits]
    for loss in () if config.quick else ("innovation_nll", "pose_nll"):
        for tuned in splits:
            judged = tuple(robot for robot in _ROBOTS if robot not in tuned)
            name = f"mrclam {', '.join(map(str, judged))}"
            yield (
                name,
                loss,
                lambda t=tuned, j=judged, loss=loss: from_robots(mrclam, "mrclam", t, j, "arc", None, wanted(loss)),
            )
    intel = config.data / "carmen" / "intel-corrected.log.gz"
    yield "intel", "map", lambda: from_scans(intel, 0.2 if config.quick else 0.1, 20.0, wanted("map"))


def _tuned(what: str, loss: str, source: Source, quick: bool) -> dict[str, Any]:
    began = time.perf_counter()
    tuned = {"map": tuning.SENSOR_MODEL, "nees": _TWO}.get(loss, tuning.NOISE)
    fit = tuning.fit(
        tuning.Objective(source.config, ((loss, 1.0),)),
        source.start,
        source.train,
        tuned=tuned,
        validation=source.validation,
        epochs=1 if quick else 20,
    )
    before, after = source.evidence(source.start), source.evidence(fit.params)
    natural = tuning.natural(fit.params)
    return {
        "log": what,
        "loss": loss,
        "one_of_many": what.startswith("mrclam"),
        "params": {name: float(natural[name]) for name in tuned},
        "evaluations": int(fit.trace.evaluations.sum()),
        "wall_s": time.perf_counter() - began,
        "before": _means(before),
        "after": _means(after),
    }


_MEANS = ("rmse_position_m", "anees", "coverage_95", "nis_mean", "log_loss", "calibration_error")


def _means(evidence: dict[str, Any]) -> dict[str, float]:
    """Of each quantity the mean over what was judged, robot by robot."""
    drives = list(evidence.values())
    return {key: float(np.mean([drive[key] for drive in drives])) for key in _MEANS if key in drives[0]}


def _summaries(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The splits of mrclam, one row a loss: means over them, and the range of the ANEES."""
    for loss in dict.fromkeys(row["loss"] for row in rows if row["one_of_many"]):
        some = [row for row in rows if row["one_of_many"] and row["loss"] == loss]

        def mean(when: str, some: list[dict[str, Any]] = some) -> dict[str, float]:
            return {key: float(np.mean([row[when][key] for row in some])) for key in some[0][when]}

        yield {
            "log": f"mrclam, two robots of five, {len(some)} splits",
            "loss": loss,
            "one_of_many": False,
            "params": {name: float(np.mean([row["params"][name] for row in some])) for name in some[0]["params"]},
            "before": mean("before"),
            "after": mean("after"),
            "anees_of_splits": [min(row["after"]["anees"] for row in some), max(row["after"]["anees"] for row in some)],
        }


def _table(rows: list[dict[str, Any]]) -> str:
    lines = ["| judged on | tuned for | position RMSE | ANEES (3) | 95 % ellipsoid holds |", "|---" * 5 + "|"]
    maps = ["| judged on | tuned for | log-loss one scan ahead | calibration error |", "|---" * 4 + "|"]
    shown = set()
    for row in rows:
        before, after = row["before"], row["after"]
        if "log_loss" in after:
            for what, values in (("–", before), ("`map`", after)):
                maps.append(f"| {row['log']} | {what} | {values['log_loss']:.4f} | {values['calibration_error']:.4f} |")
            continue
        if row["log"] not in shown:
            lines.append(_line(row["log"], "–", before))
            shown.add(row["log"])
        spread = row.get("anees_of_splits")
        lines.append(_line(row["log"], f"`{row['loss']}`", after, spread))
    return "\n".join([*lines, "", *maps])


def _line(log: str, loss: str, values: dict[str, float], spread: list[float] | None = None) -> str:
    anees = readable(values["anees"]) + (f" ({readable(spread[0])} to {readable(spread[1])})" if spread else "")
    return f"| {log} | {loss} | {values['rmse_position_m']:.3f} m | {anees} | {100 * values['coverage_95']:.1f} % |"


if __name__ == "__main__":
    command_line(main)
