"""Trajectories and maps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxlocmap.consistency import chi2_quantile
from jaxlocmap.plotting.style import ESTIMATE, EXPECTED, TRUTH, save
from jaxlocmap.types import GridSpec


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
        estimate: (T, 3) m, m, rad.
        cov: (T, 3, 3).
        truth: (T, 3), NaN where unknown; None without truth.
        landmarks: (L, 2) m.
        segments: (S, 2, 2) m, walls.
    """
    figure = Figure(figsize=(8, 8), layout="constrained")
    ax = figure.subplots()
    _walls(ax, segments)
    if truth is not None:
        ax.plot(truth[:, 0], truth[:, 1], color=TRUTH, lw=1.5, label="truth")
    ax.plot(estimate[:, 0], estimate[:, 1], color=ESTIMATE, lw=1, label="estimate")
    ax.plot(landmarks[:, 0], landmarks[:, 1], "*", color=EXPECTED, ms=10, label="landmarks")
    ellipses_of_position(ax, estimate, cov, probability, ellipses)
    ax.set(xlabel="x [m]", ylabel="y [m]", title=title)
    ax.set_aspect("equal", adjustable="datalim")  # a straight drive would leave no height
    figure.legend(fontsize=8, loc="outside lower center", ncols=5)
    save(figure, path, dpi=120)


def map_figure(
    path: Path,
    log_odds: np.ndarray,
    spec: GridSpec,
    poses: np.ndarray,
    *,
    truth: np.ndarray | None = None,
    cov: np.ndarray | None = None,
    segments: np.ndarray | None = None,
    title: str = "",
) -> None:
    """Occupancy probability with the path driven; walls of a known world on top.

    Args:
        log_odds: (rows, columns) nats.
        poses: (T, 3) m, m, rad, the path the map was made from.
        truth: (T, 3).
        cov: (T, 3, 3), for ellipses that hold the position with 95 %.
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
        ax.plot(truth[:, 0], truth[:, 1], color=EXPECTED, lw=1.5, label="truth")
    ax.plot(poses[:, 0], poses[:, 1], color=ESTIMATE, lw=1, label="path the map was made from")
    if cov is not None:
        ellipses_of_position(ax, poses, cov, 0.95, 25)
    seen_rows, seen_columns = np.nonzero(log_odds)
    if len(seen_rows):  # the picture shows what was seen, with a margin
        margin = 0.05 * max(np.ptp(seen_rows), np.ptp(seen_columns), 10)
        ax.set_xlim(*_limits(seen_columns, margin, x, spec.resolution, columns))
        ax.set_ylim(*_limits(seen_rows, margin, y, spec.resolution, rows))
    ax.set(xlabel="x [m]", ylabel="y [m]", title=title)
    figure.legend(fontsize=8, loc="outside lower center", ncols=3)
    save(figure, path, dpi=150)


def ellipses_of_position(ax: Axes, mean: np.ndarray, cov: np.ndarray, probability: float, count: int) -> None:
    """Ellipses that hold the position with a probability, at `count` of the poses (T, 3) with covariances (T, 3, 3)."""
    reach = math.sqrt(chi2_quantile(probability, 2))
    label = f"{100 * probability:.0f} % ellipses of the position"
    for k in np.linspace(0, len(mean) - 1, count).astype(int):
        if not np.all(np.isfinite(cov[k])):
            continue
        variance, axes = np.linalg.eigh(cov[k, :2, :2])
        width, height = 2 * reach * np.sqrt(np.maximum(variance, 0))
        angle = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
        ax.add_patch(
            Ellipse((mean[k, 0], mean[k, 1]), width, height, angle=angle, fill=False, color="tab:red", label=label)
        )
        label = None


def _limits(cells: np.ndarray, margin: float, origin: float, resolution: float, count: int) -> tuple[float, float]:
    low, high = max(cells.min() - margin, 0), min(cells.max() + 1 + margin, count)
    return origin + resolution * low, origin + resolution * high


def _walls(ax: Axes, segments: np.ndarray | None) -> None:
    for i, wall in enumerate(() if segments is None else np.asarray(segments)):
        ax.plot(wall[:, 0], wall[:, 1], color="tab:green", lw=1, ls="--", label="walls" if i == 0 else None)
