"""Submaps in the filter: the algebra against NumPy, the gates, and a filter whose covariance holds."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Gaussian, init, poses, run, simulation
from jaxlocmap.filters import information
from jaxlocmap.matching import submaps
from jaxlocmap.matching.lines import add_points
from jaxlocmap.matching.normals import surface_points
from jaxlocmap.se2 import between
from jaxlocmap.types import Matcher


def random_cov(seed, n, rank=None):
    L = np.random.default_rng(seed).normal(size=(n, rank or n))
    return L @ L.T / n


# --- The correction by information ---


corrected = jax.jit(information.update, static_argnames=("angles", "poses"))
observed = jax.jit(submaps.relative_pose, static_argnames="anchor")


def test_an_invertible_information_is_a_kalman_correction(tolerance):
    rng = np.random.default_rng(3)
    mean, P, H, R, z = (
        rng.normal(size=5),
        random_cov(1, 5),
        rng.normal(size=(3, 5)),
        random_cov(2, 3),
        rng.normal(size=3),
    )
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    Lambda = np.linalg.inv(R)
    got = corrected(*map(jnp.asarray, (mean, P, H, Lambda, Lambda @ z)), angles=())
    np.testing.assert_allclose(got[0], mean + K @ z, rtol=0, atol=tolerance(1e-9, 1e-3))
    np.testing.assert_allclose(got[1], P - K @ S @ K.T, rtol=0, atol=tolerance(1e-9, 1e-3))


def test_what_is_not_known_is_not_corrected(tolerance):
    """Singular information, and none: as if R were infinite there."""
    P = np.diag([0.5, 0.4, 0.3, 0.2])
    H = np.eye(3, 4)
    told = np.diag([100.0, 0.0, 4.0])
    mean, cov = corrected(*map(jnp.asarray, (np.zeros(4), P, H, told, np.array([10.0, 0.0, 0.4]))), angles=())
    expected = np.diag([1 / (2 + 100), 0.4, 1 / (1 / 0.3 + 4), 0.2])
    np.testing.assert_allclose(cov, expected, rtol=0, atol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(mean, [10 / 102, 0, 0.4 * expected[2, 2], 0], rtol=0, atol=tolerance(1e-12, 1e-5))
    unchanged = corrected(*map(jnp.asarray, (mean, P, H, np.zeros((3, 3)), np.zeros(3))), angles=())
    np.testing.assert_allclose(unchanged[1], P, rtol=0, atol=tolerance(1e-15, 1e-7))


@pytest.mark.parametrize("seed", range(5))
def test_a_covariance_stays_semi_definite(seed, tolerance):
    """Of a singular covariance, as clones make it, and strong information."""
    H, P = np.random.default_rng(seed).normal(size=(3, 6)), random_cov(seed, 6, rank=2)
    told = 1e6 * random_cov(seed + 9, 3, rank=2)
    _, cov = information.update(*map(jnp.asarray, (np.zeros(6), P, H, told, np.zeros(3))), angles=())
    np.testing.assert_array_equal(cov, np.asarray(cov).T)
    assert np.linalg.eigvalsh(np.asarray(cov, float))[0] > -tolerance(1e-12, 1e-3)


def test_a_turn_of_the_whole_world_stays_unknown_whatever_is_seen_of_two_poses(tolerance):
    """Two poses that turn together about the origin, and what is observed of one in the frame of the other. The mean
    moves with every correction; the covariance along that turn must not shrink.
    """

    def known(mean, cov):
        """Information on a turn of the world, by which both poses move: tᵀ P⁻¹ t."""
        turn = np.concatenate([[-mean[1], mean[0], 1.0], [-mean[4], mean[3], 1.0], np.zeros(3)])
        return turn @ np.linalg.solve(np.asarray(cov, float), turn)

    mean, cov = jnp.array([4.0, 1.0, 0.3, 2.0, 3.0, -0.4, 0.0, 0.0, 0.0]), jnp.asarray(random_cov(7, 9))
    before = known(mean, cov)
    told = jnp.asarray(np.diag([100.0, 400.0, 900.0]))
    for k in range(20):
        _, H = observed(mean, 3)
        pull = jnp.asarray(30 * np.sin(np.arange(3.0) + k))
        start, (mean, cov) = mean, corrected(mean, cov, H, told, pull, angles=(2, 5), poses=(0, 3))
        assert np.abs(np.asarray(mean) - np.asarray(start)).max() > 1e-3
    np.testing.assert_allclose(known(mean, cov), before, rtol=tolerance(1e-9, 2e-2))


# --- The entries of a submap ---


def test_a_pose_in_the_frame_of_another_and_its_derivatives(tolerance):
    a, b = jnp.array([1.0, -2.0, 2.5]), jnp.array([0.5, 1.0, -2.0])

    @jax.jit
    def both(a, b):
        got, *by = between(a, b)
        return got, [J.array(a.dtype) for J in by], jax.jacfwd(lambda a, b: between(a, b)[0], argnums=(0, 1))(a, b)

    got, by, expected = both(a, b)
    c, s = np.cos(2.5), np.sin(2.5)
    x, y = np.array([[c, s], [-s, c]]) @ [-0.5, 3.0]
    np.testing.assert_allclose(got, [x, y, -4.5 + 2 * np.pi], rtol=0, atol=tolerance(1e-12, 1e-5))
    for J, value in zip(by, expected, strict=True):
        np.testing.assert_allclose(J, value, rtol=0, atol=tolerance(1e-12, 1e-5))


@pytest.mark.parametrize("anchor", [3, 9])
def test_what_a_match_observes_and_its_derivative(anchor, tolerance):
    mean = np.random.default_rng(anchor).normal(size=15)
    got, H = observed(jnp.asarray(mean), anchor)
    own, bias = mean[anchor : anchor + 3], mean[anchor + 3 : anchor + 6]
    np.testing.assert_allclose(got, poses.between(own, mean[:3]) + bias, rtol=0, atol=tolerance(1e-12, 1e-5))
    expected = jax.jit(jax.jacfwd(lambda x: submaps.relative_pose(x, anchor)[0]))(jnp.asarray(mean))
    np.testing.assert_allclose(H, expected, rtol=0, atol=tolerance(1e-12, 1e-5))


@pytest.mark.parametrize("anchor", [3, 9])
def test_a_new_anchor_is_a_clone_of_the_pose(anchor):
    belief = Gaussian(jnp.asarray(np.random.default_rng(1).normal(size=15)), jnp.asarray(random_cov(1, 15)))
    got = jax.tree.map(np.asarray, jax.jit(submaps._begun, static_argnums=1)(belief, anchor))
    before, at = np.asarray(belief.cov), np.arange(anchor, anchor + 3)
    others = np.setdiff1d(np.arange(15), np.arange(anchor, anchor + 6))
    np.testing.assert_array_equal(got.mean[at], belief.mean[:3])
    np.testing.assert_array_equal(got.mean[at + 3], 0)
    np.testing.assert_array_equal(got.mean[others], np.asarray(belief.mean)[others])
    np.testing.assert_array_equal(got.cov[np.ix_(others, others)], before[np.ix_(others, others)])
    np.testing.assert_array_equal(got.cov[np.ix_(at, others)], before[np.ix_(np.arange(3), others)])
    np.testing.assert_array_equal(got.cov[np.ix_(at, at)], before[:3, :3])
    np.testing.assert_allclose(got.cov[np.ix_(at + 3, at + 3)], np.diag([0.25, 0.25, 0.04]), rtol=1e-6)
    assert not got.cov[np.ix_(at + 3, np.setdiff1d(np.arange(15), at + 3))].any()
    # Between a pose and its clone nothing is uncertain but the bias.
    _, H = observed(jnp.asarray(got.mean), anchor)
    np.testing.assert_allclose(H @ got.cov @ H.T, np.diag([0.25, 0.25, 0.04]), rtol=0, atol=1e-5)


def test_the_bias_moves_towards_the_error_of_the_pose_a_scan_is_added_at(tolerance):
    """P ← T P Tᵀ + κ² (Λ + P_rel⁻¹)⁻¹ on the bias, T x the errors after it moved."""
    mean, P, kappa = np.random.default_rng(4).normal(size=15), random_cov(4, 15), 0.3
    told = random_cov(5, 3)
    _, H = observed(jnp.asarray(mean), 9)
    rel = np.asarray(H) @ P @ np.asarray(H).T
    T = np.eye(15)
    T[12:15] -= kappa * np.asarray(H)
    expected = T @ P @ T.T
    expected[12:15, 12:15] += kappa**2 * np.linalg.inv(told + np.linalg.inv(rel))
    belief = Gaussian(jnp.asarray(mean), jnp.asarray(P))
    got = jax.jit(submaps._moved_bias, static_argnums=1)(belief, 9, *map(jnp.asarray, (kappa, H, rel, told)))
    np.testing.assert_allclose(got.cov, expected, rtol=0, atol=tolerance(1e-9, 1e-3))
    np.testing.assert_array_equal(got.mean, belief.mean)


# --- In the filter ---


NOISE = simulation.Noise()
LOOP = dataclasses.replace(simulation.LOOP, steps=360, exact_prior=True)
PATIENCE = 16
MATCHER = Matcher(period=5, gap=0.8, half_width=11.0, steps=5, patience=PATIENCE)
CONFIG = dataclasses.replace(LOOP.config(motion="euler", grid=False), matcher=MATCHER)
PARAMS = submaps.with_defaults(simulation.own_params(NOISE, LOOP))


@functools.cache
def drives(runs):
    """Drives without landmarks from a start that is known."""

    def drive(key):
        start = jnp.asarray(LOOP.start)
        truth, inputs = simulation.simulate(key, simulation.room(), NOISE, start, scenario=LOOP)
        return truth.state, inputs._replace(
            landmark=inputs.landmark[:, :0], z=inputs.z[:, :0], valid=inputs.valid[:, :0]
        )

    return jax.jit(jax.vmap(drive))(jax.random.split(jax.random.key(3), runs))


@functools.partial(jax.jit, static_argnames="config")
def filtered(params, inputs, config=CONFIG):
    start = Gaussian(LOOP.prior().mean, jnp.zeros((3, 3)))

    def one(inputs):
        state = init(start, config=config)
        return run(params, state, inputs, beam_angles=LOOP.beam_angles(), config=config)

    return jax.vmap(one)(inputs)


def nees(info, truth):
    error = np.asarray(truth) - np.asarray(info.belief.mean)[..., :3]
    error[..., 2] = poses.wrapped(error[..., 2])
    cov = np.asarray(info.belief.cov, float)[..., :3, :3] + 1e-12 * np.eye(3)
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(cov), error), error


RUNS = 16


@pytest.fixture(scope="module")
def matched():
    truth, inputs = drives(RUNS)
    state, info = filtered(PARAMS, inputs)
    return truth, jax.tree.map(np.asarray, state), jax.tree.map(np.asarray, info)


@pytest.fixture(scope="module")
def alone():
    """The beliefs of odometry, without matches."""
    config = dataclasses.replace(CONFIG, matcher=None)
    return jax.tree.map(np.asarray, filtered(PARAMS, drives(RUNS)[1]._replace(ranges=None), config=config)[1].belief)


def test_the_covariance_holds_and_the_pose_is_better_than_odometrys(matched, alone):
    """Over 16 runs the mean of NEES at one moment, a sum of 16 chi-square of 3, is below 3 + 5 sqrt(6 / 16) but for one
    time in a million if the filter is consistent; at 71 moments that depend on each other, for one in ten thousand. A
    filter that takes matches for absolute measurements is beyond it by far.
    """
    truth, _, info = matched
    statistic, error = nees(info, truth)
    late = statistic[:, 10::5].mean(axis=0)
    assert late.max() < 3 + 5 * np.sqrt(6 / RUNS)
    assert 1.0 < statistic[:, 50:].mean() < 4.5
    odometry = np.asarray(truth) - alone.mean

    def rmse(error):
        return np.sqrt(np.mean(np.sum(error[:, -50:, :2] ** 2, axis=-1)))

    assert rmse(error) < 0.4 * rmse(odometry)


def test_matches_are_due_every_period_and_reported(matched):
    _, state, info = matched
    tried = info.match.tried
    assert info.ok.all()
    assert not tried[:, 0].any()  # there the first submap begins
    assert tried[:, 5::5].all()
    assert not np.delete(tried, np.s_[::5], axis=1).any()
    assert (info.match.accepted == tried).mean() > 0.999
    assert (info.match.used <= info.match.points).all()
    # The belief's own displacement by a match: below chi-square of 3, for what the scan does not tell is not displaced.
    assert info.match.nis[tried].mean() < 3 + 4 * np.sqrt(6 / tried.sum())
    assert (state.submaps.steps == LOOP.steps).all()


def test_a_finished_submap_reports_where_the_next_anchor_is(matched):
    truth, _, info = matched
    matches, scans = LOOP.steps // 5, MATCHER.submap_scans
    # A match that is refused puts a run's submaps off by one scan.
    every = (info.match.accepted == info.match.tried).all(axis=1)
    assert every.sum() >= RUNS - 2
    truth, info = truth[every], jax.tree.map(lambda x: x[every], info)
    moments = np.flatnonzero(info.match.finished[0])
    # The first two anchors lie at steps 0 and 50; the older is finished when the younger holds ten scans.
    np.testing.assert_array_equal(moments, 5 * np.arange(2 * scans, matches, scans))
    anchors = np.concatenate([[0], 5 * scans * np.arange(1, len(moments) + 1)])
    for moment, a, b in zip(moments, anchors[:-1], anchors[1:], strict=True):
        exact = poses.between(np.asarray(truth[:, a]), np.asarray(truth[:, b]))
        mean, cov = info.match.edge.mean[:, moment], info.match.edge.cov[:, moment]
        error = exact - mean
        assert np.abs(error).max() < 0.1
        statistic = np.einsum("ri,rij,rj->r", error, np.linalg.inv(cov), error)
        assert statistic.mean() < 3 + 5 * np.sqrt(6 / every.sum())
    assert not info.match.edge.mean[~info.match.finished].any()


def test_a_submap_holds_the_scans_since_it_began_and_no_others(matched, tolerance):
    """Of each cell W is a sum over points, and that of one point's 16 cells is 4."""
    _, state, info = matched
    maps = state.submaps.lines.reshape(RUNS, 2, -1, 6)[..., 5].sum(axis=-1, dtype=float)
    for run_of in range(RUNS):
        older = state.submaps.older[run_of]
        added = (info.match.accepted | info.match.anew)[run_of]
        points = info.match.points[run_of, added]
        for slot, scans in zip((older, 1 - older), state.submaps.scans[run_of], strict=True):
            assert scans > 0
            assert maps[run_of, slot] == pytest.approx(4 * points[-scans:].sum(), rel=tolerance(1e-9, 1e-4))


CARRIED = 200  # the step from which on a robot is elsewhere
CALLED = CARRIED + 5 * (PATIENCE - 1)  # that of the refusal after which submaps begin anew
CASES = {"carried": slice(0, 5), "refused": slice(5, 10), "before": slice(10, 15), "blind": slice(15, 16)}


@pytest.fixture(scope="module")
def faulty():
    """The drives in a batch as large as that of `matched`, whose program it shares: five robots carried to the other
    side of the room at step 200, without a word from the odometry; the same five, which see nothing from the scan on
    that their patience would end with; the same, which see nothing once they are carried; one that never sees anything.
    """
    inputs = drives(RUNS)[1]
    ranges, step = np.asarray(inputs.ranges), np.arange(LOOP.steps)[:, None]
    ranges, control = (np.concatenate([x[:5]] * 3 + [x[5:6]]) for x in (ranges, np.asarray(inputs.control)))
    elsewhere = np.where(step >= CARRIED, np.roll(ranges, 150, axis=1), ranges)
    blind = {"carried": LOOP.steps, "refused": CALLED, "before": CARRIED, "blind": 0}
    for case, first in blind.items():
        ranges[CASES[case]] = np.where(step >= first, 8.0, elsewhere[CASES[case]])
    state, info = filtered(PARAMS, inputs._replace(ranges=jnp.asarray(ranges), control=jnp.asarray(control)))
    return {case: jax.tree.map(lambda x, at=at: np.asarray(x)[at], (state, info)) for case, at in CASES.items()}


def test_a_kidnapped_robot_is_refused_and_its_map_stays(faulty):
    state, info = faulty["refused"]
    accepted = info.match.accepted[:, CARRIED:CALLED:5]
    assert info.match.tried[:, CARRIED:CALLED:5].all()
    assert accepted.mean() < 0.2
    before, _ = faulty["before"]
    held = ~accepted.any(axis=1)
    assert held.any()
    np.testing.assert_array_equal(state.submaps.lines[held], before.submaps.lines[held])


def test_after_so_many_refusals_the_submaps_begin_anew(faulty):
    accepted = faulty["carried"][1].match.accepted
    refused = ~accepted[:, CARRIED : CALLED + 1 : 5].any(axis=1)  # all of its patience
    assert refused.any()
    assert accepted[refused][:, CALLED + 5 :: 5].mean() > 0.9
    assert faulty["carried"][1].match.anew[refused, CALLED].all()


def test_scans_without_points_change_nothing_but_are_counted(faulty, alone):
    state, info = faulty["blind"]
    belief = jax.tree.map(lambda x: x[5:6], alone)
    np.testing.assert_allclose(info.belief.mean[..., :3], belief.mean, rtol=0, atol=1e-5)
    np.testing.assert_allclose(info.belief.cov[..., :3, :3], belief.cov, rtol=0, atol=1e-5)
    assert info.match.due[:, ::5].all()
    assert not info.match.tried.any()
    assert not state.submaps.lines.any()
    assert info.ok.all()


def test_with_a_window_a_robot_whose_odometry_slipped_is_found_again():
    """At step 100 the robot is a metre farther on than its wheels say. The first scans are refused, until the
    covariance has grown to allow it.
    """
    inputs = drives(RUNS)[1]
    seen = np.asarray(inputs.ranges)
    slipped = np.full_like(seen, 8.0)  # nothing is seen in the end
    slipped[:, :100], slipped[:, 100:-36] = seen[:, :100], seen[:, 136:]
    slipped = inputs._replace(ranges=jnp.asarray(slipped))
    loose = PARAMS._replace(Q=jnp.diag(jnp.array([1.0, 0.3]) ** 2))
    searching = dataclasses.replace(CONFIG, matcher=dataclasses.replace(MATCHER, window=(0.8, 0.4)))
    short = jax.tree.map(lambda x: x[:1, :160], slipped)
    accepted = filtered(loose, slipped)[1].match.accepted[:, 100::5]
    found = filtered(loose, short, config=searching)[1].match.accepted[0, 100::5]
    assert np.asarray(found)[4:].all()
    assert not np.asarray(accepted)[0, 4:8].any()


def test_one_map_grows_and_no_submap_begins(matched):
    """The robot comes to where it was: what it knows of its pose since the start takes nothing from it."""
    truth, _, _ = matched
    single = dataclasses.replace(CONFIG, matcher=dataclasses.replace(MATCHER, submap_scans=None, patience=1))
    _, inputs = drives(RUNS)
    state, info = jax.tree.map(np.asarray, filtered(PARAMS, inputs, config=single))
    assert state.submaps.lines.shape == (RUNS, *MATCHER.spec.shape, 6)
    assert not info.match.begun.any()
    assert not info.match.finished.any()
    assert (info.match.anew.sum(axis=1) == 1).all()
    np.testing.assert_array_equal(state.submaps.scans[:, 0], 1 + info.match.accepted.sum(axis=1))
    assert info.match.accepted[info.match.tried].mean() > 0.99
    assert nees(info, truth)[0][:, 50:].mean() < 4.5


def test_a_known_map_is_matched_on_and_not_changed(matched):
    """Of other drives at their true poses, which lie within a wall's noise of it. Over 16 runs and some ten stretches
    of 0.6 m that depend little on each other, the mean of NEES has a standard deviation of sqrt(6 / 160).
    """
    truth, _, _ = matched
    matcher = dataclasses.replace(MATCHER, submap_scans=None, known_std=(0.01, 0.002))
    config = dataclasses.replace(CONFIG, matcher=matcher)
    shift = np.array([6.0, 6.0, 0.0])
    others, scans = (np.asarray(x)[8:, 4::20] for x in (truth, drives(RUNS)[1].ranges))

    @jax.jit
    def drawn(poses, scans):
        def add(lines, now):
            pose, ranges = now
            points = surface_points(ranges, 0.03, scanner=config.scanner(LOOP.beam_angles()), gap=0.8)
            return add_points(lines, pose, points, spec=matcher.spec), None

        return jax.lax.scan(add, jnp.zeros((*matcher.spec.shape, 6), poses.dtype), (poses, scans))[0]

    lines = drawn(jnp.asarray((others - shift).reshape(-1, 3)), jnp.asarray(scans.reshape(-1, scans.shape[2])))
    shifted = LOOP.prior().mean - jnp.asarray(shift)
    _, inputs = drives(RUNS)

    @jax.jit
    def localised(inputs):
        def one(inputs):
            state = init(Gaussian(shifted, jnp.diag(jnp.array([0.1, 0.1, 0.05]) ** 2)), config=config)
            state = state._replace(submaps=submaps.known(lines, matcher, shifted.dtype))
            return run(PARAMS, state, inputs, beam_angles=LOOP.beam_angles(), config=config)

        return jax.vmap(one)(inputs)

    state, info = jax.tree.map(np.asarray, localised(jax.tree.map(lambda x: x[:8], inputs)))
    np.testing.assert_array_equal(state.submaps.lines[0], lines)
    assert info.match.accepted[:, ::5].mean() > 0.99
    assert not info.match.anew.any()
    statistic, error = nees(info, np.asarray(truth)[:8] - shift)
    assert np.abs(error[:, 5:, :2]).max() < 0.08
    assert 0.8 < statistic[:, 5:].mean() < 4.5
    # The map errs by as much here as elsewhere: what a match tells of its error is forgotten along the way.
    of_map = np.sqrt(np.diagonal(state.belief.cov, axis1=1, axis2=2)[:, 6:9])
    assert np.all(of_map > 0.5 * np.array([0.01, 0.01, 0.002]))


def test_a_map_is_known_for_a_matcher_that_leaves_it():
    lines = np.zeros((*MATCHER.spec.shape, 6))
    with pytest.raises(ValueError, match=r"^matcher.known_std: expected the standard deviations"):
        submaps.known(lines, MATCHER, np.dtype(float))
    with pytest.raises(ValueError, match=r"^lines: expected shape"):
        submaps.known(lines[1:], dataclasses.replace(MATCHER, known_std=(0.01, 0.01)), np.dtype(float))


def test_a_run_in_pieces_is_one_run(matched, tolerance):
    """Of 72 steps each: matches are due at other steps of every piece."""
    _, whole, _ = matched
    one = jax.tree.map(lambda x: x[0], drives(RUNS)[1])

    @jax.jit
    def piece(state, inputs):
        return run(PARAMS, state, inputs, beam_angles=LOOP.beam_angles(), config=CONFIG, collect=lambda *_: None)[0]

    state = init(Gaussian(LOOP.prior().mean, jnp.zeros((3, 3))), config=CONFIG)
    for first in range(0, LOOP.steps, 72):
        state = piece(state, jax.tree.map(lambda x, first=first: x[first : first + 72], one))
    np.testing.assert_allclose(state.belief.mean, whole.belief.mean[0], rtol=0, atol=tolerance(1e-8, 1e-3))


# --- Settings ---


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"period": 0}, "period"),
        ({"period": 1.5}, "period"),
        ({"submap_scans": 1}, "submap_scans"),
        ({"gate_probability": 1.0}, "gate_probability"),
        ({"least_share": 0.0}, "least_share"),
        ({"half_width": 0.05}, "half_width"),
        ({"resolution": 0.0}, "resolution"),
        ({"range_std": 0.0}, "range_std"),
        ({"gap": np.inf}, "gap"),
        ({"submap_length": 0.0}, "submap_length"),
        ({"window": (0.5, 0.0)}, "window"),
        ({"window": (0.5,)}, "window"),
        ({"known_std": (0.01, 0.0)}, "known_std"),
    ],
)
def test_a_setting_out_of_range_is_named(wrong, name):
    with pytest.raises(ValueError, match=rf"Matcher\.{name}"):
        Matcher(**wrong)


def test_parameters_without_the_blocks_of_matching_are_refused():
    inputs = jax.tree.map(lambda x: x[0], drives(RUNS)[1])
    state = init(Gaussian(LOOP.prior().mean, jnp.zeros((3, 3))), config=CONFIG)
    with pytest.raises(ValueError, match=r"params\.match_std"):
        run(simulation.own_params(NOISE, LOOP), state, inputs, beam_angles=LOOP.beam_angles(), config=CONFIG)
