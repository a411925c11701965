"""Matches scored in a study: against `run` and NumPy, drive by drive."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Gaussian, init, run, simulation
from jaxlocmap.consistency import match_scoring
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.matching import submaps
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.se2 import between
from jaxlocmap.types import Matcher

DRIVE = dataclasses.replace(simulation.LOOP, steps=90, exact_prior=False, prior_std=(0.01, 0.01, 0.01), beams=31)
NOISE, PRIOR = simulation.Noise(), DRIVE.prior()
WORLD = simulation.room()._replace(landmarks=jnp.zeros((0, 2)))
MATCHER = Matcher(period=5, gap=1.0, half_width=9.0, steps=4, submap_scans=4)
CONFIG = dataclasses.replace(DRIVE.config(motion="euler", grid=False), matcher=MATCHER)
PARAMS = submaps.with_defaults(simulation.own_params(NOISE, DRIVE))
RUNS = 3


@pytest.fixture(scope="module")
def totals():
    study = Study(DRIVE, CONFIG)
    return monte_carlo(study, jax.random.key(5), RUNS, PARAMS, WORLD, NOISE, PRIOR, chunk=RUNS).value


@pytest.fixture(scope="module")
def reports():
    """The same drives through `run`: true poses (runs, T, 3) and what was reported."""

    def one(key):
        start_key, key = jax.random.split(key)
        start = simulation.draw_start(start_key, PRIOR, scenario=DRIVE)
        truth, inputs = simulation.simulate(key, WORLD, NOISE, start, scenario=DRIVE)
        state = init(PRIOR, config=CONFIG)
        _, info = run(PARAMS, state, inputs, beam_angles=DRIVE.beam_angles(), config=CONFIG)
        return truth.state, info.match

    keys = jax.vmap(lambda i: jax.random.fold_in(jax.random.key(5), i))(jnp.arange(RUNS))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


def in_frame_of(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    x, y = np.array([[c, s], [-s, c]]) @ (b - a)[:2]
    return np.array([x, y, (b - a)[2]])


def test_a_study_scores_what_run_reports(totals, reports, tolerance):
    truth, match = reports
    nees = {"relative": [[] for _ in range(RUNS)], "edge": [[] for _ in range(RUNS)]}
    for r in range(RUNS):
        older = younger = None
        for k in range(DRIVE.steps):
            pose = truth[r, k]
            pairs = []
            if match.tried[r, k]:
                pairs.append(("relative", older, pose, match.relative))
            if match.finished[r, k]:
                pairs.append(("edge", older, younger, match.edge))
                older = younger
            for name, a, b, belief in pairs:
                error = in_frame_of(a, b) - belief.mean[r, k]
                error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
                nees[name][r].append(error @ np.linalg.solve(belief.cov[r, k].astype(float), error))
            older = pose if match.anew[r, k] else older
            younger = pose if match.begun[r, k] else younger
    sums = totals.match.sums
    assert float(sums.tried) == match.tried.sum() == RUNS * 17
    assert float(sums.accepted) == match.accepted.sum()
    for reason, counted in submaps.refusals(match, MATCHER)._asdict().items():
        assert float(getattr(sums.refused, reason)) == counted.sum()
    assert float(sums.edge.scored) == match.finished.sum() > 0
    np.testing.assert_allclose(sums.nis, match.nis.sum(), rtol=tolerance(1e-7, 1e-2))
    for i, (name, one) in enumerate((("relative", sums.pose), ("edge", sums.edge))):
        np.testing.assert_allclose(one.nees, sum(map(sum, nees[name])), rtol=tolerance(1e-6, 5e-2))
        averages = np.array([np.mean(x) for x in nees[name]])
        np.testing.assert_allclose(totals.match.nees[i], averages.sum(), rtol=tolerance(1e-6, 5e-2))
        np.testing.assert_allclose(totals.match.nees_square[i], (averages**2).sum(), rtol=tolerance(1e-6, 1e-1))
        assert totals.match.runs[i] == RUNS


def test_a_report_names_what_matches_tell(totals):
    report = summarise(totals, CONFIG)
    assert report["matches"] == RUNS * 17
    assert 0.9 < report["match_accept_rate"] <= 1
    assert 0.8 < report["match_points_used"] <= 1
    assert report["submaps_begun_anew"] == 0
    counts = np.arange(1.0, 5.0)
    refused = totals._replace(
        match=totals.match._replace(sums=totals.match.sums._replace(refused=submaps.Refusals(*counts)))
    )
    names = ("points", "share", "nis", "convergence")
    assert [summarise(refused, CONFIG)[f"match_refused_{name}"] for name in names] == [1, 2, 3, 4]
    assert report["relative_count"] == report["matches"]
    assert report["edge_count"] == RUNS * 3
    for name in ("relative", "edge"):
        assert report[f"{name}_anees"] < 9
        assert 0 < report[f"{name}_rmse_position_m"] < 0.1
        assert 0.2 < report[f"{name}_sigma_position_m"] / report[f"{name}_rmse_position_m"] < 5
    assert "matches" not in summarise(totals._replace(match=None), CONFIG)


def test_errors_and_anchors_of_one_step():
    """An error of (3, 4) cm in the frame of an anchor turned by 90 degrees, with a variance of 1 cm² each."""
    older, younger, truth = jnp.array([1.0, 2.0, np.pi / 2]), jnp.array([1.0, 3.0, 0.0]), jnp.array([0.0, 4.0, np.pi])
    exact, _, _ = between(older, truth)
    np.testing.assert_allclose(exact, [2.0, 1.0, np.pi / 2], rtol=0, atol=1e-6)
    belief = Gaussian(exact - jnp.array([0.03, 0.04, 0.0]), 1e-4 * jnp.eye(3))
    none = submaps.no_match(truth.dtype)
    report = none._replace(
        tried=jnp.array(True), accepted=jnp.array(True), points=jnp.array(20), used=jnp.array(15), relative=belief
    )
    tally, anchors = match_scoring.score_match(report, truth, (older, younger), MATCHER)
    np.testing.assert_allclose(tally.pose.nees, 25, rtol=1e-4)
    np.testing.assert_allclose(tally.pose.error_square, [9e-4, 16e-4, 0], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(tally.used, 0.75)
    assert tally.edge.scored == 0
    np.testing.assert_array_equal(anchors, (older, younger))
    _, anchors = match_scoring.score_match(report._replace(begun=jnp.array(True)), truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (older, truth))
    swap = report._replace(begun=jnp.array(True), finished=jnp.array(True), edge=belief)
    tally, anchors = match_scoring.score_match(swap, truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (younger, truth))
    assert tally.edge.scored == 1
    again = none._replace(anew=jnp.array(True), submap=jnp.array(3))
    tally, anchors = match_scoring.score_match(again, truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (truth, younger))
    assert tally.anew == 1
    assert tally.tried == tally.pose.scored == 0
    few = none._replace(due=jnp.array(True), points=jnp.array(MATCHER.least_points - 1))
    refused = match_scoring.score_match(few, truth, (older, younger), MATCHER)[0].refused
    assert [float(count) for count in refused] == [1, 0, 0, 0]
    first = again._replace(submap=jnp.array(-1))
    assert match_scoring.score_match(first, truth, (older, younger), MATCHER)[0].anew == 0
