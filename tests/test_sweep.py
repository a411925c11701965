"""Sweeps: every parameter enters its cell and no other, a cell is a study of its own, and values never recompile."""

import dataclasses
import itertools
import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drives import like

from jaxlocmap import Params, plotting, simulation
from jaxlocmap.cli import sweep as command
from jaxlocmap.consistency import sweep
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.monte_carlo import monte_carlo

# In sight of all four landmarks, which the detector looks for in every second step; it can be lied to.
SHORT = like(simulation.CAPSTONE, name="short", start=(6.0, 8.5, 0.5), steps=12, detector=dict(period=2, outliers=True))
RUNS, RATES, GATES = 16, (0.0, 0.3, 0.6), (0.9, 1.0)
Q, R = np.diag([0.02**2, 0.051**2]), np.diag([0.08**2, 0.02**2])


# What a value of 4 does to (Q, R, outlier rate, gate); the last two take any value, here where nothing runs.
ENTERED = {
    "Q": (4 * Q, R, 0, None),
    "R": (Q, 4 * R, 0, None),
    "sigma_v": (np.diag([(4 * 0.02) ** 2, 0.051**2]), R, 0, None),
    "sigma_w": (np.diag([0.02**2, (4 * 0.051) ** 2]), R, 0, None),
    "sigma_range": (Q, np.diag([(4 * 0.08) ** 2, 0.02**2]), 0, None),
    "sigma_bearing": (Q, np.diag([0.08**2, (4 * 0.02) ** 2]), 0, None),
    "gate_probability": (Q, R, 0, 4),
    "outlier_rate": (Q, R, 4, None),
}


@dataclasses.dataclass(frozen=True)
class Stub:
    """In the place of a study: hands back what it was given."""

    def __call__(self, key, params, world, noise, prior):
        del key, world, prior
        gate = jnp.zeros(()) if params.gate_probability is None else params.gate_probability
        return {"Q": params.Q, "R": params.R, "rate": jnp.asarray(noise.outlier_rate, float), "gate": gate}


def handed(x, y, x_values, y_values, params):
    study = sweep.SweepStudy(Stub(), x, y)
    return study(None, jnp.array(x_values), jnp.array(y_values), params, None, simulation.Noise(), None)


@pytest.fixture(scope="module")
def params():
    return Params.from_std(v=0.02, w=0.051, range=0.08, bearing=0.02)


@pytest.mark.parametrize("name", sweep.SWEPT)
def test_a_value_enters_its_own_cell_alone(name, params, tolerance):
    other = "Q" if name != "Q" else "R"
    got = handed(name, other, [1.0, 4.0], [1.0, 1.0, 1.0], params)  # x: two columns; y: three rows that change nothing
    expected = ENTERED[name]
    close = {"rtol": tolerance(1e-12, 1e-6)}
    assert got["Q"].shape == (3, 2, 2, 2)
    for row in range(3):
        np.testing.assert_allclose(got["Q"][row, 1], expected[0], **close)
        np.testing.assert_allclose(got["R"][row, 1], expected[1], **close)
        assert float(got["rate"][row, 1]) == expected[2]
        assert float(got["gate"][row, 1]) == (expected[3] or 0)
        np.testing.assert_allclose(got["Q"][row, 0], Q, **close)
        np.testing.assert_allclose(got["R"][row, 0], R, **close)


def test_two_scales_of_one_matrix_work_together(tolerance):
    """And on a full matrix, correlation and all."""
    full = np.array([[4e-4, 3e-4], [3e-4, 9e-4]])
    params = Params(*map(jnp.asarray, (full, R, 0.85, -0.4)))
    got = handed("sigma_v", "Q", [3.0], [2.0], params)["Q"][0, 0]
    np.testing.assert_allclose(
        got, [[2 * 9 * 4e-4, 2 * 3 * 3e-4], [2 * 3 * 3e-4, 2 * 9e-4]], rtol=tolerance(1e-12, 1e-6)
    )


def test_every_parameter_can_be_swept():
    assert set(ENTERED) == set(sweep.SWEPT)


# --- Cells that are run ---


def settings():
    return SHORT.config(motion="euler", gate_probability=None, grid=False)


def shared():
    noise = simulation.Noise()
    return simulation.own_params(noise, SHORT), simulation.room(), noise, SHORT.prior()


@pytest.fixture(scope="module")
def grid():
    """Every run of every cell."""
    study = sweep.SweepStudy(Study(SHORT, settings()), "outlier_rate", "gate_probability")
    values = jnp.array(RATES), jnp.array(GATES)
    return monte_carlo(study, jax.random.key(0), RUNS, *values, *shared()).value


@pytest.fixture(scope="module")
def program(grid, tmp_path_factory):
    """Two sweeps by the program, over other values each, after one that has compiled it."""
    del grid
    patch = pytest.MonkeyPatch()
    patch.setitem(simulation.SCENARIOS, "short", SHORT)
    reports = []
    for rates, gates in (((0.0, 0.2, 0.8), (0.5, 1.0)), (RATES, GATES)):
        out = tmp_path_factory.mktemp("sweep")
        config = command.SweepConfig(
            "outlier_rate", "gate_probability", rates, gates, scenario="short", runs=RUNS, out=out
        )
        reports.append((command.main(config), out))
    patch.undo()
    return reports


def alone(rate, gate):
    """A study of one cell."""
    params, world, noise, prior = shared()
    noise = noise._replace(outlier_rate=jnp.asarray(rate, float))
    params = params._replace(gate_probability=jnp.asarray(gate, float))
    arguments = (params, world, noise, prior)
    return monte_carlo(Study(SHORT, settings()), jax.random.key(0), RUNS, *arguments).value


def test_a_cell_is_a_study_of_its_own(grid, tolerance):
    rounding = tolerance(1e-9, 1e-3)  # vectors of another width round apart
    for (i, gate), (j, rate) in itertools.product(enumerate(GATES), enumerate(RATES)):
        for got, expected in zip(*map(jax.tree.leaves, (grid, alone(rate, gate))), strict=True):
            np.testing.assert_allclose(got[i, j], expected, rtol=rounding, atol=rounding)
    assert grid.nees.shape == (len(GATES), len(RATES), SHORT.steps)


def test_what_outliers_and_a_gate_do(grid):
    let_in, seen = grid.accepted.sum(-1), grid.observed.sum(-1)
    np.testing.assert_array_equal(let_in[1], seen[1])  # a gate of 1 is none
    assert np.all(let_in[0, 1:] < 0.9 * seen[0, 1:])
    assert np.all(grid.average.nees[1, 1:] > 100 * grid.average.nees[1, 0])  # without one, the robot is lost


def test_other_values_compile_nothing(program):
    assert [report["compile_s"] for report, _ in program] == [0, 0]


def test_the_report_has_every_cell_in_its_place(program, grid):
    _, out = program[1]
    written = json.loads((out / "report.json").read_text())
    assert (written["x"], written["y"]) == ("outlier_rate", "gate_probability")
    assert [cell["outlier_rate"] for cell in written["cells"]] == [*RATES, *RATES]
    assert [cell["gate_probability"] for cell in written["cells"]] == [GATES[0]] * 3 + [GATES[1]] * 3
    for k, cell in enumerate(written["cells"]):
        i, j = divmod(k, len(RATES))
        expected = summarise(jax.tree.map(lambda total, i=i, j=j: total[i, j], grid), settings())
        for name in ("anees", "nis_mean", "gate_accept_rate", "rmse_position_m", "diverged_runs", "verdict"):
            assert cell[name] == expected[name]
        assert cell["anees_band_95"] == list(expected["anees_band_95"])
        inside = cell["anees_band_95"][0] <= cell["anees"] <= cell["anees_band_95"][1]
        assert cell["consistent"] == (inside and not cell["diverged_runs"])
    assert written["consistent_cells"] == sum(cell["consistent"] for cell in written["cells"])
    assert (out / "sweep.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert not (out / "parts").exists()


def test_the_report_says_what_the_gate_buys(program):
    rows = program[1][0]["what_the_gate_buys"]
    assert [row["value"] for row in rows] == list(RATES)
    worst = rows[-1]
    assert worst["best"]["gate_probability"] == GATES[0]
    assert worst["without"]["gate_probability"] == 1
    assert worst["best"]["rmse_position_m"] < worst["without"]["rmse_position_m"]


# --- Words and pictures ---


def made_cell(anees, nis, *, consistent=False, **values):
    misfit = abs(math.log(anees / 3)) + abs(math.log(nis / 2)) if anees > 0 else math.inf
    figures = {"anees": anees, "nis_mean": nis, "misfit": misfit, "consistent": consistent, "rmse_position_m": 0.1}
    return figures | {"diverged_runs": 0} | values


def test_the_verdict_prefers_a_consistent_cell_that_fits_the_nis_as_well():
    cells = [
        made_cell(3.0, 4.0, consistent=True, Q=0.125, R=8.0),
        made_cell(3.1, 2.1, consistent=True, Q=1.0, R=1.0),
        made_cell(3.01, 2.0, Q=2.0, R=1.0),  # fits better still
    ]
    said = sweep.verdict("Q", "R", cells)
    assert said.startswith("2 of 3 cells are consistent; ANEES and NIS together fit best at Q × 1, R × 1: ANEES 3.1")
    assert sweep.verdict("Q", "R", cells[1:]).startswith("1 of 2 cells is consistent")
    none = sweep.verdict("Q", "R", cells[2:])
    assert none.startswith("none of 1 cells is consistent; ANEES and NIS together fit best at Q × 2, R × 1")


def with_nees(totals, value):
    """The same, every run's average NEES being `value`."""
    average = totals.average._replace(nees=np.array(value * RUNS))
    return totals._replace(
        average=average, average_square=totals.average_square._replace(nees=np.array(value**2 * RUNS))
    )


def test_a_cell_is_judged_by_both_statistics_and_the_runs_lost(grid):
    totals = jax.tree.map(lambda total: total[1, 0], grid)
    totals = with_nees(totals, 3.0)._replace(run_nis=np.array([2.0, 4.0]) * RUNS)
    totals = totals._replace(diverged=np.array(0.0))
    cell = sweep.judged_cell(totals, settings())
    assert cell["misfit"] == pytest.approx(0, abs=1e-12)
    assert cell["consistent"]
    lost = sweep.judged_cell(totals._replace(diverged=np.array(1.0)), settings())
    assert not lost["consistent"]
    totals = with_nees(totals, 6.0)._replace(run_nis=np.array([1.0, 1.0]) * RUNS)
    assert sweep.judged_cell(totals, settings())["misfit"] == pytest.approx(2 * math.log(2))
    broken = sweep.judged_cell(totals._replace(scored_runs=np.array(0.0)), settings())
    assert broken["misfit"] == math.inf
    assert not broken["consistent"]


def gate_cells(rmse):
    """By gate 0.9 and 1, of the two rates 0 and 0.1."""
    where = itertools.product((0.9, 1.0), (0.0, 0.1))
    return [
        made_cell(3.0, 2.0, gate_probability=gate, outlier_rate=rate, rmse_position_m=value, diverged_runs=i)
        for i, ((gate, rate), value) in enumerate(zip(where, rmse, strict=True))
    ]


@pytest.mark.parametrize(
    ("rmse", "expected"),
    [
        ((0.02, 0.03, 0.01, 0.3), "the gate buys most at outlier rate 0.1: position RMSE 0.03 m with gate 0.9, 0.3 m"),
        ((0.02, 0.03, 0.01, math.nan), "the gate buys most at outlier rate 0.1: position RMSE 0.03 m"),
        ((0.02, 0.03, 0.01, 0.02), "the gate buys no accuracy here"),
    ],
)
def test_the_words_on_the_gate(rmse, expected):
    rows = sweep.what_the_gate_buys("outlier_rate", gate_cells(rmse))
    assert sweep.gate_verdict("outlier_rate", rows, 50).startswith(expected)


def test_the_words_on_the_gate_name_the_runs_lost():
    rows = sweep.what_the_gate_buys("outlier_rate", gate_cells((0.02, 0.03, 0.01, 0.3)))
    assert sweep.gate_verdict("outlier_rate", rows, 50).endswith("1 of 50 runs diverged, 3 without")


def test_without_no_gate_there_is_nothing_to_compare_a_gate_with():
    rows = sweep.what_the_gate_buys("outlier_rate", gate_cells((0.02, 0.03, 0.01, 0.3))[:2])
    assert rows[0]["without"] is None
    assert "nothing to compare" in sweep.gate_verdict("outlier_rate", rows, 50)


@pytest.mark.parametrize(
    ("value", "expected"), [(0.99999, "0.99999"), (1.0, "1"), (0.21022410381342863, "0.21"), (8, "8")]
)
def test_values_are_shown_with_the_digits_they_need(value, expected):
    assert sweep.shown(value) == expected


@pytest.mark.parametrize("shape", [(1, 1), (1, 13), (3, 4)])
@pytest.mark.parametrize("anees", [3.0, 2000.0, math.nan])
def test_a_picture_is_made_of_any_cells(tmp_path, shape, anees):
    """One cell, more than have room for their values, none consistent, some or all no number."""
    rows, columns = shape
    values = [anees, 1.0, 4.0, *[anees] * 10][: rows * columns]
    cells = [made_cell(value, 2.0, consistent=value == 3) for value in values]
    if math.isnan(anees):
        for cell in cells:
            cell |= {"rmse_position_m": math.nan, "nis_mean": math.nan, "misfit": math.inf}
    report = {"cells": cells, "scenario": "loop", "motion": "arc", "runs": 2, "verdict": "so it is"}
    plotting.sweep_figure(tmp_path / "a.png", report, ("x", "y"), (["1"] * columns, ["1"] * rows))
    assert (tmp_path / "a.png").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"x": "mass"}, "x: expected one of Q, R, sigma_v, .*outlier_rate, got 'mass'"),
        ({"y": "mass"}, "y: expected one of Q"),
        ({"x": "R"}, "x, y: expected two different parameters, got R twice"),
        ({"x_values": ()}, "x_values: expected at least one value of Q, got none"),
        ({"y_values": (1.0, 0.0)}, r"y_values: expected a scale in \[1e-6, 1e6\] for R, got 0"),
        ({"y_values": (math.nan,)}, "y_values: expected a scale .* for R, got nan"),
        ({"x": "gate_probability", "x_values": (0.0,)}, r"x_values: expected a probability in \(0, 1\] .*, got 0"),
        ({"x": "gate_probability", "x_values": (1.1,)}, r"x_values: expected a probability in \(0, 1\] .*, got 1.1"),
        ({"x": "outlier_rate", "x_values": (-0.1,)}, r"x_values: expected a share in \[0, 1\] .*, got -0.1"),
        ({"x": "gate_probability", "gate": 0.9}, "gate: swept as gate_probability: expected it not to be given"),
        ({"runs": 1}, "runs: expected at least 2, which a band needs, got 1"),
        ({"scenario": "moon"}, "scenario: expected one of"),
    ],
)
def test_nonsense_is_refused(tmp_path, arguments, expected):
    with pytest.raises(ValueError, match="^" + expected):
        command.main(command.SweepConfig(**arguments, out=tmp_path))
