"""A map of lines as a file: what is written reads back, and nothing else is taken for one."""

import numpy as np
import pytest

from jaxlocmap.matching.storage import load_lines, save_lines
from jaxlocmap.types import Matcher

MATCHER = Matcher(half_width=2.5, resolution=0.1)


def written(path):
    lines = np.zeros((*MATCHER.spec.shape, 6), np.float32)
    lines[3, 7], lines[49, 49] = np.arange(1, 7), 0.1 * np.arange(1, 7)
    save_lines(path, lines, MATCHER)
    return lines


def changed(path, **arrays):
    """The file with other arrays in it."""
    written(path)
    with np.load(path) as stored:
        kept = dict(stored) | arrays
    with path.open("wb") as stream:
        np.savez(stream, **kept)


def test_what_is_written_reads_back(tmp_path):
    lines = written(tmp_path / "a.npz")
    loaded = load_lines(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded.lines, lines)
    assert loaded.lines.dtype == np.float32
    again = Matcher(resolution=loaded.resolution, half_width=loaded.half_width)
    assert again.spec == MATCHER.spec
    assert (tmp_path / "a.npz").stat().st_size < 3000  # two cells of 2,500


def test_lines_of_another_shape_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^lines: expected shape \(50, 50, 6\)"):
        save_lines(tmp_path / "a.npz", np.zeros((50, 51, 6)), MATCHER)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 damaged", b"\x93NUMPY"])
def test_a_file_of_something_else_is_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=f"^{tmp_path}/a.npz: "):
        load_lines(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", np.zeros(3))
    with pytest.raises(ValueError, match=f"^{tmp_path}/b.npy: "):
        load_lines(tmp_path / "b.npy")
    with pytest.raises(FileNotFoundError, match=f"{tmp_path}/c.npz"):
        load_lines(tmp_path / "c.npz")


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"cells": np.array([3, 2500])}, "cells: expected rising numbers of the 2500 cells"),
        ({"cells": np.array([-1, 3])}, "cells"),
        ({"cells": np.array([3, 3])}, "cells"),
        ({"cells": np.array([0.5, 3])}, "cells"),
        ({"sums": np.zeros((3, 6), np.float32)}, "sums: expected finite numbers"),
        ({"sums": np.full((2, 6), np.nan)}, "sums"),
        ({"sums": np.full((2, 6), "a")}, "sums"),
        ({"resolution": -0.1}, "resolution"),
        ({"half_width": np.inf}, "half_width"),
        ({"half_width": 1e6}, "got more; JAXLOCMAP_MAX_BYTES"),
        ({"resolution": np.zeros(3)}, "map of lines"),
        ({"cells": np.array([{}, {}])}, "map of lines|pickle"),
    ],
)
def test_numbers_that_make_no_map_are_refused(tmp_path, arrays, said):
    changed(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError, match=f"^{tmp_path}/a.npz: .*({said})"):
        load_lines(tmp_path / "a.npz")


def test_a_packed_file_is_refused(tmp_path):
    """A small file might unpack to gigabytes."""
    written(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as stored:
        np.savez_compressed(tmp_path / "b.npz", **(dict(stored) | {"sums": np.zeros((100_000, 6))}))
    with pytest.raises(ValueError, match="not packed"):
        load_lines(tmp_path / "b.npz")
