"""Errors that name the thing, what came and what was expected. Traced values pass: they are flagged at run time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax.core
import jax.numpy as jnp
import numpy as np


def is_concrete(value: Any) -> bool:
    """Whether the value can be looked at now, that is, not inside jit, vmap or grad."""
    return not isinstance(value, jax.core.Tracer)


def number(name: str, value: Any) -> None:
    """Raise unless `value` is one real number.

    Raises:
        TypeError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name}: expected a number, got {value!r}")


def named(name: str, value: Any, table: Mapping[str, Any], other: str) -> Any:
    """The entry of a table that `value` names.

    Raises:
        ValueError: it names none; `other` is what may stand in the place of a name.
    """
    if value not in table:
        raise ValueError(f"{name}: expected one of {sorted(table)} or {other}, got {value!r}")
    return table[value]


def shape(name: str, value: Any, expected: tuple[int | None, ...]) -> None:
    """Raise unless `value` is an array of the expected shape; None stands for any length.

    Raises:
        TypeError: not an array, nor a number where one is expected.
        ValueError: the shape differs.
    """
    if not hasattr(value, "shape") and not isinstance(value, (int, float)):
        raise TypeError(f"{name}: expected an array, got {type(value).__name__}")
    got = np.shape(value)
    if len(got) != len(expected) or any(e is not None and g != e for g, e in zip(got, expected, strict=True)):
        wanted = "(" + ", ".join("any" if e is None else str(e) for e in expected) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {got}")


def shapes(**arrays: tuple[Any, tuple[int | None, ...]]) -> None:
    """`shape` of several: `shapes(pose=(pose, (3,)), z=(z, (2,)))`.

    Raises:
        TypeError, ValueError: as `shape`.
    """
    for name, (value, expected) in arrays.items():
        shape(name, value, expected)


def dtype(name: str, value: Any, kind: Any) -> None:
    """Raise unless the dtype of `value` is of a kind, such as `np.floating`.

    Raises:
        TypeError: it is of another kind.
    """
    got = jnp.result_type(value)
    if not jnp.issubdtype(got, kind):
        raise TypeError(f"{name}: expected dtype {kind.__name__}, got {got}")


_FINEST = 1e-3  # m: what a position must be told apart by


def farthest(dtype: Any) -> float:
    """Below which coordinate, m, numbers of a type lie no more than a millimetre apart: 16,384 m in float32."""
    return 2.0 ** (math.floor(math.log2(_FINEST / float(jnp.finfo(dtype).eps))) + 1)


def resolved(name: str, value: Any, dtype: Any) -> None:
    """Raise if a type cannot hold coordinates to a millimetre.

    Args:
        value: m, any shape.
        dtype: the floating-point type it is, or will be, held in.

    Raises:
        ValueError: a coordinate at which numbers of that type lie further apart.
    """
    if not is_concrete(value):
        return
    size = np.abs(np.asarray(value, np.float64))
    worst = float(np.max(size, initial=0, where=np.isfinite(size)))
    if worst >= farthest(dtype):
        spacing = 2.0 ** math.floor(math.log2(worst)) * float(jnp.finfo(dtype).eps)
        raise ValueError(
            f"{name}: expected coordinates that {jnp.dtype(dtype).name} holds to {_FINEST:g} m, got {worst:g} m, where "
            f"its numbers lie {spacing:.2g} m apart: subtract an origin, or use float64 "
            "(jax.config.update('jax_enable_x64', True))"
        )


def covariance(name: str, value: Any, size: int, *, definite: bool = False) -> None:
    """Raise unless `value` is a symmetric positive (semi-)definite matrix of finite numbers.

    Raises:
        ValueError: wrong shape, a non-finite entry, not symmetric, or a negative eigenvalue.
    """
    shape(name, value, (size, size))
    if not is_concrete(value):
        return
    matrix = np.asarray(value, np.float64)
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name}: expected finite entries, got {matrix.tolist()}")
    if not np.allclose(matrix, matrix.T, rtol=1e-5, atol=0):
        raise ValueError(f"{name}: expected a symmetric matrix, got {matrix.tolist()}")
    # Rounding of the dtype the matrix came in, relative to its largest eigenvalue.
    eigenvalues = np.linalg.eigvalsh(matrix)
    slack = size * float(np.finfo(np.result_type(np.asarray(value), np.float32)).eps) * abs(eigenvalues[-1])
    if eigenvalues[0] < -slack or (definite and eigenvalues[0] <= 0):
        wanted = "definite" if definite else "semi-definite"
        raise ValueError(f"{name}: expected a positive {wanted} matrix, got eigenvalues {eigenvalues.tolist()}")
