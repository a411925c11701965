"""`tune --match`: the drives it tunes on, the worlds it judges by, and what it says of them."""

import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import Recorder

from jaxlocmap import Gaussian, simulation, tuning
from jaxlocmap.cli import tune, tune_matching, tune_sources
from jaxlocmap.cli.tune_sources import Wanted
from jaxlocmap.matching.submaps import with_defaults

pytestmark = pytest.mark.usefixtures("as_a_program")
WANTED = Wanted(("pose_nll",), None, 0.9999, 0.99, 3, False)
CIRCLE = np.array([6.0, 5.4]) + 3 * np.stack([f(np.linspace(0, 2 * np.pi, 720)) for f in (np.cos, np.sin)], axis=1)


@pytest.fixture
def simulated(monkeypatch):
    """What is simulated, without simulating it: drives along x, 1 m a step, in another place for every run."""

    def made(key, count, around, noise, *, scenario, **how):
        drives(key, count, around, noise, scenario=scenario, **how)
        x = np.arange(count)[:, None] * 1000.0 + np.arange(1, scenario.steps + 1)
        truth = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)
        prior = Gaussian(truth[:, 0] - np.eye(3)[0], np.tile(np.eye(3), (count, 1, 1)))
        inputs = jax.tree.map(lambda x: np.tile(x, (count, *[1] * x.ndim)), tuning.no_observations(scenario.steps))
        known = np.ones(x.shape, bool)
        return tuning.Batch(prior, inputs, known, truth=truth, known=known, landmarks=around.landmarks[0])

    drives = Recorder()
    monkeypatch.setattr(tune_matching.tuning, "simulated", made)
    return drives


def test_the_boxes_of_rooms_differ_and_stand_clear_of_the_drive(simulated):
    tune_matching.in_rooms(jax.random.key(1), 12, 50)
    ((_, count, worlds, noise), how) = simulated.calls[0]
    assert (count, noise, how["scans"], how["worlds"]) == (12, simulation.Noise(), True, True)
    assert (how["scenario"].steps, how["scenario"].command) == (50, simulation.LOOP.command)
    assert (how["scenario"].exact_prior, how["scenario"].prior_std) == (False, (1e-3,) * 3)
    assert worlds.landmarks.shape == (12, 0, 2)
    boxes = np.asarray(worlds.segments)[:, 4:].reshape(12, -1, 2)
    assert len({box.tobytes() for box in boxes}) == 12
    np.testing.assert_array_equal(worlds.segments[:, :4], np.tile(simulation.room().segments[:4], (12, 1, 1, 1)))
    for low, high in zip(boxes.min(axis=1), boxes.max(axis=1), strict=True):
        away = np.hypot(*np.maximum(np.maximum(low - CIRCLE, CIRCLE - high), 0).T)
        assert away.min() > 0.39


def test_drives_in_buildings_begin_one_after_the_other_along_the_tour_where_the_robot_is(simulated):
    pieces = tune_matching.in_buildings(jax.random.key(1), 5, 1000)  # of 2,400 steps: from 0, 1,000 and 2,000 on
    ((_, count, worlds, _), how) = simulated.calls[0]
    assert (count, how["scenario"].steps, how["scenario"].command) == (5, 2400, simulation.BUILDING.command)
    assert len({np.asarray(walls).tobytes() for walls in worlds.segments}) == 5
    begins = np.array([0, 1000, 2000, 0, 1000]) + 1000.0 * np.arange(5)
    np.testing.assert_array_equal(pieces.prior.mean[:, 0], begins)
    np.testing.assert_array_equal(pieces.truth[:, 0, 0], begins + 1)
    np.testing.assert_allclose(pieces.prior.cov[1], 1e-6 * np.eye(3))


def test_what_is_tuned_on_validated_and_judged(monkeypatch):
    batches, studies = Recorder(), Recorder(SimpleNamespace(value="totals"))
    for name in ("in_rooms", "in_buildings"):
        monkeypatch.setattr(tune_matching, name, lambda *args, name=name: batches(name, *args) or (name, args[1]))
    monkeypatch.setattr(tune_matching.tuning, "join", lambda *parts: parts)
    monkeypatch.setattr(tune_sources, "monte_carlo", studies)
    monkeypatch.setattr(tune_sources, "summarise", lambda totals, config: {"anees": 3.0, "of": config})
    source = tune_matching.from_drawn_worlds("euler", 9, 70, WANTED)
    assert source.train == source.compared == (("in_rooms", 4), ("in_buildings", 5))
    assert source.validation == (("in_rooms", 1), ("in_buildings", 1))
    assert len({np.asarray(jax.random.key_data(args[1])).tobytes() for args, _ in batches.calls}) == 4
    assert {args[3] for args, _ in batches.calls} == {300}
    config = source.config
    assert (config.motion, config.gate_probability, config.gate_temperature) == ("euler", 0.9999, 2.0)
    assert (config.grid, config.matcher) == (None, tune_matching.MATCHER)
    assert source.start.blocks.keys() == {"match_std", "match_scale", "map_length"}
    evidence = source.evidence(source.start)
    assert list(evidence) == ["loop", "building"]
    for (study, _, runs, params, world, _, _), _ in studies.calls:
        assert (runs, study.config.gate_probability, study.config.matcher) == (70, 0.99, config.matcher)
        assert (study.scenario.prior_std, world.landmarks.shape) == ((1e-3,) * 3, (0, 2))
        assert params.blocks["match_std"].dtype == jnp.float32
    (loop, *_), (building, *_) = (args for args, _ in studies.calls)
    assert (loop.scenario.steps, building.scenario.steps) == (2400, 7200)
    given = with_defaults(simulation.course_params(), std=0.02)
    wanted = dataclasses.replace(WANTED, start=given, quick=True)
    assert tune_matching.from_drawn_worlds("euler", 9, 70, wanted).start is given
    assert batches.calls[-1][0][3] == 100  # steps of a quick run


def test_parameters_are_reported_with_their_units():
    config = dataclasses.replace(simulation.LOOP.config(grid=False), matcher=tune_matching.MATCHER)
    objective = tuning.Objective(config, (("pose_nll", 1.0),))
    start = with_defaults(simulation.course_params())
    end = with_defaults(simulation.course_params(), std=0.02)
    names, two = ("v", "match_std"), np.array([0.002, 0.001])
    sure = tuning.StandardErrors(names, two, two, np.outer(two, [1, 3]), np.eye(2), np.eye(2), ())
    report = tune._parameters(objective, start, end, sure)
    assert [report[name]["unit"] for name in names] == ["m/s", "m"]
    assert [report["match_std"][when] for when in ("start", "end")] == pytest.approx([0.03, 0.02])


def test_each_world_that_judges_has_its_figure_and_its_rows(monkeypatch, tmp_path, capsys):
    figure = Recorder()
    monkeypatch.setattr(tune.plotting, "descent_figure", lambda *_: None)
    monkeypatch.setattr(tune.plotting, "study_before_after_figure", figure)
    of_worlds = {name: {"anees": 2.5, "nis_mean": np.nan, "nees_band_95": [2, 4]} for name in ("loop", "building")}
    report = {"source": "drives", "parameters": {}, "loss": {}, "not_identified": [], "evaluations": 1}
    report |= {"run_s": 1.0, "compile_s": 1.0, "skipped_steps": 0}
    source = SimpleNamespace(validation=None, name="drives", dt=0.1)
    files = tune._figures(tmp_path, source, report, of_worlds, of_worlds)
    assert files == ["descent.png", "nees_loop.png", "nees_building.png"]
    assert [args[0] for args, _ in figure.calls] == [tmp_path / name for name in files[1:]]
    tune._print(report | {"held_out": {"before": of_worlds, "after": of_worlds}})
    said = capsys.readouterr().out
    assert said.count("ANEES") == 2
    assert "NIS" not in said  # nothing is observed


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"scenario": "loop"}, "scenario: with match each drive has its own world: expected none, got loop"),
        ({"loss": ("innovation_nll",)}, "expected pose_nll, mse or nees alone, got innovation_nll"),
        ({"loss": ("pose_nll", "map")}, "expected pose_nll, mse or nees alone, got pose_nll, map"),
        ({"full": True}, "expected pose_nll, mse or nees alone, got pose_nll and full"),
        (
            {"log": Path("nowhere"), "format": "woods"},
            "match: applies to scenario, not to a woods log: expected it not to be given, got True",
        ),
    ],
)
def test_what_does_not_go_with_matching_is_named(settings, expected):
    with pytest.raises(ValueError, match=re.escape(expected)):
        tune.checked(tune.TuneConfig(**({"match": True, "loss": ("pose_nll",)} | settings)))


def test_what_is_not_given_has_its_default():
    quick, plain = (tune.checked(tune.TuneConfig(match=True, loss=("pose_nll",), quick=q)) for q in (True, False))
    assert [(c.runs, c.judge_runs) for c in (quick, plain)] == [(4, 4), (24, 100)]
    assert tune.tuned_parameters(plain) == tune_matching.MATCHING_NOISE
    assert tune.tuned_parameters(tune.TuneConfig(match=True, tune=("v",))) == ("v",)
