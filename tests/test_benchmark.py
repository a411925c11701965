"""The baselines do the work they are timed for, and the benchmark writes what it promises."""

import contextlib
import importlib
import io
import json
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import reference

from jaxlocmap.filters import ekf

pytestmark = pytest.mark.slow
EXPERIMENTS = Path(__file__).parent.parent / "experiments"
sys.path.append(str(EXPERIMENTS))
benchmark, course, cpp, peers = map(
    importlib.import_module, ("benchmark", "baselines.course", "baselines.cpp", "baselines.peers")
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return cpp.build(tmp_path_factory.mktemp("cpp"))


@pytest.fixture
def program(built):
    if built is None:
        pytest.skip("no C++ compiler here")
    return built


@pytest.fixture(scope="module")
def driven():
    """What the course's program makes of a run."""
    return course.run(seed=4)


@pytest.fixture(scope="module")
def quick(tmp_path_factory, built, driven):
    """What `benchmark.py --quick` wrote and printed: here in smaller studies, since a program that is compiled for a
    test is slow, and with the C++ program and the run of the course that the other tests look at.
    """
    out, printed = tmp_path_factory.mktemp("benchmark"), io.StringIO()
    with contextlib.ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setattr(benchmark, "QUICK", benchmark.QUICK._replace(runs=400))
        patch.setattr(cpp, "build", lambda folder: built)
        patch.setattr(course, "run", lambda seed: driven)
        patch.setattr(sys, "argv", ["benchmark.py", "--quick", "--no-cache", "--out", str(out)])
        stack.enter_context(jax.enable_x64(False))
        stack.enter_context(jax.numpy_rank_promotion("allow"))
        stack.enter_context(jax.numpy_dtype_promotion("standard"))
        stack.enter_context(contextlib.redirect_stdout(printed))
        benchmark.command_line(benchmark.main)
    return json.loads((out / "report.json").read_text()), (out / "tables.md").read_text(), printed.getvalue()


def test_cpp_filters_and_maps_a_given_run_as_the_reference(program):
    ran = reference.course_run(motion="arc", conventions="design", gate=ekf.gate_threshold(0.99, 2))
    beliefs, log_odds = cpp.check(program, ran["control"], ran["z"], ran["valid"], ran["scans"])
    # Float32 keeps 1e-6 of poses of 10 m, and each landmark seen draws the errors of the steps before together.
    np.testing.assert_allclose(beliefs[:, :3], ran["mean"], rtol=0, atol=1e-5)
    upper = np.triu_indices(3)
    np.testing.assert_allclose(beliefs[:, 3:9], ran["cov"][:, upper[0], upper[1]], rtol=1e-5, atol=5e-8)
    np.testing.assert_allclose(beliefs[:, 9], ran["log_likelihood"].sum(1), rtol=0, atol=2e-4)

    expected = np.zeros(reference.COURSE_GRID_SHAPE)
    for pose, ranges in zip(beliefs[:, :3].astype(float), ran["scans"], strict=True):
        expected = reference.update_scan(expected, pose, ranges, reference.COURSE_ANGLES, **reference.COURSE_SCAN)
    # A beam's end is off by 1e-6 m, which of 240 · 61 puts a third of one beam into the cell beside: one of 41 cells.
    assert np.sum(np.abs(log_odds - expected) > 1e-4) <= 41
    assert np.sum(expected != 0) > 2000


def test_cpp_totals_depend_on_the_seed_and_not_on_the_threads(program):
    one, three, other = (
        cpp.study(program, 99, mapping=True, threads=threads, seed=seed) for threads, seed in ((1, 0), (3, 0), (1, 1))
    )
    timing = {"threads", "seconds", "runs_per_s"}
    same = {name: value for name, value in one.items() if name not in timing}
    assert same == pytest.approx({name: three[name] for name in same}, rel=1e-6)
    assert other["anees"] != one["anees"]
    assert one["runs"] == 99
    assert one["flagged_steps"] == 0


def test_cpp_profile_adds_up(program):
    parts = cpp.profile(program, 20)
    names = ("drive_normals", "drive", "filter", "score", "scan_normals", "ray_cast", "map_update", "map_score")
    assert sum(parts[name] for name in names) == pytest.approx(parts["with_map"], abs=0.1)


def test_a_missing_compiler_is_no_error_and_a_refusing_one_is(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert cpp.build(tmp_path) is None
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(OSError, match=r"cannot build study\.cpp"):
        cpp.build(tmp_path)


def test_the_course_program_makes_the_course_numbers(driven):
    assert driven["rmse_position_m"] == pytest.approx(0.0293, abs=5e-5)
    assert driven["occupancy_mean"] == pytest.approx(0.4352, abs=5e-5)


@pytest.fixture(scope="module")
def drives():
    return peers.drive(runs=500, steps=41, seed=1)


def beliefs(drives, size=1.0):
    """Means off by as much as their covariances say."""
    root = size * np.array([[0.02, 0, 0], [0.01, 0.03, 0], [0.002, 0.001, 0.01]])
    means = drives.truth + np.random.default_rng(2).standard_normal(drives.truth.shape) @ root.T
    return means, np.broadcast_to(root @ root.T, (*drives.truth.shape, 3)).copy()


@pytest.mark.parametrize("size", [1.0, 0.01])  # the smaller, the more of the prediction is the process's noise
def test_score_of_honest_beliefs(drives, size):
    found = peers.score(drives, *beliefs(drives, size))
    samples = drives.truth[..., 0].size
    assert found["anees"] == pytest.approx(3, abs=5 * np.sqrt(6 / samples))
    assert found["anees_standard_error"] == pytest.approx(np.sqrt(6 / samples), rel=0.2)
    assert found["nis_mean"] == pytest.approx(8, abs=5 * np.sqrt(16 / (500 * 4)))  # of every tenth step
    assert (found["diverged_runs"], found["unusable_steps"]) == (0, 0)


def test_score_wraps_and_counts_what_is_lost(drives):
    means, covs = beliefs(drives)
    turned = means + np.array([0, 0, 2 * np.pi])
    assert peers.score(drives, turned, covs)["anees"] == pytest.approx(peers.score(drives, means, covs)["anees"])
    means[0, 20] += 1.5  # far off and sure of it
    means[1, -1] = np.nan
    covs[2, -1] = np.diag([1, 1, -1])
    covs[3, 5] = np.diag([1, 1, -1])  # recovers
    covs[4], means[4] = 10 * np.eye(3), means[4] + 1.5  # far off and says so
    covs[5] *= 1e-3  # too sure, but near
    found = peers.score(drives, means, covs)
    assert (found["diverged_runs"], found["unusable_steps"]) == (3, 3)


def test_drives_are_repeatable_and_see_what_they_pass(drives):
    again = peers.drive(runs=500, steps=41, seed=1)
    np.testing.assert_array_equal(again.z, drives.z)
    dx, dy = (peers.LANDMARKS[2, i] - drives.truth[..., i] for i in (0, 1))
    assert np.std(drives.z[..., 4] - np.hypot(dx, dy)) == pytest.approx(peers.RANGE_STD, rel=0.1)
    off = (drives.z[..., 5] - np.arctan2(dy, dx) + drives.truth[..., 2] + np.pi) % (2 * np.pi) - np.pi
    assert np.std(off) == pytest.approx(peers.BEARING_STD, rel=0.1)
    assert np.abs(drives.z[..., 1::2]).max() <= np.pi


def test_pairs_are_measured_in_turns():
    order = []
    speeds = {"ours": iter([4.0, 9.0, 12.0]), "other": iter([1.0, 3.0, 2.0])}

    def measure(name):
        order.append(name)
        return next(speeds[name])

    found = benchmark._in_turns(lambda: measure("ours"), lambda: measure("other"), 3)
    assert order == ["ours", "other"] * 3
    assert (found["ratio"], found["ratio_min"], found["ratio_max"]) == (4.0, 3.0, 6.0)
    assert (found["ours"], found["other"]) == (9.0, 2.0)


@pytest.mark.parametrize("mapping", ["without_map", "with_map"])
def test_library_and_cpp_agree(quick, mapping):
    written = quick[0]["study"]
    if written["cpp"] is None:
        pytest.skip("no C++ compiler here")
    apart = written[mapping]["difference"]
    assert {"anees", "nis_mean", "mean_square_position", "mean_square_yaw", "gate_accept_rate"} <= set(apart)
    assert ({"entropy_bits", "brier"} <= set(apart)) == (mapping == "with_map")
    # In standard errors of the difference between independent runs: one in a million is 5 apart, and one in a hundred
    # thousand where the spread is that of 40 runs, which is Student's.
    assert max(map(abs, apart.values())) < 5


def test_quick_writes_its_report_and_tables(quick):
    written, tables, printed = quick
    assert {"machine", "pairs", "wall_s", "study", "filter"} <= set(written)
    study = written["study"]
    for row in (study["without_map"], study["with_map"]):
        assert row["ours"] > 0
        assert study["cpp"] is None or row["ratio"] == pytest.approx(row["ours"] / row["other"])
        assert row["compile_s"] > 0
    assert study["course"]["ratio"] == pytest.approx(study["with_map"]["ours"] * study["course"]["seconds_a_run"])
    by_name = {found["name"]: found for found in written["filter"]["filters"]}
    assert set(by_name) == {peers.OURS.name, *(peer.name for peer in peers.PEERS)}
    # 20 runs of 50 steps: the spread between runs is written beside the average.
    ours = by_name["jaxlocmap"]
    assert ours["anees"] == pytest.approx(3, abs=5 * ours["anees_standard_error"])
    assert ours["diverged_runs"] == 0
    for found in by_name.values():
        assert ("steps_per_s" in found) == (found["version"] is not None or found is ours)
        assert ("not installed" in tables) == any(found["version"] is None for found in by_name.values())
    for line in ("study without maps", "study with maps", "the same, plain Python", "jaxlocmap"):
        assert line in tables
        assert line in printed
    shown = [line for line in printed.splitlines() if not line.startswith(("wrote", "tracing"))]  # those hold paths
    assert max(map(len, shown)) <= 100
