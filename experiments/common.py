"""What every program shares: the command line, the output folder, progress, tables and the report."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shlex
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from jaxlocmap import Params, files, simulation
from jaxlocmap.monte_carlo import Result, hosts, monte_carlo
from jaxlocmap.monte_carlo.checkpoint import Checkpoint

_README = Path(__file__).parent.parent / "README.md"
# A path or a name may hold what looks like markup.
CONSOLE = Console(width=min(100, Console().width) if sys.stdout.isatty() else 100, markup=False, highlight=False)


@dataclasses.dataclass(frozen=True)
class ComputeConfig:
    """Where and how it is computed; the results do not depend on it, but for rounding."""

    chunk: int | None = None
    """Runs that one device computes at once; chosen by default, so that they stay in its cache."""
    devices: int | None = None
    """How many of this machine's processor cores (or accelerators, where there are any) to use; all by default."""
    resume: bool = False
    """Go on with the study that was stopped in the folder --out."""
    discard: bool = False
    """Start anew where a study was stopped in the folder --out, and lose its finished runs."""
    distributed: bool = False
    """Share the work with other processes; a job of Slurm, Kubernetes or Open MPI needs no more than this."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where there is no such job; then also --processes and --process-id."""
    processes: int | None = None
    """How many processes share the work."""
    process_id: int | None = None
    """Which of them this one is, from 0."""


def command_line(main: Callable[[Any], Any], config: type) -> None:
    """Read `config` from the command line and run `main`; a mistake of the user's is one line, not a traceback."""
    try:
        main(tyro.cli(config, description=sys.modules[main.__module__].__doc__))
    except (ValueError, TypeError, OverflowError, OSError) as error:
        _leave(1, f"error: {error}")
    except KeyboardInterrupt as stop:
        _leave(130, "; ".join(["stopped", *map(str, stop.args)]))


def _leave(status: int, last_words: str) -> NoReturn:
    print(last_words, file=sys.stderr, flush=True)
    if jax.distributed.is_initialized() or threading.active_count() > 1:
        os._exit(status)  # JAX would wait minutes for the other processes, or crash under a thread that does
    sys.exit(status)


def start(config: ComputeConfig) -> None:
    """Set up JAX's devices and processes, before anything else touches it. Only process 0 speaks from here on.

    Raises:
        ValueError, OSError: as `hosts.join` and `hosts.use_all_cores`.
    """
    hosts.merge_kernels()
    given = (config.coordinator, config.processes, config.process_id)
    if config.distributed or given != (None, None, None):
        hosts.join(*given)
    devices = hosts.use_all_cores(config.devices)
    CONSOLE.quiet = jax.process_index() > 0
    platform = jax.devices()[0].platform
    others = f" in each of {jax.process_count()} processes" if jax.process_count() > 1 else ""
    CONSOLE.print(f"computing on {devices} {platform} device(s){others}; compiling takes some seconds")
    if others:
        CONSOLE.print("if one of them dies, JAX aborts all with a C++ stack: what they finished is kept, see --resume")


def study_checkpoint(out: Path, config: ComputeConfig, settings: Mapping[str, Any]) -> Checkpoint:
    """Where in the output folder a study with these settings keeps its finished parts."""
    return Checkpoint(
        out,
        settings,
        resume=config.resume,
        discard=config.discard,
        say=lambda sentence: CONSOLE.print(sentence, soft_wrap=True),
    )


def study(one_run: Any, key: jax.Array, runs: int, *args: Any, config: ComputeConfig, checkpoint: Checkpoint) -> Result:
    """`monte_carlo` under a bar. Ctrl-C stops it after the turn under way, a second Ctrl-C at once.

    Raises:
        KeyboardInterrupt: it was stopped; says what is kept, if anything.
    """
    try:
        with progress_bar("simulating", runs) as bar, _stopped_by_ctrl_c(bar) as progress:
            devices = jax.local_devices()[: config.devices]
            return monte_carlo(
                one_run, key, runs, *args, chunk=config.chunk, devices=devices, progress=progress, checkpoint=checkpoint
            )
    except KeyboardInterrupt:
        if not checkpoint.runs_kept:
            raise
        again = shlex.join([*sys.orig_argv, *([] if "--resume" in sys.argv else ["--resume"])])
        kept = f"{checkpoint.runs_kept:,} of {runs:,} runs are kept in {checkpoint.folder}"
        raise KeyboardInterrupt(f"{kept}; go on with\n{again}") from None


def how_computed(result: Result, runs: int, began: float, per_run: int = 1) -> dict[str, Any]:
    """What a report says of the computation.

    Args:
        began: of `time.perf_counter`. per_run: how many runs of a filter each of the `runs` stands for.
    """
    return {
        "chunk": result.chunk,
        "devices": result.devices,
        "processes": result.processes,
        "resumed_runs": result.resumed_runs,
        "wall_s": time.perf_counter() - began,
        "compile_s": result.compile_s,
        "runs_per_s": (runs - result.resumed_runs) * per_run / result.run_s,
    }


def finish(checkpoint: Checkpoint) -> None:
    """Clear the parts of a study whose report is written, by whichever process."""
    hosts.in_turn(checkpoint.clear)  # process 0 first, which has written the report by then


@contextmanager
def _stopped_by_ctrl_c(progress: Callable[[int], None]) -> Iterator[Callable[[int], None]]:
    stop = False

    def on_ctrl_c(*_: Any) -> None:
        nonlocal stop
        stop = True
        signal.signal(signal.SIGINT, before)
        CONSOLE.print("stopping after this turn; Ctrl-C again stops at once")

    def move(done: int) -> None:
        progress(done)
        if stop:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, on_ctrl_c)
    try:
        yield move
    finally:
        signal.signal(signal.SIGINT, before)


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


def scenario_of(name: str) -> simulation.Scenario:
    """The scenario of that name.

    Raises:
        ValueError: there is none.
    """
    if name not in simulation.SCENARIOS:
        raise ValueError(f"scenario: expected one of {sorted(simulation.SCENARIOS)}, got {name!r}")
    return simulation.SCENARIOS[name]


def scenario_world(scenario: simulation.Scenario) -> simulation.World:
    """What stands around the robot of a scenario."""
    buildings = simulation.BUILDING.name, simulation.RANDOM_BUILDING.name
    return simulation.building() if scenario.name in buildings else simulation.room()


EXACT = (1e-3, 1e-3, 1e-3)  # m, m, rad
GAP = 0.8  # m: `Matcher.gap` for the course's 61 beams, whose ends lie far apart


def with_known_start(scenario: simulation.Scenario) -> simulation.Scenario:
    """The scenario of a robot whose filter knows the start, to `EXACT`."""
    return dataclasses.replace(scenario, exact_prior=False, prior_std=EXACT)


def check_gate(gate: float | None, name: str = "gate") -> None:
    """Raise unless this is what a gate can let in.

    Raises:
        ValueError: no probability inside (0, 1).
    """
    if gate is not None and not 0 < gate < 1:
        raise ValueError(f"{name}: expected a probability inside (0, 1), or None for no gate, got {gate}")


def params_or(path: Path | None, default: Params) -> Params:
    """The parameters in a file, or the default."""
    return default if path is None else Params.load(path)


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar that is moved by calling with the number done so far."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=CONSOLE, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def in_pieces(
    turn: Callable[[Any, Any], tuple[Any, Any]], state: Any, inputs: Any, steps: int, size: int, what: str
) -> tuple[Any, Any]:
    """A scan over time in equal pieces, so that a bar can move.

    Args:
        turn: (state, inputs of a piece) -> (state, what it reports of each step).
        inputs: of all steps and those that fill up the last piece.
        steps: how many count.

    Returns:
        The last state, and the reports of the steps that count, as NumPy arrays.
    """
    reports = []
    with progress_bar(what, steps) as progress:
        for begin in range(0, steps, size):
            state, report = turn(state, jax.tree.map(lambda x, begin=begin: x[begin : begin + size], inputs))
            reports.append(jax.tree.map(np.asarray, report))
            progress(min(begin + size, steps))
    return state, jax.tree.map(lambda *pieces: np.concatenate(pieces)[:steps], *reports)


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


def replace_table(name: str, table: str) -> None:
    begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->"
    head, found, rest = _README.read_text().partition(begin)
    _, ended, tail = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"{_README}: expected the marks {begin.strip()} and {end}")
    files.write(_README, head + begin + table + "\n" + end + tail)
