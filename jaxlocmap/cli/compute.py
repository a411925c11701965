"""Where a study is computed: devices, processes, and the parts it can be resumed from."""

from __future__ import annotations

import dataclasses
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax

from jaxlocmap.cli.console import CONSOLE, progress_bar
from jaxlocmap.monte_carlo import Result, hosts, monte_carlo
from jaxlocmap.monte_carlo.checkpoint import Checkpoint


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
