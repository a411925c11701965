"""Pose graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from jaxlocmap.consistency import chi2_quantile
from jaxlocmap.plotting.maps import ellipses_of_position
from jaxlocmap.plotting.style import BAND, ESTIMATE, EXPECTED, from_zero, save
from jaxlocmap.se2 import POSE

_WEIGHTS = "coolwarm_r"  # 0 red, 1 blue


def slam_figure(path: Path, before: np.ndarray, after: np.ndarray, seconds: float, title: str) -> None:
    """Errors, standard deviations and NEES over time, without and with closed loops.

    Args:
        before, after: (N, S, 4) of N runs: squared error of position m² and of heading rad², NEES, variance of position
            m².
        seconds: between two scans.
    """
    figure = Figure(figsize=(9, 7), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = seconds * np.arange(before.shape[1])
    for values, color, name in ((before, "0.4", "loops open"), (after, ESTIMATE, "loops closed")):
        upper.plot(time, np.sqrt(values[..., 0].mean(axis=0)), color=color, label=f"{name}: RMSE")
        upper.plot(time, np.sqrt(values[..., 3].mean(axis=0)), color=color, ls="--", label=f"{name}: 1 sigma")
        lower.plot(time[1:], np.nanmean(values[:, 1:, 2], axis=0), color=color, label=name)
    lower.axhspan(*(chi2_quantile(p, POSE * len(before)) / len(before) for p in (0.025, 0.975)), color=BAND, alpha=0.3)
    lower.axhline(POSE, color=EXPECTED, lw=1, label="3, with the 95 % band of a consistent one")
    upper.set(ylabel="position [m]", title=f"{title}: mean over {len(before)} runs")
    lower.set(xlabel="time [s]", ylabel="NEES of the pose [–]")
    from_zero(upper)
    from_zero(lower)
    save(figure, path, dpi=120)


def graph_figure(
    path: Path,
    poses: np.ndarray,
    cov: np.ndarray,
    pair: np.ndarray,
    weights: np.ndarray,
    *,
    before: np.ndarray,
    truth: np.ndarray | None = None,
    title: str = "",
) -> None:
    """Poses before and after, and the loops between them coloured by how much they count.

    Args:
        poses: (N, 3) m, m, rad, optimised.
        cov: (N, 3, 3), for ellipses that hold the position with 95 %.
        pair: (L, 2) poses of the loops.
        weights: (L,) 0 to 1.
        before: (N, 3) where the search began.
        truth: (T, 3).
    """
    figure = Figure(figsize=(14, 7), layout="constrained")
    left, right = figure.subplots(1, 2)
    for ax, xy, name in ((left, before, "before"), (right, poses, "after")):
        lines = LineCollection(list(xy[pair][:, :, :2]), linewidths=0.8, cmap=_WEIGHTS, norm=Normalize(0, 1), zorder=1)
        lines.set_array(weights)
        ax.add_collection(lines)
        if truth is not None:
            ax.plot(truth[:, 0], truth[:, 1], color=EXPECTED, lw=1.5, label="truth" if ax is right else None)
        color = "0.4" if ax is left else ESTIMATE
        ax.plot(xy[:, 0], xy[:, 1], color=color, lw=0.8, label="start" if ax is left else "optimised", zorder=2)
        ax.set(xlabel="x [m]", ylabel="y [m]", title=name)
        ax.set_aspect("equal", adjustable="datalim")
    ellipses_of_position(right, poses, cov, 0.95, 25)
    scale = ScalarMappable(Normalize(0, 1), _WEIGHTS)
    figure.colorbar(scale, ax=[left, right], label="weight of a loop [–]: 1 counts in full, 0 not at all", shrink=0.8)
    figure.suptitle(title)
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    save(figure, path, dpi=120)
