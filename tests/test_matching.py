"""Normals, the map of lines and one match, against plain NumPy and against places whose answer is known."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import GridSpec, simulation
from jaxlocmap.matching import lines, scan_match
from jaxlocmap.matching.normals import Points, surface_points
from jaxlocmap.types import Scanner

ANGLES = np.linspace(-1.2, 1.2, 61)
SPEC = GridSpec(origin=(-6.0, -6.0), resolution=0.1, shape=(120, 120))
STD, SCALE, GAP = 0.03, 0.1, 0.8


def scanner(offset=(0.0, 0.0, 0.0), angles=ANGLES):
    return Scanner(jnp.asarray(angles), offset=offset, min_range=0.05, max_range=8.0)


@functools.partial(jax.jit, static_argnames="offset")
def seen(ranges, offset=(0.0, 0.0, 0.0)):
    return surface_points(ranges, jnp.asarray(STD), scanner=scanner(offset), gap=GAP)


def ranges_in_room(pose, noise=0.0, seed=0):
    """Of the course's room."""
    exact = simulation.ray_cast(jnp.asarray(pose), jnp.asarray(ANGLES), simulation.room().segments, 8.0)
    return jnp.asarray(np.asarray(exact) + noise * np.random.default_rng(seed).normal(size=len(ANGLES)))


# --- Normals ---


def normals_by_eigh(ranges, offset):
    """The rules of `surface_points`, beam by beam."""
    dx, dy, turn = offset
    hit = np.isfinite(ranges) & (ranges > 0.05) & (ranges < 7.85)
    ends = np.stack([dx + ranges * np.cos(ANGLES + turn), dy + ranges * np.sin(ANGLES + turn)], axis=1)
    normal, valid = np.full((len(ranges), 2), np.nan), np.zeros(len(ranges), bool)
    for i in np.flatnonzero(hit):
        group, sides = [i], 0
        for side in (1, -1):
            for k in range(1, 9):
                j = i + side * k
                if not 0 <= j < len(ranges) or not hit[j] or np.linalg.norm(ends[j] - ends[j - side]) >= GAP:
                    break
                if k > 1 and np.linalg.norm(ends[j] - ends[i]) > 0.3:
                    break
                group.append(j)
                sides += k == 1
        centre = ends[group].mean(axis=0)
        variance, axes = np.linalg.eigh(np.cov(ends[group].T, bias=True)) if len(group) > 1 else ((1, 1), np.eye(2))
        normal[i] = axes[:, 0]
        off = abs(axes[:, 0] @ (ends[i] - centre))
        valid[i] = sides == 2 and variance[0] <= (2 * STD) ** 2 and variance[1] >= 4 * variance[0] and off <= 3 * STD
    return ends, normal, valid


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.3, -0.1, 0.5)], ids=["centred", "mounted"])
@pytest.mark.parametrize("pose", [(6.0, 2.0, 0.0), (1.0, 1.0, 0.7), (9.0, 5.4, 2.5), (0.5, 3.0, 3.1)])
def test_normals_are_numpys_beam_by_beam(pose, offset, tolerance):
    ranges = np.array(ranges_in_room(pose, noise=STD))
    ranges[[5, 6, 30]] = np.nan, 8.0, 0.01
    got = seen(jnp.asarray(ranges), offset)
    ends, normal, valid = normals_by_eigh(ranges, offset)
    np.testing.assert_array_equal(got.valid, valid)
    assert 5 < valid.sum() < len(valid)
    np.testing.assert_allclose(got.xy[valid], ends[valid], rtol=0, atol=tolerance(1e-12, 1e-5))
    across = np.abs(np.sum(np.asarray(got.normal) * normal, axis=1))  # of either sign
    np.testing.assert_allclose(across[valid], 1, rtol=0, atol=tolerance(1e-10, 1e-3))


def test_three_beams_have_a_normal_between_them():
    angles = np.array([-0.1, 0, 0.1])
    got = surface_points(jnp.asarray(1 / np.cos(angles)), STD, scanner=scanner(angles=angles), gap=GAP)
    assert got.valid.tolist() == [False, True, False]
    np.testing.assert_allclose(np.abs(got.normal[1]), [1, 0], atol=1e-6)


def test_a_beam_at_a_corner_a_gap_or_the_scans_end_has_no_normal():
    ranges = np.full(61, 2.0) / np.cos(ANGLES)  # a wall 2 m ahead
    got = np.asarray(seen(jnp.asarray(ranges)).valid)
    assert got[1:-1].all()
    assert not got[[0, -1]].any()
    ranges[20:] += 3  # from there another wall far behind
    got = np.asarray(seen(jnp.asarray(ranges)).valid)
    assert not got[[19, 20]].any()
    assert got[10:19].all()


def test_a_scan_without_returns_has_no_point():
    for ranges in (np.full(61, 8.0), np.full(61, 7.9), np.full(61, np.inf), np.zeros(61), np.full(61, np.nan)):
        got = seen(jnp.asarray(ranges))
        assert not np.any(got.valid)
        assert np.all(np.isfinite(got.xy))
        assert np.all(np.isfinite(got.normal))


# --- The map of lines ---


def placed(pose, points):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    R = np.array([[c, -s], [s, c]])
    return pose[:2] + np.asarray(points.xy) @ R.T, np.asarray(points.normal) @ R.T


def sums_cell_by_cell(pose, points, spec=SPEC):
    """A (xx, xy, yy), b (x, y) and W of every cell, from every point."""
    q, n = placed(np.asarray(pose), points)
    centres = [np.asarray(spec.origin)[i] + spec.resolution * (np.arange(spec.shape[1 - i]) + 0.5) for i in (0, 1)]
    x, y = np.meshgrid(*centres)
    total = np.zeros((*spec.shape, 6))
    for p, m, valid in zip(q, n, np.asarray(points.valid), strict=True):
        wx, wy = (np.maximum(1 - np.abs(p[i] - c) / (2 * spec.resolution), 0) for i, c in enumerate((x, y)))
        w = valid * wx * wy
        off = m[0] * (p[0] - x) + m[1] * (p[1] - y)
        total += w[..., None] * np.stack(
            [m[0] * m[0] + 0 * x, m[0] * m[1] + 0 * x, m[1] * m[1] + 0 * x, m[0] * off, m[1] * off, 1 + 0 * x], axis=-1
        )
    return total


EMPTY = np.zeros((*SPEC.shape, 6))
add = jax.jit(functools.partial(lines.add_points, spec=SPEC))
fit = jax.jit(functools.partial(lines.fit, spec=SPEC))


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (-3.0, 1.5, 2.0), (4.0, -4.0, 0.5)])
def test_a_map_is_the_sum_over_its_points(pose, tolerance):
    """The last pose has points beyond the map."""
    points = seen(ranges_in_room((6.0, 2.0, 0.3), noise=STD))
    expected = sums_cell_by_cell(pose, points)
    got = add(jnp.asarray(EMPTY), jnp.asarray(pose), points)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance(1e-12, 1e-4))
    twice = add(got, jnp.asarray(pose), points)
    np.testing.assert_allclose(twice, 2 * expected, rtol=0, atol=tolerance(1e-12, 1e-4))
    np.testing.assert_array_equal(add(got, jnp.asarray(pose), points, counts=jnp.array(False)), got)


def test_one_of_several_maps_in_an_array_is_like_one_alone():
    points, pose = seen(ranges_in_room((6.0, 2.0, 0.3), noise=STD)), jnp.array([0.1, 0.2, 0.3])
    alone = add(jnp.asarray(EMPTY), pose, points)
    for which in (0, 1):
        both = add(jnp.concatenate([EMPTY, EMPTY]), pose, points, at=which)
        halves = np.split(np.asarray(both), 2)
        np.testing.assert_array_equal(halves[which], alone)
        np.testing.assert_array_equal(halves[1 - which], EMPTY)
        there = fit(both, pose, points, jnp.asarray(SCALE), at=which)
        jax.tree.map(np.testing.assert_array_equal, there, fit(alone, pose, points, jnp.asarray(SCALE)))


def test_maps_are_cleared_where_a_run_says_so_and_derivatives_go_with_them():
    maps = np.random.default_rng(3).normal(size=(3, 8, 4, 6))  # of three runs, two of 4 x 4 cells each
    clear = np.array([[False, True], [False, False], [True, True]])
    kept = np.repeat(~clear, 4, axis=1)[..., None, None]
    nis = np.array([1.0, np.nan, 2.0])

    def loss(maps, clear):
        return jnp.sum(jax.vmap(lines.cleared)(maps, clear, jnp.sum(maps, axis=(1, 2, 3))) ** 2)

    @jax.jit
    def all_of(maps, clear, nis):
        alone = lines.cleared(maps[0], clear[0], nis[0])
        return (
            jax.vmap(lines.cleared)(maps, clear, nis),
            alone,
            (jax.grad(loss)(maps, clear), jax.jacfwd(loss)(maps, clear)),
        )

    together, alone, slopes = all_of(*map(jnp.asarray, (maps, clear, nis)))
    np.testing.assert_array_equal(together, maps.astype(together.dtype) * kept)
    for slope in slopes:
        np.testing.assert_allclose(slope, 2 * maps * kept, rtol=1e-6)
    np.testing.assert_array_equal(alone, together[0])


def test_the_sign_of_a_normal_does_not_matter(tolerance):
    points, pose = seen(ranges_in_room((6.0, 2.0, 0.3), noise=STD)), jnp.array([0.02, 0.01, 0.01])
    turned = points._replace(normal=points.normal * jnp.where(jnp.arange(61) % 2 == 0, 1.0, -1.0)[:, None])
    for a, b in ((points, turned), (turned, points)):
        got = fit(add(jnp.asarray(EMPTY), jnp.zeros(3), a), pose, b, jnp.asarray(SCALE))
        plain = fit(add(jnp.asarray(EMPTY), jnp.zeros(3), points), pose, points, jnp.asarray(SCALE))
        np.testing.assert_allclose(got.hessian, plain.hessian, rtol=tolerance(1e-10, 1e-4), atol=tolerance(1e-10, 1e-3))
        np.testing.assert_allclose(got.slope, plain.slope, rtol=0, atol=tolerance(1e-12, 1e-4))


def wall(n=41, distance=2.0):
    """Points every 10 cm along a straight wall ahead, with the normal it has."""
    xy = np.stack([np.full(n, distance), np.linspace(-n / 20, n / 20, n)], axis=1)
    return Points(jnp.asarray(xy), jnp.tile(jnp.array([1.0, 0.0]), (n, 1)), jnp.ones(n, bool))


@pytest.mark.parametrize("heading", [0.0, 0.4, np.pi / 2, 3.0])
def test_off_a_straight_wall_the_residual_is_the_distance(heading, tolerance):
    points = wall()
    there = jnp.array([0.3, -0.2, heading])
    drawn = add(jnp.asarray(EMPTY), there, points)
    ahead = jnp.array([np.cos(heading), np.sin(heading), 0.0])
    for off in (-0.1, 0.0, 0.03, 0.12):
        got = fit(drawn, there + off * ahead, points, jnp.asarray(SCALE))
        used = np.asarray(got.used)
        assert used[3:-3].all()
        np.testing.assert_allclose(got.residual[used], off, rtol=0, atol=tolerance(1e-12, 1e-5))
        weight = (1 - (off / lines.REACH) ** 2) / (1 + (off / SCALE) ** 2)
        np.testing.assert_allclose(got.weight[used], weight, rtol=tolerance(1e-9, 1e-4))
        # Along the wall nothing is known; the residual changes by 1 m a metre ahead.
        along = np.array([-np.sin(heading), np.cos(heading), 0.0])
        np.testing.assert_allclose(got.hessian @ along, 0, rtol=0, atol=tolerance(1e-9, 1e-3))
        np.testing.assert_allclose(ahead @ got.hessian @ ahead, weight * used.sum(), rtol=tolerance(1e-9, 1e-4))
        np.testing.assert_allclose(ahead @ got.slope, off * weight * used.sum(), rtol=0, atol=tolerance(1e-9, 1e-3))


@pytest.mark.parametrize("heading", [0.0, 0.4])
def test_noisy_normals_tell_little_along_a_wall(heading):
    """Normals 0.1 rad off: each point's own would count sin² of that a point. In the map they are averages over the
    points of ten scans, so that a tenth of it and less is left.
    """

    def noisy(seed):
        turn = 0.1 * np.random.default_rng(seed).normal(size=41)
        return wall()._replace(normal=jnp.asarray(np.stack([np.cos(turn), np.sin(turn)], axis=1)))

    there, drawn = jnp.array([0.3, -0.2, heading]), jnp.asarray(EMPTY)
    for seed in range(10):
        drawn = add(drawn, there, noisy(seed))
    got = fit(drawn, there, noisy(10), jnp.asarray(SCALE))
    ahead, along = np.array([np.cos(heading), np.sin(heading), 0]), np.array([-np.sin(heading), np.cos(heading), 0])
    assert ahead @ got.hessian @ ahead > 0.95 * 41
    assert along @ got.hessian @ along < 0.1 * 41 * 0.1**2


def test_the_derivative_by_the_heading_is_the_residuals_own(x64):
    points, there = wall(), jnp.array([0.3, -0.2, 0.4])
    drawn = add(jnp.asarray(EMPTY), there, points)

    def residual(turn):
        # The normal stays: to first order a wall seen a little turned is as far off as with its own normal.
        return fit(drawn, there.at[2].add(turn), points, jnp.asarray(SCALE)).residual

    got = fit(drawn, there, points, jnp.asarray(SCALE))
    slopes = (residual(1e-6) - residual(-1e-6)) / 2e-6
    inner = slice(3, -3)
    np.testing.assert_allclose(slopes[inner], -points.xy[inner, 1], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        got.hessian[2, 2], np.sum(np.asarray(got.used) * np.asarray(points.xy)[:, 1] ** 2), rtol=1e-9
    )


def test_points_off_the_map_across_it_or_far_from_its_lines_are_left_out():
    drawn = add(jnp.asarray(EMPTY), jnp.zeros(3), wall())
    scale = jnp.asarray(SCALE)
    assert not np.any(fit(jnp.asarray(EMPTY), jnp.zeros(3), wall(), scale).used)
    assert not np.any(fit(drawn, jnp.array([0.5, 0.0, 0.0]), wall(), scale).used)  # 0.5 m off
    assert not np.any(fit(drawn, jnp.array([9.0, 0.0, 0.0]), wall(), scale).used)
    across = wall()._replace(normal=jnp.tile(jnp.array([0.0, 1.0]), (41, 1)))
    got = fit(drawn, jnp.zeros(3), across, scale)
    assert not np.any(got.used)
    assert not np.any(got.hessian)
    assert not np.any(got.slope)


# --- One match ---


match = jax.jit(functools.partial(scan_match.match, spec=SPEC), static_argnames="steps")
WIDE = jnp.diag(jnp.array([0.1, 0.1, 0.05]) ** 2)


def in_room(pose, other, noise=0.0, cov=WIDE, mean=None, **kwargs):
    """A scan from `other`, given in the frame of `pose`, matched on one from `pose`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    there = np.add(pose, (c * other[0] - s * other[1], s * other[0] + c * other[1], other[2]))
    drawn = add(jnp.asarray(EMPTY), jnp.zeros(3), seen(ranges_in_room(pose, noise, 1)))
    scan = seen(ranges_in_room(there, noise, 2))
    mean = jnp.zeros(3) if mean is None else jnp.asarray(mean)
    return match(drawn, mean, cov, scan, jnp.asarray(STD), jnp.asarray(SCALE), **kwargs)


@pytest.mark.parametrize("other", [(0.0, 0.0, 0.0), (0.08, -0.05, 0.03), (-0.1, 0.1, -0.05)])
def test_a_match_finds_where_the_scan_was_taken(other):
    """Without noise, and with a belief so wide that it weighs nothing."""
    got = in_room((2.0, 2.0, 0.8), other, cov=1e4 * WIDE)
    np.testing.assert_allclose(got.pose, other, rtol=0, atol=1e-4)
    assert 18 >= int(got.points) >= int(got.used) >= 14


def test_at_the_optimum_scan_and_belief_balance(tolerance):
    """score = P⁻¹ (pose - mean), whichever of the two knows more."""
    for scale in (0.01, 1.0, 100.0):
        got = in_room((2.0, 2.0, 0.8), (0.05, -0.03, 0.02), noise=STD, cov=scale * WIDE, steps=30)
        back = np.linalg.solve(scale * np.asarray(WIDE), np.asarray(got.pose))
        size = np.sqrt(np.diagonal(got.information))
        np.testing.assert_allclose(got.score / size, back / size, rtol=0, atol=tolerance(1e-3, 5e-2))


def test_a_pose_known_exactly_stays():
    got = in_room((2.0, 2.0, 0.8), (0.05, -0.03, 0.02), cov=jnp.zeros((3, 3)), mean=(0.01, 0.02, 0.03))
    np.testing.assert_array_equal(got.pose, jnp.array([0.01, 0.02, 0.03]))


def test_in_a_corridor_the_pose_stays_along_it_and_nothing_is_claimed(tolerance):
    n = 30
    along = np.linspace(-3, 3, n)
    xy = np.concatenate([np.stack([along, np.full(n, side)], axis=1) for side in (-1.0, 1.0)])
    points = Points(jnp.asarray(xy), jnp.tile(jnp.array([0.0, 1.0]), (2 * n, 1)), jnp.ones(2 * n, bool))
    drawn = add(jnp.asarray(EMPTY), jnp.zeros(3), points)
    mean = jnp.array([0.15, 0.06, 0.02])
    got = match(drawn, mean, WIDE, points, jnp.asarray(STD), jnp.asarray(SCALE))
    assert abs(got.pose[0] - 0.15) < 1e-2
    assert np.all(np.abs(np.asarray(got.pose)[1:]) < 5e-3)
    variance, axes = np.linalg.eigh(np.asarray(got.information))
    assert variance[0] < 1e-3 * variance[1]
    assert abs(axes[0, 0]) > 0.999


def test_a_scan_without_points_leaves_the_belief():
    nothing = seen(jnp.full(61, 8.0))
    drawn = add(jnp.asarray(EMPTY), jnp.zeros(3), seen(ranges_in_room((2.0, 2.0, 0.8))))
    got = match(drawn, jnp.array([0.1, 0.2, 0.3]), WIDE, nothing, jnp.asarray(STD), jnp.asarray(SCALE))
    np.testing.assert_array_equal(got.pose, jnp.array([0.1, 0.2, 0.3]))
    assert not np.any(got.information)
    assert got.points == got.used == 0


# --- Far off ---


FAR = jnp.diag(jnp.array([0.2, 0.2, 0.12]) ** 2)
search = jax.jit(functools.partial(scan_match.search, spec=SPEC), static_argnames="window")


@pytest.mark.parametrize(("other", "which"), [((0.45, -0.3, 0.2), 0), ((-0.4, 0.35, -0.25), 1), ((0.0, 0.0, 0.0), 1)])
def test_a_search_finds_the_neighbourhood_that_a_match_alone_does_not(other, which):
    """In the one of two maps that it is told."""
    pose = np.array([6.0, 2.0, 0.3])
    c, s = np.cos(pose[2]), np.sin(pose[2])
    there = np.add(pose, (c * other[0] - s * other[1], s * other[0] + c * other[1], other[2]))
    drawn = add(jnp.asarray(EMPTY), jnp.zeros(3), seen(ranges_in_room(pose)))
    scan, mean, scale = seen(ranges_in_room(there)), jnp.zeros(3), jnp.asarray(SCALE)
    both = jnp.concatenate([drawn, EMPTY] if which == 0 else [EMPTY, drawn])
    start = search(both, mean, FAR, scan, scale, window=(0.7, 0.4), at=which)
    off = np.abs(np.asarray(start) - other)
    assert off[:2].max() < 0.12
    assert off[2] < 0.06
    found = match(drawn, mean, FAR, scan, jnp.asarray(STD), scale, start=start).pose
    np.testing.assert_allclose(found, other, rtol=0, atol=0.01)
    alone = match(drawn, mean, FAR, scan, jnp.asarray(STD), scale).pose
    assert (np.abs(np.asarray(alone) - other).max() > 0.1) == any(other)


def test_a_search_looks_no_farther_than_its_window_and_where_all_is_alike_stays():
    pose = (2.0, 2.0, 0.8)
    drawn, scan = (add(jnp.asarray(EMPTY), jnp.zeros(3), seen(ranges_in_room(pose))), seen(ranges_in_room(pose)))
    scale = jnp.asarray(SCALE)
    start = search(drawn, jnp.array([0.4, 0.0, 0.3]), FAR, scan, scale, window=(0.1, 0.05))
    np.testing.assert_array_less(np.abs(np.asarray(start) - [0.4, 0.0, 0.3]), [0.1001, 0.1001, 0.0501])
    mean = jnp.array([0.1, 0.2, 0.3])
    nowhere = search(jnp.asarray(EMPTY), mean, FAR, scan, scale, window=(0.7, 0.4))
    np.testing.assert_allclose(nowhere, mean, rtol=0, atol=1e-6)
    known = search(drawn, mean, jnp.zeros((3, 3)), scan, scale, window=(0.7, 0.4))
    np.testing.assert_allclose(known, mean, rtol=0, atol=1e-6)


def test_points_are_counted_as_a_fit_weighs_them_where_cells_are_read_at_their_centres(tolerance):
    """At a point on the centre of a cell, the nearest cell alone is what is read."""
    n = 30
    xy = np.stack([np.full(n, 1.05), 0.1 * np.arange(n) - 1.45], axis=1)
    points = Points(jnp.asarray(xy), jnp.tile(jnp.array([1.0, 0.0]), (n, 1)), jnp.ones(n, bool))
    drawn = add(jnp.asarray(EMPTY), jnp.array([0.03, 0.0, 0.0]), points)

    @jax.jit
    def overlap(drawn, points):
        there = lines.placed(jnp.zeros(3), points)
        return lines.overlap(drawn, jnp.zeros(2), there, jnp.asarray(SCALE), spec=SPEC)

    got = overlap(drawn, points)
    expected = fit(drawn, jnp.zeros(3), points, jnp.asarray(SCALE))
    np.testing.assert_allclose(got, expected.weight.sum(), rtol=tolerance(1e-9, 1e-4))
    assert float(got) == pytest.approx(n * (1 - 0.01) / (1 + (0.03 / SCALE) ** 2), rel=1e-4)
