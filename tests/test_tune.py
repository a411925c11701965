"""The tuning program: what it writes, and what it says to a mistake."""

import json
import sys
from pathlib import Path

import jax
import pytest
from test_experiments import is_png

from jaxlocmap import Params

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import tune


@pytest.fixture(autouse=True)
def as_a_program(monkeypatch):
    """Not in the strict session: a program makes its own. Its devices are those there are."""
    monkeypatch.setattr(tune.hosts, "use_all_cores", lambda: None)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield


def tuned(folder, **settings):
    tune.main(tune.TuneConfig(quick=True, out=folder, **settings))
    return json.loads((folder / "report.json").read_text())


def test_simulated_drives(tmp_path):
    report = tuned(tmp_path, motion="euler", tune=("range", "bearing"), optimiser="adam", gate=None)
    assert set(report["parameters"]) == {"range", "bearing"}
    for value in report["parameters"].values():
        assert {"start", "end", "standard_error", "unit"} == set(value)
    losses = report["loss"]["innovation"]
    assert losses["train_after"] < losses["train_before"] - 0.3
    assert losses["validation_after"] < losses["validation_before"] - 0.3
    before, after = report["held_out"]["before"], report["held_out"]["after"]
    for fields in (before, after):
        assert {"anees", "nis_mean", "coverage_95", "rmse_position_m", "gate_accept_rate"} <= set(fields)
    assert abs(after["nis_mean"] - 2) < abs(before["nis_mean"] - 2)
    assert report["evaluations"] >= 4
    assert report["wall_s"] > report["run_s"] > 0
    best = Params.load(tmp_path / "params.json")
    assert float(best.R[0, 0]) ** 0.5 == pytest.approx(report["parameters"]["range"]["end"], rel=1e-6)
    assert is_png(tmp_path / "descent.png")
    assert is_png(tmp_path / "nees.png")


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"loss": ("speed",)}, "loss: expected one of"),
        ({"loss": ("pose=much",)}, "loss: expected NAME or NAME=WEIGHT, got 'pose=much'"),
        ({"tune": ("speed",)}, "tuned: expected some of"),
        ({"minibatch": 3}, "expected --optimiser adam"),
        ({"log": Path("nowhere")}, "log, format: expected both or neither"),
        ({"log": Path("nowhere"), "format": "carmen"}, "a carmen log has no landmarks: expected `map` alone"),
        ({"log": Path("nowhere"), "format": "mrclam", "judged": ()}, "expected robots to tune on and others to judge"),
        ({"log": Path("nowhere"), "format": "mrclam", "loss": ("map",)}, "the format mrclam has no scans, got `map`"),
        ({"runs": 1}, "runs: expected at least 2, got 1"),
    ],
)
def test_a_mistake_is_named(tmp_path, settings, expected):
    with pytest.raises(ValueError, match=expected.replace("(", r"\(")):
        tuned(tmp_path, **settings)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"Q": [[1.0, 2.0], [2.0, 1.0]]}, r"bad.json: Q: expected a positive definite matrix"),
        ({"l_free": 0.4}, r"bad.json: l_free: expected a finite value < 0"),
    ],
)
def test_a_start_that_is_no_filter(tmp_path, change, expected):
    fields = {"Q": [[1.0, 0.0], [0.0, 1.0]], "R": [[1.0, 0.0], [0.0, 1.0]], "l_occ": 0.8, "l_free": -0.4}
    (tmp_path / "bad.json").write_text(json.dumps(fields | change))
    with pytest.raises(ValueError, match=expected):
        tuned(tmp_path, params=tmp_path / "bad.json")
