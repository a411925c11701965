"""Statistics of consistency against NumPy and SciPy, sampled filters of known honesty, and the words for them."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats

from jaxlocmap import consistency
from jaxlocmap.consistency.means import average, run_averages

FAILURE = 1e-6  # probability with which a statistical bound is missed by a right program
REACH = scipy.stats.norm.isf(FAILURE / 2)

nees = jax.jit(jax.vmap(consistency.nees))
whiten = jax.jit(jax.vmap(consistency.whiten))
score_pose = jax.jit(consistency.score_pose)


def covariances(count, size, seed=0):
    """Covariances whose axes differ and are correlated."""
    rng = np.random.default_rng(seed)
    L = np.tril(rng.normal(size=(count, size, size))) * [1.0, 0.3, 0.05][:size]
    return L @ np.swapaxes(L, 1, 2) + np.diag([1e-2, 1e-3, 1e-4][:size])


# --- Normalised errors ---


def test_a_pose_error_is_truth_minus_estimate_with_the_heading_wrapped():
    error = consistency.pose_error(jnp.array([1.0, 5.0, 3.1]), jnp.array([3.0, 4.0, -3.1]))
    np.testing.assert_allclose(error, [-2, 1, 6.2 - 2 * math.pi], rtol=0, atol=1e-6)


def test_nees_is_the_quadratic_form_with_the_inverse(tolerance):
    P, errors = covariances(50, 3), np.random.default_rng(1).normal(size=(50, 3))
    expected = [reference.nees(e, cov) for e, cov in zip(errors, P, strict=True)]
    np.testing.assert_allclose(nees(jnp.array(errors), jnp.array(P)), expected, rtol=tolerance(1e-10, 1e-3))


def test_nees_of_a_singular_covariance_is_no_number():
    for last in (0.0, -1.0, math.nan):  # a covariance of no width, one that is none, one that is no number
        assert math.isnan(consistency.nees(jnp.ones(3), jnp.diag(jnp.array([1.0, 1.0, last]))))


@pytest.mark.parametrize("indefinite", [(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, -1.0)])
def test_a_covariance_with_one_negative_variance_scores_nothing_however_small_the_error_along_it(indefinite):
    error, P = jnp.array([0.1, 0.1, 0.1]) + jnp.array(indefinite) * 0.1, jnp.diag(jnp.array(indefinite))
    assert math.isnan(consistency.nees(error, P))  # of the plain quadratic form 0.08
    assert not np.any(jax.tree.leaves(score_pose(error, jnp.zeros(3), P)))


def test_an_indefinite_covariance_with_a_positive_diagonal_is_none():
    P = jnp.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert math.isnan(consistency.nees(jnp.array([1.0, -1.0, 0.0]), P))  # the plain quadratic form is -2


@pytest.mark.parametrize(
    ("atom", "shapes"),
    [
        ("pose_error", [(5, 3), (3,)]),
        ("pose_error", [(3,), (2,)]),
        ("nees", [(5, 3), (3, 3)]),
        ("nees", [(3,), (5, 3, 3)]),
        ("whiten", [(5, 2), (2, 2)]),
        ("whiten", [(2,), (5, 2, 2)]),
        ("score_pose", [(5, 3), (5, 3), (5, 3, 3)]),
    ],
)
def test_atoms_refuse_a_batch(atom, shapes):
    with pytest.raises(ValueError, match="expected shape"):
        getattr(consistency, atom)(*(jnp.ones(shape) for shape in shapes))


def test_the_score_of_a_pose_is_its_parts():
    P, truth, mean = covariances(1, 3)[0], np.array([1.0, 2.0, 3.1]), np.array([1.1, 1.9, -3.1])
    score = consistency.score_pose(*map(jnp.array, (truth, mean, P)))
    error = np.array([-0.1, 0.1, 6.2 - 2 * math.pi])
    assert score.scored
    assert float(score.nees) == pytest.approx(reference.nees(error, P), rel=1e-3)
    np.testing.assert_allclose(score.error_square, error**2, rtol=0, atol=1e-6)
    np.testing.assert_allclose(score.variance, np.diag(P), rtol=1e-6)
    np.testing.assert_allclose(score.axis_nees, error**2 / np.diag(P), rtol=1e-4)
    assert not score.diverged  # though its NEES says so, it is not a metre off
    assert consistency.score_pose(jnp.array(truth) + 1, jnp.array(mean), jnp.array(P)).diverged
    none = consistency.score_pose(jnp.array(truth), jnp.array(mean), -jnp.array(P))
    assert not none.scored
    assert not np.any(jax.tree.leaves(none))


@pytest.mark.parametrize(
    ("away", "nees", "lost"),
    [
        ((0.9, 0.5, 0.0), 100.0, True),  # together more than a metre
        ((0.8, 0.59, 0.0), 100.0, False),
        ((0.0, -1.01, 0.0), 100.0, True),
        ((0.5, 0.0, 3.0), 100.0, False),  # a heading is no distance
        ((2.0, 0.0, 0.0), 30.5, False),  # one honest pose in a million has a NEES of 30.66 and more
        ((2.0, 0.0, 0.0), 30.8, True),
    ],
)
def test_the_robot_is_lost_beyond_a_metre_and_a_millionth(away, nees, lost):
    assert scipy.stats.chi2.isf(1e-6, 3) == pytest.approx(30.66, abs=0.01)
    error = jnp.array(away)
    P = jnp.eye(3) * jnp.sum(error**2) / nees
    assert bool(score_pose(error, jnp.zeros(3), P).diverged) == lost


def test_the_documented_shares_are_those_of_normal_errors():
    assert pytest.approx(scipy.stats.norm.cdf(2) - scipy.stats.norm.cdf(-2)) == consistency.WITHIN_TWO_SIGMA
    assert consistency.COVERAGE_LEVELS == (0.5, 0.9, 0.95, 0.99)


def test_whitening_divides_by_the_root_of_each_part_in_order(tolerance):
    S, r = covariances(30, 2), np.random.default_rng(4).normal(size=(30, 2))
    expected = [np.linalg.solve(np.linalg.cholesky(cov), x) for cov, x in zip(S, r, strict=True)]
    np.testing.assert_allclose(whiten(jnp.array(r), jnp.array(S)), expected, rtol=tolerance(1e-9, 1e-2), atol=1e-4)
    indefinite = jnp.array([[[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]])
    white = np.asarray(whiten(jnp.ones((2, 2)), indefinite))
    np.testing.assert_array_equal(np.isfinite(white), [[True, False], [False, True]])


def test_whitened_innovations_are_uncorrelated_with_unit_variance():
    count = 20_000
    S = covariances(1, 2)[0]
    r = np.random.default_rng(2).multivariate_normal([0, 0], S, count)
    white = np.asarray(whiten(jnp.array(r), jnp.broadcast_to(jnp.array(S), (count, 2, 2))))
    # Of unit normals a sample variance has variance 2/n, a sample covariance 1/n.
    spread = REACH * np.sqrt(np.array([[2, 1], [1, 2]]) / count)
    assert np.all(np.abs(white.T @ white / count - np.eye(2)) < spread)


def test_whitening_keeps_the_mahalanobis_distance(tolerance):
    S, r = covariances(30, 2), np.random.default_rng(3).normal(size=(30, 2))
    white = np.asarray(whiten(jnp.array(r), jnp.array(S)))
    distance = np.einsum("ni,nij,nj->n", r, np.linalg.inv(S), r)
    np.testing.assert_allclose((white**2).sum(1), distance, rtol=tolerance(1e-10, 1e-3))


def test_an_empty_slot_whitens_to_zero():
    np.testing.assert_array_equal(whiten(jnp.zeros((1, 2)), jnp.zeros((1, 2, 2))), 0)


# --- Quantiles and bands ---


def correlated_noise(rng, shape, rho):
    """AR(1) unit normals along axis 0."""
    noise = rng.normal(size=shape)
    for k in range(1, len(noise)):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


@pytest.mark.parametrize("degrees", [1, 2, 3, 150, 7_200_000])
@pytest.mark.parametrize("probability", [1e-4, 0.025, 0.5, 0.95, 0.975, 0.9999])
def test_chi2_quantiles_are_scipy_s(probability, degrees):
    expected = scipy.stats.chi2.ppf(probability, degrees)
    assert consistency.chi2_quantile(probability, degrees) == pytest.approx(expected, rel=1e-9)


def test_the_chi2_band_of_known_studies():
    assert consistency.chi2_band(3, 50) == pytest.approx((2.360, 3.716), abs=5e-4)
    assert consistency.chi2_band(3, 1000) == pytest.approx((2.85, 3.15), abs=5e-3)
    assert consistency.chi2_band(2, 1) == pytest.approx(scipy.stats.chi2.interval(0.95, 2))
    assert consistency.chi2_band(3, 7, 0.8) == pytest.approx(np.array(scipy.stats.chi2.interval(0.8, 21)) / 7)


@pytest.mark.parametrize(("samples", "probability"), [(0, 0.95), (-3, 0.95), (5, 0.0), (5, 1.0), (5, math.nan)])
def test_a_band_of_nothing_is_refused(samples, probability):
    with pytest.raises(ValueError, match=r"expected (at least 1|a value inside \(0, 1\)), got"):
        consistency.chi2_band(3, samples, probability)


def judged(values, expected):
    """`mean_over_runs` of one average per run."""
    return consistency.mean_over_runs(float(np.sum(values)), float(np.sum(np.square(values))), len(values), expected)


@pytest.mark.parametrize("runs", [2, 3, 10, 500])
def test_the_band_over_runs_is_student_s_t(runs):
    values = 3 + 0.2 * np.random.default_rng(runs).normal(size=runs)
    mean = judged(values, 3)
    error = scipy.stats.sem(values)
    assert mean.value == pytest.approx(values.mean())
    assert mean.standard_error == pytest.approx(error, rel=1e-6)
    assert mean.band_95 == pytest.approx(scipy.stats.t.interval(0.95, runs - 1, loc=3, scale=error), rel=1e-6)


def test_one_run_has_a_value_and_no_band():
    value, error, samples, band = judged([2.5], 3)
    assert samples == 1
    assert value == 2.5
    assert math.isnan(error)
    assert band == (-math.inf, math.inf)


def test_no_run_has_no_value():
    value, error, samples, band = consistency.mean_over_runs(0.0, 0.0, 0, 3)
    assert samples == 0
    assert math.isnan(value)
    assert math.isnan(error)
    assert band == (-math.inf, math.inf)


def test_runs_without_spread_have_a_band_of_no_width():
    # total_square / runs - value² rounds to a little below zero here.
    mean = judged([2.1] * 7, 3)
    assert mean.standard_error == pytest.approx(0, abs=1e-7)
    assert mean.band_95 == pytest.approx((3, 3), abs=1e-6)


def test_a_lost_run_does_not_widen_the_band_until_it_holds_the_lost_run():
    # The spread of a sample with one huge value grows as fast as its mean: unlimited, the band would hold any ANEES.
    honest = np.random.default_rng(0).chisquare(3 * 40, 999) / 40
    for lost in (1e4, 1e9, 1e200):
        with np.errstate(over="ignore"):
            mean = judged([*honest, lost], 3)
        assert not mean.band_95[0] <= mean.value <= mean.band_95[1]


@pytest.mark.parametrize(("variance", "most"), [(None, 6.0), (0.25, 0.25)])
def test_the_band_is_no_wider_than_one_value_s_variance_makes_it(variance, most):
    values = np.array([3.0, 5.0, 1.0, 100.0])
    mean = consistency.mean_over_runs(values.sum(), np.square(values).sum(), 4, 3.0, variance)
    reach = scipy.stats.t.ppf(0.975, 3) * math.sqrt(most / 4)
    assert mean.band_95 == pytest.approx((3 - reach, 3 + reach), rel=1e-12)
    assert mean.standard_error == pytest.approx(scipy.stats.sem(values), rel=1e-12)
    assert (mean.value, mean.samples) == (27.25, 4)


@functools.cache
def studies():
    """Averages per run, (studies, runs), of a χ² with 3 degrees whose steps are strongly correlated in time."""
    rng = np.random.default_rng(6)
    repeats, runs, steps, rho = 1000, 30, 50, 0.9
    errors = correlated_noise(rng, (steps, repeats, runs, 3), rho)
    return (errors**2).sum(-1).mean(0), runs, steps


def test_the_band_over_runs_holds_the_mean_of_honest_correlated_runs_95_times_in_100():
    averages, _, _ = studies()
    held = 0
    for values in averages:
        mean = judged(values, 3)
        held += mean.band_95[0] <= mean.value <= mean.band_95[1]
    low, high = scipy.stats.binom.ppf([1e-3, 1 - 1e-3], len(averages), 0.95)
    assert low <= held <= high


def test_a_chi2_band_over_runs_times_steps_does_not_hold_it():
    # Why `mean_over_runs` exists: steps of a run are correlated, and that band takes them for independent.
    averages, runs, steps = studies()
    low, high = consistency.chi2_band(3, runs * steps)
    means = averages.mean(1)
    assert np.mean((low <= means) & (means <= high)) < 0.6


# --- One run, whose values are correlated in time ---


def honest_nees(rng, runs, steps, rho):
    """NEES (runs, steps) of an honest filter whose errors are AR(1)."""
    return np.sum(correlated_noise(rng, (steps, runs, 3), rho) ** 2, axis=-1).T


@pytest.mark.parametrize("rho", [0.0, 0.8, 0.98])
def test_the_correlation_time_is_that_of_the_process(rho):
    # NEES of AR(1) errors has the correlation rho² at lag one: τ = (1 + rho²) / (1 - rho²).
    expected = (1 + rho**2) / (1 - rho**2)
    found = [consistency.correlation_time(x) for x in honest_nees(np.random.default_rng(7), 40, 20_000, rho)]
    assert np.mean(found) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(("rho", "steps"), [(0.0, 200), (0.9, 2000), (0.98, 10_000)])
def test_the_band_of_one_run_holds_the_mean_of_an_honest_one(rho, steps):
    held = 0
    for values in honest_nees(np.random.default_rng(8), 400, steps, rho):
        mean = consistency.mean_over_time(values, 3)
        held += mean.band_95[0] <= mean.value <= mean.band_95[1]
    low, high = scipy.stats.binom.ppf([1e-4, 1 - 1e-4], 400, 0.94)  # near 95 %: a sum of χ² is a little skewed
    assert low <= held <= max(high, 394)


def correlation_time_in_loops(values):
    """1 + 2 Σ ρ up to the first lag of five times as much, over 1 - (2 M + 1) / T."""
    count, x = len(values), values - values.mean()
    time = 1.0
    for lag in range(count):
        time += 2 * np.sum(x[lag:] * x[: count - lag]) / np.sum(x * x) if lag else 0.0
        if lag >= 5 * time:
            return min(max(time / (1 - (2 * lag + 1) / count), 1.0), count)
    raise AssertionError("no lag closes the sum")


@pytest.mark.parametrize(("rho", "scale"), [(0.0, 1.0), (0.7, 1.0), (-0.6, 1.0), (0.7, 1.3), (0.7, 5.0), (0.7, 0.1)])
def test_the_mean_of_one_run_is_judged_by_the_formulas(rho, scale):
    """The band's variance is the series' own, between once and twice that of an honest filter."""
    values = scale * correlated_noise(np.random.default_rng(11), (500,), rho) * math.sqrt(6) + 3
    time = correlation_time_in_loops(values)
    assert consistency.correlation_time(values) == pytest.approx(time, rel=1e-9)
    mean, samples = consistency.mean_over_time(values, 3), 500 / time
    assert mean.samples == pytest.approx(samples, rel=1e-9)
    assert mean.standard_error == pytest.approx(values.std() / math.sqrt(samples), rel=1e-9)
    reach = scipy.stats.t.ppf(0.975, samples - 1) * math.sqrt(np.clip(values.var(), 6, 12) / samples)
    assert mean.band_95 == pytest.approx((3 - reach, 3 + reach), rel=1e-9)
    share = consistency.mean_over_time(values, 0.5, 0.25)
    reach *= math.sqrt(np.clip(values.var(), 0.25, 0.5) / np.clip(values.var(), 6, 12))
    assert share.band_95 == pytest.approx((0.5 - reach, 0.5 + reach), rel=1e-9)


def test_no_value_of_one_run_has_no_mean_and_one_has_no_error():
    none = consistency.mean_over_time(np.zeros(0), 3)
    assert (math.isnan(none.value), none.samples, none.band_95) == (True, 0, (-math.inf, math.inf))
    one = consistency.mean_over_time(np.array([2.0]), 3)
    assert (one.value, one.samples, math.isnan(one.standard_error)) == (2.0, 1, True)


def test_runs_are_averaged_over_the_steps_they_have():
    values = np.array([[1.0, np.nan, 3.0], [np.nan, np.nan, np.nan], [5.0, 7.0, np.nan]])
    np.testing.assert_array_equal(run_averages(values), [2, 6])
    mean = average(values, 3)
    assert (mean.value, mean.samples, mean.standard_error) == (4, 2, pytest.approx(2))
    alone = average(np.array([[np.nan, 1.0, np.nan, 4.0]]), 3)
    assert alone == consistency.mean_over_time(np.array([1.0, 4.0]), 3)


def test_a_series_too_short_to_tell_its_correlation_is_worth_one_value():
    assert consistency.correlation_time(np.arange(10.0)) == 10  # a trend
    assert consistency.correlation_time(np.ones(5)) == 5
    assert consistency.mean_over_time(np.arange(10.0), 3).samples == 1


def test_a_filter_that_is_wrong_by_much_makes_no_wide_band():
    values = 100 * honest_nees(np.random.default_rng(9), 1, 2000, 0.9)[0]
    mean = consistency.mean_over_time(values, 3)
    assert mean.band_95[1] < 4
    assert mean.interval_95[0] < 300 < mean.interval_95[1]  # around what was measured


def test_the_interval_around_a_mean_is_student_s_t():
    values = 3 + np.random.default_rng(1).normal(size=12)
    expected = scipy.stats.t.interval(0.95, 11, loc=values.mean(), scale=scipy.stats.sem(values))
    assert judged(values, 3).interval_95 == pytest.approx(expected, rel=1e-6)
    assert judged([1.0], 3).interval_95 == (-math.inf, math.inf)


@pytest.mark.parametrize(("count", "trials"), [(0, 10), (3, 10), (10, 10), (29_000, 1_000_000)])
def test_the_binomial_interval_is_scipy_s(count, trials):
    expected = scipy.stats.binomtest(count, trials).proportion_ci(0.95, method="exact")
    assert consistency.binomial_interval(count, trials) == pytest.approx(tuple(expected), rel=1e-9, abs=1e-12)
    wide = scipy.stats.binomtest(count, trials).proportion_ci(0.5, method="exact")
    assert consistency.binomial_interval(count, trials, 0.5) == pytest.approx(tuple(wide), rel=1e-9, abs=1e-12)


def test_a_ratio_has_the_errors_of_both():
    """To first order: the relative errors 0.1 and 0.2 of 6 and 3; if it is 1, those of 3 alone, 0.2 and 0.2."""
    of = consistency.Mean(6.0, 0.6, 40.0, (0.0, 0.0)), consistency.Mean(3.0, 0.6, 20.0, (0.0, 0.0))
    found = consistency.ratio(*of)
    assert (found.value, found.samples) == (2, 20)
    assert found.standard_error == pytest.approx(2 * math.hypot(0.1, 0.2), rel=1e-12)
    reach = scipy.stats.t.ppf(0.975, 19) * math.hypot(0.2, 0.2)
    assert found.band_95 == pytest.approx((1 - reach, 1 + reach), rel=1e-12)
    assert consistency.ratio(*of[::-1]).samples == 20


@pytest.mark.parametrize("samples", [1.0, 1.2, 1.5, 2.0, 30.0])
def test_student_s_t_has_one_degree_less_than_samples_and_half_of_one_at_least(samples):
    expected = scipy.stats.t.ppf(0.975, max(samples - 1, 0.5))
    assert consistency.student_t(samples) == pytest.approx(expected, rel=1e-9)
    assert consistency.student_t(samples, 0.8) == pytest.approx(scipy.stats.t.ppf(0.9, max(samples - 1, 0.5)), rel=1e-9)


def test_lag_one_of_several_runs_of_one_and_of_none():
    each = np.array([[0.1, -0.2], [0.3, 0.0], [0.2, 0.5]])
    mean, reach = consistency.mean_lag_one(each.sum(0), np.square(each).sum(0), 3, 50)
    np.testing.assert_allclose(mean, each.mean(0), rtol=1e-12)
    np.testing.assert_allclose(reach, scipy.stats.t.ppf(0.975, 2) * scipy.stats.sem(each), rtol=1e-12)
    mean, reach = consistency.mean_lag_one(each[0], each[0] ** 2, 1, 50)
    np.testing.assert_allclose((mean, reach), (each[0], [1.96 / math.sqrt(50)] * 2), rtol=1e-12)
    assert np.isnan(consistency.mean_lag_one(np.zeros(2), np.zeros(2), 0, 0)).all()


# --- The report ---


def test_each_field_of_a_report_is_of_its_own_mean():
    numbers = iter(range(1, 99))

    def mean():
        value = float(next(numbers))
        return consistency.Mean(value, value / 10, value + 2, (value - 0.5, value + 0.25))

    def means(count):
        return tuple(mean() for _ in range(count))

    made = consistency.PoseMeans(mean(), mean(), means(3), means(3), means(4), means(2), ((0.0, 1.0), (1.5, 2.0)))
    fields = consistency.pose_fields(made)
    nees = made.nees
    assert [fields[f"anees{name}"] for name in ("", "_standard_error", "_band_95")] == [1.0, 0.1, nees.band_95]
    assert (fields["anees_interval_95"], fields["independent_samples"]) == (nees.interval_95, 3.0)
    for name, of in (("axis_nees", made.axis_nees), ("within_two_sigma", made.within_two_sigma)):
        assert list(fields[name].items()) == [(axis, m.value) for axis, m in zip(("x", "y", "yaw"), of, strict=True)]
        assert list(fields[f"{name}_interval_95"].values()) == [m.interval_95 for m in of]
    for level, m in zip((50, 90, 95, 99), made.covered, strict=True):
        assert (fields[f"coverage_{level}"], fields[f"coverage_{level}_interval_95"]) == (m.value, m.interval_95)
    assert fields["nees_phases"] == [
        {"from_s": begin, "to_s": end, "anees": m.value, "band_95": m.band_95}
        for (begin, end), m in zip(made.phase_spans, made.phases, strict=True)
    ]


def test_the_share_of_steps_in_their_band_counts_its_ends_and_stays_a_share():
    values = np.tile([2.0, 1.9, 4.0, 4.1, 3.0, 3.0, 3.0, 3.0], 50)
    fields = consistency.share_in_band(values, (2.0, 4.0))
    assert fields["nees_steps_in_band"] == 0.75
    inside = np.isin(values, (2.0, 3.0, 4.0)).astype(float)
    samples = 400 / consistency.correlation_time(inside)
    reach = scipy.stats.t.ppf(0.975, samples - 1) * math.sqrt(min(max(inside.var(), 0.0475), 0.095) / samples)
    assert fields["nees_steps_in_band_interval_95"] == pytest.approx((0.75 - reach, min(0.75 + reach, 1)), rel=1e-9)
    every = consistency.share_in_band(np.tile([3.0, 3.0, 3.0, 9.0], 5), (2.0, 4.0))["nees_steps_in_band_interval_95"]
    none = consistency.share_in_band(np.tile([9.0, 9.0, 9.0, 3.0], 5), (2.0, 4.0))["nees_steps_in_band_interval_95"]
    assert 0 <= none[0] < none[1] <= 1
    assert 0 <= every[0] < every[1] <= 1


def test_components_are_range_and_bearing_or_their_numbers():
    assert consistency.by_component(np.array([1.0, 2.0])) == {"range": 1.0, "bearing": 2.0}
    assert consistency.by_component(np.array([1.0, 2.0, 3.0])) == {"0": 1.0, "1": 2.0, "2": 3.0}
