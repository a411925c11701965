"""What a program says and writes: progress, tables, the output folder and the report."""

from __future__ import annotations

import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from jaxlocmap import files

# A path or a name may hold what looks like markup.
CONSOLE: Console = Console(
    width=min(100, Console().width) if sys.stdout.isatty() else 100, markup=False, highlight=False
)


def output_folder(path: Path) -> Path:
    """Make the folder, before anything is computed, and see that it can be written.

    Raises:
        OSError: it cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()  # under a name that nobody else has
    except OSError as error:
        raise OSError(f"out: expected a folder that can be written, got {path}: {error.strerror}") from None
    return path


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar that is moved by calling with the number done so far."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=CONSOLE, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def write_report(folder: Path, report: dict[str, Any]) -> None:
    """`report.json`; a number that is not finite becomes null, which is what JSON has for it."""
    files.write(folder / "report.json", json.dumps(_plain(report), indent=1, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def show(title: str, rows: list[tuple[str, str, str]]) -> None:
    """A table of quantity, measured, and what a consistent filter gives, if any row says so."""
    headers = (
        ["quantity", "measured", "a consistent filter"] if any(row[2] for row in rows) else ["quantity", "measured"]
    )
    table = Table(*headers, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row[: len(headers)])
    CONSOLE.print(table)


def count_rows(counts: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """Rows of what a reader dropped or mended; those of nothing are left to the report."""
    return [
        (f"dropped or mended in the log: {name.replace('_', ' ')}", str(count), "")
        for name, count in counts.items()
        if count
    ]


def saved(folder: Path, *names: str) -> None:
    """Say what was written, and where."""
    CONSOLE.print(f"wrote {', '.join(names)} to {folder}", soft_wrap=True)
