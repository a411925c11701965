"""Pose graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from jaxlocmap.plotting.maps import ellipses_of_position
from jaxlocmap.plotting.style import ESTIMATE, EXPECTED, save

_WEIGHTS = "coolwarm_r"  # 0 red, 1 blue


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
