"""Simulated worlds against the reference's program, hand-worked rooms, and the noise they claim to have."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats

from jaxlocmap import Gaussian, GridSpec, simulate
from jaxlocmap.simulate import CAPSTONE, LOOP, Noise, World

BOX = (4.5, 4.0, 7.5, 6.5)  # the box in the room: low x, low y, high x, high y, m
SHORT = dataclasses.replace(CAPSTONE, name="short", steps=12, beams=5, sight_period=4)
FAILURE = 1e-6  # probability with which a statistical bound is missed by a right program

occupancy = jax.jit(simulate.occupancy, static_argnums=1)
draw_poses = jax.jit(jax.vmap(simulate.draw_pose, in_axes=(0, None)))


simulated = jax.jit(simulate.simulate, static_argnames=("scenario", "scan"))


@functools.partial(jax.jit, static_argnames=("scenario", "scan"))
def simulated_by_key_and_start(keys, world, noise, starts, *, scenario, scan):
    one = functools.partial(simulate.simulate, scenario=scenario, scan=scan)
    return jax.vmap(one, in_axes=(0, None, None, 0))(keys, world, noise, starts)


def many(seed, count, scenario, *, start=None, scan=False):
    """Drives of `count` keys as NumPy arrays, from starts drawn from the prior unless given."""
    keys = jax.random.split(jax.random.key(seed), count)
    if start is None:
        starts = draw_poses(jax.random.split(keys[0], count), scenario.prior())
    else:
        starts = jnp.broadcast_to(jnp.array(start), (count, 3))
    drives = simulated_by_key_and_start(keys, simulate.room(), Noise(), starts, scenario=scenario, scan=scan)
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


def assert_standard_deviation(values, expected):
    """The sample's standard deviation about zero lies in its χ² band around `expected`."""
    values = np.asarray(values, np.float64).ravel()
    low, high = spread_bounds(values.size)
    assert low <= np.sqrt(np.mean(values**2)) / expected <= high


# --- The course's drive ---


def test_given_the_course_s_random_numbers_the_drive_is_the_course_s(tolerance):
    draws, expected = reference.course_draws(seed=4), reference.course_run(seed=4)
    noise = Noise()
    truth, inputs = jax.jit(simulate.roll_out, static_argnames="scenario")(
        simulate.Draws(
            heading=jnp.array(draws["heading"] / noise.heading),
            control=jnp.array(draws["control"] / [noise.v, noise.w]),
            sighting=jnp.array(draws["detector"][::5] / [noise.range, noise.bearing]),
            scan=jnp.array(draws["scan"] / noise.scan),
        ),
        simulate.room(),
        noise,
        jnp.array(CAPSTONE.start),
        scenario=CAPSTONE,
    )
    exact = {"rtol": 0, "atol": tolerance(1e-10, 1e-4)}  # float32: rounding of 240 steps and of rays that graze a wall
    np.testing.assert_allclose(truth.pose, expected["truth"], **exact)
    np.testing.assert_allclose(inputs.control, expected["control"], **exact)
    np.testing.assert_array_equal(inputs.valid, expected["valid"])
    np.testing.assert_allclose(
        np.where(inputs.valid[..., None], inputs.z, 0), expected["z"], rtol=0, atol=tolerance(1e-10, 1e-4)
    )
    np.testing.assert_array_equal(inputs.landmark, expected["landmark"])
    np.testing.assert_allclose(inputs.dt, expected["dt"], rtol=1e-7)
    off = np.abs(inputs.ranges - expected["scans"]) > tolerance(1e-10, 1e-3)
    assert np.mean(off) <= tolerance(0, 1e-3)  # float32: a ray past a corner may meet another wall


def test_the_scenario_holds_the_course_s_constants():
    prior = CAPSTONE.prior()
    np.testing.assert_allclose(prior.mean, reference.COURSE_PRIOR_MEAN)
    np.testing.assert_allclose(prior.cov, reference.COURSE_PRIOR_COV, rtol=1e-6)
    np.testing.assert_allclose(CAPSTONE.beam_angles(), reference.COURSE_ANGLES, rtol=1e-6)
    np.testing.assert_allclose(simulate.room().landmarks, reference.COURSE_LANDMARKS)
    params = simulate.course_params()
    np.testing.assert_allclose(params.Q, reference.COURSE_Q, rtol=1e-6)
    np.testing.assert_allclose(params.R, reference.COURSE_R, rtol=1e-6)
    config = CAPSTONE.config()
    assert (config.dt, config.min_range, config.max_range) == (0.1, 0.05, 8.0)
    assert config.grid == GridSpec((0.0, 0.0), 0.2, reference.COURSE_GRID_SHAPE, -4.0, 4.0)
    assert CAPSTONE.config(grid=False).grid is None


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
    np.testing.assert_allclose((turned[:, -1] - turned[:, lap - 1]) / (2 * np.pi), 1, atol=0.05)


# --- Randomness ---


def test_the_same_key_gives_the_same_numbers_and_another_key_others():
    start = jnp.array(SHORT.start)
    first, again, other = (
        simulated(jax.random.key(seed), simulate.room(), Noise(), start, scenario=SHORT) for seed in (3, 3, 4)
    )
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.any(first[0].pose[:, 2] == other[0].pose[:, 2])
    assert not np.any(first[1].control == other[1].control)
    assert not np.any(first[1].z[:: SHORT.sight_period] == other[1].z[:: SHORT.sight_period])
    assert not np.any(first[1].ranges == other[1].ranges)


def test_a_batch_of_keys_worlds_noises_and_starts_is_a_python_loop(tolerance):
    batch = (
        jax.random.split(jax.random.key(0), 2),
        jax.tree.map(lambda x: jnp.stack([x, x * 1.5]), simulate.room()),
        jax.tree.map(lambda std: jnp.array([1.0, 2.0]) * std, Noise()),
        jnp.array([SHORT.start, (2.0, 3.0, 1.0)]),
    )
    both = jax.jit(jax.vmap(functools.partial(simulate.simulate, scenario=SHORT)))(*batch)
    for i in range(2):
        alone = simulated(*jax.tree.map(lambda x, i=i: x[i], batch), scenario=SHORT)
        jax.tree.map(
            lambda a, b, i=i: np.testing.assert_allclose(a, b[i], rtol=0, atol=tolerance(1e-12, 1e-5)), alone, both
        )


def test_neither_compiling_nor_leaving_out_the_scanner_changes_the_drive(tolerance):
    args = (jax.random.key(0), simulate.room(), Noise(), jnp.array(SHORT.start))
    truth, inputs = simulated(*args, scenario=SHORT)
    plain_truth, plain_inputs = simulate.simulate(*args, scenario=SHORT, scan=False)
    assert plain_inputs.ranges is None
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance(1e-12, 1e-5)),
        (truth, inputs._replace(ranges=None)),
        (plain_truth, plain_inputs),
    )


def test_the_true_start_has_the_prior_s_mean_and_covariance():
    L = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [-0.05, 0.1, 0.15]])
    prior = Gaussian(jnp.array([1.0, -2.0, 0.5]), jnp.array(L @ L.T))
    count = 20_000
    poses = np.asarray(draw_poses(jax.random.split(jax.random.key(0), count), prior))
    cov = L @ L.T
    reach = scipy.stats.norm.isf(FAILURE / 2)
    assert np.all(np.abs(poses.mean(0) - prior.mean) < reach * np.sqrt(np.diag(cov) / count))
    # The variance of a sample covariance of normals: (c_ij² + c_ii c_jj) / (n - 1).
    error = np.sqrt((cov**2 + np.outer(np.diag(cov), np.diag(cov))) / (count - 1))
    assert np.all(np.abs(np.cov(poses.T) - cov) < reach * error)


def test_the_true_start_s_heading_is_wrapped():
    prior = Gaussian(jnp.array([0.0, 0.0, 3.1]), jnp.diag(jnp.array([0.01, 0.01, 0.25])))
    headings = draw_poses(jax.random.split(jax.random.key(0), 200), prior)[:, 2]
    assert np.min(headings) < -2
    assert np.all((headings >= -np.pi) & (headings < np.pi))


# --- Sensors ---


def test_the_measured_noise_has_the_deviations_it_was_given(capstones):
    truth, inputs = capstones
    poses, noise = np.asarray(truth.pose, np.float64), Noise()
    command = np.array([reference.course_control(k) for k in range(CAPSTONE.steps)])
    assert_standard_deviation(inputs.control[..., 0] - command[:, 0], noise.v)
    assert_standard_deviation(inputs.control[..., 1] - command[:, 1], noise.w)
    before = np.concatenate([np.broadcast_to(CAPSTONE.start, (len(poses), 1, 3)), poses[:, :-1]], axis=1)
    kick = reference.wrap(poses[..., 2] - before[..., 2] - command[:, 1] * CAPSTONE.dt)
    assert_standard_deviation(kick, noise.heading)
    # Sightings of landmarks well within the detector's reach: nearer its edge the cut picks the short readings.
    to = reference.COURSE_LANDMARKS - poses[:, :, None, :2]
    distance = np.hypot(to[..., 0], to[..., 1])
    sure = np.asarray(inputs.valid) & (distance < CAPSTONE.sight_range - 6 * noise.range)
    assert_standard_deviation((np.asarray(inputs.z[..., 0]) - distance)[sure], noise.range)
    bearing = np.arctan2(to[..., 1], to[..., 0]) - poses[..., None, 2]
    assert_standard_deviation(reference.wrap(np.asarray(inputs.z[..., 1]) - bearing)[sure], noise.bearing)
    cast = jax.jit(
        jax.vmap(lambda pose: simulate.ray_cast(pose, CAPSTONE.beam_angles(), simulate.room().segments, 8.0))
    )
    run = slice(0, 20)
    exact = np.stack([cast(pose) for pose in truth.pose[run]])
    clear = exact > 0.5  # a reading is never below the least range
    assert_standard_deviation((np.asarray(inputs.ranges[run]) - exact)[clear], noise.scan)


def test_the_detector_looks_every_fifth_step_and_no_further_than_its_reach(capstones):
    truth, inputs = capstones
    valid, z = np.asarray(inputs.valid), np.asarray(inputs.z)
    looks = np.arange(CAPSTONE.steps) % 5 == 0
    assert not valid[:, ~looks].any()
    assert valid[:, looks].any(axis=(0, 2)).all()
    assert z[valid][:, 0].max() < CAPSTONE.sight_range
    distance = np.linalg.norm(reference.COURSE_LANDMARKS - np.asarray(truth.pose)[:, :, None, :2], axis=-1)
    near = distance < CAPSTONE.sight_range - 6 * 0.08
    assert valid[:, looks][near[:, looks]].all()
    far = distance > CAPSTONE.sight_range + 6 * 0.08
    assert far.any()
    assert not valid[far].any()


def test_every_finite_hit_lies_within_four_deviations_of_an_occupied_cell(capstones):
    # Between the exact hit, which is in an occupied cell, and the reading lies the beam's noise alone.
    truth, inputs = (jax.tree.map(lambda x: np.asarray(x[:2], np.float64), part) for part in capstones)
    spec = CAPSTONE.grid
    occupied = np.argwhere(np.asarray(occupancy(simulate.room(), spec)))
    low = occupied[:, ::-1] * spec.resolution
    high = low + spec.resolution
    sigma = 0.03
    hits = inputs.ranges < CAPSTONE.max_range - 5 * sigma  # a beam that met nothing reads 8 m plus noise
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


@pytest.mark.parametrize("pose", [(1.0, 1.0, 0.0), (9.0, 5.4, 2.0), (6.0, 5.0, -3.0), (0.3, 11.7, 3.1)])
def test_ray_casting_is_the_reference_s(pose, tolerance):
    expected = reference.course_ranges(np.array(pose), np.zeros(61))
    got = simulate.ray_cast(jnp.array(pose), CAPSTONE.beam_angles(), simulate.room().segments, 8.0)
    np.testing.assert_allclose(np.maximum(got, 0.05), expected, rtol=0, atol=tolerance(1e-12, 1e-4))


def test_ray_casting_in_a_room_worked_by_hand():
    # A square of 4 m with a short wall from (3, 1) to (3, 1.5) in it; the robot at (1, 1) looks along +x.
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]
    walls = [(corners[i], corners[(i + 1) % 4]) for i in range(4)] + [((3.0, 1.0), (3.0, 1.5))]
    angles = np.deg2rad([0.0, 45.0, 90.0, 180.0, -90.0, np.rad2deg(np.arctan2(0.25, 2.0)), -5.0])
    exact = [2.0, 3 * np.sqrt(2), 3.0, 1.0, 1.0, np.hypot(2, 0.25), 3 / np.cos(np.deg2rad(5))]
    cast = functools.partial(simulate.ray_cast, beam_angles=jnp.array(angles), segments=jnp.array(walls))
    np.testing.assert_allclose(cast(jnp.array([1.0, 1.0, 0.0]), max_range=10.0), exact, rtol=1e-5)
    np.testing.assert_allclose(cast(jnp.array([1.0, 1.0, 0.0]), max_range=2.5), np.minimum(exact, 2.5), rtol=1e-5)
    # The same robot turned by 90 degrees sees to the left what was ahead.
    turned = simulate.ray_cast(jnp.array([1.0, 1.0, np.pi / 2]), jnp.array(angles) - np.pi / 2, jnp.array(walls), 10.0)
    np.testing.assert_allclose(turned, exact, rtol=1e-5)


def test_a_beam_along_a_wall_and_a_world_without_walls_hit_nothing():
    along = jnp.array([[[2.0, 1.0], [3.0, 1.0]]])
    pose, ahead = jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0])
    assert simulate.ray_cast(pose, ahead, along, 8.0) == 8.0
    assert simulate.ray_cast(pose, ahead, jnp.zeros((0, 2, 2)), 8.0) == 8.0


# --- The true map ---


def drawn(cells):
    """The map as a picture of lines, highest y first."""
    return ["".join(".#"[int(cell)] for cell in row) for row in np.asarray(cells)[::-1]]


def occupied_by(*walls, origin=(0.0, 0.0), shape=(4, 5), resolution=1.0):
    world = World(jnp.array(walls, float), jnp.zeros((0, 2)))
    return drawn(occupancy(world, GridSpec(origin, resolution, shape)))


def test_a_wall_occupies_the_cells_it_runs_through():
    assert occupied_by([(0.5, 1.5), (3.5, 1.5)]) == [".....", ".....", "####.", "....."]
    assert occupied_by([(2.5, 3.7), (2.5, 2.2)]) == ["..#..", "..#..", ".....", "....."]


def test_a_slanted_wall_occupies_every_cell_it_cuts():
    # From (0.5, 0.5) to (2.5, 1.5): crosses x = 1 at y = 0.75, y = 1 at x = 1.5, x = 2 at y = 1.25.
    assert occupied_by([(0.5, 0.5), (2.5, 1.5)]) == [".....", ".....", ".##..", "##..."]
    assert occupied_by([(2.5, 1.5), (0.5, 0.5)]) == [".....", ".....", ".##..", "##..."]


def test_a_diagonal_through_corners_occupies_the_cells_that_touch_them():
    assert occupied_by([(0.5, 0.5), (2.5, 2.5)]) == [".....", ".##..", "###..", "##..."]


def test_a_wall_on_the_edge_of_two_cells_occupies_both():
    assert occupied_by([(0.5, 2.0), (1.5, 2.0)]) == [".....", "##...", "##...", "....."]
    assert occupied_by([(3.0, 0.5), (3.0, 0.6)]) == [".....", ".....", ".....", "..##."]


@pytest.mark.parametrize("resolution", [0.2, 0.1, 0.05])
def test_a_wall_on_an_edge_does_not_depend_on_rounding(resolution):
    # 0.2 and its multiples are no binary fractions: computed edges miss the wall by a rounding error.
    count = round(2 / resolution)
    for column in range(1, count):
        world = World(jnp.array([[(column * resolution, 0.31), (column * resolution, 0.33)]]), jnp.zeros((0, 2)))
        cells = np.asarray(occupancy(world, GridSpec((0.0, 0.0), resolution, (count, count))))
        assert np.flatnonzero(cells.any(axis=0)).tolist() == [column - 1, column]


def test_a_wall_outside_or_past_the_map_occupies_what_lies_on_it():
    assert occupied_by([(-3.0, -1.0), (9.0, -1.0)]) == ["....."] * 4
    assert occupied_by([(-3.0, 2.5), (9.0, 2.5)]) == [".....", "#####", ".....", "....."]
    assert occupied_by([(6.0, 0.0), (6.0, 3.0)]) == ["....."] * 4


def test_the_grid_s_origin_and_shape_place_the_walls():
    wall = [(-9.5, 21.5), (-8.5, 21.5)]
    assert occupied_by(wall, origin=(-10.0, 20.0), shape=(2, 4)) == ["##..", "...."]


def test_a_point_is_a_wall_and_no_wall_is_an_empty_map():
    assert occupied_by([(1.5, 1.5), (1.5, 1.5)]) == [".....", ".....", ".#...", "....."]
    world = World(jnp.zeros((0, 2, 2)), jnp.zeros((0, 2)))
    assert not np.any(occupancy(world, GridSpec((0.0, 0.0), 1.0, (4, 5))))
