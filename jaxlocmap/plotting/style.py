"""What the figures share."""

from __future__ import annotations

from matplotlib.axes import Axes

TRUTH, ESTIMATE, BAND, EXPECTED = "0.25", "tab:blue", "tab:green", "tab:orange"


def from_zero(ax: Axes) -> None:
    """The vertical axis from zero, with room for the legend."""
    ax.set_ylim(bottom=0)
    ax.margins(y=0.2)
    ax.legend(fontsize=8)
