"""The linear system of a pose graph, solved in the space of its loops: what odometry says, corrected as by a Kalman
filter whose observations are the loops.

The covariance of odometry carried to the world is a sum along the chain, so that of any two poses is the sum up to
the earlier one, Cov(x_a, x_b) = P(min(a, b)). With the loops' rows A the inverse of the normal equations' matrix is

    H⁻¹ = V - V Aᵀ S⁻¹ A V,  S = I + A V Aᵀ

S has 3 L rows for L loops however many poses there are, and S >= I: a loop of weight zero costs nothing and spoils
nothing. Everything is arithmetic on arrays, so batches of graphs of different topology run side by side.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap._internal.linalg import Matrix
from jaxlocmap.graph import dense
from jaxlocmap.graph.prefix import prefix_sum, suffix_sum

Vectors = tuple[jax.Array, ...]  # d entries of N vectors, (N,) each


class System(NamedTuple):
    """Least squares in N vectors x of d entries, x_0 = 0:

    Σ (x_k+1 - x_k)ᵀ W_k (x_k+1 - x_k) + Σ |after x_b + before x_a|²
    """

    information: Matrix  # W, dxd of (N - 1,)
    covariance: Matrix  # W⁻¹, dxd of (N - 1,)
    pair: jax.Array  # (L, 2) a, b
    after: Matrix  # rxd of (L,)
    before: Matrix | None = None  # rxd of (L,); None: the negative of `after`

    @property
    def ends(self) -> tuple[tuple[int, Matrix], ...]:
        """Column of `pair` and matrix of either end of a loop."""
        return (1, self.after), (0, self.after.scale(-1) if self.before is None else self.before)


class LoopSpace(NamedTuple):
    """A system, ready to be solved."""

    system: System
    sums: jax.Array  # (N, d (d + 1) / 2) upper triangles of P
    factor: jax.Array  # (r L, r L) lower triangular, of S

    def solve(self, g: Vectors) -> Vectors:
        """H⁻¹ g, the first vector zero."""
        system = self.system
        if not len(system.pair):
            return self._without_loops(g)
        rows = _rows(system, self._without_loops(g))
        weight = dense.solve(self.factor, jnp.stack(rows, axis=-1).reshape(-1, 1))
        pulls = tuple(jnp.moveaxis(weight.reshape(-1, len(rows)), -1, 0))
        return self._without_loops(minus_loops(system, pulls, g))

    def _without_loops(self, g: Vectors) -> Vectors:
        """V g: of odometry alone."""
        after = suffix_sum(jnp.stack(g, axis=-1)[1:])
        steps = self.system.covariance @ Matrix([[after[:, i]] for i in range(len(g))])
        x = prefix_sum(jnp.stack([step for (step,) in steps.rows], axis=-1))
        return tuple(x[:, i] for i in range(len(g)))

    def marginals(self) -> jax.Array:
        """Covariances of all vectors, (N, d, d)."""
        every = jnp.arange(len(self.sums), dtype=jnp.int32)
        return self.covariances(jnp.stack([0 * every, every], axis=-1))

    def covariances(self, pair: jax.Array) -> jax.Array:
        """Of x_b - x_a, (K, d, d), for pairs a, b (K, 2) of poses."""
        system, d = self.system, self.system.after.shape[1]
        a, b = pair[:, 0], pair[:, 1]
        apart = _upper(self.sums[b] + self.sums[a] - 2 * self.sums[jnp.minimum(a, b)], d)
        apart = jnp.stack([jnp.stack(row, axis=-1) for row in apart.rows], axis=-2)
        if not len(system.pair):
            return apart
        across = []
        for end, sign in ((b, 1), (a, -1)):
            for loop_end, J in system.ends:
                shared = _upper(sign * self.sums[jnp.minimum(system.pair[:, loop_end, None], end[None])], d)
                across.append(_broadcast(J, 1) @ shared)
        rows = sum(across[1:], across[0])
        r = rows.shape[0]
        table = jnp.stack([jnp.stack(row, axis=-1) for row in rows.rows], axis=1)  # (L, r, K, d)
        table = dense.solve_lower(self.factor, table.reshape(len(system.pair) * r, -1))
        table = table.reshape(len(table), len(pair), d)
        return apart - jnp.einsum("lki,lkj->kij", table, table)


def factorised(system: System) -> LoopSpace:
    """The system with the factor of S."""
    d, r = system.after.shape[1], system.after.shape[0]
    upper = [system.covariance[i, j] + jnp.zeros_like(system.covariance[0, 0]) for i in range(d) for j in range(i, d)]
    sums = prefix_sum(jnp.stack(upper, axis=-1))
    shared = {
        (i, j): sums[jnp.minimum(system.pair[:, i, None], system.pair[None, :, j])] for i in (0, 1) for j in (0, 1)
    }
    if system.before is None:
        V = _upper(shared[1, 1] - shared[1, 0] - shared[0, 1] + shared[0, 0], d)
        S = _broadcast(system.after, 1) @ V @ _broadcast(system.after, 0).T
    else:
        S = Matrix([[0] * r] * r)
        for i, J in system.ends:
            for j, K in system.ends:
                S = S + _broadcast(J, 1) @ _upper(shared[i, j], d) @ _broadcast(K, 0).T
    size = len(system.pair) * r
    table = jnp.stack([jnp.stack(row, axis=-1) for row in S.rows], axis=1).reshape(size, size)  # (L, r, L, r)
    return LoopSpace(system, sums, dense.cholesky(table + jnp.eye(size, dtype=table.dtype)))


def _rows(system: System, x: Vectors) -> list[jax.Array]:
    """A x: r entries of (L,)."""
    total = Matrix([[0]] * system.after.shape[0])
    for end, J in system.ends:
        total = total + J @ Matrix([[entry[system.pair[:, end]]] for entry in x])
    return [row for (row,) in total.rows]


def minus_loops(system: System, pulls: Vectors, g: Vectors) -> Vectors:
    """G - Aᵀ y."""
    table = jnp.stack(g, axis=-1)
    for end, J in system.ends:
        pull = J.T @ Matrix([[entry] for entry in pulls])
        table = table.at[system.pair[:, end]].add(-jnp.stack([row for (row,) in pull.rows], axis=-1))
    return tuple(table[:, i] for i in range(len(g)))


def _upper(entries: jax.Array, d: int) -> Matrix:
    """Symmetric matrices from upper triangles in the last axis."""
    place = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(d) for j in range(i, d))}
    return Matrix([[entries[..., place[min(i, j), max(i, j)]] for j in range(d)] for i in range(d)])


def _broadcast(J: Matrix, axis: int) -> Matrix:
    """A matrix of (L,) as one of (L, 1) or (1, L)."""
    return Matrix([[x if isinstance(x, int) else jnp.expand_dims(x, axis) for x in row] for row in J.rows])
