"""A study that is killed or stopped goes on to the report it would have written."""

import os
import shlex
import signal
import subprocess
import time

import pytest
from programs import ON_CPU, ROOT, WALKS, ended, report, result, start

from jaxlocmap.cli import compute

pytestmark = pytest.mark.slow
# Without a gate and from a drawn start, which needs no reference.
STUDY = ("--no-map", "--gate", "None", "--start", "drawn", "--runs", 1000, "--chunk", 1, "--steps", 30)
# One study after the other in one process: what the first has traced and compiled the second has.
STUDIES = """
import sys

from jaxlocmap.__main__ import main

_, study, *folders = sys.argv
for out in folders:
    sys.argv = ["jaxlocmap", "study", *study.split(), "--out", out]
    main()
"""


def test_a_killed_study_goes_on_to_the_report_of_an_uninterrupted_one(tmp_path):
    study, parts = " ".join(map(str, STUDY)), tmp_path / "killed" / "parts"
    (tmp_path / "studies.py").write_text(STUDIES)
    killed = start(tmp_path / "studies.py", study, tmp_path / "whole", tmp_path / "killed")
    while killed.poll() is None and len(list(parts.glob("part-???"))) < 0.7 * 256:
        time.sleep(0.002)
    killed.send_signal(signal.SIGKILL)
    status, _, err = ended(killed)
    assert status == -signal.SIGKILL, err
    whole = report(tmp_path / "whole")
    assert whole["resumed_runs"] == 0
    kept = sorted(parts.glob("part-???"))
    assert 0.7 * 256 <= len(kept) < 256
    os.truncate(kept[100], 99)

    status, said, err = ended(start("-m", "jaxlocmap", "study", *STUDY, "--resume", "--out", tmp_path / "killed"))
    assert status == 0, err
    assert f"part {int(kept[100].name[5:])} in {parts} is damaged" in said
    resumed = report(tmp_path / "killed")
    assert 3 * (len(kept) - 1) <= resumed["resumed_runs"] <= 4 * (len(kept) - 1)  # 3 or 4 chunks, of a run, a part
    assert list(resumed) == list(whole)
    assert resumed["devices"] == whole["devices"]
    assert result(tmp_path / "killed") == result(tmp_path / "whole")
    assert not parts.exists()


def test_ctrl_c_stops_at_the_next_turn_and_says_how_to_go_on(tmp_path):
    study = (WALKS, "--chunk", 7, "--devices", 1)
    assert ended(start(*study, "--out", tmp_path / "whole"))[0] == 0
    stopped = start(*study, "--out", tmp_path / "stopped", DIE_AT="200", DIE_BY=str(int(signal.SIGINT)))
    status, said, err = ended(stopped)
    assert status == 130
    assert "stopping after this turn" in said
    told, command = err.splitlines()
    assert told == f"stopped; 203 of 300 runs are kept in {tmp_path}/stopped/parts; go on with"
    assert command.endswith(f"walks.py --chunk 7 --devices 1 --out {tmp_path}/stopped --resume")
    assert not (tmp_path / "stopped" / "report.json").exists()
    # Not to go on with other settings.
    status, _, err = ended(start(*study, "--seed", 1, "--resume", "--out", tmp_path / "stopped"))
    assert status == 1
    belongs = (
        f"error: resume: expected the study that {tmp_path}/stopped/parts belongs to, got another: seed was 0, is 1;"
    )
    assert err.startswith(belongs)
    # The command itself, on all devices.
    again = shlex.split(command.replace("--devices 1", ""))
    environment = {**ON_CPU, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(again, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "going on: 203 of 300 runs are done" in done.stdout
    assert report(tmp_path / "stopped")["resumed_runs"] == 203
    assert result(tmp_path / "stopped") == result(tmp_path / "whole")


def test_a_new_start_loses_nothing_unless_told_to(tmp_path):
    study = (WALKS, "--chunk", 7, "--devices", 1, "--out", tmp_path)
    assert ended(start(*study, DIE_AT="200", DIE_BY=str(int(signal.SIGKILL))))[0] == -signal.SIGKILL
    status, _, err = ended(start(*study))
    refused = f"error: parts: expected resume or discard, since {tmp_path}/parts holds 203 finished runs of this study"
    assert (status, err.strip()) == (1, refused)
    status, said, err = ended(start(*study, "--discard"))
    assert status == 0, err
    assert f"discarding 203 finished runs in {tmp_path}/parts" in said
    assert report(tmp_path)["resumed_runs"] == 0


def test_a_second_ctrl_c_stops_at_once():
    before, done = signal.default_int_handler, []
    at_first = signal.signal(signal.SIGINT, before)  # a job in the background ignores it
    with compute._stopped_by_ctrl_c(done.append) as progress:
        progress(1)
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            progress(2)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert done == [1, 2]
    assert signal.signal(signal.SIGINT, at_first) == before


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--runs", 0), "runs: expected at least 1, a whole number, got 0"),
        (("--chunk", 0), "chunk: expected at least 1, a whole number, got 0"),
        (("--devices", 5000), "devices: expected at most "),
        (("--runs", 2 * 10**9, "--chunk", 10**9), "chunk: expected one that fits into the memory, got 1000000000 runs"),
    ],
)
def test_what_cannot_be_computed_is_one_clear_line(tmp_path, arguments, expected):
    status, _, err = ended(start(WALKS, *arguments, "--out", tmp_path))
    assert status == 1
    assert err.startswith(f"error: {expected}")
    assert len(err.splitlines()) == 1
