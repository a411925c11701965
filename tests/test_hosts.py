"""What a process asks of the others and of JAX, with the others played by hand: no process is started."""

import re
import socket
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import free_port

from jaxlocmap.monte_carlo import hosts
from jaxlocmap.monte_carlo.checkpoint import Checkpoint
from jaxlocmap.monte_carlo.run import _exchange, monte_carlo


@pytest.mark.parametrize(
    ("user", "expected"),
    [
        (None, hosts._MERGED),
        ("", hosts._MERGED),
        ("--xla_a=1 --xla_b", f"--xla_a=1 --xla_b {hosts._MERGED}"),
        ("--xla_backend_extra_options=other", "--xla_backend_extra_options=other"),
    ],
)
def test_the_user_s_flags_stay(monkeypatch, user, expected):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if user is not None:
        monkeypatch.setenv("XLA_FLAGS", user)
    for _ in range(2):
        hosts.merge_kernels()
        assert hosts.os.environ["XLA_FLAGS"] == expected


def played(monkeypatch, gathered, *, process=0, processes=2):
    """A process of several: `gathered(value)` is what all of them said. Returns what this one said, in turn."""
    said = []

    def gather(value):
        said.append(value.copy())
        return np.asarray(gathered(value), value.dtype)

    monkeypatch.setattr(hosts, "gather", gather)
    monkeypatch.setattr(jax, "process_index", lambda: process)
    monkeypatch.setattr(jax, "process_count", lambda: processes)
    return said


@pytest.mark.parametrize("process", [0, 1, 2])
def test_processes_take_their_turns_one_after_the_other(monkeypatch, process):
    done = []
    said = played(monkeypatch, lambda _: [0, 0, 0], process=process, processes=3)
    assert hosts.in_turn(lambda: done.append(len(said)) or "mine") == "mine"
    assert done == [process]  # after so many turns of others
    assert [int(failed) for failed in said] == [0, 0, 0]


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_what_fails_in_another_process_ends_this_one_in_that_turn(monkeypatch, failing):
    said = played(monkeypatch, lambda value: [value, int(len(said) == failing + 1), 0], process=0, processes=3)
    with pytest.raises(ConnectionError, match=f"^processes: expected all to go on, process {failing} did not; it says"):
        hosts.in_turn(lambda: 5)
    assert len(said) == failing + 1


def test_what_fails_here_is_told_to_the_others_and_raised(monkeypatch):
    said = played(monkeypatch, lambda value: [0, value], process=1)
    with pytest.raises(ZeroDivisionError):
        hosts.in_turn(lambda: 1 // 0)
    assert [int(failed) for failed in said] == [0, 1]


def test_a_study_counts_the_devices_and_resumed_runs_of_all_processes(monkeypatch, tmp_path):
    """The other has three devices and has done seven runs; the chunk is the smallest that a process takes."""

    def gathered(value):
        if value.dtype == np.int64 and value.ndim == 0:  # runs that were done before
            return [value, 7]
        if value.shape == (2,):  # devices, and the chunk that is asked for
            return [value, [3, value[1]]]
        return [value, 4] if value.ndim == 0 and value.dtype == np.int32 and value > 1 else [value, value]

    def one_run(key):
        return jax.random.uniform(key, ())

    def study(**kwargs):
        return monte_carlo(one_run, jax.random.key(0), 10, devices=jax.local_devices()[:1], **kwargs)

    whole = study(chunk=4)
    assert (whole.devices, whole.resumed_runs, whole.chunk) == (1, 0, 4)
    played(monkeypatch, gathered, processes=1)
    kept = Checkpoint(tmp_path)
    result = study(checkpoint=kept)
    assert (result.devices, result.resumed_runs, result.chunk) == (4, 7, 3)  # ten runs on four devices
    again = study(checkpoint=Checkpoint(tmp_path, resume=True))
    assert (again.resumed_runs, again.chunk) == (17, 3)
    assert again.value == result.value
    assert study(chunk=4).chunk == 4


def test_a_process_with_another_study_is_named(monkeypatch):
    played(monkeypatch, lambda value: [value, value, value + 1 if value.dtype == np.int64 else value], processes=3)
    with pytest.raises(ValueError, match=r"^processes: expected the same study in all, process 2 has another$"):
        monte_carlo(lambda key: jnp.zeros(()), jax.random.key(0), 3, chunk=1)


# --- Meeting the others ---


@pytest.fixture
def initialized(monkeypatch):
    """What JAX is asked to do, call by call."""
    calls = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *args, **kwargs: calls.append((args, kwargs)))
    return calls


@pytest.mark.parametrize(
    ("host", "process", "listens"),
    [("127.0.0.1", 0, True), ("127.0.0.1", 1, False), ("localhost", 0, False), ("localhost", 1, False)],
)
def test_joining_hands_on_what_it_is_given(initialized, host, process, listens):
    """Process 0 listens at the address alone if that is a number, else everywhere; nobody else listens."""
    where = f"{host}:{free_port()}"
    hosts.join(where, 2, process)
    [(args, kwargs)] = initialized
    assert args == (where, 2, process)
    assert kwargs["coordinator_bind_address"] == (where if listens else None)
    assert kwargs["initialization_timeout"] > 24 * 3600  # JAX would abort the process; `timeout` does not


def test_who_has_joined_stays_so(initialized, monkeypatch):
    monkeypatch.setattr(jax.distributed, "is_initialized", lambda: True)
    hosts.join("no such thing", -1, -1)
    assert not initialized


def test_process_0_alone_needs_the_port(initialized):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ConnectionError, match=r"^coordinator: expected a free port to listen at, got \d+: "):
            hosts.join(where, 2, 0)
        hosts.join(where, 2, 1)
    assert len(initialized) == 1


@pytest.mark.parametrize(
    ("raised", "error", "message"),
    [
        (ValueError("what JAX says"), ValueError, "^process_id: expected to be given, or to be found in a cluster"),
        (
            jax.errors.JaxRuntimeError("gone"),
            ConnectionError,
            "^distributed: JAX cannot meet the other processes: gone$",
        ),
    ],
)
def test_what_jax_says_is_told_in_words(monkeypatch, raised, error, message):
    def initialize(*args, **kwargs):
        raise raised

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(error, match=message):
        hosts.join(f"127.0.0.1:{free_port()}", 2, None)


def test_who_does_not_come_in_time_is_told(monkeypatch):
    late = threading.Event()
    monkeypatch.setattr(jax.distributed, "initialize", lambda *args, **kwargs: late.wait(5))
    with pytest.raises(TimeoutError, match=r"^distributed: expected the processes of this cluster to meet within"):
        hosts.join(timeout=0.01)
    with socket.create_server(("127.0.0.1", 0)) as there:
        where = f"127.0.0.1:{there.getsockname()[1]}"
        with pytest.raises(TimeoutError, match=f"^processes: expected 2 to meet at {re.escape(where)} within 0.01 s"):
            hosts.join(where, 2, 1, timeout=0.01)
    late.set()


# --- A study shared, and the devices here ---


@pytest.mark.parametrize("process", [0, 1])
def test_the_parts_of_all_processes_come_in_order(monkeypatch, process):
    """Of three parts the first process has two and the other one, which sends nothing at the second turn."""
    parts = [np.array([float(part), -part]) for part in range(3)]
    turns = iter([parts[:2], [parts[2], np.zeros(2)]])
    said = played(monkeypatch, lambda _: next(turns), process=process)
    outputs = (jax.ShapeDtypeStruct((), float), jax.ShapeDtypeStruct((1,), float))
    every = list(_exchange([(part,) for part in parts[process::2]], 3, outputs))
    np.testing.assert_array_equal(every, [(part,) for part in parts])
    np.testing.assert_array_equal(said, [parts[process], parts[2] if process == 0 else np.zeros(2)])


def test_runs_of_several_processes_are_not_kept(monkeypatch):
    played(monkeypatch, lambda value: [value, value])
    with pytest.raises(ValueError, match=r"^keep_runs: expected one process, got 2$"):
        monte_carlo(lambda key: jnp.zeros(()), jax.random.key(0), 3, keep_runs=True)


@pytest.mark.parametrize(("count", "asked"), [(None, 16), (3, 3), (16, 16)])
def test_as_many_devices_are_asked_for_as_there_are_cores_or_fewer(monkeypatch, count, asked):
    settings = {}
    monkeypatch.setattr(hosts, "cores", lambda: 16)
    monkeypatch.setattr(jax.config, "update", settings.__setitem__)
    monkeypatch.setattr(jax, "local_devices", lambda: ["cpu"] * settings["jax_num_cpu_devices"])
    assert hosts.use_all_cores(count) == asked
    assert settings == {"jax_num_cpu_devices": asked}


@pytest.mark.parametrize(
    ("value", "least", "most", "refused"),
    [
        (1, 1, None, None),
        (0, 1, None, "least 1, a whole number, got 0"),
        (0, 0, None, None),
        (5, 1, 5, None),
        (6, 1, 5, "most 5, got 6"),
        (True, 0, 5, "least 0, a whole number, got True"),
    ],
)
def test_a_count_is_a_whole_number_between_its_bounds(value, least, most, refused):
    if refused is None:
        hosts.check_count("runs", value, least, most)
    else:
        with pytest.raises(ValueError, match=f"^runs: expected at {refused}$"):
            hosts.check_count("runs", value, least, most)
