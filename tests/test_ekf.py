"""Predict, update and gate against the reference and the textbook Kalman filter; what covariances must never do."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats
from hypothesis import assume, given
from hypothesis import strategies as st

from jaxlocmap import Config, Gaussian, Inputs, Params, init, motion, run, se2, sensors
from jaxlocmap.filters import ekf

MEAN = np.array([0.4, -0.3, 3.1])
COV = np.array([[0.05, 0.01, 0.004], [0.01, 0.04, -0.003], [0.004, -0.003, 0.02]])
Q = np.array([[0.02, 0.003], [0.003, 0.05]])
R = np.diag([0.15**2, 0.03**2])


def near(got, expected, atol):
    np.testing.assert_allclose(np.asarray(got, float), expected, atol=atol, rtol=atol)


def assert_symmetric(cov, before, rounding):
    """To the rounding of what it was computed from: compilers differ in how they evaluate an entry and its mirror."""
    scale = np.max(np.diagonal(before, axis1=-2, axis2=-1), axis=-1)
    assert np.all(np.abs(cov - np.swapaxes(cov, -1, -2)) <= rounding * scale[..., None, None])


predicted = jax.jit(ekf.predict, static_argnames=("motion", "nominal_dt"))  # once, and not operation by operation


# --- predict


@pytest.mark.parametrize("name", ["euler", "arc", "capstone"])
@pytest.mark.parametrize("dt", [0.0, 0.03, 0.1, 0.7])
def test_predict_is_the_reference(name, dt, tolerance):
    control = np.array([0.6, -0.8])
    mean, cov = predicted(
        jnp.array(MEAN),
        jnp.array(COV),
        jnp.array(control),
        jnp.array(dt),
        jnp.array(Q),
        motion=motion.resolve(name),
        nominal_dt=0.1,
    )
    expected_mean, expected_cov = reference.predict(MEAN, COV, control, dt, Q, reference.MOTION[name], 0.1)
    near(mean, expected_mean, tolerance(1e-14, 1e-6))
    near(cov, expected_cov, tolerance(1e-15, 1e-7))
    assert_symmetric(cov, COV, tolerance(1e-15, 1e-6))


def added(dt, steps, omega):
    """What `steps` steps of dt add to no uncertainty, first-order model, nominal period 0.1 s."""
    mean, cov = jnp.array(MEAN), jnp.zeros((3, 3))
    for _ in range(steps):
        control = jnp.array([0.6, omega])
        mean, cov = predicted(mean, cov, control, jnp.array(dt), jnp.array(Q), motion=motion.EULER, nominal_dt=0.1)
    return np.asarray(cov)


def test_a_step_of_no_length_adds_nothing():
    np.testing.assert_array_equal(added(0.0, 1, 0.5), np.zeros((3, 3)))


def test_a_nominal_step_adds_G_Q_G_transposed(tolerance):
    _, _, G = reference.euler(MEAN, np.array([0.6, 0.5]), 0.1)
    near(added(0.1, 1, 0.5), G @ Q @ G.T, tolerance(1e-17, 1e-9))


def test_two_half_steps_add_as_much_heading_noise_as_one_whole(tolerance):
    """Nothing moves the heading but omega, so for it the equality is exact."""
    near(added(0.05, 2, 0.5)[2, 2], added(0.1, 1, 0.5)[2, 2], tolerance(1e-17, 1e-9))


def test_many_short_steps_add_as_much_noise_as_one_whole_to_first_order():
    """Heading noise of a part step reaches the position as v dt: the gap falls with dt, and is that lever's size."""
    gaps = []
    for dt in (0.1, 0.01):
        whole, halves = added(dt, 1, 0.0), added(dt / 2, 2, 0.0)
        gaps.append(np.abs(halves - whole).max() / np.abs(whole).max())
    assert gaps[0] < 0.6 * 0.1  # v dt
    assert gaps[1] < 0.15 * gaps[0]


def test_the_noise_of_a_second_does_not_depend_on_the_rate():
    """A Q of a tenth of a second: a thousand steps of 1 ms add to the heading what ten nominal ones add."""
    assert added(0.005, 20, 0.3)[2, 2] == pytest.approx(added(0.1, 1, 0.3)[2, 2], rel=1e-5)


# --- gate


def test_gate_threshold_is_the_chi_square_quantile():
    assert ekf.gate_threshold(0.99, 2) == pytest.approx(9.2103, abs=5e-5)  # -2 ln 0.01
    for p in (0.5, 0.95, 0.999):
        for dimension in (1, 2, 3):
            assert ekf.gate_threshold(p, dimension) == pytest.approx(scipy.stats.chi2.ppf(p, dimension), rel=1e-12)


def test_no_gate_lets_everything_in():
    assert ekf.gate_threshold(None, 2) == math.inf


def test_a_traced_gate_is_the_same_quantile_and_one_of_1_is_none(tolerance):
    p = np.array([0.5, 0.95, 0.99, 1.0])
    got = jax.jit(lambda p: ekf.gate_threshold(p, 2))(jnp.array(p))
    np.testing.assert_allclose(got, scipy.stats.chi2.ppf(p, 2), rtol=tolerance(1e-12, 1e-5))  # 0.01 of a float32 0.99


@pytest.mark.parametrize("dimension", [1, 3, 4, 7, 12])
def test_a_traced_gate_is_the_quantile_of_any_dimension_far_out_on_both_sides(dimension, tolerance):
    p = jnp.array([1e-6, 1e-3, 0.05, 0.4999, 0.5, 0.95, 0.99, 0.9999, 1 - 1e-6, 1.0])
    got = jax.jit(lambda p: ekf.gate_threshold(p, dimension))(p)
    below, above = (np.asarray(x, np.float64) for x in (p, 1 - p))
    chi2 = scipy.stats.chi2(dimension)
    np.testing.assert_allclose(
        got, np.where(below < 0.5, chi2.ppf(below), chi2.isf(above)), rtol=tolerance(1e-11, 1e-5)
    )


def test_a_threshold_may_be_a_value_of_each_run():
    args = [jnp.array(x) for x in (MEAN, COV, np.array([0.1, 0.2]), np.eye(2, 3), R)]
    alone = jax.jit(ekf.update)(*args)
    thresholds = alone.nis * jnp.array([0.9, 1.1, math.inf])
    update = jax.jit(jax.vmap(lambda threshold: ekf.update(*args, threshold=threshold)))(thresholds)
    assert update.accepted.tolist() == [False, True, True]
    mean = np.asarray(update.mean)
    np.testing.assert_array_equal(mean[0], MEAN.astype(mean.dtype))
    np.testing.assert_array_equal(mean[1], alone.mean)


def test_an_observation_exactly_at_the_threshold_is_refused():
    """Residuals whose distance is exact: S = 4 I, so d² of (2, 4) is 5."""
    args = [jnp.array(x) for x in (MEAN, 3 * np.eye(3), np.array([2.0, 4.0]), np.eye(2, 3), np.eye(2))]
    for threshold, accepted in ((5.0, False), (np.nextafter(np.float32(5), np.float32(6)).item(), True)):
        update = ekf.update(*args, threshold=threshold)
        assert float(update.nis) == 5
        assert bool(update.accepted) is accepted


@pytest.mark.parametrize("probability", [0.0, 1.0, -1.0, 2.0, math.nan])
def test_a_gate_that_is_no_probability_is_refused(probability):
    with pytest.raises(ValueError, match=r"gate probability: expected a value inside \(0, 1\), got"):
        ekf.gate_threshold(probability, 2)


@pytest.mark.parametrize(("distance", "accepted"), [(7.4, True), (9.2, True), (9.22, False), (9.3, False)])
def test_course_problem_4_the_99_percent_gate_in_two_dimensions(distance, accepted):
    """d2 = 7.4 is let in, 9.3 is not: the threshold is 9.2103."""
    S = COV[:2, :2] + R
    residual = np.linalg.cholesky(S) @ np.array([math.sqrt(distance), 0.0])
    update = ekf.update(
        jnp.array(MEAN),
        jnp.array(COV),
        jnp.array(residual),
        jnp.eye(2, 3),
        jnp.array(R),
        threshold=ekf.gate_threshold(0.99, 2),
    )
    assert float(update.nis) == pytest.approx(distance, rel=1e-5)
    assert bool(update.accepted) == accepted
    assert bool(np.all(update.mean == jnp.array(MEAN))) != accepted
    assert bool(np.all(update.cov == jnp.array(COV))) != accepted


# --- update


@pytest.mark.parametrize("gate", [None, 0.25])
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.4)])
def test_a_correction_by_a_landmark_is_the_reference(gate, offset, tolerance):
    z, landmark = np.array([3.4, -2.9]), np.array([3.0, 2.0])
    mean, cov, noise = (jnp.array(x) for x in (MEAN, COV, R))
    residual, H, defined = sensors.linearise(mean, jnp.array(landmark), jnp.array(z), offset=offset)
    assert defined
    got = ekf.update(mean, cov, residual, H, noise, threshold=math.inf if gate is None else gate)
    expected = reference.correct(MEAN, COV, z, landmark, R, gate, offset)
    for field, value in zip(got, expected, strict=True):
        near(field, value, tolerance(1e-12, 2e-5))  # S⁻¹ magnifies by up to 100
    assert bool(got.accepted) == (gate is None)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_linear_model_is_the_textbook_kalman_filter(m, tolerance):
    """Any linear sensor of dimension m, ten observations in turn: K = P Hᵀ (H P Hᵀ + R)⁻¹, P ← (I − K H) P."""
    rng = np.random.default_rng(m)
    H, root = rng.normal(size=(m, 3)), rng.normal(size=(m, m))
    noise = root @ root.T + 0.1 * np.eye(m)
    mean, cov = np.array([0.2, -0.1, 0.05]), COV
    got = ekf.Update(jnp.array(mean), jnp.array(cov), *[None] * 5)
    update = jax.jit(ekf.update)
    for z in rng.normal(size=(10, m)) * 0.1:
        residual = jnp.array(z) - jnp.array(H) @ got.mean
        got = update(got.mean, got.cov, residual, jnp.array(H), jnp.array(noise))
        innovation, S = z - H @ mean, H @ cov @ H.T + noise
        K = cov @ H.T @ np.linalg.inv(S)
        mean, cov = mean + K @ innovation, (np.eye(3) - K @ H) @ cov
        atol = tolerance(1e-13, 1e-5)
        near(got.mean, mean, atol)
        near(got.cov, cov, atol)
        near(got.innovation, innovation, atol)
        near(got.S, S, tolerance(1e-13, 1e-5))
        near(got.nis, innovation @ np.linalg.solve(S, innovation), tolerance(1e-12, 1e-4))
        density = scipy.stats.multivariate_normal(np.zeros(m), S)
        near(got.log_likelihood, density.logpdf(innovation), tolerance(1e-12, 1e-4))


GATES = pytest.mark.parametrize(
    "gate", [{"threshold": 9.21}, {"threshold": 9.21, "temperature": 2.0}], ids=["hard", "soft"]
)


@GATES
def test_an_update_that_is_not_valid_leaves_the_belief_bit_for_bit(gate):
    args = [jnp.array(x) for x in (MEAN, COV, np.array([0.1, 0.2]), np.eye(2, 3), R)]
    update = ekf.update(*args, valid=False, **gate)
    assert not update.accepted
    np.testing.assert_array_equal(update.mean, args[0])
    np.testing.assert_array_equal(update.cov, args[1])


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("gate", [{}, {"threshold": 9.21, "temperature": 2.0}], ids=["none", "soft"])
def test_a_residual_that_is_no_number_never_passes_even_without_a_gate(bad, gate):
    args = [jnp.array(x) for x in (MEAN, COV, np.array([bad, 0.2]), np.eye(2, 3), R)]
    update = ekf.update(*args, **gate)
    assert not update.accepted
    np.testing.assert_array_equal(update.mean, args[0])
    np.testing.assert_array_equal(update.cov, args[1])


@GATES
@pytest.mark.parametrize("variances", [(-9.0, -9.0), (9.0, -9.0), (-9.0, 9.0), (9.0, -COV[1, 1])])
def test_an_innovation_covariance_that_is_not_definite_never_passes(variances, gate):
    """A negative one gives a residual of zero a distance of zero, inside any gate; the last one is singular."""
    args = [jnp.array(x) for x in (MEAN, np.diag(np.diag(COV)), np.zeros(2), np.eye(2, 3), np.diag(variances))]
    args[2] = args[2] + (0.1 if variances[1] == -COV[1, 1] else 0)
    update = ekf.update(*args, **gate)
    assert np.isnan(update.nis)
    assert not update.accepted
    np.testing.assert_array_equal(update.mean, args[0])
    np.testing.assert_array_equal(update.cov, args[1])


@pytest.mark.parametrize("variances", [(1.0, math.inf), (math.inf, 1.0), (math.inf, math.inf)])
def test_an_infinite_variance_never_passes(variances):
    """It would leave 0 · inf in the covariance."""
    args = [jnp.array(x) for x in (MEAN, COV, np.array([0.1, 0.2]), np.eye(2, 3), np.diag(variances))]
    update = ekf.update(*args)
    assert not update.accepted
    np.testing.assert_array_equal(update.cov, args[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mean": np.zeros(4)}, r"cov: expected shape \(4, 4\), got \(3, 3\)"),
        ({"mean": np.zeros((3, 1))}, r"mean: expected shape \(any\), got \(3, 1\)"),
        ({"cov": np.eye(2)}, r"cov: expected shape \(3, 3\), got \(2, 2\)"),
        ({"residual": np.zeros(3)}, r"H: expected shape \(3, any\), got \(2, 3\)"),
        ({"residual": np.zeros((2, 1))}, r"residual: expected shape \(any\), got \(2, 1\)"),
        ({"H": np.eye(3)}, r"H: expected shape \(2, any\), got \(3, 3\)"),
        ({"H": np.eye(2, 4)}, r"H: expected up to the 3 columns of the state, got 4"),
        ({"R": np.eye(3)}, r"R: expected shape \(2, 2\), got \(3, 3\)"),
    ],
)
def test_an_update_of_the_wrong_shape_is_refused_by_name(change, message):
    whole = {"mean": MEAN, "cov": COV, "residual": np.zeros(2), "H": np.eye(2, 3), "R": R} | change
    with pytest.raises(ValueError, match=message):
        ekf.update(**{name: jnp.array(value) for name, value in whole.items()})


def test_a_jacobian_of_fewer_columns_than_the_state_is_zero_beyond():
    args = [jnp.array(x) for x in (MEAN, COV, np.array([0.1, 0.2]))]
    short, whole = (ekf.update(*args, jnp.eye(2, columns), jnp.array(R)) for columns in (2, 3))
    jax.tree.map(lambda x, y: near(x, y, 1e-6), short, whole)


def test_a_threshold_or_a_flag_for_many_observations_is_refused_by_name():
    one = [jnp.array(x) for x in (MEAN, COV, np.zeros(2), np.eye(2, 3), R)]
    for name, value in (("threshold", jnp.ones(1)), ("valid", jnp.ones(3, bool))):
        with pytest.raises(ValueError, match=rf"^{name}: expected shape \(\), got \({len(value)},\)$"):
            ekf.update(*one, **{name: value})


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("mean", (4,)),
        ("mean", (5, 3)),
        ("cov", (5, 3, 3)),
        ("control", (3,)),
        ("control", (5, 2)),
        ("dt", (1,)),
        ("Q", (3, 3)),
    ],
)
def test_a_prediction_of_the_wrong_shape_is_refused_by_name(name, wrong):
    whole = {"mean": MEAN, "cov": COV, "control": np.zeros(2), "dt": np.array(0.1), "Q": Q} | {name: np.ones(wrong)}
    with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got {re.escape(str(wrong))}$"):
        ekf.predict(**{key: jnp.array(x) for key, x in whole.items()}, motion=motion.EULER, nominal_dt=0.1)


def test_entries_beyond_the_motion_models_stand_still(tolerance):
    """As if the model had them too, moved by nothing."""
    rng = np.random.default_rng(2)
    mean, L = rng.normal(size=7), rng.normal(size=(7, 7))
    P, control, dt = L @ L.T, np.array([0.4, 0.3]), 0.2
    mean[2] = 0.5
    args = jnp.asarray(control), jnp.asarray(dt), jnp.asarray(Q)
    got = predicted(jnp.asarray(mean), jnp.asarray(P), *args, motion=motion.ARC, nominal_dt=0.1)
    still = motion.from_transition(
        lambda state, u, dt: jnp.concatenate([motion.ARC.transition(state[:3], u, dt), state[3:]]), dim=7
    )
    expected = predicted(jnp.asarray(mean), jnp.asarray(P), *args, motion=still, nominal_dt=0.1)
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance(1e-12, 1e-4))
    np.testing.assert_array_equal(np.asarray(got[0])[3:], np.asarray(jnp.asarray(mean))[3:])


@pytest.mark.parametrize("name", ["transition", "F", "G"])
def test_a_motion_model_that_returns_something_else_is_refused_by_name(name):
    made = {"transition": (3,), "F": (3, 3), "G": (3, 2)} | {name: (2, 3)}
    own = motion.MotionModel(
        lambda *_: jnp.ones(made["transition"]), lambda *_: (jnp.ones(made["F"]), jnp.ones(made["G"]))
    )
    arrays = [jnp.array(x) for x in (MEAN, COV, np.zeros(2), 0.1, Q)]
    with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got \(2, 3\)$"):
        ekf.predict(*arrays, motion=own, nominal_dt=0.1)


@pytest.mark.parametrize("residual", [(0.05, 0.01), (0.9, -0.2), (40.0, 1.0)])
def test_a_soft_gate_is_an_update_with_r_over_w(residual, tolerance):
    """w = 1 / (1 + exp((d² - threshold) / temperature)), and no smaller than 1e-6; what is reported is of R itself."""
    threshold, temperature, H = 9.21, 2.0, np.array([[-0.8, -0.6, 0.0], [0.12, -0.16, -1.0]])
    args = [jnp.array(x) for x in (MEAN, COV, residual, H)]
    got = ekf.update(*args, jnp.array(R), threshold=threshold, temperature=temperature)
    S = H @ COV @ H.T + R
    nis = np.array(residual) @ np.linalg.solve(S, residual)
    weight = max(1 / (1 + math.exp(min((nis - threshold) / temperature, 700))), 1e-6)
    loose = np.asarray(R) / weight
    K = COV @ H.T @ np.linalg.inv(H @ COV @ H.T + loose)
    A = np.eye(3) - K @ H
    error = got.mean - (MEAN + K @ residual)
    np.testing.assert_allclose(error.at[2].set(se2.wrap(error[2])), 0, rtol=0, atol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(got.cov, A @ COV @ A.T + K @ loose @ K.T, rtol=0, atol=tolerance(1e-13, 1e-6))
    np.testing.assert_allclose(got.S, S, rtol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(got.nis, nis, rtol=tolerance(1e-10, 1e-3))
    assert bool(got.accepted) == (nis < threshold)


@pytest.mark.parametrize(("fault", "nis"), [("valid", 9.0), ("residual", math.nan), ("R", math.nan), ("cov", math.nan)])
def test_a_soft_gate_leaves_the_belief_where_there_is_nothing_to_weigh(fault, nis):
    """An empty slot, a residual that is no number, and covariances of the innovation that are not definite."""
    mean, cov, residual, R = np.array([0.1, 0.2, 0.3]), np.eye(3), np.array([6.0, 0.0]), 3 * np.eye(2)
    if fault == "residual":
        residual[1] = math.nan
    if fault == "R":
        R = -9 * np.eye(2)
    if fault == "cov":
        cov = np.diag([1.0, -9.0, 1.0])
    args = [jnp.array(x) for x in (mean, cov, residual, np.eye(2, 3), R)]
    update = ekf.update(*args, threshold=9.5, temperature=2.0, valid=fault != "valid")
    np.testing.assert_array_equal(update.mean, args[0])
    np.testing.assert_array_equal(update.cov, args[1])
    assert not update.accepted
    np.testing.assert_array_equal(update.nis, nis)


# --- course problem 2: a Joseph update of a positive semi-definite matrix is one

joseph = jax.jit(lambda P, H, R: ekf.update(jnp.zeros(3), P, jnp.zeros(len(R)), H, R).cov)


@given(
    seed=st.integers(0, 100_000),
    rank=st.sampled_from([1, 2, 3]),
    spread=st.sampled_from([1.0, 1e-3, 1e-6]),
    precision=st.sampled_from([1.0, 1e-3, 1e-6]),
)
def test_course_problem_2_joseph_stays_positive_semi_definite(seed, rank, spread, precision, tolerance):
    """Also for a P without full rank, axes of very unequal size, and a sensor far sharper than P."""
    rng = np.random.default_rng(seed)
    A = np.diag([1.0, spread, 1.0]) @ rng.normal(size=(3, rank))
    root = rng.normal(size=(2, 2))
    noise = precision * (root @ root.T + 1e-3 * np.eye(2))
    P, H = A @ A.T, rng.normal(size=(2, 3))
    cov = np.asarray(joseph(jnp.array(P), jnp.array(H), jnp.array(noise)), np.float64)
    assert_symmetric(cov, P, tolerance(1e-13, 1e-4))
    # Both terms are squares whatever K is, so what is below zero is their rounding.
    eps, S, norm = float(jnp.finfo(jnp.result_type(float)).eps), H @ P @ H.T + noise, np.linalg.norm
    assume(eps * np.linalg.cond(S) < 0.1)  # else K is all rounding
    K = np.linalg.solve(S, H @ P).T
    size = norm(np.eye(3) - K @ H) ** 2 * norm(P) + norm(K) ** 2 * norm(noise)
    assert np.linalg.eigvalsh(cov)[0] >= -10 * eps * size


def test_positive_semi_definite_after_100_000_float32_steps():
    """A robot on a circle that sees a landmark sharply every step, for 10,000 s: float32 rounding must not add up."""
    steps, f32 = 100_000, np.float32
    heading = 0.3 * 0.1 * np.arange(1, steps + 1)
    truth = np.column_stack([np.sin(heading) / 0.3, (1 - np.cos(heading)) / 0.3, heading])
    marks = np.array([[0.0, 8.0], [-5.0, -3.0]])
    which = np.arange(steps) % 2
    to = marks[which] - truth[:, :2]
    z = np.column_stack([np.hypot(*to.T), reference.wrap(np.arctan2(to[:, 1], to[:, 0]) - heading)])
    inputs = Inputs(
        dt=jnp.full(steps, 0.1, f32),
        control=jnp.broadcast_to(jnp.array([1.0, 0.3], f32), (steps, 2)),
        landmark=jnp.array(which[:, None], jnp.int32),
        z=jnp.array(z[:, None], f32),
        valid=jnp.ones((steps, 1), bool),
    )
    params = Params(*(jnp.array(x, f32) for x in (np.diag([0.02**2, 0.03**2]), np.diag([0.01**2, 1e-3**2]), 0.8, -0.4)))
    prior = Gaussian(jnp.zeros(3, f32), jnp.diag(jnp.array([1.0, 1.0, 1.0], f32)))
    config = Config(dt=0.1)
    keep = jax.jit(
        functools.partial(run, config=config, landmarks=jnp.array(marks, f32), collect=lambda s, i, _: (i.ok, i.belief))
    )
    _, (ok, belief) = keep(params, init(prior, config=config), inputs)
    cov = np.asarray(belief.cov, np.float64)
    assert belief.cov.dtype == f32
    assert bool(jnp.all(ok))
    before = np.concatenate([np.eye(3)[None], cov[:-1]]) + 1e-5 * np.eye(3)  # and a step's Q
    assert_symmetric(cov, before, 1e-6)
    assert np.linalg.eigvalsh(cov).min() > 0
    error = np.asarray(belief.mean, np.float64) - truth
    assert np.abs(error[:, :2]).max() < 0.05  # and it is a filter still: 5 standard deviations of the sensor's range


# --- derivatives


def plain_update(mean, cov, residual, H, R):
    """The same formulas in matrices, for the compiler to differentiate: gain and all."""
    S = H @ cov @ H.T + R
    K = cov @ H.T @ jnp.linalg.inv(S)
    A = jnp.eye(3, dtype=cov.dtype) - K @ H
    nis = residual @ jnp.linalg.inv(S) @ residual
    log_likelihood = -0.5 * (nis + jnp.log(jnp.linalg.det(S)) + len(residual) * math.log(2 * math.pi))
    return mean + K @ residual, A @ cov @ A.T + K @ R @ K.T, S, nis, log_likelihood


@pytest.mark.parametrize(("order", "dimension", "mode"), [(1, 1, jax.jacfwd), (2, 2, jax.jacfwd), (1, 2, jax.jacrev)])
def test_derivatives_by_hand_are_those_of_the_formulas(order, dimension, mode, x64):
    rng = np.random.default_rng(dimension)
    spread = rng.normal(size=(dimension, dimension))
    args = (
        jnp.array([0.4, -0.3, 0.5]),
        jnp.asarray(COV),
        jnp.asarray(0.2 * rng.normal(size=dimension)),
        jnp.asarray(rng.normal(size=(dimension, 3))),
        jnp.asarray(0.05 * spread @ spread.T + 0.02 * np.eye(dimension)),
    )
    directions = [rng.normal(size=np.shape(x)) for x in args]
    directions = [x + x.T if x.ndim == 2 and x.shape[0] == x.shape[1] else x for x in directions]

    def along(function):
        """As a function of one number: how far all arguments are moved."""

        def f(t):
            moved = [x + t * d for x, d in zip(args, directions, strict=True)]
            return jnp.concatenate([jnp.ravel(x) for x in function(*moved)])

        for _ in range(order):
            f = mode(f)
        return jax.jit(f)(0.0)

    def by_hand(*args):
        update = ekf.update(*args)
        return update.mean, update.cov, update.S, update.nis, update.log_likelihood

    near(along(by_hand), along(plain_update), 1e-10)
