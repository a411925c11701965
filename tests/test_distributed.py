"""Several processes on the loopback interface share a study, and say what is wrong when they cannot meet."""

import os
import re
import signal
import socket
import time

import jax
import numpy as np
import pytest
from programs import WALKS, ended, free_port, is_free, report, result, start

from jaxlocmap.monte_carlo import hosts

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """What the study gives in one process, on one device, and what it says last."""
    out = tmp_path_factory.mktemp("alone")
    status, said, err = ended(start(WALKS, "--chunk", 7, "--devices", 1, "--out", out))
    assert status == 0, err
    assert report(out)["devices"] == report(out)["processes"] == 1
    assert not (out / "parts").exists()
    return result(out), re.search(r"total .*\n", said)[0]


def meeting(port, process):
    return "--coordinator", f"127.0.0.1:{port}", "--processes", 2, "--process-id", process


# --- A study shared ---


def test_two_processes_give_what_one_gives_to_the_last_bit(alone, tmp_path):
    # Machines differ: one has a device, the other all cores.
    port, out = free_port(), [tmp_path / "0", tmp_path / "1"]
    both = [
        start(WALKS, "--chunk", 7, *meeting(port, 0), "--out", out[0]),
        start(WALKS, "--chunk", 7, *meeting(port, 1), "--devices", 1, "--out", out[1]),
    ]
    (status, said, err), (status_1, said_1, err_1) = map(ended, both)
    assert (status, status_1) == (0, 0), err + err_1
    assert result(out[0]) == alone[0]
    assert report(out[0])["processes"] == 2
    assert report(out[0])["devices"] == int(re.search(r"computing on (\d+)", said)[1]) + 1
    assert "in each of 2 processes" in said
    # The other process has the same result, and neither says nor writes a thing.
    assert said_1 == alone[1]
    assert alone[1] in said
    assert not (out[1] / "report.json").exists()
    assert not any((folder / "parts").exists() for folder in out)


def test_processes_found_by_slurm_die_and_one_alone_goes_on(alone, tmp_path):
    # JAX takes the port from the number of the job.
    job = next(job for job in range(os.getpid(), os.getpid() + 4096) if is_free(job % 4096 + 61440))
    slurm = {"SLURM_JOB_ID": str(job), "SLURM_STEP_NODELIST": "127.0.0.1", "SLURM_NTASKS": "2"}
    both = [
        start(
            WALKS,
            *("--chunk", 7, "--distributed", "--devices", 1, "--out", tmp_path),
            **slurm,
            SLURM_PROCID=str(process),
            SLURM_LOCALID=str(process),
            DIE_AT="200",
            DIE_BY=str(int(signal.SIGKILL)),
        )
        for process in (0, 1)
    ]
    assert {ended(process)[0] for process in both} <= {-signal.SIGKILL, -signal.SIGABRT}
    kept = len(list((tmp_path / "parts").glob("part-???")))
    assert 20 <= kept <= 40  # of 43
    status, said, err = ended(start(WALKS, "--resume", "--out", tmp_path))
    assert status == 0, err
    assert result(tmp_path) == alone[0]
    assert report(tmp_path)["resumed_runs"] == 7 * kept
    assert f"going on: {7 * kept} of 300 runs are done" in said


def test_processes_with_different_settings_refuse_each_other(tmp_path):
    port = free_port()
    both = [start(WALKS, *meeting(port, i), "--seed", i, "--out", tmp_path / str(i)) for i in (0, 1)]
    for status, _, err in map(ended, both):
        assert status == 1
        assert "error: processes: expected the same study in all, process 1 has another" in err


# --- Those who do not meet ---

JOIN = """
from __future__ import annotations

import dataclasses

import tyro

from jaxlocmap.cli.command import command_line
from jaxlocmap.monte_carlo import hosts


@dataclasses.dataclass(frozen=True)
class Meeting:
    port: tyro.conf.Positional[int]
    process: tyro.conf.Positional[int]


def main(config: Meeting):
    hosts.join(f"127.0.0.1:{config.port}", 2, config.process, timeout=2)


command_line(main)
"""


def test_a_coordinator_that_cannot_be_reached_and_a_process_that_is_missing_are_errors_in_time(tmp_path):
    (tmp_path / "join.py").write_text(JOIN)
    nobody, somebody, taken = free_port(), free_port(), socket.create_server(("", 0))
    occupied = taken.getsockname()[1]
    expected = [
        ((nobody, 1), f"coordinator: expected one that answers at 127.0.0.1:{nobody} within 2 s, got: "),
        ((somebody, 0), f"processes: expected 2 to meet at 127.0.0.1:{somebody} within 2 s, some did not come"),
        ((occupied, 0), f"coordinator: expected a free port to listen at, got {occupied}: "),
    ]
    processes = [start(tmp_path / "join.py", *arguments) for arguments, _ in expected]
    began = time.monotonic()
    for process, (_, message) in zip(processes, expected, strict=True):
        status, _, err = ended(process)
        assert status == 1  # no abort
        assert err.startswith(f"error: {message}")
        assert len(err.splitlines()) == 1
    taken.close()
    assert time.monotonic() - began < 30


def test_without_a_cluster_what_is_missing_is_named(tmp_path):
    status, _, err = ended(start(WALKS, "--distributed", "--out", tmp_path))
    assert status == 1
    assert err == (
        "error: coordinator, processes, process_id: expected to be given, or to be found in a cluster "
        "(Slurm, Kubernetes, Open MPI); got neither\n"
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("here", 2, 0), "coordinator: expected host:port, got 'here'"),
        ((":80", 2, 0), "coordinator: expected host:port, got ':80'"),
        (("here:0", 2, 0), "coordinator: expected host:port, got 'here:0'"),
        (("here:70000", 2, 0), "coordinator: expected host:port, got 'here:70000'"),
        (("here:80", 0, 0), "processes: expected at least 1, a whole number, got 0"),
        (("here:80", 2, 2), "process_id: expected at most 1, got 2"),
        (("here:80", 2, -1), "process_id: expected at least 0, a whole number, got -1"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anybody_is_waited_for(arguments, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        hosts.join(*arguments)


# --- Alone ---


@pytest.mark.parametrize("value", [np.array(1.5), np.arange(6.0).reshape(2, 3), np.zeros((0, 2)), np.array([7])])
def test_alone_one_gathers_one_s_own(value):
    np.testing.assert_array_equal(hosts.gather(value), value[None], strict=True)
    assert jax.process_count() == 1


def test_alone_errors_of_a_turn_are_one_s_own():
    assert hosts.in_turn(lambda: 5) == 5
    with pytest.raises(KeyError):
        hosts.in_turn(lambda: {}[1])


def test_waiting_ends_in_time_and_hands_on_what_happened():
    assert hosts.waiting(lambda: 5) == 5
    with pytest.raises(KeyError):
        hosts.waiting(lambda: {}[1])
    with pytest.raises(TimeoutError):
        hosts.waiting(lambda: time.sleep(2), 0.01)
