"""Compiled programs kept on disk for the next start, and how long tracing and compiling took.

JAX looks a program up by its code, its options, the version of the compiler and the devices; that of a CPU says nothing
of its instructions, so each kind of processor has a folder of its own here. An entry that cannot be read is compiled
anew, and JAX warns of it. Of several processes that share the work the first one writes. See docs.jax.dev, "Persistent
compilation cache".
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock
import jax
import platformdirs

_CPUINFO = Path("/proc/cpuinfo")  # where the system has one
_MOST_BYTES = 2**28  # of a folder; what was used longest ago goes first
_COMPILED, _KEPT = "/jax/core/compile/backend_compile_duration", "/jax/compilation_cache/cache_hits"
_PHASES = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    _COMPILED: "compiling",
}


def keep_on_disk(keep: bool = True) -> None:
    """Have JAX keep every program it compiles, in the user's cache folder or where JAX_COMPILATION_CACHE_DIR says.

    A folder that cannot be found or written is no error: then each start compiles.

    Args:
        keep: or not to use what is kept there either.
    """
    jax.config.update("jax_enable_compilation_cache", keep)
    if not keep:
        return
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    if not folder_in_use():
        try:
            folder = platformdirs.user_cache_path("jaxlocmap") / f"jax-{jax.__version__}-{_processor()}"
            folder.mkdir(parents=True, exist_ok=True)
            _clear_what_was_not_finished(folder)
        except (OSError, RuntimeError):  # the latter where the system knows no home
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)


def _clear_what_was_not_finished(folder: Path) -> None:
    """Delete entries of starts that ended while they wrote one. JAX writes a program and then when it was used; what
    lacks either may be cut short, and stops JAX from keeping more.

    Raises:
        OSError: the folder cannot be written, or somebody holds its lock.
    """
    with filelock.FileLock(folder / ".lockfile", timeout=1):  # the one JAX takes
        for last, other in (("-cache", "-atime"), ("-atime", "-cache")):
            for file in folder.glob(f"*{last}"):
                if not file.with_name(file.name.removesuffix(last) + other).exists():
                    file.unlink()


def folder_in_use() -> str | None:
    """Where compiled programs are kept, if they are."""
    values = jax.config.values
    return values["jax_compilation_cache_dir"] if values["jax_enable_compilation_cache"] else None


def _processor() -> str:
    """A name for the instructions of this machine's processor."""
    try:
        lines = _CPUINFO.read_text().splitlines()
    except OSError:
        lines = [platform.processor()]
    told = {line for line in lines if line.startswith(("flags", "Features", "model name"))} or set(lines[:1])
    return hashlib.sha256("\n".join([platform.machine(), *sorted(told)]).encode()).hexdigest()[:12]


class Spent:
    """What JAX says of its tracing and compiling."""

    def __init__(self) -> None:
        self._spans: dict[str, list[tuple[float, float]]] = {phase: [] for phase in _PHASES.values()}
        self.programs: int = 0
        self.kept: int = 0  # of them, compiled by an earlier start

    def on_span(self, event: str, start_time: float, end_time: float, **kwargs: str | int) -> None:
        """Called by JAX; a span that lies in another, as of a function called while tracing, is part of it."""
        del kwargs
        if event in _PHASES:
            spans = self._spans[_PHASES[event]]
            spans[:] = [*(span for span in spans if span[0] < start_time), (start_time, end_time)]
            self.programs += event == _COMPILED

    def on_event(self, event: str, **kwargs: str | int) -> None:
        """Called by JAX."""
        del kwargs
        self.kept += event == _KEPT

    def seconds(self) -> dict[str, float]:
        """Of each phase."""
        return {phase: sum(end - begin for begin, end in spans) for phase, spans in self._spans.items()}

    def words(self) -> str:
        """A sentence."""
        seconds = ", ".join(f"{phase} {value:.1f} s" for phase, value in self.seconds().items())
        cache = folder_in_use()
        if not cache:
            return seconds
        kept = f"{self.kept} of {self.programs} programs for the processor were compiled before"
        return f"{seconds}; {kept}, in {cache} (--no-cache compiles anew)"


@contextmanager
def watched() -> Iterator[Spent]:
    """Listen to what JAX says of its tracing and compiling."""
    spent = Spent()
    jax.monitoring.register_event_time_span_listener(spent.on_span)
    jax.monitoring.register_event_listener(spent.on_event)
    try:
        yield spent
    finally:
        jax.monitoring.unregister_event_time_span_listener(spent.on_span)
        jax.monitoring.unregister_event_listener(spent.on_event)
