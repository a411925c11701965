"""Can the covariance be believed? Statistics of normalised errors, and what they say in words.

The first half works on JAX arrays, inside the loop and inside `vmap`; the second half judges totals on the host, in
float64. A pose error is truth minus estimate with the heading wrapped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from jaxlocmap.ekf import gate_threshold
from jaxlocmap.linalg import Matrix, forward, ldl, mahalanobis
from jaxlocmap.motion import wrap

POSE_DIMENSION = 3
COVERAGE_LEVELS = (0.50, 0.90, 0.95, 0.99)
_NEAR = 1.25  # a misfit that a single run, whose errors are correlated in time, cannot tell from none


def pose_error(truth: jax.Array, estimate: jax.Array) -> jax.Array:
    """Truth minus estimate, (3,) m, m, rad, heading wrapped."""
    error = truth - estimate
    return jnp.stack([error[0], error[1], wrap(error[2])])


def nees(error: jax.Array, cov: jax.Array) -> jax.Array:
    """Normalised estimation error squared, eᵀ P⁻¹ e: χ² with 3 degrees if the covariance is honest.

    Args:
        error: (3,) from `pose_error`. cov: (3, 3).

    Returns:
        () >= 0; NaN or infinite for a singular covariance. Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.
    """
    return mahalanobis(Matrix.symmetric(cov), tuple(error))


def whiten(innovation: jax.Array, S: jax.Array) -> jax.Array:
    """D^(-1/2) L⁻¹ r with S = L D Lᵀ: independent unit normals if the filter is consistent.

    Args:
        innovation: (m,). S: (m, m) its covariance.

    Returns:
        (m,), zero where S is zero, as in the reports of empty slots.
    """
    n = len(innovation)
    empty = S[0, 0] == 0  # a variance of zero: there is none
    rows = [[jnp.where(empty, jnp.asarray(i == j, S.dtype), S[i, j]) for j in range(n)] for i in range(n)]
    L, D = ldl(Matrix.symmetric(Matrix(rows)))
    return jnp.stack([y / jnp.sqrt(d) for y, d in zip(forward(L, tuple(innovation)), D, strict=True)])


def lag_one(white: jax.Array, observed: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Products of each whitened innovation with the one before it of the same landmark: their sum is zero on average
    for a consistent filter (Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2).

    Args:
        white: (T, M, m) from `whiten`, column j always the same landmark. observed: (T, M) bool.

    Returns:
        (m,) sum of products, (m,) sum of squares of the later member of each pair, () number of pairs. The
        autocorrelation is the first over the second; its 95 % band is ±1.96 / √pairs.
    """
    steps = jnp.arange(len(observed))[:, None]
    latest = jax.lax.cummax(jnp.where(observed, steps, -1), axis=0)
    before = jnp.concatenate([jnp.full_like(latest[:1], -1), latest[:-1]])
    paired = (observed & (before >= 0))[..., None]
    previous = jnp.take_along_axis(white, jnp.maximum(before, 0)[..., None], axis=0)
    products = jnp.where(paired, white * previous, 0)
    squares = jnp.where(paired, white * white, 0)
    return products.sum((0, 1)), squares.sum((0, 1)), paired.sum().astype(white.dtype)


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


class Mean(NamedTuple):
    """A mean over independent runs and how far it can be trusted."""

    value: float
    standard_error: float  # from the spread between the runs; NaN for a single run
    band_95: tuple[float, float]  # where the mean lies in 95 of 100 studies if the expectation is met


def mean_over_runs(total: float, total_square: float, runs: int, expected: float) -> Mean:
    """Judge a per-run average by its spread between runs.

    Values within a run are correlated in time, so the number of steps says nothing about the precision of their
    average; runs are independent, so the spread of the runs' averages does (batch means, Law 2015, section 9.5.3).

    Args:
        total, total_square: sum over runs of the per-run average and of its square. runs: their number.
        expected: the value if the filter is consistent, that is, the degrees of freedom of the χ² that is averaged.

    Returns:
        `Mean`, the band being Student's t with runs - 1 degrees around `expected`; infinite for a single run. However
        correlated, an average of χ² variables varies no more than one of them, 2 * expected: a larger spread, such
        as that of one lost run among many, does not widen the band.
    """
    if runs < 1:
        return Mean(math.nan, math.nan, (-math.inf, math.inf))
    value = total / runs
    if runs < 2:
        return Mean(value, math.nan, (-math.inf, math.inf))
    variance = max(total_square / runs - value * value, 0.0) * runs / (runs - 1)
    error = math.sqrt(variance / runs)
    reach = float(scipy.special.stdtrit(runs - 1, 0.975)) * min(error, math.sqrt(2 * expected / runs))
    return Mean(value, error, (expected - reach, expected + reach))


def readable(value: float, digits: int = 3) -> str:
    """A number for people: so many digits, and never a power of ten where there is room for the number."""
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:.{digits}g}"


def verdict(anees: float, band: tuple[float, float] | None = None, diverged: int = 0, runs: int = 1) -> str:
    """What the average NEES of a pose says about its covariance, with the size of the misfit.

    Args:
        anees: average NEES, 3 if the covariance is honest. band: where it may lie if so; none, or infinite, for a
            single run or log, whose errors are correlated in time and give no band.
        diverged, runs: how many of how many runs lost the robot.
    """
    lost = f"; {diverged} of {runs} runs diverged" if diverged else ""
    if not math.isfinite(anees):
        return f"not consistent: the NEES is not finite{lost}"
    if band is not None and not all(map(math.isfinite, band)):
        band = None
    small = anees < POSE_DIMENSION
    ratio = (POSE_DIMENSION / anees if anees > 0 else math.inf) if small else anees / POSE_DIMENSION
    if band is not None and band[0] <= anees <= band[1]:
        opening = "not consistent" if diverged else "consistent"
        return f"{opening}: ANEES {readable(anees, 4)} lies in its 95 % band [{band[0]:.4g}, {band[1]:.4g}]{lost}"
    where = "one run gives no band" if band is None else f"95 % band [{band[0]:.4g}, {band[1]:.4g}]"
    judged = f"(ANEES {readable(anees, 4)}, 3 expected, {where}){lost}"
    if band is None and ratio < _NEAR:
        return f"undecided: nothing speaks against the covariance {judged}"
    side, size = ("under-confident", "large") if small else ("over-confident", "small")
    return f"{side}: covariance {readable(ratio)} times too {size} {judged}"


def gate_verdict(accept_rate: float, nominal: float | None, observations: int | None = None) -> str:
    """What the share of observations the gate lets in says: None as `nominal` means there is no gate.

    With the number of `observations`, a share is called too tight or too loose only where a good filter would show
    one as extreme in fewer than 25 of 1000 studies (binomial).
    """
    if nominal is None:
        return "no gate: every observation is used"
    if not math.isfinite(accept_rate):
        return "nothing observed: the gate was never asked"
    rejected, expected = 100 * (1 - accept_rate), 100 * (1 - nominal)
    text = f"the gate rejected {rejected:.3g} % of the observations, {expected:.3g} % expected"
    if accept_rate < 0.5 * nominal:
        return f"locked out: {text}; the filter is sure of a wrong pose and refuses what would correct it"
    many = few = 0.0
    if observations is not None:
        count = round((1 - accept_rate) * observations)
        few = float(scipy.special.bdtr(count, observations, 1 - nominal))
        many = float(scipy.special.bdtrc(count - 1, observations, 1 - nominal)) if count else 1.0
    if rejected > 3 * expected and many < 0.025:
        return f"too tight: {text}; innovations are larger than the filter believes"
    if rejected < expected / 3 and few < 0.025:
        return f"too loose: {text}; innovations are smaller than the filter believes"
    return text


def shares_below(values: np.ndarray, levels: tuple[float, ...] = COVERAGE_LEVELS) -> dict[float, float]:
    """Share of NEES values inside the ellipsoid that should hold each share of them."""
    return {level: float(np.mean(values < chi2_quantile(level, POSE_DIMENSION))) for level in levels}
