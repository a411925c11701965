"""Branches that stay branches under `vmap`, and constants that fit beside values under `shard_map`."""

from __future__ import annotations

from typing import Any

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


def zero_like_any(*trees: Any) -> jax.Array:
    """An int32 zero that differs between devices, as far as `shard_map` is concerned, if any of these values may.

    `shard_map` wants both branches of a `cond`, and the carry before and after a step, to agree on that; a plain
    constant agrees with nothing. Add this to it. The compiler sees the zero and drops the addition.
    """
    total = jnp.zeros((), jnp.int32)
    for leaf in jax.tree.leaves(trees):
        if jnp.size(leaf):
            first = jnp.ravel(leaf)[0]
            total = total + jnp.where(first == first, 0, 0).astype(jnp.int32)
    return total
