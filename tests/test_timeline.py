"""Pauses, clocks that differ and stamps that fold: what becomes of time between the streams of a log."""

import dataclasses
import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Config, Gaussian, Params, init, logs, run
from jaxlocmap.logs import timeline
from jaxlocmap.replay.landmarks import first_pose


def log_of(odometry, observations=(), truth=(), scans=()):
    """Stamps with a command each, stamps at which landmark 0 is seen, stamps of truth, stamps of scans."""
    odometry = np.array(odometry, float).reshape(-1, 3)
    return logs.Log(
        name="made",
        landmarks=np.zeros((1, 2)),
        odometry_time=odometry[:, 0],
        odometry=odometry[:, 1:],
        observation_time=np.array(observations, float),
        observation_landmark=np.zeros(len(observations), np.int32),
        observation=np.ones((len(observations), 2)),
        scan_time=np.array(scans, float),
        scan=np.ones((len(scans), 1)),
        beam_angles=np.zeros(1),
        truth_time=np.array(truth, float),
        truth=np.zeros((len(truth), 3)),
    )


DRIVE = [(0.0, 1.0, 0.1), (0.5, 1.1, 0.2), (1.0, 1.2, 0.3), (9.0, 1.3, 0.4), (9.5, 1.4, 0.5)]


def test_in_a_gap_the_command_holds_for_a_period_and_then_the_robot_stands():
    time, inputs, _, _, counts = logs.to_timeline(log_of(DRIVE, observations=[1.25, 4.0, 9.25]))
    np.testing.assert_array_equal(time, [0, 0.5, 1, 1.25, 1.5, 4, 9, 9.25, 9.5])
    np.testing.assert_array_equal(inputs.control[1:, 0], [1.0, 1.1, 1.2, 1.2, 0, 0, 1.3, 1.3])
    np.testing.assert_array_equal(inputs.control[1:, 1], [0.1, 0.2, 0.3, 0.3, 0, 0, 0.4, 0.4])
    np.testing.assert_array_equal(inputs.dt, np.diff(time, prepend=0.0))
    np.testing.assert_array_equal(inputs.valid[:, 0], [0, 0, 0, 1, 0, 1, 0, 1, 0])
    assert (counts["odometry_gaps"], counts["odometry_gap_seconds"]) == (1, 7.5)


def test_after_the_last_command_the_robot_stands_too():
    time, inputs, _, _, counts = logs.to_timeline(log_of(DRIVE[:3], observations=[1.25, 4.0], scans=[5.0]))
    np.testing.assert_array_equal(time, [0, 0.5, 1, 1.25, 1.5, 4, 5])
    np.testing.assert_array_equal(inputs.control[1:, 0], [1.0, 1.1, 1.2, 1.2, 0, 0])
    assert (counts["odometry_gaps"], counts["odometry_gap_seconds"]) == (1, 3.5)


@pytest.mark.parametrize("max_gap", [8.0, math.inf])
def test_up_to_the_limit_a_command_holds(max_gap):
    time, inputs, _, _, counts = logs.to_timeline(log_of(DRIVE, observations=[4.0]), max_gap=max_gap)
    np.testing.assert_array_equal(time, [0, 0.5, 1, 4, 9, 9.5])
    np.testing.assert_array_equal(inputs.control[1:, 0], [1.0, 1.1, 1.2, 1.2, 1.3])
    assert (counts["odometry_gaps"], counts["odometry_gap_seconds"]) == (0, 0)


@pytest.mark.parametrize(
    ("start", "stop", "time", "speeds", "seconds"),
    [
        (1.1, 6.0, [1.25, 1.5, 4], [1.2, 0], 2.5),
        (2.0, None, [4, 9, 9.25, 9.5], [0, 1.3, 1.3], 5),
        (None, 1.4, [0, 0.5, 1, 1.25], [1, 1.1, 1.2], 0),
        (9.0, None, [9, 9.25, 9.5], [1.3, 1.3], 0),
        (4.0, 4.0, [4], [], 0),
    ],
)
def test_only_the_gaps_between_start_and_stop_count(start, stop, time, speeds, seconds):
    log = log_of(DRIVE, observations=[1.25, 4.0, 9.25])
    timeline = logs.to_timeline(log, start=start, stop=stop)
    np.testing.assert_array_equal(timeline.time, time)
    np.testing.assert_array_equal(timeline.inputs.control[1:, 0], speeds)
    assert timeline.counts["odometry_gap_seconds"] == seconds
    assert timeline.counts["odometry_gaps"] == (seconds > 0)


def test_odometry_slower_than_the_limit_is_refused():
    slow = log_of([(2 * t, 1, 0) for t in range(5)])
    with pytest.raises(ValueError, match=r"made: odometry: expected stamps at most max_gap = 1.5 s .* 2.000 s apart"):
        logs.to_timeline(slow)
    assert logs.to_timeline(slow, max_gap=2).counts["odometry_gaps"] == 0


def test_one_command_holds_as_long_as_the_limit():
    time, inputs, _, _, counts = logs.to_timeline(log_of([(0, 1, 0)], observations=[1, 5]), max_gap=2)
    np.testing.assert_array_equal(time, [0, 1, 2, 5])
    np.testing.assert_array_equal(inputs.control[1:, 0], [1, 1, 0])
    assert counts["odometry_gap_seconds"] == 3


def test_gaps_of_the_truth_count_where_steps_lie_in_them():
    log = log_of([(t / 4, 0, 0) for t in range(40)], truth=[1, 2, 5, 6, 6.1, 8, 9.6, 12])
    timeline = logs.to_timeline(log)
    # From 2 to 5, 6.1 to 8, 8 to 9.6; of the last only the part before 9.75, where the steps end, has steps.
    assert timeline.counts["truth_gaps"] == 4
    assert logs.to_timeline(log, max_gap=2).counts["truth_gaps"] == 2
    assert logs.to_timeline(log, start=7.9, stop=9.5).counts["truth_gaps"] == 1
    known = {t for t in timeline.time if 1 <= t <= 2 or 5 <= t <= 6.1 or t == 8}
    assert set(timeline.time[timeline.truth_valid]) == known


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ([5000, 5001], "truth from 5000.000 to 5001.000 s, odometry from 0.000 to 9.500 s"),
        ([-0.1, -5], "truth from -5.000 to -0.100 s, odometry from"),
        ([9.6], "truth from 9.600 to 9.600 s"),
    ],
)
def test_clocks_that_differ_are_told_with_both_spans(truth, said):
    with pytest.raises(ValueError, match=f"made: truth and odometry: no overlap in time: {said}"):
        logs.to_timeline(log_of(DRIVE, truth=truth), start=min(truth))


def test_streams_that_touch_overlap():
    assert logs.to_timeline(log_of(DRIVE, truth=[9.5, 12])).truth_valid.sum() == 1
    assert logs.to_timeline(log_of(DRIVE, truth=[-1, 0])).truth_valid.sum() == 1


# --- Many observations at one stamp ---


def crowd(seen):
    """So many observations at each stamp, of ranges 1, 2, 3 ... in order, and a scan and truth at every stamp."""
    stamps = np.arange(len(seen), dtype=float)
    log = log_of([(t, 1 + t, 0) for t in stamps], np.repeat(stamps, seen), truth=stamps, scans=stamps)
    observation = np.column_stack([1 + np.arange(sum(seen)), np.zeros(sum(seen))])
    return dataclasses.replace(log, observation=observation.astype(float))


def test_a_crowd_at_one_stamp_takes_several_steps_of_no_length_and_little_memory():
    seen = [0, 1, 2, 3000, 0, 1, *[0] * 2000]
    log = crowd(seen)
    timeline = logs.to_timeline(log)
    time, inputs = timeline.time, timeline.inputs
    assert inputs.z.nbytes < 200_000  # a table with 3,000 slots would be of 96 MB
    # What is there is what was there, in order; what a stamp sees comes before anything moves on.
    assert (inputs.dt.sum(), inputs.dt.min(), inputs.dt[0]) == (len(seen) - 1, 0, 0)
    np.testing.assert_array_equal(np.cumsum(inputs.dt), time)
    np.testing.assert_array_equal(inputs.z[inputs.valid][:, 0], 1 + np.arange(sum(seen)))
    step, _ = np.nonzero(inputs.valid)
    np.testing.assert_array_equal(time[step], log.observation_time)
    moves = inputs.dt > 0
    np.testing.assert_array_equal(inputs.control[moves, 0], 1 + np.arange(len(seen) - 1))
    # The scan and the truth belong to the pose that has seen all.
    last = np.append(np.diff(time) > 0, True)
    np.testing.assert_array_equal(np.isfinite(inputs.ranges[:, 0]), last)
    np.testing.assert_array_equal(timeline.truth_valid, last)
    np.testing.assert_array_equal(np.isfinite(timeline.truth[:, 0]), last)
    assert timeline.counts["truth_gaps"] == 0


def test_several_steps_of_a_stamp_give_the_belief_of_one(monkeypatch):
    log = crowd([0] * 200 + [40] + [0] * 200)
    log = dataclasses.replace(log, landmarks=np.array([[3.0, 2.0]]), observation=log.observation * [0.1, 0] + [1, 0.5])
    config, params = Config(dt=1.0), Params.from_std(v=0.1, w=0.1, range=0.5, bearing=0.5)
    prior = Gaussian(jnp.zeros(3), jnp.eye(3) * 0.1)

    def believed():
        inputs = logs.to_timeline(log).inputs._replace(ranges=None)
        inputs = jax.tree.map(lambda x: jnp.asarray(x, jnp.int32 if x.dtype == np.int32 else None), inputs)
        landmarks = jnp.asarray(log.landmarks)
        state, _ = jax.jit(
            lambda: run(params, init(prior, config=config), inputs, landmarks=landmarks, config=config)
        )()
        return inputs.valid.shape, state.belief

    (steps, slots), belief = believed()
    assert (steps, slots) == (440, 1)
    monkeypatch.setattr(timeline, "_WORTH", math.inf)
    shape, expected = believed()
    assert shape == (401, 40)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4 if x.dtype == jnp.float32 else 1e-11), belief, expected
    )


@pytest.mark.parametrize("seen", [[0, 3, 5, 1] * 9, [40] * 5, [0] * 30 + [7]])
def test_a_table_that_is_well_used_keeps_a_step_for_every_stamp(seen):
    timeline = logs.to_timeline(crowd(seen))
    assert timeline.inputs.valid.shape == (len(seen), max(seen))
    np.testing.assert_array_equal(timeline.inputs.z[timeline.inputs.valid][:, 0], 1 + np.arange(sum(seen)))
    assert np.all(np.diff(timeline.time) > 0)


def test_a_log_that_starts_in_a_crowd_starts_at_its_truth():
    timeline = logs.to_timeline(crowd([4000, *[0] * 2000]))
    np.testing.assert_array_equal(first_pose(crowd([1]), timeline), np.zeros(3))


def test_what_lies_before_is_told_from_what_lies_after_and_a_stamp_at_the_limit_is_neither():
    seen, scans = [-2.0, -1.0, 0.5, 1.0, 1.25, 1.4], [-3.0, 0.25, 0.75, 1.25, 1.3]
    log = log_of(DRIVE[:3], observations=seen, scans=scans)
    timeline = logs.to_timeline(log, start=0.5, stop=1.25)
    np.testing.assert_array_equal(timeline.time, [0.5, 0.75, 1, 1.25])
    np.testing.assert_array_equal(timeline.inputs.valid[:, 0], [1, 0, 1, 1])
    np.testing.assert_array_equal(np.isfinite(timeline.inputs.ranges[:, 0]), [0, 1, 0, 1])
    names = ("before_odometry", "before_start", "after_stop")
    assert [timeline.counts[name] for name in names] == [3, 1, 2]
    # Before the first command there is no step, whatever the start.
    early = logs.to_timeline(log, start=-5.0)
    assert early.time[0] == 0
    assert [early.counts[name] for name in names] == [3, 0, 0]


def test_stamps_that_go_back_count_in_every_stream():
    log = log_of(
        [DRIVE[0], DRIVE[2], DRIVE[1]], observations=[1, 0.5, 0.25], scans=[4, 3, 2, 1], truth=[1, 0, 1, 0, 1, 0]
    )
    counts = logs.to_timeline(log, max_gap=9.0).counts
    assert (counts["backward_stamps"], counts["backward_truth"]) == (1 + 2 + 3, 3)


# --- Small logs on disk ---


@pytest.fixture(scope="module")
def programs():
    from jaxlocmap.cli import localize

    return localize


@pytest.fixture(scope="module")
def localized(tmp_path_factory, programs):
    """Runs the program on a case, in this process, and keeps its report."""
    root = os.environ.get("JAXLOCMAP_DATA")
    if not root:
        pytest.skip("JAXLOCMAP_DATA does not name a folder with the real logs")

    def report(case, **settings):
        folder = Path(root).parent / "cases" / case
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            out = tmp_path_factory.mktemp("out")
            return programs.main(programs.LocalizeConfig(folder, "mrclam", robot=1, out=out, **settings))

    return report


def test_a_pause_of_ten_seconds_costs_nothing(localized):
    plain, paused = localized("mrclam_nogap"), localized("mrclam_gap10")
    assert abs(plain["rmse_position_m"] - 0.063) < 5e-4
    assert abs(paused["rmse_position_m"] - 0.063) < 5e-4
    assert (paused["counts"]["odometry_gaps"], paused["counts"]["odometry_gap_seconds"]) == (1, 10)
    assert plain["counts"]["odometry_gaps"] == plain["counts"]["truth_gaps"] == 0
    assert localized("mrclam_gap10", max_gap=20.0)["rmse_position_m"] > 1


def test_a_truth_clock_that_is_off(localized):
    with pytest.raises(ValueError, match=r"no overlap in time: truth from 1248005000.000 .* odometry from 1248000000"):
        localized("mrclam_clock_off")
    with pytest.raises(ValueError, match="no overlap in time"):
        localized("mrclam_clock_off", start=(0.0, 0.0, 0.0))


def test_too_little_truth_is_counted(localized, capsys):
    assert localized("mrclam_truth_3_steps")["counts"]["duplicate_truth"] == 0
    capsys.readouterr()
    assert localized("mrclam_truth_7_digits")["counts"]["duplicate_truth"] == 1199
    assert "1,199 of 1,200 stamps of the truth repeat another" in capsys.readouterr().out
