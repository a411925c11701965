"""The range-bearing sensor against the reference and forward-mode differentiation; association."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st

from jaxlocmap import se2, sensors

OFFSETS = [(0.0, 0.0, 0.0), (0.219, 0.0, 0.0), (0.0, 0.0, 0.5), (0.3, -0.2, -1.1), (-0.1, 0.4, 3.0)]


def scene(seed, count=20):
    """Poses with headings all round, and a landmark for each at 0.5 to 10 m."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(-np.pi, np.pi, count)])
    reach, bearing = rng.uniform(1.0, 10.0, count), rng.uniform(-np.pi, np.pi, count)
    return poses, poses[:, :2] + reach[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])


def jacobian(pose, landmark, offset):
    return sensors.linearise(pose, landmark, jnp.zeros(2), offset=offset)[1].array(pose.dtype)


def over_scene(function, offset):
    return np.asarray(jax.jit(jax.vmap(lambda p, m: function(p, m, offset=offset)))(*(jnp.array(x) for x in scene(0))))


@pytest.mark.parametrize("offset", OFFSETS)
def test_expectation_and_jacobian_are_the_reference(offset, tolerance):
    expected = [reference.expected_observation(*case, offset) for case in zip(*scene(0), strict=True)]
    atol = tolerance(1e-13, 2e-5)  # roundings of 10 m; bearing of a landmark at 0.5 m
    error = over_scene(sensors.observe, offset) - np.array([h for h, _ in expected])
    error[:, 1] = reference.wrap(error[:, 1])
    np.testing.assert_allclose(error, 0, rtol=0, atol=atol)
    np.testing.assert_allclose(over_scene(jacobian, offset), [H for _, H in expected], rtol=0, atol=atol)


@pytest.mark.parametrize("offset", OFFSETS)
def test_jacobian_is_the_derivative_of_the_expectation(offset, tolerance):
    derivative = over_scene(jax.jacfwd(sensors.observe), offset)
    np.testing.assert_allclose(over_scene(jacobian, offset), derivative, rtol=0, atol=tolerance(1e-14 * 4, 1e-5))


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_sensor_off_the_centre_sees_what_one_at_its_place_would(offset, tolerance):
    dx, dy, dtheta = offset

    def at_its_place(pose, landmark, offset):
        c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
        sensor = jnp.stack([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + dtheta])
        return sensors.observe(sensor, landmark)

    error = over_scene(sensors.observe, offset) - over_scene(at_its_place, offset)
    error[:, 1] = reference.wrap(error[:, 1])
    np.testing.assert_allclose(error, 0, rtol=0, atol=tolerance(1e-14, 1e-5))


@pytest.mark.parametrize("offset", OFFSETS)
def test_residual_of_the_expectation_is_zero(offset, tolerance):
    def residual(pose, landmark, offset):
        return sensors.linearise(pose, landmark, sensors.observe(pose, landmark, offset=offset), offset=offset)[0]

    np.testing.assert_allclose(over_scene(residual, offset), 0, rtol=0, atol=tolerance(1e-14, 5e-6))


def test_residual_takes_the_short_way_across_pi(tolerance):
    """Expected at bearing -pi + 0.01, seen at pi - 0.01: 0.02 rad to the right, not 6.26 to the left."""
    pose, landmark = jnp.array([0.0, 0.0, -0.01]), jnp.array([-2.0, 0.0])
    np.testing.assert_allclose(sensors.observe(pose, landmark)[1], -np.pi + 0.01, rtol=1e-6)
    residual, _, _ = sensors.linearise(pose, landmark, jnp.array([2.5, np.pi - 0.01]))
    np.testing.assert_allclose(residual, [0.5, -0.02], rtol=0, atol=tolerance(1e-14, 1e-6))


@given(seed=st.integers(0, 1000), turns=st.integers(-3, 3))
def test_residual_bearing_stays_within_pi_however_the_bearing_is_counted(seed, turns):
    (pose, *_), (landmark, *_) = scene(seed, 1)
    z = sensors.observe(jnp.array(pose), jnp.array(landmark)) + jnp.array([0.0, 0.3 + 2 * np.pi * turns])
    residual, _, _ = sensors.linearise(jnp.array(pose), jnp.array(landmark), z)
    assert abs(float(residual[1]) - 0.3) < 1e-5  # 20 rad in float32


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.5, 0.25, 0.3)])
def test_a_landmark_on_the_sensor_is_undefined_with_finite_gradients(offset):
    pose = jnp.array([0.0, 0.0, 0.0])
    landmark = jnp.array(offset[:2])

    def total(pose, landmark):
        residual, H, defined = sensors.linearise(pose, landmark, jnp.array([1.0, 0.1]), offset=offset)
        return jnp.sum(residual) + jnp.sum(H.array(pose.dtype)), defined

    gradients, defined = jax.grad(total, argnums=(0, 1), has_aux=True)(pose, landmark)
    assert not defined
    assert all(np.all(np.isfinite(g)) for g in gradients)


@pytest.mark.parametrize(
    ("distance", "there"), [(0.0, False), (3.1e-5, False), (3.2e-5, True), (1e-4, True), (1e-3, True), (0.05, True)]
)
def test_a_landmark_has_a_bearing_from_a_thirtieth_of_a_millimetre_on(distance, there, tolerance):
    """Where it has none the Jacobian is that of one a metre ahead along x."""
    pose, angle = jnp.array([0.0, 0.0, 0.3]), 2.0
    landmark = distance * np.array([np.cos(angle), np.sin(angle)])
    residual, H, defined = sensors.linearise(pose, jnp.array(landmark), jnp.array([1.0, 0.5]))
    assert bool(defined) is there
    r, angle = (distance, angle) if there else (1.0, 0.0)
    c, s = np.cos(angle), np.sin(angle)
    rtol = tolerance(1e-12, 1e-5)
    np.testing.assert_allclose(residual, [1 - r, 0.5 - angle + 0.3], rtol=rtol)
    np.testing.assert_allclose(H.array(pose.dtype), [[-c, -s, 0], [s / r, -c / r, -1]], rtol=rtol, atol=0)


SHAPES = {"state": (3,), "landmark": (2,), "z": (2,)}
WRONG = [(name, wrong) for name in SHAPES for wrong in ((), (1,), (5, 2), (5, 3), (4,))]
WRONG.remove(("state", (4,)))  # it may be longer than a pose


@pytest.mark.parametrize(("name", "wrong"), WRONG)
def test_a_batch_is_refused_by_name(name, wrong):
    arrays = {key: jnp.ones(shape) for key, shape in SHAPES.items()} | {name: jnp.ones(wrong)}
    expected = rf"^{name}: expected shape .*, got {re.escape(str(wrong))}$"
    with pytest.raises(ValueError, match=expected):
        sensors.linearise(**arrays)
    if name != "z":
        with pytest.raises(ValueError, match=expected):
            sensors.observe(arrays["state"], arrays["landmark"])


@pytest.mark.parametrize("wrong", [(), (1,), (5, 2), (5, 3), (4,)])
def test_the_pose_of_a_sensor_is_of_one_pose(wrong):
    with pytest.raises(ValueError, match=rf"^pose: expected shape .*, got {re.escape(str(wrong))}$"):
        se2.compose(jnp.ones(wrong), (0.1, 0.0, 0.0))


# --- association

SHAPES_OF_ASSOCIATE = {"mean": (3,), "cov": (3, 3), "z": (2,), "landmarks": (4, 2), "R": (2, 2)}


@pytest.mark.parametrize("name", SHAPES_OF_ASSOCIATE)
def test_association_of_a_batch_is_refused_by_name(name):
    arrays = {key: jnp.ones(shape) for key, shape in SHAPES_OF_ASSOCIATE.items()}
    with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got \(5, "):
        sensors.associate(**arrays | {name: jnp.ones((5, *SHAPES_OF_ASSOCIATE[name]))})


P = np.array([[0.05, 0.01, 0.002], [0.01, 0.04, 0.001], [0.002, 0.001, 0.02]])
R = np.diag([0.15**2, 0.03**2])


@pytest.mark.parametrize("offset", OFFSETS[:1] + OFFSETS[3:4])
def test_association_is_the_reference(offset):
    """200 observations of no landmark in particular, so that the nearest is often a close call."""
    rng = np.random.default_rng(1)
    table = rng.uniform(-6, 6, (7, 2))
    zs = np.column_stack([rng.uniform(0.5, 8, 200), rng.uniform(-np.pi, np.pi, 200)])
    poses = np.column_stack([rng.normal(size=(200, 2)), rng.uniform(-np.pi, np.pi, 200)])
    expected = [reference.nearest_landmark(p, P, z, table, R, offset) for p, z in zip(poses, zs, strict=True)]

    def associate(pose, z):
        return sensors.associate(pose, jnp.array(P), z, jnp.array(table), jnp.array(R), offset=offset)

    got = jax.jit(jax.vmap(associate))(jnp.array(poses), jnp.array(zs))
    assert len(set(expected)) == 7
    np.testing.assert_array_equal(got, expected)


def test_association_weighs_distance_by_uncertainty():
    """Landmark 0 is the nearer in metres, 1 along the uncertain direction: the filter must prefer 1."""
    pose, cov = jnp.zeros(3), jnp.diag(jnp.array([1.0, 1e-4, 1e-6]))
    table = jnp.array([[5.0, 0.5], [6.0, 0.0]])
    z = jnp.array([5.0, 0.0])
    assert sensors.associate(pose, cov, z, table, jnp.diag(jnp.array([1e-3, 1e-4]))) == 1


def test_association_never_picks_a_landmark_on_the_sensor():
    table = jnp.array([[0.0, 0.0], [50.0, 50.0]])
    row = sensors.associate(jnp.zeros(3), jnp.array(P), jnp.array([0.01, 0.0]), table, jnp.array(R))
    assert row == 1
    assert row.dtype == jnp.int32
