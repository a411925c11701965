"""Walls seen by a laser, against the reference, NumPy and rooms worked by hand, and the map they ought to give."""

import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats

from jaxlocmap import GridSpec
from jaxlocmap.simulation import scenario, world
from jaxlocmap.simulation.world import World, room

occupancy = jax.jit(world.occupancy, static_argnums=1)
ray_cast = jax.jit(world.ray_cast)


def test_the_room_is_the_course_s():
    here = room()
    np.testing.assert_allclose(here.landmarks, reference.COURSE_LANDMARKS)
    expected = [(ring[i], ring[(i + 1) % 4]) for ring in reference.COURSE_WALLS for i in range(4)]
    np.testing.assert_allclose(here.segments, expected)


# --- What a laser sees ---


@pytest.mark.parametrize("pose", [(1.0, 1.0, 0.0), (9.0, 5.4, 2.0), (6.0, 5.0, -3.0), (0.3, 11.7, 3.1)])
def test_ray_casting_is_the_reference_s(pose, tolerance):
    expected = reference.course_ranges(np.array(pose), np.zeros(61))
    got = ray_cast(jnp.array(pose), jnp.array(reference.COURSE_ANGLES), room().segments, 8.0)
    np.testing.assert_allclose(np.maximum(got, 0.05), expected, rtol=0, atol=tolerance(1e-12, 1e-4))


def nearest_hit(pose, angle, walls, max_range):
    """Where a beam first meets a wall: pose + t d = a + s (b - a), solved for t and s wall by wall."""
    heading, hits = pose[2] + angle, [max_range]
    for a, b in walls:
        directions = np.column_stack([[np.cos(heading), np.sin(heading)], a - b])
        t, s = np.linalg.solve(directions, a - pose[:2])
        if t >= 0 and 0 <= s <= 1:
            hits.append(t)
    return min(hits)


@pytest.mark.parametrize("walls", [1, 7, 8, 9, 20])
def test_ray_casting_among_random_walls_is_a_linear_system_a_wall(walls, tolerance):
    """Behind the robot, beyond the reach, one behind another; however many a turn of the loop takes at once."""
    rng = np.random.default_rng(walls)
    segments, angles = rng.uniform(-5, 5, (walls, 2, 2)), rng.uniform(-np.pi, np.pi, 12)
    poses = np.column_stack([rng.uniform(-3, 3, (6, 2)), rng.uniform(-np.pi, np.pi, 6)])
    got = jax.vmap(ray_cast, in_axes=(0, None, None, None))(*map(jnp.array, (poses, angles, segments)), 4.0)
    expected = [[nearest_hit(pose, angle, segments, 4.0) for angle in angles] for pose in poses]
    off = np.abs(got - np.array(expected)) > tolerance(1e-9, 1e-3)  # where a beam all but runs along a wall
    assert np.mean(off) <= tolerance(0, 0.02)  # float32: a beam past an end may meet another wall


def test_ray_casting_in_a_room_worked_by_hand():
    # A square of 4 m with a short wall from (3, 1) to (3, 1.5) in it; the robot at (1, 1) looks along +x.
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]
    walls = [(corners[i], corners[(i + 1) % 4]) for i in range(4)] + [((3.0, 1.0), (3.0, 1.5))]
    angles = np.deg2rad([0.0, 45.0, 90.0, 180.0, -90.0, np.rad2deg(np.arctan2(0.25, 2.0)), -5.0])
    exact = [2.0, 3 * np.sqrt(2), 3.0, 1.0, 1.0, np.hypot(2, 0.25), 3 / np.cos(np.deg2rad(5))]
    cast = functools.partial(ray_cast, beam_angles=jnp.array(angles), segments=jnp.array(walls))
    np.testing.assert_allclose(cast(jnp.array([1.0, 1.0, 0.0]), max_range=10.0), exact, rtol=1e-5)
    np.testing.assert_allclose(cast(jnp.array([1.0, 1.0, 0.0]), max_range=2.5), np.minimum(exact, 2.5), rtol=1e-5)
    # The same robot turned by 90 degrees sees to the left what was ahead.
    turned = ray_cast(jnp.array([1.0, 1.0, np.pi / 2]), jnp.array(angles) - np.pi / 2, jnp.array(walls), 10.0)
    np.testing.assert_allclose(turned, exact, rtol=1e-5)


def test_a_beam_along_a_wall_and_a_world_without_walls_hit_nothing():
    along = jnp.array([[[2.0, 1.0], [3.0, 1.0]]])
    pose, ahead = jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0])
    assert ray_cast(pose, ahead, along, 8.0) == 8.0
    assert ray_cast(pose, ahead, jnp.zeros((0, 2, 2)), 8.0) == 8.0


@pytest.mark.parametrize(
    ("wall", "distance"),
    [
        ([(3.0, 1.0), (3.0, 2.0)], 2.0),  # onto its first end, exactly
        ([(3.0, 0.0), (3.0, 1.0)], 2.0),  # onto its last
        ([(3.0, 1.0 + 1e-4), (3.0, 2.0)], 8.0),  # just past it
        ([(3.0, 0.0), (3.0, 1.0 - 1e-4)], 8.0),
        ([(1.0, 0.0), (1.0, 2.0)], 0.0),  # the robot stands at the wall
        ([(1.0 - 1e-4, 0.0), (1.0 - 1e-4, 2.0)], 8.0),  # or just before it
        ([(2.0, 1.0 - 1e-5), (4.0, 1.0 + 1e-5)], 2.0),  # all but along the beam
        ([(2.0, 1.0), (4.0, 1.0)], 8.0),  # seen edge on
        ([(9.0, 0.0), (9.0, 2.0)], 8.0),  # at the very end of its reach
        ([(8.9, 0.0), (8.9, 2.0)], 7.9),
    ],
)
def test_a_beam_that_all_but_misses_a_wall(wall, distance, tolerance):
    got = ray_cast(jnp.array([1.0, 1.0, 0.0]), jnp.array([0.0]), jnp.array([wall]), 8.0)
    np.testing.assert_allclose(got, [distance], rtol=0, atol=tolerance(1e-9, 2e-2))


# --- Rooms drawn at random ---


def test_a_random_room_s_box_has_sides_of_1_to_4_m_half_a_metre_or_more_from_the_walls():
    """Each of its four numbers is drawn for itself, evenly between its bounds."""
    count, plain = 2000, room()
    rooms = jax.jit(jax.vmap(world.random_room))(jax.random.split(jax.random.key(0), count))
    np.testing.assert_array_equal(rooms.landmarks, np.broadcast_to(plain.landmarks, (count, 4, 2)))
    np.testing.assert_array_equal(rooms.segments[:, :4], np.broadcast_to(plain.segments[:4], (count, 4, 2, 2)))
    box = np.asarray(rooms.segments[:, 4:], np.float64)
    np.testing.assert_array_equal(box[:, :, 1], np.roll(box[:, :, 0], -1, axis=1))  # its walls close
    low, high = box[:, :, 0].min(1), box[:, :, 0].max(1)
    corners = np.stack([low, np.stack([high[:, 0], low[:, 1]], 1), high, np.stack([low[:, 0], high[:, 1]], 1)], 1)
    np.testing.assert_array_equal(box[:, :, 0], corners)
    share = np.column_stack([(high - low - 1) / 3, (low - 0.5) / (11 - (high - low))])
    assert -1e-5 < share.min() < 0.01
    assert 0.99 < share.max() < 1 + 1e-5
    for values in share.T:
        assert scipy.stats.kstest(values, "uniform").pvalue > 1e-6
    # Of 2000 rooms a correlation has a standard error of 0.022.
    assert np.abs(np.corrcoef(share.T) - np.eye(4)).max() < 5 * 0.0224


def test_the_tour_leads_through_the_doors_of_a_random_building():
    """No wall and no furniture comes within 0.3 m of it in any of 100; posts and furniture are drawn one by one."""
    many, plain = 100, np.asarray(world.building().segments)
    walls = np.asarray(jax.jit(jax.vmap(world.random_building))(jax.random.split(jax.random.key(0), many)).segments)
    assert walls.shape == (many, *plain.shape)
    a, along = walls[:, :, 0], walls[:, :, 1] - walls[:, :, 0]
    for start, end in itertools.pairwise(scenario._TOUR):
        for point in np.linspace(start, end, 60):
            share = np.clip(np.sum((point - a) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
            assert np.linalg.norm(point - (a + share[..., None] * along), axis=-1).min() > 0.3
    # What stays: the outer walls, the lines that inner walls stand on, the size of furniture.
    np.testing.assert_array_equal(walls[:, :4], np.broadcast_to(plain[:4], (many, 4, 2, 2)))
    np.testing.assert_array_equal(walls[:, 4:12, :, 1], np.broadcast_to(plain[4:12, :, 1], (many, 8, 2)))
    np.testing.assert_array_equal(walls[:, 12:20, :, 0], np.broadcast_to(plain[12:20, :, 0], (many, 8, 2)))
    np.testing.assert_allclose(along[:, 20:], np.broadcast_to(plain[20:, 1] - plain[20:, 0], (many, 32, 2)), atol=1e-5)
    # What is drawn: the posts of ten doors, of which those of the two that the tour does not pass move together.
    to_corridor = walls[:, 4:12].reshape(many, 2, 4, 2, 2)[..., 0]
    between_rooms = walls[:, 12:20].reshape(many, 4, 2, 2, 2)[..., 1]
    posts = [
        to_corridor[:, :, [0, 2], 1],
        to_corridor[:, :, [1, 3], 0],
        between_rooms[:, :, 0, 1],
        between_rooms[:, :, 1, 0],
    ]
    used = np.concatenate([x.reshape(many, -1) for x in posts], axis=1)
    corners = walls[:, 20::4, 0].reshape(many, -1)
    assert np.ptp(used, axis=0).min() > 0.6
    assert np.ptp(to_corridor[:, :, 1, 1], axis=0).min() > 4
    assert np.ptp(corners, axis=0).min() > 1
    together = np.corrcoef(np.concatenate([used, corners], axis=1).T)
    assert np.abs(together - np.eye(len(together))).max() < 5 / np.sqrt(many)


# --- The true map ---


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("pose", (5, 3)),
        ("pose", (2,)),
        ("beam_angles", (5, 4)),
        ("beam_angles", ()),
        ("segments", (5, 8, 2, 2)),
        ("segments", (2, 2)),
        ("segments", (8, 2, 3)),
        ("max_range", (4,)),
    ],
)
def test_a_batch_is_refused_by_name(name, wrong):
    arrays = {"pose": (3,), "beam_angles": (4,), "segments": (8, 2, 2), "max_range": ()} | {name: wrong}
    with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got {re.escape(str(wrong))}$"):
        world.ray_cast(**{key: jnp.ones(shape) for key, shape in arrays.items()})


@pytest.mark.parametrize("wrong", [(5, 8, 2, 2), (2, 2), (8, 2, 3)])
def test_walls_of_many_worlds_have_no_map(wrong):
    with pytest.raises(ValueError, match=rf"^world\.segments: expected shape .*, got {re.escape(str(wrong))}$"):
        world.occupancy(World(jnp.ones(wrong), jnp.zeros((0, 2))), GridSpec((0.0, 0.0), 1.0, (4, 5)))


def drawn(cells):
    """The map as a picture of lines, highest y first."""
    return ["".join(".#"[int(cell)] for cell in row) for row in np.asarray(cells)[::-1]]


def occupied_by(*walls, origin=(0.0, 0.0), shape=(4, 5), resolution=1.0):
    here = World(jnp.array(walls, float), jnp.zeros((0, 2)))
    return drawn(occupancy(here, GridSpec(origin, resolution, shape)))


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
        here = World(jnp.array([[(column * resolution, 0.31), (column * resolution, 0.33)]]), jnp.zeros((0, 2)))
        cells = np.asarray(occupancy(here, GridSpec((0.0, 0.0), resolution, (count, count))))
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
    here = World(jnp.zeros((0, 2, 2)), jnp.zeros((0, 2)))
    assert not np.any(occupancy(here, GridSpec((0.0, 0.0), 1.0, (4, 5))))
