"""Statistics of normalised errors: NEES and its score at one step, whiteness, means and how far they can be trusted.

The first half works on JAX arrays, inside the loop and inside `vmap`; the second half works on the host, in float64.
A pose error is truth minus estimate with the heading wrapped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from jaxlocmap import checks
from jaxlocmap.ekf import gate_threshold
from jaxlocmap.linalg import Matrix, forward, ldl
from jaxlocmap.motion import wrap

POSE_DIMENSION = 3
COVERAGE_LEVELS = (0.50, 0.90, 0.95, 0.99)
WITHIN_TWO_SIGMA = math.erf(math.sqrt(2))  # of the values of a normal variable
# The robot is lost where a pose is further off than this, and the filter all but excludes that itself. The second half
# spares a filter that has seen nothing for long and says so.
_LOST_DISTANCE = 1.0  # m
_LOST_TAIL = 1e-6  # of honest poses have such a NEES
_WINDOW = 5.0  # correlation times that the sum over lags takes in


def pose_error(truth: jax.Array, estimate: jax.Array) -> jax.Array:
    """Truth minus estimate, (3,) m, m, rad, heading wrapped.

    Args:
        truth: (3,) m, m, rad.
        estimate: (3,) m, m, rad.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    checks.shape("truth", truth, (3,))
    checks.shape("estimate", estimate, (3,))
    error = truth - estimate
    return jnp.stack([error[0], error[1], wrap(error[2])])


def nees(error: jax.Array, cov: jax.Array) -> jax.Array:
    """Normalised estimation error squared, eᵀ P⁻¹ e: χ² with 3 degrees if the covariance is honest.

    Args:
        error: (3,) m, m, rad, from `pose_error`.
        cov: (3, 3) the estimate's covariance, of which the upper triangle is read.

    Returns:
        () >= 0; NaN where the covariance is not positive definite.
        Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.

    Raises:
        ValueError: a wrong shape; a batch is a `vmap`.
    """
    checks.shape("error", error, (3,))
    checks.shape("cov", cov, (3, 3))
    L, D = ldl(Matrix.symmetric(cov))
    definite = (D[0] > 0) & (D[1] > 0) & (D[2] > 0)
    distance = sum(y * y / d for y, d in zip(forward(L, tuple(error)), D, strict=True))
    return jnp.where(definite, distance, jnp.nan)


class PoseScore(NamedTuple):
    """One pose against its truth. What is not scored counts zero everywhere."""

    scored: jax.Array  # () bool: everything is finite and the covariance positive definite
    nees: jax.Array  # ()
    error_square: tuple[jax.Array, ...]  # x, y, yaw: () each, m², m², rad²
    variance: tuple[jax.Array, ...]  # the same of the filter's own
    axis_nees: tuple[jax.Array, ...]  # of each axis alone, error² / σ²
    lost: jax.Array  # () bool: over a metre off, and the covariance all but excludes it


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
    square = [jnp.where(scored, error[i] ** 2, 0) for i in range(3)]
    variance = [jnp.where(scored, cov[i, i], 0) for i in range(3)]
    ratio = [jnp.where(scored, square[i] / cov[i, i], 0) for i in range(3)]
    surprising = distance > chi2_quantile(1 - _LOST_TAIL, POSE_DIMENSION)
    lost = scored & (square[0] + square[1] > _LOST_DISTANCE**2) & surprising
    return PoseScore(scored, jnp.where(scored, distance, 0), tuple(square), tuple(variance), tuple(ratio), lost)


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


class Mean(NamedTuple):
    """A mean of dependent samples and how far it can be trusted."""

    value: float
    standard_error: float  # NaN where nothing tells it
    samples: float  # independent ones: runs, or the effective number of one run's steps
    band_95: tuple[float, float]  # where the mean lies in 95 of 100 studies if the expectation is met

    @property
    def interval_95(self) -> tuple[float, float]:
        """Where the expectation lies, whatever it is, in 95 of 100 studies: value ± t · standard error."""
        if not math.isfinite(self.standard_error):
            return -math.inf, math.inf
        reach = student_t(self.samples) * self.standard_error
        return self.value - reach, self.value + reach


_NO_MEAN = Mean(math.nan, math.nan, 0.0, (-math.inf, math.inf))


def student_t(samples: float, probability: float = 0.95) -> float:
    """Student's t with samples - 1 degrees, the two-sided quantile that holds `probability`."""
    return float(scipy.special.stdtrit(max(samples - 1, 0.5), (1 + probability) / 2))


def mean_over_runs(
    total: float, total_square: float, runs: int, expected: float, variance: float | None = None
) -> Mean:
    """Judge a per-run average by its spread between runs.

    Values within a run are correlated in time, so the number of steps says nothing about the precision of their
    average; runs are independent, so the spread of the runs' averages does (batch means, Law 2015, section 9.5.3).

    Args:
        total, total_square: sum over runs of the per-run average and of its square. runs: their number.
        expected: the value if the filter is consistent: for an average of χ² variables their degrees of freedom.
        variance: of a single value if the filter is consistent; by default that of χ², 2 * expected.

    Returns:
        `Mean`, the band being Student's t with runs - 1 degrees around `expected`; infinite for a single run. However
        correlated, an average varies no more than one of its values: the band is no wider than `variance` makes it,
        however large the spread. That limit is far out for runs of many steps: one lost run among hundreds makes the
        band several times as wide, which is why a study reports the mean without them, and the median, too.
    """
    if runs < 1:
        return _NO_MEAN
    value = total / runs
    if runs < 2:
        return _NO_MEAN._replace(value=value, samples=1.0)
    spread = max(total_square / runs - value * value, 0.0) * runs / (runs - 1)
    error = math.sqrt(spread / runs)
    most = math.sqrt((2 * expected if variance is None else variance) / runs)
    reach = student_t(runs) * min(error, most)
    return Mean(value, error, float(runs), (expected - reach, expected + reach))


def correlation_time(values: np.ndarray) -> float:
    """How many steps of a correlated series tell its mean as well as one independent value would.

        τ = 1 + 2 Σ_{k=1..M} ρ_k,  M the first lag >= 5 τ;  then τ / (1 - (2 M + 1) / T)

    The last factor mends what is lost by taking the correlations ρ about the series' own mean.

    Args:
        values: (T,), finite.

    Returns:
        Steps, between 1 and T: T where the series is too short to tell.
        Source: Sokal 1997, section 3; Anderson 1971, section 8.3 (the correction).
    """
    count = len(values)
    centred = values - np.mean(values)
    spectrum = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    products = np.fft.irfft(spectrum, 2 * count)[:count]
    if not products[0] > 0:
        return float(count)
    times = 2 * np.cumsum(products / products[0]) - 1
    closed = np.arange(count) >= _WINDOW * times
    window = int(np.argmax(closed)) if closed.any() else count
    left = 1 - (2 * window + 1) / count
    return float(np.clip(times[min(window, count - 1)] / left, 1, count)) if left > 0 else float(count)


def mean_over_time(values: np.ndarray, expected: float, variance: float | None = None) -> Mean:
    """Judge the average of one run by the correlation time of its values.

    Args:
        values: (T,), finite, in order of time.
        expected, variance: as in `mean_over_runs`.

    Returns:
        `Mean`; `samples` is the effective number T / τ of independent values (`correlation_time`), the band Student's
        t with samples - 1 degrees around `expected`. The variance it takes is the series' own, kept between once and
        twice that of a consistent filter: a filter that is wrong by much makes no wide band around what is right.
    """
    if not len(values):
        return _NO_MEAN
    own, honest = float(np.var(values)), 2 * expected if variance is None else variance
    samples = len(values) / correlation_time(values)
    reach = student_t(samples) * math.sqrt(min(max(own, honest), 2 * honest) / samples)
    error = math.sqrt(own / samples) if len(values) > 1 else math.nan
    return Mean(float(np.mean(values)), error, samples, (expected - reach, expected + reach))


def run_averages(values: np.ndarray) -> np.ndarray:
    """Each run's mean over its steps, (runs, ...) of (N, T, ...), of the runs that have any; NaN is left out."""
    values = values[np.isfinite(values).reshape(len(values), -1).any(1)]
    return np.nansum(values, axis=1) / np.sum(np.isfinite(values), axis=1)


def average(values: np.ndarray, expected: float, variance: float | None = None) -> Mean:
    """`mean_over_runs` of values (N, T), or `mean_over_time` of those of a single run; NaN is left out."""
    if len(values) == 1:
        return mean_over_time(values[0][np.isfinite(values[0])], expected, variance)
    each = run_averages(values)
    return mean_over_runs(float(each.sum()), float(np.square(each).sum()), len(each), expected, variance)


def ratio(mean: Mean, reference: Mean) -> Mean:
    """A mean over that of a reference, to first order; both independent of each other.

    Returns:
        `Mean` whose band is around 1, and whose samples are the fewer of the two.
    """
    value = mean.value / reference.value
    relative = [m.standard_error / m.value for m in (mean, reference)]
    error = abs(value) * math.hypot(*relative)
    samples = min(mean.samples, reference.samples)
    reach = student_t(samples) * math.hypot(*(m.standard_error / reference.value for m in (mean, reference)))
    return Mean(value, error, samples, (1 - reach, 1 + reach))


def binomial_interval(count: int, trials: int, probability: float = 0.95) -> tuple[float, float]:
    """Interval of a share that holds it with at least `probability` if the trials are independent.

    Source: Clopper & Pearson 1934.
    """
    tail = (1 - probability) / 2
    low = float(scipy.special.betaincinv(count, trials - count + 1, tail)) if count else 0.0
    high = float(scipy.special.betaincinv(count + 1, trials - count, 1 - tail)) if count < trials else 1.0
    return low, high


def mean_lag_one(total: np.ndarray, square: np.ndarray, runs: int, pairs: float) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of each innovation with the one before it of the same landmark, and how far it may be off.

    Of one run it is 2 Σ aₖ bₖ / Σ (aₖ² + bₖ²) over its pairs of whitened innovations: never beyond ±1, whatever a run
    that has lost the robot makes of them, and 0 on average for a consistent filter. Of many runs it is their mean.

    Args:
        total, square: (m,) sums over runs of the run's correlation and of its square, for each component.
        runs: that have any pair. pairs: of all runs.

    Returns:
        (m,) the mean and (m,) half the width of its 95 % interval: from the spread between runs, of a single run
        1.96 / √pairs.
        Source: Burg 1975 (the correlation); Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2 (the test).
    """
    if not runs:
        return np.full_like(total, np.nan), np.full_like(total, np.nan)
    mean = total / runs
    if runs == 1:
        return mean, np.full_like(mean, 1.96 / math.sqrt(pairs))
    spread = np.maximum(square / runs - mean**2, 0) / (runs - 1)
    return mean, student_t(runs) * np.sqrt(spread)
