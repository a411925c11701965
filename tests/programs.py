"""Programs in processes of their own, and what they leave behind."""

import json
import os
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


def start(file, *arguments, **environment):
    """Start a program as from a command line."""
    inherited = {name: value for name, value in ON_CPU.items() if not name.startswith("SLURM_")}
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "experiments")))}
    return subprocess.Popen(
        [sys.executable, str(file), *map(str, arguments)],
        env={**inherited, **paths, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


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
