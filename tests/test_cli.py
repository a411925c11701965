"""What all programs share: options handed on, numbers of a report, rows of a table, the README's marks."""

import dataclasses
import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from programs import Recorder

from jaxlocmap import Params
from jaxlocmap.cli import command, compute, console, options
from jaxlocmap.cli import rows as rows_of

sys.path.append(str(Path(__file__).parent.parent / "experiments"))
import evidence


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the program does."""

    runs: int = 2
    """How many."""


@pytest.fixture
def hosts(monkeypatch):
    stub = SimpleNamespace(merge_kernels=Recorder(), join=Recorder(), use_all_cores=Recorder(1))
    monkeypatch.setattr(compute, "hosts", stub)
    return stub


@pytest.mark.parametrize(
    ("given", "joined"),
    [
        ({}, []),
        ({"distributed": True}, [(None, None, None)]),
        ({"coordinator": "a:1", "processes": 3, "process_id": 2}, [("a:1", 3, 2)]),
        ({"process_id": 0}, [(None, None, 0)]),
    ],
)
def test_a_program_joins_the_others_where_it_is_told_to(hosts, given, joined):
    compute.start(compute.ComputeConfig(**given, devices=5))
    assert [args for args, _ in hosts.join.calls] == joined
    assert hosts.use_all_cores.calls == [((5,), {})]
    assert len(hosts.merge_kernels.calls) == 1


def test_a_study_gets_every_option_of_the_computing(monkeypatch, tmp_path):
    parts, ran = Recorder(SimpleNamespace(runs_kept=0)), Recorder("result")
    monkeypatch.setattr(compute, "Checkpoint", parts)
    monkeypatch.setattr(compute, "monte_carlo", ran)
    monkeypatch.setattr(compute.jax, "local_devices", lambda: ["a", "b", "c"])
    for resume, discard in ((True, False), (False, True)):
        config = compute.ComputeConfig(chunk=7, devices=2, resume=resume, discard=discard)
        kept = compute.study_checkpoint(tmp_path, config, {"seed": 3})
        args, how = parts.calls[-1]
        assert (args, how["resume"], how["discard"]) == ((tmp_path, {"seed": 3}), resume, discard)
    assert compute.study("one run", "key", 11, "params", "world", config=config, checkpoint=kept) == "result"
    ((args, how),) = ran.calls
    assert args == ("one run", "key", 11, "params", "world")
    assert (how["chunk"], how["devices"], how["checkpoint"]) == (7, ["a", "b"], kept)


def test_a_speed_counts_the_runs_of_this_time_alone(monkeypatch):
    monkeypatch.setattr(compute.time, "perf_counter", lambda: 107.0)
    result = SimpleNamespace(chunk=4, devices=2, processes=3, resumed_runs=40, compile_s=1.5, run_s=2.0)
    assert compute.how_computed(result, 100, 100.0, per_run=9) == {
        "chunk": 4,
        "devices": 2,
        "processes": 3,
        "resumed_runs": 40,
        "wall_s": 7.0,
        "compile_s": 1.5,
        "runs_per_s": 60 * 9 / 2.0,
    }
    assert compute.how_computed(result, 100, 100.0)["runs_per_s"] == 30


def test_parts_are_cleared_in_turn(monkeypatch):
    cleared = Recorder()
    monkeypatch.setattr(compute, "hosts", SimpleNamespace(in_turn=lambda work: work()))
    compute.finish(SimpleNamespace(clear=cleared))
    assert len(cleared.calls) == 1


def test_parameters_are_those_of_the_file_if_one_is_named(tmp_path):
    given, default = (
        Params.from_std(v=0.1, w=0.2, range=0.3, bearing=0.4),
        Params.from_std(v=1, w=1, range=1, bearing=1),
    )
    given.save(tmp_path / "a.json")
    assert options.params_or(None, default) is default
    np.testing.assert_allclose(options.params_or(tmp_path / "a.json", default).R, given.R, rtol=1e-6)


@pytest.mark.parametrize(("gate", "good"), [(None, True), (0.5, True), (1e-9, True), (0.0, False), (1.0, False)])
def test_a_gate_is_a_probability(gate, good):
    if good:
        options.check_gate(gate, "judge_gate")
    else:
        with pytest.raises(ValueError, match=r"judge_gate: expected a probability inside \(0, 1\)"):
            options.check_gate(gate, "judge_gate")


def test_a_report_holds_plain_numbers(tmp_path):
    console.write_report(
        tmp_path,
        {
            "nested": {"array": np.array([[1.5, math.nan], [math.inf, -2.0]]), "tuple": (1, -math.inf)},
            "float32": np.float32(0.25),
            "int32": np.int32(7),
            "words": "x",
            "flag": True,
            "none": None,
        },
    )
    assert json.loads((tmp_path / "report.json").read_text()) == {
        "nested": {"array": [[1.5, None], [None, -2.0]], "tuple": [1, None]},
        "float32": 0.25,
        "int32": 7,
        "words": "x",
        "flag": True,
        "none": None,
    }


@pytest.mark.parametrize(("expected", "columns"), [(("", ""), 2), (("", "3"), 3)])
def test_a_table_has_a_third_column_where_any_row_says_what_is_expected(monkeypatch, expected, columns):
    tables = Recorder()
    monkeypatch.setattr(console.CONSOLE, "print", tables)
    console.show("title", [("a", "1", expected[0]), ("b", "2", expected[1])])
    (((table,), _),) = tables.calls
    cells = [list(column.cells) for column in table.columns]
    assert (table.title, cells) == ("title", [["a", "b"], ["1", "2"], list(expected)][:columns])


def test_what_was_not_dropped_gets_no_row():
    rows = console.count_rows({"bad_ranges": 3, "no_return": 0, "gap_seconds": 1.5})
    assert rows == [
        ("dropped or mended in the log: bad ranges", "3", ""),
        ("dropped or mended in the log: gap seconds", "1.5", ""),
    ]


def test_a_table_takes_the_place_of_the_one_between_its_marks(monkeypatch, tmp_path):
    pages = tmp_path / "a.md", tmp_path / "b.md"
    text = "a\n<!-- table: x -->\nold\n<!-- end: x -->\nb\n<!-- table: y -->\nkept\n<!-- end: y -->\nc\n"
    pages[0].write_text("nothing here\n")
    pages[1].write_text(text)
    monkeypatch.setattr(evidence, "_PAGES", pages)
    evidence.replace_table("x", "new\nlines")
    assert pages[1].read_text() == text.replace("old", "new\nlines")
    assert pages[0].read_text() == "nothing here\n"
    with pytest.raises(ValueError, match="expected the marks <!-- table: z --> and <!-- end: z -->"):
        evidence.replace_table("z", "new")


@pytest.mark.parametrize(
    ("raised", "status", "said"),
    [
        (ValueError("runs: no"), 1, "error: runs: no"),
        (OSError("disk"), 1, "error: disk"),
        (KeyboardInterrupt("some runs are kept"), 130, "stopped; some runs are kept"),
        (KeyboardInterrupt(), 130, "stopped"),
    ],
)
def test_a_program_ends_with_one_line_and_its_status(monkeypatch, raised, status, said):
    left = Recorder()
    monkeypatch.setattr(command, "_leave", left)
    monkeypatch.setattr(sys, "argv", ["program", "--no-cache", "--runs", "3"])

    def main(config: Settings):
        assert config == Settings(runs=3)
        raise raised

    command.command_line(main)
    assert left.calls == [((status, said), {})]


def test_a_stopped_study_says_what_is_kept_and_how_to_go_on(monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(compute, "monte_carlo", stopped)
    monkeypatch.setattr(sys, "orig_argv", ["python", "a b.py", "--runs", "9"])
    monkeypatch.setattr(sys, "argv", ["a b.py", "--runs", "9"])
    parts = SimpleNamespace(runs_kept=1200, folder="out/parts")
    with pytest.raises(KeyboardInterrupt) as told:
        compute.study("run", "key", 9000, config=compute.ComputeConfig(), checkpoint=parts)
    assert told.value.args == (
        "1,200 of 9,000 runs are kept in out/parts; go on with\npython 'a b.py' --runs 9 --resume",
    )


# --- Rows of the reports on consistency


REPORT = {
    "anees": 3.25,
    "anees_band_95": (2.5, 3.5),
    **{f"coverage_{p}": p / 100 - 0.1 for p in (50, 90, 95, 99)},
    **{f"coverage_{p}_interval_95": (p / 100 - 0.125, p / 100) for p in (50, 90, 95, 99)},
    "axis_nees": {"x": 1.1, "y": 0.9, "yaw": 2.0},
    "axis_nees_interval_95": {"x": (1.0, 1.2), "y": (0.8, 1.0), "yaw": (1.5, 2.5)},
    "within_two_sigma": {"x": 0.9, "y": 0.91, "yaw": 0.92},
    "within_two_sigma_interval_95": {"x": (0.8, 0.95), "y": (0.85, 0.96), "yaw": (0.875, 0.97)},
    "rmse_position_m": 0.0123,
    "rmse_yaw_rad": 0.0045,
    "diverged_runs": 6,
    "nis_mean": 2.125,
    "nis_band_95": (1.75, 2.25),
    "innovation_lag_one": {"range": 0.03125, "bearing": -0.5},
    "innovation_lag_one_band_95": {"range": 0.25, "bearing": 0.125},
    "gate_accept_rate": 0.98765,
    "longest_rejection": 12,
    "verdict": "so so",
}


def test_rows_of_the_pose():
    rows = rows_of.pose_rows(REPORT)
    assert rows == [
        ("ANEES (3 degrees)", "3.25", "[2.5, 3.5]"),
        *((f"{p} % ellipsoid holds", f"{p - 10:.1f} % [{p - 12.5:.4g}, {p}]", f"{p} %") for p in (50, 90, 95, 99)),
        ("x alone: error² over σ²", "1.1 [1, 1.2]", "1"),
        ("y alone: error² over σ²", "0.9 [0.8, 1]", "1"),
        ("yaw alone: error² over σ²", "2 [1.5, 2.5]", "1"),
        ("x within ±2σ", "90 % [80, 95]", "95.4 %"),
        ("y within ±2σ", "91 % [85, 96]", "95.4 %"),
        ("yaw within ±2σ", "92 % [87.5, 97]", "95.4 %"),
        ("position RMSE", "0.0123 m", ""),
        ("yaw RMSE", "0.0045 rad", ""),
        ("diverged runs", "6", "0"),
    ]


@pytest.mark.parametrize(
    ("gate", "white", "share"), [(None, "0", "100 %"), (0.99, "not 0 behind a gate", "99 %")], ids=["no gate", "gate"]
)
def test_rows_of_the_innovations(gate, white, share):
    rows = rows_of.innovation_rows(REPORT | ({} if gate is None else {"gate_nominal_rate": gate}))
    assert rows == [
        ("NIS (2 degrees)", "2.125", "[1.75, 2.25]"),
        ("innovation lag one, range", "+0.0312 ± 0.2500", white),
        ("innovation lag one, bearing", "-0.5000 ± 0.1250", white),
        ("gate lets in", "98.765 %", share),
        ("longest streak refused", "12 observations", ""),
    ]
    assert rows_of.innovation_rows(REPORT | {"nis_degrees": 3})[0][0] == "NIS (3 degrees)"


def test_verdicts_are_printed_the_gate_s_where_there_is_one(monkeypatch):
    printed = Recorder()
    monkeypatch.setattr(rows_of.CONSOLE, "print", printed)
    rows_of.print_verdicts(REPORT)
    rows_of.print_verdicts(REPORT | {"gate_verdict": "locked"})
    assert [args for args, _ in printed.calls] == [("so so",), ("so so",), ("locked",)]


def test_the_bar_is_moved_to_what_is_done(monkeypatch):
    moved = Recorder()
    monkeypatch.setattr(console.Progress, "update", moved)
    with console.progress_bar("x", 9) as move:
        moved.calls.clear()
        move(4)
    assert moved.calls[0][1]["completed"] == 4


def test_other_processes_are_silent(hosts, monkeypatch):
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    compute.start(compute.ComputeConfig())
    assert console.CONSOLE.quiet
    monkeypatch.setattr(jax, "process_index", lambda: 0)
    compute.start(compute.ComputeConfig())
    assert not console.CONSOLE.quiet
