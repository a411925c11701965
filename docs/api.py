"""Pages of the library's docstrings: `python docs/api.py out/api`. Whatever pdoc warns of is an error."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import typing
import warnings
from pathlib import Path

import pdoc.render
from pdoc.extract import walk_specs

import jaxlocmap


def main(folder: Path) -> None:
    """Write the pages into a folder."""
    warnings.simplefilter("error")
    names = [found.name for found in pkgutil.walk_packages(jaxlocmap.__path__, "jaxlocmap.") if "._" not in found.name]
    for name in names:
        _evaluate_records(importlib.import_module(name))
    pages = ["jaxlocmap"]
    for name in names:  # pdoc leaves out those that a package does not list in `__all__`
        if name not in walk_specs(pages):
            pages.append(name)
    pdoc.render.configure(docformat="google")
    pdoc.pdoc(*pages, output_directory=folder)
    print(f"wrote {len(list(folder.rglob('*.html')))} pages to {folder}")


def _evaluate_records(module: object) -> None:
    """Evaluate the annotations of its NamedTuples, which pdoc takes from a function that knows no module."""
    for record in vars(module).values():
        if isinstance(record, type) and issubclass(record, tuple) and hasattr(record, "_fields"):
            record.__new__.__annotations__ = typing.get_type_hints(record)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/api"))
