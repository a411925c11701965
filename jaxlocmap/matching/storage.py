"""A map of lines as a file: the cells that know something, and where they lie."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxlocmap import checks, files
from jaxlocmap.matching.lines import SUMS
from jaxlocmap.types import Matcher

_KEYS = ("resolution", "half_width", "cells", "sums")


class LoadedLines(NamedTuple):
    """A map of lines read from a file."""

    lines: np.ndarray  # (rows, columns, 6) float32, as `lines.add_points` makes it
    resolution: float  # m per cell
    half_width: float  # m of the map, about the frame it is in; with `resolution`, what `Matcher` takes


def save_lines(path: str | Path, lines: np.ndarray, matcher: Matcher) -> None:
    """Write a map of lines, in NumPy's npz format.

    Args:
        path: of the file to write.
        lines: (rows, columns, 6) as `matcher.spec` has it.
        matcher: that the map was made with.

    Raises:
        ValueError: a wrong shape. OSError: as `files.write`.
    """
    checks.shape("lines", lines, (*matcher.spec.shape, SUMS))
    flat = np.asarray(lines, np.float32).reshape(-1, SUMS)
    cells = np.flatnonzero(flat[:, -1])
    stream = io.BytesIO()
    resolution, half_width = np.array(matcher.resolution), np.array(matcher.half_width)
    np.savez(stream, resolution=resolution, half_width=half_width, cells=cells.astype(np.int32), sums=flat[cells])
    files.write(path, stream.getvalue())


def load_lines(path: str | Path) -> LoadedLines:
    """Read what `save_lines` wrote.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: no such file, or one that is damaged or too large; the message starts with the path.
    """
    data = files.read(path)
    with files.reading(path, "a map of lines (save_lines)"), np.load(io.BytesIO(data), allow_pickle=False) as stored:
        # Nothing in the file is packed: what it unpacks to is no larger than what was read.
        if any(entry.file_size > len(data) for entry in stored.zip.infolist()):
            raise ValueError("expected numbers that are not packed")
        resolution, half_width, cells, sums = (stored[key] for key in _KEYS)
        matcher = Matcher(resolution=float(resolution), half_width=float(half_width))
        rows, columns = matcher.spec.shape
        if rows * columns * SUMS * 4 > files.most_bytes():
            raise files.too_large(path, "a map of lines")
        whole = cells.ndim == 1 and np.issubdtype(cells.dtype, np.integer)
        if not (whole and np.all((cells >= 0) & (cells < rows * columns)) and np.all(np.diff(cells) > 0)):
            raise ValueError(f"cells: expected rising numbers of the {rows * columns} cells, got others")
        number = np.issubdtype(sums.dtype, np.floating) and np.all(np.isfinite(sums))
        if sums.shape != (len(cells), SUMS) or not number:
            raise ValueError(f"sums: expected finite numbers ({len(cells)}, {SUMS}), got {sums.dtype} {sums.shape}")
    lines = np.zeros((rows * columns, SUMS), np.float32)
    lines[cells] = sums
    return LoadedLines(lines.reshape(rows, columns, SUMS), matcher.resolution, matcher.half_width)
