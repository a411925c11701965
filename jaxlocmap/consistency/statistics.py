"""Statistics of one step: pose error, NEES and its score, whitened innovations; and the quantiles to hold them against.

They work inside the loop and inside `vmap`. A pose error is truth minus estimate with the heading wrapped.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import SMALL, Matrix, forward, ldl, mirrored
from jaxlocmap.filters.ekf import gate_threshold
from jaxlocmap.se2 import POSE, boxminus

COVERAGE_LEVELS = (0.50, 0.90, 0.95, 0.99)
WITHIN_TWO_SIGMA = math.erf(math.sqrt(2))  # of the values of a normal variable
# A filter has diverged where a pose is further off than this, and the filter all but excludes that itself. The second
# half spares a filter that has seen nothing for long and says so.
_DIVERGED_DISTANCE = 1.0  # m
_DIVERGED_TAIL = 1e-6  # of honest poses have such a NEES


def pose_error(truth: jax.Array, estimate: jax.Array) -> jax.Array:
    """Truth minus estimate, (3,) m, m, rad, heading wrapped.

    Args:
        truth: (3,) m, m, rad.
        estimate: (3,) m, m, rad.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    checks.shape("truth", truth, (POSE,))
    checks.shape("estimate", estimate, (POSE,))
    return boxminus(truth, estimate)


def nees(error: jax.Array, cov: jax.Array) -> jax.Array:
    """Normalised estimation error squared, eᵀ P⁻¹ e: χ² with n degrees if the covariance is honest.

    Args:
        error: (n,), of a pose (3,) m, m, rad from `pose_error`.
        cov: (n, n) the estimate's covariance, of which the upper triangle is read.

    Returns:
        () >= 0; NaN where the covariance is not positive definite.
        Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    checks.shape("error", error, (None,))
    n = len(error)
    checks.shape("cov", cov, (n, n))
    if n > SMALL:
        L = jnp.linalg.cholesky(mirrored(cov))
        white = jax.scipy.linalg.solve_triangular(L, error, lower=True)
        return jnp.sum(white * white)
    L, D = ldl(Matrix.symmetric(cov))
    definite = functools.reduce(jnp.logical_and, [d > 0 for d in D])
    distance: Any = sum(y * y / d for y, d in zip(forward(L, tuple(error)), D, strict=True))
    return jnp.where(definite, distance, jnp.nan)


class PoseScore(NamedTuple):
    """One pose against its truth. What is not scored counts zero everywhere."""

    scored: jax.Array  # () bool: everything is finite and the covariance positive definite
    nees: jax.Array  # ()
    error_square: tuple[jax.Array, ...]  # x, y, yaw: () each, m², m², rad²
    variance: tuple[jax.Array, ...]  # the same of the filter's own
    axis_nees: tuple[jax.Array, ...]  # of each axis alone, error² / σ²
    diverged: jax.Array  # () bool: over a metre off, and the covariance all but excludes it


def score_pose(truth: jax.Array, mean: jax.Array, cov: jax.Array) -> PoseScore:
    """Score one step of a filter: its NEES, and error and variance along x, y and yaw.

    Args:
        truth: (3,) m, m, rad.
        mean: (3,) m, m, rad, the estimate.
        cov: (3, 3) its covariance.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    error = pose_error(truth, mean)
    distance = nees(error, cov)
    scored = jnp.isfinite(distance)
    square = [jnp.where(scored, error[i] ** 2, 0) for i in range(POSE)]
    variance = [jnp.where(scored, cov[i, i], 0) for i in range(POSE)]
    ratio = [jnp.where(scored, square[i] / cov[i, i], 0) for i in range(POSE)]
    surprising = distance > chi2_quantile(1 - _DIVERGED_TAIL, POSE)
    diverged = scored & (square[0] + square[1] > _DIVERGED_DISTANCE**2) & surprising
    return PoseScore(scored, jnp.where(scored, distance, 0), tuple(square), tuple(variance), tuple(ratio), diverged)


def whiten(innovation: jax.Array, S: jax.Array) -> jax.Array:
    """D^(-1/2) L⁻¹ r with S = L D Lᵀ: independent unit normals if the filter is consistent.

    Args:
        innovation: (m,).
        S: (m, m) its covariance.

    Returns:
        (m,), zero where S is zero, as in the reports of empty slots; NaN where S is not positive definite.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    checks.shape("innovation", innovation, (None,))
    n = len(innovation)
    checks.shape("S", S, (n, n))
    empty = S[0, 0] == 0  # a variance of zero: there is none
    rows = [[jnp.where(empty, jnp.asarray(i == j, S.dtype), S[i, j]) for j in range(n)] for i in range(n)]
    L, D = ldl(Matrix.symmetric(Matrix(rows)))
    return jnp.stack([y / jnp.sqrt(d) for y, d in zip(forward(L, tuple(innovation)), D, strict=True)])


def chi2_quantile(probability: float, degrees: int) -> float:
    """The value a χ² variable with `degrees` degrees of freedom stays below with `probability`.

    Raises:
        ValueError: a probability outside (0, 1).
    """
    return gate_threshold(probability, degrees)


def chi2_band(dimension: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Where the mean of `samples` independent χ² variables of `dimension` degrees lies with `probability`:
    quantiles of χ² with samples * dimension degrees, over samples.

    Raises:
        ValueError: no samples, or a probability outside (0, 1).
    """
    if samples < 1:
        raise ValueError(f"samples: expected at least 1, got {samples}")
    if not 0 < probability < 1:
        raise ValueError(f"probability: expected a value inside (0, 1), got {probability}")
    tail = (1 - probability) / 2
    low, high = (chi2_quantile(p, samples * dimension) / samples for p in (tail, 1 - tail))
    return low, high
