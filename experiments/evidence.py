"""The tables of the README, between the marks that name them."""

from __future__ import annotations

from pathlib import Path

from jaxlocmap import files

_README = Path(__file__).parent.parent / "README.md"


def replace_table(name: str, table: str) -> None:
    """Put a table in the place of the one of that name.

    Raises:
        ValueError: there is none.
    """
    begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
    head, found, rest = _README.read_text().partition(begin)
    _, ended, tail = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"{_README}: expected the marks {begin.strip()} and {end}")
    files.write(_README, head + begin + table + "\n" + end + tail)
