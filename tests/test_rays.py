"""The cells of beams against the reference's Bresenham: all directions, both ways to divide, up to the map's edge."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import GridSpec
from jaxlocmap.mapping import rays
from jaxlocmap.types import Scanner

# So long a reach that integers are divided, and one that float32 does for; where it cuts no beam both give the same.
REACHES = {"float32": 70.0, "integers": 2000.0}
both_forms = pytest.mark.parametrize("max_range", REACHES.values(), ids=REACHES)


def scanner(angles, max_range, min_range=0.0):
    return Scanner(angles, min_range=min_range, max_range=max_range)


@functools.partial(jax.jit, static_argnames=("spec", "min_range", "max_range"))
def cells(pose, ranges, angles, *, spec, min_range=0.0, max_range):
    return rays.beam_cells(pose, ranges, scanner(angles, max_range, min_range), spec=spec)


def cells_to(ends, *, resolution, shape, start, max_range):
    """Cells (row, column) of the beams from the middle of cell `start` to that of each of `ends`, as (B, K) arrays."""
    span = np.asarray(ends) - start
    found = cells(
        jnp.array([*((np.asarray(start) + 0.5) * resolution), 0.0]),
        jnp.array(np.hypot(*span.T) * resolution),
        jnp.array(np.arctan2(span[:, 1], span[:, 0])),
        spec=GridSpec(origin=(0.0, 0.0), resolution=resolution, shape=shape),
        max_range=max_range,
    )
    return jax.tree.map(np.asarray, found)


def visited(found, beam, which):
    """Cells (column, row) of a beam that are free, or hit, nearest first."""
    chosen = getattr(found, which)[beam]
    return list(zip(found.column[beam][chosen].tolist(), found.row[beam][chosen].tolist(), strict=True))


def assert_bresenham(found, start, ends):
    """Every beam ends on the map."""
    for beam, end in enumerate(ends):
        *crossed, last = reference.bresenham(*start, *end)
        assert visited(found, beam, "free") == crossed
        assert visited(found, beam, "hit") == [last]


@pytest.mark.parametrize(("max_range", "every"), [(REACHES["float32"], 1), (REACHES["integers"], 4)], ids=REACHES)
def test_every_beam_of_up_to_45_cells_is_bresenhams(max_range, every):
    ends = [(x, y) for x in range(91) for y in range(91) if (x, y) != (45, 45)][::every]
    found = cells_to(ends, resolution=1.0, shape=(91, 91), start=(45, 45), max_range=max_range)
    assert_bresenham(found, (45, 45), ends)


@both_forms
@pytest.mark.parametrize("start", [(0, 0), (6, 4), (3, 1), (6, 0)])
def test_a_beam_that_leaves_the_map_crosses_the_cells_before_the_first_outside(start, max_range):
    """All beams of up to 18 cells on a map of 7 x 5, in all directions; those that end outside hit nothing."""
    columns, rows = 7, 5
    ends = [(x, y) for x in range(-12, 19) for y in range(-13, 18) if (x, y) != start]
    found = cells_to(ends, resolution=1.0, shape=(rows, columns), start=start, max_range=max_range)
    for beam, end in enumerate(ends):
        line = reference.bresenham(*start, *end)
        inside = [0 <= x < columns and 0 <= y < rows for x, y in line]
        first_outside = inside.index(False) if False in inside else len(line)
        assert visited(found, beam, "free") == line[: min(first_outside, len(line) - 1)]
        assert visited(found, beam, "hit") == (line[-1:] if first_outside == len(line) else [])


def test_a_map_of_one_cell_is_crossed_by_what_leaves_it():
    found = cells_to([(3, 1), (-2, -9)], resolution=1.0, shape=(1, 1), start=(0, 0), max_range=70.0)
    np.testing.assert_array_equal(found.free, [[True], [True]])
    np.testing.assert_array_equal([found.row, found.column], np.zeros((2, 2, 1)))
    assert not np.any(found.hit)


# --- Long beams ---


def long_ends(count, reach):
    """Ends of beams of about `reach` cells in all directions of a quadrant."""
    angle = np.linspace(0, np.pi / 2, count)
    return np.floor(reach * np.column_stack([np.cos(angle), np.sin(angle)])).astype(int)


@pytest.mark.usefixtures("x64")  # a cell's middle at 2000 cells is 1e-4 of its distance from the edge in float32
@pytest.mark.parametrize("reach", [1020, 1990], ids=REACHES)
def test_beams_of_a_thousand_cells_are_bresenhams(reach):
    ends = long_ends(60, reach)
    found = cells_to(ends, resolution=0.01, shape=(2000, 2000), start=(0, 0), max_range=reach * 0.01 + 0.02)
    assert_bresenham(found, (0, 0), ends)


@pytest.mark.parametrize("n", [1, 30, 997, 1023, 1024])
def test_float32_places_every_cell_where_integers_do(n):
    """Of all beams of n cells, to either side, up to the longest for which it is used."""
    m = jnp.arange(-n, n + 1, dtype=jnp.int32)
    many, j = jnp.full_like(m, n), jnp.arange(n + 1, dtype=jnp.int32)[None]

    @functools.partial(jax.jit, static_argnums=0)
    def along(exact):
        """Of beams that span m cells along one axis, n along the other."""
        return rays._steps(jnp.stack([m, m]), many, exact).along(0, j)

    fast, slow = along(True), along(False)
    np.testing.assert_array_equal(fast, slow)
    x, y = abs(np.asarray(m, np.int64))[:, None], np.asarray(j, np.int64)
    np.testing.assert_array_equal(slow, np.sign(m)[:, None] * -((n - 2 * y * x) // (2 * n)))  # ceil(j m / n - 1/2)


@pytest.mark.parametrize("n", [1, 30, 997, 1023, 1024])
def test_float32_counts_the_cells_inside_as_integers_do(n):
    """Of all beams of n cells from all places; also where a compiler divides by taking a reciprocal."""
    m, start = jnp.arange(-n, n + 1, dtype=jnp.int32)[None], jnp.arange(n + 2, dtype=jnp.int32)[:, None]
    inside = jax.jit(lambda exact: rays._cells_inside(m, jnp.int32(n), start, n + 2, exact), static_argnums=0)
    fast, slow = inside(True), inside(False)
    np.testing.assert_array_equal(np.minimum(fast, n + 1), slow)
    # Cell j is the first outside where it is, and j - 1 is not.
    first = np.asarray(slow, np.int64)
    away = np.where(m > 0, n + 2 - start, start + 1)
    at = lambda j: -((n - 2 * j * np.abs(m)) // (2 * n))  # noqa: E731
    outside = first <= n
    assert np.all((at(first) >= away)[outside])
    assert np.all((at(first - 1) < away)[outside])
    assert np.all((at(np.int64(n)) < away)[~outside])


@pytest.mark.usefixtures("x64")
def test_a_beam_far_longer_than_the_map_is_bresenhams_as_far_as_the_map_goes():
    """1000 cells of a beam of thousands: a float32 product would misplace some."""
    span, side = 3948, 1000
    ends = np.array([(span, m) for m in range(0, span + 1, 3)])
    found = cells_to(ends, resolution=0.1, shape=(side, side), start=(0, 0), max_range=600.0)
    j = np.arange(side)
    expected = (2 * j * ends[:, 1:] + span - 1) // (2 * span)
    np.testing.assert_array_equal(found.free, expected < side)
    np.testing.assert_array_equal(found.row, expected)
    assert not np.any(found.hit)


def test_products_that_do_not_fit_are_divided_as_pythons_integers_are():
    rng = np.random.default_rng(3)
    a, c = rng.integers(0, 2**20, 3000, endpoint=True), rng.integers(1, 2**21, 3000, endpoint=True)
    b = rng.integers(0, c, endpoint=True)
    edges = [(2**20, 2**21, 2**21), (2**20 - 1, 2**21 - 1, 2**21), (2**20, 2**20, 2**20), (0, 0, 1), (1023, 1, 1)]
    a, b, c = (np.append(x, y) for x, y in zip((a, b, c), zip(*edges, strict=True), strict=True))
    got = jax.jit(rays._times_over)(*(jnp.asarray(x, jnp.int32) for x in (a, b, c)))
    np.testing.assert_array_equal(got, np.divmod(a * b, c))  # in 64 bits


@functools.partial(jax.jit, static_argnames=("spec", "max_range"))
def some_cells(pose, ranges, angles, j, *, spec, max_range):
    lines = rays.trace(pose, ranges, scanner(angles, max_range), spec=spec)
    return lines.free, lines.last, rays.cells_at(lines, j)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("n", [9_000, 32_767, 32_768, 46_341, 1_000_003, 2**20 - 50])
def test_a_very_long_beam_is_bresenhams(n):
    """To every cell of the last column and beyond the map's sides, against integers of 64 bits."""
    rows, start = 4_001, (1, 1_000)
    up = np.array([0, 1, -1, 7, -1000, 1499, -1499, 2997, 3000, -3001, 9_000, -9_000])
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.5, shape=(rows, n + 2))
    pose = jnp.array([*((np.array(start) + 0.5) * 0.5), 0.0])
    ranges, angles = jnp.array(np.hypot(n, up) * 0.5), jnp.array(np.arctan2(up, n))
    j = np.array([0, 1, n // 3, n // 2, n - 1, n])
    free, last, (column, row) = some_cells(
        pose, ranges, angles, jnp.asarray(j[None], jnp.int32), spec=spec, max_range=0.5 * (2**20 - 1)
    )
    away = np.sign(up)[:, None] * ((2 * j * abs(up)[:, None] + n - 1) // (2 * n))
    np.testing.assert_array_equal(column, np.broadcast_to(start[0] + j, away.shape))
    np.testing.assert_array_equal(row, start[1] + away)
    every = start[1] + np.sign(up)[:, None] * ((2 * np.arange(n + 1) * abs(up)[:, None] + n - 1) // (2 * n))
    on_map = (every >= 0) & (every < rows)
    first_outside = np.where(on_map.all(1), n + 1, np.argmin(on_map, axis=1))
    np.testing.assert_array_equal(free, np.minimum(first_outside, n))
    np.testing.assert_array_equal(last, np.where(first_outside > n, n, -1))


@pytest.mark.parametrize(
    ("reach", "shape", "exact"),
    [
        (1023, (9, 9), True),  # a beam of 1023 cells, and one spare for rounding
        (1023.5, (9, 9), False),
        (9000, (9, 9), False),
        (50, (4096, 4096), True),
        (50, (4096, 4097), False),  # 2**24 cells and more
    ],
)
def test_float32_is_for_beams_of_1024_cells_on_maps_of_2_to_the_24(reach, shape, exact):
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.5, shape=shape)
    trace = functools.partial(rays.trace, spec=spec)
    lines = jax.eval_shape(trace, jnp.zeros(3), jnp.zeros(2), scanner(jnp.zeros(2), reach * 0.5))
    assert isinstance(lines.steps, rays.Slopes if exact else rays.Spans)
    assert {x.dtype for x in lines.steps} == {jnp.dtype(jnp.float32 if exact else jnp.int32)}


@pytest.mark.usefixtures("x64")
def test_every_cell_of_a_beam_of_9000_cells_is_bresenhams():
    """On a map as long, by as short a reach as will do: in float32 some would lie a cell beside."""
    n, up = 9_000, np.array([1, 7, 1499, 2997, 3000, 4497, 4499, 4500])
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.5, shape=(4_600, n + 2))
    ranges, angles = jnp.array(np.hypot(n, up) * 0.5), jnp.array(np.arctan2(up, n))
    j = np.arange(n + 1)
    pose = jnp.array([0.25, 0.25, 0.0])
    free, last, (column, row) = some_cells(
        pose, ranges, angles, jnp.asarray(j[None], jnp.int32), spec=spec, max_range=0.5 * 10_100
    )
    np.testing.assert_array_equal(column, np.broadcast_to(j, (len(up), n + 1)))
    np.testing.assert_array_equal(row, (2 * j * up[:, None] + n - 1) // (2 * n))
    np.testing.assert_array_equal([free, last], np.full((2, len(up)), n))


def test_beams_of_more_cells_than_can_be_counted_are_refused():
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.05, shape=(10, 10))
    with pytest.raises(ValueError, match=r"^max_range: expected beams of up to 1,048,576 cells, got 60000\.0 m"):
        rays.trace(jnp.zeros(3), jnp.ones(2), scanner(jnp.zeros(2), 6e4), spec=spec)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("max_range", [0.5, 1.0, 1.23])
def test_the_longest_beam_has_one_cell_to_spare(max_range):
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.1, shape=(100, 100))
    starts = 5 + 0.1 * np.linspace(0.01, 0.99, 50)
    most = 1 + np.max(np.floor((starts + max_range) / 0.1) - np.floor(starts / 0.1))
    assert rays.longest(spec, max_range) == most + 1
    assert rays.longest(spec, 20.0) == 100  # the map's side


def test_flat_cells_are_rows_and_columns_also_of_a_map_too_large_for_float32():
    """Of more than 2**24 cells, the last of which float32 cannot count."""
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.1, shape=(6, 3_400_001))

    @jax.jit
    def both(pose, ranges, angles):
        lines = rays.trace(pose, ranges, scanner(angles, 5.0), spec=spec)
        j = jnp.arange(6, dtype=jnp.int32)[None]
        return rays.cells_at(lines, j), rays.flat_cells(lines, j, spec)

    (column, row), flat = both(jnp.array([340_000.02, 0.05, np.pi / 2]), jnp.full(3, 0.55), jnp.array([0.0, 0.3, -0.3]))
    assert row.max() == 5
    np.testing.assert_array_equal(flat, row * spec.shape[1] + column)


# --- Cells of points ---

SPEC = GridSpec(origin=(-1.0, 0.5), resolution=0.25, shape=(16, 24))  # x from -1 to 5 m, y from 0.5 to 4.5 m


def test_cell_of_a_point_is_a_floor_and_may_lie_outside():
    points = jnp.array([[-1.0, 0.5], [-1.01, 0.49], [4.99, 4.49], [5.0, 4.5]])
    np.testing.assert_array_equal(rays.cell_of(points, SPEC), [[0, 0], [-1, -1], [23, 15], [24, 16]])


@pytest.mark.usefixtures("x64")
def test_a_point_millions_of_cells_away_is_in_its_own():
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.1, shape=(2, 5_000_000))
    point = jnp.array([[123_456.78, 0.05], [-400_000.01, 3e6]])
    np.testing.assert_array_equal(rays.cell_of(point, spec), [[1_234_567, 0], [-4_000_001, 30_000_000]])
    assert rays.on_map(jnp.array([499_999.95, 0.05, 0.0]), spec)
    assert not rays.on_map(jnp.array([500_000.05, 0.05, 0.0]), spec)


@pytest.mark.parametrize("far", [1e9, 1e20, np.inf, np.nan])
def test_a_point_beyond_all_integers_is_far_outside(far):
    below, above = np.asarray(rays.cell_of(jnp.array([[-far, -far], [far, far]]), SPEC))
    assert np.all(below <= -(2**29))
    assert np.all(abs(above) >= 2**29)


@pytest.mark.parametrize(
    ("pose", "there"),
    [
        ((-1.0, 0.5, 0.0), True),
        ((4.99, 4.49, -3.0), True),
        ((5.0, 2.0, 0.0), False),
        ((2.0, 4.5, 0.0), False),
        ((-1.01, 2.0, 0.0), False),
        ((2.0, 0.49, 0.0), False),
        ((2.0, 2.0, np.nan), False),
        ((2.0, np.inf, 0.0), False),
    ],
)
def test_a_pose_on_the_map_is_one_on_a_cell_with_a_heading(pose, there):
    assert bool(rays.on_map(jnp.array(pose), SPEC)) is there


def test_the_heading_turns_the_beams():
    """A beam at 0.3 rad in the body of a robot that heads 1.9 rad is one at 2.2 rad."""
    place, ranges, angles = (2.1, 2.3), jnp.array([1.0, 1.7]), jnp.array([0.3, -0.4])
    limits = {"spec": SPEC, "max_range": 4.0}
    turned = cells(jnp.array([*place, 1.9]), ranges, angles, **limits)
    straight = cells(jnp.array([*place, 0.0]), ranges, angles + 1.9, **limits)
    jax.tree.map(np.testing.assert_array_equal, turned, straight)


def test_a_scanner_off_the_centre_has_the_beams_of_one_where_it_sits():
    pose, offset = np.array([2.1, 2.3, 0.8]), (0.4, -0.3, 1.9)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    there = pose + np.array([0.4 * c + 0.3 * s, 0.4 * s - 0.3 * c, 1.9])
    ranges, angles = jnp.array([1.0, 1.7, 0.6]), jnp.array([0.3, -0.4, 2.0])
    mounted = Scanner(angles, offset, min_range=0.0, max_range=4.0)
    got = jax.jit(rays.beam_cells, static_argnames="spec")(jnp.array(pose), ranges, mounted, spec=SPEC)
    jax.tree.map(np.testing.assert_array_equal, got, cells(jnp.array(there), ranges, angles, spec=SPEC, max_range=4.0))


def test_shapes_that_do_not_fit_are_refused():
    beams = scanner(jnp.zeros(3), 4.0)
    with pytest.raises(ValueError, match=r"^pose: expected shape \(3\), got \(2,\)"):
        rays.beam_cells(jnp.zeros(2), jnp.ones(3), beams, spec=SPEC)
    with pytest.raises(ValueError, match=r"^beam_angles: expected shape \(any\), got \(3, 1\)"):
        rays.beam_cells(jnp.zeros(3), jnp.ones(3), scanner(jnp.zeros((3, 1)), 4.0), spec=SPEC)
    with pytest.raises(ValueError, match=r"^ranges: expected shape \(3\), got \(2,\)"):
        rays.trace(jnp.zeros(3), jnp.ones(2), beams, spec=SPEC)
