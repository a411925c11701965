"""The programs behind the README's tables: what they run, what they take of it, and every cell they print."""

import gzip
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import Recorder, stop
from scipy.stats import chi2

from jaxlocmap import Config, Gaussian, Params, simulation, tuning
from jaxlocmap.logs import read_trajectory

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import readme_tables
import tune_compare
import tune_robots

pytestmark = pytest.mark.usefixtures("as_a_program")
A = Params.from_std(v=0.1, w=0.2, range=0.3, bearing=0.4)
B = Params.from_std(v=0.5, w=0.6, range=0.7, bearing=0.8)
NATURAL = {"v": 0.1, "w": 0.2, "range": 0.3, "bearing": 0.4}


def key_data(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def rows_of(table):
    """Cells below the head."""
    return [cells(line) for line in table.splitlines()[2:]]


# --- Ways to tune


@pytest.fixture
def fits(monkeypatch):
    """Takes the place of every descent, of an objective that is no more than its settings and losses."""
    trace = SimpleNamespace(evaluations=np.array([2, 3]))
    stub = Recorder(SimpleNamespace(params=A, trace=trace, run_s=1.5))
    monkeypatch.setattr(tuning, "fit", stub)
    monkeypatch.setattr(tuning, "Objective", lambda config, weights: SimpleNamespace(config=config, weights=weights))
    return stub


@pytest.mark.parametrize(
    ("options", "runs", "losses", "judged"),
    [
        ({"runs": 40, "judge_runs": 100}, 40, 8, (100, 20)),
        ({"quick": True}, 16, 8, (50, 10)),
        ({}, 512, 102, (2000, 400)),
    ],
)
def test_options_of_the_comparison(monkeypatch, tmp_path, options, runs, losses, judged):
    for name in ("hosts", "write_report", "saved"):
        monkeypatch.setattr(tune_compare, name, SimpleNamespace(check_count=Recorder(), use_all_cores=Recorder()))
    monkeypatch.setattr(tune_compare, "write_report", written := Recorder())
    monkeypatch.setattr(tune_compare, "saved", Recorder())
    parts = {name: Recorder(name) for name in ("_optimisers", "_losses", "_cost", "_linear")}
    parts |= {f"_table_of_{name}": Recorder(f"table of {name}") for name in ("optimisers", "losses", "costs", "linear")}
    parts |= {"_judge_on_fresh_runs": Recorder("judge"), "replace_table": Recorder()}
    for name, part in parts.items():
        monkeypatch.setattr(tune_compare, name, part)
    config = tune_compare.CompareConfig(**options, seed=5, out=tmp_path)
    tune_compare.main(config)
    assert parts["replace_table"].calls == []
    assert [args for args, _ in parts["_judge_on_fresh_runs"].calls] == [
        (simulation.CAPSTONE, 0.99, judged[0], config),
        (simulation.LOOP, None, judged[1], config),
    ]
    assert parts["_optimisers"].calls == [((runs, "judge", config), {})]
    assert parts["_losses"].calls == [((losses, "judge", config), {})]
    assert parts["_cost"].calls == [((runs, config.quick), {})]
    assert parts["_linear"].calls == [((config,), {})]
    report = {"optimisers": "_optimisers", "losses": "_losses", "cost": "_cost", "linear": "_linear"}
    assert written.calls == [((tmp_path, report), {})]
    tune_compare.main(tune_compare.CompareConfig(**options, out=tmp_path, write=True))
    assert [args for args, _ in parts["replace_table"].calls] == [
        ("optimisers", "table of optimisers"),
        ("losses", "table of losses"),
        ("gradients", "table of costs"),
        ("okf", "table of linear"),
    ]
    assert [parts[f"_table_of_{name}"].calls[0][0] for name in ("optimisers", "losses", "costs", "linear")] == [
        ("_optimisers",),
        ("_losses",),
        ("_cost",),
        ("_linear",),
    ]


@pytest.mark.parametrize("name", ["runs", "judge_runs"])
def test_too_few_runs_to_compare_are_refused(monkeypatch, tmp_path, name):
    monkeypatch.setattr(tune_compare.hosts, "use_all_cores", stop)
    with pytest.raises(ValueError, match=f"{name}: expected at least 10"):
        tune_compare.main(tune_compare.CompareConfig(**{name: 9}, out=tmp_path))


def test_fresh_runs_are_not_those_tuned_on(monkeypatch):
    ran, told = Recorder(SimpleNamespace(value="totals")), Recorder({"anees": 3})
    monkeypatch.setattr(tune_compare, "monte_carlo", ran)
    monkeypatch.setattr(tune_compare, "summarise", told)
    monkeypatch.setattr(tuning, "simulated", drawn := Recorder("batch"))
    config = tune_compare.CompareConfig(seed=5)
    assert tune_compare._judge_on_fresh_runs(simulation.LOOP, 0.9, 70, config)(A) == {"anees": 3}
    ((study, key, runs, params, *_), _) = ran.calls[0]
    assert (study.scenario, study.config.motion, study.config.gate_probability) == (simulation.LOOP, "euler", 0.9)
    assert (study.config.grid, runs, params.R.dtype) == (None, 70, np.float32)
    np.testing.assert_allclose(params.R, A.R, rtol=1e-6)
    assert key_data(key) == key_data(jax.random.fold_in(jax.random.key(5), 9))
    assert told.calls == [(("totals", study.config), {})]
    assert tune_compare._drives(simulation.LOOP, 9, 5) == "batch"
    ((key, runs, *_), how) = drawn.calls[0]
    assert (key_data(key), runs, how) == (key_data(jax.random.key(5)), 9, {"scenario": simulation.LOOP})


@pytest.mark.parametrize("quick", [False, True])
def test_optimisers_are_compared_by_when_they_reach_the_best(monkeypatch, quick, fits):
    """Within 1e-4 nats of it, of whichever found it; and judged by the parameters each ended at."""
    ours = tune_compare.Descent([3.0, 1.00005, 1.0], [1, 3, 6], [0.1, 0.3, 0.6], A)
    scipy = {
        ("L-BFGS-B", True): tune_compare.Descent([2.0, 1.0001], [1, 2], [0.5, 0.9], B),
        ("L-BFGS-B", False): tune_compare.Descent([2.0, 1.01], [4, 8], [0.5, 0.75], B),
        ("Nelder-Mead", False): tune_compare.Descent([1.5, 1.2], [10, 20], [5.0, 6.0], A),
    }
    given = []

    def way(*args):
        given.append(args[-4:])
        return scipy[args[:2]] if len(args) > 4 else ours

    monkeypatch.setattr(tune_compare, "_ours", way)
    monkeypatch.setattr(tune_compare, "_scipy", way)
    monkeypatch.setattr(tune_compare, "_drives", lambda *args: args)
    study = {"anees": 3.0, "nis_mean": 2.0, "coverage_95": 0.95, "gate_accept_rate": 0.99, "more": 1}
    judge = lambda params: study | {"anees": 3.0 if params is A else 4.0}  # noqa: E731
    rows = tune_compare._optimisers(30, judge, tune_compare.CompareConfig(seed=5, quick=quick))
    reached = [(row["evaluations_to_best"], row["seconds_to_best"], row["evaluations"], row["seconds"]) for row in rows]
    every = [(3, 0.3, 6, 0.6), (2, 0.9, 2, 0.9), (None, None, 8, 0.75), (None, None, 20, 6.0)]
    assert reached == (every if not quick else [(8, 0.75, 8, 0.75), (None, None, 20, 6.0)])
    assert [row["loss"] for row in rows][-2:] == [1.01, 1.2]
    assert [row["anees"] for row in rows][-2:] == [4.0, 3.0]
    assert rows[-1]["params"]["range"] == pytest.approx(0.3)
    assert rows[0]["gate_accept_rate"] == 0.99
    assert len(rows[0]) == 11
    for objective, start, batch, short in given:
        assert (objective.weights, short) == ((("innovation_nll", 1.0),), quick)
        assert (objective.config.gate_probability, objective.config.gate_temperature) == (0.9999, 2.0)
        np.testing.assert_array_equal(start.R, simulation.course_params().R)
        assert batch == (simulation.CAPSTONE, 30, 5)


@pytest.mark.parametrize(("quick", "epochs"), [(False, 20), (True, 2)])
def test_our_descent_is_marked_epoch_by_epoch(fits, quick, epochs):
    def fit(*args, progress, **how):
        assert args == ("objective", "start", "batch")
        assert how == {"epochs": epochs, "steps": 1, "patience": 3}
        for losses, evaluations, seconds in (([4.0], [1], 0.5), ([4.0, 3.0], [1, 2], 0.75)):
            trace = SimpleNamespace(evaluations=np.array(evaluations))
            progress(SimpleNamespace(losses=losses, trace=trace, run_s=seconds))
        return SimpleNamespace(params=A)

    tuning.fit, kept = fit, tuning.fit
    try:
        found = tune_compare._ours("objective", "start", "batch", quick)
    finally:
        tuning.fit = kept
    assert found == ([4.0, 3.0], [1, 3], [0.5, 0.75], A)


@pytest.mark.parametrize(("method", "slopes"), [("L-BFGS-B", True), ("L-BFGS-B", False), ("Nelder-Mead", False)])
def test_scipy_finds_the_minimum_and_every_value_counts(monkeypatch, method, slopes):
    """Of a bowl around B in the coordinates; what is kept is the lowest so far."""
    there = tuning.unconstrain(B)
    scale = jnp.asarray(2.0, B.R.dtype)

    def bowl(objective, start, names):
        assert (objective, names) == ("objective", tuning.NOISE)
        return lambda at, batch: (batch * sum((at[name] - there[name]) ** 2 for name in names), {})

    monkeypatch.setattr(tuning, "coordinates_objective", bowl)
    whole = {}
    minimise = tune_compare.scipy.optimize.minimize
    monkeypatch.setattr(
        tune_compare.scipy.optimize, "minimize", lambda f, x, **how: whole.update(how) or minimise(f, x, **how)
    )
    with jax.enable_x64(True):
        found = tune_compare._scipy(method, slopes, "objective", A, scale, False)
        np.testing.assert_allclose(np.sqrt(np.diagonal(found.params.R)), [0.7, 0.8], rtol=0.02)
        assert (whole["method"], whole["jac"], whole["options"]) == (method, slopes or None, {})
        assert found.evaluations == list(range(1, len(found.losses) + 1))
        assert np.all(np.diff(found.losses) <= 0)
        assert np.all(np.diff(found.seconds) >= 0)
        first = 2 * sum(np.log(5) ** 2 if n == "v" else np.log(x) ** 2 for n, x in FACTORS.items())
        assert found.losses[0] == pytest.approx(first, rel=1e-5)
        tune_compare._scipy(method, slopes, "objective", A, scale, True)
        assert whole["options"] == {"maxiter": 2}


FACTORS = {"v": 5, "w": 3, "range": 7 / 3, "bearing": 2}  # from A to B


@pytest.mark.parametrize("quick", [False, True])
def test_losses_are_compared_from_a_start_three_times_too_sure(monkeypatch, fits, quick):
    judged = Recorder({name: 1.0 for name in ("rmse_position_m", "rmse_yaw_rad", "anees", "nis_mean", "coverage_95")})
    monkeypatch.setattr(tune_compare, "_drives", lambda *args: args)
    rows = tune_compare._losses(8, judged, tune_compare.CompareConfig(seed=5, quick=quick))
    own = simulation.own_params(simulation.Noise(), simulation.CAPSTONE)
    (start,), (told,) = (args for args, _ in judged.calls[:2])
    for name in ("Q", "R"):
        np.testing.assert_allclose(getattr(told, name), getattr(own, name), rtol=1e-6)
        np.testing.assert_allclose(getattr(start, name), np.asarray(getattr(own, name)) / 9, rtol=1e-6)
    assert [args[0] for args, _ in judged.calls[2:]] == [A] * (1 if quick else 5)
    words = [
        "the start",
        "the robot's own noise",
        "tuned for `mse`",
        "tuned for `pose_nll`",
        "tuned for `innovation_nll`",
    ]
    words += [f"tuned for `{name}`, range and bearing alone" for name in ("nees", "nis")]
    assert [row["filter"] for row in rows] == words[: len(rows)]
    assert len(rows) == (3 if quick else 7)
    for ((objective, begun, batch), how), name in zip(
        fits.calls, ("mse", "pose_nll", "innovation_nll", "nees", "nis"), strict=False
    ):
        assert (objective.weights, begun, batch) == (((name, 1.0),), start, (simulation.LOOP, 8, 5))
        tuned = ("range", "bearing") if name in ("nees", "nis") else tuning.NOISE
        assert how == {"tuned": tuned, "epochs": 1 if quick else 20}
        assert (objective.config.gate_probability, objective.config.motion) == (None, "euler")
    assert rows[2]["params"]["range"] == pytest.approx(0.3)


def test_what_a_gradient_costs(monkeypatch):
    """Medians of times taken in turns; the ratio is the median of ratios, not the ratio of medians."""
    clock = iter(np.cumsum([0, 1, 0, 9, 0, 2, 0, 8, 0, 10, 0, 20] * 5).tolist())
    monkeypatch.setattr(tune_compare.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(tune_compare, "_drives", lambda *args: jnp.ones(2))
    monkeypatch.setattr(tune_compare, "_bytes_a_run", lambda steps: 10.0 * steps + 600)
    monkeypatch.setattr(tuning, "coordinates_objective", lambda *_: lambda at, batch: (at["v"] * batch.sum(), {}))
    cost = tune_compare._cost(4, False)
    assert (cost["value_s"], cost["gradient_s"], cost["gradient_over_value"]) == (2, 9, 4)
    assert (cost["bytes_a_run_240"], cost["bytes_a_run_3840"], cost["memory_ratio"]) == (3000, 39000, 13)


def test_the_memory_of_a_gradient_is_a_run_s_with_everything(monkeypatch):
    memory = SimpleNamespace(argument_size_in_bytes=100, temp_size_in_bytes=20, output_size_in_bytes=8)
    lowered = Recorder(SimpleNamespace(compile=lambda: SimpleNamespace(memory_analysis=lambda: memory)))
    monkeypatch.setattr(
        tune_compare,
        "jax",
        SimpleNamespace(
            eval_shape=lambda f, key: f(key),
            random=jax.random,
            jit=lambda f: SimpleNamespace(lower=lowered),
            value_and_grad=lambda f: f,
        ),
    )
    monkeypatch.setattr(tuning, "simulated", drawn := Recorder("batch"))
    monkeypatch.setattr(tuning, "Objective", objective := Recorder("objective"))
    monkeypatch.setattr(tuning, "coordinates_objective", asked := Recorder())
    assert tune_compare._bytes_a_run(480, runs=4) == 128 / 4
    ((_, runs, *_), how) = drawn.calls[0]
    assert (runs, how["scenario"].steps, how["scans"]) == (4, 480, True)
    ((settings, weights), _) = objective.calls[0]
    assert (settings.grid is not None, weights) == (True, (("innovation_nll", 1.0), ("map", 1.0)))
    assert asked.calls[0][0][2] == ("v", "w", "range", "bearing", "l_occ", "l_free")
    ((at, batch), _) = lowered.calls[0]
    assert (set(at), batch) == ({"v", "w", "range", "bearing", "l_occ", "l_free"}, "batch")


def test_the_linear_robot_drives_and_sees_as_it_says(x64, monkeypatch):
    rng = np.random.default_rng(0)
    batch = tune_compare._linear_drives(rng, 40, 50)
    truth, z = np.asarray(batch.truth), np.asarray(batch.inputs.z)[:, :, 0]
    moved = np.diff(truth, axis=1)
    heading = truth[:, :-1, 2]  # a step goes where the robot looked before it
    along = moved[..., 0] * np.cos(heading) + moved[..., 1] * np.sin(heading)
    across = moved[..., 1] * np.cos(heading) - moved[..., 0] * np.sin(heading)
    assert np.std(along) == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(across, 0, rtol=0, atol=1e-12)
    assert np.std(moved[..., 2]) == pytest.approx(0.01, rel=0.05)
    np.testing.assert_allclose(truth[:, 0, 1], 0, rtol=0, atol=1e-12)  # it starts on the axis, looking along it
    off = np.stack([z[..., 0] - np.hypot(1e3 - truth[..., 0], truth[..., 1])], -1)[..., 0]
    turned = z[..., 1] - (np.arctan2(-truth[..., 1], 1e3 - truth[..., 0]) - truth[..., 2])
    assert np.std(off) == pytest.approx(0.2, rel=0.05)
    assert np.std(turned) == pytest.approx(0.04, rel=0.05)
    monkeypatch.setattr(tune_compare, "_SEEN", (0.0, 0.0))
    exact = tune_compare._linear_drives(rng, 2, 50)
    (x, y, heading), z = np.moveaxis(np.asarray(exact.truth), -1, 0), np.asarray(exact.inputs.z)[:, :, 0]
    np.testing.assert_allclose(z[..., 0], np.hypot(1e3 - x, y), rtol=1e-12)
    np.testing.assert_allclose(z[..., 1], np.arctan2(-y, 1e3 - x) - heading, rtol=0, atol=1e-12)
    assert np.all(batch.inputs.dt == 1)
    assert np.all(batch.inputs.valid)
    np.testing.assert_array_equal(batch.landmarks, [[1e3, 0]])
    np.testing.assert_allclose(batch.prior.cov[0], np.diag([1e-2, 1e-4, 1e-4]), rtol=1e-6)


def test_a_filter_of_the_linear_robot_is_judged_by_position_and_heading(monkeypatch):
    truth = np.zeros((2, 3, 3))
    mean = np.zeros((2, 3, 3))
    mean[0, 1] = [0.5, 9.0, 0.25]  # what moves along y is hardly seen
    mean[1, 2] = [3.0, 9.0, 0.0]
    cov = np.array([[0.25, 0.1, 0.0], [0.1, 1.0, 0.1], [0.0, 0.1, 0.0625]])
    monkeypatch.setattr(
        tuning,
        "beliefs",
        lambda params, test, config: Gaussian(jnp.asarray(mean), jnp.asarray(np.tile(cov, (2, 3, 1, 1)))),
    )
    test = tuning.Batch(*[None] * len(tuning.Batch._fields))._replace(truth=truth)
    row = tune_compare._linear_row("it", A, 2.5, test, Config())
    close = {"rel": 1e-5}
    assert row["rmse_position_m"] == pytest.approx(math.sqrt((0.25 + 9) / 6), **close)
    assert row["rmse_yaw_rad"] == pytest.approx(math.sqrt(0.0625 / 6), **close)
    assert row["anees_of_2"] == pytest.approx((1 + 1 + 36) / 6, **close)
    assert row["covered_95"] == pytest.approx(5 / 6, **close)
    assert (row["filter"], row["seconds"]) == ("it", 2.5)
    assert row["params"]["bearing"] == pytest.approx(0.4)
    # 95 % of two degrees: an error just inside, one just outside.
    mean[...] = 0
    mean[0, :2, 0] = np.sqrt(chi2.ppf(0.95, 2) * np.array([0.99, 1.01]) * 0.25)
    assert tune_compare._linear_row("it", A, 2.5, test, Config())["covered_95"] == pytest.approx(5 / 6, **close)


@pytest.mark.parametrize("quick", [False, True])
@pytest.mark.parametrize("installed", [False, True])
def test_what_the_linear_robot_is_tuned_by(monkeypatch, fits, quick, installed):
    drives, rowed = Recorder(), Recorder()
    sets = iter(["train", "test"])
    monkeypatch.setattr(tune_compare, "_linear_drives", lambda *args: drives(*args) or next(sets))
    monkeypatch.setattr(tune_compare, "_linear_row", lambda *args: rowed(*args) or args[0])
    monkeypatch.setattr(tune_compare, "_okf", Recorder((B, 7.0)))
    monkeypatch.setattr(tune_compare.importlib.util, "find_spec", lambda name: installed or None)
    rows = tune_compare._linear(tune_compare.CompareConfig(seed=5, quick=quick))
    losses = ["mse"] if quick else ["mse", "pose_nll", "innovation_nll"]
    assert rows == ["the start", *(f"this library, `{n}`" for n in losses)] + ["OKF, squared error"] * installed
    (rng, count, steps), (_, more, _) = (args for args, _ in drives.calls)
    assert (count, more, steps) == ((10, 40, 10) if quick else (100, 400, 60))
    assert rng.bit_generator.state == np.random.default_rng(5).bit_generator.state
    for ((objective, _, batch), how), name in zip(fits.calls, losses, strict=True):
        assert (objective.weights, batch) == (((name, 1.0),), "train")
        assert how == {"tuned": tuning.FULL_NOISE, "epochs": 2 if quick else 20}
    assert {args[3] for args, _ in rowed.calls} == {"test"}
    assert [args[2] for args, _ in rowed.calls] == [0.0] + [1.5] * len(losses) + [7.0] * installed
    if installed:
        assert tune_compare._okf.calls[0][0][0] == "train"
        assert rowed.calls[-1][0][1] is B


@pytest.mark.parametrize("quick", [False, True])
def test_okf_gets_the_linear_robot_in_its_own_terms(monkeypatch, x64, quick):
    """How far along x and which heading each observation says; it tunes the noise of a step, ours is of a control."""
    monkeypatch.setattr(tune_compare, "_SEEN", (1e-3, 1e-5))
    train = tune_compare._linear_drives(np.random.default_rng(0), 3, 4)
    model = SimpleNamespace(get_Q=lambda: np.diag([0.25, 0.5]), get_R=lambda: np.diag([1.0, 2.0]))
    okf = SimpleNamespace(OKF=Recorder(model), train=Recorder())
    torch = SimpleNamespace(
        manual_seed=Recorder(), eye=np.eye, tensor=np.array, diag=np.diag, zeros=np.zeros, sum=np.sum, double=float
    )
    torch.eye = lambda n, dtype: np.eye(n)
    monkeypatch.setattr(tune_compare.importlib, "import_module", lambda name: {"okf": okf, "torch": torch}[name])
    monkeypatch.setattr(tune_compare, "_DT", 0.5)
    params, _ = tune_compare._okf(train, tune_compare.CompareConfig(seed=6, quick=quick))
    np.testing.assert_allclose(params.Q, np.diag([1.0, 2.0]), rtol=1e-12)
    np.testing.assert_allclose(params.R, np.diag([1.0, 2.0]), rtol=1e-12)
    assert torch.manual_seed.calls == [((6,), {})]
    ((same, z, x), how) = okf.train.calls[0]
    assert (same, how["n_epochs"], how["save_best"]) == (model, 1 if quick else 10, not quick)
    truth = np.asarray(train.truth)
    np.testing.assert_array_equal(x, truth[..., [0, 2]])
    assert np.all(np.abs(np.array(z) - x).max((0, 1)) < [5e-3, 1e-4])
    assert np.abs(truth[..., 2]).max() > 0.01
    settings = okf.OKF.calls[0][1]
    np.testing.assert_allclose(settings["P0"], np.diag([1e-2, 1e-4]), rtol=1e-12)
    assert settings["loss_fun"](np.array([1.0, 2.0]), np.array([3.0, 5.0])) == 13


def test_tables_of_the_comparison():
    optimiser = {"optimiser": "o", "evaluations_to_best": 3, "seconds_to_best": 0.26, "evaluations": 9, "seconds": 1.25}
    optimiser |= {"anees": 3.123, "nis_mean": 2.456, "gate_accept_rate": 0.98765}
    late = optimiser | {"evaluations_to_best": None, "seconds_to_best": None}
    assert rows_of(tune_compare._table_of_optimisers([optimiser, late])) == [
        ["o", "3, 0.3 s", "9, 1.2 s", "3.12", "2.46", "98.77 %"],
        ["o", "not reached", "9, 1.2 s", "3.12", "2.46", "98.77 %"],
    ]
    loss = {"filter": "f", "rmse_position_m": 0.0123, "rmse_yaw_rad": 0.0045, "anees": 3.5, "nis_mean": 2.5}
    assert rows_of(tune_compare._table_of_losses([loss | {"coverage_95": 0.951}])) == [
        ["f", "12.30 mm", "4.50 mrad", "3.5", "2.5", "95.1 %"]
    ]
    cost = {"value_s": 0.04, "gradient_s": 0.12, "gradient_over_value": 3.125}
    cost |= {"bytes_a_run_240": 2**20, "bytes_a_run_3840": 5 * 2**19, "memory_ratio": 2.5}
    assert rows_of(tune_compare._table_of_costs(cost)) == [
        ["time over the value's, filter alone", "120 over 40 ms", "3.12"],
        ["memory a run with the map, 3,840 over 240 steps", "2.50 over 1.00 MiB", "2.50"],
    ]
    linear = {"filter": "l", "rmse_position_m": 0.05, "rmse_yaw_rad": 0.01, "anees_of_2": 2.5, "covered_95": 0.9}
    rows = rows_of(tune_compare._table_of_linear([linear | {"seconds": 0.0}, linear | {"seconds": 1.26}]))
    assert rows == [["l", seconds, "50.00 mm", "10.00 mrad", "2.5", "90.0 %"] for seconds in ("–", "1.3")]


# --- Real robots


def jobs(monkeypatch, **options):
    """(log, loss, what the source is asked for) of every job."""
    for name in ("from_robots", "from_scans"):
        monkeypatch.setattr(tune_robots, name, lambda *args: args)
    config = tune_robots.RobotsConfig(Path("d"), **options)
    return [(what, loss, source()) for what, loss, source in tune_robots._jobs(config)]


def test_robots_are_tuned_loss_by_loss_and_split_by_split(monkeypatch):
    made = jobs(monkeypatch, splits=2, seed=4)
    assert [(what, loss) for what, loss, _ in made] == [
        *(("woods", loss) for loss in ("innovation_nll", "mse", "nees", "pose_nll")),
        *((f"mrclam {rest}", loss) for loss in ("innovation_nll", "pose_nll") for rest in ("4, 5", "3, 5")),
        ("intel", "map"),
    ]
    for _, loss, args in made:
        told = args[-1]
        assert (told.losses, told.gate, told.judge_gate, told.seed) == ((loss,), 0.9999, 0.99, 4)
        assert (told.start, told.quick) == (None, False)
    woods = Path("d/lost_in_the_woods/dataset2.mat")
    assert {args[:-1] for what, _, args in made if what == "woods"} == {(woods, "woods", (), (), "euler", 5.0)}
    mrclam = Path("d/mrclam/MRCLAM_Dataset6"), "mrclam"
    assert [args[:-1] for what, _, args in made if "mrclam" in what] == [
        (*mrclam, tuned, judged, "arc", None)
        for _ in range(2)
        for tuned, judged in (((1, 2, 3), (4, 5)), ((1, 2, 4), (3, 5)))
    ]
    assert made[-1][2][:-1] == (Path("d/carmen/intel-corrected.log.gz"), 0.1, 20.0)
    assert len(jobs(monkeypatch)) == 4 + 20 + 1


def test_a_quick_run_of_the_robots_is_short(monkeypatch):
    made = jobs(monkeypatch, quick=True)
    assert [(what, loss) for what, loss, _ in made] == [("woods", "pose_nll"), ("intel", "map")]
    assert made[1][2][1] == 0.2
    assert all(args[-1].quick for *_, args in made)


@pytest.mark.parametrize(
    ("loss", "tuned"),
    [("pose_nll", tuning.NOISE), ("map", tuning.SENSOR_MODEL), ("nees", ("range", "bearing"))],
)
@pytest.mark.parametrize(("quick", "epochs"), [(False, 20), (True, 1)])
def test_a_log_is_tuned_and_judged(fits, loss, tuned, quick, epochs):
    evidence = lambda params: {"robot 4": {"anees": 9.0 if params is B else 3.0}}  # noqa: E731
    source = SimpleNamespace(config="config", start=B, train="train", validation="some", evidence=evidence)
    row = tune_robots._tuned("mrclam 4, 5", loss, source, quick)
    (((objective, start, batch), how),) = fits.calls
    assert (objective.config, objective.weights, start, batch) == ("config", ((loss, 1.0),), B, "train")
    assert how == {"tuned": tuned, "validation": "some", "epochs": epochs}
    assert (row["log"], row["loss"], row["one_of_many"], row["evaluations"]) == ("mrclam 4, 5", loss, True, 5)
    assert (row["before"], row["after"]) == ({"anees": 9.0}, {"anees": 3.0})
    natural = NATURAL | {"l_occ": 0.85, "l_free": -0.4}
    assert row["params"] == pytest.approx({name: natural[name] for name in tuned})
    assert not tune_robots._tuned("woods", loss, source, quick)["one_of_many"]


def test_means_over_robots_and_over_splits():
    drives = {"robot 4": {"anees": 3.0, "nis_mean": 1.0, "x": 9}, "robot 5": {"anees": 5.0, "nis_mean": 2.0, "x": 9}}
    assert tune_robots._means(drives) == {"anees": 4.0, "nis_mean": 1.5}

    def row(loss, many, before, after, v):
        return {"log": "l", "loss": loss, "one_of_many": many, "params": {"v": v}} | {
            "before": {"anees": before},
            "after": {"anees": after},
        }

    rows = [
        row("pose_nll", True, 9.0, 3.0, 0.1),
        row("pose_nll", True, 7.0, 2.0, 0.2),
        row("pose_nll", False, 1.0, 1.0, 1.0),
    ]
    rows += [row("innovation_nll", True, 4.0, 6.0, 0.5)]
    pose, innovation = tune_robots._summaries(rows)
    assert pose == {
        "log": "mrclam, two robots of five, 2 splits",
        "loss": "pose_nll",
        "one_of_many": False,
        "params": {"v": pytest.approx(0.15)},
        "before": {"anees": 8.0},
        "after": {"anees": 2.5},
        "anees_of_splits": [2.0, 3.0],
    }
    assert (innovation["loss"], innovation["after"]) == ("innovation_nll", {"anees": 6.0})


def test_the_table_of_robots_has_a_start_for_each_log():
    def values(rmse, anees, coverage):
        return {"rmse_position_m": rmse, "anees": anees, "coverage_95": coverage}

    before = values(0.5, 30.0, 0.2)
    rows = [
        {"log": "woods", "loss": "nees", "before": before, "after": values(0.25, 3.0, 0.951)},
        {"log": "woods", "loss": "pose_nll", "before": before, "after": values(0.125, 2.5, 0.9)},
        {"log": "m", "loss": "pose_nll", "before": before, "after": values(1, 2, 1), "anees_of_splits": [1.5, 4.0]},
        {
            "log": "intel",
            "loss": "map",
            "before": {"log_loss": 0.5, "calibration_error": 0.25},
            "after": {"log_loss": 0.375, "calibration_error": 0.125},
        },
    ]
    poses, maps = tune_robots._table(rows).split("\n\n")
    assert rows_of(poses) == [
        ["woods", "–", "0.500 m", "30", "20.0 %"],
        ["woods", "`nees`", "0.250 m", "3", "95.1 %"],
        ["woods", "`pose_nll`", "0.125 m", "2.5", "90.0 %"],
        ["m", "–", "0.500 m", "30", "20.0 %"],
        ["m", "`pose_nll`", "1.000 m", "2 (1.5 to 4)", "100.0 %"],
    ]
    assert rows_of(maps) == [["intel", "–", "0.5000", "0.2500"], ["intel", "`map`", "0.3750", "0.1250"]]


@pytest.mark.parametrize("write", [False, True])
def test_the_program_of_robots(monkeypatch, tmp_path, write):
    monkeypatch.setattr(tune_robots.hosts, "use_all_cores", Recorder())
    monkeypatch.setattr(
        tune_robots, "_jobs", lambda config: [("mrclam 1", "pose_nll", lambda: "source"), ("w", "p", dict)]
    )
    monkeypatch.setattr(
        tune_robots,
        "_tuned",
        lambda what, loss, source, quick: {"log": what, "one_of_many": "m" in what, "quick": quick},
    )
    monkeypatch.setattr(tune_robots, "_summaries", lambda rows: [{"log": "sum", "one_of_many": False}])
    monkeypatch.setattr(tune_robots, "_table", lambda rows: ", ".join(row["log"] for row in rows))
    monkeypatch.setattr(tune_robots, "replace_table", replaced := Recorder())
    report = tune_robots.main(tune_robots.RobotsConfig(tmp_path, write=write, quick=True, out=tmp_path))
    assert [row["log"] for row in report["rows"]] == ["mrclam 1", "w", "sum"]
    assert report["rows"][0]["quick"]
    assert replaced.calls == ([(("robots", "w, sum"), {})] if write else [])
    with pytest.raises(ValueError, match="splits: expected at most 10"):
        tune_robots.main(tune_robots.RobotsConfig(tmp_path, splits=11, out=tmp_path))


# --- The README's studies and logs


STUDY = {
    "axis_nees": {"x": 1.125, "y": 0.995, "yaw": 2.0},
    "anees": 3.456,
    "nis_mean": 2.345,
    "gate_accept_rate": 0.98765,
    "verdict": "over-confident (ANEES 3.4 (x)); more; yet",
}


@pytest.mark.parametrize("quick", [False, True])
def test_the_studies_of_the_readme(monkeypatch, tmp_path, quick):
    monkeypatch.setattr(readme_tables.study, "main", ran := Recorder(STUDY))
    config = readme_tables.TablesConfig(runs=70, seed=4, quick=quick)
    rows = rows_of(readme_tables._studies(config, tmp_path))
    plant = tmp_path / "plant.json"
    np.testing.assert_allclose(
        Params.load(plant).Q, simulation.own_params(simulation.Noise(), simulation.CAPSTONE).Q, rtol=1e-6, atol=1e-12
    )
    configs = [args[0] for args, _ in ran.calls]
    assert {(c.runs, c.map, c.seed, c.quick) for c in configs} == {(70, False, 4, quick)}
    assert [(c.motion, c.params, c.scenario, c.gate) for c in configs] == [
        ("arc", None, "capstone", 0.99),
        ("capstone", None, "capstone", 0.99),
        ("euler", None, "capstone", 0.99),
        ("euler", plant, "capstone", 0.99),
        ("euler", plant, "loop", 0.99),
        ("euler", plant, "loop", None),
    ]
    assert len({c.out for c in configs}) == 6
    # What stands beside a study is what it was called with.
    for row, c in zip(rows, configs, strict=True):
        said = row[1].strip("`–")
        options = [] if c.motion == "arc" else [f"--motion {c.motion}"]
        options += [f"--params {plant.name}"] * (c.params is not None)
        options += [f"--scenario {c.scenario}"] * (c.scenario != "capstone") + ["--gate None"] * (c.gate is None)
        assert said == " ".join(options)
        assert row[2:] == ["3.46", "1.12, 0.99, 2.00", "2.35", "98.77 %", readme_tables._short(STUDY["verdict"])]


MATCHES = {
    "rmse_position_m": 0.12345,
    "anees": 2.345,
    "relative_anees": 1.234,
    "edge_anees": 3.456,
    "match_accept_rate": 0.98765,
    "diverged_runs": 1,
}


@pytest.mark.parametrize("quick", [False, True])
def test_the_studies_of_matching_of_the_readme(monkeypatch, tmp_path, quick):
    monkeypatch.setattr(readme_tables.study, "main", ran := Recorder(MATCHES))
    config = readme_tables.TablesConfig(match_runs=70, seed=4, quick=quick)
    rows = rows_of(readme_tables._matches(config, tmp_path))
    configs = [args[0] for args, _ in ran.calls]
    assert {(c.runs, c.map, c.seed, c.match, c.landmarks, c.own_noise) for c in configs} == {
        (8 if quick else 70, False, 4, True, False, True)
    }
    assert len({c.out for c in configs}) == len(rows) == (1 if quick else 10)
    assert rows[0][2:] == ["0.123 m", "2.35", "1.23", "3.46", "98.8 %", "1"]
    assert [c.exact_prior for c in configs[:2]] == ([True] if quick else [True, False])
    # What stands beside a study is what it was called with, but for what it says of the one before.
    for row, c in zip(rows, configs, strict=True):
        options = [f"--odometry-noise {c.odometry_noise:g}"] * (c.odometry_noise != 1)
        options += [f"--scan-noise {c.scan_noise:g}"] * (c.scan_noise != 0.03)
        options += [f"--match-every {c.match_every}"] * (c.match_every != 5)
        said = row[1].strip("`–")
        steps = f" --steps {c.steps}" if c.steps and not quick else " --steps 2400" if quick else ""
        assert said == (" ".join(options) if row[0].startswith("the same") else f"--scenario {c.scenario}{steps}")


def test_the_matched_logs_of_the_readme(monkeypatch, tmp_path):
    score = {"scored": 9, "translation_m": 0.1234, "translation_median_m": 0.05}
    score |= {"rotation_deg": 1.234, "rotation_median_deg": 0.5}
    report = {"relations": score, "revisits": score | {"scored": 7}, "wall_s": 12.6}
    closure = {"kept": 21, "false_kept": 2}
    ran = []

    def slam_main(config):
        ran.append(config)
        return report | ({"closure": closure} if config.closure else {})

    monkeypatch.setattr(readme_tables.slam, "main", slam_main)
    folder = tmp_path / "carmen" / "raw_odom"
    folder.mkdir(parents=True)
    poses = {"12.5": {"x": 1.0, "y": 2.0, "theta": 0.5, "range": []}, "9.5": {"x": 0.0, "y": 0.0, "theta": 0.0}}
    text = json.dumps({"map": poses}).encode()
    for name in ("intel", "csail"):
        (folder / f"{name}_corrected_log.json.gz").write_bytes(gzip.compress(text))
    rows = rows_of(readme_tables._slam(readme_tables.TablesConfig(), tmp_path, tmp_path))
    reference = tmp_path / "reference.tum"
    assert [(c.log.name, c.relations and c.relations.name, c.reference, c.closure) for c in ran] == [
        ("intel-raw.log.gz", "intel.relations", reference, True),
        ("intel-raw.log.gz", "intel.relations", reference, False),
        ("csail-raw.log.gz", None, reference, True),
        ("csail-raw.log.gz", None, reference, False),
    ]
    assert len({c.out for c in ran}) == 4
    assert rows[0] == ["Intel", "closed", "relations, 9", "0.123 m, 0.050 m", "1.23°, 0.50°", "21, 2", "13"]
    assert rows[1][1:3] + rows[1][5:] == ["`--no-closure`", "relations, 9", "–", "13"]
    assert rows[2][:3] == ["CSAIL", "closed", "revisits, 7"]
    read = read_trajectory(reference)
    np.testing.assert_allclose(read.time, [9.5, 12.5])
    np.testing.assert_allclose(read.pose, [[0, 0, 0], [1, 2, 0.5]])


def test_the_logs_of_the_readme(monkeypatch, tmp_path):
    log = {"rmse_position_m": 0.12345, "anees": 4.5, "gate_accept_rate": 0.987, "verdict": "so: it is (x)"}
    monkeypatch.setattr(readme_tables.localize, "main", ran := Recorder(log | {"gate_verdict": "fine; yet"}))
    config = readme_tables.TablesConfig(quick=True)
    rows = rows_of(readme_tables._logs(config, Path("d"), tmp_path))
    configs = [args[0] for args, _ in ran.calls]
    assert all(c.quick for c in configs)
    assert len({c.out for c in configs}) == 8
    woods = Path("d/lost_in_the_woods/dataset2.mat"), "woods", "euler"
    assert [(c.log, c.format, c.motion, c.max_range, c.gate) for c in configs[:3]] == [
        (*woods, 5.0, 0.99),
        (*woods, 5.0, None),
        (*woods, 1.5, 0.99),
    ]
    assert [(c.log, c.format, c.motion, c.robot) for c in configs[3:]] == [
        (Path("d/mrclam/MRCLAM_Dataset6"), "mrclam", "arc", robot) for robot in range(1, 6)
    ]
    assert rows[0] == ["woods `--motion euler --max-range 5`", "0.123 m", "4.5", "98.7 %", "so: it is; fine"]
    assert [row[0] for row in rows[1:3]] == [
        "woods `--motion euler --max-range 5 --gate None`",
        "woods `--motion euler --max-range 1.5`",
    ]
    five = [", ".join([value] * 5) for value in ("0.123", "4.5", "98.7")]
    assert rows[3] == ["MRCLAM dataset 6, `--robot 1` to `5`", f"{five[0]} m", five[1], f"{five[2]} %", "so"]


@pytest.mark.parametrize(("data", "write"), [(None, False), (None, True), (Path("d"), True)])
def test_tables_are_written_where_that_is_asked_for(monkeypatch, tmp_path, data, write):
    for name in ("studies", "matches", "logs", "slam"):
        monkeypatch.setattr(readme_tables, f"_{name}", Recorder(f"{name}' table"))
    monkeypatch.setattr(readme_tables, "replace_table", replaced := Recorder())
    tables = readme_tables.main(readme_tables.TablesConfig(data=data, write=write, out=tmp_path))
    names = ("studies", "matches", "logs", "slam") if data else ("studies", "matches")
    expected = {name: f"{name}' table" for name in names}
    assert tables == expected
    assert [args for args, _ in replaced.calls] == (list(expected.items()) if write else [])


@pytest.mark.parametrize(
    ("verdict", "short"),
    [
        ("consistent", "consistent"),
        ("consistent (ANEES 3)", "consistent"),
        ("over-confident (ANEES 4, 3 expected); 2 runs lost", "over-confident; 2 runs lost"),
    ],
)
def test_a_verdict_is_shown_without_its_numbers(verdict, short):
    assert readme_tables._short(verdict) == short
