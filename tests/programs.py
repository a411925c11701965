"""Programs in processes of their own, and what they leave behind."""

import atexit
import functools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
WALKS = Path(__file__).parent / "walks.py"
_CACHE = tempfile.TemporaryDirectory(prefix="jaxlocmap-")  # not the user's own
# A program takes the processor even where there is a GPU, which two processes cannot share; and compiles quickly, with
# the flags of `conftest`.
ON_CPU = {
    **os.environ,
    "JAX_PLATFORMS": "cpu",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "JAX_COMPILATION_CACHE_DIR": _CACHE.name,
}
# What a report says of the computing and not of the study.
COMPUTING = {"devices", "processes", "resumed_runs", "wall_s", "compile_s", "run_s", "runs_per_s"}


class Recorder:
    """In the place of a function: keeps what it is called with, and hands back what it is told to."""

    def __init__(self, answer=None):
        self.calls, self.answer = [], answer

    def __call__(self, *args, **kwargs):
        self.calls.append((args, kwargs))
        return self.answer


class Enough(Exception):
    """What was to be seen has been seen: the program need not go on."""


def stop(*_, **__):
    """In the place of a function after which nothing is of interest."""
    raise Enough


def _surroundings(**environment):
    """Of a program: those of the tests, but for what a job of Slurm adds, and with what is asked for."""
    inherited = {name: value for name, value in ON_CPU.items() if not name.startswith("SLURM_")}
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "experiments")))}
    return {**inherited, **paths, **environment}


def anew(file, *arguments, **environment):
    """Start a program as from a command line."""
    return subprocess.Popen(
        [sys.executable, *map(str, (file, *arguments))],
        env=_surroundings(**environment),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@functools.cache
def _nursery():
    """The socket to a process that becomes any program."""
    here, there = socket.socketpair()
    with there:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("nursery.py"))], stdin=there, env=_surroundings()
        )

    @atexit.register
    def close():
        here.close()
        process.wait(60)

    return here


class Program:
    """One under way, with the methods of a `Popen`."""

    def __init__(self, arguments, environment):
        self._folder = tempfile.TemporaryDirectory()
        (Path(self._folder.name) / "request").write_text(json.dumps([arguments, environment]))
        self._told, tell = os.pipe()
        socket.send_fds(_nursery(), [self._folder.name.encode()], [tell])
        os.close(tell)
        self.pid, self.returncode = self._number(), None

    def _number(self):
        told = os.read(self._told, 8)
        if not told:
            raise ChildProcessError("the process that becomes programs has ended")
        return int.from_bytes(told, signed=True)

    def poll(self, timeout=0):
        if self.returncode is None and select.select([self._told], [], [], timeout)[0]:
            self.returncode = self._number()
            os.close(self._told)
        return self.returncode

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout):
        if self.poll(timeout) is None:
            raise subprocess.TimeoutExpired("a program", timeout)
        with self._folder as folder:
            return [(Path(folder) / name).read_text() for name in ("out", "err")]


def start(file, *arguments, **environment):
    """The same by a fork of a process that has imported what it needs, for a quarter of the time."""
    return Program(list(map(str, (file, *arguments))), _surroundings(**environment))


def ended(process):
    """Its exit status and what it said."""
    try:
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    # The library that processes talk through says so.
    return process.returncode, "".join(line for line in out.splitlines(True) if not line.startswith("[Gloo]")), err


def report(folder):
    return json.loads((folder / "report.json").read_text())


def result(folder):
    """The report without what is different each time."""
    return {name: value for name, value in report(folder).items() if name not in COMPUTING}


def is_free(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
