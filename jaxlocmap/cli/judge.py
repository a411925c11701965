"""Can the covariance of your own filter be believed? Truth and estimates from files, its NEES, and a verdict."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxlocmap import consistency, plotting
from jaxlocmap.cli.console import CONSOLE, count_rows, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.cli.options import check_gate
from jaxlocmap.cli.rows import innovation_rows, pose_rows, print_verdicts
from jaxlocmap.consistency import Innovations, judge, readable
from jaxlocmap.logs import Pairs, pair, read_innovations, read_trajectory

_QUICK = 2000  # steps of each run


@dataclasses.dataclass(frozen=True)
class JudgeConfig:
    """Can the covariance of your own filter be believed? True poses and estimates from files, and a verdict."""

    truth: tuple[Path, ...]
    """True poses, one file a run of the filter: TUM (timestamp x y z qx qy qz qw) or CSV (t, x, y, theta)."""
    estimate: tuple[Path, ...]
    """The filter's poses with their covariances, in the same order: TUM and then the entries of a covariance, or CSV
    with columns t, x, y, theta and xx, xy, xt, yy, yt, tt, or cov_0 to cov_35 of a ROS PoseWithCovariance."""
    innovations: tuple[Path, ...] = ()
    """The filter's innovations, for NIS, whiteness and gate: CSV with columns t, nu0, nu1, S00, S01, S11 and, if known,
    landmark and accepted."""
    gate: float | None = None
    """Share of good observations the filter's gate is to let in; None for no gate."""
    max_gap: float = 0.5
    """Gaps of the truth longer than this are not interpolated, s."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/judge")
    """Folder for report.json and nees.png."""
    quick: bool = False
    """The first 2,000 steps of each run alone."""


def main(config: JudgeConfig) -> dict[str, Any]:
    """Judge, write the report and the figure."""
    out = output_folder(config.out)
    check_gate(config.gate)
    if config.innovations and len(config.innovations) != len(config.estimate):
        raise ValueError(
            f"innovations: expected one file for each of the {len(config.estimate)} estimates, "
            f"got {len(config.innovations)}"
        )
    pairs = _read(config)
    innovations = _innovations(config.innovations, pairs) if config.innovations else None
    if config.quick:
        pairs, innovations = _first(pairs, innovations, _QUICK)
    report = judge(
        pairs.truth,
        pairs.mean,
        pairs.cov,
        time=pairs.time,
        valid=pairs.valid,
        innovations=innovations,
        gate_probability=config.gate,
    )
    names = [str(path) for path in config.estimate]
    report = {"estimates": names, **report, "counts": {**pairs.counts, **report["counts"]}}
    write_report(out, report)
    title = config.estimate[0].name + (f" and {len(names) - 1} more" if len(names) > 1 else "")
    plotting.judge_figure(out / "nees.png", report, pairs.truth[0, :, :2], title)
    _print(report, title)
    saved(out, "report.json", "nees.png")
    return report


def _read(config: JudgeConfig) -> Pairs:
    files = [*config.truth, *config.estimate]
    read = []
    with progress_bar("reading", len(files)) as progress:
        for path in files:
            read.append(read_trajectory(path))
            progress(len(read))
    count = len(config.truth)
    return pair(read[:count], read[count:], [str(path) for path in config.estimate], max_gap=config.max_gap)


def _innovations(paths: tuple[Path, ...], pairs: Pairs) -> Innovations:
    """Those of all runs, with as many steps and slots as the largest has."""
    runs = [read_innovations(path, stamps) for path, stamps in zip(paths, pairs.stamps, strict=True)]
    for path, run in zip(paths, runs, strict=True):
        for what, got, expected in (
            ("columns", sorted(run), sorted(runs[0])),
            ("components", run["innovation"].shape[-1], runs[0]["innovation"].shape[-1]),
        ):
            if got != expected:
                raise ValueError(f"{path}: expected the same {what} as in {paths[0]}, {expected}, got {got}")
    slots, steps = max(run["observed"].shape[1] for run in runs), len(pairs.time)

    def padded(value: np.ndarray) -> np.ndarray:
        empty = {"f": np.nan, "i": -1, "b": False}[value.dtype.kind]
        whole = np.full((steps, slots, *value.shape[2:]), empty, value.dtype)
        whole[: value.shape[0], : value.shape[1]] = value
        return whole

    return Innovations(**{name: np.stack([padded(run[name]) for run in runs]) for name in runs[0]})


def _first(pairs: Pairs, innovations: Innovations | None, steps: int) -> tuple[Pairs, Innovations | None]:
    """The same, cut short."""
    cut = {name: getattr(pairs, name)[:, :steps] for name in ("truth", "mean", "cov", "valid")}
    pairs = pairs._replace(time=pairs.time[:steps], **cut)
    if innovations is not None:
        given = {name: x for name, x in innovations._asdict().items() if x is not None}
        innovations = Innovations(**{name: np.asarray(x)[:, :steps] for name, x in given.items()})
    return pairs, innovations


def _print(report: dict[str, Any], title: str) -> None:
    rows = [
        ("runs, steps, steps scored", f"{report['runs']}, {report['steps']}, {report['scored_steps']}", ""),
        ("independent samples", readable(report["independent_samples"]), ""),
        ("median NEES", readable(report["nees_median"]), f"{consistency.chi2_quantile(0.5, 3):.2f}"),
        *pose_rows(report),
        *(innovation_rows(report) if "nis_mean" in report else []),
    ]
    show(title, rows + count_rows(report["counts"]))
    for span in report["dishonest"]:
        (x0, x1), (y0, y1) = span["x_m"], span["y_m"]
        CONSOLE.print(
            f"{span['side']} from {span['from_s']:.4g} to {span['to_s']:.4g} s (x {x0:.3g} to {x1:.3g} m, "
            f"y {y0:.3g} to {y1:.3g} m): NEES {readable(span['anees'])}",
        )
    print_verdicts(report)
