"""The program of a chunk, which is what a device computes at once: how many runs, compiled, and whether it fits."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxlocmap._internal import batching


class Limits(NamedTuple):
    """What one device should be given. Constants, so that machines choose the same chunk for a long study."""

    working: int  # bytes that the loop of a chunk touches at every turn
    resident: int  # bytes that a chunk holds while it runs
    most: int  # runs


# Some L2 caches (a scan touches a small part of a map); an eighth of 2 GiB a core; enough runs that what it costs to
# start a kernel is little beside what it does.
CPU = Limits(working=8 * 2**20, resident=256 * 2**20, most=3000)
ACCELERATOR = Limits(working=2 * 2**30, resident=4 * 2**30, most=2**20)  # what counts there is to be wide
_LEAST = 8  # runs: the lanes of a vector register
_FEW_TURNS = 8
_PAGES = 512  # runs: where these divide a chunk, its arrays lie whole pages apart and push each other out of the cache


def limits_of(device: Any) -> Limits:
    """Those of a device; where it says how much memory it has, a chunk may hold a quarter of that."""
    if device.platform == "cpu":
        return CPU
    stats = device.memory_stats() or {}
    return ACCELERATOR._replace(resident=stats.get("bytes_limit", 4 * ACCELERATOR.resident) // 4)


def foreseen(run: OneRun, limits: Limits) -> int:
    """The most runs whose loop works inside the cache, by what the run says that its loop carries; `limits.most` where
    it says nothing.
    """
    carried = getattr(run.function, "carried", None)
    if carried is None:
        return limits.most
    key, args = jax.tree.unflatten(run.structure, run.leaves)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(jax.eval_shape(carried, key, *args)))
    return min(limits.most, limits.working // max(2 * size, 1))  # a turn reads one carry and writes the next


def even(fit: int, runs: int, devices: int) -> int:
    """The chunk where `fit` runs are the most: a multiple of 8 that depends on nothing else, unless `runs` are so few
    that `devices` would take no more than 8 turns. Then the turns are made of equal size, so that no device waits for
    a last odd chunk, and another number of runs may be another chunk, which is compiled anew.
    """
    chunk = max(fit // _LEAST, 1) * _LEAST
    turns = -(-runs // (chunk * devices))
    if turns > _FEW_TURNS:
        return chunk
    chunk = -(-runs // (turns * devices))
    return chunk + _LEAST if chunk % _PAGES == 0 else chunk


def choose(run: OneRun, runs: int, count: int, devices: tuple[Any, ...]) -> int:
    """The chunk for so many runs on `count` devices of all processes, `devices` of them here.

    What the run says is taken, compiled, and taken again smaller where the program holds more than it should: so one
    compilation does for a run that says what its loop carries, or that needs little.
    """
    limits = limits_of(devices[0])
    fit = foreseen(run, limits)
    while True:
        chunk = even(fit, runs, count)
        try:
            need = compile(run, chunk, devices).need
        except ValueError:  # more than the compiler itself takes
            need = 16 * limits.resident
        if need <= limits.resident or chunk <= _LEAST:
            return chunk
        fit = min(chunk * limits.resident // need, chunk // 2)


class OneRun(NamedTuple):
    """A run to be compiled: hashable, equal where the compiled program is the same."""

    function: Callable[..., Any]  # (key, *args) -> pytree of arrays
    keep_runs: bool  # every run's own values are wanted, not their sum
    structure: Any  # of (key, args)
    leaves: tuple[jax.ShapeDtypeStruct, ...]
    x64: bool  # JAX may compute in 64 bits

    @staticmethod
    def of(function: Callable[..., Any], keep_runs: bool, key: jax.Array, args: tuple[Any, ...]) -> OneRun:
        """For arguments like these."""
        leaves, structure = jax.tree.flatten((key, args))
        shapes = tuple(jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves)
        return OneRun(function, keep_runs, structure, shapes, jax.config.read("jax_enable_x64"))


class Traced(NamedTuple):
    """A run, traced."""

    jaxpr: Any  # of (key, whether the run is counted, *args); adds up over the axis `RUNS` where runs are not kept
    outputs: Any  # pytree of `ShapeDtypeStruct`


@functools.lru_cache(maxsize=64)
def trace(run: OneRun) -> Traced:
    """The run, traced once: its chunk is chosen from this and its program made of it.

    Raises:
        ValueError: it returns nothing.
    """
    key, args = jax.tree.unflatten(run.structure, run.leaves)

    def one(key: jax.Array, counted: jax.Array, *args: Any) -> Any:
        if run.keep_runs:
            return run.function(key, *args)
        if summed := getattr(run.function, "summed", None):
            return summed(key, counted, *args)
        return batching.sum_over_runs(jax.tree.map(_real, run.function(key, *args)), counted)

    counted = jax.ShapeDtypeStruct((), np.bool_)
    jaxpr, outputs = jax.make_jaxpr(one, axis_env=[(batching.RUNS, 1)], return_shape=True)(key, counted, *args)
    if not jaxpr.out_avals:
        raise ValueError(f"one_run: expected it to return arrays, got {outputs!r}")
    return Traced(jaxpr, outputs)


def _real(x: Any) -> jax.Array:
    return jnp.asarray(x) if jnp.issubdtype(jnp.result_type(x), jnp.inexact) else jnp.asarray(x, float)


def _chunk(run: OneRun, chunk: int) -> Callable[..., list[jax.Array]]:
    """The program of `chunk` runs: (index of the first, runs, key, args) -> arrays, as `compile` says."""
    from jax.extend.core import jaxpr_as_fun  # imports Pallas, a fifth of a second

    one_run = jaxpr_as_fun(trace(run).jaxpr)

    def compute(first: jax.Array, runs: jax.Array, key: jax.Array, args: Any) -> list[jax.Array]:
        number, shared = jnp.arange(chunk, dtype=jnp.int32), jax.tree.leaves(args)
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(first + number)
        every = jax.vmap(
            lambda key, counted: one_run(key, counted, *shared),
            axis_name=batching.RUNS,
            out_axes=0 if run.keep_runs else None,
        )(keys, number < runs - first)
        if run.keep_runs:
            return every
        widest = functools.reduce(np.promote_types, [x.dtype for x in every])
        return [jnp.concatenate([x.astype(widest).ravel() for x in every])]

    return compute


def lowered_text(run: OneRun) -> str:
    """What would be compiled for one run: its code, its settings and the shapes of its arguments."""
    key, args = jax.tree.unflatten(run.structure, run.leaves)
    index = jax.ShapeDtypeStruct((), np.int32)
    return jax.jit(_chunk(run, 1)).lower(index, index, key, args).as_text()


class Program(NamedTuple):
    """A chunk on each of some devices, compiled."""

    run: Callable[..., list[jax.Array]]  # (first run of each device's chunk, runs, key, args) -> arrays
    chunk: int
    mesh: Mesh  # the devices
    need: int  # bytes that it holds on each device while it runs; 0 where the compiler does not say

    def place(self, values: Any) -> Any:
        """Put what all runs share on the devices, once."""
        return jax.device_put(values, NamedSharding(self.mesh, P()))

    def compute(self, first: np.ndarray, *others: Any) -> list[np.ndarray]:
        """The arrays of a turn.

        Raises:
            ValueError: it does not fit into memory.
        """
        with _refused(self.chunk, self.mesh.size):
            return [np.asarray(x) for x in self.run(first, *others)]

    def check_memory(self) -> None:
        """Refuse to need more memory than there is, before it starts.

        Raises:
            ValueError: it does; the message says what it needs and what would fit.
        """
        device, devices = self.mesh.devices.flat[0], self.mesh.size
        available = _available(device)
        need = self.need * (devices if device.platform == "cpu" else 1)  # these share the machine's memory
        if available is not None and need > available:
            raise ValueError(
                f"chunk: expected one that fits into the memory, got {self.chunk} runs on each of {devices} devices, "
                f"which need about {need / 1e9:,.1f} GB of {available / 1e9:,.1f} GB; about "
                f"{int(self.chunk * available / need)} fit"
            )


@contextlib.contextmanager
def _refused(chunk: int, devices: int) -> Iterator[None]:
    """Where a device runs out of memory, the same kind of error as where that is known before.

    Raises:
        ValueError: it does.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise ValueError(
            f"chunk: expected one that fits into the memory, got {chunk} runs on each of {devices} devices: "
            f"{str(error).splitlines()[0]}"
        ) from None


@functools.lru_cache(maxsize=64)
def compile(run: OneRun, chunk: int, devices: tuple[Any, ...]) -> Program:
    """The program of `chunk` runs on each device. What it returns has a leading axis for the devices.

    Sums come as one array (devices, n) of all leaves in order, in the widest float type among them; kept runs as one
    array (devices, chunk, ...) a leaf. Runs from index `runs` on are past the end and not counted.

    Raises:
        ValueError: the compiler runs out of memory.
    """
    compute = _chunk(run, chunk)
    key, args = jax.tree.unflatten(run.structure, run.leaves)

    def on_device(first: jax.Array, *others: Any) -> list[jax.Array]:
        return [x[None] for x in compute(first[0], *others)]

    mesh = Mesh(np.array(devices), ("devices",))
    # Unchecked, so that a run may use constants without a thought of which values differ between devices.
    sharded = jax.shard_map(
        on_device, mesh=mesh, in_specs=(P("devices"), P(), P(), P()), out_specs=P("devices"), check_vma=False
    )
    first, runs = jax.ShapeDtypeStruct((len(devices),), np.int32), jax.ShapeDtypeStruct((), np.int32)
    with _refused(chunk, len(devices)):
        compiled = jax.jit(sharded).lower(first, runs, key, args).compile()
    sizes = compiled.memory_analysis()
    need = sizes.temp_size_in_bytes + sizes.output_size_in_bytes + sizes.argument_size_in_bytes if sizes else 0
    return Program(compiled, chunk, mesh, need)


def _available(device: Any) -> int | None:
    """Bytes that are free for a program, if the system says."""
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0) if "bytes_limit" in stats else None
    try:
        free = [int(line.split()[1]) * 1024 for line in _lines("/proc/meminfo") if line.startswith("MemAvailable:")]
        return min([*free, *_container()]) if free else os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, AttributeError):  # a system that does not say
        return None


def _container() -> list[int]:
    """Bytes left to the control groups this process is in, where they are limited (containers, Slurm)."""
    group = next((line.partition("::")[2] for line in _lines("/proc/self/cgroup") if line.startswith("0::")), "/")
    left = []
    for folder in {Path("/sys/fs/cgroup"), Path(f"/sys/fs/cgroup{group}")}:
        limit, used = _lines(f"{folder}/memory.max"), _lines(f"{folder}/memory.current")
        if limit and used and limit[0] != "max":
            left.append(int(limit[0]) - int(used[0]))
    return left


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text().splitlines()
    except OSError:
        return []
