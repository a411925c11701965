"""The localising program on made-up logs: what it believes, starts from, filters, judges, writes and says."""

import contextlib
import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import reference
from programs import Enough, Recorder

from jaxlocmap import Config, Info, Inputs, Params
from jaxlocmap.cli import localize
from jaxlocmap.filters import ekf
from jaxlocmap.logs import Log, Timeline, read_trajectory
from jaxlocmap.replay import landmarks as replay

pytestmark = pytest.mark.usefixtures("as_a_program")
OFFSET = (0.2, 0.1, 0.3)


def made_log(**changed):
    """Odometry every 0.1 s up to 3.9 s, a observation every 0.5 s, 1 to 8 m away, truth from 0.5 s on."""
    time, seen, known = np.arange(40) / 10, np.arange(8) / 2, np.arange(5, 40) / 10
    fields = {
        "landmarks": np.array([[4.0, 1.0], [1.0, 5.0]]),
        "odometry_time": time,
        "odometry": np.stack([0.5 + 0.1 * time, 0.1 * time], axis=1),
        "observation_time": seen,
        "observation_landmark": np.arange(8, dtype=np.int32) % 2,
        "observation": np.stack([1.0 + np.arange(8), np.full(8, 0.1)], axis=1),
        "truth_time": known,
        "truth": np.stack([known, 2 * known, 0.1 * known], axis=1),
        "sensor_offset": np.array(OFFSET),
        "counts": {"misreads": 3},
    }
    return Log("made", **fields | changed)


class Filtered:
    """What the program hands to the filter."""

    def __init__(self, monkeypatch, log):
        self.read, self.given = Recorder(log), None
        monkeypatch.setattr(localize, "read", self.read)
        monkeypatch.setattr(replay, "filter_log", self)

    def __call__(self, *given):
        *self.given, _ = given  # and the bar
        raise Enough

    def by(self, folder, **options):
        with pytest.raises(Enough):
            localize.main(localize.LocalizeConfig(**{"log": Path("a.log"), "format": "woods", "out": folder} | options))
        return self.given


@pytest.fixture
def filtered(monkeypatch):
    return Filtered(monkeypatch, made_log())


def test_what_is_filtered_by_default(filtered, tmp_path):
    params, prior, inputs, landmarks, settings = filtered.by(tmp_path, robot=4)
    assert filtered.read.calls == [((Path("a.log"), "woods", 4), {})]
    np.testing.assert_allclose(prior.mean, [0.5, 1.0, 0.05], rtol=1e-12)  # where the truth begins
    np.testing.assert_allclose(prior.cov, np.diag([0.05] * 3) ** 2, rtol=1e-6)
    assert len(inputs.dt) == 35
    assert inputs.valid.sum() == 7
    np.testing.assert_array_equal(landmarks, made_log().landmarks)
    assert settings == Config(dt=0.1, motion="arc", gate_probability=0.99, sensor_offset=OFFSET)
    # A tenth of a metre and of a radian per root second, over 0.1 s.
    np.testing.assert_allclose(params.Q, np.diag([0.1, 0.1]), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(params.R, np.diag([0.15, 0.05]) ** 2, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ({"motion": "euler"}, {"motion": "euler"}),
        ({"gate": None}, {"gate_probability": None}),
        ({"gate": 0.9}, {"gate_probability": 0.9}),
    ],
)
def test_options_of_the_filter(filtered, tmp_path, options, fields):
    *_, settings = filtered.by(tmp_path, **options)
    expected = Config(dt=0.1, motion="arc", gate_probability=0.99, sensor_offset=OFFSET)
    assert settings == dataclasses.replace(expected, **fields)


def test_options_of_what_is_filtered(filtered, tmp_path, monkeypatch):
    *_, inputs, _, _ = filtered.by(tmp_path, max_range=5.0)
    assert sorted(inputs.z[inputs.valid][:, 0]) == [2, 3, 4]  # at or beyond are left out
    _, prior, inputs, _, _ = filtered.by(tmp_path, start=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(prior.mean, [1, 2, 3], rtol=1e-12)
    assert len(inputs.dt) == 40  # from the first step on, truth or not
    monkeypatch.setattr(replay, "PIECE", 12)
    *_, inputs, _, _ = filtered.by(tmp_path, quick=True)
    assert (len(inputs.dt), inputs.valid.sum()) == (12, 3)


def test_a_gap_is_as_long_as_the_option_says(filtered, tmp_path):
    whole = made_log()
    kept = (whole.odometry_time < 1.0) | (whole.odometry_time > 1.9)
    filtered.read.answer = made_log(odometry_time=whole.odometry_time[kept], odometry=whole.odometry[kept])
    stands = [filtered.by(tmp_path, max_gap=gap)[2].control[:, 0].min() for gap in (0.5, 1.5)]
    assert (stands[0], stands[1] > 0.4) == (0, True)


def test_parameters_of_the_file_and_of_the_log(filtered, tmp_path):
    stated = {"v": 0.04, "w": 0.09, "range": 0.16, "bearing": 0.25}
    filtered.read.answer = made_log(stated_variance=stated)
    params, *_ = filtered.by(tmp_path)
    np.testing.assert_allclose(params.Q, np.diag([0.04, 0.09]), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(params.R, np.diag([0.16, 0.25]), rtol=1e-6, atol=1e-12)
    Params.from_std(v=0.1, w=0.2, range=0.3, bearing=0.4).save(tmp_path / "a.json")
    params, *_ = filtered.by(tmp_path, params=tmp_path / "a.json")
    np.testing.assert_allclose(params.R, np.diag([0.3, 0.4]) ** 2, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "options", "said"),
    [
        (
            {"landmarks": np.zeros((0, 2)), "observation_landmark": np.full(8, -1, np.int32)},
            {},
            "expected landmarks to",
        ),
        ({"truth_time": np.zeros(0), "truth": np.zeros((0, 3))}, {}, "has no truth to start from"),
        ({}, {"start": (0.0, math.nan, 0.0)}, "start: expected a finite pose"),
    ],
)
def test_what_cannot_be_localised_is_refused(monkeypatch, tmp_path, changed, options, said):
    monkeypatch.setattr(localize, "read", Recorder(made_log(**changed)))
    with pytest.raises(ValueError, match=said):
        localize.main(localize.LocalizeConfig(log=Path("a.log"), format="woods", out=tmp_path, **options))


def test_the_first_step_needs_truth_to_start_from():
    known = np.array([False, True])
    timeline = Timeline(np.array([5.0, 6.0]), None, np.array([[1.0, 2, 3], [4, 5, 6]]), known, {})
    with pytest.raises(ValueError, match=r"made has no truth at its first step, 5.000 s"):
        replay.first_pose(made_log(), timeline)
    assert replay.first_pose(made_log(), timeline._replace(truth_valid=~known)).tolist() == [1, 2, 3]


def test_a_log_is_filtered_in_pieces_as_in_one(monkeypatch):
    """Of 20 steps in pieces of 8, each going on where the last one stopped, against NumPy."""
    monkeypatch.setattr(replay, "PIECE", 8)
    moved = Recorder()
    rng = np.random.default_rng(0)
    steps, landmarks = 20, np.array([[4.0, 1.0], [1.0, 5.0]])
    inputs = Inputs(
        dt=np.full(steps, 0.1),
        control=rng.normal([0.5, 0.2], 0.1, (steps, 2)),
        landmark=np.tile(np.arange(2, dtype=np.int32), (steps, 1)),
        z=np.stack([rng.normal(4, 1, (steps, 2)), rng.normal(0.5, 0.5, (steps, 2))], axis=-1),
        valid=rng.random((steps, 2)) < 0.5,
    )
    with jax.enable_x64(True):
        params = Params.from_std(v=0.3, w=0.3, range=0.8, bearing=0.5)
        config = Config(dt=0.1, motion="arc", gate_probability=0.9, sensor_offset=OFFSET)
        prior = replay.prior_at(np.array([1.0, 0.5, 0.2]))
        info = replay.filter_log(params, prior, inputs, landmarks, config, moved)
        Q, R = np.asarray(params.Q), np.asarray(params.R)
    prior = np.array([1.0, 0.5, 0.2]), np.diag([0.05] * 3) ** 2
    gate = ekf.gate_threshold(0.9, 2)
    expected = reference.run(*prior, *inputs[:5], landmarks, Q, R, gate, reference.arc, 0.1, OFFSET)
    assert len(info.ok) == steps
    np.testing.assert_allclose(info.belief.mean, expected["mean"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(info.belief.cov, expected["cov"], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(info.accepted, expected["accepted"])
    assert 0 < info.accepted.sum() < inputs.valid.sum()
    assert [args for args, _ in moved.calls] == [(8,), (16,), (20,)]


def _entered(moved, told):
    assert told == ("filtering", 20)
    return contextlib.nullcontext(moved)


def made_info(steps=6, ok=None):
    mean = np.arange(3.0 * steps).reshape(steps, 3)
    belief = SimpleNamespace(mean=mean, cov=np.broadcast_to(np.eye(3), (steps, 3, 3)))
    valid = np.zeros((steps, 2), bool)
    valid[1, 0] = valid[3, 1] = valid[4, 0] = True
    info = Info(
        belief=belief,
        innovation=np.full((steps, 2, 2), 0.5),
        S=np.full((steps, 2, 2, 2), 2.0),
        accepted=valid & np.array([True, False]),
        row=np.tile([0, 1], (steps, 1)),
        log_likelihood=np.arange(2.0 * steps).reshape(steps, 2),
        **{name: None for name in Info._fields if name not in GIVEN},
        ok=np.ones(steps, bool) if ok is None else np.array(ok),
    )
    known = np.array([False, True, True, False, True, True])
    time = 100 + np.arange(steps) / 4
    inputs = SimpleNamespace(valid=valid)
    return info, Timeline(time, inputs, -mean, known, {"misreads": 2}), valid


GIVEN = ("belief", "innovation", "S", "accepted", "row", "log_likelihood", "ok")


def judged(monkeypatch, timeline, info, **told):
    report = {"nees_per_step": [1.0, 2.0, math.nan, 9.0, 6.0, 7.0], "verdict": "so so", "counts": {"missing": 2}}
    stub = Recorder(report | told)
    monkeypatch.setattr(replay.consistency, "judge", stub)
    report = replay.judge_log(made_log(), timeline, info, Config(gate_probability=0.8))
    ((args, how),) = stub.calls
    return report, args, how


def test_the_report_of_a_log(monkeypatch):
    info, timeline, valid = made_info(ok=[True, True, False, True, True, True])
    report, args, how = judged(monkeypatch, timeline, info)
    for got, expected in zip(args, (timeline.truth, info.belief.mean, info.belief.cov), strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(how["time"], np.arange(6) / 4)
    np.testing.assert_array_equal(how["valid"], timeline.truth_valid)
    assert how["gate_probability"] == 0.8
    given = how["innovations"]._asdict()
    expected = {"innovation": info.innovation, "S": info.S, "observed": valid, "accepted": info.accepted}
    for name, value in (expected | {"landmark": info.row}).items():
        np.testing.assert_array_equal(given[name], value)
    assert {name: report[name] for name in ("log", "duration_s", "flagged_steps", "log_likelihood", "verdict")} == {
        "log": "made",
        "duration_s": 1.25,
        "flagged_steps": 1,
        "log_likelihood": 66.0,
        "verdict": "so so",
    }
    assert report["truth_share"] == pytest.approx(4 / 6)
    assert report["anees_at_observations"] == pytest.approx((2 + 9 + 6) / 3)
    assert (report["counts"], report["left_out"]) == ({"misreads": 2}, {"missing": 2})


@pytest.mark.parametrize(("flagged", "said"), [(3, "so so"), (4, "no verdict: 4 of 6 steps are flagged")])
def test_no_verdict_where_most_steps_are_flagged(monkeypatch, flagged, said):
    info, timeline, _ = made_info(ok=np.arange(6) >= flagged)
    report, *_ = judged(monkeypatch, timeline, info)
    assert report["verdict"].startswith(said)
    report, *_ = judged(monkeypatch, timeline._replace(truth_valid=np.zeros(6, bool)), info)
    assert report["verdict"].startswith("no verdict: the log has no truth")


def test_without_a_score_at_a_observation_there_is_no_number(monkeypatch):
    info, timeline, _ = made_info()
    report, *_ = judged(monkeypatch, timeline, info, nees_per_step=[1.0, math.nan, 2.0, math.nan, math.nan, 3.0])
    assert math.isnan(report["anees_at_observations"])


COUNTS = {"odometry_gaps": 0, "odometry_gap_seconds": 0, "duplicate_truth": 0, "duplicate_odometry": 0}


@pytest.mark.parametrize(
    ("counts", "changed", "said"),
    [
        ({}, {}, []),
        ({"odometry_gaps": 2, "odometry_gap_seconds": 7.5}, {}, ["more than 1.2 s, 2 time(s)", "stand there, 7.5 s"]),
        ({"duplicate_truth": 17}, {}, []),  # of 35
        ({"duplicate_truth": 18}, {}, ["18 of 35 stamps of the truth repeat another"]),
        ({"duplicate_odometry": 20}, {}, []),  # of 40
        ({"duplicate_odometry": 21}, {}, ["21 of 40 stamps of the odometry repeat another"]),
        ({}, {"observation_time": np.arange(8) + 3.9}, []),  # the first at the last command
        ({}, {"observation_time": np.arange(8) - 7.0}, []),  # the last at the first
        (
            {},
            {"observation_time": np.arange(8) + 4.0},
            ["observations from 4.000 to 11.000 s, none in the time"],
        ),
        ({}, {"observation_time": np.arange(8) - 7.5}, ["observations from -7.500 to -0.500 s", "0.000 to 3.900 s"]),
    ],
)
def test_what_looks_odd_in_a_log_s_time_is_said(counts, changed, said):
    sentences = replay.time_doubts(made_log(**changed), COUNTS | counts, 1.2)
    assert len(sentences) == (len(said) > 0)
    for words in said:
        assert words in sentences[0]


@pytest.mark.parametrize("scored", [4, 0])
def test_what_is_written(monkeypatch, tmp_path, scored):
    """The estimate at every step, the truth where it is known, and no judgement where there is none."""
    info, timeline, _ = made_info()
    figures = {name: Recorder() for name in ("judge_figure", "trajectory_figure")}
    for name, figure in figures.items():
        monkeypatch.setattr(localize.plotting, name, figure)
    monkeypatch.setattr(localize, "_print", printed := Recorder())
    report = {"scored_steps": scored, "rmse_position_m": 0.1234, "log": "made"}
    localize._write(tmp_path, made_log(), timeline, info, report)
    assert json.loads((tmp_path / "report.json").read_text()) == report
    estimate = np.loadtxt(tmp_path / "estimate.tum")
    np.testing.assert_allclose(estimate[:, :3], np.c_[timeline.time, info.belief.mean[:, :2]], rtol=1e-9)
    (((_, mean, cov, truth), how),) = figures["trajectory_figure"].calls
    np.testing.assert_array_equal(mean, info.belief.mean)
    np.testing.assert_array_equal(cov, info.belief.cov)
    np.testing.assert_array_equal(how["landmarks"], made_log().landmarks)
    assert printed.calls == [((report, scored > 0), {})]
    assert (tmp_path / "truth.tum").exists() == bool(scored)
    if not scored:
        assert (truth, how["title"], figures["judge_figure"].calls) == (None, "made", [])
        return
    known = timeline.truth_valid
    written = np.loadtxt(tmp_path / "truth.tum")
    np.testing.assert_allclose(written[:, :3], np.c_[timeline.time, timeline.truth[:, :2]][known], rtol=1e-9)
    np.testing.assert_array_equal(truth, timeline.truth)
    assert how["title"] == "made: position RMSE 0.123 m"
    (((_, shown, where, name), _),) = figures["judge_figure"].calls
    assert (shown, name) == (report, "made")
    np.testing.assert_array_equal(where, timeline.truth[:, :2])


def test_what_is_shown(monkeypatch):
    monkeypatch.setattr(localize, "show", shown := Recorder())
    monkeypatch.setattr(localize, "print_verdicts", Recorder())
    monkeypatch.setattr(localize, "innovation_rows", lambda report: [("i", "", "")])
    monkeypatch.setattr(localize, "pose_rows", lambda report: [("p", "", "")])
    report = {"steps": 9, "observations": 8, "flagged_steps": 7, "truth_share": 0.655, "independent_samples": 44.4}
    report |= {"anees_at_observations": 3.5, "nees_median": 2.0, "log": "made", "counts": {"a": 1, "b": 0}}
    report |= {"left_out": {"missing": 5}}
    for judged in (True, False):
        localize._print(report, judged)
    (((title, rows), _), ((_, fewer), _)) = shown.calls
    assert title == "made"
    head = [("steps, observations", "9, 8", ""), ("flagged steps", "7", "0"), ("i", "", "")]
    dropped = [(f"dropped or mended in the log: {name}", n, "") for name, n in (("a", "1"), ("missing", "5"))]
    assert fewer == head + dropped
    assert rows == [
        *head,
        ("steps with truth", "65.5 %", ""),
        ("independent samples", "44.4", ""),
        ("ANEES at observations", "3.5", "3"),
        ("median NEES", "2", "2.37"),
        ("p", "", ""),
        *dropped,
    ]


def test_smoothed_poses(monkeypatch, tmp_path, x64):
    """What the option adds: the report's entry, and poses with covariances that read back and are more certain."""
    monkeypatch.setattr(localize, "read", Recorder(made_log()))
    config = localize.LocalizeConfig(log=Path("a.log"), format="woods", out=tmp_path, smooth=True, gate=None)
    report = localize.main(config)
    assert set(report["smoothed"]) >= {"rmse_position_m", "rmse_yaw_rad", "anees"}
    poses = read_trajectory(tmp_path / "smoothed.csv")
    assert len(poses.time) == len(read_trajectory(tmp_path / "estimate.tum").time)
    assert np.all(np.linalg.eigvalsh(poses.cov) > -1e-12)
    assert "smoothed" not in localize.main(dataclasses.replace(config, smooth=False))
