"""Bad input to scan matching: what is refused has its reason, and the covariance holds or the step is flagged."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_submaps import CONFIG, LOOP, NOISE, PARAMS, nees

from jaxlocmap import Gaussian, init, run, simulation
from jaxlocmap.matching import submaps

RUNS, STEPS = 8, 240
MATCHER = dataclasses.replace(CONFIG.matcher, patience=5, half_width=9.0)
CONFIG = dataclasses.replace(CONFIG, matcher=MATCHER)
PERIOD = MATCHER.period
ANGLES = np.asarray(LOOP.beam_angles())
LOST = np.arange(100, 140)  # steps at which scans are of no use
SILENT = np.arange(180, 240)  # steps at which the odometry tells of no motion
LATER = 75  # steps by which the scans of a robot are too late that somebody has carried: an eighth of a lap
CORRIDOR = dataclasses.replace(
    LOOP,
    steps=STEPS,
    start=(0.0, 0.0, 0.0),
    command=lambda k, pose: jnp.stack([jnp.asarray(0.4, pose.dtype), -pose[2] - 0.5 * pose[1]]),
)
SLIPPING = NOISE._replace(v=0.2)  # m/s: wheels so bad that of the place along a corridor they tell little
WALLS = simulation.World(
    segments=jnp.array([[(-40.0, side), (80.0, side)] for side in (-1.2, 1.2)]),
    landmarks=simulation.room().landmarks,  # as many as elsewhere, which nobody sees
)


@functools.partial(jax.jit, static_argnames="config")
def filtered(inputs, start, Q, config=CONFIG):
    """Many runs, each with a start that is known and a Q of its own. Of the maps nothing is kept."""

    def one(inputs, start, Q):
        state = init(Gaussian(start, jnp.zeros((3, 3))), config=config)
        params = PARAMS._replace(Q=Q)
        scene = {"landmarks": simulation.room().landmarks, "beam_angles": LOOP.beam_angles()}
        state, info = run(params, state, inputs, **scene, config=config)
        return state._replace(submaps=state.submaps._replace(lines=None)), info

    return jax.vmap(one)(inputs, start, Q)


def everywhere(inputs, start, Q):
    """Inputs of runs, and of each the same start and Q."""
    return jax.tree.map(jnp.asarray, (inputs, np.tile(np.asarray(start), (RUNS, 1)), np.tile(Q, (RUNS, 1, 1))))


@functools.cache
def drive():
    """Truth (RUNS, T, 3) and inputs of drives in the room, four landmarks in sight now and then, as NumPy arrays."""

    def one(key):
        truth, inputs = simulation.simulate(key, simulation.room(), NOISE, jnp.asarray(LOOP.start), scenario=scenario)
        return truth.state, inputs

    scenario = dataclasses.replace(LOOP, steps=STEPS + LATER)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(4), RUNS)))


def cut(x):
    return jax.tree.map(lambda x: x[:, :STEPS], x)


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
    truth, inputs = cut(drive())
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
    ranges = np.concatenate([inputs.ranges[:, :100], inputs.ranges[:, 100 + LATER :]], axis=1)
    return cut(truth), cut(inputs)._replace(ranges=ranges)


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


def along_a_corridor():
    """No end of it is in sight."""

    def one(key):
        start = jnp.asarray(CORRIDOR.start)
        truth, inputs = simulation.simulate(key, WALLS, SLIPPING, start, scenario=CORRIDOR)
        return truth.state, inputs

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(3), RUNS)))


def as_it_was():
    """Without a fault."""
    return cut(drive())


def without_walls():
    """No beam returns."""
    truth, inputs = cut(drive())
    return truth, inputs._replace(ranges=np.full_like(inputs.ranges, 8.0))


OWN = simulation.own_params(NOISE, LOOP).Q
# How it is made, the start, Q, and whether landmarks are seen.
FAULTS = {
    "blinded": (blinded, LOOP.start, OWN, False),
    "glass": (behind_glass, LOOP.start, OWN, False),
    "people": (among_people, LOOP.start, OWN, False),
    "kidnapped": (kidnapped, LOOP.start, OWN, False),
    "silent": (functools.partial(silent, 0.0), LOOP.start, OWN, False),
    "missing": (functools.partial(silent, np.nan), LOOP.start, OWN, False),
    "silent, known to be": (functools.partial(silent, 0.0), LOOP.start, np.diag([0.4, 0.2]) ** 2, False),
    "gap": (with_a_gap, LOOP.start, OWN, False),
    "corridor": (along_a_corridor, CORRIDOR.start, simulation.own_params(SLIPPING, CORRIDOR).Q, False),
    "landmarks and matches": (as_it_was, LOOP.start, OWN, True),
    "matches": (as_it_was, LOOP.start, OWN, False),
    "landmarks": (without_walls, LOOP.start, OWN, True),
    "landmarks, matches refused": (kidnapped, LOOP.start, OWN, True),
}


@pytest.fixture(scope="module")
def faults():
    """By name: truth, inputs, state, info and refusals of RUNS runs. One program, fault by fault: all maps at once
    would not fit the processor's cache.
    """
    made = {}
    for name, (make, start, Q, seen) in FAULTS.items():
        truth, inputs = make()
        inputs = inputs._replace(valid=inputs.valid & seen)
        state, info = jax.tree.map(np.asarray, filtered(*everywhere(inputs, start, Q)))
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
    assert any_reason[:, 100:121:PERIOD].mean() > 0.9
    assert match.anew[:, 100:].sum(axis=1).min() >= 1


@pytest.mark.parametrize("name", ["silent", "missing"])
def test_odometry_that_stops_without_a_word_is_refused_soon(faults, name):
    """The matches contradict it. A control that is no number is flagged as well."""
    _, _, _, info, refused = faults[name]
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


def test_a_robot_beyond_its_submaps_grid_is_refused_and_no_surer_than_it_may_be():
    """Of a grid that reaches 5 m the scans, which reach 8 m, see little and the drive soon leads out."""
    truth, inputs = cut(drive())
    inputs = inputs._replace(valid=np.zeros_like(inputs.valid))
    config = dataclasses.replace(CONFIG, matcher=dataclasses.replace(MATCHER, half_width=5.0))
    _, info = jax.tree.map(np.asarray, filtered(*everywhere(inputs, LOOP.start, OWN), config=config))
    refused = submaps.refusals(info.match, config.matcher)
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
    until_anew = slice(100, 100 + PERIOD * (MATCHER.patience - 1))
    assert not info.match.accepted[:, until_anew].any()
    statistic, _ = nees(info, truth)
    assert statistic[:, until_anew].mean(axis=0).max() < 3 + 5 * np.sqrt(6 / RUNS)
    variance = info.belief.cov[:, until_anew, 0, 0].mean(axis=0)
    alone = faults["landmarks"][3].belief.cov[:, until_anew, 0, 0].mean(axis=0)
    assert (variance < 1.1 * alone).all()
    assert info.ok.all()
