"""The benchmark's own sums and tables, and its options, with nothing measured."""

import contextlib
import dataclasses
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import reference
from programs import Recorder, stop

from jaxlocmap import simulation

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import benchmark
from baselines import course, cpp, peers, probe, tables

pytestmark = pytest.mark.usefixtures("as_a_program")
SIZE = benchmark.Size(3, 2.0)
PROGRAM = cpp.Program(Path("study"), "g++ 1", "g++ -O3")


@pytest.mark.parametrize(
    ("options", "size", "sections"),
    [
        ({}, (3, 2.0), ("study", "filter", "devices", "cost")),
        ({"pairs": 5, "seconds": 0.5, "seed": 8}, (5, 0.5), ("study", "filter", "devices", "cost")),
        ({"only": ("cost", "filter")}, (3, 2.0), ("filter", "cost")),
        ({"quick": True, "pairs": 5}, (1, 0.0), ("study", "filter")),
        ({"quick": True, "only": ("devices",)}, (1, 0.0), ("devices",)),
    ],
)
@pytest.mark.parametrize("write", [False, True])
def test_options_of_the_benchmark(monkeypatch, tmp_path, options, size, sections, write):
    for name in ("merge_kernels", "saved"):
        monkeypatch.setattr(benchmark, name, Recorder())
    monkeypatch.setattr(benchmark, "use_all_cores", Recorder(6))
    measured = {}
    for name, section in (("_studies", "study"), ("_filters", "filter"), ("_devices", "devices"), ("_costs", "cost")):
        monkeypatch.setattr(benchmark, name, measured.setdefault(section, Recorder(f"measured {section}")))
    empty = tables.Table((), [])
    monkeypatch.setattr(tables, "overview", Recorder(tables.Table(("a", "b"), [("1", "")])))
    monkeypatch.setattr(tables, "filters", Recorder(empty))
    monkeypatch.setattr(tables, "notes", Recorder(["a note"]))
    monkeypatch.setattr(benchmark, "replace_table", replaced := Recorder())
    report = benchmark.main(benchmark.BenchmarkConfig(**options, write=write, out=tmp_path))
    assert {section: report[section] for section in measured if section in report} == {
        section: f"measured {section}" for section in sections
    }
    for section in sections:
        ((args, _),) = measured[section].calls
        assert args[0][:2] == size
        assert section == "cost" or args[1] == report["seed"] == options.get("seed", 0)
    assert report["pairs"] == size[0]
    assert report["machine"]["devices"] == 6
    text = "| a | b |\n| --- | --- |\n| 1 | – |\n\na note"
    assert (tmp_path / "tables.md").read_text() == text + "\n"
    assert replaced.calls == ([(("benchmark", text), {})] if write else [])
    assert json.loads((tmp_path / "report.json").read_text())["pairs"] == size[0]


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_seconds_that_are_none_are_refused(monkeypatch, tmp_path, value):
    monkeypatch.setattr(benchmark, "merge_kernels", stop)
    with pytest.raises(ValueError, match="seconds: expected more than 0, finite, got"):
        benchmark.main(benchmark.BenchmarkConfig(seconds=value, out=tmp_path))


@pytest.mark.parametrize(
    ("a_run", "tried"),
    [
        (1.0, [10]),  # long enough at once
        (0.1, [10, 26]),  # 1.3 times what is wanted, for 2 s
        (0.19, [10, 15]),  # at least half as many again
        (1e-6, [10, 500, 25_000, 1_250_000, 2_600_000]),  # at most fifty times as many
    ],
)
def test_a_timing_is_made_long_enough(a_run, tried):
    ran = []
    runs, first, last = benchmark._long_enough(lambda n: ran.append(n) or n, lambda n: n * a_run, 10, 2.0)
    assert (ran, runs, first, last) == (tried, tried[-1], 10, tried[-1])


@pytest.mark.parametrize("mapping", [False, True])
def test_the_benchmark_runs_the_default_study(monkeypatch, mapping):
    monkeypatch.setattr(benchmark, "monte_carlo", ran := Recorder("result"))
    assert benchmark._study(mapping, 7, ["device"])(99) == "result"
    ((study, key, runs, params, *_), how) = ran.calls[0]
    assert (study.scenario, study.config) == (simulation.CAPSTONE, simulation.CAPSTONE.config(grid=mapping))
    assert (runs, how) == (99, {"devices": ["device"]})
    np.testing.assert_array_equal(jax.random.key_data(key), jax.random.key_data(jax.random.key(7)))
    np.testing.assert_array_equal(params.R, simulation.course_params().R)


def test_studies_with_and_without_maps_and_the_course_s_runs(monkeypatch, tmp_path):
    monkeypatch.setattr(cpp, "build", Recorder(PROGRAM))
    monkeypatch.setattr(cpp, "profile", profiled := Recorder("parts"))
    asked = Recorder()
    monkeypatch.setattr(benchmark, "_against_cpp", lambda *args: asked(*args) or {"ours": 50.0 if args[1] else 400.0})
    times = iter([2.0, 4.0, 9.0])
    monkeypatch.setattr(benchmark, "_seconds", lambda work: work() or next(times))
    monkeypatch.setattr(course, "run", drove := Recorder())
    report = benchmark._studies(SIZE, 7, tmp_path, Recorder())
    assert [args for args, _ in asked.calls] == [(PROGRAM, False, SIZE, 7), (PROGRAM, True, SIZE, 7)]
    assert (report["without_map"], report["with_map"]) == ({"ours": 400.0}, {"ours": 50.0})
    assert profiled.calls == [((PROGRAM, 1000), {})]
    assert report["cpp"]["microseconds_a_run"] == "parts"
    assert [args for args, _ in drove.calls] == [(0,), (1,), (2,)]
    assert report["course"] == {"seconds_a_run": 4.0, "ratio": 200.0, "measured": [2.0, 4.0, 9.0]}
    monkeypatch.setattr(cpp, "build", Recorder(None))
    times = iter([1.0] * 3)
    assert benchmark._studies(SIZE, 7, tmp_path, Recorder())["cpp"] is None


@pytest.mark.parametrize(("mapping", "least"), [(False, 20_000), (True, 2000)])
@pytest.mark.parametrize("program", [PROGRAM, None])
def test_a_study_is_compared_at_the_same_work(monkeypatch, mapping, least, program):
    seconds = iter([4.0, 4.0, 5.0, 2.0])
    ran, other = Recorder(), Recorder({"seconds": 3.0, "runs_per_s": 500.0})

    def study(runs):
        ran(runs)
        return SimpleNamespace(value="totals", run_s=next(seconds), compile_s=0.5, chunk=16)

    monkeypatch.setattr(benchmark, "_study", asked := Recorder(study))
    monkeypatch.setattr(benchmark, "summarise", told := Recorder("summary"))
    monkeypatch.setattr(benchmark, "_statistics", lambda summary: {"of": summary})
    monkeypatch.setattr(benchmark, "_difference", apart := Recorder("difference"))
    monkeypatch.setattr(cpp, "study", other)
    monkeypatch.setattr(benchmark.hosts, "cores", lambda: 6)
    row = benchmark._against_cpp(program, mapping, SIZE, 7)
    assert asked.calls == [((mapping, 7, jax.local_devices()), {})]
    assert told.calls == [(("totals", simulation.CAPSTONE.config(grid=mapping)), {})]
    assert {args for args, _ in ran.calls} == {(least,)}
    assert (row["runs"], row["chunk"], row["compile_s"]) == (least, 16, 0.5)
    assert row["statistics"] == {"of": "summary"}
    assert row["ours"] == least / 4
    if program is None:
        assert "ratio" not in row
        return
    assert {(args, *sorted(how.items())) for args, how in other.calls} == {
        ((PROGRAM, least), ("mapping", mapping), ("seed", 7), ("threads", 6))
    }
    assert row["measured"] == [(least / s, 500.0) for s in (4.0, 5.0, 2.0)]
    assert apart.calls == [(({"of": "summary"}, least, other.answer), {})]
    assert row["difference"] == "difference"


def test_the_statistics_that_are_compared():
    names = ("anees", "anees_standard_error", "nis_mean", "nis_standard_error", "rmse_position_m", "rmse_yaw_rad")
    names += ("gate_accept_rate", "coverage_95", "diverged_runs")
    summary = {name: i for i, name in enumerate(names)}
    assert benchmark._statistics(summary | {"more": 0}) == summary
    maps = {"entropy_bits": 90, "brier": 91}
    assert benchmark._statistics(summary | {"map": maps | {"more": 0}}) == summary | maps


def test_two_programs_differ_in_standard_errors_of_the_difference():
    ours = {"anees": 3.5, "nis_mean": 2.0, "rmse_position_m": 0.2, "rmse_yaw_rad": 0.1, "gate_accept_rate": 0.98}
    found = {"runs": 300, "observations": 3000, "anees": 3.0, "nis_mean": 2.25, "gate_accept_rate": 0.99}
    found |= {"mean_square_position": 0.03, "mean_square_yaw": 0.01, "entropy_bits": 9.0, "brier": 1.0}
    errors = {"anees": 0.25, "nis_mean": 0.125, "mean_square_position": 0.005, "mean_square_yaw": 0.1}
    found |= {f"{name}_standard_error": value for name, value in (errors | {"entropy_bits": 1, "brier": 1}).items()}
    apart = benchmark._difference(ours, 100, found)  # a third of the runs: twice the error in all
    binomial = math.sqrt(0.02 * (1 / 1000 + 1 / 3000))
    assert apart == {
        "mean_square_position": pytest.approx(1.0),
        "mean_square_yaw": pytest.approx(0.0, abs=1e-12),
        "anees": pytest.approx(1.0),
        "nis_mean": pytest.approx(-1.0),
        "gate_accept_rate": pytest.approx(-0.01 / binomial),
    }
    assert set(benchmark._difference(ours | {"entropy_bits": 9, "brier": 1}, 100, found)) > {"entropy_bits", "brier"}
    all_in = benchmark._difference(ours | {"gate_accept_rate": 1.0}, 100, found | {"gate_accept_rate": 1.0})
    assert all_in["gate_accept_rate"] == 0


def test_all_devices_over_one(monkeypatch):
    devices = [SimpleNamespace(platform="cpu")] * 4
    monkeypatch.setattr(benchmark.jax, "local_devices", lambda: devices)
    asked = Recorder()

    def study(mapping, seed, some):
        asked(mapping, seed, len(some))
        return lambda runs: SimpleNamespace(run_s=8.0 / len(some) if runs else 0)

    monkeypatch.setattr(benchmark, "_study", study)
    clock = iter(np.cumsum([0, 7, 0, 5] * 3 + [0, 7] * 3).tolist())  # process seconds of each timing
    took = iter([2.0, 5.0] * 3 + [2.0] * 3)
    monkeypatch.setattr(benchmark, "_seconds", lambda work: next(took))
    monkeypatch.setattr(benchmark.time, "process_time", lambda: next(clock))
    monkeypatch.setattr(benchmark, "_probe", probed := Recorder({"run_s": 10.0}))
    monkeypatch.setattr(benchmark.os, "sched_setaffinity", Recorder(), raising=False)
    found = benchmark._devices(SIZE, 7, Recorder())
    assert {args for args, _ in asked.calls} == {(False, 7, 1), (False, 7, 4)}
    assert (found["devices"], found["runs"]) == (4, {1: 20_000, 4: 20_000})
    assert (found["ours"], found["other"], found["ratio"]) == (10_000, 4000, 2.5)
    assert (found["one_core"]["ours"], found["one_core"]["other"], found["one_core"]["ratio"]) == (10_000, 2000, 5)
    assert {args for args, _ in probed.calls} == {("--cores", 1, "--runs", 20_000)}
    assert found["cores_busy"] == {"ours": 3.5, "other": 1.0}
    monkeypatch.setattr(benchmark.jax, "local_devices", lambda: devices[:1])
    assert benchmark._devices(SIZE, 7, ticked := Recorder()) is None
    assert len(ticked.calls) == 1


def test_filters_are_compared_in_each_precision_they_have(monkeypatch):
    """With what is installed; each tells its own facts, and the others' speed is their own."""
    monkeypatch.setattr(peers, "drive", drove := Recorder("drives"))
    monkeypatch.setattr(peers.Peer, "version", lambda peer: None if peer.name == "absent" else "1.0")
    both = peers.Peer("both", "p", "form", None)
    double = peers.Peer("double", "p", "form", None, ("float64",))
    absent = peers.Peer("absent", "p", "form", None)
    monkeypatch.setattr(peers, "PEERS", (both, double, absent))
    speeds = {peers.OURS: 8.0, both: 2.0, double: 4.0}
    prepared = Recorder()

    def ready(peer, drives, precision):
        prepared(peer.name, drives, precision)
        facts = {"anees": 3.0, "runs": len(peer.name)}
        return contextlib.nullcontext(SimpleNamespace(steps_per_s=lambda: speeds[peer], facts=facts))

    monkeypatch.setattr(peers, "ready", ready)
    found = benchmark._filters(SIZE, 7, ticked := Recorder())
    assert drove.calls == [((1000, 1000, 7), {})]
    assert (found["runs"], found["steps"], len(ticked.calls)) == (1000, 1000, 6)
    assert [(f["name"], f["precision"], f.get("steps_per_s"), f.get("ratio")) for f in found["filters"]] == [
        ("jaxlocmap", "float64", 8, None),
        ("both", "float64", 2, 4),
        ("double", "float64", 4, 2),
        ("absent", "float64", None, None),
        ("jaxlocmap", "float32", 8, None),
        ("both", "float32", 2, 4),
        ("absent", "float32", None, None),
    ]
    assert [f.get("runs") for f in found["filters"]] == [9, 4, 6, None, 9, 4, None]
    assert {args[1:] for args, _ in prepared.calls} == {("drives", "float64"), ("drives", "float32")}
    assert found["filters"][1] | {"form": "form", "version": "1.0"} == found["filters"][1]


def test_what_a_user_waits_for(monkeypatch):
    times = {"jaxlocmap": iter([3.0, 4.0, 9.0, 5.0, 6.0]), "jax": iter([1.0, 1.0, 1.0, 4.0, 3.0])}
    monkeypatch.setattr(benchmark, "_import_s", lambda module: next(times[module]))
    given, peaks = [], {20_000: iter([10, 30, 20]), 200_000: iter([20, 33, 80]), 200: iter([1, 1, 1])}
    compiled = {20_000: 1.0, 200_000: 2.0, 200: 7.0}

    def probe(*arguments):
        given.append(arguments)
        return {"compile_s": compiled[arguments[-1]], "peak_bytes": next(peaks[arguments[-1]])}

    monkeypatch.setattr(benchmark, "_probe", probe)
    found = benchmark._costs(SIZE, ticked := Recorder())
    assert given == [("--runs", 20_000), ("--runs", 200_000), ("--map", "--runs", 200)] * 3
    assert len(ticked.calls) == 3
    assert found["import_over_jax_s"] == 3.0  # the median of 2, 3, 8, 1, 3
    assert (found["imports"]["ours"], found["imports"]["other"]) == (5.0, 1.0)
    assert (found["compile_s"], found["compile_s_without_map"]) == (7.0, 1.5)
    assert found["memory"] == {
        "runs": (20_000, 200_000),
        "peak_bytes": [20, 33],
        "ratio": 2.0,
        "ratio_min": 1.1,
        "ratio_max": 4.0,
    }


def test_a_probe_is_a_program_of_its_own(monkeypatch):
    monkeypatch.setattr(benchmark, "_python", asked := Recorder('{"run_s": 2.5}'))
    assert benchmark._probe("--cores", 1) == {"run_s": 2.5}
    program = str(Path(benchmark.__file__).parent / "baselines" / "probe.py")
    assert asked.calls == [((program, "--cores", "1"), {})]


@pytest.mark.parametrize("mapping", [False, True])
def test_the_c_program_is_asked_for_the_study(monkeypatch, mapping):
    monkeypatch.setattr(cpp, "_answer", asked := Recorder({}))
    cpp.study(PROGRAM, 9, mapping=mapping, threads=5, seed=7)
    cpp.profile(PROGRAM, 8)
    flags = ("--map",) if mapping else ()
    assert [args for args, _ in asked.calls] == [
        (PROGRAM, "--runs", "9", "--threads", "5", "--seed", "7", *flags),
        (PROGRAM, "--profile", "--runs", "8"),
    ]


# --- Tables


PAIR = {"ratio": 2.5, "ratio_min": 2.0, "ratio_max": 3.125}
REPORT = {
    "machine": {"cores": 8, "cpu": "CPU", "python": "3.11", "jax": "0.10"},
    "pairs": 3,
    "study": {
        "cpp": {},
        "without_map": {"ours": 12345.6, "other": 6789.1, "difference": {"a": -1.5, "b": 0.5}, **PAIR},
        "with_map": {"ours": 234.5, "other": 123.4, "difference": {"a": 1.0}, **PAIR},
        "course": {"seconds_a_run": 1.256, "ratio": 1234.5},
    },
    "filter": {
        "filters": [
            {"name": "jaxlocmap", "version": None, "precision": "float64", "steps_per_s": 9.87e6}
            | {"diverged_runs": 1, "runs": 8, "anees": 3.004, "nis_mean": 8.126},
            {"name": "dynamax", "version": "1.0", "precision": "float32", "steps_per_s": 4e6}
            | {"diverged_runs": 0, "runs": 8, "anees": 1234.5, "nis_mean": 99.994, "ours": 1e7, "other": 4e6}
            | PAIR,
            {"name": "absent", "version": None, "precision": "float32"},
        ]
    },
    "devices": {"devices": 4, "ours": 1000.4, "other": 400.2, "cores_busy": {"ours": 3.9, "other": 1.256}}
    | PAIR
    | {"one_core": {"ours": 900.0, "other": 300.0, "ratio": 30.0, "ratio_min": 30.0, "ratio_max": 30.0}},
    "cost": {
        "memory": {"runs": (20_000, 200_000), "peak_bytes": [2**20 * 100, 2**20 * 110.4]}
        | {"ratio": 1.1, "ratio_min": 1.0, "ratio_max": 1.25},
        "compile_s": 7.26,
        "imports": {"ours": 1.5, "other": 1.25},
        "import_over_jax_s": 0.256,
    },
}


def test_the_overview_says_what_was_measured():
    assert tables.overview(REPORT).rows == [
        ("study without maps", "12,346 runs/s", "C++ 6,789 runs/s", "2.50 (2.00 to 3.12)"),
        ("study with maps", "234 runs/s", "C++ 123 runs/s", "2.50 (2.00 to 3.12)"),
        ("the same, plain Python on one core", "234 runs/s", "Python 1.26 s a run", "1,234"),
        ("filter alone, float32", "10 M steps/s", "dynamax 4 M steps/s", "2.50 (2.00 to 3.12)"),
        ("4 devices over 1", "1,000 runs/s", "400 runs/s, 1.26 cores", "2.50 (2.00 to 3.12)"),
        ("4 devices over 1 core", "900 runs/s", "300 runs/s", "30"),
        ("peak memory", "200,000 runs: 110 MiB", "20,000 runs: 100 MiB", "1.10 (1.00 to 1.25)"),
        ("compile, default study", "7.3 s", "", ""),
        ("import", "jaxlocmap 1.50 s", "jax 1.25 s", "+0.26 s"),
    ]
    assert tables.overview({"devices": None}).rows == []
    study = REPORT["study"] | {"cpp": None, "with_map": {"ours": 2.0}, "without_map": {"ours": 3.0}}
    assert tables.overview({"study": study}).rows[0] == ("study without maps", "3 runs/s", "no C++ compiler here", "")


def test_filters_have_their_speed_beside_their_consistency():
    assert tables.filters(REPORT).rows == [
        ("jaxlocmap", "64", "9.87", "", "3.00", "8.13", "12.5 %"),
        ("dynamax 1.0", "32", "4", "2.50 (2.00 to 3.12)", "1,234", "99.99", "0 %"),
        ("absent", "32", "not installed", "", "", "", ""),
    ]
    assert tables.filters({}).rows == []
    shown = tables.filters(REPORT).rich()
    assert [list(column.cells)[1] for column in shown.columns] == list(tables.filters(REPORT).rows[1])


@pytest.mark.parametrize(("furthest", "words"), [(-4.9, "agree: at most 4.9"), (-5.0, "DO NOT AGREE"), (5.1, "DO NOT")])
def test_notes_say_whether_both_did_the_same_work(furthest, words):
    study = REPORT["study"] | {"with_map": {"difference": {"a": furthest}}}
    where, same = tables.notes(REPORT | {"study": study})
    assert where == "8 cores of CPU, Python 3.11, JAX 0.10; pairs measured: 3"
    assert words in same
    without = {"machine": REPORT["machine"], "pairs": 3}
    assert tables.notes(without) == [where]
    nothing = {name: {} for name in ("without_map", "with_map")}
    assert tables.notes(without | {"study": nothing}) == [where]


@pytest.mark.parametrize(
    ("ratio", "text"), [((19.994, 18.0, 21.0), "19.99 (18.00 to 21.00)"), ((20.0, 18.0, 21.0), "20 (18 to 21)")]
)
def test_large_ratios_need_no_digits(ratio, text):
    assert tables._ratio(dict(zip(("ratio", "ratio_min", "ratio_max"), ratio, strict=True))) == text


# --- The course's program and the peers' model, in pieces


def test_the_course_s_filter_is_the_reference(x64):
    """With numbers that leave no term small; what the gate refuses changes nothing."""
    settings = course.Settings(q_v=0.3, q_w=0.2)
    robot = course.Localizer(settings)
    mean, cov = robot.mean.copy(), robot.cov.copy()
    Q, R = np.diag([0.3, 0.2]) ** 2, np.diag([0.15, 0.03]) ** 2
    for v, w in ((0.5, 0.8), (0.4, 0.0), (-0.3, -1.0)):
        robot.predict(v, w)
        mean, cov = reference.predict(mean, cov, np.array([v, w]), 0.1, Q, reference.capstone, 0.1)
        np.testing.assert_allclose(robot.mean, mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(robot.cov, cov, rtol=0, atol=1e-12)
    landmark = (2.0, 10.0)
    for share, refused in ((0.9, False), (1.1, True), (0.5, False)):  # of the squared distance that the gate lets in
        expected = reference.expected_observation(mean, np.array(landmark))[0]
        S = reference.correct(mean, cov, expected, np.array(landmark), R, None)[3]
        z = expected + np.linalg.cholesky(S) @ np.sqrt([share * 9.21, 0])
        kept = robot.mean.copy()
        robot.correct(*z, landmark)
        mean, cov, *_ = reference.correct(mean, cov, np.array(z), np.array(landmark), R, 9.21)
        assert np.array_equal(robot.mean, kept) == refused
        np.testing.assert_allclose(robot.mean, mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(robot.cov, cov, rtol=0, atol=1e-12)


def test_the_course_s_grid_and_beams():
    settings = course.Settings(cells=10, resolution=1.0, max_range=4.0, l_occ=3.0)
    grid = course.Grid(settings)
    angles = np.array([0.0, np.pi / 2])
    pose = np.array([1.5, 2.5, 0.0])
    grid.add(pose, np.array([3.0, 9.0]), angles)
    expected = np.zeros((10, 10))
    expected[2, 1:4] += -0.4  # the robot's own cell and on to the right
    expected[2, 4] = 3.0
    expected[2:6, 1] += -0.4  # upwards, no return: cleared up to the limit, nothing marked
    np.testing.assert_allclose(grid.log_odds, expected, rtol=0, atol=1e-12)
    grid.add(pose, np.array([3.0, 0.05]), angles)
    assert grid.log_odds[2, 4] == 4.0  # clamped
    assert grid.log_odds[3, 1] == pytest.approx(-0.4)  # too near is no measurement
    assert grid.log_odds[2, 1] == pytest.approx(-1.2)
    before = grid.log_odds.copy()
    grid.add(pose, np.array([3.0]), np.array([np.pi]))  # ends outside
    grid.add(np.array([-3.0, 2.5, 0.0]), np.array([2.0]), angles[:1])  # starts outside
    np.testing.assert_array_equal(grid.log_odds, before)
    room = dataclasses.replace(settings, walls=[(3.0, 0.0, 3.0, 9.0), (2.0, 5.0, 0.0, 5.0), (2.0, 3.0, 4.0, 3.0)])
    still = SimpleNamespace(normal=lambda mean, std: 0.0)
    np.testing.assert_allclose(course.scan(pose, angles, room, still), [1.5, 2.5], rtol=0, atol=1e-12)
    assert course.scan(pose, np.array([np.pi]), room, still) == 4.0  # none behind: the limit
    near = SimpleNamespace(normal=lambda mean, std: -9.0)
    assert course.scan(pose, angles[:1], room, near) == 0.05
    for ends in ((0, 0, 7, 3), (5, 2, 1, 9), (4, 4, 4, 4), (0, 5, 6, 5)):
        assert course.bresenham(*ends) == [tuple(cell) for cell in reference.bresenham(*ends)]


def test_the_peers_model_has_the_derivatives_it_says(x64):
    rng = np.random.default_rng(0)
    poses = np.stack([rng.uniform(3, 8, 5), rng.uniform(3, 8, 5), rng.uniform(-3, 3, 5)], axis=1)
    step = 1e-6 * np.eye(3)

    def slopes(f):
        return np.stack([(f(poses + d) - f(poses - d)) / 2e-6 for d in step], axis=-1)

    np.testing.assert_allclose(peers._move_jacobian(poses), slopes(peers._moved), rtol=0, atol=1e-7)
    np.testing.assert_allclose(peers._see_jacobian(poses), slopes(peers._seen), rtol=0, atol=1e-7)
    for pose in poses:
        np.testing.assert_allclose(peers._moved(pose), reference.euler(pose, (0.3, 0.1), 0.1)[0], rtol=0, atol=1e-12)
        np.testing.assert_allclose(peers._transition(pose), peers._moved(pose), rtol=0, atol=1e-6)
        np.testing.assert_allclose(peers._expected(pose), peers._seen(pose), rtol=0, atol=1e-5)
        turned = peers._seen(pose) + np.tile([0.0, 2 * np.pi], 4)
        np.testing.assert_allclose(peers._expected_near(pose, turned), turned, rtol=0, atol=1e-5)
        np.testing.assert_allclose(peers._kalman_py_residual(turned, peers._seen(pose)), 0, rtol=0, atol=1e-5)
        np.testing.assert_allclose(peers._residual(turned, peers._seen(pose)), 0, rtol=0, atol=1e-9)
    mean, cov = peers._first_predicted()
    F = peers._move_jacobian(peers.PRIOR_MEAN)
    np.testing.assert_allclose(cov, F @ np.diag([0.04, 0.04, 0.01]) @ F.T + peers.Q, rtol=1e-12)
    np.testing.assert_allclose(mean, peers._moved(peers.PRIOR_MEAN), rtol=1e-12)


def test_our_filter_among_the_peers_believes_what_the_model_says(x64):
    del x64
    runs, steps = jax.local_device_count(), 3
    z = peers.drive(runs, steps, 1).z
    mean, cov = map(np.asarray, peers._jaxlocmap(z)())
    assert mean.shape == (runs, steps, 3)
    for i in range(runs):
        x, P = peers.PRIOR_MEAN, np.diag(peers.PRIOR_STD**2)
        for k in range(steps):
            F = peers._move_jacobian(x)
            x, P = peers._moved(x), F @ P @ F.T + peers.Q
            for j in range(4):  # one landmark after the other
                rows = slice(2 * j, 2 * j + 2)
                H, R = peers._see_jacobian(x)[rows], peers.R[rows, rows]
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x = x + K @ peers._residual(z[i, k, rows].copy(), peers._seen(x)[rows])
                P = P - K @ H @ P
            np.testing.assert_allclose(cov[i, k], P, rtol=1e-6, atol=1e-10)
            away = mean[i, k] - x
            np.testing.assert_allclose([*away[:2], np.sin(away[2])], 0, rtol=0, atol=1e-8)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux has it")
def test_a_peak_of_memory_is_what_was_held_at_most():
    held = np.ones(2**25)  # 256 MiB
    del held
    now = int(next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmRSS" in line).split()[1])
    assert probe.peak_bytes() > 1024 * now + 2**27


def test_drives_of_the_peers_start_where_the_prior_says_and_turn_as_the_noise_says():
    drives = peers.drive(4000, 3, 5)
    turned = drives.truth[:, 1:] - peers._moved(drives.truth[:, :-1])
    np.testing.assert_allclose(turned[..., :2], 0, rtol=0, atol=1e-12)
    assert np.std(turned[..., 2]) == pytest.approx(0.05 * 0.1, rel=0.05)
    first = drives.truth[:, 0] - peers._moved(peers.PRIOR_MEAN)
    # A start turned by 0.1 rad moves the end of a step of 3 cm by no more than 3 mm.
    np.testing.assert_allclose(first.std(0), [0.2, 0.2, math.hypot(0.1, 0.005)], rtol=0.05)
    np.testing.assert_allclose(first.mean(0), 0, rtol=0, atol=0.02)
    assert not np.array_equal(peers.drive(4000, 3, 6).z, drives.z)


@pytest.mark.parametrize(("share", "runs"), [(1, 40), (5, 8), (1000, jax.local_device_count())])
def test_a_filter_is_timed_over_all_steps_of_its_runs(monkeypatch, share, runs):
    clock = iter([0.0, 3.0, 10.0, 14.0])
    monkeypatch.setattr(peers.time, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(peers, "score", scored := Recorder({"anees": 3.0}))
    drives = peers.Drives(None, np.zeros((40, 25, 8)))
    prepared = Recorder()
    peer = peers.Peer(
        "p", "p", "form", lambda z: prepared(z.shape, z.dtype) or (lambda: ("means", "covs")), share=share
    )
    with peers.ready(peer, drives, "float32") as ready:
        assert ready.facts == {"runs": runs, "steps": 25, "prepare_s": 3.0, "anees": 3.0}
        assert ready.steps_per_s() == runs * 25 / 4
    assert prepared.calls == [(((runs, 25, 8), np.dtype("float32")), {})]
    assert scored.calls == [((drives, "means", "covs"), {})]
