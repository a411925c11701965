"""A descent, and a filter before and after it."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxlocmap.consistency import chi2_quantile, readable
from jaxlocmap.plotting.style import BAND, ESTIMATE, EXPECTED, TRUTH, from_zero, save

_BEFORE, _AFTER = EXPECTED, ESTIMATE


def descent_figure(path: Path, report: dict[str, Any]) -> None:
    """Loss, parameters and gradient step by step, as in the report of `jaxlocmap tune`."""
    trace, tuned = report["trace"], report["parameters"]
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    step = np.arange(len(trace["loss"]))
    left.plot(step, trace["loss"], ".-", color=ESTIMATE, label="on the sequences tuned on")
    if report["validated"]:
        epochs = report["steps_per_epoch"] * np.arange(len(trace["validation"]))
        left.plot(epochs, trace["validation"], "o--", color=EXPECTED, ms=4, label="on those left aside")
        best = report["best_epoch"]
        left.plot(epochs[best], trace["validation"][best], "*", color="tab:red", ms=14, label="best: what is kept")
    left.set(title="Loss: " + report["loss_words"], xlabel="step", ylabel="loss [nats or as the loss says]")
    left.legend(fontsize=8)
    for i, (name, value) in enumerate(tuned.items()):
        path_of = np.array(trace["parameters"][name])
        start = path_of[0] if path_of[0] else 1.0
        middle.plot(step, path_of / start, color=f"C{i}", label=f"{name}: {value['end']:.4g} {value['unit']}")
        error = value["standard_error"]
        if error is not None and np.isfinite(error):
            middle.errorbar(step[-1] + 0.5, value["end"] / start, 2 * error / abs(start), fmt="o", ms=4, color=f"C{i}")
    middle.axhline(1, color=TRUTH, lw=0.8, ls=":")
    middle.set(title="Parameters over their start; bars: ±2 standard errors", xlabel="step", ylabel="ratio [–]")
    if all(np.min(trace["parameters"][name]) > 0 or np.max(trace["parameters"][name]) < 0 for name in tuned):
        middle.set_yscale("log")
    middle.legend(fontsize=8)
    right.semilogy(step, np.maximum(trace["gradient_norm"], 1e-16), ".-", color=ESTIMATE)
    right.set(title="Norm of the gradient by the coordinates", xlabel="step", ylabel="norm [per unit of the logarithm]")
    figure.suptitle(f"{report['source']}: {report['evaluations']} evaluations in {report['run_s']:.1f} s", fontsize=11)
    save(figure, path, dpi=120)


def study_before_after_figure(path: Path, before: dict[str, Any], after: dict[str, Any], dt: float) -> None:
    """NEES over time of two studies of fresh runs, with its band; reports of `study.summarise`."""
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    time = dt * (1 + np.arange(after["steps"]))
    low, high = after["nees_band_95"]
    left.axhspan(low, high, color=BAND, alpha=0.3, label=f"95 % band, χ²(3·{after['runs']})/{after['runs']}")
    for study, colour, name in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
        left.plot(time, study["nees_per_step"], color=colour, lw=1.2, label=f"{name}: ANEES {study['anees']:.3g}")
    left.set(title="NEES of the pose on fresh runs: 3 if honest", xlabel="time [s]", ylabel="NEES [–]")
    from_zero(left)
    _coverage(right, before, after)
    verdicts = (f"{when}: {study['verdict']}" for when, study in (("before", before), ("after", after)))
    figure.suptitle("\n".join(textwrap.fill(verdict, 150) for verdict in verdicts), fontsize=10)
    save(figure, path, dpi=120)


def log_before_after_figure(path: Path, drives: dict[str, dict[str, Any]]) -> None:
    """NEES over time of held-out drives before and after.

    Args:
        drives: by name, each with `time` (T,) s, `nees_before`, `nees_after` (T,), NaN without truth, and the reports
            `before` and `after`.
    """
    rows = len(drives)
    figure = Figure(figsize=(12, 1 + 3.2 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, width_ratios=(2, 1), squeeze=False)
    low, high = (chi2_quantile(p, 3) for p in (0.025, 0.975))
    for (left, right), (name, drive) in zip(axes, drives.items(), strict=True):
        time = drive["time"] - drive["time"][0]
        left.axhspan(low, high, color=BAND, alpha=0.3, label="95 % of an honest filter's values, χ²(3)")
        for when, colour in (("before", _BEFORE), ("after", _AFTER)):
            label = f"{when}: ANEES {readable(drive[when]['anees'])}, RMSE {drive[when]['rmse_position_m']:.3f} m"
            left.plot(time, np.maximum(drive[f"nees_{when}"], 1e-3), color=colour, lw=0.6, label=label)
        left.set(title=f"{name}, held out", xlabel="time [s]", ylabel="NEES [–]", yscale="log")
        left.legend(fontsize=8, loc="lower right")
        _coverage(right, drive["before"], drive["after"])
    save(figure, path, dpi=110)


def calibration_figure(path: Path, before: dict[str, Any], after: dict[str, Any], what: str) -> None:
    """Of the cells the map calls p, how many does the next beam end in? As in the report of `jaxlocmap tune`."""
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], color=TRUTH, ls=":", label="calibrated")
    for judged, colour, name in ((before, _BEFORE, "before"), (after, _AFTER, "after")):
        cells = np.array(judged["calibration_cells"])
        p, share = (np.array(judged[f"calibration_{x}"], float) for x in ("probability", "frequency"))
        some = cells > 0
        label = f"{name}: error {judged['calibration_error']:.4f}, log-loss {judged['log_loss']:.4f} nats"
        left.plot(p[some], share[some], "o-", color=colour, ms=4, label=label)
        right.plot(p[some], cells[some] / cells.sum(), "o-", color=colour, ms=4, label=name)
    left.set(
        title=f"Calibration one scan ahead: {what}",
        xlabel="probability of being occupied the map gave [–]",
        ylabel="share of these cells a beam ended in [–]",
    )
    right.set(
        title="How often the map says so",
        xlabel="probability of being occupied the map gave [–]",
        ylabel="share of all cells [–]",
        yscale="log",
    )
    left.legend(fontsize=8)
    right.legend(fontsize=8)
    save(figure, path, dpi=120)


def _coverage(ax: Axes, before: dict[str, Any], after: dict[str, Any]) -> None:
    levels = (50, 90, 95, 99)
    place = np.arange(len(levels))
    ax.bar(place - 0.27, levels, 0.26, color=BAND, alpha=0.5, label="expected")
    for shift, report, colour, name in ((0.0, before, _BEFORE, "before"), (0.27, after, _AFTER, "after")):
        shares = [100 * (report[f"coverage_{level}"] or 0) for level in levels]
        ax.bar_label(ax.bar(place + shift, shares, 0.26, color=colour, label=name), fmt="%.0f", fontsize=7)
    ax.set(title="Poses inside the filter's ellipsoid", ylabel="[%]", ylim=(0, 125))
    ax.set_xticks(place, [f"{level} %" for level in levels])
    ax.legend(fontsize=8, loc="upper left", ncols=3)
