"""Filters that match scans, over simulated drives: the covariance holds, bad input is refused with its reason or the
step is flagged, and a study scores what `run` reports.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import Gaussian, init, poses, run, simulation
from jaxlocmap.consistency import match_scoring
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.matching import submaps
from jaxlocmap.matching.lines import add_points
from jaxlocmap.matching.normals import surface_points
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.types import Matcher

RUNS, STEPS = 8, 242
PIECE = STEPS // 2  # no match is due where the second piece begins
NOISE = simulation.Noise()
LOOP = dataclasses.replace(simulation.LOOP, steps=STEPS, exact_prior=True)
PERIOD, PATIENCE = 5, 10
MATCHER = Matcher(period=PERIOD, gap=0.8, half_width=9.0, steps=5, patience=PATIENCE)
CONFIG = dataclasses.replace(LOOP.config(motion="euler", grid=False), matcher=MATCHER)
PARAMS = submaps.with_defaults(simulation.own_params(NOISE, LOOP))
OWN = PARAMS.Q
ANGLES = np.asarray(LOOP.beam_angles())
LOST = np.arange(100, 140)  # steps at which scans are of no use
SILENT = np.arange(180, STEPS)  # steps at which the odometry tells of no motion
LATER = 75  # steps by which the scans of a robot are too late that somebody has carried: an eighth of a lap
CARRIED = 100  # the step from which on it is elsewhere
CALLED = CARRIED + PERIOD * (PATIENCE - 1)  # that of the refusal after which submaps begin anew
SLIPPING = NOISE._replace(v=0.2)  # m/s: wheels so bad that of the place along a corridor they tell little
KNOWN = Gaussian(LOOP.prior().mean, jnp.zeros((3, 3)))
CORRIDOR, FAST = (0.0, 60.0, 0.0), (0.0, 120.0, 0.0)  # where drives along corridors begin, far from the room

# The room, whose landmarks nobody sees from elsewhere, and two corridors. No end of them is in sight.
ROOM = simulation.room()
WALLS = [[(-40.0, y + side), (140.0, y + side)] for _, y, _ in (CORRIDOR, FAST) for side in (-1.2, 1.2)]
WORLD = ROOM._replace(segments=jnp.concatenate([ROOM.segments, jnp.array(WALLS)]))


def command(k, pose):
    """Round the room, or along the middle of the corridor that the robot is in: in the one at 0.4 m/s, in the other as
    fast as leads out of a submap's grid before the next submap begins.
    """
    middle, speed = (jnp.where(pose[1] < 90, a, b) for a, b in ((CORRIDOR[1], FAST[1]), (0.4, 3.0)))
    along = jnp.stack([speed.astype(pose.dtype), -pose[2] - 0.5 * (pose[1] - middle)])
    return jnp.where(pose[1] < 30, simulation.LOOP.command(k, pose), along)


@functools.cache
def every_drive():
    """Truth (T, 3) and inputs of drives as NumPy arrays: 2 RUNS in the room, four landmarks in sight now and then, RUNS
    along a corridor and RUNS along the other. One program. Keys and starts in the room are those of a study.
    """

    def one(key, start, noise):
        key = jax.random.split(jax.random.fold_in(jax.random.key(4), key))[1]
        truth, inputs = simulation.simulate(key, WORLD, noise, start, scenario=scenario)
        return truth.state, inputs

    scenario = dataclasses.replace(LOOP, steps=STEPS + LATER, command=command)
    starts = np.repeat([LOOP.start, LOOP.start, CORRIDOR, FAST], RUNS, axis=0)
    v = np.where(np.arange(4 * RUNS) >= 2 * RUNS, SLIPPING.v, NOISE.v)
    noise = NOISE._replace(v=jnp.asarray(v))
    drives = jax.jit(
        jax.vmap(one, in_axes=(0, 0, type(noise)(*[0 if name == "v" else None for name in noise._fields])))
    )
    return jax.tree.map(np.asarray, drives(jnp.arange(4 * RUNS), jnp.asarray(starts), noise))


def drive(first=0):
    """RUNS of them, longer by LATER than what is filtered."""
    return jax.tree.map(lambda x: x[first : first + RUNS], every_drive())


@functools.partial(jax.jit, static_argnames="config")
def begun(start, config=CONFIG):
    return jax.vmap(lambda start: init(Gaussian(start, jnp.zeros((3, 3))), config=config))(start)


@functools.partial(jax.jit, static_argnames="config")
def filtered(state, inputs, Q, config=CONFIG):
    """Many runs, each with a Q of its own."""

    def one(state, inputs, Q):
        scene = {"landmarks": ROOM.landmarks, "beam_angles": LOOP.beam_angles()}
        return run(PARAMS._replace(Q=Q), state, inputs, **scene, config=config)

    return jax.vmap(one)(state, inputs, Q)


def in_pieces(inputs, start, Q):
    """The last state and the reports of RUNS runs from a start that is known, in two pieces that share a program."""
    state, infos = begun(jnp.asarray(np.broadcast_to(np.asarray(start), (RUNS, 3)))), []
    Q = jnp.asarray(np.broadcast_to(np.asarray(Q), (RUNS, 2, 2)))
    for first in (0, PIECE):
        piece = jax.tree.map(lambda x, first=first: jnp.asarray(x[:, first : first + PIECE]), inputs)
        state, info = filtered(state, piece, Q)
        infos.append(jax.tree.map(np.asarray, info))
    return state, jax.tree.map(lambda *x: np.concatenate(x, axis=1), *infos)


def cut(x):
    return jax.tree.map(lambda x: x[:, :STEPS], x)


def nees(info, truth):
    error = np.asarray(truth) - np.asarray(info.belief.mean)[..., :3]
    error[..., 2] = poses.wrapped(error[..., 2])
    cov = np.asarray(info.belief.cov, float)[..., :3, :3] + 1e-12 * np.eye(3)
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(cov), error), error


# --- What may go wrong ---


def blinded():
    """For 40 steps the beams do not return, or give no number, or 9 of 61 return, or all read zero."""
    truth, inputs = cut(drive())
    ranges = inputs.ranges.copy()
    blind = np.stack([np.full(61, 8.0), np.full(61, np.nan), np.full(61, 8.0), np.zeros(61)] * 2)
    lost = np.broadcast_to(blind[:, None], ranges[:, LOST].shape).copy()
    lost[2::4, :, :9] = ranges[2::4, LOST, :9]
    ranges[:, LOST] = lost
    return truth, inputs._replace(ranges=ranges)


def behind_glass():
    """The walls at the right and at the top of the room are not seen in every other scan."""
    truth, inputs = cut(drive(RUNS))
    heading = truth[..., 2:] + ANGLES
    x, y = (truth[..., i, None] + inputs.ranges * turn(heading) for i, turn in ((0, np.cos), (1, np.sin)))
    glass = (np.maximum(x, y) > 11.7) & (np.random.default_rng(0).random((RUNS, STEPS, 1)) < 0.5)
    assert 0.1 < glass.mean() < 0.3
    return truth, inputs._replace(ranges=np.where(glass, 8.0, inputs.ranges))


def among_people():
    """Four discs of 0.4 m walk round the box the other way, at 0.12 m a step, and one meets the robot every 4 s."""
    truth, inputs = cut(drive())
    ranges = inputs.ranges
    for first in range(4):
        turn = 2 * np.pi * (np.arange(STEPS) / 200 + first / 4)
        person = np.stack([6 + 3.8 * np.cos(turn), 5.4 - 3.8 * np.sin(turn)], axis=-1)
        dx, dy = np.moveaxis(person - truth[..., :2], -1, 0)
        bearing = (np.arctan2(dy, dx) - truth[..., 2])[..., None] - ANGLES
        along, off = (np.hypot(dx, dy)[..., None] * part for part in (np.cos(bearing), np.sin(bearing)))
        near = along - np.sqrt(np.maximum(0.4**2 - off**2, 0))
        ranges = np.where((np.abs(off) < 0.4) & (near > 0), np.minimum(near, ranges), ranges)
    assert 0.05 < np.mean(ranges != inputs.ranges) < 0.3
    return truth, inputs._replace(ranges=ranges)


def kidnapped():
    """From step 100 on the scans are those of an eighth of a lap later."""
    truth, inputs = drive()
    ranges = np.concatenate([inputs.ranges[:, :CARRIED], inputs.ranges[:, CARRIED + LATER :]], axis=1)
    return cut(truth), cut(inputs)._replace(ranges=ranges)


SLIPPED = 36  # steps, 1.1 m, that the wheels do not tell of
CASES = {"refused": slice(0, 3), "before": slice(3, 6), "blind": slice(6, 7), "slipped": slice(7, 8)}


def several():
    """Three robots that are carried, which see nothing from the scan on that their patience would end with; the same,
    which see nothing once they are carried; one that never sees anything; and one that slips.
    """
    truth, inputs = cut(drive())
    carried, step = kidnapped()[1].ranges, np.arange(STEPS)[:, None]
    which = np.r_[:3, :3, 6:8]
    ranges = inputs.ranges.copy()
    for case, first in {"refused": CALLED, "before": CARRIED, "blind": 0}.items():
        ranges[CASES[case]] = np.where(step >= first, 8.0, carried[which[CASES[case]]])
    ranges[CASES["slipped"], CARRIED:] = drive()[1].ranges[7:8, CARRIED + SLIPPED : STEPS + SLIPPED]
    return truth[which], jax.tree.map(lambda x: x[which], inputs)._replace(ranges=ranges)


def silent(value):
    """The odometry reads zero, or nothing, while the robot drives on."""
    truth, inputs = cut(drive())
    control = inputs.control.copy()
    control[:, SILENT] = value
    return truth, inputs._replace(control=control)


def with_a_gap():
    """A robot that stands for a minute: step 101 is that long, at the place of the step before."""
    truth, inputs = drive()
    kept = np.r_[:101, 100 : STEPS - 1]
    truth, inputs = truth[:, kept], jax.tree.map(lambda x: x[:, kept], inputs)
    inputs.control[:, 101], inputs.dt[:, 101] = 0, 60
    return truth, inputs


def along_a_corridor(first):
    return cut(drive(first))


def as_it_was():
    """Without a fault."""
    return cut(drive())


def without_walls():
    """No beam returns."""
    truth, inputs = cut(drive())
    return truth, inputs._replace(ranges=np.full_like(inputs.ranges, 8.0))


ZERO_OR_NOTHING = np.where(np.arange(RUNS)[:, None, None] < 4, 0.0, np.nan)
SLIPS = simulation.own_params(SLIPPING, LOOP).Q
LOOSE = np.diag([1.0, 0.3]) ** 2  # of wheels that may slip by a metre a second
# How it is made, the start, Q, and whether landmarks are seen.
FAULTS = {
    "blinded": (blinded, LOOP.start, OWN, False),
    "glass": (behind_glass, LOOP.start, OWN, False),
    "people": (among_people, LOOP.start, OWN, False),
    "kidnapped": (kidnapped, LOOP.start, OWN, False),
    "silent or missing": (functools.partial(silent, ZERO_OR_NOTHING), LOOP.start, OWN, False),
    "silent, known to be": (functools.partial(silent, 0.0), LOOP.start, np.diag([0.4, 0.2]) ** 2, False),
    "gap": (with_a_gap, LOOP.start, OWN, False),
    "corridor": (functools.partial(along_a_corridor, 2 * RUNS), CORRIDOR, SLIPS, False),
    "beyond": (functools.partial(along_a_corridor, 3 * RUNS), FAST, SLIPS, False),
    "several": (several, LOOP.start, np.where(np.arange(RUNS)[:, None, None] == 7, LOOSE, OWN), False),
    "landmarks and matches": (as_it_was, LOOP.start, OWN, True),
    "matches": (as_it_was, LOOP.start, OWN, False),
    "landmarks": (without_walls, LOOP.start, OWN, True),
    "landmarks, matches refused": (kidnapped, LOOP.start, OWN, True),
}


@pytest.fixture(scope="module")
def faults():
    """By name: truth, inputs, state, info and refusals of RUNS runs. One program, fault by fault: all maps at once
    would not fit the processor's cache. Few of them are looked at.
    """
    made = {}
    for name, (make, start, Q, seen) in FAULTS.items():
        truth, inputs = make()
        inputs = inputs._replace(valid=inputs.valid & seen)
        state, info = in_pieces(inputs, start, Q)
        if name not in ("matches", "several"):
            state = state._replace(submaps=state.submaps._replace(lines=None))
        state = jax.tree.map(np.asarray, state)
        made[name] = truth, inputs, state, info, submaps.refusals(info.match, MATCHER)
    return made


def holds(info, truth, first=20):
    """Whether the mean of NEES over the runs is one in a million's or less, at matched steps, which depend on each
    other, and its average over time is about that of an honest filter.
    """
    statistic, _ = nees(info, truth)
    at = statistic[:, first::PERIOD].mean(axis=0)
    return at.max() < 3 + 5 * np.sqrt(6 / RUNS) and at.mean() < 3 + 3 * np.sqrt(6 / RUNS)


def test_scans_with_too_few_points_are_counted_and_the_covariance_grows(faults):
    truth, _, _, info, refused = faults["blinded"]
    due = np.isin(np.arange(STEPS), LOST[LOST % PERIOD == 0])
    np.testing.assert_array_equal(refused.points, np.broadcast_to(due, refused.points.shape))
    np.testing.assert_array_equal(info.match.due, np.broadcast_to(np.arange(STEPS) % PERIOD == 0, info.ok.shape))
    assert not info.match.tried[:, due].any()
    place = np.sqrt(info.belief.cov[..., 0, 0] + info.belief.cov[..., 1, 1])
    assert (np.diff(place[:, LOST]) > 0).all()
    assert info.match.accepted[:, LOST[-1] + 1 :: PERIOD].mean() > 0.9
    assert holds(info, truth)
    assert info.ok.all()


@pytest.mark.parametrize("name", ["glass", "people"])
def test_walls_seen_now_and_then_and_people_do_no_harm(faults, name):
    truth, _, _, info, refused = faults[name]
    assert info.match.accepted.sum() > 0.97 * info.match.tried.sum()
    assert refused.points.any() == (name == "glass")
    assert holds(info, truth)
    _, error = nees(info, truth)
    assert np.sqrt(np.mean(np.sum(error[:, -50:, :2] ** 2, axis=-1))) < 0.08


def test_a_kidnapped_robots_matches_have_a_reason_and_its_submaps_begin_anew(faults):
    _, _, _, info, refused = faults["kidnapped"]
    match = info.match
    any_reason = np.any(refused, axis=0)
    np.testing.assert_array_equal(match.accepted, match.tried & ~any_reason)
    assert any_reason[:, CARRIED:121:PERIOD].mean() > 0.9
    assert match.anew[:, CARRIED:].sum(axis=1).min() >= 1


@pytest.mark.parametrize(("name", "runs"), [("silent", slice(0, 4)), ("missing", slice(4, 8))])
def test_odometry_that_stops_without_a_word_is_refused_soon(faults, name, runs):
    """The matches contradict it. A control that is no number is flagged as well."""
    info, refused = (jax.tree.map(lambda x: x[runs], x) for x in faults["silent or missing"][3:])
    contradicted = refused.nis | refused.convergence
    assert contradicted[:, SILENT[0] : SILENT[0] + 4 * PERIOD].any(axis=1).all()
    assert not contradicted[:, : SILENT[0]].sum(axis=1).max() > 1
    assert (np.any(refused, axis=0)[:, SILENT[::PERIOD]].mean(axis=1) > 0.5).all()
    flagged = np.isin(np.arange(STEPS), SILENT) & (name == "missing")
    np.testing.assert_array_equal(info.ok, np.broadcast_to(~flagged, info.ok.shape))


def test_matches_alone_carry_a_robot_whose_odometry_is_known_to_be_worthless(faults):
    """Travel counts although no wheel tells of it."""
    truth, _, state, info, refused = faults["silent, known to be"]
    assert not np.any(refused, axis=0)[:, SILENT].any()
    assert holds(info, truth)
    _, error = nees(info, truth)
    assert np.hypot(*error[:, -1, :2].T).max() < 0.25
    path = np.hypot(*np.diff(truth[..., :2], axis=1).T).T + 0.5 * np.abs(np.diff(truth[..., 2], axis=1))
    begun = np.array([np.flatnonzero(one)[-1] for one in info.match.begun])
    assert begun.min() >= SILENT[0] + PERIOD
    expected = np.array([steps[first:].sum() for steps, first in zip(path, begun, strict=True)])
    np.testing.assert_allclose(state.submaps.length, expected, rtol=0.3)


def test_over_a_gap_in_time_the_covariance_grows_and_matches_go_on(faults):
    truth, _, _, info, _ = faults["gap"]
    heading = info.belief.cov[..., 2, 2].mean(axis=0)
    np.testing.assert_allclose(heading[101] - heading[100], OWN[1, 1] * LOOP.dt * 60, rtol=1e-3)
    assert heading[105] < 0.1 * heading[101]
    assert info.match.accepted[:, 100::PERIOD].mean() > 0.95
    assert info.ok.all()
    assert holds(info, truth)


def test_in_a_corridor_the_covariance_grows_along_it_and_not_across(faults):
    """Along it the odometry alone is left, whose variance grows by (0.2 m/s 0.1 s)² a step. Noisy normals tell of the
    place along it, but little. Across it and of the heading the matches tell all.
    """
    truth, _, _, info, refused = faults["corridor"]
    assert not np.any(refused, axis=0).any()
    variance = np.diagonal(info.belief.cov, axis1=-2, axis2=-1).mean(axis=0)
    odometry = (0.2 * LOOP.dt) ** 2 * (1 + np.arange(STEPS))
    share = variance[20::PERIOD, 0] / odometry[20::PERIOD]
    assert share.min() > 0.8
    assert share.max() < 1.05
    assert np.sqrt(variance[-1, 1]) < 0.08 < 0.25 < np.sqrt(variance[-1, 0])
    assert np.sqrt(variance[-1, 2]) < 0.02
    assert holds(info, truth)


def test_a_robot_beyond_its_submaps_grid_is_refused_and_no_surer_than_it_may_be(faults):
    """At 1.25 m a scan it is out of a grid that reaches 9 m before the submap is finished."""
    truth, _, _, info, refused = faults["beyond"]
    assert (refused.share.sum(axis=1) >= MATCHER.patience).all()
    assert (info.match.anew.sum(axis=1) >= 2).all()
    assert info.ok.all()
    assert holds(info, truth)


# --- Beside landmarks ---


def test_landmarks_and_matches_both_correct(faults):
    """Together they know the pose better than either does, and the covariance says so."""
    names = ("landmarks and matches", "matches", "landmarks")
    truth, infos = faults["matches"][0], {name: faults[name][3] for name in names}
    sigma = {name: np.sqrt(info.belief.cov[:, -50:, 0, 0].mean()) for name, info in infos.items()}
    assert sigma["landmarks and matches"] < 0.8 * min(sigma["matches"], sigma["landmarks"])
    for name, info in infos.items():
        assert holds(info, truth), name
        assert info.ok.all(), name
    accepted = infos["landmarks and matches"].match.accepted[:, PERIOD::PERIOD]
    assert accepted.mean() > 0.97


def test_matches_refused_leave_landmarks_to_correct(faults):
    truth, _, _, info, _ = faults["landmarks, matches refused"]
    until_anew = slice(CARRIED, CALLED)
    assert not info.match.accepted[:, until_anew].any()
    statistic, _ = nees(info, truth)
    assert statistic[:, until_anew].mean(axis=0).max() < 3 + 5 * np.sqrt(6 / RUNS)
    variance = info.belief.cov[:, until_anew, 0, 0].mean(axis=0)
    alone = faults["landmarks"][3].belief.cov[:, until_anew, 0, 0].mean(axis=0)
    assert (variance < 1.1 * alone).all()
    assert info.ok.all()


# --- Without a fault ---


@pytest.fixture(scope="module")
def odometry():
    """The beliefs of odometry alone, by NumPy."""
    inputs = cut(drive()[1])
    told = np.asarray(OWN, float)
    means, covs = np.zeros((RUNS, STEPS, 3)), np.zeros((RUNS, STEPS, 3, 3))
    for i in range(RUNS):
        mean, cov = np.array(LOOP.start), np.zeros((3, 3))
        for k in range(STEPS):
            control, dt = inputs.control[i, k].astype(float), float(inputs.dt[i, k])
            mean, cov = reference.predict(mean, cov, control, dt, told, "euler", LOOP.dt)
            means[i, k], covs[i, k] = mean, cov
    return Gaussian(means, covs)


def test_the_covariance_holds_and_the_pose_is_better_than_odometrys(faults, odometry):
    """Over 8 runs the mean of NEES at one moment, a sum of 8 chi-square of 3, is below 3 + 5 sqrt(6 / 8) but for one
    time in a million if the filter is consistent; at 47 moments that depend on each other, for one in ten thousand. A
    filter that takes matches for absolute measurements is beyond it by far.
    """
    truth, _, _, info, _ = faults["matches"]
    statistic, error = nees(info, truth)
    late = statistic[:, 10::PERIOD].mean(axis=0)
    assert late.max() < 3 + 5 * np.sqrt(6 / RUNS)
    assert 1.0 < statistic[:, 50:].mean() < 4.5

    def rmse(error):
        return np.sqrt(np.mean(np.sum(error[:, -50:, :2] ** 2, axis=-1)))

    assert rmse(error) < 0.4 * rmse(truth - odometry.mean)


def test_matches_are_due_every_period_and_reported(faults):
    _, _, state, info, _ = faults["matches"]
    tried = info.match.tried
    assert info.ok.all()
    assert not tried[:, 0].any()  # there the first submap begins
    assert tried[:, PERIOD::PERIOD].all()
    assert not np.delete(tried, np.s_[::PERIOD], axis=1).any()
    assert (info.match.accepted == tried).mean() > 0.999
    assert (info.match.used <= info.match.points).all()
    # The belief's own displacement by a match: below chi-square of 3, for what the scan does not tell is not displaced.
    assert info.match.nis[tried].mean() < 3 + 4 * np.sqrt(6 / tried.sum())
    assert (state.submaps.steps == STEPS).all()


def test_a_finished_submap_reports_where_the_next_anchor_is(faults):
    truth, _, _, info, _ = faults["matches"]
    matches, scans = -(-STEPS // PERIOD), MATCHER.submap_scans
    # A match that is refused puts a run's submaps off by one scan.
    every = (info.match.accepted == info.match.tried).all(axis=1)
    assert every.sum() >= RUNS - 2
    truth, info = truth[every], jax.tree.map(lambda x: x[every], info)
    moments = np.flatnonzero(info.match.finished[0])
    # The first two anchors lie at steps 0 and 50; the older is finished when the younger holds ten scans.
    np.testing.assert_array_equal(moments, PERIOD * np.arange(2 * scans, matches, scans))
    anchors = np.concatenate([[0], PERIOD * scans * np.arange(1, len(moments) + 1)])
    for moment, a, b in zip(moments, anchors[:-1], anchors[1:], strict=True):
        exact = poses.between(truth[:, a], truth[:, b])
        mean, cov = info.match.edge.mean[:, moment], info.match.edge.cov[:, moment]
        error = exact - mean
        assert np.abs(error).max() < 0.1
        statistic = np.einsum("ri,rij,rj->r", error, np.linalg.inv(cov), error)
        assert statistic.mean() < 3 + 5 * np.sqrt(6 / every.sum())
    assert not info.match.edge.mean[~info.match.finished].any()
    # Matched is on the submap after all that were finished before.
    before = np.cumsum(info.match.finished, axis=1) - info.match.finished
    np.testing.assert_array_equal(info.match.submap[:, PERIOD::PERIOD], before[:, PERIOD::PERIOD])


def test_a_submap_holds_the_scans_since_it_began_and_no_others(faults, tolerance):
    """Of each cell W is a sum over points, and that of one point's 16 cells is 4."""
    _, _, state, info, _ = faults["matches"]
    maps = state.submaps.lines.reshape(RUNS, 2, -1, 6)[..., 5].sum(axis=-1, dtype=float)
    for run_of in range(RUNS):
        older = state.submaps.older[run_of]
        added = (info.match.accepted | info.match.anew)[run_of]
        points = info.match.points[run_of, added]
        for slot, scans in zip((older, 1 - older), state.submaps.scans[run_of], strict=True):
            assert scans > 0
            assert maps[run_of, slot] == pytest.approx(4 * points[-scans:].sum(), rel=tolerance(1e-9, 1e-4))


# --- Carried away, blind or slipping ---


@pytest.fixture(scope="module")
def cases(faults):
    _, _, state, info, _ = faults["several"]
    return {case: jax.tree.map(lambda x, at=at: x[at], (state, info)) for case, at in CASES.items()}


def test_a_kidnapped_robot_is_refused_and_its_map_stays(cases):
    state, info = cases["refused"]
    accepted = info.match.accepted[:, CARRIED:CALLED:PERIOD]
    assert info.match.tried[:, CARRIED:CALLED:PERIOD].all()
    assert accepted.mean() < 0.2
    before, _ = cases["before"]
    held = ~accepted.any(axis=1)
    assert held.any()
    np.testing.assert_array_equal(state.submaps.lines[held], before.submaps.lines[held])


def test_after_so_many_refusals_the_submaps_begin_anew(faults):
    _, _, _, info, _ = faults["kidnapped"]
    accepted = info.match.accepted
    refused = ~accepted[:, CARRIED : CALLED + 1 : PERIOD].any(axis=1)  # all of its patience
    assert refused.any()
    assert accepted[refused][:, CALLED + PERIOD :: PERIOD].mean() > 0.9
    assert info.match.anew[refused, CALLED].all()


def test_scans_without_points_change_nothing_but_are_counted(cases, odometry):
    state, info = cases["blind"]
    belief = jax.tree.map(lambda x: x[6:7], odometry)
    np.testing.assert_allclose(info.belief.mean[..., :3], belief.mean, rtol=0, atol=1e-5)
    np.testing.assert_allclose(info.belief.cov[..., :3, :3], belief.cov, rtol=0, atol=1e-5)
    assert info.match.due[:, ::PERIOD].all()
    assert not info.match.tried.any()
    assert not state.submaps.lines.any()
    assert info.ok.all()


# --- Other matchers ---

SHORT, FEW = 160, 4


@pytest.fixture(scope="module")
def alone():
    """One map, and a window to search over: what is reported of drives, the last of which slips, and the last state."""
    matcher = dataclasses.replace(MATCHER, submap_scans=None, patience=1, window=(0.8, 0.4))
    config = dataclasses.replace(CONFIG, matcher=matcher)
    which = np.r_[:FEW, RUNS - 1]
    (_, inputs), (_, faulty) = cut(drive()), several()
    inputs = jax.tree.map(lambda x: x[which, :SHORT], inputs)
    ranges = np.concatenate([inputs.ranges[:FEW], faulty.ranges[CASES["slipped"], :SHORT]])
    inputs = inputs._replace(ranges=ranges, valid=np.zeros_like(inputs.valid))
    Q = np.stack([OWN] * FEW + [LOOSE])
    state = begun(jnp.tile(KNOWN.mean, (FEW + 1, 1)), config=config)
    return jax.tree.map(np.asarray, filtered(state, jax.tree.map(jnp.asarray, inputs), jnp.asarray(Q), config=config))


def test_with_a_window_a_robot_whose_odometry_slipped_is_found_again(cases, alone):
    """At step 100 the robot is a metre farther on than its wheels say. The first scans are refused, until the
    covariance has grown to allow it.
    """
    found = alone[1].match.accepted[-1, CARRIED::PERIOD]
    accepted = cases["slipped"][1].match.accepted[0, CARRIED::PERIOD]
    assert found[4:].all()
    assert not accepted[4:8].any()


def test_one_map_grows_and_no_submap_begins(alone):
    """The robot comes to where it was: what it knows of its pose since the start takes nothing from it."""
    state, info = jax.tree.map(lambda x: x[:FEW], alone)
    assert state.submaps.lines.shape == (FEW, *MATCHER.spec.shape, 6)
    assert not info.match.begun.any()
    assert not info.match.finished.any()
    assert (info.match.anew.sum(axis=1) == 1).all()
    np.testing.assert_array_equal(state.submaps.scans[:, 0], 1 + info.match.accepted.sum(axis=1))
    assert info.match.accepted[info.match.tried].mean() > 0.99
    assert nees(info, drive()[0][:FEW, :SHORT])[0][:, 50:].mean() < 4.5


def test_a_known_map_is_matched_on_and_not_changed():
    """Of other drives at their true poses, which lie within a wall's noise of it. Over 8 runs and some ten stretches
    of 0.6 m that depend little on each other, the mean of NEES has a standard deviation of sqrt(6 / 80).
    """
    matcher = dataclasses.replace(MATCHER, half_width=11.0, submap_scans=None, known_std=(0.01, 0.002))
    config = dataclasses.replace(CONFIG, matcher=matcher)
    shift = np.array([6.0, 6.0, 0.0])
    others, scans = (x[:, 4::20] for x in (lambda truth, inputs: (truth, inputs.ranges))(*drive(RUNS)))
    truth, inputs = cut(drive())

    @jax.jit
    def drawn(poses, scans):
        def add(lines, now):
            pose, ranges = now
            points = surface_points(ranges, 0.03, scanner=config.scanner(LOOP.beam_angles()), gap=0.8)
            return add_points(lines, pose, points, spec=matcher.spec), None

        return jax.lax.scan(add, jnp.zeros((*matcher.spec.shape, 6), poses.dtype), (poses, scans))[0]

    lines = drawn(jnp.asarray((others - shift).reshape(-1, 3)), jnp.asarray(scans.reshape(-1, scans.shape[2])))
    shifted = KNOWN.mean - jnp.asarray(shift)

    @jax.jit
    def localised(inputs):
        def one(inputs):
            state = init(Gaussian(shifted, jnp.diag(jnp.array([0.1, 0.1, 0.05]) ** 2)), config=config)
            state = state._replace(submaps=submaps.known(lines, matcher, shifted.dtype))
            return run(PARAMS, state, inputs, beam_angles=LOOP.beam_angles(), config=config)

        return jax.vmap(one)(inputs)

    nothing = (inputs.landmark[..., :0], inputs.z[..., :0, :], inputs.valid[..., :0])
    inputs = inputs._replace(landmark=nothing[0], z=nothing[1], valid=nothing[2])
    state, info = jax.tree.map(np.asarray, localised(jax.tree.map(jnp.asarray, inputs)))
    np.testing.assert_array_equal(state.submaps.lines[0], lines)
    assert info.match.accepted[:, ::PERIOD].mean() > 0.99
    assert not info.match.anew.any()
    statistic, error = nees(info, truth - shift)
    assert np.abs(error[:, 5:, :2]).max() < 0.08
    assert 0.8 < statistic[:, 5:].mean() < 4.5
    # The map errs by as much here as elsewhere: what a match tells of its error is forgotten along the way.
    of_map = np.sqrt(np.diagonal(state.belief.cov, axis1=1, axis2=2)[:, 6:9])
    assert np.all(of_map > 0.5 * np.array([0.01, 0.01, 0.002]))


def test_parameters_without_the_blocks_of_matching_are_refused():
    inputs = jax.tree.map(lambda x: x[0], cut(drive()[1]))
    scene = {"landmarks": ROOM.landmarks, "beam_angles": LOOP.beam_angles()}
    with pytest.raises(ValueError, match=r"params\.match_std"):
        # Where it is traced; otherwise a state would be made, piece by piece.
        jax.eval_shape(
            lambda prior: run(
                simulation.own_params(NOISE, LOOP), init(prior, config=CONFIG), inputs, **scene, config=CONFIG
            ),
            KNOWN,
        )


# --- Scored in a study ---

SCORED = 4  # of the runs of `matches`


@pytest.fixture(scope="module")
def totals():
    """Of the first drives of `matches`, simulated anew and filtered in one loop."""
    world = ROOM._replace(landmarks=jnp.zeros((0, 2)))
    study = Study(LOOP, CONFIG)
    return monte_carlo(study, jax.random.key(4), SCORED, PARAMS, world, NOISE, KNOWN, chunk=SCORED).value


def test_runs_in_pieces_are_those_of_a_study_in_one(faults, totals, tolerance):
    """Step by step; at first the covariance is singular and not scored."""
    truth, _, _, info, _ = jax.tree.map(lambda x: x[:SCORED], faults["matches"])
    error = truth - info.belief.mean[..., :3]
    error[..., 2] = poses.wrapped(error[..., 2])
    cov = info.belief.cov[..., :3, :3].astype(float)
    late = slice(20, None)
    expected = np.einsum("rti,rti->rt", error[:, late], np.linalg.solve(cov[:, late], error[:, late, :, None])[..., 0])
    np.testing.assert_array_equal(totals.scored[late], SCORED)
    np.testing.assert_allclose(totals.nees[late], expected.sum(axis=0), rtol=tolerance(1e-6, 5e-2))


def in_frame_of(a, b):
    c, s = np.cos(a[2]), np.sin(a[2])
    x, y = np.array([[c, s], [-s, c]]) @ (b - a)[:2]
    return np.array([x, y, (b - a)[2]])


def test_a_study_scores_what_run_reports(faults, totals, tolerance):
    """Drive by drive, against NumPy."""
    truth, _, _, info, _ = jax.tree.map(lambda x: x[:SCORED], faults["matches"])
    match = info.match
    nees = {"relative": [[] for _ in range(SCORED)], "edge": [[] for _ in range(SCORED)]}
    for r in range(SCORED):
        older = younger = None
        for k in range(STEPS):
            pose = truth[r, k]
            pairs = []
            if match.tried[r, k]:
                pairs.append(("relative", older, pose, match.relative))
            if match.finished[r, k]:
                pairs.append(("edge", older, younger, match.edge))
                older = younger
            for name, a, b, belief in pairs:
                error = in_frame_of(a, b) - belief.mean[r, k]
                error[2] = (error[2] + np.pi) % (2 * np.pi) - np.pi
                nees[name][r].append(error @ np.linalg.solve(belief.cov[r, k].astype(float), error))
            older = pose if match.anew[r, k] else older
            younger = pose if match.begun[r, k] else younger
    sums = totals.match.sums
    assert float(sums.tried) == match.tried.sum() == SCORED * 48
    assert float(sums.accepted) == match.accepted.sum()
    for reason, counted in submaps.refusals(match, MATCHER)._asdict().items():
        assert float(getattr(sums.refused, reason)) == counted.sum()
    assert float(sums.edge.scored) == match.finished.sum() > 0
    np.testing.assert_allclose(sums.nis, match.nis.sum(), rtol=tolerance(1e-7, 1e-2))
    for i, (name, one) in enumerate((("relative", sums.pose), ("edge", sums.edge))):
        np.testing.assert_allclose(one.nees, sum(map(sum, nees[name])), rtol=tolerance(1e-6, 5e-2))
        averages = np.array([np.mean(x) for x in nees[name]])
        np.testing.assert_allclose(totals.match.nees[i], averages.sum(), rtol=tolerance(1e-6, 5e-2))
        np.testing.assert_allclose(totals.match.nees_square[i], (averages**2).sum(), rtol=tolerance(1e-6, 1e-1))
        assert totals.match.runs[i] == SCORED


def test_a_report_names_what_matches_tell(totals):
    report = summarise(totals, CONFIG)
    assert report["matches"] == SCORED * 48
    assert 0.9 < report["match_accept_rate"] <= 1
    assert 0.8 < report["match_points_used"] <= 1
    assert report["submaps_begun_anew"] == 0
    counts = np.arange(1.0, 5.0)
    refused = totals._replace(
        match=totals.match._replace(sums=totals.match.sums._replace(refused=submaps.Refusals(*counts)))
    )
    names = ("points", "share", "nis", "convergence")
    assert [summarise(refused, CONFIG)[f"match_refused_{name}"] for name in names] == [1, 2, 3, 4]
    assert report["relative_count"] == report["matches"]
    assert report["edge_count"] == SCORED * 3
    for name in ("relative", "edge"):
        assert report[f"{name}_anees"] < 9
        assert 0 < report[f"{name}_rmse_position_m"] < 0.1
        assert 0.2 < report[f"{name}_sigma_position_m"] / report[f"{name}_rmse_position_m"] < 5
    assert "matches" not in summarise(totals._replace(match=None), CONFIG)


score_match = jax.jit(match_scoring.score_match, static_argnums=3)


def test_errors_and_anchors_of_one_step():
    """An error of (3, 4) cm in the frame of an anchor turned by 90 degrees, with a variance of 1 cm² each."""
    older, younger, truth = jnp.array([1.0, 2.0, np.pi / 2]), jnp.array([1.0, 3.0, 0.0]), jnp.array([0.0, 4.0, np.pi])
    belief = Gaussian(jnp.array([2.0 - 0.03, 1.0 - 0.04, np.pi / 2]), jnp.asarray(1e-4 * np.eye(3)))
    none = submaps.no_match(truth.dtype)
    report = none._replace(
        tried=jnp.array(True), accepted=jnp.array(True), points=jnp.array(20), used=jnp.array(15), relative=belief
    )
    tally, anchors = score_match(report, truth, (older, younger), MATCHER)
    np.testing.assert_allclose(tally.pose.nees, 25, rtol=1e-4)
    np.testing.assert_allclose(tally.pose.error_square, [9e-4, 16e-4, 0], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(tally.used, 0.75)
    assert tally.edge.scored == 0
    np.testing.assert_array_equal(anchors, (older, younger))
    _, anchors = score_match(report._replace(begun=jnp.array(True)), truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (older, truth))
    swap = report._replace(begun=jnp.array(True), finished=jnp.array(True), edge=belief)
    tally, anchors = score_match(swap, truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (younger, truth))
    assert tally.edge.scored == 1
    again = none._replace(anew=jnp.array(True), submap=jnp.array(3))
    tally, anchors = score_match(again, truth, (older, younger), MATCHER)
    np.testing.assert_array_equal(anchors, (truth, younger))
    assert tally.anew == 1
    assert tally.tried == tally.pose.scored == 0
    few = none._replace(due=jnp.array(True), points=jnp.array(MATCHER.least_points - 1))
    refused = score_match(few, truth, (older, younger), MATCHER)[0].refused
    assert [float(count) for count in refused] == [1, 0, 0, 0]
    first = again._replace(submap=jnp.array(-1))
    assert score_match(first, truth, (older, younger), MATCHER)[0].anew == 0
