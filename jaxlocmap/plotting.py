"""Figures for people: units on the axes, bands and legends in the picture. NumPy in, a file out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxlocmap.consistency import COVERAGE_LEVELS, chi2_quantile, readable
from jaxlocmap.types import GridSpec

_TRUTH, _ESTIMATE, _BAND, _EXPECTED = "0.25", "tab:blue", "tab:green", "tab:orange"


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
    ax.axhspan(low, high, color=_BAND, alpha=0.25, label=f"95 % band, χ²(3·{runs})/{runs}")
    ax.axhline(3, color=_BAND, lw=1)
    ax.plot(time, report["nees_per_step"], color=_ESTIMATE, lw=1.2, label=f"mean of {runs} runs")
    ax.axhline(report["anees"], color=_EXPECTED, ls="--", label=f"ANEES {report['anees']:.3g} over all steps")
    ax.set(title="NEES of the pose: 3 if the covariance is honest", xlabel="time [s]", ylabel="NEES [–]")
    _from_zero(ax)

    ax = axes[0, 1]
    seen = np.array([value is not None for value in report["nis_per_step"]])
    if seen.any():
        bands = np.array([band for band in report["nis_chi2_band_95"] if band is not None])
        ax.fill_between(time[seen], bands[:, 0], bands[:, 1], color=_BAND, alpha=0.25, label="95 % band, χ²(2·n)/n")
        nis = [value for value in report["nis_per_step"] if value is not None]
        ax.plot(time[seen], nis, ".-", color=_ESTIMATE, lw=0.8, ms=4, label="mean over observations")
        ax.axhline(2, color=_BAND, lw=1)
    ax.set(title="NIS of range and bearing: 2 if consistent", xlabel="time [s]", ylabel="NIS [–]")
    _from_zero(ax)

    ax = axes[1, 0]
    error, sigma = np.array(report["rmse_per_step"]), np.array(report["sigma_per_step"])
    position = (np.hypot(*error[:, :2].T), np.hypot(*sigma[:, :2].T), "position", "m", _ESTIMATE)
    heading = (error[:, 2], sigma[:, 2], "heading", "rad", "tab:red")
    for measured, claimed, name, unit, colour in (position, heading):
        ax.plot(time, measured, color=colour, lw=1.2, label=f"{name}: error, RMS over runs [{unit}]")
        ax.plot(time, claimed, color=colour, ls=":", label=f"{name}: the filter's own σ [{unit}]")
    ax.set(title="How large the errors are, and how large the filter says", xlabel="time [s]", ylabel="[m] or [rad]")
    ax.set_yscale("log")
    ax.legend(fontsize=8)

    _coverage_bars(axes[1, 1], [report[f"coverage_{round(100 * level)}"] for level in COVERAGE_LEVELS])
    figure.suptitle(f"{report['scenario']}, {report['motion']} motion, {runs} runs — {report['verdict']}", fontsize=11)
    figure.savefig(path, dpi=120)


def log_nees_figure(path: Path, time: np.ndarray, nees: np.ndarray, report: dict[str, Any]) -> None:
    """NEES of one drive over time on a log scale, and its coverage. NaN where there is no truth."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    low, high = (chi2_quantile(p, 3) for p in (0.025, 0.975))
    left.axhspan(low, high, color=_BAND, alpha=0.25, label="95 % of an honest filter's values, χ²(3)")
    left.plot(time - time[0], nees, color=_ESTIMATE, lw=0.6, label="NEES")
    left.axhline(report["anees"], color=_EXPECTED, ls="--", label=f"ANEES {readable(report['anees'])}")
    left.set(title="NEES of the pose", xlabel="time [s]", ylabel="NEES [–]", yscale="log")
    left.legend(fontsize=8)
    _coverage_bars(right, [report[f"coverage_{round(100 * level)}"] for level in COVERAGE_LEVELS])
    figure.suptitle(f"{report['log']} — {report['verdict']}", fontsize=11)
    figure.savefig(path, dpi=120)


def trajectory_figure(
    path: Path,
    estimate: np.ndarray,
    cov: np.ndarray,
    truth: np.ndarray | None,
    *,
    landmarks: np.ndarray,
    segments: np.ndarray | None = None,
    probability: float = 0.95,
    ellipses: int = 25,
    title: str = "",
) -> None:
    """Path and truth from above, with ellipses that hold the position with the given probability.

    Args:
        estimate: (T, 3) m, m, rad. cov: (T, 3, 3). truth: (T, 3), NaN where unknown; None without truth.
        landmarks: (L, 2) m. segments: (S, 2, 2) m, walls.
    """
    figure = Figure(figsize=(8, 8), layout="constrained")
    ax = figure.subplots()
    _walls(ax, segments)
    if truth is not None:
        ax.plot(truth[:, 0], truth[:, 1], color=_TRUTH, lw=1.5, label="truth")
    ax.plot(estimate[:, 0], estimate[:, 1], color=_ESTIMATE, lw=1, label="estimate")
    ax.plot(landmarks[:, 0], landmarks[:, 1], "*", color=_EXPECTED, ms=10, label="landmarks")
    reach = math.sqrt(chi2_quantile(probability, 2))
    for i, k in enumerate(np.linspace(0, len(estimate) - 1, ellipses).astype(int)):
        if not np.all(np.isfinite(cov[k])):
            continue
        variance, axes = np.linalg.eigh(cov[k, :2, :2])
        width, height = 2 * reach * np.sqrt(np.maximum(variance, 0))
        angle = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
        label = f"{100 * probability:.0f} % ellipses of the position" if i == 0 else None
        ax.add_patch(
            Ellipse(
                (estimate[k, 0], estimate[k, 1]), width, height, angle=angle, fill=False, color="tab:red", label=label
            )
        )
    ax.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal")
    figure.legend(fontsize=8, loc="outside lower center", ncols=5)
    figure.savefig(path, dpi=120)


def map_figure(
    path: Path,
    log_odds: np.ndarray,
    spec: GridSpec,
    poses: np.ndarray,
    *,
    truth: np.ndarray | None = None,
    segments: np.ndarray | None = None,
    title: str = "",
) -> None:
    """Occupancy probability with the path driven; walls of a known world on top.

    Args:
        log_odds: (rows, columns) nats. poses: (T, 3) m, m, rad, the path the map was made from. truth: (T, 3).
    """
    figure = Figure(figsize=(9, 8), layout="constrained")
    ax = figure.subplots()
    rows, columns = spec.shape
    x, y = spec.origin
    extent = (x, x + columns * spec.resolution, y, y + rows * spec.resolution)
    shown = 1 / (1 + np.exp(-np.asarray(log_odds, np.float64)))
    image = ax.imshow(shown, origin="lower", extent=extent, cmap="gray_r", vmin=0, vmax=1, interpolation="nearest")
    figure.colorbar(image, ax=ax, label="probability of being occupied [–], 0.5 = never seen", shrink=0.8)
    _walls(ax, segments)
    if truth is not None:
        ax.plot(truth[:, 0], truth[:, 1], color=_EXPECTED, lw=1.5, label="truth")
    ax.plot(poses[:, 0], poses[:, 1], color=_ESTIMATE, lw=1, label="path the map was made from")
    seen_rows, seen_columns = np.nonzero(log_odds)
    if len(seen_rows):  # the picture shows what was seen, with a margin
        margin = 0.05 * max(np.ptp(seen_rows), np.ptp(seen_columns), 10)
        ax.set_xlim(*_limits(seen_columns, margin, x, spec.resolution, columns))
        ax.set_ylim(*_limits(seen_rows, margin, y, spec.resolution, rows))
    ax.set(xlabel="x [m]", ylabel="y [m]", title=title)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=150)


def _limits(cells: np.ndarray, margin: float, origin: float, resolution: float, count: int) -> tuple[float, float]:
    low, high = max(cells.min() - margin, 0), min(cells.max() + 1 + margin, count)
    return origin + resolution * low, origin + resolution * high


def _walls(ax: Axes, segments: np.ndarray | None) -> None:
    for i, wall in enumerate(() if segments is None else np.asarray(segments)):
        ax.plot(wall[:, 0], wall[:, 1], color="tab:green", lw=1, ls="--", label="walls" if i == 0 else None)


def _coverage_bars(ax: Axes, measured: list[float]) -> None:
    place = np.arange(len(COVERAGE_LEVELS))
    ax.bar(place - 0.2, [100 * level for level in COVERAGE_LEVELS], 0.4, color=_BAND, alpha=0.5, label="expected")
    bars = ax.bar(place + 0.2, [100 * share for share in measured], 0.4, color=_ESTIMATE, label="measured")
    ax.bar_label(bars, fmt="%.1f", fontsize=8)
    ax.set(title="Share of poses inside the filter's ellipsoid", ylabel="[%]", ylim=(0, 115))
    ax.set_xticks(place, [f"{100 * level:.0f} %" for level in COVERAGE_LEVELS])
    ax.set_xlabel("ellipsoid that should hold this share")
    ax.legend(fontsize=8, loc="upper left")


def _from_zero(ax: Axes) -> None:
    ax.set_ylim(bottom=0)
    ax.margins(y=0.2)
    ax.legend(fontsize=8)
