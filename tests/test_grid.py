"""The occupancy grid against the reference's loops, what no scan may do to it, and the scores of a map."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import example, given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxlocmap import GridSpec, grid

L_OCC, L_FREE = 0.85, -0.40
SPEC = GridSpec(origin=(-1.0, 0.5), resolution=0.25, shape=(16, 24))  # x from -1 to 5 m, y from 0.5 to 4.5 m
MIN_RANGE, MAX_RANGE = 0.05, 4.0
ANGLES = np.linspace(-1.2, 1.2, 9)
POSE = np.array([0.63, 2.41, 0.3])


@functools.partial(jax.jit, static_argnames="spec")
def scanned(log_odds, pose, ranges, angles, l_occ=L_OCC, l_free=L_FREE, *, spec=SPEC):
    return grid.update_log_odds(
        log_odds, pose, ranges, angles, l_occ, l_free, spec=spec, min_range=MIN_RANGE, max_range=MAX_RANGE
    )


def scan(ranges, *, pose=POSE, angles=ANGLES, before=None):
    """The map after one scan, by default of an empty map."""
    before = jnp.zeros(SPEC.shape) if before is None else jnp.asarray(before)
    return np.asarray(scanned(before, jnp.asarray(pose), jnp.asarray(ranges), jnp.asarray(angles)))


def reference_scan(ranges, *, pose=POSE, angles=ANGLES, before=None):
    return reference.update_scan(
        np.zeros(SPEC.shape) if before is None else before,
        pose,
        ranges,
        angles,
        origin=SPEC.origin,
        resolution=SPEC.resolution,
        l_occ=L_OCC,
        l_free=L_FREE,
        l_min=SPEC.l_min,
        l_max=SPEC.l_max,
        min_range=MIN_RANGE,
        max_range=MAX_RANGE,
    )


@pytest.fixture
def same(tolerance):
    """Maps that differ by no more than the order of a few sums."""
    return functools.partial(np.testing.assert_allclose, rtol=0, atol=tolerance(1e-12, 1e-5))


# --- cells of a beam


def cells_to(ends, *, resolution, shape, start, max_range):
    """Cells (row, column) of the beams from the middle of cell `start` to that of each of `ends`, as (B, K) arrays."""
    span = np.asarray(ends) - start
    beams = grid.beam_cells(
        jnp.array([*((np.asarray(start) + 0.5) * resolution), 0.0]),
        jnp.array(np.hypot(*span.T) * resolution),
        jnp.array(np.arctan2(span[:, 1], span[:, 0])),
        spec=GridSpec(origin=(0.0, 0.0), resolution=resolution, shape=shape),
        min_range=0.0,
        max_range=max_range,
    )
    return jax.tree.map(np.asarray, beams)


def assert_bresenham(beams, start, ends):
    assert np.all(beams.hit.sum(1) == 1)
    for column, row, free, hit, end in zip(beams.column, beams.row, beams.free, beams.hit, ends, strict=True):
        along = free | hit
        got = list(zip(column[along].tolist(), row[along].tolist(), strict=True))
        assert got == reference.bresenham(*start, *end)
        assert hit[along][-1]


def test_every_beam_of_up_to_45_cells_is_bresenhams():
    ends = [(x, y) for x in range(91) for y in range(91) if (x, y) != (45, 45)]
    beams = cells_to(ends, resolution=1.0, shape=(91, 91), start=(45, 45), max_range=70.0)
    assert_bresenham(beams, (45, 45), ends)


def long_ends(count, reach):
    """Ends of beams of about `reach` cells in all directions of a quadrant."""
    angle = np.linspace(0, np.pi / 2, count)
    return np.floor(reach * np.column_stack([np.cos(angle), np.sin(angle)])).astype(int)


@pytest.mark.usefixtures("x64")  # a cell's middle at 2000 cells is 1e-4 of its distance from the edge in float32
def test_beams_of_more_than_a_thousand_cells_are_bresenhams():
    ends = long_ends(60, 1990)
    beams = cells_to(ends, resolution=0.01, shape=(2000, 2000), start=(0, 0), max_range=20.0)
    assert beams.row.shape[1] > 1024  # these take the integer division
    assert_bresenham(beams, (0, 0), ends)


def test_integer_and_float_division_place_the_same_cells():
    """All m of a beam of n cells, up to the longest for which the float product is used."""
    for cells in (1024, 997, 30, 1):
        n, m = jnp.full((cells + 1, 1), cells, jnp.int32), jnp.arange(cells + 1, dtype=jnp.int32)[:, None]
        j = jnp.arange(cells, dtype=jnp.int32)[None]
        fast, slow = (grid._cells_along(j, m, n, float_exact=exact) for exact in (True, False))
        np.testing.assert_array_equal(fast, slow)


@pytest.mark.usefixtures("x64")
def test_a_beam_far_longer_than_the_map_is_bresenhams_as_far_as_the_map_goes():
    """1000 cells of a beam of thousands: a float32 product would misplace some."""
    span, side = 3948, 1000
    ends = np.array([(span, m) for m in range(0, span + 1, 3)])
    beams = cells_to(ends, resolution=0.1, shape=(side, side), start=(0, 0), max_range=600.0)
    j = np.arange(side)
    expected = (2 * j * ends[:, 1:] + span - 1) // (2 * span)
    np.testing.assert_array_equal(beams.row, expected)
    np.testing.assert_array_equal(beams.free, expected < side)
    assert not np.any(beams.hit)


def test_cell_of_a_point_is_a_floor_and_may_lie_outside():
    points = jnp.array([[-1.0, 0.5], [-1.01, 0.49], [4.99, 4.49], [5.0, 4.5]])
    np.testing.assert_array_equal(grid.cell_of(points, SPEC), [[0, 0], [-1, -1], [23, 15], [24, 16]])


# --- one scan


@pytest.mark.parametrize("seed", range(4))
def test_a_scan_is_the_reference(seed, same):
    """Ranges short, long, out of range and none; some beams leave the map. Twice, so that cells add up."""
    rng = np.random.default_rng(seed)
    pose = np.array([rng.uniform(-0.9, 4.9), rng.uniform(0.6, 4.4), rng.uniform(-np.pi, np.pi)])
    first, second = rng.uniform(0.0, 6.0, (2, len(ANGLES)))
    first[:4] = np.nan, np.inf, -np.inf, MIN_RANGE
    expected = reference_scan(second, pose=pose, before=reference_scan(first, pose=pose))
    same(scan(second, pose=pose, before=scan(first, pose=pose)), expected)
    assert np.ptp(expected) > 0


def test_course_problem_3_log_odds_add_up(same):
    """Two beams through a cell and one that ends in it: L = 2 l_free + l_occ, p = 1 / (1 + exp(-L))."""
    pose, angles = np.array([0.1, 2.1, 0.0]), np.zeros(1)
    row, column = 6, 8  # of the cell around (1.1, 2.1)
    map_ = scan([2.0], pose=pose, angles=angles)
    map_ = scan([2.0], pose=pose, angles=angles, before=map_)
    map_ = scan([1.0], pose=pose, angles=angles, before=map_)
    same(map_[row, column], 2 * L_FREE + L_OCC)
    same(grid.probability(jnp.array(map_))[row, column], 1 / (1 + math.exp(-0.05)))
    same(map_[row, column + 4], 2 * L_OCC)
    same(map_[row, column - 1], 3 * L_FREE)


def test_beams_of_one_scan_that_share_a_cell_add_up(same):
    map_ = scan(np.full(5, 1.0), pose=[0.1, 2.1, 0.0], angles=np.zeros(5))
    same(map_[6, 8], min(5 * L_OCC, SPEC.l_max))
    same(map_[6, 5], 5 * L_FREE)


@pytest.mark.parametrize(
    "pose", [(-1.1, 2.0, 0.0), (5.1, 2.0, 3.0), (1.0, 0.4, 1.5), (1.0, 4.6, -1.5), (1e9, 2.0, 0.0)]
)
def test_a_robot_outside_the_map_changes_nothing(pose):
    np.testing.assert_array_equal(scan(np.full(9, 2.0), pose=pose), np.zeros(SPEC.shape))


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_pose_that_is_no_number_changes_nothing(place, bad):
    pose = POSE.copy()
    pose[place] = bad
    np.testing.assert_array_equal(scan(np.full(9, 2.0), pose=pose), np.zeros(SPEC.shape))


@pytest.mark.parametrize(
    ("heading", "cleared"),
    [
        (0.0, (6, slice(8, 24))),
        (math.pi, (6, slice(0, 9))),
        (math.pi / 2, (slice(6, 16), 8)),
        (-math.pi / 2, (slice(0, 7), 8)),
    ],
)
def test_a_beam_that_leaves_the_map_clears_up_to_the_edge_and_marks_none(heading, cleared, same):
    """Also shows that cell -1 is not the last one: nothing on the far side changes."""
    expected = np.zeros(SPEC.shape)
    expected[cleared] = L_FREE
    past_the_edge = 3.95  # m; in direction +x the edge is 3.9 m away
    same(scan([past_the_edge], pose=[1.1, 2.1, heading], angles=[0.0]), expected)


def test_an_end_just_left_of_the_map_does_not_wrap_to_its_right():
    """The end lies in column -1, row -1."""
    map_ = scan([0.2], pose=[-0.95, 0.55, -0.75 * math.pi], angles=[0.0])
    assert map_[0, 0] == np.asarray(L_FREE, map_.dtype)
    assert np.count_nonzero(map_) == 1


@pytest.mark.parametrize("none", [math.nan, math.inf, -math.inf, -1.0, 0.0, MIN_RANGE])
def test_a_range_that_is_no_measurement_changes_nothing(none):
    np.testing.assert_array_equal(scan(np.full(9, none)), np.zeros(SPEC.shape))


@pytest.mark.parametrize("beyond", [MAX_RANGE, 1.5 * MAX_RANGE, 1e30])
def test_a_range_out_of_reach_clears_up_to_the_reach_and_marks_none(beyond, same):
    map_ = scan([beyond], pose=[-0.9, 2.1, 0.0], angles=[0.0])
    expected = np.zeros(SPEC.shape)
    expected[6, :16] = L_FREE  # 4 m of 0.25 m cells, the last one excluded
    same(map_, expected)


def test_log_odds_are_clamped_both_ways(same):
    full = np.full(SPEC.shape, 3.9)
    map_ = scan([1.0], pose=[0.1, 2.1, 0.0], angles=[0.0], before=full)
    same(map_[6, 8], SPEC.l_max)
    map_ = scan([1.0], pose=[0.1, 2.1, 0.0], angles=[0.0], before=-full)
    same(map_[6, 6], SPEC.l_min)


any_range = st.one_of(st.floats(-1.0, 12.0), st.sampled_from([math.nan, math.inf, -math.inf]))
coordinate = st.floats(-8.0, 8.0)


@settings(max_examples=150)
@given(
    x=coordinate,
    y=coordinate,
    heading=st.floats(-7.0, 7.0),
    ranges=st.lists(any_range, min_size=9, max_size=9),
    seed=st.integers(0, 100),
)
@example(x=-0.99, y=0.51, heading=-2.3, ranges=[3.0] * 9, seed=0)
def test_no_scan_leaves_the_bounds_or_touches_a_cell_out_of_its_reach(x, y, heading, ranges, seed):
    before = np.random.default_rng(seed).uniform(SPEC.l_min, SPEC.l_max, SPEC.shape)
    before = np.array(jnp.clip(jnp.array(before), SPEC.l_min, SPEC.l_max))  # in the precision of the job
    after = scan(ranges, pose=[x, y, heading], before=before)
    assert after.min() >= SPEC.l_min
    assert after.max() <= SPEC.l_max
    rows, columns = np.indices(SPEC.shape)
    away = np.hypot(
        SPEC.origin[0] + (columns + 0.5) * SPEC.resolution - x, SPEC.origin[1] + (rows + 0.5) * SPEC.resolution - y
    )
    reach = min(MAX_RANGE, max([r for r in ranges if math.isfinite(r)], default=0.0))
    untouched = away > reach + 2 * SPEC.resolution  # half a cell's diagonal at either end, and Bresenham's half cell
    np.testing.assert_array_equal(after[untouched], before[untouched])


def test_robots_at_once_are_robots_one_by_one():
    """One of them stands outside the map, and changes neither its own nor the others' map."""
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(-0.9, 4.9, 4), rng.uniform(0.6, 4.4, 4), rng.uniform(-3, 3, 4)])
    poses[2, 0] = 9.0
    ranges = rng.uniform(0.0, 5.0, (4, 9))
    before = rng.uniform(-1, 1, (4, *SPEC.shape))
    batch = jax.vmap(scanned, in_axes=(0, 0, 0, None))(*(jnp.array(a) for a in (before, poses, ranges, ANGLES)))
    for got, pose, r, b in zip(batch, poses, ranges, before, strict=True):
        np.testing.assert_array_equal(got, scan(r, pose=pose, before=b))


# --- gradients


@pytest.mark.usefixtures("x64")
def test_gradient_by_the_sensor_model_is_exact():
    """Linear in l_occ and l_free where no cell is clamped, so finite differences are exact to rounding."""
    ranges = jnp.array(np.random.default_rng(0).uniform(0.5, 5.0, 9))
    weights = jnp.array(np.random.default_rng(1).normal(size=SPEC.shape))

    def score(l_occ, l_free):
        after = scanned(jnp.zeros(SPEC.shape), jnp.array(POSE), ranges, jnp.array(ANGLES), l_occ, l_free)
        return jnp.sum(weights * after)

    check_grads(score, (0.3, -0.1), order=1, modes=("fwd", "rev"), atol=1e-7, rtol=1e-7)


def test_gradient_by_pose_and_ranges_is_zero():
    def score(pose, ranges):
        return jnp.sum(scanned(jnp.zeros(SPEC.shape), pose, ranges, jnp.array(ANGLES)) ** 2)

    for gradient in jax.grad(score, argnums=(0, 1))(jnp.array(POSE), jnp.full(9, 2.0)):
        np.testing.assert_array_equal(gradient, jnp.zeros_like(gradient))


# --- scores of a map


def test_entropy_of_what_is_not_known_is_a_bit_a_cell(tolerance):
    assert float(grid.entropy_bits(jnp.zeros((5, 7)))) == pytest.approx(35.0, rel=tolerance(1e-15, 1e-6))


def test_entropy_by_hand(tolerance):
    """p = 3/4: -(3/4 log2 3/4 + 1/4 log2 1/4) = 0.811278; certainty, even where p rounds to 1, is 0 bits."""
    bits = grid.entropy_bits(jnp.array([[math.log(3), -math.log(3), 800.0, -800.0]]))
    assert float(bits) == pytest.approx(2 * 0.8112781244591328, rel=tolerance(1e-14, 1e-6))


def test_entropy_is_numpys(tolerance):
    log_odds = np.random.default_rng(0).uniform(-4, 4, (6, 5))
    p = reference.probability(log_odds)
    expected = np.sum(-p * np.log2(p) - (1 - p) * np.log2(1 - p))
    assert float(grid.entropy_bits(jnp.array(log_odds))) == pytest.approx(expected, rel=tolerance(1e-13, 1e-6))


def test_brier_by_hand():
    """Probabilities 3/4, 1/4, 1/2 of occupied, free, not scored: (1/16 + 1/16) / 2."""
    log_odds = jnp.array([[math.log(3), -math.log(3), 0.0]])
    score = grid.brier(log_odds, jnp.array([[True, False, True]]), log_odds != 0)
    assert float(score) == pytest.approx(1 / 16, rel=1e-6)


def test_brier_of_no_cell_is_no_number():
    none = jnp.zeros((2, 2), bool)
    assert math.isnan(float(grid.brier(jnp.zeros((2, 2)), none, none)))


def test_brier_of_an_ignorant_map_is_a_quarter():
    everywhere = jnp.ones((3, 3), bool)
    assert float(grid.brier(jnp.zeros((3, 3)), jnp.eye(3, dtype=bool), everywhere)) == 0.25


def test_calibration_by_hand():
    """Four cells called 3/4, three of them occupied, and one called 1/4 that is occupied: error (0 * 4 + 3/4) / 5."""
    log_odds = jnp.array([math.log(3)] * 4 + [-math.log(3), 0.0]).reshape(2, 3)
    occupied = jnp.array([[True, True, True], [False, True, True]])
    bins = grid.calibration(log_odds, occupied, log_odds != 0, bins=2)
    np.testing.assert_allclose(bins.edges, [0, 0.5, 1])
    np.testing.assert_allclose(bins.cells, [1, 4])
    np.testing.assert_allclose(bins.probability, [0.25, 0.75], rtol=1e-6)
    np.testing.assert_allclose(bins.frequency, [1.0, 0.75], rtol=1e-6)
    assert float(bins.error) == pytest.approx(0.75 / 5, rel=1e-6)


def test_calibration_is_numpys(tolerance):
    rng = np.random.default_rng(0)
    log_odds, occupied = rng.uniform(-3, 3, (20, 20)), rng.random((20, 20)) < 0.4
    where = rng.random((20, 20)) < 0.7
    bins = grid.calibration(jnp.array(log_odds), jnp.array(occupied), jnp.array(where), bins=10)
    p, o = reference.probability(log_odds)[where], occupied[where]
    counts, _ = np.histogram(p, 10, (0, 1))
    rtol = tolerance(1e-12, 1e-5)
    with np.errstate(invalid="ignore"):
        mean = np.histogram(p, 10, (0, 1), weights=p)[0] / counts
        share = np.histogram(p, 10, (0, 1), weights=o.astype(float))[0] / counts
    np.testing.assert_array_equal(bins.cells, counts)
    np.testing.assert_allclose(bins.probability, mean, rtol=rtol)
    np.testing.assert_allclose(bins.frequency, share, rtol=rtol)
    np.testing.assert_allclose(bins.error, np.nansum(np.abs(mean - share) * counts) / len(p), rtol=rtol)


def test_certain_cells_fall_into_the_last_bins():
    log_odds = jnp.array([[50.0, -50.0]])
    bins = grid.calibration(log_odds, jnp.array([[True, False]]), jnp.ones((1, 2), bool), bins=4)
    np.testing.assert_array_equal(bins.cells, [1, 0, 0, 1])
    assert float(bins.error) == pytest.approx(0.0, abs=1e-6)


# --- course problem 1: the covariance of a beam's end

BEAM_NOISE = np.diag([0.05**2, 0.01**2])
POSE_COV = np.array([[4e-3, 1e-3, 2e-4], [1e-3, 3e-3, -1e-4], [2e-4, -1e-4, 4e-4]])


def endpoint(pose, beam):
    return pose[..., :2] + beam[..., :1] * np.stack(
        [np.cos(pose[..., 2] + beam[..., 1]), np.sin(pose[..., 2] + beam[..., 1])], axis=-1
    )


@pytest.mark.parametrize("noise", [None, BEAM_NOISE])
def test_course_problem_1_end_covariance_is_that_of_samples(noise):
    """20,000 poses and beams: an entry of a sample covariance has standard error sqrt((S_ii S_jj + S_ij²) / N).

    Five of them. What the first order leaves out, (reach σ_θ²)² / 2 = 2e-6 m², is a tenth of one.
    """
    rng, count, beam = np.random.default_rng(0), 20_000, np.array([5.0, 0.4])
    poses = rng.multivariate_normal(POSE, POSE_COV, count)
    beams = rng.multivariate_normal(beam, np.zeros((2, 2)) if noise is None else noise, count)
    sampled = np.cov(endpoint(poses, beams).T)
    R = None if noise is None else jnp.array(noise)
    got = np.asarray(grid.endpoint_covariance(jnp.array(POSE), jnp.array(POSE_COV), *jnp.array(beam), R))
    bound = 5 * np.sqrt((np.outer(np.diag(got), np.diag(got)) + got**2) / count)
    assert np.all(np.abs(got - sampled) < bound)


def test_end_covariance_is_the_propagation_by_the_endpoints_derivative(tolerance):
    def point(pose, beam):
        angle = pose[2] + beam[1]
        return pose[:2] + beam[0] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    pose, beam = jnp.array(POSE), jnp.array([5.0, 0.4])
    J, J_beam = (np.asarray(j) for j in jax.jacfwd(point, argnums=(0, 1))(pose, beam))
    args = (pose, jnp.array(POSE_COV), *beam)
    rtol = tolerance(1e-12, 1e-5)
    np.testing.assert_allclose(grid.endpoint_covariance(*args), J @ POSE_COV @ J.T, rtol=rtol)
    expected = J @ POSE_COV @ J.T + J_beam @ BEAM_NOISE @ J_beam.T
    np.testing.assert_allclose(grid.endpoint_covariance(*args, jnp.array(BEAM_NOISE)), expected, rtol=rtol)


def test_walls_turn_fuzzier_with_reach():
    wide = [
        np.trace(grid.endpoint_covariance(jnp.array(POSE), jnp.array(POSE_COV), jnp.array(r), jnp.array(0.4)))
        for r in (1.0, 4.0, 8.0)
    ]
    assert wide[0] < wide[1] < wide[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_odds": (3, 3)}, r"log_odds: expected shape \(4, 4\), got \(3, 3\)"),
        ({"pose": (4,)}, r"pose: expected shape \(3\), got \(4,\)"),
        ({"ranges": (3,)}, r"ranges: expected shape \(2\), got \(3,\)"),
        ({"beam_angles": (2, 1)}, r"beam_angles: expected shape \(any\), got \(2, 1\)"),
    ],
)
def test_an_update_of_the_wrong_shape_is_refused_by_name(change, message):
    """A map of another shape than the grid's would be written outside its bounds."""
    shapes = {"log_odds": (4, 4), "pose": (3,), "ranges": (2,), "beam_angles": (2,)} | change
    arrays = {name: jnp.ones(shape) for name, shape in shapes.items()}
    spec = GridSpec(origin=(0.0, 0.0), resolution=1.0, shape=(4, 4))
    with pytest.raises(ValueError, match=message):
        grid.update_log_odds(
            **arrays, l_occ=jnp.array(0.8), l_free=jnp.array(-0.4), spec=spec, min_range=0.1, max_range=3.0
        )
