"""The linear system of a large pose graph: a sparse factor of the matrix of the normal equations.

CHOLMOD through `sparsax` where it is installed (extra `sparse`; float64, CPUs), else SuperLU through SciPy and a
callback.
"""

from __future__ import annotations

import functools
import importlib.util
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap._internal.linalg import Matrix
from jaxlocmap.graph.loop_space import System, Vectors

_COLUMNS = 96  # right-hand sides solved at a time


def has_sparsax() -> bool:
    """Whether `sparsax` can be used: it is installed, numbers are float64, and the device is a CPU."""
    there = importlib.util.find_spec("sparsax") is not None
    return there and jax.default_backend() == "cpu" and jax.dtypes.canonicalize_dtype(float) == np.float64


class Sparse(NamedTuple):
    """A system as the entries of the upper triangle of its matrix, without the first vector. Not for crossing `jit`."""

    row: jax.Array  # (nnz,) int32; those of the diagonal blocks come first, block by block
    column: jax.Array  # (nnz,) int32, >= row
    value: jax.Array  # (nnz,)
    finite: jax.Array  # () bool; if not, the matrix is the identity
    vectors: int  # N
    size: int  # d, of each
    sparsax: bool

    def solve(self, g: Vectors) -> Vectors:
        """H⁻¹ g, the first vector zero; NaN where H is not positive definite."""
        b = jnp.stack(g, axis=-1).at[0].set(0).reshape(-1, 1)
        x = self._solved(b).reshape(self.vectors, self.size)
        return tuple(x[:, i] for i in range(self.size))

    def _solved(self, b: jax.Array) -> jax.Array:
        """H⁻¹ b, (d N, k)."""
        if self.sparsax:
            import sparsax

            x = sparsax.solve(self.row, self.column, self.value, b)
        else:
            of = jax.ShapeDtypeStruct(b.shape, b.dtype)
            x = jax.pure_callback(_scipy_solve, of, self.row, self.column, self.value, b, vmap_method="sequential")
        return jnp.where(self.finite, x, jnp.nan)

    def marginals(self) -> jax.Array:
        """Covariances of all vectors, (N, d, d)."""
        if not self.sparsax:
            every = jnp.arange(self.vectors, dtype=jnp.int32)
            return self.covariances(jnp.stack([0 * every, every], axis=-1))
        import sparsax

        n, d = self.vectors, self.size
        inverse = sparsax.selinv(self.row, self.column, self.value, n * d)
        rows, columns = np.triu_indices(d)
        blocks = inverse[: n * len(rows)].reshape(n, len(rows))
        upper = jnp.zeros((n, d, d), blocks.dtype).at[:, rows, columns].set(blocks).at[:, columns, rows].set(blocks)
        return jnp.where(self.finite, upper.at[0].set(0), jnp.nan)

    def covariances(self, pair: jax.Array) -> jax.Array:
        """Of x_b - x_a, (K, d, d), for pairs a, b (K, 2) of poses."""
        d, each = self.size, _COLUMNS // self.size
        chunks = -(-len(pair) // each)
        padded = jnp.concatenate([pair, jnp.zeros((chunks * each - len(pair), 2), pair.dtype)])

        def some(pair: jax.Array) -> jax.Array:
            unit = jnp.zeros((self.vectors, d, each, d), self.value.dtype)
            for end, sign in ((1, 1), (0, -1)):
                for i in range(d):
                    unit = unit.at[pair[:, end], i, jnp.arange(each), i].add(sign)
            unit = unit.at[0].set(0).reshape(self.vectors * d, each * d)
            x = self._solved(unit).reshape(self.vectors, d, each, d)
            column = jnp.arange(each)
            return x[pair[:, 1], :, column] - x[pair[:, 0], :, column]

        return jax.lax.map(some, padded.reshape(chunks, each, 2)).reshape(-1, d, d)[: len(pair)]


def factorised(system: System, *, sparsax: bool) -> Sparse:
    """The entries of the system's matrix."""
    d = system.after.shape[1]
    upper = [(i, j) for i in range(d) for j in range(i, d)]
    like = jnp.zeros_like(system.information[0, 0])
    n = len(like) + 1
    (_, after), (_, before) = system.ends

    def stacked(M: Matrix, entries: list[tuple[int, int]], like: jax.Array) -> jax.Array:
        return jnp.stack([M[i, j] + like for i, j in entries], axis=-1)

    W = stacked(system.information, upper, like)
    diagonal = jnp.zeros((n, len(upper)), W.dtype).at[1:].add(W).at[:-1].add(W)
    none = jnp.zeros(system.pair.shape[:1], W.dtype)
    for end, J in system.ends:
        diagonal = diagonal.at[system.pair[:, end]].add(stacked(J.T @ J, upper, none))
    every = [(i, j) for i in range(d) for j in range(d)]
    chain = -stacked(system.information, every, like)
    loops = stacked(before.T @ after, every, none)

    k = jnp.arange(n, dtype=jnp.int32)
    blocks = [(diagonal, upper, k, k), (chain, every, k[:-1], k[1:]), (loops, every, *system.pair.T.astype(jnp.int32))]
    row, column, value = [], [], []
    for entries, places, a, b in blocks:
        i, j = np.array(places, np.int32).T
        row.append((a[:, None] * d + i[None]).reshape(-1))
        column.append((b[:, None] * d + j[None]).reshape(-1))
        value.append(entries.reshape(-1))
    rows, columns, values = (jnp.concatenate(part) for part in (row, column, value))
    rows, columns = jnp.minimum(rows, columns), jnp.maximum(rows, columns)
    finite = jnp.all(jnp.isfinite(values))
    identity = (rows == columns).astype(values.dtype)
    values = jnp.where(finite & (rows >= d), values, identity)
    return Sparse(rows, columns, values, finite, n, d, sparsax)


@functools.lru_cache(maxsize=4)
def _pattern(row: bytes, column: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each entry goes in a compressed matrix of columns, both triangles, and that matrix's indices."""
    i, j = np.frombuffer(row, np.int32).astype(np.int64), np.frombuffer(column, np.int32).astype(np.int64)
    n = int(j.max()) + 1
    key, place = np.unique(np.concatenate([j * n + i, i * n + j]), return_inverse=True)
    starts = np.searchsorted(key, np.arange(n + 1) * n)
    return place, (key % n).astype(np.int32), starts.astype(np.int32)


def _scipy_solve(row: Any, column: Any, value: Any, b: Any) -> np.ndarray:
    from scipy.sparse import csc_matrix, linalg  # takes its time, and is needed here alone

    row, column, value, b = (np.asarray(x) for x in (row, column, value, b))
    place, indices, starts = _pattern(row.tobytes(), column.tobytes())
    both = np.concatenate([value, np.where(row == column, 0, value)])
    data = np.bincount(place, both, len(indices))
    matrix = csc_matrix((data, indices, starts), shape=(len(starts) - 1,) * 2)
    try:
        factor = linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # the factor is exactly singular
        return np.full_like(b, np.nan)
    pivots = np.abs(factor.U.diagonal())
    if pivots.min() < np.finfo(float).eps * pivots.max():  # singular, but for rounding
        return np.full_like(b, np.nan)
    return factor.solve(b.astype(np.float64)).astype(b.dtype)
