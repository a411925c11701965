"""The filter over a batch of sequences."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks, motion
from jaxlocmap.parameters import Params
from jaxlocmap.pipeline import init, run
from jaxlocmap.se2 import POSE
from jaxlocmap.tuning.batch import Batch
from jaxlocmap.types import Config, Gaussian, Info, Inputs


class Judged(NamedTuple):
    """What is known of a step beside what the filter reports."""

    counted: jax.Array  # () bool
    truth: jax.Array | None  # (3,) m, m, rad, of the pose
    known: jax.Array | None  # () bool


def filtered(params: Params, batch: Batch, *, config: Config, collect: Callable[[Info, Judged], Any]) -> Any:
    """The filter over every sequence, matching scans where it has a matcher, without an occupancy grid.

    Args:
        params: the filter's.
        batch: N sequences of T steps; of a longer prior the filter takes the first entries.
        config: static; its grid is left aside.
        collect: `(info, judged) -> pytree`, what to keep of each step.

    Returns:
        What `collect` made of each step, leading axes (N, T).

    Raises:
        ValueError, TypeError: as `pipeline.run`; fields of the batch that do not fit; a matcher and no scans.
    """
    check_batch(batch)
    config, inputs, beam_angles = dataclasses.replace(config, grid=None), batch.inputs, batch.beam_angles
    if config.matcher is None:
        inputs, beam_angles = inputs._replace(ranges=None), None
    elif inputs.ranges is None or beam_angles is None:
        raise ValueError("config.matcher: expected batch.inputs.ranges and batch.beam_angles to match, got None")
    dtype, dim = jnp.asarray(batch.prior.mean).dtype, motion.resolve(config.motion).dim
    params, landmarks, truth = jax.tree.map(lambda x: jnp.asarray(x, dtype), (params, batch.landmarks, batch.truth))

    def one(prior: Gaussian, inputs: Inputs, judged: Judged) -> Any:
        state = init(prior.first(dim), config=config)
        _, collected = run(
            params,
            state,
            inputs,
            landmarks=landmarks,
            beam_angles=beam_angles,
            config=config,
            collect=lambda state, info, aside: collect(info, aside),
            aside=judged,
        )
        return collected

    judged = Judged(jnp.asarray(batch.counted), truth, batch.known)
    return jax.vmap(one)(batch.prior, inputs, judged)


def beliefs(params: Params, batch: Batch, *, config: Config) -> Gaussian:
    """The filter's belief after every step, (N, T, n) and (N, T, n, n). The rest as of `filtered`."""
    return filtered(params, batch, config=config, collect=lambda info, _: info.belief)


def check_batch(batch: Batch) -> None:
    """Raise if the fields of a batch do not fit.

    Raises:
        ValueError: a wrong shape, or a pose or landmark, when it can be looked at, so far out that the dtype of the
            prior cannot hold it to a millimetre. TypeError: a field that is no array.
    """
    checks.shape("batch.counted", batch.counted, (None, None))
    n, steps = np.shape(batch.counted)
    checks.shape("batch.prior.mean", batch.prior.mean, (n, None))
    dim = np.shape(batch.prior.mean)[1]
    checks.shape("batch.prior.cov", batch.prior.cov, (n, dim, dim))
    checks.shape("batch.inputs.dt", batch.inputs.dt, (n, steps))
    for name, shape in (("truth", (n, steps, POSE)), ("known", (n, steps)), ("poses", (n, steps, POSE))):
        if getattr(batch, name) is not None:
            checks.shape(f"batch.{name}", getattr(batch, name), shape)
    places = {"prior.mean": batch.prior.mean, "truth": batch.truth, "poses": batch.poses, "landmarks": batch.landmarks}
    for name, value in places.items():
        if value is not None:
            checks.resolved(f"batch.{name}", value[..., :2], jnp.result_type(batch.prior.mean))
