"""The occupancy grid against the reference's loops, what no scan may do to it, and the scores of a map."""

import functools
import itertools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxlocmap import GridSpec
from jaxlocmap.mapping import grid, quality
from jaxlocmap.types import Scanner

L_OCC, L_FREE = 0.85, -0.40
SPEC = GridSpec(origin=(-1.0, 0.5), resolution=0.25, shape=(16, 24))  # x from -1 to 5 m, y from 0.5 to 4.5 m
MIN_RANGE, MAX_RANGE = 0.05, 4.0
ANGLES = np.linspace(-1.2, 1.2, 9)
POSE = np.array([0.63, 2.41, 0.3])


def scanner(angles=ANGLES, min_range=MIN_RANGE, max_range=MAX_RANGE):
    return Scanner(jnp.asarray(angles), min_range=min_range, max_range=max_range)


@functools.partial(jax.jit, static_argnames="spec")
def scanned(log_odds, pose, ranges, angles, l_occ=L_OCC, l_free=L_FREE, *, spec=SPEC):
    return grid.update_log_odds(log_odds, pose, ranges, l_occ, l_free, scanner=scanner(angles), spec=spec)


def scan(ranges, *, pose=POSE, angles=ANGLES, before=None):
    """The map after one scan, by default of an empty map. Further beams that measure nothing change nothing (below), so
    that one program serves scans of all lengths.
    """
    before = jnp.zeros(SPEC.shape) if before is None else jnp.asarray(before)
    more = len(ANGLES) - len(ranges)
    ranges, angles = (np.append(x, np.full(more, value)) for x, value in ((ranges, np.nan), (angles, 0.0)))
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


def test_the_two_bounds_of_the_log_odds_are_their_own(same):
    """That of walls is 1.5 nats, that of free space -0.7."""
    spec = GridSpec(SPEC.origin, SPEC.resolution, SPEC.shape, l_min=-0.7, l_max=1.5)
    scene = jnp.array([0.1, 2.1, 0.0]), jnp.full(9, 1.0), jnp.zeros(9)
    map_ = scanned(jnp.zeros(spec.shape), *scene, spec=spec)
    same([map_[6, 8], map_[6, 6], map_[5, 6]], [1.5, -0.7, 0])
    same(grid.clamp(jnp.array([-9.0, -0.6, 1.4, 9.0]), spec), [-0.7, -0.6, 1.4, 1.5])


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


def test_a_map_shorter_than_its_beams_is_cleared_from_edge_to_edge():
    """Along its longer side too."""
    spec = GridSpec((0.0, 0.0), 0.5, (3, 7))  # 3.5 m by 1.5 m
    pose, angles = jnp.array([0.2, 0.7, 0.0]), jnp.array([0.0, math.pi / 2])
    map_ = scanned(jnp.zeros(spec.shape), pose, jnp.full(2, 3.9), angles, spec=spec)
    expected = np.zeros(spec.shape, map_.dtype)
    expected[1] = expected[2, 0] = L_FREE
    expected[1, 0] = 2 * np.float32(L_FREE)
    np.testing.assert_allclose(map_, expected, rtol=1e-6)


# --- scan after scan, clamped below at the end alone


@functools.partial(jax.jit, static_argnames=("at_the_end", "settled", "angles"))
def mapped(log_odds, poses, ranges, l_occ=L_OCC, l_free=L_FREE, *, at_the_end=True, settled=True, angles=tuple(ANGLES)):
    """The map after several scans: each clamped, or only the last."""
    add = grid.add_scan if at_the_end else grid.update_log_odds

    def body(log_odds, now):
        return add(log_odds, *now, l_occ, l_free, scanner=scanner(angles), spec=SPEC), None

    log_odds, _ = jax.lax.scan(body, log_odds, (poses, ranges))
    return grid.clamp(log_odds, SPEC) if settled else log_odds


def drive(seed, scans=40):
    """Poses and ranges that clear the same cells again and again, then hit them, then both; on and beside the map."""
    rng = np.random.default_rng(seed)
    poses = np.tile(POSE, (scans, 1)) + rng.normal(size=(scans, 3)) * [0.02, 0.02, 0.01]
    ranges = rng.uniform(2.5, 5.0, (scans, len(ANGLES)))
    ranges[scans // 3 : scans // 2] = rng.choice([0.6, 0.8, 1.0], (1, len(ANGLES)))  # in the middle of what was cleared
    ranges[scans // 2 :] = rng.uniform(0.0, 5.0, (scans - scans // 2, len(ANGLES)))
    poses[-scans // 4 :, :2] = rng.uniform([-2, 0], [6, 5], (scans // 4, 2))
    return jnp.array(poses), jnp.array(ranges)


@pytest.mark.parametrize("seed", range(4))
def test_one_lower_clamp_after_all_scans_is_one_after_every_scan(seed, same):
    poses, ranges = drive(seed)
    before = jnp.array(np.random.default_rng(seed).uniform(SPEC.l_min, SPEC.l_max, SPEC.shape))
    lazy, every = (mapped(before, poses, ranges, at_the_end=at_the_end) for at_the_end in (True, False))
    np.testing.assert_array_equal(lazy, every)
    expected = np.asarray(before, float)
    for pose, scan_ranges in zip(np.asarray(poses, float), np.asarray(ranges, float), strict=True):
        expected = reference_scan(scan_ranges, pose=pose, before=expected)
    if jax.config.jax_enable_x64:  # in float32 an end may fall across the edge of a cell
        same(lazy, expected)


def test_cells_fall_below_the_clamp_and_rise_from_it():
    """What the test above is about. No cell passes the upper one."""
    poses, ranges = drive(0)
    poses, ranges = map(np.asarray, (poses, ranges))
    clears, hits = slice(0, 13), slice(13, 20)
    fallen = unclamped(jnp.zeros(SPEC.shape), poses[clears], ranges[clears])
    assert fallen.min() < SPEC.l_min - 10
    hit = np.tile(poses[hits][:1], (13, 1)), np.tile(ranges[hits][:1], (13, 1))
    only_first = np.where(np.arange(13)[:, None] > 0, np.nan, hit[1]).astype(ranges.dtype)
    once = unclamped(jnp.array(fallen), hit[0], only_first)
    raised = (fallen < SPEC.l_min - 1) & (once > fallen)
    assert raised.sum() >= 3
    assert np.all(once[raised] > SPEC.l_min)
    assert unclamped(jnp.array(once), *hit).max() == SPEC.l_max


def unclamped(*args, **kwargs):
    return np.asarray(mapped(*args, settled=False, **kwargs))


def test_a_cell_below_the_clamp_that_is_both_crossed_and_hit_counts_from_the_clamp(same):
    """Three beams cross it and two end in it, within one scan."""
    before = np.full(SPEC.shape, SPEC.l_min - 7)
    ranges = jnp.array([[2.0, 2.0, 2.0, 1.0, 1.0] + [math.nan] * 4])
    after = unclamped(jnp.array(before), jnp.array([[0.1, 2.1, 0.0]]), ranges, angles=(0.0,) * 9)
    same(after[6, 8], SPEC.l_min + 3 * L_FREE + 2 * L_OCC)
    same(after[6, 7], before[6, 7] + 5 * L_FREE)
    same(after[5], before[5])


# --- many at once

BATCH = {  # one of the robots stands outside the map, one has no heading
    "log_odds": np.random.default_rng(0).uniform(-6, 4, (4, *SPEC.shape)),
    "pose": np.array([[0.63, 2.41, 0.3], [9.0, 2.0, 1.0], [4.1, 1.2, -2.0], [1.0, 2.0, np.nan]]),
    "ranges": np.random.default_rng(1).uniform(0.0, 5.0, (4, len(ANGLES))),
    "l_occ": np.array([0.85, 0.5, 1.0, 0.7]),
    "l_free": np.array([-0.4, -0.5, -0.1, -0.3]),
}


@functools.partial(jax.jit, static_argnums=0)
def batched(levels, args):
    """`add_scan` under one vmap a level, each over the arguments of the names it lists."""

    def one(args):
        return grid.add_scan(**args, scanner=scanner(), spec=SPEC)

    for names in reversed(levels):
        one = jax.vmap(one, in_axes=({name: 0 if name in names else None for name in BATCH},))
    return one(args)


EVERYTHING = tuple(BATCH)
LINES = ("pose", "ranges")
LEVELS = [
    [("log_odds",)],
    [("l_occ",)],
    [("l_free",)],
    [LINES],
    [EVERYTHING],
    [EVERYTHING, EVERYTHING],
    [("l_free",), ("log_odds", *LINES)],
    [("log_odds",), ("l_occ", *LINES)],
]


@pytest.mark.parametrize("levels", LEVELS, ids=lambda levels: "-of-".join("+".join(names) for names in levels))
def test_robots_at_once_are_robots_one_by_one(levels):
    """Whatever they share. With two levels, the outer two of two."""
    shape = (2, 2) if len(levels) == 2 else (4,)
    args = {}
    for name, value in BATCH.items():
        value = value.reshape(*shape, *value.shape[1:])
        for axis in reversed(range(len(levels))):
            value = value if name in levels[axis] else value.take(0, axis)
        args[name] = jnp.array(value)  # in the precision of the job
    args = jax.tree.map(np.asarray, args)
    got = np.asarray(batched(tuple(levels), args))
    for place in itertools.product(*map(range, shape)):
        own = {
            name: value[tuple(i for i, names in zip(place, levels, strict=True) if name in names)]
            for name, value in args.items()
        }
        np.testing.assert_array_equal(got[place], batched((), own))


# --- gradients

WEIGHTS = np.random.default_rng(1).normal(size=SPEC.shape)


STEP = 1e-5  # of a difference, whose next term is its square times a third derivative of order ten thousand


def curved(given, poses, ranges):
    """A score of the map before, l_occ and l_free that has a second derivative; and the map after."""
    after = mapped(given[0], poses, ranges, *given[1:])
    return jnp.sum(jnp.array(WEIGHTS) * jnp.sin(after)), after


def derivatives(given, direction, poses, ranges):
    """First derivative, forward and reverse, and second, along a direction; the score itself, and the map."""
    score = functools.partial(curved, poses=poses, ranges=ranges)
    value, forward, after = jax.jvp(score, (given,), (direction,), has_aux=True)
    gradient, bend = jax.jvp(jax.grad(lambda given: score(given)[0]), (given,), (direction,))
    return forward, gradient, bend, value, after


def along(tree, direction):
    return sum(np.vdot(a, b) for a, b in zip(jax.tree.leaves(tree), jax.tree.leaves(direction), strict=True))


def lane(tree, index):
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


@pytest.mark.usefixtures("x64")
def test_derivatives_through_the_clamps_are_finite_differences_alone_and_in_a_batch():
    """By the map before, l_occ and l_free; cells sit at both clamps, where the derivative is zero."""
    rng = np.random.default_rng(5)
    scans = jax.tree.map(lambda *x: np.stack(x), *(drive(seed, scans=12) for seed in (0, 2)))
    given = rng.uniform(-4.5, 3.9, (2, *SPEC.shape)), np.array([0.83, 0.7]), np.array([-0.37, -0.41])
    given[0][:, 4:11, 8:16] = 3.9
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), given)
    slopes = jax.jit(derivatives)
    *batch, _, _ = jax.jit(jax.vmap(derivatives))(given, direction, *scans)
    summed = jax.jit(jax.grad(lambda given: jnp.sum(jax.vmap(curved)(given, *scans)[0])))(given)
    for i in range(2):
        here, way, both = lane(given, i), lane(direction, i), lane(scans, i)
        ahead, behind = (
            jax.tree.map(np.asarray, slopes(jax.tree.map(lambda x, d, step=step: x + step * d, here, way), way, *both))
            for step in (STEP, -STEP)
        )
        forward, gradient, bend, _, after = jax.tree.map(np.asarray, slopes(here, way, *both))
        assert np.any(after == SPEC.l_min)
        assert np.any(after == SPEC.l_max)
        np.testing.assert_allclose(forward, (ahead[3] - behind[3]) / (2 * STEP), rtol=1e-6)
        np.testing.assert_allclose(along(gradient, way), forward, rtol=1e-12)
        np.testing.assert_allclose(along(bend, way), (ahead[0] - behind[0]) / (2 * STEP), rtol=1e-6)
        exact = functools.partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
        jax.tree.map(exact, lane(batch, i), [forward, gradient, bend])
        jax.tree.map(exact, lane(summed, i), gradient)


def test_gradient_by_pose_and_ranges_is_zero():
    def score(pose, ranges):
        return jnp.sum(scanned(jnp.zeros(SPEC.shape), pose, ranges, jnp.array(ANGLES)) ** 2)

    for gradient in jax.jit(jax.grad(score, argnums=(0, 1)))(jnp.array(POSE), jnp.full(9, 2.0)):
        np.testing.assert_array_equal(gradient, np.zeros(gradient.shape))


# --- scores of a map

entropy_bits, brier = jax.jit(quality.entropy_bits), jax.jit(quality.brier)
calibration, score = (jax.jit(f, static_argnames="bins") for f in (quality.calibration, quality.score))


def test_entropy_of_what_is_not_known_is_a_bit_a_cell(tolerance):
    assert float(entropy_bits(jnp.zeros((5, 7)))) == pytest.approx(35.0, rel=tolerance(1e-15, 1e-6))


def test_entropy_by_hand(tolerance):
    """p = 3/4: -(3/4 log2 3/4 + 1/4 log2 1/4) = 0.811278; certainty, even where p rounds to 1, is 0 bits."""
    bits = entropy_bits(jnp.array([[math.log(3), -math.log(3), 800.0, -800.0]]))
    assert float(bits) == pytest.approx(2 * 0.8112781244591328, rel=tolerance(1e-14, 1e-6))


def test_entropy_is_numpys(tolerance):
    log_odds = np.random.default_rng(0).uniform(-4, 4, (6, 5))
    p = reference.probability(log_odds)
    expected = np.sum(-p * np.log2(p) - (1 - p) * np.log2(1 - p))
    assert float(entropy_bits(jnp.array(log_odds))) == pytest.approx(expected, rel=tolerance(1e-13, 1e-6))


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0, 20.0, 60.0])
def test_entropy_loses_no_digit_where_a_cell_is_all_but_certain(size, tolerance):
    """p of the less likely is e^-L / (1 + e^-L): in a cell that is free or occupied alike."""
    q = math.exp(-size)
    bits = (math.log1p(q) + size * q / (1 + q)) / math.log(2)
    for log_odds in (size, -size):
        got = entropy_bits(jnp.full((1, 1), log_odds))
        assert float(got) == pytest.approx(bits, rel=tolerance(1e-14, 1e-6))


def test_brier_by_hand():
    """Probabilities 3/4, 1/4, 1/2 of occupied, free, not scored: (1/16 + 1/16) / 2."""
    log_odds = jnp.array([[math.log(3), -math.log(3), 0.0]])
    got = brier(log_odds, jnp.array([[True, False, True]]), log_odds != 0)
    assert float(got) == pytest.approx(1 / 16, rel=1e-6)


def test_brier_of_no_cell_is_no_number():
    none = jnp.zeros((2, 2), bool)
    assert math.isnan(float(brier(jnp.zeros((2, 2)), none, none)))


def test_brier_of_an_ignorant_map_is_a_quarter():
    everywhere = jnp.ones((3, 3), bool)
    assert float(brier(jnp.zeros((3, 3)), jnp.eye(3, dtype=bool), everywhere)) == 0.25


def test_calibration_by_hand():
    """Four cells called 3/4, three of them occupied, and one called 1/4 that is occupied: error (0 * 4 + 3/4) / 5."""
    log_odds = jnp.array([math.log(3)] * 4 + [-math.log(3), 0.0]).reshape(2, 3)
    occupied = jnp.array([[True, True, True], [False, True, True]])
    bins = calibration(log_odds, occupied, log_odds != 0, bins=2)
    np.testing.assert_allclose(bins.edges, [0, 0.5, 1])
    np.testing.assert_allclose(bins.cells, [1, 4])
    np.testing.assert_allclose(bins.probability, [0.25, 0.75], rtol=1e-6)
    np.testing.assert_allclose(bins.frequency, [1.0, 0.75], rtol=1e-6)
    assert float(bins.error) == pytest.approx(0.75 / 5, rel=1e-6)


def test_calibration_is_numpys(tolerance):
    rng = np.random.default_rng(0)
    log_odds, occupied = rng.uniform(-3, 3, (20, 20)), rng.random((20, 20)) < 0.4
    where = rng.random((20, 20)) < 0.7
    bins = calibration(jnp.array(log_odds), jnp.array(occupied), jnp.array(where), bins=10)
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


def test_a_probability_on_an_edge_falls_into_the_bin_above():
    """A half, exactly; and a cell that is not to be scored falls into none."""
    where = jnp.array([[True, True, True, False]])
    sums = score(jnp.zeros((1, 4)), jnp.array([[True, False, True, True]]), where, bins=4)
    np.testing.assert_array_equal(sums.cells, [0, 0, 3, 0])
    np.testing.assert_array_equal(sums.probability, [0, 0, 1.5, 0])
    np.testing.assert_array_equal(sums.occupied, [0, 0, 2, 0])
    assert (float(sums.square), float(sums.entropy_bits)) == (0.75, 4.0)


def test_certain_cells_fall_into_the_last_bins():
    log_odds = jnp.array([[50.0, -50.0]])
    bins = calibration(log_odds, jnp.array([[True, False]]), jnp.ones((1, 2), bool), bins=4)
    np.testing.assert_array_equal(bins.cells, [1, 0, 0, 1])
    assert float(bins.error) == pytest.approx(0.0, abs=1e-6)


def test_a_cell_at_the_edge_of_two_bins_falls_into_the_upper():
    bins = calibration(jnp.zeros((1, 2)), jnp.array([[True, False]]), jnp.ones((1, 2), bool), bins=4)
    np.testing.assert_array_equal(bins.cells, [0, 0, 2, 0])


# --- course problem 1: the covariance of a beam's end

end_covariance = jax.jit(grid.endpoint_covariance)
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
    got = np.asarray(end_covariance(jnp.array(POSE), jnp.array(POSE_COV), *map(jnp.asarray, beam), R))
    bound = 5 * np.sqrt((np.outer(np.diag(got), np.diag(got)) + got**2) / count)
    assert np.all(np.abs(got - sampled) < bound)


def test_end_covariance_is_the_propagation_by_the_endpoints_derivative(tolerance):
    def point(pose, beam):
        angle = pose[2] + beam[1]
        return pose[:2] + beam[0] * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    pose, beam = jnp.array(POSE), jnp.array([5.0, 0.4])
    J, J_beam = (np.asarray(j) for j in jax.jit(jax.jacfwd(point, argnums=(0, 1)))(pose, beam))
    args = (pose, jnp.array(POSE_COV), jnp.array(5.0), jnp.array(0.4))
    rtol = tolerance(1e-12, 1e-5)
    np.testing.assert_allclose(end_covariance(*args), J @ POSE_COV @ J.T, rtol=rtol)
    expected = J @ POSE_COV @ J.T + J_beam @ BEAM_NOISE @ J_beam.T
    np.testing.assert_allclose(end_covariance(*args, jnp.array(BEAM_NOISE)), expected, rtol=rtol)


def test_walls_turn_fuzzier_with_reach():
    wide = [
        np.trace(end_covariance(jnp.array(POSE), jnp.array(POSE_COV), jnp.array(r), jnp.array(0.4)))
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
        ({"log_odds": (5, 4, 4)}, r"log_odds: expected shape \(4, 4\), got \(5, 4, 4\)"),
        ({"l_occ": (2,)}, r"l_occ: expected shape \(\), got \(2,\)"),
        ({"l_free": (1,)}, r"l_free: expected shape \(\), got \(1,\)"),
    ],
)
def test_an_update_of_the_wrong_shape_is_refused_by_name(change, message):
    """A map of another shape than the grid's would be written outside its bounds."""
    shapes = {"log_odds": (4, 4), "pose": (3,), "ranges": (2,), "beam_angles": (2,), "l_occ": (), "l_free": ()} | change
    arrays = {name: jnp.ones(shape) for name, shape in shapes.items()}
    beams = scanner(arrays.pop("beam_angles"), min_range=0.1, max_range=3.0)
    spec = GridSpec(origin=(0.0, 0.0), resolution=1.0, shape=(4, 4))
    with pytest.raises(ValueError, match=message):
        grid.update_log_odds(**arrays, scanner=beams, spec=spec)


@pytest.mark.parametrize(
    ("name", "shape"), {"pose": (3,), "cov": (3, 3), "reach": (), "angle": (), "R": (2, 2)}.items()
)
def test_an_end_covariance_of_a_batch_is_refused_by_name(name, shape):
    arrays = {"pose": (3,), "cov": (3, 3), "reach": (), "angle": (), "R": (2, 2)}
    for wrong in ((5, *shape), (1,)):
        with pytest.raises(ValueError, match=rf"^{name}: expected shape .*, got {re.escape(str(wrong))}$"):
            grid.endpoint_covariance(**{key: jnp.ones(s) for key, s in (arrays | {name: wrong}).items()})


def test_scores_of_many_maps_are_refused_by_name():
    """Their sum would pass for the score of one."""
    one, many = jnp.zeros((4, 4)), jnp.zeros((5, 4, 4))
    with pytest.raises(ValueError, match=r"^log_odds: expected shape \(any, any\), got \(5, 4, 4\)$"):
        quality.entropy_bits(many)
    for score in (quality.brier, quality.calibration):
        with pytest.raises(ValueError, match=r"^log_odds: expected shape \(any, any\), got \(5, 4, 4\)$"):
            score(many, many > 0, many > 0)
        with pytest.raises(ValueError, match=r"^occupied: expected shape \(4, 4\), got \(5, 4, 4\)$"):
            score(one, many > 0, one > 0)
        with pytest.raises(ValueError, match=r"^where: expected shape \(4, 4\), got \(4,\)$"):
            score(one, one > 0, one[0] > 0)


@pytest.mark.parametrize("origin", [(388_096.0, 0.0), (0.0, -3_948_996.0), (16_380.0, 0.0)])
def test_a_grid_too_far_out_for_the_pose_s_precision_is_refused(origin):
    """The last one ends 4 m beyond where float32 counts in millimetres; float64 holds them all."""
    spec, scan = GridSpec(origin=origin, resolution=2.0, shape=(4, 4)), jnp.ones(2, jnp.float32)

    def maps(pose, scan):
        beams = scanner(scan, min_range=0.1, max_range=3.0)
        return grid.update_log_odds(jnp.zeros((4, 4), jnp.float32), pose, scan, 0.8, -0.4, scanner=beams, spec=spec)

    with pytest.raises(ValueError, match=r"^grid: expected coordinates that float32 holds to 0\.001 m, got \d"):
        jax.eval_shape(lambda pose: maps(pose, scan), jnp.zeros(3, jnp.float32))
    if jnp.result_type(float) == jnp.float64:
        double = scan.astype(float)
        jax.eval_shape(lambda pose: maps(pose, double), jnp.zeros(3))


def test_a_batch_of_maps_with_more_cells_than_an_index_counts_is_refused():
    """While tracing: nothing of that size is made."""
    spec = GridSpec(origin=(0.0, 0.0), resolution=0.1, shape=(2**10, 2**10))
    beams = scanner(jnp.zeros(3), min_range=0.0, max_range=4.0)

    def one(log_odds, pose):
        return grid.update_log_odds(log_odds, pose, jnp.ones(3), 1.0, -1.0, scanner=beams, spec=spec)

    def shape(runs):
        given = (jax.ShapeDtypeStruct((runs, *shape), jnp.zeros(()).dtype) for shape in (spec.shape, (3,)))
        return jax.eval_shape(jax.vmap(one), *given).shape

    assert shape(2**11 - 1) == (2**11 - 1, *spec.shape)
    with pytest.raises(
        ValueError, match=r"^log_odds: expected fewer than 2\*\*31 cells .* got 2,048 maps of 1,048,576 "
    ):
        shape(2**11)
