"""The program of a chunk, which is what a device computes at once: how many runs, compiled, and whether it fits."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun, jaxprs_in_params
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxlocmap import batching


class Limits(NamedTuple):
    """What one device should be given. Constants, so that machines choose the same chunk for a long study."""

    working: int  # bytes that the loops of a chunk touch at every turn
    resident: int  # bytes that a chunk holds for as long as it runs
    most: int  # runs


# Some L2 caches (a scan touches a small part of a map); an eighth of 2 GiB a core; enough runs that what it costs to
# start a kernel is little beside what it does.
CPU = Limits(working=8 * 2**20, resident=256 * 2**20, most=3000)
ACCELERATOR = Limits(working=2 * 2**30, resident=4 * 2**30, most=2**16)  # what counts there is to be wide
_LEAST = 8  # runs: the lanes of a vector register
_FEW_TURNS = 8
_PAGES = 512  # runs: where these divide a chunk, its arrays lie whole pages apart and push each other out of the cache


class RunBytes(NamedTuple):
    """What one run needs, by its shapes alone: before the compiler fuses anything."""

    working: int  # carry of the hungriest loop and the largest value its body makes; without loops, the largest value
    resident: int  # most that is alive at once outside loops, the stacked results of loops among it


def run_bytes(jaxpr: Any) -> RunBytes:
    """Bytes of one run, from its `ClosedJaxpr`."""
    largest, loop, peak = _walk(jaxpr)
    return RunBytes(loop or largest, peak)


def _walk(jaxpr: Any) -> tuple[int, int, int]:
    """Bytes of the largest value, of the hungriest loop, and of all values alive at once outside loops."""
    jaxpr = getattr(jaxpr, "jaxpr", jaxpr)
    last = {id(used): k for k, equation in enumerate(jaxpr.eqns) for used in equation.invars}
    last |= {id(result): len(jaxpr.eqns) for result in jaxpr.outvars}
    dying: dict[int, int] = {}  # bytes that are used for the last time by an equation
    summed = _summed(jaxpr)
    largest = loop = alive = peak = 0
    for k, equation in enumerate(jaxpr.eqns):
        made = {
            id(out): 0 if id(out) in summed else math.prod(out.aval.shape) * out.aval.dtype.itemsize
            for out in equation.outvars
        }
        inside = [_walk(inner) for inner in jaxprs_in_params(equation.params)]
        if equation.primitive.name in ("scan", "while"):
            carry = sum(list(made.values())[: equation.params.get("num_carry")])  # of a `while`, all it makes
            loop = max([loop, *(carry + max(inner[:2]) for inner in inside)])
            inside = []
        largest = max([largest, *made.values(), *(inner[0] for inner in inside)])
        loop = max([loop, *(inner[1] for inner in inside)])
        peak = max([peak, alive + sum(made.values()), *(alive + inner[2] for inner in inside)])
        for out, size in made.items():
            if out in last:
                dying[last[out]] = dying.get(last[out], 0) + size
                alive += size
        alive -= dying.pop(k, 0)
    return largest, loop, peak


def _summed(jaxpr: Any) -> set[int]:
    """The values that are sums over the runs of a chunk, so that a run has no part in their bytes."""
    summed = set[int]()
    for equation in jaxpr.eqns:
        if equation.primitive.name == "psum":
            summed |= {id(out) for out in equation.outvars}
        if equation.primitive.name == "scan":
            body = equation.params["jaxpr"].jaxpr
            inside = _summed(body)
            stacked = zip(equation.outvars, body.outvars, strict=True)
            summed |= {id(out) for out, within in stacked if id(within) in inside}
    return summed


def from_shapes(jaxpr: Any, runs: int, devices: int, platform: str) -> int:
    """The chunk for a run that is traced to `jaxpr`.

    A multiple of 8 whose loops work inside the cache and whose values take little of the memory. It depends on the
    shapes and on whether the device is a CPU alone, unless `runs` are so few that `devices` would take no more than 8
    turns: then the turns are made of equal size, so that no device waits for a last odd chunk, and another number of
    runs may be another chunk, which is compiled anew.
    """
    limits = CPU if platform == "cpu" else ACCELERATOR
    need = run_bytes(jaxpr)
    fit = min(limits.most, limits.working // max(need.working, 1), limits.resident // max(need.resident, 1))
    chunk = max(fit // _LEAST, 1) * _LEAST
    turns = -(-runs // (chunk * devices))
    if turns > _FEW_TURNS:
        return chunk
    chunk = -(-runs // (turns * devices))
    return chunk + _LEAST if chunk % _PAGES == 0 else chunk


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

    compute: Callable[..., list[jax.Array]]  # (first run of each device's chunk, runs, key, args) -> arrays
    mesh: Mesh  # the devices

    def place(self, values: Any) -> Any:
        """Put what all runs share on the devices, once."""
        return jax.device_put(values, NamedSharding(self.mesh, P()))


@functools.lru_cache(maxsize=64)
def compile(run: OneRun, chunk: int, devices: tuple[Any, ...]) -> Program:
    """The program of `chunk` runs on each device. What it returns has a leading axis for the devices.

    Sums come as one array (devices, n) of all leaves in order, in the widest float type among them; kept runs as one
    array (devices, chunk, ...) a leaf. Runs from index `runs` on are past the end and not counted.

    Raises:
        ValueError: it does not fit into memory.
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
    compiled = jax.jit(sharded).lower(first, runs, key, args).compile()
    check_memory(compiled, chunk, devices)
    return Program(compiled, mesh)


def check_memory(compiled: Any, chunk: int, devices: Sequence[Any]) -> None:
    """Refuse a program that needs more memory than there is, before it starts.

    Args:
        compiled: of `chunk` runs on each of `devices`.

    Raises:
        ValueError: it does not fit; the message says what it needs and what would fit.
    """
    analysis, available = compiled.memory_analysis(), _available(devices[0])
    if analysis is None or available is None:
        return
    need = analysis.temp_size_in_bytes + analysis.output_size_in_bytes + analysis.argument_size_in_bytes
    if devices[0].platform == "cpu":  # the devices share the machine's memory
        need *= len(devices)
    if need > available:
        raise ValueError(
            f"chunk: expected one that fits into the memory, got {chunk} runs on each of {len(devices)} devices, which "
            f"need about {need / 1e9:,.1f} GB of {available / 1e9:,.1f} GB; about {int(chunk * available / need)} fit"
        )


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
