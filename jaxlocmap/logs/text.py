"""Opening plain or gzipped files and parsing columns of numbers, with errors that name path and line."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from jaxlocmap import files

# m, s or rad: nothing that a robot measures is larger, and the squares of what is are of no use.
LARGEST = 1e12
_LONGEST_LINE = 2**20  # bytes: a scan of 100,000 beams


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file, unpacked if it starts like gzip, whatever its name.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: a folder, an empty file, a truncated or damaged gzip, or more than `files.most_bytes`.
    """
    data = files.read(path)
    if data.startswith(b"\x1f\x8b"):
        data = files.unzipped(path, data)
    if not data:
        raise ValueError(f"{path}: the file is empty")
    return data


def lines(path: str | Path) -> Iterator[tuple[int, str]]:
    """Yield (line number from 1, stripped line) for each line that is neither blank nor a `#` comment.

    Byte-order marks are no part of a line; UTF-16 text with one is read like any other.

    Raises:
        FileNotFoundError, ValueError: as `read_bytes`; ValueError also for a file with zero bytes in it, and for a line
            of more than a mebibyte.
    """
    data = read_bytes(path)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data[: len(data) // 2 * 2].decode("utf-16").encode()
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise ValueError(f"{path}:{line}: expected text, got binary data")
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    number, end = 1, 0
    for match in re.finditer(rb"[^\n]+", data):  # megabytes of blank lines are passed over at once
        number += data.count(b"\n", end, match.start())
        raw, end = match[0], match.end()
        if len(raw) > _LONGEST_LINE:
            raise ValueError(f"{path}:{number}: expected lines of at most {_LONGEST_LINE:,} bytes, got {len(raw):,}")
        # Latin-1 takes any byte: old logs have comments in unknown encodings, and numbers are ASCII.
        line = raw.removeprefix(codecs.BOM_UTF8).decode("latin-1").strip()
        if line and not line.startswith("#"):
            yield number, line


def numbers(fields: Sequence[str], names: Sequence[str], where: str, *, finite: bool = True) -> list[float]:
    """Parse as many fields as names.

    Raises:
        ValueError: another number of fields, or one that is no number or (with `finite`) not finite or larger
            than 1e12 in size; the message starts with `where` and gives the column's name.
    """
    if len(fields) != len(names):
        listed = ", ".join(names if len(names) <= 10 else [*names[:3], "...", names[-1]])
        raise ValueError(f"{where}: expected {len(names)} columns ({listed}), got {len(fields)}")
    return [_number(*pair, where, finite) for pair in zip(names, fields, strict=True)]


def _number(name: str, field: str, where: str, finite: bool) -> float:
    try:
        value = float(field) if field.isascii() and "_" not in field else None  # Python reads 2_5 as 25
    except ValueError:
        value = None
    if value is None or (finite and not math.isfinite(value)):
        kind = "a finite number" if finite else "a number"
        raise ValueError(f"{where}: {name}: expected {kind}, got {field[:40]!r}")
    if finite and abs(value) > LARGEST:
        kind = f"a number of a size up to {LARGEST:g}"
        raise ValueError(f"{where}: {name}: expected {kind}, got {field[:40]!r}")
    return value


def whole(name: str, field: str, where: str, *, least: int) -> int:
    """Parse a whole number that is not negative, in ASCII digits.

    Raises:
        ValueError: something else, or one below `least`; the message starts with `where` and gives the name.
    """
    digits = field.isascii() and field.isdecimal() and len(field) < 10
    if not digits or int(field) < least:
        raise ValueError(f"{where}: {name}: expected a whole number >= {least}, got {field[:40]!r}")
    return int(field)


def table(path: str | Path, names: Sequence[str], *, integer: Collection[str] = ()) -> np.ndarray:
    """Read white-space separated columns of finite numbers as (rows, len(names)) float64.

    Args:
        path: plain or gzipped text; blank lines and lines that start with `#` are skipped.
        names: of the columns, for the messages.
        integer: names of the columns that must hold whole numbers.

    Raises:
        FileNotFoundError, ValueError: as `lines`; ValueError also for a line with missing, extra or
            non-numeric columns (path and line) and for a file without rows.
    """
    rows = []
    for number, line in lines(path):
        where = f"{path}:{number}"
        row = numbers(line.split(), names, where)
        for name, value in zip(names, row, strict=True):
            if name in integer and not value.is_integer():
                raise ValueError(f"{where}: {name}: expected a whole number, got {value}")
        rows.append(np.array(row))
    if not rows:
        raise ValueError(f"{path}: no rows of {', '.join(names)}: only blank lines and comments")
    return np.array(rows, np.float64)
