"""Run every study and log that the README's tables show, and print those tables, or write them into the README."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import consistency
import localize
from common import CONSOLE, command_line, output_folder, replace_table

from jaxlocmap import simulation
from jaxlocmap.consistency import readable

_STUDIES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("the course's noise, exact arc (the default)", "", {}),
    ("the course's noise, exact mean, first-order Jacobians", "--motion capstone", {"motion": "capstone"}),
    ("the course's noise, first-order model as the robot's", "--motion euler", {"motion": "euler"}),
    ("the robot's own noise", "--motion euler --params plant.json", {"motion": "euler", "params": True}),
    (
        "the same, steady state",
        "--motion euler --params plant.json --scenario loop",
        {"motion": "euler", "params": True, "scenario": "loop"},
    ),
    (
        "the same, without a gate",
        "--motion euler --params plant.json --scenario loop --gate None",
        {"motion": "euler", "params": True, "scenario": "loop", "gate": None},
    ),
)
_WOODS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("--motion euler --max-range 5", {"max_range": 5.0}),
    ("--motion euler --max-range 5 --gate None", {"max_range": 5.0, "gate": None}),
    ("--motion euler --max-range 1.5", {"max_range": 1.5}),
)


@dataclasses.dataclass(frozen=True)
class TablesConfig:
    """What to run."""

    data: Path | None = None
    """Folder with lost_in_the_woods/ and mrclam/; without it the table of real logs is left out."""
    runs: int = 2000
    """Runs of each study."""
    write: bool = False
    """Put the tables into the README instead of printing them."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/readme_tables")
    """Folder for the reports behind the tables, and plant.json."""
    quick: bool = False
    """Studies of 100 runs, and the first 2,000 steps of each log."""


def main(config: TablesConfig) -> dict[str, str]:
    """Run, and return the tables by name."""
    out = output_folder(config.out)
    tables = {"studies": _studies(config, out)}
    if config.data is not None:
        tables["logs"] = _logs(config, config.data, out)
    for name, table in tables.items():
        if config.write:
            replace_table(name, table)
        else:
            CONSOLE.print(f"\n{table}", soft_wrap=True)
    return tables


def _studies(config: TablesConfig, out: Path) -> str:
    plant = out / "plant.json"
    simulation.own_params(simulation.Noise(), simulation.CAPSTONE).save(plant)
    rows = ["| the filter believes | arguments | ANEES (3) | x, y, yaw alone (1) | NIS (2) | gate lets in | verdict |"]
    rows.append("|---" * 7 + "|")
    for i, (what, arguments, settings) in enumerate(_STUDIES):
        chosen: dict[str, Any] = settings | {"params": plant if settings.get("params") else None}
        report = consistency.main(
            consistency.ConsistencyConfig(
                **chosen, runs=config.runs, map=False, seed=config.seed, quick=config.quick, out=out / f"study{i}"
            )
        )
        alone = ", ".join(f"{value:.2f}" for value in report["axis_nees"].values())
        rows.append(
            f"| {what} | `{arguments}` | {report['anees']:.2f} | {alone} | {report['nis_mean']:.2f} | "
            f"{100 * report['gate_accept_rate']:.2f} % | {_short(report['verdict'])} |".replace("``", "–")
        )
    return "\n".join(rows)


def _logs(config: TablesConfig, data: Path, out: Path) -> str:
    rows = ["| log, arguments | position RMSE | ANEES (3) | gate lets in | what the program says |", "|---" * 5 + "|"]
    for i, (arguments, settings) in enumerate(_WOODS):
        report = localize.main(
            localize.LocalizeConfig(
                log=data / "lost_in_the_woods" / "dataset2.mat",
                format="woods",
                motion="euler",
                quick=config.quick,
                out=out / f"woods{i}",
                **settings,
            )
        )
        rows.append(_log_row(f"woods `{arguments}`", [report]))
    robots = [
        localize.main(
            localize.LocalizeConfig(
                log=data / "mrclam" / "MRCLAM_Dataset6",
                format="mrclam",
                robot=robot,
                quick=config.quick,
                out=out / f"mrclam{robot}",
            )
        )
        for robot in range(1, 6)
    ]
    rows.append(_log_row("MRCLAM dataset 6, `--robot 1` to `5`", robots))
    return "\n".join(rows)


def _log_row(what: str, reports: list[dict[str, Any]]) -> str:
    rmse = ", ".join(f"{report['rmse_position_m']:.3f}" for report in reports)
    anees = ", ".join(readable(report["anees"]) for report in reports)
    gate = ", ".join(f"{100 * report['gate_accept_rate']:.1f}" for report in reports)
    if len(reports) == 1:
        says = f"{_short(reports[0]['verdict'])}; {reports[0]['gate_verdict'].split(';')[0]}"
    else:
        says = ", ".join(sorted({report["verdict"].split(":")[0] for report in reports}))
    return f"| {what} | {rmse} m | {anees} | {gate} % | {says} |"


def _short(verdict: str) -> str:
    """The verdict without the numbers that stand in the table's other columns."""
    head, _, tail = verdict.partition(" (")
    return head + (";" + tail.partition(");")[2] if ");" in tail else "")


if __name__ == "__main__":
    command_line(main, TablesConfig)
