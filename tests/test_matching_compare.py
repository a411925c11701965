"""The filters that scan matching is compared with, atom by atom, and the program that compares them."""

import dataclasses
import functools
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import Recorder, stop

from jaxlocmap import GridSpec, init, run, simulation
from jaxlocmap.consistency import chi2_band
from jaxlocmap.matching import lines, scan_match
from jaxlocmap.matching.normals import Points, surface_points
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.se2 import between
from jaxlocmap.types import Matcher, Scanner

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import matching_compare
from baselines import fits, scan_filters
from baselines.scan_filters import Matched

ANGLES = np.linspace(-1.2, 1.2, 61)
SPEC = GridSpec(origin=(-2.0, -1.0), resolution=0.1, shape=(140, 140))
STD, SCALE = 0.03, 0.1


def random_points(seed, count=40):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, count)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    valid = rng.random(count) < 0.8
    return Points(jnp.asarray(rng.uniform(-3, 3, (count, 2))), jnp.asarray(normal), jnp.asarray(valid))


@jax.jit
def scan_in_room(pose):
    exact = simulation.ray_cast(pose, jnp.asarray(ANGLES), simulation.room().segments, 8.0)
    return surface_points(exact, jnp.asarray(STD), scanner=Scanner(jnp.asarray(ANGLES)), gap=0.8)


def turned(pose, vectors):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(vectors) @ np.array([[c, -s], [s, c]]).T


# --- How a scan fits ---


def test_occupancy_is_read_between_four_cells_and_derived(tolerance):
    rng = np.random.default_rng(0)
    log_odds, pose = rng.normal(size=SPEC.shape) * 3, np.array([3.0, 4.0, 0.7])
    points = random_points(1)
    xy = np.asarray(points.xy).copy()
    xy[0] = 50.0  # off the grid

    def residuals(pose):
        q = pose[:2] + turned(pose, xy)
        probability = 1 / (1 + np.exp(-np.clip(log_odds, -4, 4)))
        at = (q - np.array(SPEC.origin)) / SPEC.resolution - 0.5
        total = np.zeros(len(q))
        for i, (x, y) in enumerate(at):
            for column in (np.floor(x), np.floor(x) + 1):
                for row in (np.floor(y), np.floor(y) + 1):
                    if 0 <= row < SPEC.shape[0] and 0 <= column < SPEC.shape[1]:
                        share = (1 - abs(x - column)) * (1 - abs(y - row))
                        total[i] += share * probability[int(row), int(column)]
        return 1 - total

    arguments = map(jnp.asarray, (log_odds, pose, xy, np.asarray(points.valid)))
    got = jax.jit(functools.partial(fits.on_occupancy, spec=SPEC))(*arguments)
    used = np.asarray(got.weight) > 0
    np.testing.assert_array_equal(used, np.asarray(points.valid) & (np.arange(len(xy)) > 0))
    np.testing.assert_allclose(got.residual[used], residuals(pose)[used], rtol=0, atol=tolerance(1e-12, 1e-3))
    step = 1e-6
    slope = np.stack([(residuals(pose + d) - residuals(pose - d)) / (2 * step) for d in step * np.eye(3)], axis=1)
    np.testing.assert_allclose(got.slope[used], slope[used], rtol=tolerance(1e-6, 1e-3), atol=tolerance(1e-6, 1e-2))


@pytest.fixture(scope="module")
def room_map():
    """A map of lines of the course's room, and a scan of it from 4 cm and 0.02 rad beside."""
    empty, pose = jnp.zeros((*SPEC.shape, lines.SUMS)), jnp.array([6.0, 2.0, 0.3])
    drawn = jax.jit(functools.partial(lines.add_points, spec=SPEC))(empty, pose, scan_in_room(pose))
    return drawn, scan_in_room(pose + jnp.array([0.03, -0.03, 0.02]))


def test_a_scan_on_lines_is_fitted_and_solved_as_the_library_does(room_map, tolerance):
    mean, cov = jnp.array([6.0, 2.0, 0.3]), jnp.diag(jnp.array([0.05, 0.05, 0.02]) ** 2)
    std, scale = jnp.asarray(STD), jnp.asarray(SCALE)

    @jax.jit
    def both(drawn, points):
        fit = functools.partial(fits.on_lines, drawn, points=points, scale=scale, spec=SPEC)
        ours = (
            lines.fit(drawn, mean, points, scale, spec=SPEC),
            scan_match.match(drawn, mean, cov, points, std, scale, spec=SPEC),
        )
        return ours, (fit(mean), fits.solve(fit, mean, cov, std))

    (expected, matched), (got, solved) = both(*room_map)
    np.testing.assert_allclose(got.hessian, expected.hessian, rtol=tolerance(1e-10, 1e-4), atol=1e-4)
    np.testing.assert_allclose(got.pull, expected.slope, rtol=tolerance(1e-10, 1e-3), atol=1e-4)
    assert int(got.used) == np.asarray(expected.used).sum() > 20
    np.testing.assert_allclose(solved.pose, matched.pose, rtol=0, atol=tolerance(1e-8, 1e-4))
    assert np.abs(np.asarray(solved.pose - mean)).max() > 0.01


def test_points_of_two_scans_are_paired_as_numpy_does(tolerance):
    reference, points, pose = random_points(2, 150), random_points(3, 150), np.array([0.2, -0.1, 0.4])
    got = jax.jit(fits.on_scan)(reference, jnp.asarray(pose), points, jnp.asarray(SCALE))
    q, n = pose[:2] + turned(pose, points.xy), turned(pose, points.normal)
    there = np.flatnonzero(reference.valid)
    for i in range(len(q)):
        apart = np.linalg.norm(q[i] - np.asarray(reference.xy)[there], axis=1)
        j = there[np.argmin(apart)]
        m = np.asarray(reference.normal)[j]
        r = m @ (q[i] - np.asarray(reference.xy)[j])
        if points.valid[i] and apart.min() < 0.5 and abs(m @ n[i]) > 0.8 and abs(r) < 0.3:
            np.testing.assert_allclose(got.residual[i], r, rtol=0, atol=tolerance(1e-12, 1e-5))
            np.testing.assert_allclose(got.weight[i], 1 / (1 + (r / SCALE) ** 2), rtol=1e-4)
            arm = q[i] - pose[:2]
            np.testing.assert_allclose(got.slope[i], [*m, m[1] * arm[0] - m[0] * arm[1]], rtol=0, atol=1e-4)
        else:
            assert got.weight[i] == 0
    assert 3 < int(got.used) < points.valid.sum()


def test_two_scans_of_a_room_tell_how_the_robot_moved():
    a, b = jnp.array([2.0, 2.0, 0.7]), jnp.array([2.2, 2.1, 0.8])
    wide = jnp.diag(jnp.asarray(fits.WEAK) ** 2)

    @jax.jit
    def solve(reference, points):
        fit = functools.partial(fits.on_scan, reference, points=points, scale=jnp.asarray(SCALE))
        return fits.solve(fit, jnp.array([0.15, 0.0, 0.05]), wide, STD)

    solved = solve(scan_in_room(a), scan_in_room(b))
    np.testing.assert_allclose(solved.pose, between(a, b)[0], rtol=0, atol=2e-3)


def linear_fit(pose, truth=(0.3, -0.2, 0.1)):
    """Points whose residual is linear in the pose."""
    J = jnp.asarray(np.random.default_rng(5).normal(size=(30, 3)))
    return fits.Fit(J @ (pose - jnp.asarray(truth)), J, jnp.linspace(0.2, 1, 30))


@pytest.mark.parametrize("sigma", [0.0, 1e-2, 10.0])
def test_the_scans_own_pose_does_not_depend_on_the_belief(sigma):
    """However strong the belief that the solver weighs the scan against, even one that allows no other pose."""

    @jax.jit
    def solve(cov):
        solved = fits.solve(linear_fit, jnp.zeros(3), cov, 0.03)
        return solved, solved.shift(jnp.zeros(3), jnp.asarray(0.03**2))

    solved, shift = solve(sigma**2 * jnp.eye(3))
    np.testing.assert_allclose(shift, [0.3, -0.2, 0.1], rtol=0, atol=1e-3)
    assert (np.abs(solved.pose - np.array([0.3, -0.2, 0.1])).max() < 1e-3) == (sigma == 10)


# --- What is taken for the covariance ---


VARIANCE = 0.04


@pytest.fixture
def matched():
    rng = np.random.default_rng(6)
    fit = fits.Fit(*map(jnp.asarray, (rng.normal(size=25), rng.normal(size=(25, 3)), rng.uniform(0.2, 1, 25))))
    return Matched(jnp.array([0.1, -0.2, 0.05]), fit, jnp.asarray(VARIANCE))


def test_covariances_are_those_of_numpy(matched, tolerance):
    r, J, w = (np.asarray(x, float) for x in matched.fit)
    H = np.einsum("k,ki,kj->ij", w, J, J)
    middle = np.einsum("k,ki,kj->ij", (w * r) ** 2, J, J) / VARIANCE**2
    bread = np.linalg.inv(H / VARIANCE)
    cells = np.diag([0.1, 0.1, 1])
    expected = {
        scan_filters.inverse_hessian: bread,
        scan_filters.sandwich: bread @ middle @ bread,
        functools.partial(scan_filters.sandwich, factor=30.0): 30 * bread @ middle @ bread,
        scan_filters.hessian: cells @ H @ cells,
        scan_filters.unscaled: np.linalg.inv(H),
    }
    for law, R in expected.items():
        told = law(matched)
        np.testing.assert_allclose(np.linalg.inv(np.asarray(told.information)), R, rtol=tolerance(1e-4, 1e-3))
        np.testing.assert_allclose(told.gradient, np.linalg.solve(R, matched.shift), rtol=tolerance(1e-4, 1e-3))


def test_a_sandwich_of_residuals_as_large_as_they_should_be_is_the_inverse_hessian(matched):
    fit = matched.fit._replace(residual=jnp.full(25, VARIANCE**0.5), weight=jnp.ones(25))
    both = (law(matched._replace(fit=fit)).information for law in (scan_filters.sandwich, scan_filters.inverse_hessian))
    np.testing.assert_allclose(*both, rtol=1e-4)


def test_an_optimiser_held_back_by_its_prior_is_sure_of_what_no_scan_told_it(matched):
    blind = matched._replace(fit=jax.tree.map(jnp.zeros_like, matched.fit))
    told = scan_filters.with_prior(blind)
    np.testing.assert_allclose(np.diag(told.information) ** -0.5, [0.0153, 0.0153, 0.000153], rtol=1e-2)
    assert not np.any(told.gradient)
    R = np.linalg.inv(np.asarray(scan_filters.with_prior(matched).information, float))
    scan = 400 * np.asarray(matched.fit.hessian, float) / np.asarray(matched.fit.weight).sum()
    np.testing.assert_allclose(R, 2.34e-4 * np.linalg.inv(scan + np.diag([1, 1, 1e4])), rtol=1e-3)
    # The pose it finds lies between those of the scan and of its prior.
    held = R @ np.asarray(scan_filters.with_prior(matched).gradient, float)
    np.testing.assert_allclose(
        held, np.linalg.solve(scan + np.diag([1, 1, 1e4]), scan @ matched.shift), rtol=0, atol=1e-5
    )


def test_moments_of_a_response_know_no_more_than_their_window(matched):
    """Flat, they are those of points spread evenly over it: 0.63 degrees, whatever the scan. Sharp, those of one."""

    @jax.jit
    def told(matched):
        responses = (
            lambda poses: jnp.ones(len(poses)),
            lambda poses: jnp.where(jnp.all(poses == 0, axis=1), 0.5, 0.0),
            lambda poses: 1 - 2 * jnp.abs(poses[:, 0] - poses[:, 1]),  # a ridge along x = y, poorer away from it
        )
        return [scan_filters.response_moments(matched, response) for response in responses]

    flat, sharp, ridge = told(matched)
    (reach, shifts), (angle, turns) = scan_filters._SHIFTS, scan_filters._TURNS
    x, y = np.meshgrid(*[np.linspace(-reach, reach, shifts)] * 2)
    expected = np.diag([np.mean(x**2), np.mean(y**2), np.mean(np.linspace(-angle, angle, turns) ** 2)])
    np.testing.assert_allclose(np.linalg.inv(flat.information), expected, rtol=0, atol=1e-6)
    assert np.rad2deg(expected[2, 2] ** 0.5) == pytest.approx(0.632, abs=1e-3)
    least = np.array([0.02**2 / 10, 0.02**2 / 10, (angle / 5) ** 2])
    np.testing.assert_allclose(1 / np.diag(sharp.information), 2 * least, rtol=1e-4)
    R = np.linalg.inv(ridge.information)
    weight = np.where(np.abs(x - y) < 0.05, 1 - 2 * np.abs(x - y), 0)
    np.testing.assert_allclose(R[0, 1], np.sum(weight * x * y) / weight.sum(), rtol=1e-2)


# --- The filters ---


SCENARIO = dataclasses.replace(simulation.LOOP, steps=40, exact_prior=False, prior_std=(1e-3,) * 3)
CONFIG = dataclasses.replace(SCENARIO.config(motion="euler", grid=False), matcher=Matcher(period=5, gap=0.8))
PARAMS = with_defaults(simulation.own_params(simulation.Noise(), SCENARIO))


@functools.cache
def drive():
    world = simulation.room()._replace(landmarks=jnp.zeros((0, 2)))
    simulate = jax.jit(functools.partial(simulation.simulate, scenario=SCENARIO))
    return simulate(jax.random.key(0), world, simulation.Noise(), jnp.asarray(SCENARIO.start))


@functools.cache
def program(name):
    scanner = CONFIG.scanner(SCENARIO.beam_angles())
    return jax.jit(functools.partial(getattr(scan_filters, name), config=CONFIG, scanner=scanner))


def filtered(name, inputs, **law):
    return jax.tree.map(np.asarray, program(name)(PARAMS, SCENARIO.prior(), inputs, **law))


@functools.cache
def odometry():
    return filtered("odometry", drive()[1])


def test_odometry_is_the_librarys(tolerance):
    config = dataclasses.replace(CONFIG, matcher=None)
    filtered = jax.jit(lambda inputs: run(PARAMS, init(SCENARIO.prior(), config=config), inputs, config=config)[1])
    info = filtered(drive()[1]._replace(ranges=None))
    np.testing.assert_allclose(odometry().mean, info.belief.mean[::5], rtol=0, atol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(odometry().cov, info.belief.cov[::5], rtol=0, atol=tolerance(1e-12, 1e-6))


LAWS = {"on_occupancy": scan_filters.ON_OCCUPANCY, "on_lines": scan_filters.ON_LINES, "on_keyframes": None}


@pytest.mark.parametrize("name", LAWS)
def test_a_filter_is_odometry_until_a_scan_tells_something(name, tolerance):
    truth, inputs = drive()
    law = {} if LAWS[name] is None else {"law": jnp.asarray(0, jnp.int32)}
    blind = filtered(name, inputs._replace(ranges=jnp.full_like(inputs.ranges, 8.0)), **law)
    for got, expected in zip(blind, odometry(), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance(1e-9, 1e-5))
    got = filtered(name, inputs, **law)
    np.testing.assert_allclose(got.mean[0], odometry().mean[0], rtol=0, atol=tolerance(1e-9, 1e-5))  # nothing to match
    assert np.all(np.linalg.det(got.cov[2:]) < 0.5 * np.linalg.det(odometry().cov[2:]))
    assert np.abs(got.mean - np.asarray(truth.pose)[::5])[:, :2].max() < 0.05


@pytest.mark.parametrize("name", ["on_occupancy", "on_lines"])
def test_each_covariance_has_its_name_and_its_row(name):
    """By how much the first match shrinks the belief; a number past the last would do the same as the last."""
    names = LAWS[name]
    assert [way.law for way in matching_compare._WAYS if way.filter == name] == list(range(len(names)))
    volume = {}
    for i, words in enumerate(names):
        assert any(words in way.name and way.law == i for way in matching_compare._WAYS if way.filter == name)
        cov = filtered(name, drive()[1], law=jnp.asarray(i, jnp.int32)).cov
        volume[words.split(" (")[0]] = np.linalg.det(cov[1])
    if name == "on_lines":
        assert volume["sandwich × 30"] > 2 * volume["sandwich"]
        assert volume["(JᵀJ)⁻¹ without σ²"] == max(volume.values()) > 2 * volume["σ² H⁻¹"]
    else:
        assert volume["H itself"] == max(volume.values())
        assert volume["the optimiser's with its prior"] == min(volume.values())
    assert len({round(np.log(v), 3) for v in volume.values()}) == len(names)


# --- The program ---


def test_what_is_said_of_a_filter():
    nees = np.array([[1.0, 2.0, np.nan], [9.0, 6.0, 5.0]])
    error = np.array([[[3.0, 0.0, 0.1]] * 3, [[0.0, 4.0, -0.3]] * 3])
    row = matching_compare._row(nees, error)
    assert row["anees"] == pytest.approx(np.mean([1.5, 20 / 3]))
    assert row["rmse_position_m"] == pytest.approx(12.5**0.5)
    assert row["rmse_yaw_rad"] == pytest.approx(0.05**0.5)
    assert row["coverage_95"] == pytest.approx(4 / 6)  # below 7.81; what is no number is not held
    assert row["flagged_moments"] == 1
    assert row["nees_per_match"] == [5.0, 4.0, 5.0]


def test_the_table_has_a_row_for_each_filter_and_four_columns_for_each_world():
    row = {"filter": "a", "rmse_position_m": 0.1234, "rmse_yaw_rad": 0.0056, "anees": 1234.5, "coverage_95": 0.025}
    report = {"worlds": {"loop": {"filters": [row]}, "hall": {"filters": [row | {"anees": 3.0}]}}}
    head, _, line = matching_compare._table(report).splitlines()
    assert head.count("|") == line.count("|") == 10
    cells = "0.123 m | 5.6 mrad | {} | 2.5 %"
    assert line == f"| a | {cells.format('1,234')} | {cells.format('3')} |"
    assert "hall: ANEES (3)" in head


@pytest.mark.parametrize(("quick", "runs"), [(False, 7), (True, 4)])
@pytest.mark.usefixtures("as_a_program")
def test_options(monkeypatch, tmp_path, quick, runs):
    asked = []

    def world(scenario, runs, seed, progress):
        asked.append((scenario.name, scenario.steps, runs, seed, scenario.prior_std, scenario.exact_prior))
        return {"filters": []}

    monkeypatch.setattr(matching_compare, "_world", world)
    for name in ("replace_table", "write_report", "saved"):
        monkeypatch.setattr(matching_compare, name, Recorder())
    monkeypatch.setattr(matching_compare.hosts, "use_all_cores", Recorder())
    monkeypatch.setattr(matching_compare.plotting, "matching_figure", Recorder())
    for write in (False, True):
        config = matching_compare.MatchingConfig(runs=7, seed=5, quick=quick, write=write, out=tmp_path)
        report = matching_compare.main(config)
        assert matching_compare.replace_table.calls == ([(("matching", matching_compare._table(report)), {})] * write)
    known = (runs, 5, (1e-3,) * 3, False)
    every = [("loop", 200, *known)] if quick else [("loop", 2400, *known), ("building", 7200, *known)]
    assert asked == 2 * every


def test_a_single_run_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(matching_compare.hosts, "use_all_cores", stop)
    with pytest.raises(ValueError, match="runs: expected at least 2"):
        matching_compare.main(matching_compare.MatchingConfig(runs=1, out=tmp_path))


@pytest.mark.slow
@pytest.mark.usefixtures("as_a_program")
def test_the_filters_are_compared_on_the_same_runs(tmp_path):
    report = matching_compare.main(matching_compare.MatchingConfig(quick=True, out=tmp_path))
    assert json.loads((tmp_path / "report.json").read_text())["runs"] == report["runs"] == 4
    assert (tmp_path / "matching_compare.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert list(report["worlds"]) == ["loop"]
    loop = report["worlds"]["loop"]
    assert loop["nees_band_95"] == chi2_band(3, 4)
    assert len(loop["time_s"]) == 40
    assert loop["time_s"][:2] == pytest.approx([0.1, 0.6])
    rows = {row["filter"]: row for row in loop["filters"]}
    assert list(rows) == [way.name for way in matching_compare._WAYS]
    assert all(len(row["nees_per_match"]) == 40 and row["flagged_moments"] == 0 for row in rows.values())
    # At the first step nothing is matched yet: the runs are the same.
    first = np.array([row["nees_per_match"][0] for row in rows.values()])
    np.testing.assert_allclose(first, first[0], rtol=1e-2)
    ours, alone = rows["this library: submaps with anchor and bias"], rows["odometry alone"]
    for told_absolute in ("occupancy grid, absolute: σ² H⁻¹", "map of lines, absolute: σ² H⁻¹"):
        assert abs(np.log(ours["anees"] / 3)) < abs(np.log(rows[told_absolute]["anees"] / 3))
    assert ours["rmse_position_m"] < alone["rmse_position_m"]
