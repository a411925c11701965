"""Compiled programs kept on disk for the next start, and how long tracing and compiling took.

JAX looks a program up by its code, its options, the version of the compiler and the devices; that of a CPU says nothing
of its instructions, so each kind of processor has a folder of its own here. An entry that cannot be read is compiled
anew. See jax.dev, "Persistent compilation cache".
"""

from __future__ import annotations

import hashlib
import platform
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import platformdirs

_CPUINFO = Path("/proc/cpuinfo")  # where the system has one
_MOST_BYTES = 2**30  # of a folder; what was used longest ago goes first
_COMPILED, _KEPT = "/jax/core/compile/backend_compile_duration", "/jax/compilation_cache/cache_hits"
_PHASES = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    _COMPILED: "compiling",
}


def keep_on_disk() -> None:
    """Have JAX keep every program it compiles, in the user's cache folder or where JAX_COMPILATION_CACHE_DIR says.

    A folder that cannot be written is no error: then each start compiles.
    """
    if folder_in_use() is None:
        folder = platformdirs.user_cache_path("jaxlocmap") / f"jax-{jax.__version__}-{_processor()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", _MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    # JAX warns of an entry that it cannot read or write, and compiles.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")


def folder_in_use() -> str | None:
    """Where compiled programs are kept, if they are."""
    return jax.config.values["jax_compilation_cache_dir"]


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
        where = f"in {cache} from earlier starts (--no-cache compiles anew)" if cache else "on disk"
        return f"{seconds}; {self.kept} of {self.programs} programs were found {where}"


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
