"""Simulated drives against the reference's program, whose company they do not notice, and the noise they claim."""

import dataclasses
import functools
import itertools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats
from drives import like
from jax.interpreters.partial_eval import dce_jaxpr

from jaxlocmap import Config, Gaussian, GridSpec, se2, sensors, simulation
from jaxlocmap._internal import random
from jaxlocmap.simulation import CAPSTONE, LOOP, Detector, Noise, Scenario
from jaxlocmap.simulation.world import World, occupancy, ray_cast, room

BOX = (4.5, 4.0, 7.5, 6.5)  # the box in the room: low x, low y, high x, high y, m
SHORT = like(CAPSTONE, name="short", steps=12, beams=5, detector=dict(period=4))
FAILURE = 1e-6  # probability with which a statistical bound is missed by a right program

# Once each, and not operation by operation.
detect = jax.jit(simulation.detect, static_argnames="scenario")
roll_out = jax.jit(simulation.roll_out, static_argnames="scenario")
cast = jax.jit(jax.vmap(ray_cast, in_axes=(0, None, None, None)))
draw_states = jax.jit(jax.vmap(simulation.draw_state, in_axes=(0, None)))
simulated = jax.jit(simulation.simulate, static_argnames=("scenario", "scan"))


@functools.partial(jax.jit, static_argnames=("scenario", "scan"))
def simulated_by_key_and_start(keys, world, noise, starts, *, scenario, scan):
    one = functools.partial(simulation.simulate, scenario=scenario, scan=scan)
    return jax.vmap(one, in_axes=(0, None, None, 0))(keys, world, noise, starts)


def many(seed, count, scenario, *, start=None, scan=False):
    """Drives of `count` keys as NumPy arrays, from starts drawn from the prior unless given."""
    keys = jax.random.split(jax.random.key(seed), count)
    if start is None:
        starts = draw_states(jax.random.split(keys[0], count), scenario.prior())
    else:
        starts = jnp.broadcast_to(jnp.array(start), (count, 3))
    drives = simulated_by_key_and_start(keys, room(), Noise(), starts, scenario=scenario, scan=scan)
    return jax.tree.map(np.asarray, drives)


@pytest.fixture(scope="module")
def loops():
    return many(0, 100, LOOP)


@pytest.fixture(scope="module")
def capstones():
    return many(1, 200, CAPSTONE, start=CAPSTONE.start, scan=True)


def spread_bounds(samples):
    """Between which ratios of sample to true standard deviation lies a sample of zero-mean normals."""
    low, high = scipy.stats.chi2.ppf([FAILURE / 2, 1 - FAILURE / 2], samples)
    return np.sqrt(low / samples), np.sqrt(high / samples)


def assert_standard_normal(values):
    """The sample's mean and standard deviation about zero, and its distribution (Kolmogorov and Smirnov's bound)."""
    values = np.asarray(values, np.float64).ravel()
    assert abs(np.mean(values)) < scipy.stats.norm.isf(FAILURE / 2) / np.sqrt(values.size)
    low, high = spread_bounds(values.size)
    assert low <= np.sqrt(np.mean(values**2)) <= high
    assert scipy.stats.kstest(values, "norm").statistic < np.sqrt(np.log(2 / FAILURE) / 2 / values.size)


def assert_unrelated(one, other):
    """Two samples of standard normals that have nothing to do with each other: their products average to zero."""
    assert abs(np.mean(one * other)) < scipy.stats.norm.isf(FAILURE / 2) / np.sqrt(np.size(one))


# --- The course's drive ---


def test_given_the_course_s_random_numbers_the_drive_is_the_course_s(tolerance):
    """Its detector decides by what it measures, so everything is reported here and then cut as it does."""
    draws, expected = reference.course_draws(seed=4), reference.course_run(seed=4)
    noise = Noise()
    truth, inputs = roll_out(
        simulation.Draws(
            drive=jnp.array(np.column_stack([draws["heading"] / noise.heading, draws["control"] / [noise.v, noise.w]])),
            detection=jnp.array(draws["detector"] / [noise.range, noise.bearing]),
            scan=jnp.array(draws["scan"] / noise.scan),
        ),
        room(),
        noise,
        jnp.array(CAPSTONE.start),
        scenario=like(CAPSTONE, detector=dict(max_range=math.inf)),
    )
    valid = np.asarray(inputs.valid & (inputs.z[..., 0] < CAPSTONE.detector.max_range))
    exact = {"rtol": 0, "atol": tolerance(1e-10, 1e-4)}  # float32: rounding of 240 steps and of rays that graze a wall
    np.testing.assert_allclose(truth.pose, expected["truth"], **exact)
    np.testing.assert_allclose(inputs.control, expected["control"], **exact)
    np.testing.assert_array_equal(valid, expected["valid"])
    np.testing.assert_allclose(np.where(valid[..., None], inputs.z, 0), expected["z"], **exact)
    np.testing.assert_array_equal(inputs.landmark, expected["landmark"])
    np.testing.assert_allclose(inputs.dt, expected["dt"], rtol=1e-7)
    off = np.abs(inputs.ranges - expected["scans"]) > tolerance(1e-10, 1e-3)
    assert np.mean(off) <= tolerance(0, 1e-3)  # float32: a ray past a corner may meet another wall


def test_the_scenario_holds_the_course_s_constants():
    prior = CAPSTONE.prior()
    np.testing.assert_allclose(prior.mean, reference.COURSE_PRIOR_MEAN)
    np.testing.assert_allclose(prior.cov, reference.COURSE_PRIOR_COV, rtol=1e-6)
    np.testing.assert_allclose(CAPSTONE.beam_angles(), reference.COURSE_ANGLES, rtol=1e-6)
    params = simulation.course_params()
    np.testing.assert_allclose(params.Q, reference.COURSE_Q, rtol=1e-6)
    np.testing.assert_allclose(params.R, reference.COURSE_R, rtol=1e-6)
    amounts = [reference.COURSE_SCAN[name] for name in ("l_occ", "l_free")]
    np.testing.assert_allclose([params.l_occ, params.l_free], amounts, rtol=1e-6)
    config = CAPSTONE.config()
    assert (config.dt, config.min_range, config.max_range) == (0.1, 0.05, 8.0)
    assert config.grid == GridSpec((0.0, 0.0), 0.2, reference.COURSE_GRID_SHAPE, -4.0, 4.0)
    assert CAPSTONE.config(grid=False).grid is None


MADE_UP = Scenario(
    name="other",
    steps=7,
    command=lambda k, pose: jnp.stack([1.0 + 0 * pose[0], 2.0 + 0 * pose[0]]),
    start=(1.0, 2.0, 3.0),
    prior_std=(0.1, 0.2, 0.3),
    robot=Config(
        dt=0.25,
        max_range=3.0,
        min_range=0.4,
        grid=GridSpec((1.0, 2.0), 0.5, (3, 4)),
        sensor_offset=(0.1, 0.2, 0.3),
        scanner_offset=(0.4, 0.5, 0.6),
    ),
    detector=Detector(max_range=2.5, period=3),
    beams=5,
    half_view=0.6,
)


def test_a_scenario_of_other_numbers_is_what_it_says():
    """Those of the filter's settings as well; nothing here is a default."""
    np.testing.assert_allclose(MADE_UP.prior().mean, [1, 2, 3])
    np.testing.assert_allclose(MADE_UP.prior().cov, np.diag([0.01, 0.04, 0.09]), rtol=1e-6)
    np.testing.assert_allclose(MADE_UP.beam_angles(), [-0.6, -0.3, 0, 0.3, 0.6], rtol=0, atol=1e-7)
    assert [bool(MADE_UP.detector.active(k)) for k in range(7)] == [True, False, False, True, False, False, True]
    expected = Config(
        dt=0.25,
        motion="euler",
        gate_probability=0.9,
        sensor_offset=(0.1, 0.2, 0.3),
        scanner_offset=(0.4, 0.5, 0.6),
        grid=MADE_UP.robot.grid,
        min_range=0.4,
        max_range=3.0,
    )
    assert MADE_UP.config(motion="euler", gate_probability=0.9) == expected
    assert MADE_UP.config(grid=False) == dataclasses.replace(expected, motion="arc", gate_probability=0.99, grid=None)


def test_the_capstone_s_path_crosses_the_box(capstones):
    x, y = np.moveaxis(np.asarray(capstones[0].pose)[..., :2], -1, 0)
    inside = (x > BOX[0]) & (x < BOX[2]) & (y > BOX[1]) & (y < BOX[3])
    assert np.all(inside.any(axis=1))
    assert np.all(np.argmax(inside, axis=1) > CAPSTONE.steps / 2)  # near the end


def test_the_loop_keeps_half_a_metre_from_every_wall_and_comes_back(loops):
    poses = np.asarray(loops[0].pose)
    x, y = poses[..., 0], poses[..., 1]
    from_room = np.min([x, y, 12 - x, 12 - y], axis=0)
    outside_box = np.hypot(
        np.maximum(np.maximum(BOX[0] - x, x - BOX[2]), 0), np.maximum(np.maximum(BOX[1] - y, y - BOX[3]), 0)
    )
    assert from_room.min() > 0.5
    assert outside_box.min() > 0.5
    lap = LOOP.steps // 2
    # After the first lap the pull towards the circle has forgotten the start; what is left is the plant's noise.
    assert np.hypot(*(poses[:, -1, :2] - poses[:, lap - 1, :2]).T).max() < 0.5
    turned = np.unwrap(poses[..., 2], axis=1)
    np.testing.assert_allclose((turned[:, -1] - turned[:, lap - 1]) / (2 * np.pi), 1, rtol=0, atol=0.05)


# --- Randomness ---


@functools.partial(jax.jit, static_argnames="scenario")
def three(keys, worlds, noises, starts, *, scenario):
    """Three drives at once that share nothing."""
    return jax.vmap(functools.partial(simulation.simulate, scenario=scenario))(keys, worlds, noises, starts)


def settings_of_three():
    """Keys, worlds, noises and starts."""
    as_given = jax.tree.map(np.asarray, room())
    return (
        jax.random.split(jax.random.key(0), 3),
        jax.tree.map(lambda x: jnp.asarray(np.stack([x, x * x.dtype.type(1.5), x * x.dtype.type(0.9)])), as_given),
        jax.tree.map(lambda std: jnp.asarray(np.array([1.0, 2.0, 0.5]) * std), Noise()),
        jnp.array([SHORT.start, (2.0, 3.0, 1.0), (1.5, 1.2, -0.3)]),
    )


def chosen_of(tree, which):
    """One of a batch, or several; keys apart, without a program for every array."""
    return jax.tree.map(lambda x: x[which] if is_key(x) else jnp.asarray(np.asarray(x)[which]), tree)


def is_key(x):
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def test_a_batch_of_keys_worlds_noises_and_starts_is_a_python_loop(tolerance):
    batch = settings_of_three()
    together = three(*batch, scenario=SHORT)
    for i in range(3):
        alone = simulated(*chosen_of(batch, i), scenario=SHORT)
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(a, np.asarray(b)[i], rtol=0, atol=tolerance(1e-12, 1e-5)),
            alone,
            together,
        )


def test_a_drive_depends_on_its_key_and_not_on_its_company():
    """Bit for bit, whoever else is in the batch, and wherever in it; and with another key it is another."""

    def batch(*chosen, keys=None):
        settings = chosen_of(settings_of_three(), np.array(chosen))
        drives = three(*settings if keys is None else (keys, *settings[1:]), scenario=SHORT)
        return jax.tree.map(np.asarray, drives)

    first, second = batch(0, 1, 2), batch(2, 0, 0)
    for i, j in ((0, 1), (0, 2), (2, 0)):
        jax.tree.map(lambda x, y, i=i, j=j: np.testing.assert_array_equal(x[i], y[j]), first, second)
    truth, inputs = batch(0, 0, 0, keys=jax.random.split(jax.random.key(1), 3))
    for one, other in itertools.combinations(range(3), 2):
        assert not np.any(truth.pose[one, :, 2] == truth.pose[other, :, 2])
        assert not np.any(inputs.control[one] == inputs.control[other])
        both = np.asarray(inputs.valid[one] & inputs.valid[other])
        assert both.any()
        assert not np.any(np.asarray(inputs.z[one])[both] == np.asarray(inputs.z[other])[both])
        assert not np.any(inputs.ranges[one] == inputs.ranges[other])


def test_neither_compiling_nor_leaving_out_the_scanner_changes_the_drive(tolerance):
    args = (jax.random.key(0), room(), Noise(), jnp.array(SHORT.start))
    truth, inputs = simulated(*args, scenario=SHORT)
    plain_truth, plain_inputs = simulation.simulate(*args, scenario=SHORT, scan=False)
    assert plain_inputs.ranges is None
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance(1e-12, 1e-5)),
        (truth, inputs._replace(ranges=None)),
        (plain_truth, plain_inputs),
    )


@pytest.mark.usefixtures("x64")
def test_a_drive_is_the_same_in_both_precisions():
    key, *args = (jax.random.key(1), room(), jax.tree.map(jnp.asarray, Noise()), jnp.array(SHORT.start))
    double = simulated(key, *args, scenario=SHORT)
    single = simulated(key, *jax.tree.map(lambda x: x.astype(jnp.float32), args), scenario=SHORT)
    floats = [x.dtype for x in jax.tree.leaves(single) if jnp.issubdtype(x.dtype, jnp.floating)]
    assert set(floats) == {jnp.dtype(jnp.float32)}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-5), single, double)


def test_no_two_uses_of_a_step_share_a_random_number(monkeypatch):
    """Drive, every detection with what makes it false, and scan take counters of their own, at every step."""
    taken = []

    def recording(key, counter):
        del key
        taken.extend(np.stack(np.broadcast_arrays(*map(np.atleast_1d, counter)), axis=-1).tolist())
        return counter

    monkeypatch.setattr(random, "threefry", recording)
    words, scenario = (0, 0), like(CAPSTONE, detector=dict(outliers=True))
    for k in (0, 1, 2**20, 2**30):
        simulation.draw_drive(words, k, scenario=scenario, dtype=float)
        for j in range(30):
            simulation.draw_detection(words, k, j, scenario=scenario, dtype=float)
        simulation.draw_scan(words, k, scenario=scenario, dtype=float)
    assert len(taken) == len({tuple(counter) for counter in taken}) == 4 * (2 + 30 * 3 + CAPSTONE.beams)


def test_the_true_start_has_the_prior_s_mean_and_covariance():
    L = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [-0.05, 0.1, 0.15]])
    prior = Gaussian(jnp.array([1.0, -2.0, 0.5]), jnp.array(L @ L.T))
    count = 20_000
    poses = np.asarray(draw_states(jax.random.split(jax.random.key(0), count), prior))
    cov = L @ L.T
    reach = scipy.stats.norm.isf(FAILURE / 2)
    assert np.all(np.abs(poses.mean(0) - prior.mean) < reach * np.sqrt(np.diag(cov) / count))
    # The variance of a sample covariance of normals: (c_ij² + c_ii c_jj) / (n - 1).
    error = np.sqrt((cov**2 + np.outer(np.diag(cov), np.diag(cov))) / (count - 1))
    assert np.all(np.abs(np.cov(poses.T) - cov) < reach * error)


def test_the_true_start_s_heading_is_wrapped():
    prior = Gaussian(jnp.array([0.0, 0.0, 3.1]), jnp.diag(jnp.array([0.01, 0.01, 0.25])))
    headings = draw_states(jax.random.split(jax.random.key(0), 200), prior)[:, 2]
    assert np.min(headings) < -2
    assert np.all((headings >= -np.pi) & (headings < np.pi))


# --- Sensors ---


def test_the_noise_of_drive_and_sensors_is_what_the_equations_say(capstones, tolerance):
    """Every disturbance, divided by its deviation, is standard normal, and new at every step and in every run."""
    truth, inputs = capstones
    poses, noise = np.asarray(truth.pose, np.float64), Noise()
    command = np.array([reference.course_control(k) for k in range(CAPSTONE.steps)])
    before = np.concatenate([np.broadcast_to(CAPSTONE.start, (len(poses), 1, 3)), poses[:, :-1]], axis=1)
    step = CAPSTONE.dt * command[:, 0]
    moved = before[..., :2] + np.stack([step * np.cos(before[..., 2]), step * np.sin(before[..., 2])], -1)
    np.testing.assert_allclose(poses[..., :2], moved, rtol=0, atol=1e-5)  # float32: a place of 10 m in 24 bits
    kicks = [
        reference.wrap(poses[..., 2] - before[..., 2] - command[:, 1] * CAPSTONE.dt) / noise.heading,
        (inputs.control[..., 0] - command[:, 0]) / noise.v,
        (inputs.control[..., 1] - command[:, 1]) / noise.w,
    ]
    for kick in kicks:
        assert_standard_normal(kick)
        assert_unrelated(kick[:, :-1], kick[:, 1:])
        assert_unrelated(kick[:-1], kick[1:])
    for one, other in itertools.combinations(kicks, 2):
        assert_unrelated(one, other)
        assert_unrelated(one[:, :-1], other[:, 1:])
    # Observations of landmarks up to the detector's reach: a cut of what it measures would pick short readings.
    to = reference.COURSE_LANDMARKS - poses[:, :, None, :2]
    distance = np.hypot(to[..., 0], to[..., 1])
    sure = np.asarray(inputs.valid)
    bearing = np.arctan2(to[..., 1], to[..., 0]) - poses[..., None, 2]
    observations = [
        (np.asarray(inputs.z[..., 0]) - distance) / noise.range,
        reference.wrap(np.asarray(inputs.z[..., 1]) - bearing) / noise.bearing,
    ]
    for observation in observations:
        assert_standard_normal(observation[sure])
        both = sure[:, : -CAPSTONE.detector.period] & sure[:, CAPSTONE.detector.period :]
        assert_unrelated(
            observation[:, : -CAPSTONE.detector.period][both], observation[:, CAPSTONE.detector.period :][both]
        )
        both = sure[..., 3] & sure[..., 1]
        assert_unrelated(observation[..., 3][both], observation[..., 1][both])
    assert_unrelated(*(observation[sure] for observation in observations))
    edge = sure & (distance > CAPSTONE.detector.max_range - noise.range)
    assert np.sum(edge) > 100
    assert_standard_normal(observations[0][edge])
    run = slice(0, 20)
    exact = np.stack([cast(pose, CAPSTONE.beam_angles(), room().segments, 8.0) for pose in truth.pose[run]])
    scan = (np.asarray(inputs.ranges[run]) - exact) / noise.scan
    clear = exact > 0.5  # a reading is never below the least range
    strayed = clear & (np.abs(scan) > 6)  # in float32 a ray past a corner may meet another wall here than there
    assert np.mean(strayed) <= tolerance(0, 1e-3)
    clear &= ~strayed
    assert_standard_normal(scan[clear])
    for one, other in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:, :, :-1], np.s_[:, :, 1:]),
    ):
        both = clear[one] & clear[other]
        assert_unrelated(scan[one][both], scan[other][both])


def test_the_detector_looks_every_fifth_step_and_no_further_than_its_reach(capstones, tolerance):
    truth, inputs = capstones
    valid, z = np.asarray(inputs.valid), np.asarray(inputs.z)
    looks = np.arange(CAPSTONE.steps) % 5 == 0
    assert not valid[:, ~looks].any()
    assert valid[:, looks].any(axis=(0, 2)).all()
    distance = np.linalg.norm(reference.COURSE_LANDMARKS - np.asarray(truth.pose, float)[:, :, None, :2], axis=-1)
    close = np.abs(distance - CAPSTONE.detector.max_range) < tolerance(1e-12, 1e-5)
    np.testing.assert_array_equal(
        (valid | close)[:, looks], ((distance < CAPSTONE.detector.max_range) | close)[:, looks]
    )
    assert z[valid][:, 0].max() > CAPSTONE.detector.max_range  # measured, of a landmark that is nearer


def test_every_finite_hit_lies_within_four_deviations_of_an_occupied_cell(capstones):
    # Between the exact hit, which is in an occupied cell, and the reading lies the beam's noise alone.
    truth, inputs = (jax.tree.map(lambda x: np.asarray(x[:2], np.float64), part) for part in capstones)
    spec = CAPSTONE.robot.grid
    occupied = np.argwhere(np.asarray(jax.jit(occupancy, static_argnums=1)(room(), spec)))
    low = occupied[:, ::-1] * spec.resolution
    high = low + spec.resolution
    sigma = 0.03
    hits = inputs.ranges < CAPSTONE.robot.max_range - 5 * sigma  # a beam that met nothing reads 8 m plus noise
    angle = truth.pose[..., 2:] + reference.COURSE_ANGLES
    points = truth.pose[..., None, :2] + inputs.ranges[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    points = points[hits]
    assert len(points) > 10_000
    distance = np.full(len(points), np.inf)
    for a, b in zip(low, high, strict=True):
        gap = np.maximum(np.maximum(a - points, points - b), 0)
        distance = np.minimum(distance, np.hypot(gap[:, 0], gap[:, 1]))
    assert np.mean(distance > 3 * sigma) < 2 * scipy.stats.norm.sf(3)
    assert distance.max() < 5 * sigma  # of some 3e4 readings


@pytest.mark.parametrize("offset", [(0.3, 0.0, 0.0), (0.0, 0.0, 0.7), (-0.2, 0.4, -2.5)])
def test_a_detector_off_the_centre_sees_from_where_it_sits(offset, tolerance):
    """Also how far: some landmarks within reach of the centre are beyond its own."""
    scenario = like(SHORT, detector=dict(max_range=3.0), robot=dict(sensor_offset=offset))
    assert scenario.config().sensor_offset == offset
    pose, (dx, dy, dtheta) = np.array([1.0, -2.0, 0.9]), offset
    c, s = np.cos(pose[2]), np.sin(pose[2])
    sensor = np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy])
    for turn in np.linspace(-3, 3, 7):
        mark = pose[:2] + 2.9 * np.array([np.cos(turn), np.sin(turn)])
        to = mark - sensor
        z, near = detect(jnp.zeros(2), jnp.array(pose), jnp.array(mark), room(), Noise(), scenario=scenario)
        assert bool(near) == (np.hypot(*to) < 3)
        np.testing.assert_allclose(z[0], np.hypot(*to), rtol=0, atol=tolerance(1e-12, 1e-5))
        turned = reference.wrap(float(z[1]) - (np.arctan2(to[1], to[0]) - pose[2] - dtheta))
        np.testing.assert_allclose(turned, 0, rtol=0, atol=tolerance(1e-12, 1e-5))


def test_a_detector_at_the_centre_costs_nothing():
    """The same program, operation by operation, as one that knows of no offset, nor of anything else it has not."""

    def centred(draws, pose, landmark):
        dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
        near = jnp.sqrt(dx * dx + dy * dy) < SHORT.detector.max_range
        exact = sensors.RANGE_BEARING.expected(pose, landmark)
        reach, bearing = exact[0] + Noise().range * draws[0], exact[1]
        near = near & sensors.RANGE_BEARING.defined(pose, landmark)
        return jnp.stack([reach, se2.wrap(bearing + Noise().bearing * draws[1])]), near

    def operations(function):
        program = jax.make_jaxpr(function)(jnp.zeros(2), jnp.zeros(3), jnp.ones(2)).jaxpr
        needed, _ = dce_jaxpr(program, [True] * len(program.outvars))
        return sorted(eqn.primitive.name for eqn in needed.eqns)

    ours = operations(lambda *args: simulation.detect(*args, room(), Noise(), scenario=SHORT))
    assert ours == operations(centred)


# --- Another robot than the course's ---

OTHER = like(
    SHORT,
    name="other",
    steps=6,
    half_view=0.4,
    detector=dict(max_range=3.0, period=3),
    robot=dict(dt=0.25, max_range=2.0, min_range=0.3),
)


def test_a_drive_goes_by_the_robot_s_own_period_reach_and_looks(tolerance):
    """Without noise: a step of a quarter of a second, looks at steps 0 and 3 up to 3 m, a scan up to 2 m."""
    scenario = dataclasses.replace(OTHER, command=lambda k, pose: jnp.stack([1.0 + 0 * pose[0], 0.4 + 0 * pose[0]]))
    none = Noise(*[0.0] * (len(Noise._fields) - 1))
    draws = simulation.Draws(jnp.ones((6, 3)), jnp.ones((6, 4, 2)), jnp.ones((6, 5)))
    start = jnp.array([1.0, 9.0, 0.3])
    truth, inputs = roll_out(draws, room(), none, start, scenario=scenario)
    pose, poses = np.array(start, float), []
    for _ in range(6):
        pose = pose + 0.25 * np.array([np.cos(pose[2]), np.sin(pose[2]), 0.4])
        poses.append(pose)
    atol = tolerance(1e-12, 1e-5)
    np.testing.assert_allclose(truth.pose, poses, rtol=0, atol=atol)
    np.testing.assert_allclose(inputs.control, np.tile([1.0, 0.4], (6, 1)), rtol=1e-6)
    np.testing.assert_array_equal(inputs.dt, np.full(6, 0.25))
    to = np.asarray(room().landmarks, float) - np.array(poses)[:, None, :2]
    distance = np.hypot(to[..., 0], to[..., 1])
    valid = (distance < 3) & (np.arange(6) % 3 == 0)[:, None]
    assert 1 < valid.sum() < 8
    np.testing.assert_array_equal(inputs.valid, valid)
    np.testing.assert_allclose(inputs.z[..., 0], np.where(valid, distance, 0), rtol=0, atol=atol)
    exact = cast(jnp.array(poses), scenario.beam_angles(), room().segments, 2.0)
    np.testing.assert_allclose(inputs.ranges, exact, rtol=0, atol=tolerance(1e-9, 1e-4))


def test_a_scan_s_noise_comes_after_the_cut_at_its_reach_and_ends_at_its_least_range():
    """Nothing but one wall, 0.4 m ahead: beam by beam, what each draw makes of it."""
    around = World(jnp.array([[(0.4, -0.05), (0.4, 0.05)]]), jnp.zeros((0, 2)))
    draws = jnp.array([1.0, -1.0, -2.0, 0.5, -30.0])
    got = simulation.simulate_scan(draws, jnp.zeros(3), around, Noise(scan=0.1), scenario=OTHER)
    np.testing.assert_allclose(got, [2.1, 1.9, 0.3, 2.05, 0.3], rtol=1e-6)  # the middle one: 0.4 - 0.2 is below 0.3


def test_a_landmark_at_the_very_reach_is_not_seen():
    for reach, near in ((3.0, False), (np.nextafter(np.float32(3), np.float32(0)), True)):
        mark = jnp.array([float(reach), 0.0])
        assert bool(detect(jnp.zeros(2), jnp.zeros(3), mark, room(), Noise(), scenario=OTHER)[1]) is near


@pytest.mark.parametrize(("drawn", "false"), [(0.29, True), (0.31, False)])
def test_a_false_observation_is_made_of_its_own_draws(drawn, false):
    """Anywhere within the robot's own reach, and all around; what is drawn decides whether it is one."""
    draws, noise = jnp.array([1.0, -1.0, drawn, 0.25, 0.875]), Noise(range=0.1, bearing=0.2, outlier_rate=0.3)
    scenario = like(OTHER, detector=dict(outliers=True))
    z, near = detect(draws, jnp.zeros(3), jnp.array([2.0, 0.0]), room(), noise, scenario=scenario)
    assert near
    np.testing.assert_allclose(z, [0.75, 0.75 * np.pi] if false else [2.1, -0.2], rtol=1e-6)


def test_what_a_step_s_draws_are_for(tolerance):
    """The first turns the robot, the second and third are in what it measures alone."""
    noise, pose, expected = Noise(heading=0.1, v=0.2, w=0.3), jnp.zeros(3), reference.course_control(0)
    for i, (turn, control) in enumerate([(0.1, (0, 0)), (0, (0.2, 0)), (0, (0, 0.3))]):
        moved, measured = simulation.drive(jnp.eye(3)[i], jnp.array(0), pose, noise, scenario=SHORT)
        by = np.array([0.1 * expected[0], 0, 0.1 * expected[1] + turn])
        np.testing.assert_allclose(moved, by, rtol=0, atol=tolerance(1e-15, 1e-7))
        np.testing.assert_allclose(measured, expected + np.array(control), rtol=0, atol=tolerance(1e-15, 1e-7))


@pytest.mark.parametrize(
    ("off", "turned", "w"), [(0.0, 0.0, 0.0), (1.0, 0.0, 0.5), (-1.0, 0.0, -0.5), (0.0, 0.2, -0.2), (0.0, -0.2, 0.2)]
)
@pytest.mark.parametrize("place", [0.0, 2.0, -3.0])
def test_the_loop_s_command_leads_back_to_its_circle(place, off, turned, w, tolerance):
    """3 m around (6.0, 5.4), a lap in a minute; outside it turns in, and a heading that is off it turns back."""
    pose = [6 + (3 + off) * np.cos(place), 5.4 + (3 + off) * np.sin(place), place + np.pi / 2 + turned]
    got = LOOP.command(jnp.array(0), jnp.array(pose))
    np.testing.assert_allclose(got, [np.pi / 10, np.pi / 30 + w], rtol=0, atol=tolerance(1e-14, 1e-5))


def test_the_loop_is_two_laps_whose_true_start_is_drawn_from_the_prior():
    assert LOOP.steps * LOOP.dt == 2 * 60
    assert (LOOP.exact_prior, CAPSTONE.exact_prior) == (False, True)
    np.testing.assert_allclose(LOOP.start, [9, 5.4, np.pi / 2])
    drawn = dataclasses.replace(simulation.BUILDING, name="random_building")
    buildings = {"building": simulation.BUILDING, "random_building": drawn}
    assert {"capstone": CAPSTONE, "loop": LOOP, **buildings} == simulation.SCENARIOS


def test_the_tour_of_the_building_goes_through_its_doors_and_no_wall():
    """In a round of 4 minutes no wall is crossed between two steps, and none comes nearer than a third of a metre."""
    scenario = dataclasses.replace(simulation.BUILDING, steps=2500)
    walls = np.asarray(simulation.building().segments)
    drive = jax.jit(functools.partial(simulation.simulate, scenario=scenario, scan=False))
    truth, _ = drive(jax.random.key(0), simulation.building(), simulation.Noise(), jnp.asarray(scenario.start))
    path = np.asarray(truth.pose)[:, None, :2]
    a, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    share = np.clip(np.sum((path - a) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
    distance = np.linalg.norm(path - (a + share[..., None] * along), axis=-1)
    assert distance.min() > 1 / 3
    assert np.linalg.norm(np.diff(path[:, 0], axis=0), axis=-1).max() < 0.07
    for x, y in ((29, 4), (5, 6), (5, 14), (27, 16), (29, 10)):  # every room and the corridor
        assert np.linalg.norm(path[:, 0] - (x, y), axis=-1).min() < 2.5


def test_the_robot_s_own_noise_as_a_filter_has_it():
    """The heading noise of a step is what a yaw rate's of 0.02 / 0.5 would be: with 0.03 rad/s a 3-4-5 triangle."""
    noise = Noise(heading=0.02, v=0.1, w=0.03, range=0.2, bearing=0.3)
    params = simulation.own_params(noise, like(CAPSTONE, robot=dict(dt=0.5)))
    np.testing.assert_allclose(params.Q, np.diag([0.01, 0.05**2]), rtol=1e-6)
    np.testing.assert_allclose(params.R, np.diag([0.04, 0.09]), rtol=1e-6)


def test_every_word_of_a_key_makes_another_drive():
    for kind, words in (("threefry2x32", 2), ("rbg", 4)):
        data = np.zeros((words + 1, words), np.uint32)
        data[1:] = np.eye(words)
        made = [tuple(map(int, random.words_of(jax.random.wrap_key_data(row, impl=kind)))) for row in data]
        assert len(set(made)) == words + 1
        assert all(a != b for one, other in itertools.combinations(made, 2) for a, b in zip(one, other, strict=True))


# --- Shapes ---

SHAPES = {
    "drive": {"draws": (3,), "k": (), "state": (3,), "heading": (), "v": (), "w": ()},
    "detect": {"draws": (2,), "state": (3,), "landmark": (2,), "range": (), "bearing": ()},
    "simulate_scan": {"draws": (5,), "state": (3,), "segments": (8, 2, 2), "scan": ()},
    "draw_state": {"mean": (3,), "cov": (3, 3)},
    "simulate": {"start": (3,), "segments": (8, 2, 2), "landmarks": (4, 2), "v": ()},
}
# A state may have any length; what is said is what it does not fit.
OF_A_SHORT_STATE = {
    ("simulate_scan", "state", (1,)): r"pose: expected shape \(3\), got \(1,\)",
    ("draw_state", "mean", (1,)): r"cov: expected shape \(1, 1\), got \(3, 3\)",
}


@pytest.mark.parametrize(("atom", "name"), [(atom, name) for atom, arrays in SHAPES.items() for name in arrays])
def test_a_batch_is_refused_by_name(atom, name):
    for wrong in ((5, *SHAPES[atom][name]), (1,)):
        some = {key: jnp.ones(shape) for key, shape in (SHAPES[atom] | {name: wrong}).items()}
        noise = Noise(**{key: some.pop(key) for key in Noise._fields if key in some})
        world = World(some.pop("segments", jnp.ones((8, 2, 2))), some.pop("landmarks", jnp.ones((4, 2))))
        around = {"scenario": SHORT, "noise": noise}
        if atom in ("simulate", "simulate_scan", "detect"):
            around["world"] = world
        if atom == "simulate":
            around["key"] = jax.random.key(0)
        if atom == "draw_state":
            some, around = {"prior": Gaussian(**some)}, {"key": jax.random.key(0)}
        said = rf"(noise\.)?{name}: expected shape .*, got {re.escape(str(wrong))}"
        with pytest.raises(ValueError, match="^" + OF_A_SHORT_STATE.get((atom, name, wrong), said)):
            getattr(simulation, atom)(**some, **around)


def test_draws_for_another_detector_or_another_drive_are_refused():
    args = jnp.zeros(3), jnp.ones(2), room(), Noise()
    with pytest.raises(ValueError, match=r"^draws: expected shape \(5\), got \(2,\)$"):
        simulation.detect(jnp.zeros(2), *args, scenario=FALSE)
    draws = simulation.Draws(jnp.zeros((13, 3)), jnp.zeros((12, 4, 2)))
    with pytest.raises(ValueError, match=r"^draws\.drive: expected shape \(12, 3\), got \(13, 3\)$"):
        simulation.roll_out(draws, room(), Noise(), jnp.zeros(3), scenario=SHORT)


@pytest.mark.parametrize("name", ["detection", "scan"])
def test_draws_of_another_shape_are_refused_by_name(name):
    shapes = {"drive": (12, 3), "detection": (12, 4, 2), "scan": (12, 5)}
    for wrong in ((3, *shapes[name]), (*shapes[name][:-1], 1)):
        draws = simulation.Draws(**{key: jnp.zeros(shape) for key, shape in (shapes | {name: wrong}).items()})
        with pytest.raises(ValueError, match=rf"^draws\.{name}: expected shape .*, got {re.escape(str(wrong))}$"):
            simulation.roll_out(draws, room(), Noise(), jnp.zeros(3), scenario=SHORT)


@pytest.mark.parametrize("steps", [(1,), (5,), (5, 2)])
def test_random_numbers_are_those_of_one_step_and_one_landmark(steps):
    """Of several at once, the axis of steps would come last."""
    words, one, many = (0, 0), jnp.array(0), jnp.zeros(steps, int)
    kind = {"scenario": SHORT, "dtype": float}
    for name, draw in (
        ("k", lambda: simulation.draw_drive(words, many, **kind)),
        ("k", lambda: simulation.draw_detection(words, many, one, **kind)),
        ("j", lambda: simulation.draw_detection(words, one, many, **kind)),
        ("k", lambda: simulation.draw_scan(words, many, **kind)),
    ):
        with pytest.raises(ValueError, match=rf"^{name}: expected shape \(\), got {re.escape(str(steps))}$"):
            draw()


@pytest.mark.parametrize("keys", [jax.random.key, jax.random.PRNGKey])
def test_many_keys_are_refused_by_name(keys):
    with pytest.raises(ValueError, match=r"^key: expected shape .*, got \(5"):
        simulation.simulate(jax.random.split(keys(0), 5), room(), Noise(), jnp.zeros(3), scenario=SHORT)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.0, math.nan, 0.0)])
def test_a_detector_that_sits_nowhere_is_refused(offset):
    with pytest.raises(ValueError, match=r"^sensor_offset: expected finite \(dx, dy, dtheta\), got "):
        like(SHORT, robot=dict(sensor_offset=offset))


# --- Outliers ---

FALSE = like(SHORT, name="false", detector=dict(outliers=True))


@functools.partial(jax.jit, static_argnames=("scenario", "count"))
def sighted(distance, noise, *, scenario, count):
    """What the detector makes of a landmark straight ahead, at as many steps."""
    words = random.words_of(jax.random.key(7))
    pose, landmark = jnp.zeros(3), jnp.stack([distance, jnp.zeros_like(distance)])

    def one(k):
        draws = simulation.draw_detection(words, k, 2, scenario=scenario, dtype=float)
        return simulation.detect(draws, pose, landmark, room(), noise, scenario=scenario)

    return jax.vmap(one)(jnp.arange(count))


def test_false_observations_are_even_over_reach_and_bearing():
    """Whatever the landmark's own place is, and of one another."""
    z, valid = map(np.asarray, sighted(jnp.array(3.0), Noise(outlier_rate=1.0), scenario=FALSE, count=40_000))
    assert valid.all()
    share = np.column_stack([z[:, 0] / FALSE.detector.max_range, (z[:, 1] / np.pi + 1) / 2]).astype(np.float64)
    for values in share.T:
        gap = scipy.stats.kstest(values, "uniform").statistic
        assert gap < np.sqrt(np.log(2 / FAILURE) / 2 / len(z))
    normal = scipy.stats.norm.ppf(share.clip(1e-9, 1 - 1e-9))
    assert_unrelated(*normal.T)
    assert_unrelated(normal[:-1], normal[1:])


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.35])
def test_the_share_of_false_observations_is_the_rate(rate):
    """A landmark out of reach is not reported, falsely or not; of one in reach the true observations are as ever."""
    count, noise = 20_000, Noise(outlier_rate=rate)
    bound = scipy.stats.norm.isf(FAILURE / 2) * np.sqrt(count * rate * (1 - rate))
    _, valid = map(np.asarray, sighted(jnp.array(20.0), noise, scenario=FALSE, count=count))
    assert not valid.any()
    (z, valid), (honest, _) = (
        map(np.asarray, sighted(jnp.array(3.0), noise, scenario=scenario, count=count)) for scenario in (FALSE, SHORT)
    )
    assert valid.all()
    false = np.any(np.abs(z - honest) > 1e-6, axis=1)
    assert abs(np.sum(false) - count * rate) <= bound
    np.testing.assert_allclose(z[~false], honest[~false], rtol=0, atol=1e-6)
    if rate:
        assert_standard_normal((z[~false] - [3.0, 0.0]) / [0.08, 0.02])  # being false is no matter of the noise


def test_false_observations_change_neither_the_drive_nor_what_is_true():
    keys, worlds, noises, starts = settings_of_three()
    (truth, honest), (same_truth, some_false), (_, none_false) = (
        jax.tree.map(
            np.asarray,
            three(keys, worlds, noises._replace(outlier_rate=jnp.full(3, rate)), starts, scenario=scenario),
        )
        for scenario, rate in ((SHORT, 0.5), (FALSE, 0.5), (FALSE, 0.0))
    )
    close = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-5)
    jax.tree.map(close, (truth, honest.control, honest.ranges), (same_truth, some_false.control, some_false.ranges))
    jax.tree.map(close, honest, none_false)
    looks = np.arange(SHORT.steps) % SHORT.detector.period == 0
    assert not some_false.valid[:, ~looks].any()
    np.testing.assert_array_equal(some_false.valid, honest.valid)
    same = np.all(np.abs(honest.z - some_false.z) < 1e-5, axis=-1)
    assert same[honest.valid].any()
    assert not same[honest.valid].all()


@pytest.mark.parametrize("name", ["steps", "beams"])
def test_a_scenario_without_steps_or_beams_is_refused(name):
    with pytest.raises(ValueError, match=rf"^Scenario\.{name}: expected at least 1, got 0$"):
        dataclasses.replace(SHORT, **{name: 0})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"period": 0}, r"period: expected at least 1 step, got 0"),
        ({"min_range": -0.1}, r"min_range, max_range: expected 0 <= min_range < max_range, got -0\.1, 7\.5"),
        ({"min_range": 7.5}, r"min_range, max_range: expected 0 <= min_range < max_range, got 7\.5, 7\.5"),
        ({"max_range": math.nan}, r"min_range, max_range: expected 0 <= min_range < max_range, got 0\.0, nan"),
        ({"field_of_view": 0.0}, r"field_of_view: expected an angle in \(0, 2π\], got 0\.0"),
        ({"field_of_view": 7.0}, r"field_of_view: expected an angle in \(0, 2π\], got 7\.0"),
        ({"field_of_view": math.nan}, r"field_of_view: expected an angle in \(0, 2π\], got nan"),
    ],
)
def test_a_detector_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=rf"^Detector\.{message}$"):
        like(SHORT, detector=dict(**change))
