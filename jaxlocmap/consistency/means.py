"""Means of dependent samples, over the runs of a study or the steps of one run, and how far they can be trusted.

On the host, in float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy.special

_WINDOW = 5.0  # correlation times that the sum over lags takes in


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
        total, total_square: sum over runs of the per-run average and of its square.
        runs: their number.
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
        runs: that have any pair.
        pairs: of all runs.

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
