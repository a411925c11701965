"""Small matrices with scalar entries, unrolled while tracing.

`F @ P @ F.T` on 3x3 arrays costs a dispatch per product, and a batch of them runs through a general `dot`. With
scalar entries the same line becomes a few multiply-adds that fuse into vector code, one lane per run of a batch.
Entries that are the Python integers 0, 1 and -1 are structure: products with them vanish from the program.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Scalar = Any  # a Python number or an array of shape ()

SMALL = 12  # the largest dimension that is unrolled: beyond, programs take longer to compile than they gain


def stack_scalars(entries: Any) -> jax.Array:
    """Scalars as an array: (n,) from a sequence of them, (n, m) from a sequence of rows.

    A later `array[i, j]` then costs nothing under `vmap`: the compiler sees through concatenations, though not through
    the reshape in a stack of stacks.
    """
    if not isinstance(entries[0], (tuple, list)):
        return jnp.stack(entries)
    cells = [[jax.lax.expand_dims(x, (0, 1)) for x in row] for row in entries]
    return jax.lax.concatenate([jax.lax.concatenate(row, 1) for row in cells], 0)


def _mul(a: Scalar, b: Scalar) -> Scalar:
    for one, other in ((a, b), (b, a)):
        if isinstance(one, int):
            if one == 0:
                return 0
            if one == 1:
                return other
            if one == -1:
                return -other
    return a * b


def _add(a: Scalar, b: Scalar) -> Scalar:
    if isinstance(a, int) and a == 0:
        return b
    if isinstance(b, int) and b == 0:
        return a
    return a + b


def _dot(a: tuple[Scalar, ...], b: tuple[Scalar, ...]) -> Scalar:
    total: Scalar = 0
    for x, y in zip(a, b, strict=True):
        total = _add(total, _mul(x, y))
    return total


class Matrix:
    """A matrix as a tuple of rows of scalars, with `@`, `+`, `-`, `.T` and `[i, j]`."""

    __slots__ = ("rows",)

    def __init__(self, rows: Any) -> None:
        self.rows: tuple[tuple[Scalar, ...], ...] = tuple(tuple(row) for row in rows)

    @classmethod
    def of(cls, value: Matrix | jax.Array | np.ndarray) -> Matrix:
        """A matrix from an array of shape (n, m); a `Matrix` passes through."""
        if isinstance(value, Matrix):
            return value
        n, m = value.shape
        return cls([value[i, j] for j in range(m)] for i in range(n))

    @classmethod
    def symmetric(cls, value: Matrix | jax.Array | np.ndarray) -> Matrix:
        """As `of`, reading the upper triangle and mirroring it."""
        full = cls.of(value)
        n = len(full.rows)
        return cls([full[min(i, j), max(i, j)] for j in range(n)] for i in range(n))

    @classmethod
    def identity(cls, n: int) -> Matrix:
        """The identity, all structure."""
        return cls([int(i == j) for j in range(n)] for i in range(n))

    def array(self, dtype: Any) -> jax.Array:
        """The same matrix as an array of shape (n, m)."""
        return stack_scalars([[jnp.asarray(x, dtype) for x in row] for row in self.rows])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return len(self.rows), len(self.rows[0])

    def __getitem__(self, index: tuple[int, int]) -> Scalar:
        return self.rows[index[0]][index[1]]

    @property
    def T(self) -> Matrix:
        """The transpose."""
        return Matrix(zip(*self.rows, strict=True))

    def __matmul__(self, other: Matrix) -> Matrix:
        columns = other.T.rows
        return Matrix([_dot(row, column) for column in columns] for row in self.rows)

    def __add__(self, other: Matrix) -> Matrix:
        return Matrix(map(_add, a, b) for a, b in zip(self.rows, other.rows, strict=True))

    def __sub__(self, other: Matrix) -> Matrix:
        return self + other.scale(-1)

    def scale(self, factor: Scalar) -> Matrix:
        """Every entry times a scalar."""
        return Matrix([_mul(factor, x) for x in row] for row in self.rows)


def values(tree: Any) -> tuple[list[Scalar], Callable[..., Any]]:
    """The entries of a tree of rows that are no structure, and the way back: `rebuild(entries)` puts others in their
    place, and `rebuild(tangents, structure=0)` makes the tangent, in which structure does not move.
    """
    leaves, form = jax.tree.flatten(tree)

    def rebuild(entries: list[Scalar], structure: int | None = None) -> Any:
        following = iter(entries)
        return jax.tree.unflatten(
            form,
            [(x if structure is None else structure) if isinstance(x, int) else next(following) for x in leaves],
        )

    return [x for x in leaves if not isinstance(x, int)], rebuild


def quadratic_form(A: Matrix, P: Matrix) -> Matrix:
    """A P Aᵀ for symmetric P: the upper triangle is computed, the lower mirrors it.

    A compiler that evaluates a mirrored entry twice may round the copies apart. That does not feed back: the filter
    reads the upper triangle of a covariance alone, through `Matrix.symmetric`.
    """
    AP = A @ P
    n = len(A.rows)
    upper = {(i, j): _dot(AP.rows[i], A.rows[j]) for i in range(n) for j in range(i, n)}
    return Matrix([upper[min(i, j), max(i, j)] for j in range(n)] for i in range(n))


def ldl(S: Matrix) -> tuple[Matrix, tuple[Scalar, ...]]:
    """S = L D Lᵀ with L unit lower triangular (Golub & Van Loan 2013, section 4.1): no square root, and S is
    positive definite exactly when every pivot in D is positive.
    """
    n = len(S.rows)
    L: list[list[Scalar]] = [[int(i == j) for j in range(n)] for i in range(n)]
    D: list[Scalar] = []
    for j in range(n):
        D.append(S[j, j] - sum(L[j][k] * L[j][k] * D[k] for k in range(j)))
        for i in range(j + 1, n):
            L[i][j] = (S[i, j] - sum(L[i][k] * L[j][k] * D[k] for k in range(j))) / D[j]
    return Matrix(L), tuple(D)


def forward(L: Matrix, b: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """Solve L y = b for unit lower triangular L."""
    y: list[Scalar] = []
    for i, value in enumerate(b):
        y.append(value - sum(L[i, k] * y[k] for k in range(i)))
    return tuple(y)


def solve(L: Matrix, D: tuple[Scalar, ...], b: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    """Solve L D Lᵀ x = b."""
    x = [y / d for y, d in zip(forward(L, b), D, strict=True)]
    n = len(x)
    for i in reversed(range(n)):
        x[i] = x[i] - sum(L[k, i] * x[k] for k in range(i + 1, n))
    return tuple(x)


def mahalanobis(S: Matrix, r: tuple[Scalar, ...]) -> Scalar:
    """rᵀ S⁻¹ r."""
    L, D = ldl(S)
    y = forward(L, r)
    return sum(v * v / d for v, d in zip(y, D, strict=True))


def block_diagonal(*blocks: Matrix) -> Matrix:
    """Blocks along the diagonal, zero elsewhere."""
    size, rows = sum(block.shape[1] for block in blocks), []
    for block in blocks:
        before = len(rows)
        rows += [(0,) * before + row + (0,) * (size - before - len(row)) for row in block.rows]
    return Matrix(rows)


def mirrored(P: jax.Array) -> jax.Array:
    """The symmetric (n, n) array with the upper triangle of P: what `Matrix.symmetric` is of a small one."""
    return jnp.triu(P) + jnp.triu(P, 1).T


def is_psd(P: jax.Array) -> jax.Array:
    """Whether a symmetric (n, n) matrix is finite and positive semi-definite, up to rounding: () bool.

    P plus a few roundings of its diagonal has no negative pivot, so that the answer does not depend on units. A pivot
    of zero is one only if what remains of its row is zero too. In a large matrix, a product of larger ones, roundings
    add up, and those of its largest entries may be all there is of its smallest.
    """
    n = len(P)
    if n > SMALL:
        variance = jnp.diagonal(P)
        lift = variance * _rounding(P.dtype) + jnp.max(variance) * jnp.finfo(P.dtype).eps
        lifted = mirrored(P) + jnp.diag(n**2 * lift + jnp.finfo(P.dtype).tiny)
        return jnp.all(variance >= 0) & jnp.all(jnp.isfinite(jnp.linalg.cholesky(lifted)))
    S = Matrix.symmetric(P)
    lift = 1 + _rounding(P.dtype)
    rows = [[S[i, j] * lift if i == j else S[i, j] for j in range(n)] for i in range(n)]
    good: Scalar = True
    finite: Scalar = 0
    for j in range(n):
        pivot = rows[j][j]
        positive = pivot > 0
        share = 1 / jnp.where(positive, pivot, 1)
        rest = [rows[i][j] for i in range(j + 1, n)]
        empty = functools.reduce(jnp.logical_and, [x == 0 for x in rest], pivot == 0)
        good = good & (positive | empty)
        finite = finite + S[j, j]
        for i in range(j + 1, n):
            scaled = rows[i][j] * share
            for k in range(j + 1, i + 1):
                rows[i][k] = rows[i][k] - scaled * rows[k][j]
    return good & jnp.isfinite(finite)


def _rounding(dtype: Any) -> float:
    return 64 * float(jnp.finfo(dtype).eps)


def jacobians(function: Callable[..., jax.Array], *at: jax.Array) -> list[Any]:
    """The Jacobians (m, n) of a function of vectors by each of them, by forward-mode differentiation.

    Small ones come column by column: those of `jax.jacfwd` are written to memory and read back entry by entry.

    Args:
        function: vectors -> (m,).
        *at: the vectors, (n,) each.
    """
    if max(map(len, at)) > SMALL:
        return list(jax.jacfwd(function, argnums=tuple(range(len(at))))(*at))
    _, along = jax.linearize(function, *at)
    none = [np.zeros(len(x), x.dtype) for x in at]

    def columns(i: int) -> list[jax.Array]:
        return [along(*none[:i], unit, *none[i + 1 :]) for unit in np.eye(len(at[i]), dtype=at[i].dtype)]

    return [Matrix(columns(i)).T for i in range(len(at))]


def inverse(M: Matrix) -> Matrix:
    """Of a 3x3 matrix, by cofactors."""
    if M.shape != (3, 3):
        raise ValueError(f"expected a 3x3 matrix, got {M.shape}")

    def cofactor(i: int, j: int) -> Scalar:
        (a, b), (c, d) = ([M[(i + k) % 3, (j + n) % 3] for n in (1, 2)] for k in (1, 2))
        return a * d - b * c

    adjugate = [[cofactor(j, i) for j in range(3)] for i in range(3)]
    determinant = sum(M[0, j] * adjugate[j][0] for j in range(3))
    return Matrix(adjugate).scale(1 / determinant)
