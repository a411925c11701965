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

FAILURE = 1e-6  # probability with which a statistical bound is missed by a right program
REACH = scipy.stats.norm.isf(FAILURE / 2)

nees = jax.jit(jax.vmap(consistency.nees))
whiten = jax.jit(jax.vmap(consistency.whiten))
lag_one = jax.jit(consistency.lag_one)


def covariances(count, size, seed=0):
    """Covariances whose axes differ and are correlated."""
    rng = np.random.default_rng(seed)
    L = np.tril(rng.normal(size=(count, size, size))) * [1.0, 0.3, 0.05][:size]
    return L @ np.swapaxes(L, 1, 2) + np.diag([1e-2, 1e-3, 1e-4][:size])


# --- Normalised errors ---


def test_a_pose_error_is_truth_minus_estimate_with_the_heading_wrapped():
    error = consistency.pose_error(jnp.array([1.0, 5.0, 3.1]), jnp.array([3.0, 4.0, -3.1]))
    np.testing.assert_allclose(error, [-2, 1, 6.2 - 2 * math.pi], atol=1e-6)


def test_nees_is_the_quadratic_form_with_the_inverse(tolerance):
    P, errors = covariances(50, 3), np.random.default_rng(1).normal(size=(50, 3))
    expected = [reference.nees(e, cov) for e, cov in zip(errors, P, strict=True)]
    np.testing.assert_allclose(nees(jnp.array(errors), jnp.array(P)), expected, rtol=tolerance(1e-10, 1e-3))


def test_nees_of_a_singular_covariance_is_no_number():
    assert not np.isfinite(consistency.nees(jnp.ones(3), jnp.diag(jnp.array([1.0, 1.0, 0.0]))))


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


# --- Whiteness ---


def plain_lag_one(white, observed):
    """Pairs of an observation and the one before it of the same landmark, in plain loops."""
    products, squares, pairs = np.zeros(white.shape[-1]), np.zeros(white.shape[-1]), 0
    for j in range(observed.shape[1]):
        previous = None
        for k in range(len(observed)):
            if observed[k, j]:
                if previous is not None:
                    products += white[k, j] * previous
                    squares += white[k, j] ** 2
                    pairs += 1
                previous = white[k, j]
    return products, squares, pairs


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_lag_one_pairs_each_observation_with_the_last_of_its_landmark_across_gaps(share, tolerance):
    rng = np.random.default_rng(4)
    white, observed = rng.normal(size=(40, 3, 2)), rng.random((40, 3)) < share
    # Values of empty slots must not matter.
    got = lag_one(jnp.array(white), jnp.array(observed))
    for value, expected in zip(got, plain_lag_one(white, observed), strict=True):
        np.testing.assert_allclose(value, expected, rtol=tolerance(1e-12, 1e-4), atol=tolerance(1e-12, 1e-4))


def correlated_noise(rng, shape, rho):
    """AR(1) unit normals along axis 0."""
    noise = rng.normal(size=shape)
    for k in range(1, len(noise)):
        noise[k] = rho * noise[k - 1] + math.sqrt(1 - rho**2) * noise[k]
    return noise


@pytest.mark.parametrize("rho", [0.0, 0.05, 0.6, -0.3])
def test_lag_one_is_the_autocorrelation_and_its_band_holds_white_noise_alone(rho):
    rng = np.random.default_rng(5)
    # Every landmark is seen at times of its own: the process runs over its sightings.
    observed = rng.random((6000, 4)) < 0.5
    white = np.zeros((6000, 4, 2))
    for j in range(4):
        white[observed[:, j], j] = correlated_noise(rng, (observed[:, j].sum(), 2), rho)
    products, squares, pairs = lag_one(jnp.array(white), jnp.array(observed))
    found, band = np.asarray(products / squares), 1.96 / math.sqrt(pairs)
    # The estimate's standard error is sqrt((1 - rho²) / pairs).
    assert np.all(np.abs(found - rho) < REACH * math.sqrt((1 - rho**2) / pairs))
    assert np.all(np.abs(found) < band) == (rho == 0)


# --- Quantiles and bands ---


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
    value, error, band = judged([2.5], 3)
    assert value == 2.5
    assert math.isnan(error)
    assert band == (-math.inf, math.inf)


def test_no_run_has_no_value():
    value, error, band = consistency.mean_over_runs(0.0, 0.0, 0, 3)
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
        assert consistency.verdict(mean.value, mean.band_95).startswith("over-confident")


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


# --- Words ---


@pytest.mark.parametrize(
    ("anees", "band", "expected"),
    [
        (3.02, (2.9, 3.1), "consistent: ANEES 3.02 lies in its 95 % band [2.9, 3.1]"),
        (2.9, (2.9, 3.1), "consistent: ANEES 2.9 lies in its 95 % band [2.9, 3.1]"),
        (
            1.5,
            (2.9, 3.1),
            "under-confident: covariance 2 times too large (ANEES 1.5, 3 expected, 95 % band [2.9, 3.1])",
        ),
        (12.0, (2.9, 3.1), "over-confident: covariance 4 times too small (ANEES 12, 3 expected, 95 % band [2.9, 3.1])"),
        (12.0, None, "over-confident: covariance 4 times too small (ANEES 12, 3 expected, one run gives no band)"),
        (2.0, None, "under-confident: covariance 1.5 times too large (ANEES 2, 3 expected, one run gives no band)"),
        (
            0.0,
            (2.9, 3.1),
            "under-confident: covariance inf times too large (ANEES 0, 3 expected, 95 % band [2.9, 3.1])",
        ),
        (
            10138.2,
            None,
            "over-confident: covariance 3,379 times too small (ANEES 10,138, 3 expected, one run gives no band)",
        ),
        (math.nan, (2.9, 3.1), "not consistent: the NEES is not finite"),
        (math.inf, None, "not consistent: the NEES is not finite"),
    ],
)
def test_the_verdict_names_the_side_and_size_of_the_misfit(anees, band, expected):
    assert consistency.verdict(anees, band) == expected


@pytest.mark.parametrize("anees", [0.1, 3.0, 47.0])
def test_a_run_without_a_band_is_never_called_consistent(anees):
    text = consistency.verdict(anees, (-math.inf, math.inf))
    assert text.startswith({0.1: "under-confident", 3.0: "undecided", 47.0: "over-confident"}[anees])
    assert "one run gives no band" in text


@pytest.mark.parametrize("anees", [3.0, 1.0, 9.0, math.nan])
def test_diverged_runs_are_in_every_verdict(anees):
    assert consistency.verdict(anees, (2.9, 3.1), 4, 100).endswith("; 4 of 100 runs diverged")
    assert not consistency.verdict(anees, (2.9, 3.1), 4, 100).startswith("consistent")
    assert "diverged" not in consistency.verdict(anees, (2.9, 3.1), 0, 100)


@pytest.mark.parametrize(
    ("rate", "nominal", "begins"),
    [
        (0.7, None, "no gate: every observation is used"),
        (math.nan, 0.99, "nothing observed: the gate was never asked"),
        (0.3, 0.99, "locked out: the gate rejected 70 % of the observations, 1 % expected"),
        (0.96, 0.99, "too tight: the gate rejected 4 % of the observations, 1 % expected"),
        (0.998, 0.99, "too loose: the gate rejected 0.2 % of the observations, 1 % expected"),
        (1.0, 0.99, "too loose: the gate rejected 0 % of the observations, 1 % expected"),
        (0.985, 0.99, "the gate rejected 1.5 % of the observations, 1 % expected"),
        (0.4, 0.4, "the gate rejected 60 % of the observations, 60 % expected"),
        (0.1, 0.4, "locked out: the gate rejected 90 % of the observations, 60 % expected"),
    ],
)
def test_the_gate_s_verdict(rate, nominal, begins):
    assert consistency.gate_verdict(rate, nominal).startswith(begins)


@pytest.mark.parametrize(
    ("rejected", "observations", "word"),
    [
        (0, 100, None),  # a good filter shows none in 37 studies of 100
        (0, 1000, "too loose"),
        (2, 40, None),  # one in 16
        (8, 100, "too tight"),
        (60, 100, "locked out"),
        (1, 1, "locked out"),
    ],
)
def test_few_observations_do_not_condemn_a_gate(rejected, observations, word):
    text = consistency.gate_verdict(1 - rejected / observations, 0.99, observations)
    assert text.startswith(f"{word}: " if word else "the gate rejected")


def test_a_good_gate_is_condemned_in_at_most_5_studies_of_100():
    for observations in (10, 50, 200, 1000, 10_000):
        counts = np.arange(observations + 1)
        chance = scipy.stats.binom.pmf(counts, observations, 0.01)
        likely = counts[chance > 1e-12]
        condemned = [
            not consistency.gate_verdict(1 - count / observations, 0.99, observations).startswith("the gate")
            for count in likely
        ]
        assert chance[likely][np.array(condemned)].sum() <= 0.05


def test_shares_below_are_the_ellipsoids_shares():
    values = scipy.stats.chi2.ppf((np.arange(1000) + 0.5) / 1000, 3)
    assert consistency.shares_below(values) == {0.5: 0.5, 0.9: 0.9, 0.95: 0.95, 0.99: 0.99}
    assert consistency.shares_below(values / 4, (0.5,))[0.5] == pytest.approx(
        scipy.stats.chi2.cdf(4 * scipy.stats.chi2.ppf(0.5, 3), 3), abs=1e-3
    )
    assert consistency.shares_below(np.array([0.1, np.nan]), (0.9,)) == {0.9: 0.5}  # no number is in no ellipsoid
