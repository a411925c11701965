"""Figures for people: units on the axes, bands and legends in the picture. NumPy in, a file out."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from jaxlocmap.consistency import COVERAGE_LEVELS, readable
from jaxlocmap.plotting.style import BAND, ESTIMATE, EXPECTED, TRUTH, from_zero, save

_BEYOND = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}


def study_figure(path: Path, report: dict[str, Any], dt: float) -> None:
    """NEES and NIS over time with their bands, errors against the filter's own sigma, and coverage, as in the
    report of `study.summarise`.
    """
    figure = Figure(figsize=(12, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    time = dt * (1 + np.arange(report["steps"]))
    runs = report["runs"]

    low, high = report["nees_band_95"]
    ax = axes[0, 0]
    ax.axhspan(low, high, color=BAND, alpha=0.25, label=f"95 % band, χ²(3·{runs})/{runs}")
    ax.axhline(3, color=BAND, lw=1)
    ax.plot(time, report["nees_per_step"], color=ESTIMATE, lw=1.2, label=f"mean of {runs} runs")
    ax.axhline(report["anees"], color=EXPECTED, ls="--", label=f"ANEES {report['anees']:.3g} over all steps")
    ax.set(title="NEES of the pose: 3 if the covariance is honest", xlabel="time [s]", ylabel="NEES [–]")
    from_zero(ax)

    ax = axes[0, 1]
    seen = np.array([value is not None for value in report["nis_per_step"]])
    if seen.any():
        bands = np.array([band for band in report["nis_chi2_band_95"] if band is not None])
        ax.fill_between(time[seen], bands[:, 0], bands[:, 1], color=BAND, alpha=0.25, label="95 % band, χ²(2·n)/n")
        nis = [value for value in report["nis_per_step"] if value is not None]
        ax.plot(time[seen], nis, ".-", color=ESTIMATE, lw=0.8, ms=4, label="mean over observations")
        ax.axhline(2, color=BAND, lw=1)
    else:
        ax.plot([], [], label="no observation")
    ax.set(title="NIS of range and bearing: 2 if consistent", xlabel="time [s]", ylabel="NIS [–]")
    from_zero(ax)

    _errors(axes[1, 0], time, report)
    _coverage_bars(axes[1, 1], report)
    named = [report["scenario"]] if "scenario" in report else []
    named += [f"{report['motion']} motion"] if "motion" in report else []
    _title(figure, ", ".join([*named, f"{runs} runs"]), report["verdict"])
    save(figure, path, dpi=120)


def judge_figure(path: Path, report: dict[str, Any], where: np.ndarray, title: str = "") -> None:
    """The report of `consistency.judge`: NEES over time with its band and the phases outside theirs, errors beside the
    filter's own σ, coverage, and where the filter is sure of too much.

    Args:
        where: (T, 2) m, the true positions of one run at the report's steps; NaN where unknown.
    """
    figure = Figure(figsize=(14, 9))  # placed by hand: axes of equal scale can leave an automatic layout no room
    axes = figure.subplots(2, 2, width_ratios=(1.6, 1))
    figure.subplots_adjust(left=0.06, right=0.97, bottom=0.07, top=0.89, hspace=0.3, wspace=0.18)
    time, nees = np.array(report["time"]), np.array(report["nees_per_step"], float)
    runs = report["runs"]
    low, high = report["nees_band_95"]

    ax = axes[0, 0]
    band = "95 % of an honest filter's values, χ²(3)" if runs == 1 else f"95 % band, χ²(3·{runs})/{runs}"
    ax.axhspan(low, high, color=BAND, alpha=0.25, label=band)
    ax.plot(time, nees, color=ESTIMATE, lw=0.7, label="NEES" if runs == 1 else f"NEES, mean of {runs} runs")
    ax.axhline(report["anees"], color=EXPECTED, ls="--", label=f"ANEES {readable(report['anees'])}")
    for side, colour in (("over-confident", "tab:red"), ("under-confident", "tab:purple")):
        for i, span in enumerate(s for s in report["dishonest"] if s["side"] == side):
            label = side if i == 0 else None
            ax.plot([span["from_s"], span["to_s"]], [span["anees"]] * 2, color=colour, lw=3, label=label)
    ax.set(title="NEES of the pose: 3 if the covariance is honest", xlabel="time [s]", ylabel="NEES [–]", yscale="log")
    ax.legend(fontsize=8)

    _errors(axes[1, 0], time, report)
    _coverage_bars(axes[1, 1], report)

    ax = axes[0, 1]
    ratio = np.clip(nees / 3, 1e-2, 1e3)
    span = max(float(np.nanmax(np.abs(np.log10(ratio)), initial=0.5)), 0.5)
    dots = ax.scatter(*where.T, c=ratio, s=4, cmap="RdBu_r", norm=LogNorm(10**-span, 10**span))
    figure.colorbar(dots, ax=ax, label="NEES over 3 [–]: red is over-confident")
    ax.set(title="Where", xlabel="x [m]", ylabel="y [m]")
    ax.set_aspect("equal", adjustable="datalim")  # a straight drive would leave no height
    _title(figure, title, report["verdict"])
    save(figure, path, dpi=120)


def _title(figure: Figure, title: str, verdict: str) -> None:
    figure.suptitle("\n".join(textwrap.wrap(" — ".join(filter(None, (title, verdict))), 130)), fontsize=11)


def _errors(ax: Axes, time: np.ndarray, report: dict[str, Any]) -> None:
    error, sigma = np.array(report["rmse_per_step"], float), np.array(report["sigma_per_step"], float)
    position = (np.hypot(*error[:, :2].T), np.hypot(*sigma[:, :2].T), "position", "m", ESTIMATE)
    heading = (error[:, 2], sigma[:, 2], "heading", "rad", "tab:red")
    for measured, claimed, name, unit, colour in (position, heading):
        over = "" if report["runs"] == 1 else ", RMS over runs"
        ax.plot(time, measured, color=colour, lw=1.2, label=f"{name}: error{over} [{unit}]")
        ax.plot(time, claimed, color=colour, ls=":", label=f"{name}: the filter's own σ [{unit}]")
    ax.set(title="How large the errors are, and how large the filter says", xlabel="time [s]", ylabel="[m] or [rad]")
    ax.set_yscale("log")
    ax.legend(fontsize=8)


def precision_figure(path: Path, rows: list[dict[str, Any]]) -> None:
    """NEES over time in float64 and in float32, and how far the two poses part, as in the rows of precision.py."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.axhline(3, color=TRUTH, ls="--", lw=1, label="3: an honest covariance")
    for i, row in enumerate(rows):
        colour, time = f"C{i}", np.array(row["time_s"])
        name = f"{row['steps']:,} steps, {row['runs']} runs"
        left.plot(time, row["float64"]["nees_per_bin"], color=colour, lw=1, label=f"{name}, float64")
        left.plot(time, row["float32"]["nees_per_bin"], "x", color=colour, ms=5, label="the same in float32")
        right.plot(time, row["float32"]["position_difference_per_bin_m"], color=colour, label=name)
        short = row["short_form"]["position_difference_per_bin_m"]
        right.plot(time, short, ":", color=colour, label="with the short form P ← (I − K H) P")
    left.set(
        title=f"NEES, mean over runs and a {len(rows[0]['time_s'])}th of the drive",
        xlabel="time [s]",
        ylabel="NEES [–]",
        xscale="log",
    )
    right.set(
        title="Position in float32 against float64: largest over runs",
        xlabel="time [s]",
        ylabel="distance [m]",
        xscale="log",
        yscale="log",
    )
    from_zero(left)
    right.legend(fontsize=8)
    figure.suptitle(rows[-1]["verdict"].replace("; ", "\n"), fontsize=11)
    save(figure, path, dpi=120)


def matching_figure(path: Path, report: dict[str, Any]) -> None:
    """NEES over time of every filter, a panel for each world, as in the report of matching_compare.py."""
    worlds, runs = report["worlds"], report["runs"]
    figure = Figure(figsize=(7 * len(worlds) + 1, 7), layout="constrained")
    axes = figure.subplots(1, len(worlds), squeeze=False)[0]
    for ax, (name, world) in zip(axes, worlds.items(), strict=True):
        low, high = world["nees_band_95"]
        ax.axhspan(low, high, color=BAND, alpha=0.25, label=f"95 % band, χ²(3·{runs})/{runs}")
        ax.axhline(3, color=TRUTH, ls="--", lw=1, label="3: an honest covariance")
        for i, row in enumerate(world["filters"]):
            last = i == len(world["filters"]) - 1
            colour, width = ("black", 2.0) if last else (f"C{i % 10}", 1.0)
            ax.plot(world["time_s"], row["nees_per_match"], color=colour, lw=width, label=row["filter"])
        ax.set(title=name, xlabel="time [s]", ylabel=f"NEES after a match, mean of {runs} runs [–]", yscale="log")
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=2)
    save(figure, path, dpi=120)


def sweep_figure(path: Path, report: dict[str, Any], labels: tuple[str, str], ticks: tuple[list[str], ...]) -> None:
    """ANEES and position RMSE of every cell of a sweep, the consistent ones outlined, from the report of such.

    Where none is consistent, the one that fits best is outlined instead, and the legend says so.

    Args:
        labels, ticks: of the x and of the y axis.
    """
    figure = Figure(figsize=(15, 7), layout="constrained")
    axes = figure.subplots(1, 2)
    columns, rows = (len(texts) for texts in ticks)
    anees, nis, rmse, misfit, consistent = (
        np.array([cell[name] for cell in report["cells"]], float).reshape(rows, columns)
        for name in ("anees", "nis_mean", "rmse_position_m", "misfit", "consistent")
    )
    factor = float(np.clip(np.exp(np.abs(np.log(_finite(anees) / 3)).max(initial=0)), 1.25, 10))
    _heat(axes[0], anees, "RdBu_r", span=(3 / factor, 3 * factor))
    _heat(axes[1], rmse, "viridis_r")
    axes[0].set_title("Consistent? ANEES [–]: 3; red is over-confident, blue under-confident", fontsize=11)
    axes[1].set_title("Accurate? Position RMSE [m]", fontsize=11)
    for values, expected, style, label in ((anees, 3, "-", "ANEES 3"), (nis, 2, "--", "NIS 2")):
        # Where a sweep crosses the expected value, and does not just rest on it.
        low, high = _finite(values).min(initial=np.inf), _finite(values).max(initial=0)
        if min(rows, columns) > 1 and low < 0.8 * expected and high > 1.25 * expected:
            axes[0].contour(np.log(values / expected), levels=[0], colors="0.3", linestyles=style, linewidths=1.2)
            axes[0].plot([], [], style, color="0.3", lw=1.2, label=f"{label}, interpolated")
    outlined, label = consistent > 0, "consistent: ANEES inside its 95 % band, no run diverged"
    if not consistent.any():
        outlined, label = misfit == misfit.min(), "none is consistent: the best fit of ANEES and NIS"
    for ax in axes:
        _outline(ax, outlined, label)
        ax.set_xticks(range(columns), ticks[0])
        ax.set_yticks(range(rows), ticks[1])
        ax.set(xlabel=labels[0], ylabel=labels[1])
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=9, loc="outside lower center", ncols=3)
    title = f"{report['scenario']}, {report['motion']} motion, {report['runs']} runs a cell"
    words = [report[name] for name in ("gate_verdict", "verdict") if name in report]
    figure.suptitle("\n".join([title, *words]), fontsize=11)
    save(figure, path, dpi=120)


def _finite(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _heat(ax: Axes, values: np.ndarray, colours: str, span: tuple[float, float] | None = None) -> None:
    """One colour a cell on a log scale, and its value where there is room."""
    some = _finite(values) if np.isfinite(values).any() else np.ones(1)
    low, high = span or (some.min(), some.max())
    image = ax.imshow(values, norm=LogNorm(low, high), cmap=colours, origin="lower", aspect="auto")
    below, above = bool((some < 0.999 * low).any()), bool((some > 1.001 * high).any())
    bar = ax.figure.colorbar(image, ax=ax, extend=_BEYOND[below, above])
    ticks = np.geomspace(low, high, 7).tolist()
    bar.set_ticks(ticks, labels=[readable(tick) for tick in ticks])
    bar.minorticks_off()
    if max(values.shape) > 12:
        return
    for (i, j), value in np.ndenumerate(values):
        colour = image.cmap(image.norm(value)) if np.isfinite(value) else (1, 1, 1)
        dark = np.dot(colour[:3], (0.3, 0.6, 0.1)) < 0.45  # how bright the eye finds red, green, blue
        ink, halo = ("white", "black") if dark else ("black", "white")
        effects = [withStroke(linewidth=1, foreground=halo, alpha=0.4)]
        ax.text(j, i, readable(value), ha="center", va="center", fontsize=8, color=ink, path_effects=effects)


def _outline(ax: Axes, cells: np.ndarray, label: str) -> None:
    """A line around a region of cells."""
    padded = np.pad(cells, 1)
    rows, columns = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    ax.vlines(columns - 0.5, rows - 0.5, rows + 0.5, color="black", lw=2.5, label=label)
    rows, columns = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    ax.hlines(rows - 0.5, columns - 0.5, columns + 0.5, color="black", lw=2.5)


def _coverage_bars(ax: Axes, report: dict[str, Any]) -> None:
    """Measured shares with their 95 % intervals beside those expected."""
    place, names = np.arange(len(COVERAGE_LEVELS)), [f"coverage_{round(100 * level)}" for level in COVERAGE_LEVELS]
    measured = np.array([report[name] for name in names], float)
    limits = np.array([report[f"{name}_interval_95"] for name in names], float)
    reach = np.nan_to_num(100 * np.abs(limits.T - measured), posinf=0)
    ax.bar(place - 0.2, [100 * level for level in COVERAGE_LEVELS], 0.4, color=BAND, alpha=0.5, label="expected")
    ax.bar(place + 0.2, 100 * measured, 0.4, yerr=reach, capsize=4, color=ESTIMATE, label="measured, 95 % interval")
    for x, share, up in zip(place + 0.2, 100 * measured, reach[1], strict=True):
        ax.text(x, share + up + 1, f"{share:.1f}", ha="center", va="bottom", fontsize=8)
    ax.set(title="Share of poses inside the filter's ellipsoid", ylabel="[%]", ylim=(0, 125))
    ax.set_xticks(place, [f"{100 * level:.0f} %" for level in COVERAGE_LEVELS])
    ax.set_xlabel("ellipsoid that should hold this share")
    ax.legend(fontsize=8, loc="upper left")
