"""What is tuned on and what it is judged by: other drives, halves and robots; and what the program makes of it."""

import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import Recorder
from test_localize import made_log

from jaxlocmap import Config, Gaussian, Params, simulation, tuning
from jaxlocmap.cli import tune, tune_options, tune_sources
from jaxlocmap.cli.tune_sources import Wanted
from jaxlocmap.logs import Log
from jaxlocmap.mapping.predictive import PredictiveScore

pytestmark = pytest.mark.usefixtures("as_a_program")
START = Params.from_std(v=0.1, w=0.2, range=0.3, bearing=0.4)


def wanted(*losses, start=None, gate=0.999, judge_gate=0.9, seed=3, quick=False, max_gap=1.5):
    return Wanted(losses or ("innovation_nll",), start, gate, judge_gate, seed, quick, max_gap)


def key_data(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


# --- Simulated drives


@pytest.fixture
def scene(monkeypatch):
    """What a scenario simulates to tune on, the studies it runs to judge, and what it scores one scan ahead."""
    stubs = {
        "simulated": Recorder(),
        "monte_carlo": Recorder(SimpleNamespace(value="totals")),
        "summarise": None,
        "predictive_score": Recorder({"log_loss": 0.5}),
    }
    stubs["summarise"] = summarise = Recorder()
    simulated = stubs["simulated"]
    monkeypatch.setattr(
        tune_sources.tuning, "simulated", lambda *args, **how: simulated(*args, **how) or f"batch of {args[1]}"
    )
    monkeypatch.setattr(tune_sources, "monte_carlo", stubs["monte_carlo"])
    monkeypatch.setattr(tune_sources, "summarise", lambda *args: summarise(*args) or {"anees": 3.0})
    monkeypatch.setattr(tune_sources, "_predictive_score", stubs["predictive_score"])
    return SimpleNamespace(**stubs)


def test_a_scenario_is_tuned_validated_and_judged_on_drives_of_their_own(scene):
    source = tune_sources.from_scenario("loop", "euler", 40, 70, wanted())
    train, validation = scene.simulated.calls
    assert [args[1] for args, _ in scene.simulated.calls] == [40, 10]
    assert key_data(train[0][0]) != key_data(validation[0][0])
    for args, _ in scene.simulated.calls:
        np.testing.assert_array_equal(args[2].segments, simulation.room().segments)
        assert args[3] == simulation.Noise()
    assert train[1] == validation[1] == {"scenario": simulation.LOOP, "scans": False, "worlds": False}
    assert (source.name, source.dt) == ("loop, euler motion, 40 runs", 0.1)
    assert (source.train, source.compared, source.validation) == ("batch of 40", "batch of 40", "batch of 10")
    config = source.config
    assert (config.motion, config.gate_probability, config.gate_temperature, config.grid) == ("euler", 0.999, 2.0, None)
    np.testing.assert_array_equal(source.start.R, simulation.course_params().R)
    assert source.evidence(START) == {"anees": 3.0}
    ((study, key, runs, params, *_), _) = scene.monte_carlo.calls[0]
    assert (study.scenario, study.config.motion, study.config.gate_probability) == (simulation.LOOP, "euler", 0.9)
    assert (runs, study.config.gate_temperature, study.config.grid) == (70, 0, None)
    assert (params.R.dtype, scene.summarise.calls) == (np.float32, [(("totals", study.config), {})])
    np.testing.assert_allclose(params.R, START.R, rtol=1e-6)
    first = [key_data(jax.random.split(jax.random.fold_in(jax.random.key(3), i))[0]) for i in (0, 1)]
    assert [key_data(args[0]) for args, _ in scene.simulated.calls] == first
    assert key_data(key) == key_data(jax.random.fold_in(jax.random.key(3), 3))
    assert tune_sources.from_scenario("loop", "euler", 3, 70, wanted(start=START)).start is START
    assert scene.simulated.calls[-1][0][1] == 1  # at least one to validate by


def test_a_map_is_tuned_and_judged_in_rooms_of_their_own(scene, monkeypatch):
    monkeypatch.setattr(tune_sources, "random_room", lambda key: jax.random.normal(key, (2,)))
    source = tune_sources.from_scenario("capstone", "arc", 4, 300, wanted("map"))
    assert [args[1] for args, _ in scene.simulated.calls] == [64, 4, 1]  # held out, to tune on, to validate
    assert all(how["scans"] and how["worlds"] for _, how in scene.simulated.calls)
    rooms = [np.asarray(args[2]) for args, _ in scene.simulated.calls]
    assert len({room.tobytes() for batch in rooms for room in batch}) == 69
    assert source.config.grid == simulation.CAPSTONE.robot.grid
    own, course = simulation.own_params(simulation.Noise(), simulation.CAPSTONE), simulation.course_params()
    np.testing.assert_array_equal(source.start.R, own.R)  # a robot that knows its own noise
    assert (source.start.l_occ, source.start.l_free) == (course.l_occ, course.l_free)
    assert source.evidence(START) == {"anees": 3.0, "one_scan_ahead": {"log_loss": 0.5}}
    ((study, _, runs, *_), _) = scene.monte_carlo.calls[0]
    assert (runs, study.config.grid) == (200, simulation.CAPSTONE.robot.grid)
    assert scene.predictive_score.calls == [((START, "batch of 64", study.config), {})]
    both = tune_sources.from_scenario("capstone", "arc", 4, 10, wanted("map", "pose_nll"))
    np.testing.assert_array_equal(both.start.R, course.R)
    assert [args[1] for args, _ in scene.simulated.calls[3:]] == [10, 4, 1]


# --- Logs of robots


@pytest.fixture
def robots(monkeypatch):
    """Logs by robot, the truth of each shifted by its number; windows of 3 steps that run in for 2."""
    logs = {}

    def read(path, kind, robot):
        log = made_log()
        truth = log.truth + np.array([robot or 0, 0, 0])
        logs[robot] = made_log(truth=truth, truth_time=log.truth_time)
        return logs[robot]

    monkeypatch.setattr(tune_sources, "read", read)
    monkeypatch.setattr(tune_sources, "_WINDOWS", {"woods": (3, 2), "mrclam": (4, 0)})
    filtered, judged = Recorder("info"), Recorder({"anees": 3.0})
    monkeypatch.setattr(tune_sources, "filter_log", filtered)
    monkeypatch.setattr(tune_sources, "judge_log", judged)
    return SimpleNamespace(filtered=filtered, judged=judged, logs=logs)


def woods(robots, **options):
    told = wanted(**{name: options.pop(name) for name in ("start", "quick", "max_gap") if name in options})
    return tune_sources.from_robots(Path("a/woods.mat"), "woods", (), (), "euler", options.get("max_range"), told)


def test_woods_is_tuned_on_its_first_half_and_judged_on_its_second(robots):
    source = woods(robots)
    assert source.name == "woods.mat, first half"
    assert source.config == Config(
        dt=0.1, motion="euler", gate_probability=0.999, gate_temperature=2.0, sensor_offset=(0.2, 0.1, 0.3)
    )
    counted, known = np.asarray(source.train.counted), np.asarray(source.train.known)
    # 35 steps from the first truth on: 17 to tune on, in six windows, of which the fifth is to validate by.
    assert counted.sum(axis=1).tolist() == [3, 3, 3, 3, 2]
    assert np.asarray(source.validation.counted).sum(axis=1).tolist() == [3]
    seen = np.asarray(source.train.truth)[counted & known][:, 0]
    np.testing.assert_allclose(seen, [*np.arange(5, 17) / 10, 2.0, 2.1], rtol=1e-6)
    np.testing.assert_allclose(source.validation.truth[0, 2:, 0], [1.7, 1.8, 1.9], rtol=1e-6)
    assert source.compared is source.train
    # Each starts at the truth before it runs in, as sure of it as a filter that is told it.
    np.testing.assert_allclose(source.train.prior.mean[:, 0], [0.5, 0.5, 0.8, 1.1, 1.7], rtol=1e-6)
    np.testing.assert_allclose(source.train.prior.cov[3], np.diag([0.05] * 3) ** 2, rtol=1e-6)
    np.testing.assert_allclose(source.train.prior.cov[0], np.diag([0.05] * 3) ** 2, rtol=1e-6)
    evidence = source.evidence(START)
    assert list(evidence) == ["second half"]
    ((params, prior, inputs, landmarks, config, _), _) = robots.filtered.calls[0]
    assert params is START
    np.testing.assert_allclose(prior.mean, [2.2, 4.4, 0.22], rtol=1e-6)
    assert len(inputs.dt) == 18
    np.testing.assert_array_equal(landmarks, made_log().landmarks)
    assert (config.gate_probability, config.gate_temperature, config.motion) == (0.9, 0, "euler")
    assert config.sensor_offset == (0.2, 0.1, 0.3)
    ((log, timeline, info, same), _) = robots.judged.calls[0]
    assert (log, info, same) == (robots.logs[None], "info", config)
    np.testing.assert_allclose(timeline.time, np.arange(22, 40) / 10, rtol=1e-6)
    np.testing.assert_array_equal(evidence["second half"]["time"], timeline.time)


def test_robots_are_tuned_on_some_and_judged_on_others(robots):
    source = tune_sources.from_robots(Path("a/log"), "mrclam", (1, 3), (2, 5), "arc", None, wanted())
    assert source.name == "log, robots 1, 3"
    begin = np.asarray(source.train.truth)[:, 0, 0] - np.asarray(source.train.truth)[:, 0, 1] / 2
    assert begin.round(6).tolist() == [1] * 8 + [3] * 7  # of nine windows each every fifth is held out
    held = np.asarray(source.validation.truth)[:, 0, 0] - np.asarray(source.validation.truth)[:, 0, 1] / 2
    assert held.round(6).tolist() == [1, 3, 3]
    evidence = source.evidence(START)
    assert list(evidence) == ["robot 2", "robot 5"]
    assert [prior.mean[0] for (_, prior, *_), _ in robots.filtered.calls] == pytest.approx([2.5, 5.5])
    assert [len(inputs.dt) for (_, _, inputs, *_), _ in robots.filtered.calls] == [35, 35]
    for tuned, judged in (((), (1,)), ((1,), ()), ((1, 2), (2, 3))):
        with pytest.raises(ValueError, match="expected robots to tune on and others to judge"):
            tune_sources.from_robots(Path("a"), "mrclam", tuned, judged, "arc", None, wanted())


def test_options_of_a_log_of_robots(robots, monkeypatch):
    assert woods(robots).train.inputs.valid.sum() == 5
    source = woods(robots, max_range=4.0, start=START)
    assert (source.config.max_range, source.start) == (4.0, START)
    assert source.train.inputs.valid.sum() < 5
    assert woods(robots).config.max_range == Config.max_range
    asked = Recorder()
    timeline = tune_sources.to_timeline
    monkeypatch.setattr(tune_sources, "to_timeline", lambda log, **how: asked(**how) or timeline(log, **how))
    woods(robots, max_gap=1.25, max_range=3.0)
    assert asked.calls == [((), {"max_range": 3.0, "start": 0.5, "max_gap": 1.25})]


@pytest.mark.parametrize(("kind", "steps"), [("woods", 2400), ("mrclam", 6000)])
def test_a_quick_run_takes_the_first_steps(monkeypatch, kind, steps):
    time = np.arange(6100) / 10
    odometry = np.full((6100, 2), 0.1)
    long = made_log(odometry_time=time, odometry=odometry, truth_time=time, truth=np.zeros((6100, 3)))
    monkeypatch.setattr(tune_sources, "read", lambda *_: long)
    for quick, expected in ((True, steps), (False, 6100)):
        _, timeline = tune_sources._timeline(Path("a"), kind, None, None, wanted(quick=quick))
        assert len(timeline.time) == len(timeline.inputs.dt) == expected


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"landmarks": np.zeros((0, 2)), "observation_landmark": np.full(8, -1, np.int32)}, "expected landmarks"),
        ({"truth_time": np.zeros(0), "truth": np.zeros((0, 3))}, "expected a log with truth"),
    ],
)
def test_a_log_without_what_tuning_needs_is_refused(monkeypatch, changed, said):
    monkeypatch.setattr(tune_sources, "read", lambda *_: made_log(**changed))
    with pytest.raises(ValueError, match=said):
        tune_sources._timeline(Path("a"), "woods", None, None, wanted())


def test_where_the_truth_is_unknown_a_window_starts_where_the_filter_is(monkeypatch):
    """And is unsure of it, by a metre and half a radian."""
    truth = made_log()
    kept = (truth.truth_time < 1.0) | (truth.truth_time > 2.9)  # a gap of two seconds
    log = made_log(truth_time=truth.truth_time[kept], truth=truth.truth[kept])
    timeline = tune_sources.to_timeline(log, start=0.5)
    believed = np.full((1, 35, 3), 7.0)
    monkeypatch.setattr(
        tune_sources.tuning, "beliefs", lambda params, batch, config: Gaussian(jnp.asarray(believed), None)
    )
    config = Config(motion="euler")
    batch = tune_sources._windows(timeline, log, START, config, 10, 0)
    np.testing.assert_allclose(batch.prior.mean, [[0.5, 1.0, 0.05], [7, 7, 7], [7, 7, 7], [3.4, 6.8, 0.34]], rtol=1e-6)
    near, far = np.diag([0.05] * 3) ** 2, np.diag([1.0, 1.0, 0.25])
    np.testing.assert_allclose(batch.prior.cov, [near, far, far, near], rtol=1e-6, atol=1e-12)
    assert np.asarray(batch.known).sum() == timeline.truth_valid.sum() == 15


def test_the_second_half_begins_where_its_truth_does():
    timeline = tune_sources.to_timeline(made_log(), start=0.0)
    cut = tune_sources._from_truth(timeline)
    assert (cut.time[0], len(cut.time)) == (0.5, 35)


# --- Laser logs


def scans(count, seen=5.0):
    ranges = np.tile([1.0, 2.0, 30.0], (count, 1)) + np.arange(count)[:, None] / 100
    poses = np.stack([np.arange(count) / 10, np.zeros(count), np.zeros(count)], axis=1)
    lines = np.arange(count, dtype=np.int32)
    time = np.arange(float(count))
    return Log(
        "scans",
        scan_time=time,
        scan=ranges,
        scan_line=lines,
        beam_angles=np.array([-0.5, 0.0, 0.5]),
        truth_time=time,
        truth=poses,
        beam_angles_from="log",
    )


@pytest.mark.parametrize(("count", "quick", "used"), [(60, False, 60), (71, False, 71), (71, True, 60)])
def test_scans_are_tuned_on_the_first_half_and_judged_on_the_second(monkeypatch, count, quick, used):
    monkeypatch.setattr(tune_sources, "read", lambda *_: scans(count))
    monkeypatch.setattr(tune_sources, "_predictive_score", scored := Recorder("evidence"))
    source = tune_sources.from_scans(Path("a/b.log"), 0.5, 8.0, wanted("map", quick=quick))
    half = used // 2
    assert source.name == f"b.log, first {half} of {used} scans"
    train, validation = (np.asarray(x.counted)[0] for x in (source.train, source.validation))
    assert len(train) == len(source.train.inputs.dt[0]) == half
    np.testing.assert_array_equal(train, np.arange(half) % 5 != 4)
    np.testing.assert_array_equal(validation, ~train)
    assert source.compared.counted.sum(axis=0).tolist() == train.astype(int).tolist()
    assert len(source.compared.counted) == 10
    assert (source.config.max_range, source.config.grid.resolution) == (8.0, 0.5)
    np.testing.assert_allclose(source.train.inputs.ranges[0, 3], [1.03, 2.03, 8.0], rtol=1e-6)
    np.testing.assert_array_equal(source.train.beam_angles, [-0.5, 0, 0.5])
    np.testing.assert_array_equal(source.start.R, simulation.course_params().R)
    assert source.evidence(START) == {"one_scan_ahead": "evidence"}
    ((params, later, config), _) = scored.calls[0]
    assert (params, config) == (START, source.config)
    np.testing.assert_array_equal(np.asarray(later.counted)[0], np.arange(used) >= half)
    assert later.inputs.ranges.shape[1] == used
    assert tune_sources.from_scans(Path("a"), 0.5, 8.0, wanted("map", start=START)).start is START


def test_runs_of_scans_validate_in_a_long_log(monkeypatch):
    """Of a first half of 150 scans every fifth run of six."""
    monkeypatch.setattr(tune_sources, "read", lambda *_: scans(300))
    source = tune_sources.from_scans(Path("a"), 0.5, 8.0, wanted("map"))
    held = np.flatnonzero(np.asarray(source.validation.counted)[0])
    assert held[:12].tolist() == [24, 25, 26, 27, 28, 29, 54, 55, 56, 57, 58, 59]


def test_a_predictive_score_is_averaged_over_cells(monkeypatch):
    sums = PredictiveScore(
        log_loss=np.array(6.0),
        cells=np.array(8.0),
        bin_cells=np.array([4.0, 0.0, 4.0]),
        bin_probability=np.array([1.0, 0.0, 3.0]),
        bin_hits=np.array([2.0, 0.0, 2.5]),
    )
    monkeypatch.setattr(tune_sources, "_predictive_sums", lambda params, batch, config: sums)
    assert tune_sources._predictive_score(START, None, None) == {
        "log_loss": 0.75,
        "cells": 8.0,
        "calibration_error": 1.5 / 8,
        "calibration_cells": [4, 0, 4],
        "calibration_probability": [0.25, 0, 0.75],
        "calibration_frequency": [0.5, 0, 0.625],
    }


@pytest.mark.parametrize("given", [True, False])
def test_scans_are_predicted_from_the_poses_of_the_batch_or_the_filter(monkeypatch, given):
    seen = Recorder({"sum": np.array([[1.0, 2.0], [10.0, 20.0]])})
    monkeypatch.setattr(tune_sources.tuning, "predictive_score", seen)
    monkeypatch.setattr(tune_sources.tuning, "beliefs", lambda *_, **__: SimpleNamespace(mean="filter"))
    batch = SimpleNamespace(poses="batch" if given else None)
    config = Config()
    sums = tune_sources._predictive_sums.__wrapped__(START, batch, config=config)
    assert sums["sum"].tolist() == [11, 22]
    poses = "batch" if given else "filter"
    assert seen.calls == [((START.l_occ, START.l_free, batch, poses), {"config": config, "bins": True})]


# --- The program


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"full": True}, ("v", "w", "v_w", "range", "bearing", "range_bearing")),
        ({}, ("v", "w", "range", "bearing")),
        ({"loss": ("map",)}, ("l_occ", "l_free")),
        ({"loss": ("map", "pose=2")}, ("v", "w", "range", "bearing", "l_occ", "l_free")),
        ({"tune": ("bearing", "v"), "loss": ("map",)}, ("bearing", "v")),
    ],
)
def test_what_is_tuned_is_what_the_losses_depend_on(options, expected):
    assert tune_options.tuned_parameters(tune.TuneConfig(**options)) == expected


def test_losses_weigh_what_they_are_told():
    assert tune_options.loss_weights(tune.TuneConfig(loss=("pose", "nees=0.25"))) == (("pose_nll", 1.0), ("nees", 0.25))


LOG = {"log": Path("a.log")}
GIVEN = {"gate": 0.9, "judge_gate": 0.8, "seed": 6, "loss": ("pose", "nis"), "motion": "euler"}


@pytest.mark.parametrize(
    ("options", "source", "args", "max_gap"),
    [
        (GIVEN | {"scenario": "loop", "runs": 7, "judge_runs": 8}, "from_scenario", ("loop", "euler", 7, 8), 1.5),
        (
            GIVEN | LOG | {"format": "woods", "max_range": 4.0, "max_gap": 2.5},
            "from_robots",
            (Path("a.log"), "woods", (1, 2, 3), (4, 5), "euler", 4.0),
            2.5,
        ),
        (
            GIVEN | LOG | {"format": "mrclam", "robots": (2,), "judged": (1,)},
            "from_robots",
            (Path("a.log"), "mrclam", (2,), (1,), "euler", None),
            1.5,
        ),
        (
            LOG | {"format": "carmen", "loss": ("map",), "resolution": 0.3, "max_range": 9.0, "seed": 6},
            "from_scans",
            (Path("a.log"), 0.3, 9.0),
            1.5,
        ),
    ],
)
@pytest.mark.parametrize("quick", [False, True])
def test_options_reach_what_is_tuned_on(monkeypatch, tmp_path, options, source, args, max_gap, quick):
    monkeypatch.setattr(tune, source, asked := Recorder("source"))
    START.save(tmp_path / "start.json")
    config = tune.checked(tune.TuneConfig(**options, params=tmp_path / "start.json", quick=quick))
    losses = tuple(name for name, _ in tune.loss_weights(config))
    assert tune._source(config, losses) == "source"
    ((given, _),) = asked.calls
    assert given[:-1] == args
    got = given[-1]
    gates = (0.9, 0.8) if "gate" in options else (0.9999, 0.99)
    assert (got.losses, got.gate, got.judge_gate, got.seed) == (losses, *gates, 6)
    assert (got.quick, got.max_gap) == (quick, max_gap)
    np.testing.assert_allclose(got.start.R, START.R, rtol=1e-6)
    assert tune._source(tune.checked(tune.TuneConfig(**options)), losses) == "source"
    assert asked.calls[1][0][-1].start is None


@pytest.mark.parametrize(("optimiser", "steps"), [("lbfgs", 2), ("adam", 20)])
def test_options_reach_the_descent(monkeypatch, tmp_path, optimiser, steps):
    monkeypatch.setattr(tune.tuning, "fit", fitted := Recorder("fit"))
    options = {"epochs": 9, "seed": 8} | ({"minibatch": 3} if optimiser == "adam" else {})
    config = tune.checked(tune.TuneConfig(optimiser=optimiser, **options))
    source = SimpleNamespace(start="start", train="train", validation="validation")
    assert tune._fit(config, "objective", source, ("v", "range"), tmp_path, []) == "fit"
    ((args, how),) = fitted.calls
    assert args == ("objective", "start", "train")
    assert {name: how[name] for name in ("tuned", "epochs", "steps", "minibatch", "validation")} == {
        "tuned": ("v", "range"),
        "epochs": 9,
        "steps": steps,
        "minibatch": 3 if optimiser == "adam" else None,
        "validation": "validation",
    }
    assert (how["optimiser"] is None) == (optimiser == "lbfgs")
    assert key_data(how["key"]) == key_data(jax.random.key(8))


def made_fit():
    trace = SimpleNamespace(
        evaluations=np.array([2, 3]),
        skipped=np.array([False, True]),
        loss=np.array([4.0, 3.0]),
        gradient_norm=np.array([1.0, 0.5]),
        params={"v": [0.1, 0.2]},
    )
    return tuning.Fit(START, 2.5, np.array([4.0, 2.5]), trace, 1, False, 1.5, 2.5)


def test_the_best_so_far_is_on_disk_after_every_epoch(tmp_path):
    kept = []
    with tune._bar(5, tuning.Objective(Config(), (("mse", 1.0),)), ("v",), tmp_path, kept) as move:
        move(made_fit())
    np.testing.assert_allclose(Params.load(tmp_path / "params.json").R, START.R, rtol=1e-6)
    assert kept == [f"the best of 1 epochs is kept in {tmp_path}/params.json, from which --params goes on"]


def test_the_whole_program(monkeypatch, tmp_path):
    """Tunes on one part, is sure by what is compared, and judges what is held out before and after."""
    own = Params.from_std(v=0.5, w=0.6, range=0.7, bearing=0.8)
    judged = Recorder()
    sure = tuning.StandardErrors(
        ("range", "v"),
        np.array([0.3, 0.1]),
        np.array([0.03, 0.01]),
        np.array([[0.2, 0.4], [0.05, 0.2]]),
        np.array([[1.0, 0.5], [0.5, 1.0]]),
        np.eye(2),
        ("too few",),
    )
    certain = Recorder(sure)

    def evidence(params):
        judged(params)
        return {"anees": 7.0 if params is own else 3.0, "drive": {"anees": 5.0, "time": [1], "nees_per_step": [2]}}

    source = tune.Source("source", own, Config(), "train", "validation", "compared", evidence, 0.1)
    monkeypatch.setattr(tune.hosts, "use_all_cores", Recorder())
    monkeypatch.setattr(tune, "_source", Recorder(source))
    monkeypatch.setattr(tune, "_fit", fitted := Recorder(made_fit()))
    monkeypatch.setattr(tune, "_figures", figures := Recorder([]))
    monkeypatch.setattr(tune.tuning, "standard_errors", certain)
    losses = {("own", "train"): 8.0, ("own", "validation"): 7.0, ("found", "train"): 6.0, ("found", "validation"): 5.0}

    class Objective:
        names, blocks = ("pose_nll",), tuning.blocks_of(source.config)

        def __init__(self, config, weights):
            assert (config, weights) == (source.config, (("pose_nll", 2.0),))

        def judged(self, params, batch):
            return 0, {"pose_nll": losses["own" if params is own else "found", batch]}

    monkeypatch.setattr(tune.tuning, "Objective", Objective)
    config = tune.TuneConfig(loss=("pose=2",), tune=("range", "v"), seed=9, out=tmp_path, epochs=3)
    report = tune._tune(tune.checked(config), tmp_path, ["nothing"])
    written = json.loads((tmp_path / "report.json").read_text())
    assert fitted.calls[0][0][2:4] == (source, ("range", "v"))
    ((_, params, compared, tuned), _) = certain.calls[0]
    assert (params, compared, tuned) == (START, "compared", ("range", "v"))
    assert [args[0] for args, _ in judged.calls] == [own, START]
    assert report["parameters"]["range"] == {
        "start": pytest.approx(0.7),
        "end": pytest.approx(0.3),
        "standard_error": 0.03,
        "interval_95": [0.2, 0.4],
        "unit": "m",
    }
    assert report["parameters"]["v"]["start"] == pytest.approx(0.5)
    assert report["parameters"]["v"]["standard_error"] == 0.01
    assert report["loss"] == {
        "pose_nll": {"train_before": 8.0, "validation_before": 7.0, "train_after": 6.0, "validation_after": 5.0}
    }
    drive = {"anees": 5.0}
    assert report["held_out"] == {
        "before": {"anees": 7.0, "drive": drive},
        "after": {"anees": 3.0, "drive": drive},
    }
    assert {
        name: written[name]
        for name in ("source", "losses", "seed", "evaluations", "skipped_steps", "best_epoch", "steps_per_epoch")
    } == {
        "source": "source",
        "losses": {"pose_nll": 2.0},
        "seed": 9,
        "evaluations": 5,
        "skipped_steps": 1,
        "best_epoch": 1,
        "steps_per_epoch": 2,
    }
    assert (written["compile_s"], written["run_s"], written["stopped_early"]) == (1.5, 2.5, False)
    assert written["trace"] == {
        "loss": [4, 3],
        "gradient_norm": [1, 0.5],
        "validation": [4, 2.5],
        "parameters": {"v": [0.1, 0.2]},
    }
    assert (written["not_identified"], written["correlation"]["matrix"]) == (["too few"], [[1, 0.5], [0.5, 1]])
    np.testing.assert_allclose(Params.load(tmp_path / "params.json").R, START.R, rtol=1e-6)
    ((_, same, _, before, after), _) = figures.calls[0]
    assert (same, before["anees"], after["anees"]) == (source, 7.0, 3.0)


def test_figures_of_what_is_held_out(monkeypatch, tmp_path):
    names = ("descent_figure", "calibration_figure", "study_before_after_figure", "log_before_after_figure")
    figures = {name: Recorder() for name in names}
    for name, figure in figures.items():
        monkeypatch.setattr(tune.plotting, name, figure)

    def drawn(before, after, validation="some"):
        source = SimpleNamespace(name="source", validation=validation, dt=0.25)
        files = tune._figures(tmp_path, source, {"a": 1}, before, after)
        return files, {name: figure.calls.pop()[0] for name, figure in figures.items() if figure.calls}

    files, got = drawn({"one_scan_ahead": "b"}, {"one_scan_ahead": "a"}, None)
    assert files == ["descent.png", "calibration.png"]
    assert got["descent_figure"][1] == {"a": 1, "validated": False}
    assert got["calibration_figure"][1:] == ("b", "a", "source")
    before, after = {"nees_per_step": [2]}, {"nees_per_step": [1]}
    files, got = drawn(before, after)
    assert got["descent_figure"][1]["validated"]
    assert (files[1], got["study_before_after_figure"][1:]) == ("nees.png", (before, after, 0.25))
    before = {"robot 4": {"anees": 9.0, "nees_per_step": [9, 8]}, "robot 5": {"anees": None, "nees_per_step": [1]}}
    after = {"robot 4": {"anees": 3.0, "nees_per_step": [3, 2], "time": [0, 1]}, "robot 5": {"anees": None}}
    files, got = drawn(before, after)
    assert got["log_before_after_figure"][1] == {
        "robot 4": {
            "time": [0, 1],
            "before": before["robot 4"],
            "after": after["robot 4"],
            "nees_before": [9, 8],
            "nees_after": [3, 2],
        }
    }


def test_what_tuning_says(monkeypatch):
    monkeypatch.setattr(tune.CONSOLE, "print", shown := Recorder())
    report = {
        "source": "here",
        "parameters": {
            "v": {"start": 0.1, "end": 0.2, "standard_error": 0.03, "interval_95": [0.15, 0.25], "unit": "m"}
        },
        "held_out": {
            "before": {"anees": 9.0, "robot 4": {"nis_mean": 4.0, "brier": 0.5}},
            "after": {"anees": 3.5, "robot 4": {"nis_mean": 2.0, "brier": None}},
        },
        "loss": {
            "pose_nll": {"train_before": 3.0, "train_after": 2.0, "validation_before": 3.5, "validation_after": 2.5},
            "nis": {"train_before": 1.0, "train_after": 0.5, "validation_before": None, "validation_after": None},
        },
        "not_identified": ["v is anything"],
        "evaluations": 5,
        "run_s": 2.0,
        "compile_s": 1.0,
        "skipped_steps": 3,
    }
    tune._print(report)
    said = [args[0] for args, _ in shown.calls]
    rows = [[list(column.cells) for column in table.columns] for table in said[:2]]
    assert rows[0] == [["v, m"], ["0.1"], ["0.2"], ["0.03"], ["[0.15, 0.25]"]]
    assert rows[1] == [["fresh runs", "robot 4"], ["ANEES (3)", "NIS (2)"], ["9", "4"], ["3.5", "2"]]
    assert said[2].endswith("nats: train: 3.0000 → 2.0000; validation: 3.5000 → 2.5000")
    assert said[3].endswith(": train: 1.0000 → 0.5000")
    assert said[4:] == [
        "careful: v is anything",
        "5 evaluations in 2.0 s after 1.0 s of compilation; 3 steps skipped as not finite",
    ]
