"""Sensors of one's own, as values: in a run, in a study, in tuning; and what a detector reports of landmarks."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drives import like

from jaxlocmap import Block, Config, Gaussian, Inputs, Params, Sensor, init, run, se2, sensors, simulation, tuning
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap._internal.trig import arctan2
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.mapping import grid
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.types import Scanner

# Each as a user would write it, with a Jacobian that could be left to autodiff.
GPS = Sensor(
    Block("gps", ("east", "north"), ("m", "m")),
    expected=lambda state, _: state[:2],
    jacobian=lambda state, _: Matrix([[1, 0, 0], [0, 1, 0]]),
    landmarks=False,
)
COMPASS = Sensor(
    Block("compass", ("heading",), ("rad",)),
    expected=lambda state, _: state[2:3],
    jacobian=lambda state, _: Matrix([[0, 0, 1]]),
    angles=(0,),
    landmarks=False,
)


def camera_jacobian(state, landmark):
    dx, dy = landmark[0] - state[0], landmark[1] - state[1]
    q = dx * dx + dy * dy
    return jnp.stack([dy / q, -dx / q, -jnp.ones_like(q)])[None]


CAMERA = Sensor(
    Block("camera", ("bearing",), ("rad",)),
    expected=lambda state, landmark: arctan2(landmark[1] - state[1], landmark[0] - state[0])[None] - state[2],
    jacobian=camera_jacobian,
    angles=(0,),
)
STD = {GPS: 0.3, COMPASS: 0.05, CAMERA: 0.02}
OWN = pytest.mark.parametrize("sensor", STD, ids=[sensor.noise.name for sensor in STD])
OFFSETS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.7), (0.5, -0.25, 0.3))


def setting(sensor, steps):
    scenario = like(simulation.LOOP, steps=steps, robot={"sensor": sensor})
    noise = simulation.Noise(blocks={sensor.noise.name: STD[sensor]})
    config = scenario.config(motion="euler", gate_probability=None, grid=False)
    return scenario, noise, config, simulation.own_params(noise, scenario)


@OWN
@pytest.mark.parametrize("offset", OFFSETS)
def test_a_jacobian_is_that_of_autodiff_wherever_the_sensor_sits(sensor, offset, tolerance):
    rng = np.random.default_rng(0)

    @jax.jit
    @jax.vmap
    def linearised(state, landmark):
        z = sensors.observe(state, landmark, sensor=sensor, offset=offset)
        found = []
        for one in (sensor, sensor._replace(jacobian=None)):
            residual, H, defined = sensors.linearise(state, landmark, z, sensor=one, offset=offset)
            found.append((residual, H.array(state.dtype), defined))
        return found, jax.jacfwd(lambda s: sensors.observe(s, landmark, sensor=sensor, offset=offset))(state)

    found, expected = linearised(jnp.asarray(rng.normal(size=(5, 4))), jnp.asarray(rng.normal(size=(5, 2)) * 5))
    for _, H, defined in found:
        rows = np.zeros((5, sensor.dim, 4))
        rows[..., : H.shape[-1]] = H
        np.testing.assert_allclose(rows, expected, rtol=0, atol=tolerance(1e-12, 1e-5))
        assert np.all(defined)
    np.testing.assert_allclose(found[0][0], 0, rtol=0, atol=tolerance(1e-14, 1e-6))


@pytest.mark.slow
@OWN
def test_a_study_of_an_honest_filter_is_consistent(sensor):
    """Bounds are in standard errors of these 500 drives, of 100 steps each."""
    scenario, noise, config, params = setting(sensor, steps=100)
    scene = params, simulation.room(), noise, scenario.prior()
    report = summarise(monte_carlo(Study(scenario, config), jax.random.key(0), 500, *scene).value, config)
    assert abs(report["anees"] - 3) < 4 * report["anees_standard_error"]
    assert abs(report["nis_mean"] - sensor.dim) < 4 * report["nis_standard_error"]
    assert tuple(report["innovation_lag_one"]) == sensor.noise.components
    reach = report["innovation_lag_one_band_95"]
    assert all(abs(value) < 3 * reach[name] for name, value in report["innovation_lag_one"].items())
    if not sensor.landmarks:
        assert report["observations"] == 500 * 20


# All three in one, so that one simulation does for each of them.
TOGETHER = Sensor(
    Block("together", tuple(name for sensor in STD for name in sensor.noise.components), ("m", "m", "rad", "rad")),
    expected=lambda state, landmark: jnp.concatenate([sensor.expected(state, landmark) for sensor in STD]),
    angles=(2, 3),
)


@functools.cache
def seen_together():
    """Sixty-four drives, and what the three sensors say of them wherever a landmark is in sight."""
    scenario = like(simulation.LOOP, steps=60, robot={"sensor": TOGETHER})
    noise = simulation.Noise(blocks={"together": np.repeat(list(STD.values()), [sensor.dim for sensor in STD])})
    return tuning.simulated(jax.random.key(1), 64, simulation.room(), noise, scenario=scenario)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@OWN
def test_its_noise_is_tuned(sensor):
    _, _, config, own = setting(sensor, steps=60)
    tuned = sensor.noise.components
    mine = [TOGETHER.noise.components.index(name) for name in tuned]
    batch = seen_together()
    batch = batch._replace(inputs=batch.inputs._replace(z=np.asarray(batch.inputs.z)[..., mine]))
    objective = tuning.Objective(config, (("innovation_nll", 1.0),))
    start = own.with_block(sensor.noise, 4 * own.block(sensor.noise))
    found = tuning.fit(objective, start, batch, tuned=tuned, epochs=3)
    sure = tuning.standard_errors(objective, found.params, batch, tuned)
    error = np.abs(sure.estimate - STD[sensor])
    assert np.all(error < 3 * sure.standard_error)
    assert np.all(sure.standard_error < 0.1 * STD[sensor])


def test_recorded_observations_of_a_sensor_without_landmarks_need_none(tolerance):
    """Two GPS fixes in one step are what a Kalman filter of a pose that stands still makes of them."""
    config = Config(motion="arc", gate_probability=None, sensor=GPS)
    params = Params.from_std(v=0.1, w=0.1, gps=(0.5, 0.5))
    assert params.R is None
    inputs = Inputs(
        dt=jnp.zeros(1),
        control=jnp.zeros((1, 2)),
        landmark=jnp.array([[7, -1]], jnp.int32),
        z=jnp.array([[[1.0, 2.0], [3.0, 4.0]]]),
        valid=jnp.ones((1, 2), bool),
    )
    prior = Gaussian(jnp.zeros(3), jnp.eye(3))
    state, info = run(params, init(prior, config=config), inputs, config=config)
    gain = 1 / (1 + 0.25 / 2)
    np.testing.assert_allclose(state.belief.mean, [2 * gain, 3 * gain, 0], rtol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(np.diag(state.belief.cov), [1 - gain, 1 - gain, 1], rtol=tolerance(1e-12, 1e-5))
    assert info.row.tolist() == [[0, 0]]
    assert bool(info.ok[0])


def test_an_unknown_sensor_and_a_missing_noise_are_named():
    inputs = jax.tree.map(jnp.asarray, tuning.no_observations(1))._replace(
        landmark=jnp.zeros((1, 1), jnp.int32), z=jnp.ones((1, 1, 2)), valid=jnp.ones((1, 1), bool)
    )
    prior = Gaussian(jnp.zeros(3), jnp.eye(3))
    params = simulation.course_params()
    for config, message in (
        (Config(sensor="sonar"), r"sensor: expected one of \['range_bearing'\] or a Sensor, got 'sonar'"),
        (Config(sensor=GPS), r"params\.gps: expected the covariance of \(east, north\) \(2, 2\), got none"),
        (Config(sensor=COMPASS), r"inputs\.z: expected shape \(1, 1\), got \(1, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            run(params, init(prior, config=config), inputs, config=config)
    without = Params.from_std(v=0.1, w=0.1)
    with pytest.raises(
        ValueError, match=r"params\.R: expected the covariance of \(range, bearing\) \(2, 2\), got none"
    ):
        run(without, init(prior, config=Config()), inputs, landmarks=jnp.ones((1, 2)), config=Config())


def test_a_jacobian_of_another_shape_is_refused():
    wrong = GPS._replace(jacobian=lambda state, _: jnp.eye(2))
    with pytest.raises(ValueError, match="jacobian of gps: expected 2 x 3 or x 4, got"):
        sensors.linearise(jnp.zeros(4), None, jnp.zeros(2), sensor=wrong)
    with pytest.raises(ValueError, match=r"expected gps: expected shape \(2\), got \(3,\)"):
        sensors.linearise(jnp.zeros(4), None, jnp.zeros(2), sensor=GPS._replace(expected=lambda s, _: s[:3]))


# --- the simulated detector


def detected(pose, landmark, robot=None, **detector):
    scenario = like(simulation.CAPSTONE, detector=detector, robot=robot or {})
    draws = jnp.zeros(2)
    noise = simulation.Noise()
    return bool(
        simulation.detect(draws, jnp.array(pose), jnp.array(landmark), simulation.room(), noise, scenario=scenario)[1]
    )


def test_a_detector_has_a_field_of_view():
    pose = [3.0, 9.0, math.pi]
    for bearing, seen in ((0.0, True), (0.49, True), (-0.49, True), (0.51, False), (-0.51, False), (3.0, False)):
        angle = pose[2] + bearing
        landmark = [pose[0] + math.cos(angle), pose[1] + math.sin(angle)]
        assert detected(pose, landmark, field_of_view=1.0) is seen
        assert detected(pose, landmark) is True
        assert detected(pose, landmark, robot={"sensor_offset": (0.0, 0.0, bearing)}, field_of_view=1.0) is True


def test_a_detector_has_a_least_and_a_largest_range():
    for reach, seen in ((0.99, False), (1.01, True), (1.99, True), (2.01, False)):
        assert detected([3.0, 9.0, 0.0], [3.0 + reach, 9.0], min_range=1.0, max_range=2.0) is seen


def test_a_landmark_on_the_sensor_has_no_bearing_to_report():
    assert detected([3.0, 9.0, 0.0], [3.0, 9.0]) is False
    assert detected([3.0, 9.0, 0.0], [3.0, 9.0 + 1e-3]) is True


@pytest.mark.parametrize(("landmark", "hidden"), [([9.0, 5.0], True), ([6.0, 9.0], False), ([4.5, 5.0], False)])
def test_walls_hide_landmarks_if_asked(landmark, hidden):
    """The box from (4.5, 4) to (7.5, 6.5) stands between; what hangs on the wall that faces the robot is seen."""
    assert detected([2.0, 5.0, 0.0], landmark, max_range=20.0) is True
    assert detected([2.0, 5.0, 0.0], landmark, max_range=20.0, occlusion=True) is not hidden


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"period": 0}, r"Detector\.period: expected at least 1 step, got 0"),
        ({"min_range": 8.0}, r"Detector\.min_range, max_range: expected 0 <= min_range < max_range, got 8\.0, 7\.5"),
        ({"min_range": -1.0}, r"Detector\.min_range, max_range: expected"),
        ({"field_of_view": 0.0}, r"Detector\.field_of_view: expected an angle in \(0, 2π\], got 0\.0"),
        ({"field_of_view": 7.0}, r"Detector\.field_of_view: expected an angle in \(0, 2π\], got 7\.0"),
    ],
)
def test_a_detector_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        simulation.Detector(**change)


def test_false_observations_of_any_sensor_lie_within_reach():
    scenario = like(simulation.LOOP, detector={"outliers": True, "max_range": 5.0}, robot={"sensor": GPS})
    noise = simulation.Noise(blocks={"gps": 0.0}, outlier_rate=0.5)
    state = jnp.array([9.0, 5.0, 1.0])

    @jax.jit
    @jax.vmap
    def draw(key):
        draws = jnp.concatenate([jax.random.normal(key, (2,)), jax.random.uniform(key, (3,))])
        return simulation.detect(draws, state, jnp.zeros(2), simulation.room(), noise, scenario=scenario)[0]

    off = np.asarray(draw(jax.random.split(jax.random.key(0), 2000))) - np.asarray(state[:2])
    false = np.any(off != 0, axis=1)
    assert abs(false.mean() - 0.5) < 4 * 0.5 / np.sqrt(2000)
    assert 4.9 < np.abs(off).max() <= 5.0


# --- a scanner off the centre


def test_a_scanner_maps_from_where_it_sits(tolerance):
    spec = grid.GridSpec(origin=(0.0, 0.0), resolution=0.5, shape=(20, 20))
    offset, pose = (0.8, -0.3, 0.4), jnp.array([4.1, 5.2, 0.6])
    angles, ranges = jnp.linspace(-1, 1, 7), jnp.linspace(1.0, 3.0, 7)
    amounts = jnp.array(0.85), jnp.array(-0.4)
    mounted, _ = se2.compose(pose, offset)

    def mapped(pose, scanner):
        return grid.update_log_odds(jnp.zeros(spec.shape), pose, ranges, *amounts, scanner=scanner, spec=spec)

    centred = jax.jit(lambda pose: mapped(pose, Scanner(angles)))
    there, here = centred(mounted), jax.jit(lambda pose: mapped(pose, Scanner(angles, offset)))(pose)
    np.testing.assert_array_equal(here, there)
    assert np.any(here != centred(pose))


def test_a_simulated_scan_is_taken_where_the_scanner_sits(tolerance):
    offset, state = (0.8, -0.3, 0.4), jnp.array([4.1, 9.2, 0.6])
    scenario = like(simulation.CAPSTONE, robot={"scanner_offset": offset})
    still, none = simulation.Noise(scan=0.0), jnp.zeros(scenario.beams)
    world = simulation.room()
    got = simulation.simulate_scan(none, state, world, still, scenario=scenario)
    mounted, _ = se2.compose(state, offset)
    expected = simulation.simulate_scan(none, mounted, world, still, scenario=simulation.CAPSTONE)
    np.testing.assert_allclose(got, expected, rtol=tolerance(1e-12, 1e-5))


def test_settings_that_are_not_the_robots_are_refused():
    for name, value in (("dt", 0.2), ("max_range", 7.0), ("min_range", 0.1), ("scanner_offset", (1.0, 0.0, 0.0))):
        config = dataclasses.replace(simulation.CAPSTONE.config(grid=False), **{name: value})
        with pytest.raises(ValueError, match=rf"config\.{name}: expected that of the scenario"):
            simulation.CAPSTONE.check(config)
    named = simulation.CAPSTONE.config(grid=False)
    simulation.CAPSTONE.check(dataclasses.replace(named, sensor=sensors.RANGE_BEARING))
    with pytest.raises(ValueError, match=r"config\.sensor: expected that of the scenario"):
        simulation.CAPSTONE.check(dataclasses.replace(named, sensor=GPS))
