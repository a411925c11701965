"""The map over runs: in chunks, over all devices of all processes, returning sums."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.monte_carlo import chunks, hosts
from jaxlocmap.monte_carlo.checkpoint import Checkpoint
from jaxlocmap.monte_carlo.hosts import use_all_cores
from jaxlocmap.monte_carlo.plan import Plan, manifest

__all__ = ["Result", "monte_carlo", "use_all_cores"]

_Arrays = tuple[np.ndarray, ...]  # of a chunk, a part or a study: its sums as one vector, or the leaves of its runs


class Result(NamedTuple):
    """What came of a study."""

    value: Any  # pytree of NumPy arrays: sums over runs in float64, or every run's own along axis 0, as it gave them
    chunk: int  # runs that a device computed at once
    devices: int  # of all processes together
    processes: int
    resumed_runs: int  # that were finished before
    compile_s: float  # s, tracing included; 0 where the program was compiled before
    run_s: float  # s


def monte_carlo(
    one_run: Callable[..., Any],
    key: jax.Array,
    runs: int,
    *args: Any,
    chunk: int | None = None,
    keep_runs: bool = False,
    devices: Sequence[Any] | None = None,
    progress: Callable[[int], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Result:
    """Run a simulation many times and add up what it returns.

    The randomness of run i depends on `key` and i alone. A device computes a chunk of consecutive runs and adds them
    up in the runs' own precision (integers as floats), which is what devices are fast in; the host adds up the chunks
    in float64, always in the same order. So for one and the same `chunk` the totals are the same to the last bit, on
    however many devices, in however many processes, interrupted or not. Another chunk changes the order of the
    additions, and so the last digits of the runs' precision.

    In several processes (`hosts.join`) each computes its share on its own, and all return the whole.

    Args:
        one_run: `(key, *args) -> pytree of arrays`. Hashable and equal by value (a function, or an instance of a frozen
            dataclass), so that the same study is compiled once. It may have a method `summed(key, counted, *args)` that
            returns the sum over the runs that are counted, by `batching.sum_over_runs`: then sums come from that, and a
            run need not hold what is added up on the way. It may also have a method `carried(key, *args)` that returns
            what its loop over time carries, of which nothing but the shapes is looked at: a chunk is then made to work
            inside the cache.
        key: of the whole study.
        runs: how many, >= 1.
        *args: pytrees of arrays handed to every run: parameters, the world. Changing their values compiles nothing.
        chunk: runs that a device computes at once. Memory grows with it, not with `runs`. By default that of the study
            to resume, else chosen by `chunks.choose`: the same in all processes, and on all machines for a run that
            says what its loop carries, unless the runs make few turns of the devices, which are then made equal.
        keep_runs: return each run's own values instead of their sums; in one process only.
        devices: of `jax.local_devices()`, all by default.
        progress: called with the number of runs done after each turn of the devices; in several processes, as if the
            others were as far as this one. What it raises ends the study, with every finished part kept on disk.
        checkpoint: where to keep what is finished; `clear()` is the caller's to call, once the result is safe.

    Returns:
        `Result`, the same in every process.

    Raises:
        ValueError: `runs` or `chunk` below 1 or no whole number, a chunk that does not fit into memory, no device,
            or a checkpoint that should be resumed and belongs to another study, or holds files that are no study's.
        TypeError: a key that is none.
        OSError: a part cannot be kept; those kept before stay. BlockingIOError: another study works in its folder.
    """
    hosts.check_count("runs", runs, most=2**31 - 1)  # a run's index is an int32
    if chunk is not None:
        hosts.check_count("chunk", chunk)
    _check_key(key)
    devices = tuple(jax.local_devices() if devices is None else devices)
    if not devices:
        raise ValueError("devices: expected at least one, got none")
    process, processes = jax.process_index(), jax.process_count()
    if keep_runs and processes > 1:
        raise ValueError(f"keep_runs: expected one process, got {processes}")
    if chunk is None and checkpoint is not None:
        chunk = checkpoint.recorded_chunk()
    counts, chosen = hosts.gather(np.array([len(devices), min(chunk or 0, runs)], np.int32)).T

    began, compiled = time.perf_counter(), chunks.compile.cache_info().misses
    args, platform = jax.tree.map(jnp.asarray, args), devices[0].platform
    run = chunks.OneRun.of(one_run, keep_runs, key, args)
    traced = chunks.trace(run)
    chunk = int(chosen[0])
    if not chunk:  # compilers on different machines may foresee different needs
        chunk = int(hosts.gather(np.array(chunks.choose(run, runs, int(counts.sum()), devices), np.int32)).min())
    plan = Plan(runs, chunk)
    study: dict[str, Any] = {}
    if checkpoint is not None or processes > 1:
        study = manifest(plan, chunks.lowered_text(run), key, args, keep_runs=keep_runs, platform=platform)
        _check_agreement(study)
    if checkpoint is not None:
        hosts.in_turn(lambda: checkpoint.check(study))
    program = chunks.compile(run, plan.chunk, devices)
    program.check_memory()
    compile_s = time.perf_counter() - began if chunks.compile.cache_info().misses > compiled else 0.0

    own, finished = range(process, plan.parts, processes), set[int]()
    try:
        if checkpoint is not None:
            finished = hosts.in_turn(lambda: checkpoint.open(study, own))
        resumed = sum(map(plan.runs_of, finished))
        resumed_runs = int(hosts.gather(np.array(resumed, np.int64)).sum())
        if checkpoint is not None and resumed_runs:
            checkpoint.say(f"going on: {resumed_runs:,} of {runs:,} runs are done")
        began = time.perf_counter()

        def report(computed: int) -> None:
            if progress is not None:
                progress(runs * (resumed + computed) // sum(map(plan.runs_of, own)))

        todo = (each for part in own if part not in finished for each in plan.chunks_of(part))
        computed = _compute(program, plan, todo, (key, args), report)
        combine = _concatenate if keep_runs else _add_up
        totals = _totals(own, finished, plan, computed, combine, checkpoint)
        if processes > 1:
            totals = _exchange(list(totals), plan.parts, traced.outputs)
        total, run_s = combine(totals), time.perf_counter() - began
        value = _kept(total, traced.outputs, runs) if keep_runs else _unpacked(total, traced.outputs)
        return Result(value, plan.chunk, int(counts.sum()), processes, resumed_runs, compile_s, run_s)
    finally:
        if checkpoint is not None:
            checkpoint.release()


def _check_key(key: Any) -> None:
    typed = hasattr(key, "dtype") and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if (not typed and getattr(key, "dtype", None) != np.uint32) or key.ndim != (0 if typed else 1):
        raise TypeError(f"key: expected one made by jax.random.key, got {key!r}")


def _check_agreement(study: dict[str, Any]) -> None:
    digest = hashlib.sha256(json.dumps(study).encode()).digest()[:8]
    digests = hosts.gather(np.frombuffer(digest, np.int64))
    if np.any(differs := np.any(digests != digests[0], axis=1)):
        raise ValueError(f"processes: expected the same study in all, process {np.argmax(differs)} has another")


def _compute(
    program: chunks.Program, plan: Plan, todo: Iterator[int], shared: Any, report: Callable[[int], None]
) -> Iterator[_Arrays]:
    """Chunk after chunk, as many at a turn as there are devices."""
    runs, shared = program.place((np.int32(plan.runs), shared))
    devices, done = program.mesh.size, 0
    while turn := list(itertools.islice(todo, devices)):
        idle = [0] * (devices - len(turn))  # what these devices compute is not looked at
        first = np.array([each * plan.chunk for each in turn] + idle, np.int32)
        arrays = program.compute(first, runs, *shared)
        yield from itertools.islice(zip(*arrays, strict=True), len(turn))
        done += sum(plan.runs_in(range(each, each + 1)) for each in turn)
        report(done)


def _totals(
    own: range,
    finished: set[int],
    plan: Plan,
    computed: Iterator[_Arrays],
    combine: Callable[[Iterable[_Arrays]], _Arrays],
    checkpoint: Checkpoint | None,
) -> Iterator[_Arrays]:
    """Part after part, from disk where it is finished, else computed and kept."""
    for part in own:
        if checkpoint is not None and part in finished:
            yield checkpoint.load(part)
            continue
        total = combine(itertools.islice(computed, len(plan.chunks_of(part))))
        if checkpoint is not None:
            checkpoint.save(part, total)
        yield total
    for _ in computed:  # nothing is left but the last report
        pass


def _add_up(sums: Iterable[_Arrays]) -> _Arrays:
    return (functools.reduce(np.add, (np.asarray(vector, np.float64) for (vector,) in sums)),)


def _concatenate(runs: Iterable[_Arrays]) -> _Arrays:
    return tuple(map(np.concatenate, zip(*runs, strict=True)))


def _exchange(own: Sequence[_Arrays], parts: int, outputs: Any) -> Iterator[_Arrays]:
    """The parts of all processes in order. One of each at a time, so that little memory is taken."""
    nothing = np.zeros(sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(outputs)))
    for start in range(0, parts, jax.process_count()):
        place = start // jax.process_count()
        together = hosts.gather(own[place][0] if place < len(own) else nothing)
        yield from ((total,) for total in together[: parts - start])


def _unpacked(sums: _Arrays, outputs: Any) -> Any:
    leaves, structure = jax.tree.flatten(outputs)
    ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves])
    pieces = zip(np.split(sums[0], ends[:-1]), leaves, strict=True)
    return jax.tree.unflatten(structure, [piece.reshape(leaf.shape) for piece, leaf in pieces])


def _kept(arrays: _Arrays, outputs: Any, runs: int) -> Any:
    return jax.tree.unflatten(jax.tree.structure(outputs), [array[:runs] for array in arrays])
