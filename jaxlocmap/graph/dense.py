"""Cholesky factors and triangular solves that run one matrix after the other under `vmap`.

JAX 0.10 on CPUs spreads a batch of them over its threads from one of these threads, and waits: two batches that do not
depend on each other, such as those of a gradient, can wait for each other without end.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.custom_batching import sequential_vmap


@jax.custom_jvp
def cholesky(S: jax.Array) -> jax.Array:
    """L with L Lᵀ = S, lower triangular, (n, n); NaN where S is not positive definite."""
    return _cholesky(S)


@cholesky.defjvp
def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    # L Phi(L⁻¹ dS L⁻ᵀ), Phi the lower triangle with half of the diagonal: Smith 1995.
    L = cholesky(*primals)
    inner = solve_lower(L, solve_lower(L, tangents[0]).T)
    return L, L @ (jnp.tril(inner) - 0.5 * jnp.diag(jnp.diag(inner)))


def solve_lower(L: jax.Array, b: jax.Array, *, transposed: bool = False) -> jax.Array:
    """Solve L x = b, or Lᵀ x = b, for lower triangular L (n, n); b: (n, m)."""
    T = jnp.tril(L).T if transposed else jnp.tril(L)
    there, back = (_backward, _forward) if transposed else (_forward, _backward)
    return jax.lax.custom_linear_solve(
        lambda x: T @ x, b, lambda _, b: there(L, b), transpose_solve=lambda _, b: back(L, b)
    )


def solve(L: jax.Array, b: jax.Array) -> jax.Array:
    """Solve L Lᵀ x = b; b: (n, m)."""
    return solve_lower(L, solve_lower(L, b), transposed=True)


@sequential_vmap
def _cholesky(S: jax.Array) -> jax.Array:
    return jnp.linalg.cholesky(S, symmetrize_input=False)


@sequential_vmap
def _forward(L: jax.Array, b: jax.Array) -> jax.Array:
    return jax.scipy.linalg.solve_triangular(L, b, lower=True)


@sequential_vmap
def _backward(L: jax.Array, b: jax.Array) -> jax.Array:
    return jax.scipy.linalg.solve_triangular(L, b, lower=True, trans=1)
