"""float32 against float64: the three filters are what they are called, and the statistics those of their definition."""

import dataclasses
import json
import math
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import Gaussian, Inputs, Params, init, simulation
from jaxlocmap.monte_carlo import monte_carlo

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import precision

STEPS, RUNS = 80, 6
SHORT = dataclasses.replace(simulation.LOOP, steps=STEPS)
CONFIG = SHORT.config(motion="euler", gate_probability=None, grid=False)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """What the program writes about six short drives, and about as many with a detector no float32 can follow."""
    out = tmp_path_factory.mktemp("precision")
    config = precision.PrecisionConfig(steps=(STEPS,), runs=(RUNS,), sharper=(1e4,), out=out)
    return precision.main(config), out


@pytest.fixture(scope="module")
def outcome():
    """Every drive's own scores."""
    with jax.enable_x64(True):
        study = precision.Precision(SHORT, CONFIG)
        noise = simulation.Noise()
        arguments = (simulation.own_params(noise, SHORT), simulation.room(), noise, SHORT.prior())
        return monte_carlo(study, jax.random.key(0), RUNS, *arguments, keep_runs=True).value


def test_the_filter_in_float64_is_the_reference(outcome):
    with jax.enable_x64(True):
        prior, world, noise = SHORT.prior(), simulation.room(), simulation.Noise()
        params = simulation.own_params(noise, SHORT)

        @jax.jit
        def drive(key):
            start_key, key = jax.random.split(key)
            start = simulation.draw_state(start_key, prior)
            return simulation.simulate(key, world, noise, start, scenario=SHORT, scan=False)

        scene = (*map(np.asarray, (world.landmarks, params.Q, params.R)), math.inf, reference.euler, SHORT.dt)
        for i in range(2):
            truth, inputs = jax.tree.map(np.asarray, drive(jax.random.fold_in(jax.random.key(0), i)))
            filtered = reference.run(*map(np.asarray, prior), *inputs[:5], *scene)
            error = truth.pose - filtered["mean"]
            error[:, 2] = reference.wrap(error[:, 2])
            nees = np.array([reference.nees(*each) for each in zip(error, filtered["cov"], strict=True)])
            bins = lambda values: values.reshape(precision.BINS, -1).sum(1)  # noqa: E731
            np.testing.assert_allclose(outcome.double.nees[i], bins(nees), rtol=1e-9)
            np.testing.assert_allclose(outcome.double.position_square[i], bins((error[:, :2] ** 2).sum(1)), rtol=1e-9)
            np.testing.assert_allclose(outcome.double.yaw_square[i], bins(error[:, 2] ** 2), rtol=1e-9)
    assert outcome.double.scored.sum() == RUNS * STEPS
    assert outcome.double.flagged.sum() == outcome.double.not_definite.sum() == 0


def test_the_other_two_filters_are_the_same_but_for_the_rounding_of_float32(outcome):
    assert np.any(outcome.double.position_square > 0)
    for gap in (outcome.single_gap, outcome.short_gap):
        assert 1e-8 < gap.position.max() < 2e-5  # m; positions are near 9 m, where float32 has steps of 1e-6
        assert 1e-9 < gap.yaw.max() < 1e-5
        assert 1e-8 < gap.cov.max() < 1e-4
    assert not np.array_equal(outcome.single_gap.cov, outcome.short_gap.cov)  # two different updates


def test_the_short_form_is_the_short_form():
    """Of one observation, as NumPy has it in float64; and its rounding is not mirrored, as that of Joseph's form is."""
    inputs = precision.in_single(
        Inputs(
            dt=jnp.zeros(1),
            control=jnp.zeros((1, 2)),
            landmark=jnp.array([[1]], jnp.int32),
            z=jnp.array([[[5.1, 0.9]]]),
            valid=jnp.array([[True]]),
        )
    )
    cov = np.array([[9.0, 1.0, 0.5], [1.0, 4.0, 0.3], [0.5, 0.3, 1.0]], np.float32)
    landmarks, R = np.array([[9.0, 9.0], [3.0, 4.0]], np.float32), np.diag([0.1, 0.2]).astype(np.float32) ** 2
    params = Params(*precision.in_single((jnp.eye(2), jnp.array(R), jnp.array(1.0), jnp.array(-1.0))))
    prior = Gaussian(jnp.zeros(3, np.float32), jnp.array(cov))
    state, (_, ok) = jax.jit(precision.short_form_run, static_argnames="config")(
        params, init(prior, config=CONFIG), inputs, jnp.array(landmarks), config=CONFIG
    )
    last = state.belief
    z, H = reference.expected_observation(np.zeros(3), landmarks[1])
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
    np.testing.assert_allclose(last.cov, (np.eye(3) - K @ H) @ cov, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(last.mean, K @ (np.array([5.1, 0.9]) - z), rtol=1e-4)
    assert bool(ok.all())
    assert not np.array_equal(last.cov, last.cov.T)


def test_a_score_counts_what_its_fields_say(x64):
    """Three steps: an honest one, a covariance with a negative pivot, one that is no number."""
    cov = np.stack([np.diag([4.0, 1.0, 0.25]), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)])
    mean = np.array([[1.0, 2.0, 0.5], [0.0, 0.0, 1.0], [0.0, 3.0, 0.0]])
    beliefs = Gaussian(jnp.array(mean, np.float32), jnp.array(cov, np.float32))
    score = jax.jit(precision._score)(jnp.zeros((3, 3)), beliefs, jnp.array([True, True, False]))
    assert score.nees.dtype == np.float64
    assert (int(score.scored), int(score.flagged), int(score.not_definite)) == (1, 1, 2)
    assert float(score.nees) == pytest.approx(1 / 4 + 4 / 1 + 0.25 / 0.25)
    assert float(score.position_square) == pytest.approx(1 + 4 + 9)
    assert float(score.yaw_square) == pytest.approx(0.25 + 1)


def test_a_gap_is_the_largest_difference(x64):
    exact = Gaussian(jnp.zeros((2, 3)).at[:, 2].set(3.14), jnp.stack([jnp.diag(jnp.array([4.0, 1.0, 0.25]))] * 2))
    mean = exact.mean.at[1].add(jnp.array([0.3, -0.4, 0.01 - 2 * math.pi]))  # the other side of the circle
    gap = jax.jit(precision._gap)(exact, Gaussian(mean, exact.cov.at[0, 0, 1].add(0.1)))
    assert float(gap.position) == pytest.approx(0.5)
    assert float(gap.yaw) == pytest.approx(0.01)
    assert float(gap.cov) == pytest.approx(0.1 / (2 * 1))


def test_standard_errors_are_those_of_leaving_runs_out():
    """Of a value and of a paired difference, against the jackknife, which knows no formula of a root."""
    rng = np.random.default_rng(0)
    runs, steps = 400, precision.BINS

    def score(shift):
        nees, square = np.abs(rng.normal(3, 1, (2, runs, steps)))
        return precision.Score(
            *(np.ones((runs, steps)), nees, square + shift, square**2 + shift, *np.zeros((2, runs, steps), int))
        )

    exact = score(0.0)
    other = exact._replace(nees=exact.nees * 1.01, position_square=exact.position_square + rng.normal(0.1, 0.01))
    other = other._replace(yaw_square=exact.yaw_square * rng.normal(1, 0.01, (runs, steps)))
    gap = precision.Gap(*np.zeros((3, runs, steps)))
    report = precision._statistics(other, steps, exact, gap)

    def values(kept):
        def of(score):
            square = (score.position_square[kept].mean() ** 0.5, score.yaw_square[kept].mean() ** 0.5)
            return np.array([score.nees[kept].mean(), *square])

        return np.stack([of(other), of(other) - of(exact)])

    every = np.arange(runs)
    left_out = np.stack([values(np.delete(every, i)) for i in every])
    jackknife = np.sqrt((runs - 1) * left_out.var(axis=0))
    for i, name in enumerate(("anees", "rmse_position_m", "rmse_yaw_rad")):
        for j, what in enumerate((name, f"{name}_difference")):
            assert report[what] == pytest.approx(values(every)[j, i], rel=1e-9)
            assert report[f"{what}_standard_error"] == pytest.approx(jackknife[j, i], rel=0.02)  # to first order


def test_a_run_without_a_single_score_leaves_no_number():
    nothing = np.zeros((2, precision.BINS))
    score = precision.Score(nothing, nothing, nothing + 1, nothing + 1, *np.ones((2, 2, precision.BINS), int))
    report = precision._statistics(score, precision.BINS)
    assert math.isnan(report["anees"])
    assert (report["unscored_steps"], report["not_definite_steps"]) == (2 * precision.BINS, 2 * precision.BINS)


def test_a_sharper_detector_is_sharper_in_truth_and_in_the_filter(outcome, monkeypatch):
    given = []
    monkeypatch.setattr(
        precision, "monte_carlo", lambda *args, **_: given.append(args) or types.SimpleNamespace(value=outcome)
    )
    row = precision._row(0, STEPS, RUNS, 10.0, None)
    _, _, runs, params, _, noise, _ = given[0]
    assert (runs, row["detector_sharper"]) == (RUNS, 10)
    assert noise == simulation.Noise()._replace(range=0.008, bearing=0.002)
    np.testing.assert_allclose(params.R, np.diag([0.008, 0.002]) ** 2, rtol=1e-5)
    np.testing.assert_allclose(params.Q, np.diag([0.02**2, 0.01**2 + (0.005 / 0.1) ** 2]), rtol=1e-5)


def test_the_program_writes_what_it_says(program, capsys):
    report, out = program
    written = json.loads((out / "report.json").read_text())
    (row,) = written["drives"]
    assert (row["steps"], row["runs"], row["detector_sharper"]) == (STEPS, RUNS, 1)
    assert len(row["time_s"]) == len(row["float32"]["nees_per_bin"]) == precision.BINS
    assert row["time_s"][-1] == pytest.approx(STEPS * SHORT.dt)
    assert row["float32"]["anees_difference"] == row["float32"]["anees"] - row["float64"]["anees"]
    assert (out / "precision.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(report["verdict"]) == 2


def test_a_detector_too_sharp_for_float32_is_found_out(program):
    """Its variance is 1e-10 of the prior's: less than float32 can tell from none."""
    report, _ = program
    (row,) = report["sharper_detectors"]
    assert row["float64"]["not_definite_steps"] == row["float64"]["flagged_steps"] == 0
    assert row["float32"]["not_definite_steps"] > 0
    assert "float32 breaks" in row["verdict"]
    assert "no cost to be seen" in report["drives"][0]["verdict"]


def test_a_cost_that_can_be_seen_is_called_one(outcome):
    row = precision.summarise(outcome, SHORT, 1.0)
    row["float32"]["anees_difference"] = 2 * row["float64"]["anees_standard_error"]
    assert "costs consistency" in precision.verdict(row)
    row["float32"]["anees_difference"] = math.nan
    assert "costs consistency" in precision.verdict(row)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"steps": ()}, "steps: expected at least one length of drive, got none"),
        ({"steps": (250,), "runs": (4,)}, "steps: expected a multiple of 40, the number of time bins, got 250"),
        ({"steps": (0,), "runs": (4,)}, "steps: expected a multiple of 40"),
        ({"runs": (4,)}, "runs: expected one number for each length, 3, got 1"),
        ({"runs": (4, 1, 4)}, "runs: expected at least 2"),
        ({"sharper": (0.0,)}, "sharper: expected a positive, finite factor, got 0.0"),
        ({"sharper": (math.inf,)}, "sharper: expected a positive, finite factor, got inf"),
    ],
)
def test_nonsense_is_refused(tmp_path, settings, expected):
    with pytest.raises(ValueError, match="^" + expected.replace("(", r"\(")):
        precision.main(precision.PrecisionConfig(out=tmp_path, **settings))
