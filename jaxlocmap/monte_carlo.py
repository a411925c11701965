"""The map over runs: in chunks, over all local devices, returning sums."""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P


class Result(NamedTuple):
    """What came of a study."""

    value: Any  # pytree of float64 NumPy arrays: sums over runs, or every run's own along axis 0
    compile_s: float  # s; 0 where the program was compiled before
    run_s: float  # s


def use_all_cores() -> int:
    """One JAX device per processor core of this machine, if JAX has not started yet.

    Call it before anything else touches JAX: once JAX has started, its devices are settled and stay as they are.

    Returns:
        The number of local devices; those of an accelerator where JAX has one.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(RuntimeError):  # started already
        jax.config.update("jax_num_cpu_devices", cores)
    return jax.local_device_count()


def monte_carlo(
    one_run: Callable[..., Any],
    key: jax.Array,
    runs: int,
    *args: Any,
    chunk: int = 256,
    keep_runs: bool = False,
    devices: Sequence[Any] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Run a simulation many times and add up what it returns.

    The randomness of run i depends on `key` and i alone, not on the chunk or the device it falls into.

    Args:
        one_run: `(key, *args) -> pytree of arrays`. Hashable and equal by value (a function, or an instance of a
            frozen dataclass), so that the same study is compiled once.
        key: of the whole study. runs: how many, >= 1.
        *args: pytrees of arrays handed to every run: parameters, the world. Changing their values compiles nothing.
        chunk: runs per device and turn. Memory grows with it, not with `runs`.
        keep_runs: return each run's own values instead of their sums.
        devices: of `jax.local_devices()`, all by default.
        progress: called with the number of runs done after each chunk.

    Returns:
        `Result`. Sums are taken in the runs' own precision (integers as floats) within a chunk and in float64 across
        chunks.

    Raises:
        ValueError: `runs` or `chunk` below 1, or no device.
        TypeError: a key that is none.
    """
    for name, value in (("runs", runs), ("chunk", chunk)):
        if int(value) != value or value < 1:
            raise ValueError(f"{name}: expected at least 1, a whole number, got {value}")
    if not hasattr(key, "dtype"):
        raise TypeError(f"key: expected one made by jax.random.key, got {key!r}")
    devices = tuple(jax.local_devices() if devices is None else devices)
    if not devices:
        raise ValueError("devices: expected at least one, got none")
    chunk = min(chunk, -(-runs // len(devices)))
    width = chunk * len(devices)

    args = jax.tree.map(jnp.asarray, args)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (key, args))
    leaves, structure = jax.tree.flatten(shapes)
    before = _compiled.cache_info().misses
    program, seconds = _compiled(one_run, chunk, keep_runs, devices, structure, tuple(leaves))
    compile_s = seconds if _compiled.cache_info().misses > before else 0.0

    began = time.perf_counter()
    parts: list[Any] = []
    for start in range(0, runs, width):
        index = np.arange(start, start + width, dtype=np.int32)
        part = jax.tree.map(np.asarray, program(index, np.int32(runs), key, args))
        if keep_runs or not parts:
            parts.append(part)
        else:
            parts[0] = jax.tree.map(_add, parts[0], part)
        if progress is not None:
            progress(min(start + width, runs))
    if keep_runs:
        value = jax.tree.map(lambda *chunks: np.concatenate(chunks)[:runs], *parts)
    else:
        value = jax.tree.map(lambda x: np.asarray(x, np.float64), parts[0])
    return Result(value, compile_s, time.perf_counter() - began)


def _add(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.add(a, b, dtype=np.float64)


@functools.lru_cache(maxsize=64)
def _compiled(
    one_run: Callable[..., Any],
    chunk: int,
    keep_runs: bool,
    devices: tuple[Any, ...],
    structure: Any,
    leaves: tuple[jax.ShapeDtypeStruct, ...],
) -> tuple[Callable[..., Any], float]:
    """The program of one chunk over all devices, and the seconds it took to compile."""

    def on_device(index: jax.Array, runs: jax.Array, key: jax.Array, args: Any) -> Any:
        each = jax.vmap(lambda i: one_run(jax.random.fold_in(key, i), *args))(index)
        if keep_runs:
            return each
        live = index < runs  # the last chunk runs past the end

        def total(x: jax.Array) -> jax.Array:
            weight = live.reshape(-1, *[1] * (x.ndim - 1))
            x = x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)
            return jax.lax.psum(jnp.sum(jnp.where(weight, x, jnp.zeros_like(x)), axis=0), "runs")

        return jax.tree.map(total, each)

    mesh = Mesh(np.array(devices), ("runs",))
    # Unchecked, so that `one_run` may use constants without a thought of which values differ between devices.
    sharded = jax.shard_map(
        on_device,
        mesh=mesh,
        in_specs=(P("runs"), P(), P(), P()),
        out_specs=P("runs") if keep_runs else P(),
        check_vma=False,
    )
    began = time.perf_counter()
    index = jax.ShapeDtypeStruct((chunk * len(devices),), np.int32)
    key, args = jax.tree.unflatten(structure, leaves)
    program = jax.jit(sharded).lower(index, jax.ShapeDtypeStruct((), np.int32), key, args).compile()
    return program, time.perf_counter() - began
