"""What one run adds to a study, from steps and observations made up by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Gaussian
from jaxlocmap.consistency import scoring
from jaxlocmap.step import Observation

scored = jax.jit(scoring.score_step, static_argnames="angles")
observed = jax.jit(scoring.score_observation)
totals = jax.jit(lambda *args: scoring.run_totals(*args, None, length=8, exact_start=False))


@pytest.mark.parametrize("steps", [1, 3, 4, 7, 8, 50])
def test_a_step_is_in_the_phase_that_its_share_of_the_drive_says(steps):
    edges = scoring.phase_edges(steps)
    assert (edges[0], edges[-1], len(edges)) == (0, steps, 5)
    phase = [next(i for i in range(4) if edges[i] <= k < edges[i + 1]) for k in range(steps)]
    assert phase == [4 * k // steps for k in range(steps)]


def test_bins_of_runs_are_five_percent_wide_from_a_tenth_to_ten_thousand():
    assert scoring.NEES_EDGES[0] == pytest.approx(0.1)
    np.testing.assert_allclose(np.diff(np.log(scoring.NEES_EDGES)), 0.05, rtol=1e-9)
    assert 1e4 * np.exp(-0.05) <= scoring.NEES_EDGES[-1] <= 1e4


def step(error, cov, ok=True, phase=2):
    truth = jnp.array([1.0, 2.0, 3.0])
    belief = Gaussian(truth - jnp.array(error), jnp.array(cov))
    return scored(belief, truth, jnp.array(ok), jnp.array(phase), angles=(2,))


def test_a_step_is_within_two_sigma_of_each_axis_and_inside_each_ellipsoid():
    """NEES of 1.99² + 2.01² + 0.1² = 8.01: outside the ellipsoid of 95 % (7.81) and inside that of 99 % (11.34)."""
    tally, square, variance = step([1.99 * 0.1, -2.01 * 0.2, 0.1 * 0.3], np.diag([0.01, 0.04, 0.09]))
    assert tally.within_two_sigma.tolist() == [1, 0, 1]
    assert tally.covered.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(tally.axis_nees, [1.99**2, 2.01**2, 0.01], rtol=1e-4)
    np.testing.assert_allclose(tally.phase_nees, [0, 0, float(tally.nees), 0])
    np.testing.assert_allclose(square, [0.199**2, 0.402**2, 0.03**2], rtol=1e-4)
    np.testing.assert_allclose(variance, [0.01, 0.04, 0.09], rtol=1e-6)
    assert (float(tally.scored), float(tally.flagged), float(tally.diverged)) == (1, 0, 0)
    assert float(step([0.0, 0.0, 0.0], np.eye(3), ok=False)[0].flagged) == 1


def test_an_indefinite_covariance_counts_nowhere():
    cov = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    tally, square, variance = step([0.5, 0.5, 0.1], cov)
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves((tally, square, variance)))


def observation(innovation=(0.3, 0.1), S=((0.09, 0.0), (0.0, 0.04)), nis=1.25, accepted=True):
    return Observation(*[None] * len(Observation._fields))._replace(
        innovation=jnp.array(innovation), S=jnp.array(S), nis=jnp.array(nis), accepted=jnp.array(accepted)
    )


def seen(white=None):
    values = jnp.array(white or (0.0, 0.0))
    return scoring.Latest(jnp.array(white is not None), (values[0], values[1]))


def test_an_observation_is_paired_with_the_one_before_it():
    """Whitened it is (1, 0.5)."""
    yes, no = jnp.array(True), jnp.array(False)
    tally, latest = observed(observation(), yes, yes, seen((2.0, -4.0)))
    np.testing.assert_allclose(tally.lag_products, [2, -2], rtol=1e-6)
    np.testing.assert_allclose(tally.lag_squares, [(1 + 4) / 2, (0.25 + 16) / 2], rtol=1e-6)
    assert [float(x) for x in tally[:5]] == [1, 1.25, 1, 0, 0]
    assert float(tally.lag_pairs) == 1
    np.testing.assert_allclose(latest.white, [1, 0.5], rtol=1e-6)
    first, latest = observed(observation(accepted=False), yes, yes, seen())
    assert not np.any(first.lag_squares)
    assert (float(first.lag_pairs), float(first.accepted)) == (0, 0)
    assert bool(latest.seen)
    # Of one that could not be used nothing is scored, and the one before it stays the last.
    for none in (observation(S=np.zeros((2, 2)), nis=0.0), observation(innovation=(np.nan, 0.1), nis=np.nan)):
        tally, latest = observed(none, yes, no, seen((2.0, -4.0)))
        assert [float(x) for x in (*tally[:2], *tally[3:5], tally.lag_pairs)] == [0, 0, 1, 1, 0]
        assert [float(x) for x in latest.white] == [2, -4]
        assert not np.any(tally.lag_products)
    empty, latest = observed(observation(S=np.zeros((2, 2)), nis=0.0, accepted=False), no, no, seen())
    assert not any(np.any(np.asarray(x)) for x in jax.tree.leaves((empty, latest)))


def run(nees=3.0, count=8.0, diverged=0.0, cov=1.0, lag=((1.0, -2.0), (2.0, 8.0))):
    """Steps of a run of eight, of which so many are scored, each with this NEES."""
    tally = scoring.no_steps(jnp.zeros(()).dtype, whole_state=False)._replace(
        scored=jnp.array(count),
        nees=jnp.array(count * nees),
        axis_nees=count * jnp.array([1.0, 2.0, 4.0]),
        within_two_sigma=count * jnp.array([0.5, 0.75, 1.0]),
        covered=count * jnp.array([0.1, 0.2, 0.3, 0.4]),
        phase_nees=jnp.array([2.0, 4.0, 6.0, 8.0]),
        diverged=jnp.array(diverged),
    )
    observations = scoring.no_observations(jnp.zeros(()).dtype, 2)._replace(
        observed=jnp.array(4.0),
        nis=jnp.array(6.0),
        lag_products=jnp.array(lag[0]),
        lag_squares=jnp.array(lag[1]),
    )
    pairs = observations._replace(lag_pairs=jnp.array(3.0))
    return totals(tally, pairs, jnp.zeros(3), Gaussian(jnp.zeros(3), cov * jnp.eye(3)))


def test_a_run_adds_its_averages_and_their_squares():
    got = run()
    for name, values in {"nees": 3, "within_two_sigma": [0.5, 0.75, 1], "covered": [0.1, 0.2, 0.3, 0.4]}.items():
        np.testing.assert_allclose(getattr(got["average"], name), values, rtol=1e-6)
        np.testing.assert_allclose(getattr(got["average_square"], name), np.square(values), rtol=1e-6)
    for name, values in {"nees": 3, "axis_nees": [1, 2, 4], "phase_nees": [1, 2, 3, 4]}.items():  # phases of two steps
        np.testing.assert_allclose(getattr(got["undiverged"], name), values, rtol=1e-6)
        np.testing.assert_allclose(getattr(got["undiverged_square"], name), np.square(values), rtol=1e-6)
    np.testing.assert_allclose(got["run_nis"], [1.5, 2.25], rtol=1e-6)
    np.testing.assert_allclose(got["lag_one"], [[0.5, -0.25], [0.25, 0.0625]], rtol=1e-6)
    ones = ("runs", "scored_runs", "undiverged_runs", "whole_runs", "observing_runs", "lag_runs")
    assert [float(got[name]) for name in ones] == [1] * 6
    assert (float(got["exact_starts"]), float(got["diverged"]), float(got["lag_pairs"])) == (0, 0, 3)


def test_innovations_of_zero_are_not_correlated():
    got = run(lag=((0.0, -2.0), (0.0, 8.0)))
    np.testing.assert_allclose(got["lag_one"], [[0, -0.25], [0, 0.0625]], rtol=1e-6)
    assert float(got["lag_runs"]) == 1


@pytest.mark.parametrize(
    ("changed", "scored_runs", "kept", "whole", "diverged"),
    [
        ({"count": 7.0}, 1, 1, 0, 0),  # a step without a score: no phase can be compared
        ({"count": 0.0}, 0, 0, 0, 0),
        ({"diverged": 2.0}, 1, 0, 0, 1),
        ({"cov": np.nan}, 1, 0, 0, 1),  # no belief at the end
    ],
)
def test_runs_that_went_wrong_are_left_out_where_they_would_outweigh_the_others(
    changed, scored_runs, kept, whole, diverged
):
    got = run(**changed)
    names = ("scored_runs", "undiverged_runs", "whole_runs", "diverged")
    assert [float(got[name]) for name in names] == [scored_runs, kept, whole, diverged]
    assert bool(got["undiverged"].nees > 0) == bool(kept)
    np.testing.assert_allclose(got["undiverged"].axis_nees, kept * np.array([1, 2, 4]), rtol=1e-6)
    assert np.any(got["undiverged"].phase_nees) == bool(whole)
    assert float(got["nees_bins"].sum()) == scored_runs
    assert float(got["average"].nees) == 3 * scored_runs


@pytest.mark.parametrize(
    ("nees", "place"), [(0.05, 0), (0.104, 1), (0.11, 2), (3.0, 69), (1e9, len(scoring.NEES_EDGES))]
)
def test_a_run_is_counted_in_the_bin_of_its_average(nees, place):
    assert place == np.searchsorted(scoring.NEES_EDGES, nees)
    assert np.flatnonzero(np.asarray(run(nees=nees)["nees_bins"])).tolist() == [place]
