"""What the figures share."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxlocmap import files

TRUTH, ESTIMATE, BAND, EXPECTED = "0.25", "tab:blue", "tab:green", "tab:orange"


def from_zero(ax: Axes) -> None:
    """The vertical axis from zero, with room for the legend."""
    ax.set_ylim(bottom=0)
    ax.margins(y=0.2)
    ax.legend(fontsize=8)


def save(figure: Figure, path: Path, dpi: int) -> None:
    """Write the picture in one piece."""
    with files.writing(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
