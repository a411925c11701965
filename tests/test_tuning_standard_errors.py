"""Standard errors against differences, and the words for what the data cannot tell."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from drives import ONLY_POSES, OWN, drives

from jaxlocmap import Config, tuning
from jaxlocmap.tuning.slopes import Evaluation, evaluate
from jaxlocmap.tuning.standard_errors import _judge, _jumps

NAMES = ("w", "range")


def test_it_is_the_quadratic_form_of_differences(x64):
    """Of a sum of losses, one of which is no mean over sequences; sums by the program that its gradients come from."""
    objective = tuning.Objective(ONLY_POSES, (("nis", 1.0), ("innovation_nll", 5.0)))
    batch, h = drives(scans=False), 1e-4
    whole, tuned = tuning.unconstrain(OWN), (*NAMES, "l_occ")
    value = jax.jit(lambda sums: objective.value(sums)[0])

    @functools.cache
    def sums(x):
        there = whole | dict(zip(NAMES, x, strict=True))
        return evaluate(objective, {name: jnp.asarray(np.float64(there[name])) for name in tuned}, OWN, batch).sums

    def gradient(at, share):
        """By differences, sequence n counting 1 + share[n] times."""
        slopes = []
        for i in range(2):
            values = []
            for sign in (1, -1):
                tallied = sums(tuple(at + sign * h * np.eye(2)[i]))
                values.append(float(value(jax.tree.map(lambda s: np.sum(s * (1 + share)), tallied))))
            slopes.append((values[0] - values[1]) / (2 * h))
        return np.array(slopes)

    at, none = np.array([float(whole[name]) for name in NAMES]), np.zeros(4)
    hessian = np.stack([(gradient(at + d, none) - gradient(at - d, none)) / 2e-3 for d in 1e-3 * np.eye(2)])
    influence = np.stack([(gradient(at, e) - gradient(at, -e)) / 2e-3 for e in 1e-3 * np.eye(4)])
    sure = tuning.standard_errors(objective, OWN, batch, tuned)
    assert "l_occ: the loss does not depend on it here" in sure.words
    assert np.isinf(sure.standard_error[2])
    assert any("the gate decides" in words for words in sure.words)
    np.testing.assert_allclose(sure.hessian[:2, :2], hessian, rtol=1e-3, atol=1e-4 * np.abs(hessian).max())
    inverse = np.linalg.inv(hessian)
    cov = inverse @ influence.T @ influence @ inverse * 4 / 3
    np.testing.assert_allclose(sure.standard_error[:2], np.sqrt(np.diag(cov)) * sure.estimate[:2], rtol=5e-3)
    assert sure.correlation[0, 1] == pytest.approx(cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1]), abs=5e-3)


def test_a_scale_that_is_left_open_is_named():
    """What squared error does: only ratios matter."""
    together = np.ones(4) / 2
    hessian = np.eye(4) - np.outer(together, together)
    influence = np.random.default_rng(0).normal(size=(9, 4)) * 0.1
    open_scale = _judge(tuning.NOISE, np.ones(4), np.zeros(4), hessian, influence, np.eye(4))
    assert open_scale.words[:1] == ("v, w, range, bearing can change together: the loss stays the same",)
    assert np.isinf(open_scale.standard_error).all()
    np.testing.assert_array_equal(open_scale.interval_95, [[0, np.inf]] * 4)


def test_vague_and_tied_parameters_are_named():
    influence = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    still, names = np.zeros(2), ("v", "w")
    vague = _judge(names, np.ones(2), still, np.diag([1.0, 100.0]), influence, np.eye(2))
    few = "4 sequences are few: standard errors are known to some 41 %, and come out too small"  # 1 / sqrt(2 * 3)
    assert vague.words == ("v: known to no more than a factor of 5.1 (one standard error)", few)  # exp(sqrt(2 * 4 / 3))
    moving = _judge(names, np.ones(2), np.array([0.0, 50.0]), np.diag([100.0, 100.0]), influence, np.eye(2))
    assert moving.words == ("w: not yet at its minimum, some 31 standard errors away", few)  # 0.5 / (sqrt(8 / 3) / 100)
    saddle = _judge(names, np.ones(2), still, np.diag([100.0, -50.0]), influence, np.eye(2))
    assert saddle.words == ("w: no minimum, the loss falls further along here", few)
    assert np.isinf(saddle.standard_error[1])


@pytest.mark.parametrize(("correlation", "said"), [(0.94, False), (0.96, True), (-0.94, False), (-0.96, True)])
def test_tied_parameters_are_named_from_a_correlation_of_095(correlation, said):
    """Errors that are those of the influence: with H = 1 their covariance is its own."""
    root = np.linalg.cholesky(np.array([[1.0, correlation], [correlation, 1.0]]))
    white = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] * 5) * 0.01
    found = _judge(("v", "w"), np.ones(2), np.zeros(2), np.eye(2), white @ root.T, np.eye(2))
    assert found.correlation[0, 1] == pytest.approx(correlation, abs=1e-12)
    assert found.words == (
        (f"w and v: known in combination, hardly apart (correlation {correlation:+.3f})",) if said else ()
    )


@pytest.mark.parametrize(("share", "flat"), [(0.5e-4, True), (2e-4, False)])
def test_a_curvature_below_one_ten_thousandth_is_none(share, flat):
    influence = np.random.default_rng(0).normal(size=(30, 2)) * 1e-6
    found = _judge(("v", "w"), np.ones(2), np.zeros(2), 50 * np.diag([1.0, share]), influence, np.eye(2))
    assert np.isinf(found.standard_error).tolist() == [False, flat]
    assert ("w: the loss does not depend on it here" in found.words) == flat


@pytest.mark.parametrize(("own", "said"), [(0.99, False), (1.01, True)])
def test_a_coordinate_is_vague_from_a_standard_error_of_one(own, said):
    found = judged_alone(own)
    assert any("known to no more than a factor" in words for words in found.words) == said


@pytest.mark.parametrize(("errors", "said"), [(0.99, False), (1.01, True), (-1.01, True)])
def test_a_minimum_is_missed_by_more_than_a_standard_error(errors, said):
    found = judged_alone(0.1, gradient=0.1 * errors)
    assert any("not yet at its minimum, some 1 standard errors away" in words for words in found.words) == said


def judged_alone(own, gradient=0.0):
    """One parameter of 20 sequences whose coordinate has this standard error."""
    influence = np.array([[1.0], [-1.0]] * 10) * own * np.sqrt(19) / 20
    return _judge(("v",), np.ones(1), np.array([gradient]), np.eye(1), influence, np.eye(1))


@pytest.mark.parametrize(("n", "few"), [(19, True), (20, False)])
def test_fewer_than_20_sequences_are_few(n, few):
    influence = np.random.default_rng(0).normal(size=(n, 1)) * 0.01
    words = _judge(("v",), np.ones(1), np.zeros(1), np.eye(1), influence, np.eye(1)).words
    assert words == ((f"{n} sequences are few: standard errors are known to some 17 %, and come out too small",) * few)


@pytest.mark.parametrize(("part", "named"), [(0.098, False), (0.102, True)])
def test_who_has_a_tenth_of_a_direction_without_curvature_has_a_part_in_it(part, named):
    axis = np.array([np.sqrt(1 - part**2), part])
    influence = np.random.default_rng(0).normal(size=(30, 2)) * 0.01
    for sign, together in ((1, "v, w can change together"), (-1, "v can change together against w")):
        along = axis * [1, sign]
        hessian = np.eye(2) - np.outer(along, along)
        found = _judge(("v", "w"), np.ones(2), np.zeros(2), hessian, influence, np.eye(2))
        said = f"{together}: the loss stays the same" if named else "v: the loss does not depend on it here"
        assert found.words == (said,)
        np.testing.assert_array_equal(np.isinf(found.standard_error), [True, named])


def test_what_is_lost_is_tied_to_nothing_and_a_correlation_ends_at_one():
    """Of two parameters alike in their errors the one the loss does not depend on is not called tied."""
    influence = np.outer([1.0, -1.0] * 15, [1.0, 1.0]) * 0.03
    scale = np.array([[1.0, 0.0], [1.0, 0.0]])
    found = _judge(("v_w", "w"), np.array([0.9, 1.0]), np.zeros(2), np.diag([1.0, 0.0]), influence, scale)
    assert found.correlation[0, 1] == pytest.approx(1)
    assert found.words == ("w: the loss does not depend on it here",)
    reach = scipy.stats.t.ppf(0.975, 29) * 0.03 * np.sqrt(30 / 29) * np.sqrt(30)
    assert found.interval_95[0].tolist() == [pytest.approx(max(0.9 - reach, -1)), 1]


@pytest.mark.parametrize("n", [2, 8, 30])
def test_errors_and_intervals_are_those_written_out(n):
    """In units of the parameters, with Student's t, along the logarithm of what has one."""
    rng = np.random.default_rng(n)
    names = ("v", "v_w", "l_free")
    estimate, scale = np.array([0.02, -0.4, -0.7]), np.array([[0.02, 0.001, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, -0.7]])
    root = rng.normal(size=(3, 3))
    hessian, influence = root @ root.T + np.eye(3), rng.normal(size=(n, 3)) * 0.05
    found = _judge(names, estimate, np.zeros(3), hessian, influence, scale)
    cov = np.zeros((3, 3))
    for g in influence:
        moved = scale @ np.linalg.solve(hessian, g)
        cov += np.outer(moved, moved) * n / (n - 1)
    error = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(found.standard_error, error, rtol=1e-10)
    np.testing.assert_allclose(found.correlation, cov / np.outer(error, error), rtol=0, atol=1e-10)
    reach = scipy.stats.t.ppf(0.975, n - 1) * error
    times = np.exp(reach / np.abs(estimate))
    expected = [
        (0.02 / times[0], 0.02 * times[0]),
        (max(-0.4 - reach[1], -1), min(-0.4 + reach[1], 1)),
        (-0.7 * times[2], -0.7 / times[2]),
    ]
    np.testing.assert_allclose(found.interval_95, expected, rtol=1e-9)
    assert any("sequences are few" in words for words in found.words) == (n < 20)


def test_one_sequence_has_nothing_to_compare_with():
    one = tuning.pick(drives(scans=False), slice(0, 1))
    objective = tuning.Objective(ONLY_POSES, (("innovation_nll", 1.0),))
    with pytest.raises(ValueError, match="at least two sequences to compare, got 1"):
        tuning.standard_errors(objective, OWN, one, NAMES)
    with pytest.raises(ValueError, match="tuned: expected some of"):
        tuning.standard_errors(objective, OWN, drives(scans=False), ())
    with pytest.raises(ValueError, match="two equations"):
        tuning.standard_errors(tuning.Objective(ONLY_POSES, (("nis", 1.0),)), OWN, drives(scans=False), tuning.NOISE)


@pytest.mark.parametrize(
    ("gate", "temperature", "accepted", "rough"),
    [(0.99, 0.0, [3], True), (None, 0.0, [3], False), (0.99, 2.0, [3], False), (0.99, 0.0, None, False)],
)
def test_behind_a_gate_that_decides_the_gradient_jumps(gate, temperature, accepted, rough):
    """Not of a map at poses that are known, for which no filter is run."""
    config = Config(gate_probability=gate, gate_temperature=temperature)
    assert _jumps(config, Evaluation(0.0, {}, {}, {}, accepted and np.array(accepted))) == rough
