"""Can the covariance of your own filter be believed? Truth and estimates from files, its NEES, and a verdict."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from common import CONSOLE, command_line, count_rows, output_folder, progress_bar, saved, show, write_report

from jaxlocmap import consistency, plotting
from jaxlocmap.consistency import Innovations, judge, readable
from jaxlocmap.logs import Pairs, pair, read_innovations, read_trajectory

_QUICK = 2000  # steps of each run


@dataclasses.dataclass(frozen=True)
class JudgeConfig:
    """What to judge. Several pairs of files are several runs of one filter."""

    truth: tuple[Path, ...]
    """True poses, one file a run: TUM (timestamp x y z qx qy qz qw) or CSV (t, x, y, theta)."""
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
    if config.gate is not None and not 0 < config.gate < 1:
        raise ValueError(f"gate: expected a probability inside (0, 1), or None for no gate, got {config.gate}")
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
    def interval(name: str, scale: float = 1) -> str:
        low, high = report[name]
        return f"[{scale * low:.4g}, {scale * high:.4g}]"

    rows = [
        ("runs, steps, steps scored", f"{report['runs']}, {report['steps']}, {report['scored_steps']}", ""),
        ("independent samples", readable(report["independent_samples"]), ""),
        ("ANEES (3 degrees)", readable(report["anees"], 4), interval("anees_band_95")),
        ("median NEES", readable(report["nees_median"]), f"{consistency.chi2_quantile(0.5, 3):.2f}"),
    ]
    rows += [
        (f"{level} % ellipsoid holds", f"{100 * report[f'coverage_{level}']:.1f} % {interval(name, 100)}", f"{level} %")
        for level in (50, 90, 95, 99)
        for name in [f"coverage_{level}_interval_95"]
    ]
    for field, words, expected, scale, unit in (
        ("axis_nees", "alone: error² over σ²", "1", 1, ""),
        ("within_two_sigma", "within ±2σ", "95.4 %", 100, " %"),
    ):
        for axis, value in report[field].items():
            low, high = (scale * limit for limit in report[f"{field}_interval_95"][axis])
            rows.append((f"{axis} {words}", f"{readable(scale * value)}{unit} [{low:.3g}, {high:.3g}]", expected))
    if "nis_mean" in report:
        degrees = report["nis_degrees"]
        rows.append((f"NIS ({degrees} degrees)", f"{report['nis_mean']:.3f}", interval("nis_band_95")))
        rows += [
            (f"innovation lag one, {name}", f"{value:+.4f}", f"±{report['innovation_lag_one_band_95'][name]:.4f}")
            for name, value in report["innovation_lag_one"].items()
        ]
    rows += [
        ("position RMSE", f"{report['rmse_position_m']:.4g} m", ""),
        ("yaw RMSE", f"{report['rmse_yaw_rad']:.4g} rad", ""),
        ("runs that lost the robot", str(report["diverged_runs"]), "0"),
    ]
    show(title, rows + count_rows(report["counts"]))
    for span in report["dishonest"]:
        (x0, x1), (y0, y1) = span["x_m"], span["y_m"]
        CONSOLE.print(
            f"{span['side']} from {span['from_s']:.4g} to {span['to_s']:.4g} s (x {x0:.3g} to {x1:.3g} m, "
            f"y {y0:.3g} to {y1:.3g} m): NEES {readable(span['anees'])}",
            highlight=False,
        )
    CONSOLE.print(f"[bold]{report['verdict']}[/bold]", highlight=False)
    if "gate_verdict" in report:
        CONSOLE.print(report["gate_verdict"], highlight=False)


if __name__ == "__main__":
    command_line(main, JudgeConfig)
