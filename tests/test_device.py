"""Whole numbers and a map on whatever device JAX computes on, against plain NumPy.

A compiler for a GPU has been seen to get the larger of two integers' magnitudes wrong, without a word: so every
formula of integers is computed here from thousands of random numbers.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import GridSpec
from jaxlocmap._internal import random
from jaxlocmap.mapping import grid, quality, rays
from jaxlocmap.types import Scanner

SIDE = 401
SPEC = GridSpec(origin=(0.0, 0.0), resolution=1.0, shape=(SIDE, SIDE - 1))
# So long a reach that integers are divided, and one for which float32 does.
both_forms = pytest.mark.parametrize("max_range", [1000.0, 5000.0], ids=["float32", "integers"])


@functools.partial(jax.jit, static_argnames="max_range")
def placed(pose, ranges, angles, *, max_range):
    lines = rays.trace(pose, ranges, Scanner(angles, min_range=0.0, max_range=max_range), spec=SPEC)
    j = jnp.arange(SIDE, dtype=jnp.int32)[None]
    ends = lines.last[:, None]
    return lines, rays.cells_at(lines, j), rays.flat_cells(lines, j, SPEC), rays.flat_cells(lines, ends, SPEC)


@both_forms
@pytest.mark.parametrize("start", [(200, 190), (3, 396)])
def test_the_cells_of_random_beams_are_numpys(start, max_range):
    """Spans, cells inside the map, cells, and their flat indices; half of the beams leave the map."""
    rng = np.random.default_rng(start[0])
    span = rng.integers(-300, 300, (4096, 2), endpoint=True)
    span[:9] = [[x, y] for x in (-5, 0, 5) for y in (-5, 0, 5)]
    span = span[np.any(span != 0, axis=1)]
    pose = jnp.array([start[0] + 0.5, start[1] + 0.5, 0.0])
    ranges, angles = np.hypot(*span.T), np.arctan2(span[:, 1], span[:, 0])
    lines, cells, flat, flat_ends = jax.tree.map(
        np.asarray, placed(pose, jnp.asarray(ranges), jnp.asarray(angles), max_range=max_range)
    )
    n, j = np.abs(span).max(axis=1), np.arange(SIDE)
    away = np.sign(span)[..., None] * (
        (2 * j * np.abs(span)[..., None] + n[:, None, None] - 1) // (2 * n)[:, None, None]
    )
    column, row = (start[axis] + away[:, axis] for axis in (0, 1))
    of_beam = j <= n[:, None]
    for got, expected in zip(cells, (column, row), strict=True):
        np.testing.assert_array_equal(got[of_beam], expected[of_beam])
    np.testing.assert_array_equal(flat[of_beam], (row * SPEC.shape[1] + column)[of_beam])
    on_map = (row >= 0) & (row < SPEC.shape[0]) & (column >= 0) & (column < SPEC.shape[1])
    first_outside = np.where(on_map.all(axis=1), SIDE, np.argmin(on_map, axis=1))
    ends_inside = n < first_outside
    assert 0.05 < ends_inside.mean() < 0.98
    np.testing.assert_array_equal(lines.free, np.minimum(n, first_outside))
    np.testing.assert_array_equal(lines.last, np.where(ends_inside, n, -1))
    end = (start[1] + span[:, 1]) * SPEC.shape[1] + start[0] + span[:, 0]
    np.testing.assert_array_equal(flat_ends[ends_inside, 0], end[ends_inside])


def test_long_quotients_are_those_of_64_bits():
    rng = np.random.default_rng(1)
    a, c = rng.integers(0, 2**20, 4096, endpoint=True), rng.integers(1, 2**21, 4096, endpoint=True)
    b = rng.integers(0, c, endpoint=True)
    got = jax.jit(rays._times_over)(*(jnp.asarray(x, jnp.int32) for x in (a, b, c)))
    np.testing.assert_array_equal(got, np.divmod(a * b, c))


def test_points_far_outside_stay_there():
    """The clamp of a cell's index."""
    x = np.array([-np.inf, -1e30, -1e6, -0.5, 0.5, 1e6, 1e30, np.inf, np.nan])
    got = jax.jit(lambda point: rays.cell_of(point, SPEC))(jnp.asarray(np.stack([x, x], axis=-1)))
    expected = [-(2**29), -(2**29), -(10**6), -1, 0, 10**6, 2**29, 2**29, -(2**29)]
    np.testing.assert_array_equal(got, np.stack([expected, expected], axis=-1))


def test_the_words_of_the_generator_are_numpys():
    key, counter = np.random.default_rng(2).integers(2**32, size=(2, 2, 4096), dtype=np.uint32)
    keys = [*key, key[0] ^ key[1] ^ np.uint32(0x1BD11BDA)]
    a, b = counter[0] + keys[0], counter[1] + keys[1]
    for group in range(5):
        for distance in ((13, 15, 26, 6), (17, 29, 16, 24))[group % 2]:
            a = a + b
            b = a ^ ((b << np.uint32(distance)) | (b >> np.uint32(32 - distance)))
        a, b = a + keys[(group + 1) % 3], b + keys[(group + 2) % 3] + np.uint32(group + 1)
    np.testing.assert_array_equal(jax.jit(random.threefry)(tuple(key), tuple(counter)), [a, b])


def test_cells_are_counted_by_probability_as_numpy_does():
    """The clamp of a bin's index: certain cells belong to the last."""
    log_odds = np.random.default_rng(3).normal(0, 3, (64, 64)).astype(np.float32)
    log_odds[0, :2] = -100, 100
    score = jax.jit(quality.score)(jnp.asarray(log_odds), jnp.zeros((64, 64), bool), jnp.ones((64, 64), bool))
    probability = 1 / (1 + np.exp(-log_odds.astype(np.float64)))
    assert np.min(abs(probability * 10 - np.round(probability * 10))[1:]) > 1e-6  # none between two bins
    np.testing.assert_array_equal(score.cells, np.histogram(probability, bins=10, range=(0, 1))[0])


def test_a_map_of_twenty_scans_is_numpys(course, tolerance):
    scan = reference.COURSE_SCAN
    rng = np.random.default_rng(4)
    poses = np.column_stack([rng.uniform(2, 8, 20), rng.uniform(2, 8, 20), rng.uniform(-3, 3, 20)])
    ranges = rng.uniform(0.2, 9, (20, len(reference.COURSE_ANGLES)))
    scanner = Scanner(course.beam_angles, min_range=scan["min_range"], max_range=scan["max_range"])

    @jax.jit
    def mapped(poses, ranges):
        def add(log_odds, now):
            l_occ, l_free = course.params.l_occ, course.params.l_free
            return grid.update_log_odds(log_odds, *now, l_occ, l_free, scanner=scanner, spec=course.grid), None

        return jax.lax.scan(add, jnp.zeros(course.grid.shape), (poses, ranges))[0]

    expected = np.zeros(course.grid.shape)
    for pose, some in zip(poses, ranges, strict=True):
        expected = reference.update_scan(expected, pose, some, reference.COURSE_ANGLES, **scan)
    got = np.asarray(mapped(jnp.asarray(poses), jnp.asarray(ranges)))
    different = np.sum(np.abs(got - expected) > tolerance(1e-12, 1e-4))
    # A beam's end is off by 1e-6 m in float32, of 20 · 61 beams: none or one is put into the cell beside, of 41.
    assert different <= tolerance(0, 41)
    assert np.sum(expected != 0) > 2000
