"""The tables of the README and of the page of evidence, between the marks that name them."""

from __future__ import annotations

from pathlib import Path

from jaxlocmap import files

_PAGES = (Path(__file__).parent / "README.md", Path(__file__).parent.parent / "README.md")


def replace_table(name: str, table: str) -> None:
    """Put a table in the place of the one of that name, on the page that has it.

    Raises:
        ValueError: none has.
    """
    begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
    for page in _PAGES:
        head, found, rest = page.read_text().partition(begin)
        _, ended, tail = rest.partition(end)
        if found and ended:
            files.write(page, head + begin + table + "\n" + end + tail)
            return
    raise ValueError(f"{' or '.join(map(str, _PAGES))}: expected the marks {begin.strip()} and {end}")
