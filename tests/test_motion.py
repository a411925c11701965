"""Motion models against the reference, their Jacobians against forward-mode differentiation, angles, wheels."""

import functools
import math
import re
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from jaxlocmap import motion, se2
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap.filters import ekf

OMEGAS = (0.0, 1e-9, -1e-9, 1e-4, 0.3, -0.3, 40.0)
PERIODS = (0.0, 1e-3, 0.1, 1.0)
SWITCH = 0.25  # |omega dt / 2| where the series takes over


def cases():
    """(pose, control, dt) of every yaw rate with every period, and of both sides of the series' switch."""
    rows = [(w, dt) for w in OMEGAS for dt in PERIODS]
    rows += [(side * 2 * SWITCH * (1 + off) / 0.1, 0.1) for side in (1, -1) for off in (-1e-3, -1e-7, 0, 1e-7, 1e-3)]
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.normal(size=(len(rows), 2)), rng.uniform(-np.pi, np.pi, len(rows))])
    controls = np.column_stack([rng.uniform(-1, 1, len(rows)), [w for w, _ in rows]])
    return poses, controls, np.array([dt for _, dt in rows])


@functools.partial(jax.jit, static_argnums=0)
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def moved_and_jacobians(name, pose, control, dt):
    model = motion.resolve(name)
    F, G = model.jacobians(pose, control, dt)
    by_jax = jax.jacfwd(model.transition, argnums=(0, 1))(pose, control, dt)
    return model.transition(pose, control, dt), (F.array(pose.dtype), G.array(pose.dtype)), by_jax


def library(name):
    return jax.tree.map(np.asarray, moved_and_jacobians(name, *(jnp.array(x) for x in cases())))


@pytest.mark.parametrize("name", ["euler", "arc", "capstone"])
def test_transition_and_jacobians_are_the_reference(name, tolerance):
    expected = [reference.MOTION[name](*case) for case in zip(*cases(), strict=True)]
    got, (F, G), _ = library(name)
    # A few roundings of entries of order 1; the course's model drops a turn of less than 1e-6 rad/s, here 1e-9.
    atol = tolerance(2e-9 if name == "capstone" else 1e-14, 1e-5)
    error = got - np.array([e[0] for e in expected])
    error[:, 2] = reference.wrap(error[:, 2])
    np.testing.assert_allclose(error, 0, rtol=0, atol=atol)
    np.testing.assert_allclose(F, [e[1] for e in expected], rtol=0, atol=atol)
    np.testing.assert_allclose(G, [e[2] for e in expected], rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["euler", "arc"])
def test_jacobians_are_the_derivatives_of_the_transition(name, tolerance):
    _, (F, G), (F_jax, G_jax) = library(name)
    atol = tolerance(1e-14, 2e-6)  # a few roundings of entries of order 1
    np.testing.assert_allclose(F, F_jax, rtol=0, atol=atol)
    np.testing.assert_allclose(G, G_jax, rtol=0, atol=atol)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("share", [1e-3, 0.3, 0.7, 0.97, 0.999])
def test_the_series_near_no_turn_is_right_to_the_last_digit(share):
    """Against Taylor's in fractions, sin(h)/h = Σ (-1)ⁿ h²ⁿ / (2n + 1)!: no coefficient is off by a per cent."""
    h = share * SWITCH
    terms = [(2 * n, Fraction((-1) ** n, math.factorial(2 * n + 1))) for n in range(12)]
    exact = float(sum(c * Fraction(h) ** power for power, c in terms))
    slope = float(sum(power * c * Fraction(h) ** (power - 1) for power, c in terms if power))
    for sign in (1, -1):
        got, got_slope = motion._sinc(jnp.array(sign * h))
        assert float(got) == pytest.approx(exact, rel=0, abs=2.3e-16)
        assert float(got_slope) == pytest.approx(
            sign * slope, rel=0, abs=5e-16
        )  # the first term left out, at the switch


def test_from_transition_predicts_as_the_analytic_model(tolerance):
    pose, control, dt = jnp.array([0.3, -0.2, 3.1]), jnp.array([0.5, 0.7]), jnp.array(0.2)
    cov = jnp.array([[0.04, 0.01, 0.002], [0.01, 0.05, 0.003], [0.002, 0.003, 0.01]])
    Q = jnp.array([[0.02, 0.001], [0.001, 0.03]])
    own = motion.from_transition(motion.ARC.transition)
    one, other = (ekf.predict(pose, cov, control, dt, Q, motion=m, nominal_dt=0.1) for m in (own, motion.ARC))
    for got, expected in zip(one, other, strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance(1e-15, 1e-7))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("h", [0.0, 1e-8, 1e-3, 0.1, 0.2, 0.2499999, 0.25, 0.2500001, 1.0, 2.0])
def test_sinc_and_its_slope_are_the_power_series(h):
    """Every coefficient: sin(h)/h = Σ (-1)ⁿ h²ⁿ / (2n + 1)!. What is cut off the slope is 1e-14 of it."""
    terms = [(-1) ** n * h ** (2 * n) / math.factorial(2 * n + 1) for n in range(20)]
    slopes = [(-1) ** n * 2 * n * h ** (2 * n - 1) / math.factorial(2 * n + 1) for n in range(1, 20)]
    for sign in (1, -1):
        value, slope = motion._sinc(jnp.array(sign * h))
        assert float(value) == pytest.approx(math.fsum(terms), rel=2e-15, abs=0)
        assert float(slope) == pytest.approx(sign * math.fsum(slopes), rel=2e-14, abs=0)


SHAPES = {"pose": (3,), "control": (2,), "dt": ()}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("model", [*motion.MODELS.values(), motion.from_transition(motion.ARC.transition)])
def test_a_batch_is_refused_by_name(model, name):
    """Five poses side by side would be taken for one, of which only the first three count."""
    arrays = {key: jnp.ones(shape) for key, shape in SHAPES.items()} | {"control": jnp.ones(model.inputs)}
    own = {"pose": "state", "control": "u"} if model not in motion.MODELS.values() else {}
    for wrong in ((5, *arrays[name].shape), (*arrays[name].shape, 1), (1,)):
        for function in (model.transition, model.jacobians):
            with pytest.raises(
                ValueError, match=rf"^{own.get(name, name)}: expected shape .*, got {re.escape(str(wrong))}"
            ):
                function(*(arrays | {name: jnp.ones(wrong)}).values())


@pytest.mark.parametrize("result", [(2,), (4,), (3, 3)])
def test_a_transition_that_returns_no_pose_is_refused(result):
    own = motion.from_transition(lambda pose, control, dt: jnp.full(result, pose[0]))
    for function in (own.transition, own.jacobians):
        with pytest.raises(ValueError, match=r"^transition\(state, u, dt\): expected shape \(3\), got"):
            function(jnp.zeros(3), jnp.zeros(2), 0.1)


@pytest.mark.parametrize("omega", OMEGAS)
def test_two_half_arcs_are_the_whole_arc(omega, tolerance):
    pose, control = jnp.array([1.0, 2.0, -0.5]), jnp.array([0.8, omega])
    half = motion.ARC.transition(motion.ARC.transition(pose, control, 0.05), control, 0.05)
    np.testing.assert_allclose(half, motion.ARC.transition(pose, control, 0.1), rtol=0, atol=tolerance(1e-15 * 8, 1e-6))


def test_first_order_model_tends_to_the_arc(tolerance):
    """The two differ by v omega dt² / 2 at most to leading order, so by a hundredth at a tenth of the period."""
    pose, control = jnp.array([0.0, 0.0, 0.4]), jnp.array([1.0, 1.0])
    gap = [
        np.abs(motion.ARC.transition(pose, control, dt) - motion.EULER.transition(pose, control, dt)).max()
        for dt in (0.1, 0.01)
    ]
    assert gap[0] < 0.5 * 0.1**2 * 1.1
    assert gap[1] / gap[0] == pytest.approx(0.01, rel=tolerance(0.1, 0.2))


# --- angles

EDGE = float(jnp.pi)


def ulps(count):
    """So many roundings of an angle of pi."""
    return count * float(np.spacing(np.asarray(EDGE, jnp.result_type(float))))


@given(angle=st.floats(-50.0, 50.0))
def test_wrap_lands_in_the_circle_on_the_same_angle(angle):
    wrapped = float(se2.wrap(jnp.array(angle)))
    assert -EDGE - ulps(1) <= wrapped <= EDGE + ulps(1)
    turns = (float(jnp.array(angle)) - wrapped) / (2 * math.pi)
    # An angle of 50 carries 16 times the rounding of pi, and so does the multiple of 2 pi taken off it.
    assert abs(turns - round(turns)) * 2 * math.pi <= ulps(32)


@given(angle=st.floats(-EDGE, EDGE))
def test_wrap_leaves_an_angle_inside_as_it_is(angle):
    angle = jnp.array(angle)
    if 1e-37 < abs(float(angle)) < EDGE - ulps(2):  # XLA flushes subnormal numbers to zero
        assert float(se2.wrap(angle)) == float(angle)


@pytest.mark.parametrize("angle", [-EDGE, EDGE, np.nextafter(EDGE, 0), 3 * EDGE, -3 * EDGE, 5 * EDGE, -7 * EDGE])
def test_wrap_at_the_seam_is_pi_from_zero(angle):
    assert abs(abs(float(se2.wrap(jnp.array(angle)))) - EDGE) <= ulps(8)  # 7 pi carries 8 roundings of pi


def test_the_circle_is_closed_at_minus_pi_and_open_at_pi():
    for angle in (-EDGE, EDGE):
        assert float(se2.wrap(jnp.array(angle))) == pytest.approx(-EDGE, abs=ulps(1))
    assert float(se2.wrap(jnp.array(EDGE - ulps(4)))) > 3


def test_wrap_has_derivative_one_everywhere():
    for angle in (0.0, 3.0, EDGE, -EDGE, 9.0):
        assert float(jax.grad(se2.wrap)(jnp.array(angle))) == 1.0


@pytest.mark.parametrize("name", ["euler", "arc", "capstone"])
def test_a_robot_that_turns_round_and_round_keeps_its_heading_inside(name, tolerance):
    """300 steps of 0.4 rad: 19 turns."""
    control, dt = jnp.array([0.1, 4.0]), jnp.array(0.1)
    model = motion.resolve(name)

    def turn(pose, _):
        pose = model.transition(pose, control, dt)
        return pose, pose[2]

    _, headings = jax.lax.scan(turn, jnp.zeros(3), length=300)
    assert np.all(np.abs(headings) <= EDGE + ulps(1))
    error = reference.wrap(np.asarray(headings) - 0.4 * np.arange(1, 301))
    np.testing.assert_allclose(
        error, 0, rtol=0, atol=tolerance(1e-12, 3e-4)
    )  # 300 roundings of pi, at most 3 ulps a step


# --- models by name, wheels


def test_an_unknown_model_is_refused_by_name():
    with pytest.raises(
        ValueError, match=r"motion: expected one of \['arc', 'capstone', 'euler', 'odometry'\].*got 'ackermann'"
    ):
        motion.resolve("ackermann")


def test_a_model_passes_through():
    assert motion.resolve(motion.EULER) is motion.EULER


def test_wheels_and_control_are_inverse(tolerance):
    control = jnp.array(np.random.default_rng(0).normal(size=(4, 5, 2)))
    back = motion.from_wheels(*motion.to_wheels(control, 0.4), 0.4)
    np.testing.assert_allclose(back, control, rtol=0, atol=tolerance(1e-14, 2e-6))


def test_a_faster_right_wheel_turns_left():
    np.testing.assert_allclose(motion.from_wheels(jnp.array(0.4), jnp.array(0.6), 0.5), [0.5, 0.4], rtol=1e-6)


def test_a_gyro_takes_the_place_of_the_wheels_yaw_rate():
    control = motion.from_wheels(jnp.array([0.4]), jnp.array([0.6]), 0.5, gyro=jnp.array([-0.1]))
    np.testing.assert_allclose(control, [[0.5, -0.1]], rtol=1e-6)
    wheels = jnp.array([0.2, 0.4]), jnp.array([0.4, 0.8])
    shared = motion.from_wheels(*wheels, 0.5, gyro=jnp.array(0.3))
    np.testing.assert_allclose(shared, [[0.3, 0.3], [0.6, 0.3]], rtol=1e-6)


@pytest.mark.parametrize("base", [0.0, -0.3, math.nan])
def test_a_wheel_base_that_is_no_distance_is_refused(base):
    with pytest.raises(ValueError, match="wheel_base: expected metres > 0"):
        motion.from_wheels(jnp.array(1.0), jnp.array(1.0), base)
    with pytest.raises(ValueError, match="wheel_base: expected metres > 0"):
        motion.to_wheels(jnp.array([1.0, 0.0]), base)


@pytest.mark.parametrize("wrong", [(3,), (2, 1), ()])
def test_a_control_that_is_none_has_no_wheel_speeds(wrong):
    with pytest.raises(ValueError, match=rf"^control: expected shape \(\.\.\., 2\), got {re.escape(str(wrong))}$"):
        motion.to_wheels(jnp.ones(wrong), 0.4)


def test_jacobians_keep_structure_so_that_products_with_it_vanish():
    F, G = motion.ARC.jacobians(jnp.zeros(3), jnp.array([1.0, 0.1]), 0.1)
    assert isinstance(F, Matrix)
    assert (F[0, 0], F[0, 1], F[2, 2], G[2, 0]) == (1, 0, 1, 0)


# --- displacements by odometry


def test_a_displacement_is_composed_with_the_pose(tolerance):
    pose, control, dt = jnp.array([1.0, 2.0, 2.5]), jnp.array([0.3, -0.1, 1.2]), jnp.array(7.0)
    got = motion.ODOMETRY.transition(pose, control, dt)
    c, s = math.cos(2.5), math.sin(2.5)
    np.testing.assert_allclose(
        got,
        [1 + 0.3 * c + 0.1 * s, 2 + 0.3 * s - 0.1 * c, 3.7 - 2 * math.pi],
        rtol=0,
        atol=tolerance(1e-14, 1e-6),
    )
    F, G = (J.array(pose.dtype) for J in motion.ODOMETRY.jacobians(pose, control, dt))
    F_jax, by_control = jax.jacfwd(motion.ODOMETRY.transition, argnums=(0, 1))(pose, control, dt)
    np.testing.assert_allclose(F, F_jax, rtol=0, atol=tolerance(1e-14, 1e-6))
    path = math.sqrt(0.3**2 + 0.1**2 + 0.6**2 + 0.05**2)
    np.testing.assert_allclose(G, by_control * math.sqrt(path), rtol=0, atol=tolerance(1e-14, 1e-6))


def test_the_noise_of_odometry_grows_with_the_way(tolerance):
    """A metre in one step or in ten, but for the five centimetres that a step counts at least."""
    Q = jnp.diag(jnp.array([0.04, 0.09, 1e-8]))
    for steps in (1, 10):
        mean, cov = jnp.zeros(3), jnp.zeros((3, 3))
        for _ in range(steps):
            control = jnp.array([1 / steps, 0.0, 0.0])
            mean, cov = ekf.predict(mean, cov, control, jnp.array(1.0), Q, motion=motion.ODOMETRY, nominal_dt=1.0)
        way = steps * math.hypot(1 / steps, 0.05)
        np.testing.assert_allclose(mean, [1, 0, 0], rtol=0, atol=tolerance(1e-14, 1e-6))
        np.testing.assert_allclose(np.diagonal(cov)[:2], [0.04 * way, 0.09 * way], rtol=tolerance(1e-6, 1e-5))
