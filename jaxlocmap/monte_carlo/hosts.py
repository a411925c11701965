"""Devices of this machine, and the processes on other machines that share a study."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import numbers
import os
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

_T = TypeVar("_T")
_MERGED = "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion"
# JAX aborts the interpreter when its own time limit passes, so that limit is out of reach (115 days).
_JAX_NEVER = 10_000_000  # s


def check_count(name: str, value: Any, least: int = 1, most: int | None = None) -> None:
    """Raise unless `value` is a whole number of a whole-number type, `least` <= value <= `most`.

    Raises:
        ValueError: it is not; 5.0 is not.
    """
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole or int(value) < least:
        raise ValueError(f"{name}: expected at least {least}, a whole number, got {value!r}")
    if most is not None and int(value) > most:
        raise ValueError(f"{name}: expected at most {most}, got {value}")


def merge_kernels() -> None:
    """Let JAX's compiler for CPUs make one kernel of those that share their inputs, if JAX has not started yet.

    Studies take less than half the time with it. It is an experimental option of XLA, for processes that simulate and
    filter: derivatives can make the compiler of JAX 0.10 abort the process. An XLA_FLAGS that sets such options stays.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_MERGED}".strip()


def cores() -> int:
    """Processor cores that this process may use: of the machine, or those that a batch system or container grants."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # no control group, or one without a quota ("max")
        quota, period = map(int, Path("/sys/fs/cgroup/cpu.max").read_text().split())
        count = min(count, -(-quota // period))
    return max(count, 1)


def use_all_cores(count: int | None = None) -> int:
    """One JAX device per processor core of this machine, if JAX has not started yet.

    Call it before anything else touches JAX, but after `join`: once JAX has started, its devices are settled and stay
    as they are.

    Args:
        count: how many devices to have, all by default.

    Returns:
        The number of local devices, or `count`; where JAX has an accelerator, its devices are the ones counted.

    Raises:
        ValueError: a `count` below 1, or more devices than exist.
    """
    here = cores()
    if count is not None:
        check_count("devices", count)
    with contextlib.suppress(RuntimeError):  # started already
        jax.config.update("jax_num_cpu_devices", min(count or here, here))
    devices = jax.local_devices()
    if count is not None and count > len(devices):
        what = "cores" if devices[0].platform == "cpu" else f"{devices[0].platform} devices"
        late = f", the devices that JAX has started with (here are {here} cores)"
        why = late if len(devices) < min(count, here) else f", the {what} of this machine"
        raise ValueError(f"devices: expected at most {len(devices)}{why}, got {count}")
    return count or len(devices)


def join(
    coordinator: str | None = None,
    processes: int | None = None,
    process_id: int | None = None,
    *,
    timeout: float = 60,
) -> None:
    """Make this process one of several that share their studies, by `jax.distributed`.

    Every process runs the same program. What is not given, JAX takes from the cluster it finds itself in (Slurm,
    Kubernetes, Open MPI). Call it before anything else touches JAX, and start the first study soon after: JAX gives
    up on a process that comes 30 s after the first one to what they do first together, and on one that comes half an
    hour later than the others to the end. When a process dies, JAX aborts the others with a C++ stack on the screen, at
    once if it was process 0, else within two minutes; what is on disk stays. Once joined, a process stays so: another
    call does nothing.

    Args:
        coordinator: "host:port" of process 0. It listens at that address alone if it is given as a number
            (127.0.0.1:1234), at all addresses of its machine if by name. There is no password: whoever reaches the port
            can join, so let that be in a network of your own.
        processes: how many there are.
        process_id: which one this is, from 0.
        timeout: s, how long the processes wait for each other.

    Raises:
        ValueError: no cluster is found and something is not given, or what is given makes no sense.
        TimeoutError: the coordinator cannot be reached, or a process is missing, for `timeout` seconds.
        ConnectionError: process 0 cannot listen at its port.
    """
    if jax.distributed.is_initialized():
        return
    host, _, port = (coordinator or "").rpartition(":")
    if coordinator is not None and not (host and port.isdecimal() and 0 < int(port) < 2**16):
        raise ValueError(f"coordinator: expected host:port, got {coordinator!r}")
    if processes is not None:
        check_count("processes", processes)
    if process_id is not None:
        check_count("process_id", process_id, 0, None if processes is None else processes - 1)

    bind = _listening_at(host, int(port)) if coordinator is not None and process_id == 0 else None

    def initialize() -> None:
        jax.distributed.initialize(
            coordinator,
            processes,
            process_id,
            initialization_timeout=_JAX_NEVER,
            coordinator_bind_address=bind,
        )

    try:
        waiting(initialize, timeout)
    except TimeoutError:
        raise TimeoutError(_who_is_missing(host, port, processes, timeout)) from None
    except ValueError as error:
        given = {"coordinator": coordinator, "processes": processes, "process_id": process_id}
        missing = ", ".join(name for name, value in given.items() if value is None)
        if not missing:
            raise
        raise ValueError(
            f"{missing}: expected to be given, or to be found in a cluster (Slurm, Kubernetes, Open MPI); got neither"
        ) from error
    except jax.errors.JaxRuntimeError as error:
        raise ConnectionError(f"distributed: JAX cannot meet the other processes: {error}") from None


def _listening_at(host: str, port: int) -> str | None:
    """Where process 0 is to listen: at the address it was given, if that is a number of this machine's; else, as a name
    may mean another address to others, at all of them (None).
    """
    try:  # JAX may crash where it cannot listen
        try:
            address = ipaddress.ip_address(host.strip("[]"))
            family = socket.AF_INET if address.version == 4 else socket.AF_INET6
            socket.create_server((str(address), port), family=family).close()
            return f"{host}:{port}"
        except ValueError:
            pass
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:  # else behind a translated address, as in a container
                raise
        everywhere, family = ("::", socket.AF_INET6) if socket.has_dualstack_ipv6() else ("", socket.AF_INET)
        socket.create_server((everywhere, port), family=family, dualstack_ipv6=bool(everywhere)).close()
    except OSError as error:
        raise ConnectionError(f"coordinator: expected a free port to listen at, got {port}: {error}") from None
    return None


def _who_is_missing(host: str, port: str, processes: int | None, timeout: float) -> str:
    if not host:
        return f"distributed: expected the processes of this cluster to meet within {timeout:g} s, they did not"
    try:
        socket.create_connection((host.strip("[]"), int(port)), 1).close()
    except OSError as error:
        return f"coordinator: expected one that answers at {host}:{port} within {timeout:g} s, got: {error}"
    return f"processes: expected {processes or 'all'} to meet at {host}:{port} within {timeout:g} s, some did not come"


def waiting(action: Callable[[], _T], timeout: float | None = None) -> _T:
    """What `action` returns. It works in a thread of its own, so that Ctrl-C is heard while JAX waits for others.

    Raises:
        TimeoutError: it took longer than `timeout` seconds; the thread is left behind.
    """
    future: Future[_T] = Future()

    def work() -> None:
        try:
            future.set_result(action())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return future.result(timeout)


def gather(value: np.ndarray) -> np.ndarray:
    """The array of every process, in every process.

    Args:
        value: numbers of 4 or 8 bytes, of the same shape and dtype in every process.

    Returns:
        (processes, *shape), bit for bit. It waits for the slowest process, though not longer than XLA does (30 min).

    Raises:
        ConnectionError: a process is gone.
    """
    if jax.process_count() == 1:
        return value[None]
    words = np.ascontiguousarray(value).view(np.uint32)  # JAX would round float64 to its default precision
    # One device of each process: the processes may have different numbers of them.
    first = {device.process_index: device for device in reversed(jax.devices())}
    mesh = Mesh(np.array([first[process] for process in sorted(first)]), ("processes",))

    def exchange() -> np.ndarray:
        everyone = jax.make_array_from_process_local_data(NamedSharding(mesh, P("processes")), words[None])
        replicated = jax.jit(_same, out_shardings=NamedSharding(mesh, P()))(everyone)
        return np.asarray(replicated.addressable_data(0))

    try:
        return waiting(exchange).view(value.dtype).reshape(len(first), *value.shape)
    except jax.errors.JaxRuntimeError as error:
        raise ConnectionError(f"processes: expected all {len(first)} to go on, one is gone: {error}") from None


def _same(x: jax.Array) -> jax.Array:
    return x


def in_turn(action: Callable[[], _T]) -> _T:
    """Do something in one process after the other, so that they may share a folder.

    Raises:
        Whatever `action` raises here, and ConnectionError where it raised in another process.
    """
    result, error = None, None
    for process in range(jax.process_count()):
        if process == jax.process_index():
            try:
                result = action()
            except Exception as raised:
                error = raised
        failed = gather(np.array(error is not None, np.int32))
        if error is not None:
            raise error
        if failed.any():
            raise ConnectionError(f"processes: expected all to go on, process {process} did not; it says why")
    return result  # pyright: ignore[reportReturnType] the turn of this process has come
