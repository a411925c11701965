"""The objective and its gradient by one compiled program, which also says what every sequence has in them."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxlocmap.parameters import Block, Params
from jaxlocmap.tuning.batch import Batch, in_dtype_of
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import Coordinates, constrain, unconstrain


class Evaluation(NamedTuple):
    """The objective at some coordinates, of N sequences."""

    loss: Any  # ()
    gradient: dict[str, Any]  # by coordinate, () each
    sums: Any  # of `Objective.tallies`, (N,) each
    slopes: Any  # of the sums, {coordinate: (N,)} each
    accepted: Any  # (N,) observations that the gate lets in, None where no filter is run

    @property
    def finite(self) -> bool:
        """Whether loss and gradient are."""
        return bool(np.isfinite([self.loss, *self.gradient.values()]).all())


def evaluate(objective: Objective, coordinates: Coordinates, params: Params, batch: Batch) -> Evaluation:
    """The objective there, in NumPy: compiled once for the objective, the names and the shapes of the batch.

    Slopes are taken in forward mode: a filter has a handful of parameters and thousands of steps.

    Args:
        objective: what for.
        coordinates: of what is tuned, () each.
        params: the rest, which stays; in the dtype of the batch, so that one program serves all calls.
        batch: of N sequences.
    """
    return jax.tree.map(np.asarray, _evaluated(objective, coordinates, params, batch))


@functools.partial(jax.jit, static_argnums=0)
def _evaluated(objective: Objective, coordinates: Coordinates, params: Params, batch: Batch) -> Evaluation:
    flat, unravel = ravel_pytree(coordinates)

    def tallied(flat: jax.Array) -> Any:
        sums, accepted = objective.tallies(params_at(objective.blocks, unravel(flat), params, batch), batch)
        return sums, (sums, accepted)

    slopes, (sums, accepted) = jax.jacfwd(tallied, has_aux=True)(flat)
    loss, weights = jax.value_and_grad(lambda sums: objective.value(sums)[0])(jax.tree.map(jnp.sum, sums))
    of_sums = jax.tree.map(lambda weight, slope: weight * jnp.sum(slope, axis=0), weights, slopes)
    gradient = unravel(jax.tree.reduce(jnp.add, of_sums))
    return Evaluation(loss, gradient, sums, jax.tree.map(jax.vmap(unravel), slopes), accepted)


def params_at(blocks: tuple[Block, ...], coordinates: Coordinates, params: Params, batch: Batch) -> Params:
    """The parameters at some coordinates, in the dtype of the batch.

    Args:
        blocks: that the filter has.
        coordinates: of what is tuned, () each.
        params: the rest.
        batch: whose dtype counts.
    """
    whole = unconstrain(in_dtype_of(batch, params), blocks)
    return constrain(whole | coordinates, blocks, others=params)
