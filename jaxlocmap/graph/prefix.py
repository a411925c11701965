"""Sums along the chain."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

_BLOCK = 32


def prefix_sum(x: jax.Array) -> jax.Array:
    """Sums of the entries before each, along the first axis: (K, ...) -> (K + 1, ...), the first zero.

    Two products with triangles of ones: a product is what a batch of many such sums does fastest, and one alone too.
    """
    count = len(x)
    blocks = max(-(-count // _BLOCK), 1)
    tail = x.shape[1:]
    padded = jnp.concatenate([x, jnp.zeros((blocks * _BLOCK - count, *tail), x.dtype)])
    padded = padded.reshape(blocks, _BLOCK, *tail)
    triangle = np.tril(np.ones((_BLOCK, _BLOCK), x.dtype))
    inside = jnp.einsum("ij,bj...->bi...", triangle, padded, precision="highest")
    before = np.tril(np.ones((blocks, blocks), x.dtype), -1)
    offsets = jnp.einsum("bc,c...->b...", before, inside[:, -1], precision="highest")
    sums = (inside + offsets[:, None]).reshape(blocks * _BLOCK, *tail)[:count]
    return jnp.concatenate([jnp.zeros((1, *tail), x.dtype), sums])


def suffix_sum(x: jax.Array) -> jax.Array:
    """Sums of the entries from each on, along the first axis, (K, ...)."""
    total = prefix_sum(x)
    return total[-1:] - total[:-1]
