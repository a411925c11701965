"""Real matrices from MATLAB files of version 5 to 7.

A reader of our own because SciPy's (1.17.1) crashes the interpreter on an element of unknown type; and these
few types leave nothing that could be executed.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from jaxlocmap import files
from jaxlocmap.logs.text import read_bytes

_HEADER = 128  # bytes
_MATRIX, _COMPRESSED = 14, 15  # element types
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse"} | dict.fromkeys(range(6, 16), "real")
_DIMENSIONS = 32  # at most
_COMPLEX = 0x0800  # flag

_Order = Literal["little", "big"]


def read_matrices(path: str | Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Read the named variables as float64 arrays, at least two-dimensional.

    Args:
        path: of the file, as it is or gzipped.
        names: of the variables wanted; others are passed over.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: no MATLAB file of version 5 to 7, a truncated or damaged one, or a variable that is
            missing or not a full matrix of real numbers; the message starts with the path.

    Source: MathWorks, "MAT-File Format", level 5.
    """
    with files.reading(path, "a MATLAB file of version 5 to 7"):
        return _read(path, names)


def _read(path: str | Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    data = read_bytes(path)
    order: _Order = "big" if data[126:128] == b"MI" else "little"
    if data[124:128] not in (b"\0\1IM", b"\1\0MI"):
        raise ValueError(f"{path}: expected a MATLAB file of version 5 to 7")
    found: dict[str, np.ndarray] = {}
    for name, content in _variables(path, data[_HEADER:], order):
        if name in names:
            try:
                values = _matrix(content, order)
            except ValueError as error:
                raise ValueError(f"{path}: {name}: {error}") from None
            if 8 * values.size > files.most_bytes():
                raise files.too_large(path, "numbers")
            with np.errstate(invalid="ignore"):  # a NaN of another pattern is one all the same
                found[name] = values.astype(np.float64)
    for name in names:
        if name not in found:
            raise ValueError(f"{path}: no variable {name}; expected {', '.join(names)}")
    return found


def _variables(path: str | Path, data: bytes, order: _Order) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each variable."""
    room = files.most_bytes()
    try:
        for kind, content in _elements(data, order):
            if kind == _COMPRESSED:
                stream = zlib.decompressobj()
                unpacked = stream.decompress(content, room + 1)
                if not stream.eof and len(unpacked) <= room:
                    raise ValueError("compressed data that end early")
                if (room := room - len(unpacked)) < 0:
                    raise files.too_large(path, "unpacked content")
                kind, content = next(_elements(unpacked, order), (0, b""))
            if kind != _MATRIX:
                raise ValueError(f"expected a matrix, got an element of type {kind}")
            parts = list(itertools.islice(_elements(content, order), 3))
            if len(parts) < 3:
                raise ValueError("a matrix without flags, dimensions and name")
            yield parts[2][1].decode("latin-1"), content
    except (ValueError, zlib.error) as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: truncated or damaged MATLAB file: {error}") from None


def _elements(data: bytes, order: _Order) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each element."""
    at = 0
    while at < len(data):
        kind = int.from_bytes(data[at : at + 4], order)
        if kind >> 16:  # small: type and size share the first four bytes, the content has the other four
            kind, size, begin, room = kind & 0xFFFF, kind >> 16, at + 4, 4
        else:
            size, begin = int.from_bytes(data[at + 4 : at + 8], order), at + 8
            room = len(data) - begin
        if at + 8 > len(data) or size > room:
            raise ValueError(f"an element of {size} bytes ends beyond the data")
        yield kind, data[begin : begin + size]
        end = begin + size
        at = end if kind == _COMPRESSED else end + (-end % 8)  # all but compressed ones fill up to 8 bytes


def _matrix(content: bytes, order: _Order) -> np.ndarray:
    """The values as they are stored, without a copy."""
    parts = list(itertools.islice(_elements(content, order), 4))
    flags = int.from_bytes(parts[0][1][:4], order)
    kind = "complex" if flags & _COMPLEX else _CLASSES.get(flags & 0xFF, "unknown")
    if kind != "real":
        raise ValueError(f"expected a matrix of real numbers, got class {kind}")
    sign = "<" if order == "little" else ">"
    shape = np.frombuffer(parts[1][1], f"{sign}i4")
    if not 2 <= len(shape) <= _DIMENSIONS or shape.min() < 0 or len(parts) < 4 or parts[3][0] not in _NUMBERS:
        raise ValueError(f"damaged: dimensions {shape[:_DIMENSIONS].tolist()}, {len(parts)} parts")
    values = np.frombuffer(parts[3][1], sign + _NUMBERS[parts[3][0]])
    return values.reshape(shape.tolist(), order="F")
