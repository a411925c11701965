"""Every option of the programs of simulated studies reaches what it is for, and their own sums are right."""

import dataclasses
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from drives import like
from programs import Enough, Recorder, stop

from jaxlocmap import Gaussian, Params, simulation
from jaxlocmap.cli import study as study_program
from jaxlocmap.cli import sweep
from jaxlocmap.cli.compute import ComputeConfig
from jaxlocmap.consistency.study import RandomBuildings
from jaxlocmap.consistency.sweep import SWEPT, what_the_gate_buys

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import capstone
import precision
import verdicts

pytestmark = pytest.mark.usefixtures("as_a_program")
RESULT = SimpleNamespace(value="totals", chunk=1, devices=1, processes=1, resumed_runs=0, compile_s=0.0, run_s=1.0)


@pytest.fixture
def plant(tmp_path):
    """A file of parameters that no program has by itself."""
    params = Params.from_std(v=0.11, w=0.22, range=0.33, bearing=0.44)
    params.save(tmp_path / "plant.json")
    return tmp_path / "plant.json", params


def same_key(key, seed):
    return np.array_equal(jax.random.key_data(key), jax.random.key_data(jax.random.key(seed)))


def handed_to_the_study(monkeypatch, program, config):
    """What a program's study is called with, and what its parts are, before anything is computed."""
    parts, study, started = Recorder("parts"), Recorder(), Recorder()

    def studied(*args, **kwargs):
        study(*args, **kwargs)
        raise Enough

    monkeypatch.setattr(program, "start", started)
    monkeypatch.setattr(program, "study_checkpoint", parts)
    monkeypatch.setattr(program, "study", studied)
    with pytest.raises(Enough):
        program.main(config)
    ((given, how),), ((out, compute, named), _) = study.calls, parts.calls[0]
    assert started.calls == [((config.compute,), {})]
    assert (out, compute, how) == (config.out, config.compute, {"config": config.compute, "checkpoint": "parts"})
    return given, named


CONSISTENCY = (
    *("scenario", "motion", "gate", "start", "map", "seed"),
    *(
        "steps",
        "own_noise",
        "odometry_noise",
        "beams",
        "scan_noise",
        "exact_prior",
        "landmarks",
        "match",
        "match_every",
    ),
)


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ({}, {}),
        ({"scenario": "loop"}, {"name": "loop", "exact": False}),
        ({"motion": "euler"}, {"motion": "euler"}),
        ({"runs": 150}, {"runs": 150}),
        ({"runs": 150, "quick": True}, {"runs": 100}),
        ({"runs": 7, "quick": True}, {"runs": 7}),
        ({"gate": 0.8}, {"gate": 0.8}),
        ({"gate": None}, {"gate": None}),
        ({"start": "drawn"}, {"exact": False}),
        ({"start": "exact", "scenario": "loop"}, {"name": "loop", "exact": True}),
        ({"map": False}, {"map": False}),
        ({"seed": 5}, {"seed": 5}),
        ({"steps": 33}, {"steps": 33}),
        ({"exact_prior": True}, {"exact": False, "prior_std": (1e-3, 1e-3, 1e-3)}),
        ({"own_noise": True}, {"own": True}),
        ({"landmarks": False}, {"landmarks": 0}),
        ({"scenario": "building"}, {"name": "building", "steps": 7200, "landmarks": 0, "walls": 52}),
        ({"scenario": "random_building"}, {"name": "random_building", "steps": 7200, "landmarks": 0, "walls": 52}),
        ({"match": True}, {"period": 5, "blocks": 3}),
        ({"match": True, "match_every": 2}, {"period": 2, "blocks": 3}),
        ({"match_every": 2}, {}),
        ({"odometry_noise": 3.0, "own_noise": True}, {"noise": {"v": 0.06, "w": 0.03, "heading": 0.015}, "own": True}),
        ({"beams": 181}, {"beams": 181}),
        ({"scan_noise": 0.06, "match": True}, {"noise": {"scan": 0.06}, "period": 5, "blocks": 3, "std": 0.06}),
    ],
    ids=str,
)
def test_options_of_a_study(monkeypatch, tmp_path, options, fields):
    config = study_program.StudyConfig(**options, out=tmp_path, compute=ComputeConfig(chunk=3))
    (study, key, runs, params, world, noise, prior), named = handed_to_the_study(monkeypatch, study_program, config)
    expected = {"name": "capstone", "exact": True, "motion": "arc", "runs": 2000, "gate": 0.99, "map": True, "seed": 0}
    expected |= {"steps": 1200 if study.scenario.name == "loop" else 240, "landmarks": 4, "walls": 8, "own": False}
    expected |= {"beams": 61, "period": None, "blocks": 0, "prior_std": simulation.CAPSTONE.prior_std}
    course, own = simulation.course_params(), simulation.own_params(noise, study.scenario)
    assert isinstance(study, RandomBuildings) == (config.scenario == "random_building")
    assert {
        "steps": study.scenario.steps,
        "beams": study.scenario.beams,
        "prior_std": study.scenario.prior_std,
        "landmarks": len(world.landmarks),
        "walls": len(world.segments),
        "own": not np.array_equal(params.Q, course.Q) and np.array_equal(params.Q, own.Q),
        "period": study.config.matcher and study.config.matcher.period,
        "blocks": len(params.blocks),
        "name": study.scenario.name,
        "exact": study.scenario.exact_prior,
        "motion": study.config.motion,
        "runs": runs,
        "gate": study.config.gate_probability,
        "map": study.config.grid is not None,
        "seed": config.seed,
    } == expected | {name: value for name, value in fields.items() if name not in ("noise", "std")}
    assert same_key(key, config.seed)
    usual = simulation.Noise()._asdict() | fields.get("noise", {})
    assert {**noise._asdict(), "blocks": 0} == pytest.approx({**usual, "blocks": 0})
    if config.match:
        assert float(params.blocks["match_std"]) == pytest.approx(fields.get("std", 0.03))
    np.testing.assert_allclose(prior.mean, study.scenario.start, rtol=1e-6)
    assert named == {name: getattr(config, name) for name in CONSISTENCY}


@pytest.mark.parametrize("options", [{"odometry_noise": 0.0}, {"odometry_noise": math.inf}, {"scan_noise": -0.1}])
def test_noise_that_is_none_is_refused(tmp_path, options):
    (name,) = options
    with pytest.raises(ValueError, match=f"^{name}: expected a finite number > 0"):
        study_program.main(study_program.StudyConfig(**options, out=tmp_path))


def test_parameters_of_a_study(monkeypatch, tmp_path, plant):
    config = study_program.StudyConfig(params=plant[0], out=tmp_path)
    given, _ = handed_to_the_study(monkeypatch, study_program, config)
    np.testing.assert_allclose(given[3].Q, plant[1].Q, rtol=1e-6)


def test_the_report_of_a_study(monkeypatch, tmp_path, plant):
    """What was summed is judged beside the reference; the picture is of this study's filter."""
    for name in ("start", "study_checkpoint", "finish", "_print"):
        monkeypatch.setattr(study_program, name, Recorder())
    summarise, reference_of, pictured = Recorder({"anees": 3.5}), Recorder("reference"), Recorder()
    figure = Recorder()
    monkeypatch.setattr(study_program, "study", Recorder(RESULT))
    monkeypatch.setattr(study_program, "summarise", summarise)
    monkeypatch.setattr(study_program, "_reference", reference_of)
    monkeypatch.setattr(study_program, "_picture_of_one_run", pictured)
    monkeypatch.setattr(study_program.plotting, "study_figure", figure)
    config = study_program.StudyConfig(
        scenario="loop", motion="euler", runs=50, gate=0.9, params=plant[0], seed=6, start="exact", out=tmp_path
    )
    report = study_program.main(config)
    ((totals, settings, told), _) = summarise.calls[0]
    assert (totals, settings.gate_probability, settings.motion, told) == ("totals", 0.9, "euler", "reference")
    ((scenario, same, given, _, runs), _) = reference_of.calls[0]
    assert (scenario.exact_prior, same, given, runs) == (True, settings, config, 50)
    ((path, key, params, _, noise, drawn, how), _) = pictured.calls[0]
    assert noise == simulation.Noise()
    assert (path, drawn, how) == (tmp_path / "map.png", scenario, settings)
    assert same_key(key, 6)
    np.testing.assert_allclose(params.R, plant[1].R, rtol=1e-6)
    ((path, shown, dt), _) = figure.calls[0]
    assert (path, shown, dt) == (tmp_path / "nees.png", report, scenario.dt)
    written = json.loads((tmp_path / "report.json").read_text())
    assert {name: written[name] for name in ("scenario", "motion", "prior", "anees", "seed", "runs_per_s")} == {
        "scenario": "loop",
        "motion": "euler",
        "prior": "exact",
        "anees": 3.5,
        "seed": 6,
        "runs_per_s": 50,
    }
    np.testing.assert_allclose(written["params"]["Q"], plant[1].Q, rtol=1e-6)
    study_program.main(dataclasses.replace(config, map=False, start="drawn"))
    assert len(pictured.calls) == 1
    assert json.loads((tmp_path / "report.json").read_text())["prior"] == "drawn"
    for scenario, start in (("loop", "drawn"), ("capstone", "exact")):  # a scenario's own
        report = study_program.main(dataclasses.replace(config, map=False, start=None, scenario=scenario))
        assert report["prior"] == start
    written_by_process_0_alone(monkeypatch, study_program, config)


def written_by_process_0_alone(monkeypatch, program, config):
    """Of several processes the others keep still; all of them clear their parts."""
    (config.out / "report.json").unlink()
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    cleared = len(program.finish.calls)
    program.main(config)
    assert not (config.out / "report.json").exists()
    assert len(program.finish.calls) == cleared + 1


@pytest.mark.parametrize(("runs", "count"), [(50, 2000), (3000, 3000), (50_000, 20_000)])
def test_the_reference_has_drives_of_its_own(monkeypatch, runs, count):
    ran = Recorder(SimpleNamespace(value="reference"))
    monkeypatch.setattr(study_program, "monte_carlo", ran)
    scenario = simulation.CAPSTONE
    settings = scenario.config(motion="arc", gate_probability=0.9, grid=True)
    config = study_program.StudyConfig(seed=3, gate=0.9, compute=ComputeConfig(devices=1))
    assert study_program._reference(scenario, settings, config, simulation.room(), runs) == "reference"
    ((study, key, asked, params, *_), how) = ran.calls[0]
    assert asked == count
    assert not same_key(key, 3)
    expected = jax.random.fold_in(jax.random.key(3), 1)
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(expected))
    assert (study.scenario, study.config.motion, study.config.grid) == (scenario, "euler", None)
    assert study.config.gate_probability == 0.9
    np.testing.assert_array_equal(params.R, simulation.own_params(simulation.Noise(), scenario).R)
    assert how["devices"] == jax.local_devices()[:1]


@pytest.mark.parametrize(
    ("exact", "gate", "landmarks", "match", "needed"),
    [
        (True, None, 4, False, True),
        (False, 0.9, 4, False, True),
        (False, None, 4, False, False),
        (False, 0.9, 0, False, False),
        (True, 0.9, 4, True, False),
    ],
)
def test_a_reference_is_run_where_start_or_gate_make_something_of_a_filter(
    monkeypatch, exact, gate, landmarks, match, needed
):
    monkeypatch.setattr(study_program, "monte_carlo", Recorder(SimpleNamespace(value="reference")))
    scenario = dataclasses.replace(simulation.LOOP, exact_prior=exact)
    settings = scenario.config(gate_probability=gate)
    config = study_program.StudyConfig(gate=gate, match=match)
    room = simulation.room()
    world = room._replace(landmarks=room.landmarks[:landmarks])
    assert (study_program._reference(scenario, settings, config, world, 10) is not None) == needed


class Mapped(NamedTuple):
    log_odds: object


def test_the_picture_is_of_one_run_of_the_same_study(monkeypatch, tmp_path):
    scenario = dataclasses.replace(simulation.LOOP, steps=4)
    settings = scenario.config(motion="euler", gate_probability=0.9)
    told = []

    def drove(key, world, noise, start, *, scenario):
        told.append(scenario)
        return SimpleNamespace(pose=jnp.tile(start, (4, 1)) + noise.v), {"seed": jax.random.key_data(key)[1]}

    def ran(params, state, inputs, *, landmarks, beam_angles, config, collect):
        told.extend([config, beam_angles.shape])
        mean = jnp.stack([params.R[0, 0], inputs["seed"].astype(landmarks.dtype), landmarks[1, 0]])
        belief = SimpleNamespace(pose=SimpleNamespace(mean=jnp.tile(mean, (4, 1))))
        return Mapped(jnp.full((2, 2), 3.0)), collect(state, SimpleNamespace(belief=belief), None)

    monkeypatch.setattr(study_program.simulation, "simulate", drove)
    monkeypatch.setattr(study_program, "run", ran)
    monkeypatch.setattr(study_program.plotting, "map_figure", figure := Recorder())
    room, noise, params = simulation.room(), simulation.Noise(), simulation.course_params()
    arguments = jax.random.key(6), params, room, noise, scenario, settings
    study_program._picture_of_one_run(tmp_path / "a.png", *arguments)
    assert told == [scenario, settings, (scenario.beams,)]
    ((path, log_odds, grid, means), how) = figure.calls[0]
    assert (path, grid, log_odds.tolist()) == (tmp_path / "a.png", settings.grid, [[3, 3], [3, 3]])
    np.testing.assert_allclose(how["truth"], [np.asarray(scenario.start) + noise.v] * 4, rtol=1e-6)
    np.testing.assert_allclose(means, [[params.R[0, 0], 6, room.landmarks[1, 0]]] * 4, rtol=1e-6)
    np.testing.assert_array_equal(how["segments"], room.segments)


def test_what_consistency_shows(monkeypatch):
    monkeypatch.setattr(study_program, "show", shown := Recorder())
    monkeypatch.setattr(study_program, "print_verdicts", Recorder())
    monkeypatch.setattr(study_program.CONSOLE, "print", said := Recorder())
    monkeypatch.setattr(study_program, "pose_rows", lambda report: [("p", "", "")])
    monkeypatch.setattr(study_program, "innovation_rows", lambda report: [("i", "", "")])
    report = {
        "observations": 5,
        "anees_median_run": 2.5,
        "anees_undiverged": 3.25,
        "anees_undiverged_interval_95": (3.0, 3.5),
    }
    report |= {"nees_steps_in_band": 0.945, "nees_steps_in_band_interval_95": (0.9, 0.97), "flagged_steps": 6}
    phase = {"from_s": 1.0, "to_s": 2.5, "anees": 4.5, "band_95": (2.75, 3.25)}
    report |= {"nees_phases": [phase], "map": {"entropy_bits": 1234.5, "brier": 0.0625, "brier_base_rate": 0.125}}
    report |= {"scenario": "loop", "motion": "arc", "runs": 50, "runs_per_s": 99.6, "compile_s": 1.25, "chunk": 8}
    study_program._print(report | {"devices": 2, "processes": 3})
    (((title, rows), _),) = shown.calls
    assert title == "loop, arc motion, 50 runs"
    assert rows == [
        ("p", "", ""),
        ("median run's average NEES", "2.5", ""),
        ("ANEES of undiverged runs", "3.250 [3, 3.5]", ""),
        ("steps inside the NEES band", "94.5 % [90, 97]", "95 %"),
        ("i", "", ""),
        ("flagged steps", "6", "0"),
        ("NEES from 1 to 2.5 s", "4.5", "[2.75, 3.25]"),
        ("map entropy", "1234 bits", ""),
        ("map Brier score", "0.0625", "0 is perfect, 0.125 knows only how many"),
    ]
    words = "100 runs/s after 1.2 s of compilation, in chunks of 8 runs on 2 device(s) of 3 process(es)"
    assert said.calls == [((words,), {})]


# --- Sweeps


def swept(monkeypatch, tmp_path, **options):
    config = sweep.SweepConfig(**options, out=tmp_path, compute=ComputeConfig(chunk=3))
    given, named = handed_to_the_study(monkeypatch, sweep, config)
    assert named == {name: getattr(config, name) for name in ("x", "y", "scenario", "motion", "gate", "seed")}
    assert same_key(given[1], config.seed)
    return given


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ({}, {}),
        ({"x": "sigma_v"}, {"x": "sigma_v"}),
        ({"y": "sigma_range"}, {"y": "sigma_range"}),
        ({"scenario": "capstone"}, {"name": "capstone"}),
        ({"motion": "arc"}, {"motion": "arc"}),
        ({"runs": 77}, {"runs": 77}),
        ({"runs": 77, "quick": True}, {"runs": 50}),
        ({"gate": 0.9}, {"gate": 0.9}),
        ({"y": "outlier_rate"}, {"y": "outlier_rate", "outliers": True}),
        ({"x": "outlier_rate"}, {"x": "outlier_rate", "outliers": True}),
        ({"seed": 8}, {}),
    ],
    ids=str,
)
def test_options_of_a_sweep(monkeypatch, tmp_path, options, fields):
    one, _, runs, *_ = swept(monkeypatch, tmp_path, **options)
    expected = {"x": "Q", "y": "R", "name": "loop", "motion": "euler", "runs": 300, "gate": None, "outliers": False}
    scenario, settings = one.study.scenario, one.study.config
    assert {
        "x": one.x,
        "y": one.y,
        "name": scenario.name,
        "motion": settings.motion,
        "runs": runs,
        "gate": settings.gate_probability,
        "outliers": scenario.detector.outliers,
    } == expected | fields
    assert settings.grid is None


def test_values_of_a_sweep(monkeypatch, tmp_path, plant):
    _, _, _, x, y, params, *_ = swept(monkeypatch, tmp_path, x_values=(1.0, 2.0), y_values=(3.0, 4.0, 5.0))
    assert (x.tolist(), y.tolist()) == ([1, 2], [3, 4, 5])
    np.testing.assert_array_equal(params.R, simulation.own_params(simulation.Noise(), simulation.LOOP).R)
    _, _, _, x, y, params, *_ = swept(monkeypatch, tmp_path, y="gate_probability", quick=True, params=plant[0])
    np.testing.assert_allclose(x, 8.0 ** np.linspace(-1, 1, 5), rtol=1e-6)
    np.testing.assert_allclose(y, (0.5, 0.9, 0.99, 0.9999, 1.0), rtol=1e-6)
    np.testing.assert_allclose(params.Q, plant[1].Q, rtol=1e-6)


@pytest.mark.parametrize("name", ["Q", "R", "sigma_v", "sigma_w", "sigma_range", "sigma_bearing"])
def test_scales_go_from_an_eighth_to_eight_times_the_variance(name):
    ends = SWEPT[name].values[0], SWEPT[name].values[-1]
    expected = (1 / 8, 8) if name in "QR" else (8**-0.5, 8**0.5)
    assert ends == pytest.approx(expected)
    assert SWEPT[name].values[4] == pytest.approx(1)


@pytest.mark.parametrize("across", ["gate_probability", "outlier_rate"])
def test_the_report_of_a_sweep(monkeypatch, tmp_path, plant, across):
    """Cells row by row, each of its own totals; the gate's table is by the other parameter, whichever way round."""
    for name in ("start", "study_checkpoint", "finish", "_print"):
        monkeypatch.setattr(sweep, name, Recorder())
    monkeypatch.setattr(sweep.plotting, "sweep_figure", figure := Recorder())
    number = {"gate_probability": (0.9, 1.0), "outlier_rate": (0.1, 0.2, 0.3)}
    up = next(name for name in number if name != across)
    shape = len(number[up]), len(number[across])
    totals = {"rmse": np.arange(6.0).reshape(shape) + 1}
    monkeypatch.setattr(sweep, "study", Recorder(SimpleNamespace(**vars(RESULT) | {"value": totals})))

    def judged(totals, settings):
        assert settings.gate_probability is None
        return {"rmse_position_m": totals["rmse"], "anees": 3.0, "nis_mean": 2.0, "misfit": 0.1} | {
            "consistent": bool(totals["rmse"] > 4),
            "diverged_runs": 0,
        }

    monkeypatch.setattr(sweep, "judged_cell", judged)
    config = sweep.SweepConfig(across, up, number[across], number[up], runs=10, params=plant[0], out=tmp_path, seed=4)
    report = sweep.main(config)
    assert [cell[across] for cell in report["cells"]] == [*number[across]] * shape[0]
    assert [cell[up] for cell in report["cells"]] == [value for value in number[up] for _ in number[across]]
    assert [cell["rmse_position_m"] for cell in report["cells"]] == [1, 2, 3, 4, 5, 6]
    assert (report["consistent_cells"], report["runs"], report["seed"], report["steps"]) == (2, 10, 4, 1200)
    assert (report["x_values"], report["y_values"]) == (list(number[across]), list(number[up]))
    assert report["runs_per_s"] == 60
    assert [row["value"] for row in report["what_the_gate_buys"]] == [0.1, 0.2, 0.3]
    assert report["gate_verdict"].startswith("the gate buys ")
    np.testing.assert_allclose(report["params"]["R"], plant[1].R, rtol=1e-6)
    ((path, shown, labels, ticks), _) = figure.calls[0]
    assert (path, shown) == (tmp_path / "sweep.png", report)
    assert labels == (SWEPT[across].meaning, SWEPT[up].meaning)
    assert tuple(map(len, ticks)) == shape[::-1]
    written_by_process_0_alone(monkeypatch, sweep, config)


def shown_tables(printed):
    """Rows of each table that was printed, and the sentences."""
    tables = [args[0] for args, _ in printed.calls]
    return [
        table if isinstance(table, str) else [list(row) for row in zip(*(c.cells for c in table.columns), strict=True)]
        for table in tables
    ]


@pytest.mark.parametrize("across", ["gate_probability", "outlier_rate"])
def test_what_a_sweep_shows(monkeypatch, across):
    monkeypatch.setattr(sweep.CONSOLE, "print", printed := Recorder())
    values = {"gate_probability": [0.9, 1.0], "outlier_rate": [0.25]}
    up = next(name for name in values if name != across)
    cells = [
        {"gate_probability": gate, "outlier_rate": 0.25, "anees": anees, "consistent": anees == 3}
        | {"rmse_position_m": anees / 10, "diverged_runs": int(anees)}
        for gate, anees in ((0.9, 3.0), (1.0, 7.0))
    ]
    report = {"x": across, "y": up, "x_values": values[across], "y_values": values[up], "cells": cells}
    report |= {"what_the_gate_buys": what_the_gate_buys("outlier_rate", cells), "gate_verdict": "it buys"}
    sweep._print(report | {"verdict": "so", "runs_per_s": 99.6, "compile_s": 1.25})
    grid, gate, *said = shown_tables(printed)
    assert grid == ([["0.25", "3*", "7"]] if across == "gate_probability" else [["0.9", "3*"], ["1", "7"]])
    assert gate == [["0.25", "0.9", "0.3000 m", "3", "3", "0.7000 m", "7", "7"]]
    assert printed.calls[1][0][0].columns[0].header == "outlier_rate"
    assert said == ["it buys", "so", "100 runs/s, every cell's counted, after 1.2 s of compilation"]
    assert sweep._figures(None) == ("–", "–", "–")


# --- The course's run


def test_the_course_draws_are_those_of_its_seed():
    """In the order of its program, in which a step's heading comes before its speed and yaw rate."""
    scenario = dataclasses.replace(simulation.CAPSTONE, steps=12)
    drawn = reference.course_draws(seed=9, steps=12)
    draws = capstone.course_draws(9, scenario, 4)
    drive, observation, scan = (np.asarray(x) for x in draws)
    close = {"rtol": 1e-6}
    np.testing.assert_allclose(drive * [0.005, 0.02, 0.01], np.c_[drawn["heading"], drawn["control"]], **close)
    np.testing.assert_allclose(observation * [0.08, 0.02], np.nan_to_num(drawn["detector"]), **close)
    np.testing.assert_allclose(scan * 0.03, drawn["scan"], **close)


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_that_numpy_has_not(seed):
    with pytest.raises(ValueError, match=f"seed: expected 0 to .* got {seed}"):
        capstone.course_draws(seed, simulation.CAPSTONE, 4)


def test_the_detector_of_the_course_goes_by_what_it_measures(monkeypatch):
    rolled = Recorder(("truth", SimpleNamespace(_replace=lambda **new: new, valid=np.array([[1, 1], [0, 1]], bool))))
    rolled.answer[1].z = np.array([[[7.4, 0.0], [7.5, 0.0]], [[1.0, 0.0], [2.0, 9.0]]])
    monkeypatch.setattr(capstone, "course_draws", draws := Recorder("draws"))
    monkeypatch.setattr(capstone.simulation, "roll_out", rolled)
    world = simulation.room()
    truth, inputs = capstone.course_drive(17, simulation.CAPSTONE, world)
    assert (truth, inputs["valid"].tolist()) == ("truth", [[True, False], [False, True]])
    assert draws.calls[0][0] == (17, simulation.CAPSTONE, 4)
    assert rolled.calls[0][1]["scenario"].detector.max_range == math.inf


@pytest.fixture
def course_report(monkeypatch, tmp_path):
    """Of four steps made up, on a map of 2 x 2 cells' worth of log-odds; and what the figures are given."""
    truth = np.array([[0, 0, 0], [1, 1, 0], [2, 2, 3.1], [3, 3, 0]], float)
    off = np.array([[0.3, 0.4, 0], [0, 0, 0.2], [0, 0, 0.1 - 2 * math.pi], [0, 0.5, 0]])
    belief = Gaussian(truth - off, np.array([np.diag([0.25, 0.25, 0.01])] * 4))
    scenario = like(
        simulation.CAPSTONE, steps=4, robot=dict(grid=dataclasses.replace(simulation.CAPSTONE.robot.grid, shape=(2, 3)))
    )
    monkeypatch.setattr(capstone.simulation, "CAPSTONE", scenario)
    log_odds = np.array([[0.0, 2.0, -1.0], [0.0, 0.0, 3.0]])
    valid = np.array([[1, 1], [1, 0], [1, 1], [0, 0]], bool)
    accepted = np.array([[1, 1], [0, 0], [1, 0], [0, 0]], bool)
    drove = Recorder((SimpleNamespace(pose=truth), SimpleNamespace(valid=valid)))
    state = SimpleNamespace(belief=jax.tree.map(lambda x: x[-1], belief), log_odds=log_odds)
    ran = Recorder((state, SimpleNamespace(belief=belief, accepted=accepted)))
    occupied = np.array([[1, 1, 0], [1, 1, 1]], bool)
    monkeypatch.setattr(capstone, "course_drive", drove)
    monkeypatch.setattr(capstone, "run", ran)
    monkeypatch.setattr(capstone.simulation, "occupancy", Recorder(occupied))
    figures = {name: Recorder() for name in ("trajectory_figure", "map_figure")}
    for name, figure in figures.items():
        monkeypatch.setattr(capstone.plotting, name, figure)
    report = capstone.main(capstone.CapstoneConfig(seed=11, out=tmp_path / "made"))
    assert json.loads((tmp_path / "made" / "report.json").read_text())["seed"] == 11
    return report, drove, ran, figures, belief, truth, log_odds


def test_numbers_of_the_course_s_run(course_report):
    report, drove, ran, figures, belief, truth, log_odds = course_report
    assert drove.calls[0][0][0] == report["seed"] == 11
    np.testing.assert_allclose(report["final_pose"], truth[3] - [0, 0.5, 0], rtol=1e-12)
    np.testing.assert_allclose(report["final_cov_diag"], [0.25, 0.25, 0.01], rtol=1e-12)
    assert report["rmse_position_m"] == pytest.approx(math.sqrt((0.25 + 0.25) / 4))
    assert report["rmse_yaw_rad"] == pytest.approx(math.sqrt((0.04 + 0.01) / 4))
    assert report["nees_mean"] == pytest.approx((1 + 4 + 1 + 1) / 4)
    assert (report["observations"], report["gate_accept_rate"]) == (5, 3 / 5)
    p = reference.probability(log_odds)
    assert report["occupancy_min"] == pytest.approx(p.min())
    assert report["occupancy_max"] == pytest.approx(p.max())
    assert report["occupancy_mean"] == pytest.approx(p.mean())
    assert report["map_entropy_bits"] == pytest.approx(-np.sum(p * np.log2(p) + (1 - p) * np.log2(1 - p)))
    seen = [(p[0, 1] - 1) ** 2, p[0, 2] ** 2, (p[1, 2] - 1) ** 2]  # of known cells alone
    assert report["map_brier"] == pytest.approx(np.mean(seen))
    (params, *_), how = ran.calls[0]
    np.testing.assert_allclose(params.R, np.diag([0.15, 0.03]) ** 2, rtol=1e-6)
    assert how["config"].motion == "capstone"
    ((_, estimate, cov, true), how) = figures["trajectory_figure"].calls[0]
    np.testing.assert_array_equal(estimate, belief.mean)
    np.testing.assert_array_equal(cov, belief.cov)
    np.testing.assert_array_equal(true, truth)
    np.testing.assert_array_equal(how["landmarks"], simulation.room().landmarks)
    ((_, odds, grid, path), how) = figures["map_figure"].calls[0]
    np.testing.assert_array_equal(odds, log_odds)
    np.testing.assert_array_equal(path, belief.mean)
    np.testing.assert_array_equal(how["truth"], truth)
    assert grid.shape == (2, 3)


# --- Float32 against float64


@pytest.mark.parametrize(
    ("options", "studies"),
    [
        ({}, [(80, 6, 1.0), (120, 4, 1.0), (80, 6, 10.0), (80, 6, 100.0)]),
        ({"quick": True}, [(80, 6, 1.0), (80, 6, 10.0), (80, 6, 100.0)]),
        ({"quick": True, "runs": (90, 4)}, [(80, 64, 1.0), (80, 64, 10.0), (80, 64, 100.0)]),
        ({"sharper": ()}, [(80, 6, 1.0), (120, 4, 1.0)]),
    ],
)
def test_options_of_precision(monkeypatch, tmp_path, options, studies):
    rows = []

    def row(seed, steps, runs, sharper, progress):
        assert seed == 12
        rows.append((steps, runs, sharper))
        return {"runs": runs, "verdict": f"{steps} {sharper:g}"}

    for name in ("start", "_print"):
        monkeypatch.setattr(precision, name, Recorder())
    monkeypatch.setattr(precision, "_row", row)
    monkeypatch.setattr(precision.plotting, "precision_figure", figure := Recorder())
    config = {"steps": (80, 120), "runs": (6, 4), "sharper": (10.0, 100.0), "seed": 12} | options
    report = precision.main(precision.PrecisionConfig(**config, out=tmp_path))
    assert rows == studies
    plain = [f"{steps} 1" for steps, _, sharper in studies if sharper == 1]
    assert [each["verdict"] for each in report["drives"]] == plain
    assert len(report["sharper_detectors"]) == len(studies) - len(plain)
    assert report["verdict"] == [f"{steps} {sharper:g}" for steps, _, sharper in studies]
    assert (report["seed"], figure.calls[0][0][1]) == (12, report["drives"])


@pytest.mark.parametrize(("steps", "name"), [(240, "capstone"), (80, "loop"), (10_000, "loop")])
def test_a_drive_of_the_course_s_length_is_the_course_s(monkeypatch, steps, name):
    ran = Recorder()
    monkeypatch.setattr(precision, "monte_carlo", lambda *args, **how: ran(*args, **how) or stop())
    with pytest.raises(Enough):
        precision._row(5, steps, 3, 1.0, None)
    ((study, key, runs, *_), how) = ran.calls[0]
    assert (study.scenario.name, study.scenario.steps, runs, how["keep_runs"]) == (name, steps, 3, True)
    assert (study.config.motion, study.config.gate_probability, study.config.grid) == ("euler", None, None)
    assert same_key(key, 5)


def test_the_words_on_float32():
    ahead, behind = np.full(20, 2e-6), np.full(20, 3e-6)
    single = {
        "not_definite_steps": 0,
        "anees_difference": -1e-5,
        "anees_difference_standard_error": 2e-6,
        "position_difference_per_bin_m": np.r_[ahead, behind],
        "largest_position_difference_m": 3e-6,
    }
    double, short = {"anees_standard_error": 0.03}, {"not_definite_steps": 7}
    row = {"steps": 1200, "runs": 5, "detector_sharper": 1.0, "float64": double, "float32": single, "short_form": short}
    assert precision.verdict(row) == (
        "1,200 steps: no cost to be seen, ANEES -1.0e-05 ± 2e-06 where the study knows it to 0.03; the positions part "
        "by 3.0e-06 m at most, in the second half of the drive 1.50 times as far as in the first"
    )
    single["anees_difference"] = -0.03  # as large as what is known
    assert precision.verdict(row) == "1,200 steps: float32 costs consistency; ANEES -3.0e-02 ± 2e-06"
    single["not_definite_steps"] = 11
    assert precision.verdict(row | {"detector_sharper": 100.0}) == (
        "100 times sharper: float32 breaks 11 of 6,000 covariances, 7 with the short form; ANEES -3.0e-02 ± 2e-06"
    )


@pytest.mark.parametrize(("sharper", "head"), [(1.0, "1,200 steps"), (100.0, "100 times")])
def test_what_precision_shows(monkeypatch, sharper, head):
    monkeypatch.setattr(precision.CONSOLE, "print", printed := Recorder())
    names = ("anees", "rmse_position_m", "rmse_yaw_rad")
    double = {name: i + 1.0 for i, name in enumerate(names)} | {f"{name}_standard_error": 0.5 for name in names}
    counts = {"not_definite_steps": 1, "flagged_steps": 2}
    row = {"steps": 1200, "runs": 5, "detector_sharper": sharper, "float64": double | counts}
    for k, which in enumerate(("float32", "short_form"), start=1):
        row[which] = {f"{name}_difference": k * (i + 1e-3) for i, name in enumerate(names)}
        row[which] |= {f"{name}_difference_standard_error": 0.25 * k for name in names}
        row[which] |= {"not_definite_steps": 10 * k, "flagged_steps": 2000 * k}
        row[which] |= {"largest_position_difference_m": k * 1e-6, "largest_yaw_difference_rad": k * 2e-6}
        row[which] |= {"largest_covariance_difference": k * 3e-6}
    precision._print("title", [row])
    (table,) = (args[0] for args, _ in printed.calls)
    assert (table.title, table.columns[1].header) == ("title", head)
    cells = dict(shown_tables(printed)[0][i] for i in (0, 1, 4, 10, 11, 12, 13, 14))
    assert cells == {
        "runs": "5",
        "ANEES (3), float64": "1 ± 0.5",
        "position RMSE, m, float64": "2 ± 0.5",
        "not positive definite, steps": "1 / 10 / 20",
        "flagged by the filter, steps": "2 / 2,000 / 4,000",
        "largest position difference, m": "1.0e-06 / 2.0e-06",
        "largest yaw difference, rad": "2.0e-06 / 4.0e-06",
        "largest covariance difference, σσ": "3.0e-06 / 6.0e-06",
    }
    differences = [row[1] for row in shown_tables(printed)[0]][2:10]
    assert differences[:2] == ["+1.0e-03 ± 0.2", "+2.0e-03 ± 0.5"]
    assert differences[3:5] == ["+1.0e+00 ± 0.2", "+2.0e+00 ± 0.5"]


# --- Verdicts on honest filters


def test_options_of_verdicts(monkeypatch, tmp_path):
    for name in ("merge_kernels", "use_all_cores", "_print"):
        monkeypatch.setattr(verdicts, name, Recorder())
    studies, singles = [], []
    monkeypatch.setattr(verdicts, "_studies", lambda *args: studies.append(args) or {"n": len(studies)})
    monkeypatch.setattr(verdicts, "_single_runs", lambda *args: singles.append(args) or {"n": len(singles)})
    report = verdicts.main(verdicts.VerdictsConfig(studies=5, runs=6, seed=7, out=tmp_path))
    assert [(s.name, s.exact_prior, gate) for _, s, gate, *_ in studies] == [
        (name, exact, gate) for name in ("loop", "capstone") for exact in (False, True) for gate in (None, 0.99)
    ]
    assert {each[3:] for each in studies} == {(5, 6)}
    assert [(s.name, s.steps, s.exact_prior, count) for _, s, count in singles] == [
        ("long loop", 10_000, False, 5),
        ("loop", 1200, False, 5),
        ("capstone", 240, False, 5),
    ]
    keys = {tuple(np.asarray(jax.random.key_data(key)).tolist()) for key, *_ in studies + singles}
    assert len(keys) == 11
    np.testing.assert_array_equal(
        jax.random.key_data(studies[2][0]), jax.random.key_data(jax.random.fold_in(jax.random.key(7), 2))
    )
    assert (report["studies"], report["runs"], report["seed"], report["settings"][7]) == (5, 6, 7, {"n": 8})
    verdicts.main(verdicts.VerdictsConfig(studies=5, runs=6, out=tmp_path, quick=True))
    assert {each[3:] for each in studies[8:]} == {(4, 30)}
    for name in ("studies", "runs"):
        with pytest.raises(ValueError, match=f"{name}: expected at least 2"):
            verdicts.main(verdicts.VerdictsConfig(**{name: 1}, out=tmp_path))


@pytest.mark.parametrize(("exact", "gate", "beside"), [(False, None, False), (True, None, True), (False, 0.99, True)])
def test_studies_are_counted_by_their_verdicts(monkeypatch, exact, gate, beside):
    """Each beside a reference of other drives, where start or gate make something of a filter."""
    words = iter(["consistent", "over-confident: the gate", "not consistent", "under-confident: x"])
    told = iter(["consistent", "consistent", "over-confident: exact start", "over-confident"])
    ran, runs = [], 6

    def monte_carlo(study, key, count, *args):
        ran.append((tuple(np.asarray(jax.random.key_data(key)).tolist()), count))
        totals = SimpleNamespace(average=SimpleNamespace(nees=3.0 * len(ran)), scored_runs=runs)
        return SimpleNamespace(value=totals)

    def summarise(*pair):
        return {"verdict": next(words if len(pair) == 2 else told)}

    monkeypatch.setattr(verdicts, "monte_carlo", monte_carlo)
    monkeypatch.setattr(verdicts, "summarise", summarise)
    monkeypatch.setattr(verdicts, "_factor_intervals", Recorder("factors"))
    monkeypatch.setattr(verdicts, "_intervals", Recorder("intervals"))
    scenario = dataclasses.replace(simulation.LOOP, exact_prior=exact)
    row = verdicts._studies(jax.random.key(0), scenario, gate, 4, runs)
    assert row["setting"] == f"loop, {'exact' if exact else 'drawn'}" + (", gate" if gate else "")
    assert row["anees"] == pytest.approx(3 * 2.5 / runs)
    assert (row["dishonest"], row["dishonest_unexplained"]) == (3 / 4, 2 / 4)
    assert row["dishonest_beside_reference"] == (2 / 4 if beside else None)
    assert row["unexplained_beside_reference"] == (1 / 4 if beside else None)
    assert row["factor"] == ("factors" if gate is None else None)
    assert [count for _, count in ran] == [runs] * 4 + [2000] * (4 * beside)
    assert len({key for key, _ in ran}) == len(ran)


def test_a_factor_is_held_where_its_interval_has_it(monkeypatch):
    """The ratio's interval beside a reference, the ANEES over its three degrees without."""
    monkeypatch.setattr(verdicts, "pose_means", lambda totals, settings: SimpleNamespace(nees=totals))
    monkeypatch.setattr(verdicts, "_scaled", lambda totals, scale: (totals, scale))
    monkeypatch.setattr(verdicts.consistency, "ratio", lambda nees, told: SimpleNamespace(interval_95=told))
    # By the scale, 1 / scale is 2, 1.25, 0.8, 0.5.
    beside = verdicts._factor_intervals(["a", "b"], [(0.8, 1.25), (1.0, 3.0)], None)
    assert beside == {"0.5": 0.5, "0.8": 1.0, "1.25": 0.5, "2": 0.0}
    monkeypatch.setattr(
        verdicts, "pose_means", lambda totals, settings: SimpleNamespace(nees=SimpleNamespace(interval_95=totals[0]))
    )
    alone = verdicts._factor_intervals([(2.4, 3.75), (3.0, 9.0)], [], None)
    assert alone == beside


def test_a_covariance_twice_as_large_halves_the_nees():
    class Sums(dict):
        __getattr__ = dict.__getitem__

        def _replace(self, **new):
            return Sums(self | new)

    totals = Sums(average=Sums(nees=12.0, yaw=1.0), average_square=Sums(nees=40.0, yaw=1.0))
    scaled = verdicts._scaled(totals, 2.0)
    assert (scaled.average.nees, scaled.average_square.nees) == (6.0, 10.0)
    assert (scaled.average.yaw, scaled.average_square.yaw) == (1.0, 1.0)


def test_intervals_hold_what_all_studies_together_say(monkeypatch):
    """Of every share, axis and correlation by its own name, ends included."""
    assert verdicts._held(np.array([[1.0, 0, 2], [3.0, 2, 4], [2.0, 2.5, 3], [2.0, 1, 1.5]])) == 0.5
    reports = []
    for value in (0.5, 0.75):
        report = {f"coverage_{p}": value for p in (50, 90, 95, 99)}
        report |= {f"coverage_{p}_interval_95": (0.6, 0.7) for p in (50, 90, 95)} | {"coverage_99_interval_95": (0, 0)}
        for field in ("axis_nees", "within_two_sigma"):
            report[field] = dict.fromkeys(("x", "y", "yaw"), value)
            report[f"{field}_interval_95"] = {"x": (value, value), "y": (0.5, 0.625), "yaw": (0.625, 0.75)}
        report["innovation_lag_one"] = {"range": value, "bearing": value}
        report["innovation_lag_one_band_95"] = {"range": 0.125, "bearing": 0.0625}
        reports.append(report)
    monkeypatch.setattr(verdicts, "summarise", lambda totals, settings: reports[totals])
    held = verdicts._intervals([0, 1], None)
    shares = {f"coverage_{p}": float(p != 99) for p in (50, 90, 95, 99)}
    axes = {f"{f} {axis}": float(axis != "x") for f in ("axis_nees", "within_two_sigma") for axis in ("x", "y", "yaw")}
    assert held == shares | axes | {"lag one range": 1.0, "lag one bearing": 0.0}


def test_single_runs_are_judged_one_by_one(monkeypatch):
    judged = iter(
        [(2.5, (2.0, 4.0), "consistent"), (4.5, (2.0, 4.0), "over-confident"), (2.0, (2.0, 4.0), "undecided: x")]
    )
    runs, samples = [], iter((10.0, 50.0, 33.0))

    def monte_carlo(single, key, count, params, world, noise, prior, keep_runs):
        assert (count, keep_runs, single.scenario) == (1, True, simulation.LOOP)
        runs.append(tuple(np.asarray(jax.random.key_data(key)).tolist()))
        np.testing.assert_array_equal(params.R, simulation.own_params(noise, simulation.LOOP).R)
        return SimpleNamespace(value=(np.ones((1, 5, 3)), Gaussian(np.zeros((1, 5, 3)), np.zeros((1, 5, 3, 3)))))

    def judge(truth, mean, cov):
        assert (truth.shape, mean.shape, cov.shape) == ((5, 3), (5, 3), (5, 3, 3))
        assert truth.sum() == 15
        anees, band, words = next(judged)
        return {"anees": anees, "anees_band_95": band, "verdict": words, "independent_samples": next(samples)}

    monkeypatch.setattr(verdicts, "monte_carlo", monte_carlo)
    monkeypatch.setattr(verdicts.consistency, "judge", judge)
    row = verdicts._single_runs(jax.random.key(0), simulation.LOOP, 3)
    assert len(set(runs)) == 3
    assert row == {
        "scenario": "loop",
        "steps": 1200,
        "independent_samples": 33.0,
        "anees": 3.0,
        "band_holds": 2 / 3,
        "dishonest": 1 / 3,
        "undecided": 1 / 3,
    }


@pytest.mark.parametrize(
    ("words", "dishonest", "explained"),
    [
        ("over-confident: covariance 2 times too small", True, False),
        ("under-confident by its exact start", True, True),
        ("not consistent: the gate", True, True),
        ("consistent", False, False),
        ("undecided", False, False),
        ("no verdict", False, False),
    ],
)
def test_words_that_call_a_filter_dishonest(words, dishonest, explained):
    assert (verdicts._dishonest(words), verdicts._explained(words)) == (dishonest, explained)


def test_shares_of_verdicts_are_shown_in_percent(monkeypatch):
    monkeypatch.setattr(verdicts.CONSOLE, "print", shown := Recorder())
    row = {
        "setting": "loop, drawn",
        "anees": 3.0125,
        "dishonest": 0.05,
        "dishonest_unexplained": 0.04,
        "dishonest_beside_reference": None,
        "unexplained_beside_reference": 0.0,
        "factor": {"0.5": 0.9, "0.8": 0.91, "1.25": 0.92, "2": 0.93},
        "intervals": {"a": 0.95, "b": 0.5, "c": 1.0},
    }
    single = {"scenario": "loop", "steps": 1200, "independent_samples": 55.4, "band_holds": 0.9}
    single |= {"dishonest": 0.1, "undecided": 0.2}
    verdicts._print({"settings": [row], "single_runs": [single]})
    tables = [[next(iter(column.cells)) for column in table.columns] for ((table,), _) in shown.calls]
    assert tables == [
        ["loop, drawn", "3.013", "5.0 %", "4.0 %", "–", "0.0 %"],
        ["loop, drawn", "90.0 %", "91.0 %", "92.0 %", "93.0 %", "50.0 % (b)", "100.0 % (c)"],
        ["loop", "1,200", "55", "90.0 %", "10.0 %", "20.0 %"],
    ]
