"""Run the studies and logs behind tables of both README files; print those tables, or write them into the files."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from evidence import replace_table

from jaxlocmap import files, simulation
from jaxlocmap.cli import localize, slam, study
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder
from jaxlocmap.consistency import readable
from jaxlocmap.logs import write_tum
from jaxlocmap.monte_carlo import hosts

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
_LOOP = {"scenario": "loop", "steps": 2400}
_MATCHES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("loop, 4 laps", "--scenario loop --steps 2400", _LOOP),
    ("the same, start known to 0.14 rad", "", _LOOP | {"exact_prior": False}),
    ("the same, wheels 3 times as bad", "--odometry-noise 3", _LOOP | {"odometry_noise": 3.0}),
    ("the same, ranges to 1 cm", "--scan-noise 0.01", _LOOP | {"scan_noise": 0.01}),
    ("the same, ranges to 6 cm", "--scan-noise 0.06", _LOOP | {"scan_noise": 0.06}),
    ("the same, a match every step", "--match-every 1", _LOOP | {"match_every": 1}),
    ("the same, every 10th", "--match-every 10", _LOOP | {"match_every": 10}),
    ("building, 3 rounds", "--scenario building", {"scenario": "building"}),
    ("the same, wheels 3 times as bad", "--odometry-noise 3", {"scenario": "building", "odometry_noise": 3.0}),
    ("the same, a match every 10th step", "--match-every 10", {"scenario": "building", "match_every": 10}),
)
_QUICK_STEPS = 100


@dataclasses.dataclass(frozen=True)
class TablesConfig:
    """What to run."""

    data: Path | None = None
    """Folder with lost_in_the_woods/, mrclam/ and carmen/; without it the tables of real logs are left out."""
    runs: int = 2000
    """Runs of each study."""
    match_runs: int = 200
    """Runs of each study of a filter that matches scans."""
    write: bool = False
    """Put the tables into their pages instead of printing them."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/readme_tables")
    """Folder for the reports behind the tables, and plant.json."""
    quick: bool = False
    """Studies of 100 runs, one of 8 short runs of matching, the beginning of each log, and none of `jaxlocmap slam`."""


def main(config: TablesConfig) -> dict[str, str]:
    """Run, and return the tables by name."""
    out = output_folder(config.out)
    hosts.use_all_cores()
    tables = {"studies": _studies(config, out), "matches": _matches(config, out)}
    if config.data is not None:
        tables["logs"] = _logs(config, config.data, out)
        if not config.quick:  # the beginning of a log passes no place twice
            tables["slam"] = _slam(config, config.data, out)
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
        report = study.main(
            study.StudyConfig(
                **chosen, runs=config.runs, map=False, seed=config.seed, quick=config.quick, out=out / f"study{i}"
            )
        )
        alone = ", ".join(f"{value:.2f}" for value in report["axis_nees"].values())
        rows.append(
            f"| {what} | `{arguments}` | {report['anees']:.2f} | {alone} | {report['nis_mean']:.2f} | "
            f"{100 * report['gate_accept_rate']:.2f} % | {_short(report['verdict'])} |".replace("``", "–")
        )
    return "\n".join(rows)


def _matches(config: TablesConfig, out: Path) -> str:
    """Of filters that see no landmark, told the robot's own noise, which start from a pose that is known."""
    heads = ("position RMSE", "ANEES (3)", "on the submap (3)", "submap to submap (3)", "let in", "diverged")
    rows = [f"| drives | arguments | {' | '.join(heads)} |", "|---" * 8 + "|"]
    for i, (what, arguments, settings) in enumerate(_MATCHES[:1] if config.quick else _MATCHES):
        chosen: dict[str, Any] = {"exact_prior": True, **settings} | ({"steps": _QUICK_STEPS} if config.quick else {})
        report = study.main(
            study.StudyConfig(
                **chosen,
                motion="euler",
                match=True,
                landmarks=False,
                own_noise=True,
                map=False,
                runs=8 if config.quick else config.match_runs,
                seed=config.seed,
                out=out / f"match{i}",
            )
        )
        rows.append(
            f"| {what} | `{arguments}` | {report['rmse_position_m']:.3f} m | {readable(report['anees'])} | "
            f"{readable(report['relative_anees'])} | {readable(report['edge_anees'])} | "
            f"{100 * report['match_accept_rate']:.1f} % | {report['diverged_runs']} |".replace("``", "–")
        )
    return "\n".join(rows)


def _slam(config: TablesConfig, data: Path, out: Path) -> str:
    """Both logs, with loops closed and open."""
    heads = (
        "loops",
        "scored by, pairs",
        "translation, median",
        "rotation, median",
        "loops kept, false",
        "seconds in all",
    )
    rows = [f"| log | {' | '.join(heads)} |", "|---" * 7 + "|"]
    carmen = data / "carmen"
    for name, by in (("Intel", "relations"), ("CSAIL", "revisits")):
        lower = name.lower()
        reference = corrected(carmen / "raw_odom" / f"{lower}_corrected_log.json.gz", out)
        relations = carmen / "relations" / "intel.relations" if by == "relations" else None
        for closure in (True, False):
            report = slam.main(
                slam.SlamConfig(
                    log=carmen / f"{lower}-raw.log.gz",
                    format="carmen",
                    relations=relations,
                    reference=reference,
                    closure=closure,
                    out=out / f"slam_{lower}_{'closed' if closure else 'open'}",
                )
            )
            score, said = report[by], report.get("closure", {})
            loops = f"{said['kept']}, {said['false_kept']}" if said else "–"
            rows.append(
                f"| {name} | {'closed' if closure else '`--no-closure`'} | {by}, {score['scored']} "
                f"| {score['translation_m']:.3f} m, {score['translation_median_m']:.3f} m "
                f"| {score['rotation_deg']:.2f}°, {score['rotation_median_deg']:.2f}° "
                f"| {loops} | {report['wall_s']:.0f} |"
            )
    return "\n".join(rows)


def corrected(path: Path, out: Path) -> Path:
    """Corrected poses of a log, as TUM file: JSON, {"map": {stamp: {"x": m, "y": m, "theta": rad}}}."""
    poses = json.loads(files.unzipped(path, files.read(path)))["map"]
    stamps = sorted(poses, key=float)
    table = [[poses[stamp][name] for name in ("x", "y", "theta")] for stamp in stamps]
    write_tum(out / "reference.tum", [float(stamp) for stamp in stamps], table)
    return out / "reference.tum"


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
    command_line(main)
