"""Branches that stay branches under `vmap`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


@custom_vmap
def any_in_batch(flags: jax.Array) -> jax.Array:
    """Whether a flag is set, in any run of the batch.

    The predicate of a `cond` that depends on the run makes both branches execute, for every run. This one does not
    depend on the run, so under `vmap` the branch stays a branch: steps at which nobody observes cost nothing. The
    branch it guards must mask per run, so that no result depends on the company a run is in.
    """
    return jnp.any(flags)


@any_in_batch.def_vmap
def _any_in_batch_vmap(axis_size: int, in_batched: list[bool], flags: jax.Array) -> tuple[jax.Array, bool]:
    del axis_size, in_batched
    return any_in_batch(flags), False
