"""Every program runs, writes what it promises, and answers a mistake with one clear line."""

import importlib
import json
import os
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxlocmap.cli import command
from jaxlocmap.cli import main as jobs

pytestmark = pytest.mark.slow
EXPERIMENTS = Path(__file__).parent.parent / "experiments"


@pytest.fixture
def run(capsys, monkeypatch, as_a_program):
    """A program's exit status and output, as from a command line, in this process, where JAX has started."""

    def leave(status, last_words):
        print(last_words, file=sys.stderr)
        sys.exit(status)

    monkeypatch.syspath_prepend(EXPERIMENTS)
    monkeypatch.setattr(command, "_leave", leave)  # it ends a process that has threads, as that of the tests

    def call(name, *arguments):
        programs, words = (jobs.JOBS, [name]) if name in jobs.JOBS else (importlib.import_module(name).main, [])
        monkeypatch.setattr(sys, "argv", ["jaxlocmap", *words, *map(str, arguments), "--no-cache"])
        status = 0
        with jax.enable_x64(False):
            try:
                command.command_line(programs)
            except SystemExit as end:
                status = end.code
        return status, "".join(capsys.readouterr())

    return call


def report(folder):
    return json.loads((folder / "report.json").read_text())


def is_png(path):
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def data(*parts):
    """A real log, where JAXLOCMAP_DATA says they are."""
    if "JAXLOCMAP_DATA" not in os.environ:
        pytest.skip("JAXLOCMAP_DATA is not set: no real logs here")
    return Path(os.environ["JAXLOCMAP_DATA"]).joinpath(*parts)


STUDY_FIELDS = [
    "scenario",
    "runs",
    "steps",
    "anees",
    "anees_band_95",
    "nis_mean",
    "nis_band_95",
    "nees_per_step",
    "coverage_95",
    "rmse_position_m",
    "rmse_yaw_rad",
    "gate_accept_rate",
    "diverged_runs",
    "map",
    "verdict",
    "wall_s",
    "compile_s",
    "runs_per_s",
]


def test_a_study_writes_its_report_and_figures(run, tmp_path):
    # Without a gate and from a drawn start it needs no reference, which a study without maps below has.
    options = ("--quick", "--gate", "None", "--start", "drawn", "--beams", 9)
    status, output = run("study", *options, "--out", tmp_path)
    assert status == 0, output
    written = report(tmp_path)
    assert set(STUDY_FIELDS) <= set(written)
    assert {"entropy_bits", "brier"} <= set(written["map"])
    assert written["runs"] == 100
    assert len(written["nees_per_step"]) == written["steps"] == 240
    assert written["verdict"] in " ".join(output.split())
    assert is_png(tmp_path / "nees.png")
    assert is_png(tmp_path / "map.png")
    tables = [line for line in output.splitlines() if not line.startswith(("wrote", "tracing"))]  # those hold paths
    assert max(map(len, tables)) <= 100


def test_a_study_takes_params_from_a_file_and_can_leave_out_the_map(run, tmp_path):
    plant = {"Q": [[0.02**2, 0], [0, 0.051**2]], "R": [[0.08**2, 0], [0, 0.02**2]], "l_occ": 0.85, "l_free": -0.4}
    (tmp_path / "plant.json").write_text(json.dumps(plant))
    # As many runs as the reference has and the robot's own motion, so that both are one program.
    size = ("--no-map", "--motion", "euler", "--runs", 2000, "--steps", 60)
    status, output = run("study", *size, "--params", tmp_path / "plant.json", "--out", tmp_path)
    assert status == 0, output
    written = report(tmp_path)
    np.testing.assert_allclose(written["params"]["Q"], plant["Q"], rtol=1e-6)
    assert "map" not in written
    assert not (tmp_path / "map.png").exists()
    # With nearly the robot's own noise ANEES is that of the reference, 2.22, with a standard error of 0.03 in each; the
    # course's noise would give 1.45.
    assert written["anees_standard_error"] < 0.04
    assert written["anees"] == pytest.approx(written["anees_reference"], abs=0.2)
    assert 2.0 < written["anees_reference"] < 2.45


def test_capstone_reproduces_the_numbers_of_the_course(run, tmp_path):
    status, output = run("capstone", "--out", tmp_path)
    assert status == 0, output
    written = report(tmp_path)
    np.testing.assert_allclose(written["final_pose"], [6.46387367, 5.58104105, 0.32367098], rtol=0, atol=1e-8)
    assert round(written["rmse_position_m"], 4) == 0.0293
    assert round(written["rmse_yaw_rad"], 4) == 0.0136
    occupancy = [written[f"occupancy_{name}"] for name in ("min", "max", "mean")]
    np.testing.assert_allclose(occupancy, [0.018, 0.982, 0.4344], rtol=0, atol=5e-4)
    assert {"final_cov_diag", "map_entropy_bits"} <= set(written)
    assert is_png(tmp_path / "trajectory.png")
    assert is_png(tmp_path / "map.png")


LOCALIZE_FIELDS = [
    "steps",
    "observations",
    "gate_accept_rate",
    "rmse_position_m",
    "rmse_yaw_rad",
    "anees",
    "nees_median",
    "nis_mean",
    "coverage_95",
]


def test_localize_judges_a_real_log(run, tmp_path):
    woods = data("lost_in_the_woods", "dataset2.mat")
    status, output = run("localize", woods, "--format", "woods", "--quick", "--out", tmp_path)
    assert status == 0, output
    written = report(tmp_path)
    assert set(LOCALIZE_FIELDS) <= set(written)
    assert written["steps"] == 2000
    assert is_png(tmp_path / "trajectory.png")
    assert is_png(tmp_path / "nees.png")
    for name in ("estimate.tum", "truth.tum"):
        assert np.loadtxt(tmp_path / name).shape[1] == 8


def test_localize_says_that_the_gate_is_locked_out(run, tmp_path):
    woods = data("lost_in_the_woods", "dataset2.mat")
    status, output = run("localize", woods, "--format", "woods", "--max-range", 1.5, "--out", tmp_path)
    assert status == 0, output
    assert "locked out" in report(tmp_path)["gate_verdict"]
    assert "locked out" in output


def test_localize_needs_a_start_where_there_is_no_truth(run, tmp_path):
    folder = data("mrclam", "MRCLAM_Dataset9")
    arguments = (folder, "--format", "mrclam", "--robot", 1, "--quick", "--out", tmp_path)
    status, output = run("localize", *arguments)
    assert status == 1
    assert "no truth to start from" in output
    status, output = run("localize", *arguments, "--start", 0, 0, 0)
    assert status == 0, output
    assert report(tmp_path)["anees"] is None
    assert not (tmp_path / "truth.tum").exists()


def test_a_map_is_made_of_a_real_building(run, tmp_path):
    from jaxlocmap.mapping.ros import FREE, OCCUPIED, load_map

    intel = data("carmen", "intel-corrected.log.gz")
    status, output = run("map", intel, "--format", "carmen", "--resolution", 0.1, "--quick", "--out", tmp_path)
    assert status == 0, output
    written = report(tmp_path)
    assert {"scans", "beams", "cells", "occupied", "free", "entropy_bits", "scans_per_s"} <= set(written)
    cells, spec = load_map(tmp_path / "map.yaml")
    assert spec.resolution == 0.1
    assert written["cells"] == cells.size
    assert (written["occupied"], written["free"]) == (np.sum(cells == OCCUPIED), np.sum(cells == FREE))
    assert is_png(tmp_path / "map.png")


def test_a_resolution_too_fine_for_the_memory_is_refused(run, tmp_path):
    intel = data("carmen", "intel-corrected.log.gz")
    status, output = run("map", intel, "--format", "carmen", "--resolution", 0.0005, "--out", tmp_path)
    assert status == 1
    assert "resolution: expected" in output
    assert "Traceback" not in output


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("study", ("--scenario", "moon"), "scenario"),
        ("study", ("--motion", "hover"), "motion"),
        ("study", ("--gate", "1.5"), "gate: expected a probability inside (0, 1)"),
        ("study", ("--runs", "0"), "runs: expected at least 1, got 0"),
        ("study", ("--params", "nowhere.json"), "nowhere.json"),
        ("study", ("--out", "/proc/nothing"), "out: expected a folder that can be written"),
        ("localize", ("nowhere.mat", "--format", "woods"), "nowhere.mat"),
        ("localize", (".", "--format", "mrclam"), "robot: expected a robot's number"),
        ("localize", (".", "--format", "rosbag"), "rosbag"),
        ("map", ("nowhere.log", "--format", "carmen"), "nowhere.log"),
        ("map", ("nowhere.log", "--format", "carmen", "--resolution", "0"), "resolution: expected metres > 0, got"),
        ("map", ("nowhere.log", "--format", "carmen", "--resolution", "nan"), "resolution: expected metres > 0"),
    ],
)
def test_a_mistake_gets_one_clear_line(run, tmp_path, name, arguments, expected):
    out = () if "--out" in arguments else ("--out", tmp_path)
    status, output = run(name, *arguments, *out)
    assert status != 0
    assert expected in output
    assert "Traceback" not in output
