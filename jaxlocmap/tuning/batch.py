"""What a filter is tuned on: sequences of what a robot measured, of one length by padding, with masks."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import simulation
from jaxlocmap.parameters import Params
from jaxlocmap.simulation.world import World
from jaxlocmap.types import Gaussian, Inputs


class Batch(NamedTuple):
    """N sequences of T steps. What is counted is judged; the filter goes through all of it."""

    prior: Gaussian  # (N, n), (N, n, n): the belief before the first step
    inputs: Inputs  # leading axes N, T
    counted: jax.Array  # (N, T) bool: not the padding, and not the steps in which a window runs in
    landmarks: jax.Array | None = None  # (L, 2) m
    truth: jax.Array | None = None  # (N, T, 3) m, m, rad
    known: jax.Array | None = None  # (N, T) bool: where the truth is known
    beam_angles: jax.Array | None = None  # (B,) rad
    poses: jax.Array | None = None  # (N, T, 3) m, m, rad: where to map the scans, if not where the filter is


_SHARED = ("landmarks", "beam_angles")


def sequence(
    inputs: Inputs,
    prior: Gaussian,
    *,
    landmarks: Any = None,
    truth: Any = None,
    known: Any = None,
    beam_angles: Any = None,
    poses: Any = None,
) -> Batch:
    """A batch of one sequence.

    Args:
        inputs: leading axis T.
        prior: mean (3,), cov (3, 3).
        landmarks: (L, 2) m.
        truth: (T, 3) m, m, rad, of which `known` (T,) says where it may be used: everywhere it is finite by default.
        beam_angles: (B,) rad.
        poses: (T, 3) m, m, rad, where to map the scans.

    Returns:
        `Batch` with N = 1. What does not fit is found by whatever uses it.
    """
    if truth is not None and known is None:
        known = np.all(np.isfinite(truth), axis=-1)
    if truth is not None:
        truth = np.where(np.asarray(known)[:, None], truth, 0)  # what is no number would spoil derivatives
    counted: Any = np.ones(len(inputs.dt), bool)
    one = Batch(prior, inputs, counted, truth=truth, known=known, poses=poses)
    one = jax.tree.map(lambda x: np.asarray(x)[None], one)
    return one._replace(landmarks=landmarks, beam_angles=beam_angles)


def no_observations(steps: int) -> Inputs:
    """Inputs (T,) of a robot that stands still and observes nothing, to fill in what it did measure; no slots."""
    arrays: Any = (
        np.zeros(steps),
        np.zeros((steps, 2)),
        np.zeros((steps, 0), np.int32),
        np.zeros((steps, 0, 2)),
        np.zeros((steps, 0), bool),
    )
    return Inputs(*arrays)


def join(*batches: Batch) -> Batch:
    """One batch of the sequences of several, the shorter ones filled up with steps of no time and no observation.

    Raises:
        ValueError: no batch, other landmarks or beams, or a field that only some of them have.
    """
    if not batches:
        raise ValueError("batches: expected at least one, got none")
    for name in (*Batch._fields, "ranges"):
        have = [getattr(b.inputs if name == "ranges" else b, name) is not None for b in batches]
        if any(have) != all(have):
            raise ValueError(f"{name}: expected in all batches or in none, got it in {sum(have)} of {len(have)}")
        if (
            name in _SHARED
            and all(have)
            and any(not _same(getattr(b, name), getattr(batches[0], name)) for b in batches)
        ):
            raise ValueError(f"{name}: expected the same in all batches")
    steps = max(b.counted.shape[1] for b in batches)
    slots = max(b.inputs.valid.shape[2] for b in batches)
    parts = [_apart_from_shared(_filled(b, steps, slots)) for b in batches]
    return _shared_with(batches[0], jax.tree.map(lambda *xs: np.concatenate(xs), *parts))


def windows(batch: Batch, length: int, *, run_in: int, beliefs: Gaussian) -> Batch:
    """Long sequences cut into windows of `length` counted steps, which can then be filtered side by side.

    Before its counted steps each window has up to `run_in` more in which the filter forgets where it was started:
    take several times the filter's memory, and a loss over the windows is that over the whole to any digit that
    matters.

    Args:
        beliefs: (N, T, 3), (N, T, 3, 3), a belief after each step to start from: of a filter, or the truth with a
            covariance. The first window of a sequence starts at the prior.

    Raises:
        ValueError: `length` below 1 or `run_in` below 0.
    """
    if length < 1 or run_in < 0:
        raise ValueError(f"length, run_in: expected at least 1 and at least 0 steps, got {length} and {run_in}")
    whole = jax.tree.map(np.asarray, _apart_from_shared(batch))
    means, covs = np.asarray(beliefs.mean), np.asarray(beliefs.cov)
    parts = []
    for n in range(len(whole.counted)):
        last = int(np.flatnonzero(whole.counted[n]).max(initial=-1)) + 1
        for begin in range(0, last, length):
            first, end = max(begin - run_in, 0), min(begin + length, last)
            piece = jax.tree.map(
                lambda x, n=n, first=first, end=end: x[n : n + 1, first:end], whole._replace(prior=None)
            )
            counted = piece.counted & (np.arange(first, end) >= begin)
            start = jax.tree.map(lambda x, n=n: x[n], whole.prior)
            if first:
                start = Gaussian(means[n, first - 1], covs[n, first - 1])
            piece = piece._replace(prior=jax.tree.map(lambda x: x[None], start), counted=counted)
            parts.append(_shared_with(batch, piece))
    return join(*parts)


def blocks(batch: Batch, count: int) -> Batch:
    """A batch of one sequence, `count` times, each time with another share of its counted steps: what
    `standard_errors` compares where a sequence cannot be cut, such as one map.

    Raises:
        ValueError: more than one sequence, or fewer counted steps than blocks.
    """
    n, counted = len(batch.counted), np.flatnonzero(np.asarray(batch.counted)[0])
    if n != 1 or not 1 <= count <= len(counted):
        raise ValueError(f"blocks: expected one sequence and 1 to {len(counted)} blocks, got {n} and {count}")
    copies = jax.tree.map(lambda x: np.repeat(np.asarray(x), count, axis=0), _apart_from_shared(batch))
    shares = np.zeros(copies.counted.shape, bool)
    for row, steps in zip(shares, np.array_split(counted, count), strict=True):
        row[steps] = True
    return _shared_with(batch, copies._replace(counted=shares))


def pick(batch: Batch, rows: Any) -> Batch:
    """The sequences in these rows: an array, a mask or a slice. Also under jit, with an array of rows."""
    return _shared_with(batch, jax.tree.map(lambda x: x[rows], _apart_from_shared(batch)))


def simulated(
    key: jax.Array,
    runs: int,
    world: World,
    noise: simulation.Noise,
    *,
    scenario: simulation.Scenario,
    scans: bool = False,
    worlds: bool = False,
) -> Batch:
    """Simulated drives, N = runs.

    Args:
        key: of the batch.
        world, noise: as their fields say.
        scenario: static.
        scans: with the laser.
        worlds: `world` leads with an axis of runs, a world each, whose landmarks are all the same.
    """
    prior = scenario.prior()
    keys = jax.random.split(key, runs)
    truth, inputs = _drives(keys, world, noise, prior, scenario=scenario, scans=scans, worlds=worlds)
    counted = jnp.ones(inputs.dt.shape, bool)
    return Batch(
        prior=jax.tree.map(lambda x: jnp.broadcast_to(x, (runs, *x.shape)), prior),
        inputs=inputs,
        counted=counted,
        landmarks=world.landmarks[0] if worlds else world.landmarks,
        truth=truth.pose,
        known=counted,
        beam_angles=scenario.beam_angles() if scans else None,
    )


@functools.partial(jax.jit, static_argnames=("scenario", "scans", "worlds"))
def _drives(
    keys: jax.Array,
    world: World,
    noise: simulation.Noise,
    prior: Gaussian,
    *,
    scenario: simulation.Scenario,
    scans: bool,
    worlds: bool,
) -> tuple[Any, Inputs]:
    def one(key: jax.Array, world: World) -> tuple[Any, Inputs]:
        start_key, key = jax.random.split(key)
        start = simulation.draw_start(start_key, prior, scenario=scenario)
        return simulation.simulate(key, world, noise, start, scenario=scenario, scan=scans)

    return jax.vmap(one, in_axes=(0, 0 if worlds else None))(keys, world)


def _apart_from_shared(batch: Batch) -> Batch:
    return batch._replace(**dict.fromkeys(_SHARED))


def _shared_with(batch: Batch, sequences: Batch) -> Batch:
    """These sequences with what those of the batch share."""
    return sequences._replace(**{name: getattr(batch, name) for name in _SHARED})


def _same(a: Any, b: Any) -> bool:
    return np.shape(a) == np.shape(b) and bool(np.all(np.asarray(a) == np.asarray(b)))


def _filled(batch: Batch, steps: int, slots: int) -> Batch:
    """The batch with more steps and more slots, in which nothing happens."""

    def fill(x: Any, widths: dict[int, int], value: Any = 0) -> np.ndarray:
        pads = [(0, widths.get(axis, 0)) for axis in range(np.ndim(x))]
        return np.pad(np.asarray(x), pads, constant_values=value)

    later, wider = steps - batch.counted.shape[1], slots - batch.inputs.valid.shape[2]
    inputs = batch.inputs._replace(
        **{name: fill(getattr(batch.inputs, name), {1: later, 2: wider}) for name in ("landmark", "z", "valid")},
        **{name: fill(getattr(batch.inputs, name), {1: later}) for name in ("dt", "control")},
        ranges=None if batch.inputs.ranges is None else fill(batch.inputs.ranges, {1: later}, np.nan),
    )
    by_step = {name: getattr(batch, name) for name in ("counted", "truth", "known", "poses")}
    return batch._replace(
        inputs=inputs, **{name: None if x is None else fill(x, {1: later}) for name, x in by_step.items()}
    )


def in_dtype_of(batch: Batch, params: Params) -> Params:
    """The same parameters in the dtype of the batch, so that programs compiled for some fit the others."""
    dtype = jnp.asarray(batch.prior.mean).dtype
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), params)
