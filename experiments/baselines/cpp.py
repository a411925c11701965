"""The C++ study beside this file: built on the spot, run, and its answers read."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SOURCE = Path(__file__).with_name("study.cpp")
FLAGS = ("-O3", "-march=native", "-std=c++17", "-pthread")
STEPS, LANDMARKS, BEAMS, GRID = 240, 4, 61, (120, 120)  # as in the source


class Program(NamedTuple):
    """A built program."""

    path: Path
    compiler: str  # its first line of --version
    command: str  # without folders


def build(folder: Path) -> Program | None:
    """Build in `folder` with $CXX, g++ or clang++; None where there is no compiler.

    Raises:
        OSError: the compiler refuses.
    """
    wanted = os.environ.get("CXX")
    compiler = next(filter(None, map(shutil.which, [wanted] if wanted else ["g++", "clang++"])), None)
    if compiler is None:
        return None
    program = folder / "study"
    done = subprocess.run(
        [compiler, *FLAGS, "-o", str(program), str(SOURCE)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise OSError(f"{compiler}: cannot build {SOURCE.name}: {done.stderr.strip()}")
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True).stdout
    command = " ".join([Path(compiler).name, *FLAGS, "-o", program.name, SOURCE.name])
    return Program(program, version.splitlines()[0], command)


def study(program: Program, runs: int, *, mapping: bool, threads: int, seed: int = 0) -> dict[str, Any]:
    """One study: `seconds` of computing after a warm-up, and its statistics."""
    counts = {"--runs": runs, "--threads": threads, "--seed": seed}
    arguments = [str(part) for pair in counts.items() for part in pair]
    return _answer(program, *arguments, *(["--map"] if mapping else []))


def profile(program: Program, runs: int) -> dict[str, Any]:
    """Microseconds of each part of a run, on one thread."""
    return _answer(program, "--profile", "--runs", str(runs))


def check(
    program: Program, control: np.ndarray, z: np.ndarray, valid: np.ndarray, ranges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Filter and map one given run of the capstone.

    Args:
        control: (T, 2). z: (T, L, 2). valid: (T, L). ranges: (T, B).

    Returns:
        (T, 10) mean, upper triangle of the covariance, log-likelihood of the step; (rows, columns) log-odds.
    """
    given = [np.asarray(x, np.float32).ravel() for x in (control, z, valid, ranges)]
    command = [str(program.path), "--check"]
    done = subprocess.run(command, input=np.concatenate(given).tobytes(), capture_output=True, check=True)
    numbers = np.frombuffer(done.stdout, np.float32)
    return numbers[: STEPS * 10].reshape(STEPS, 10), numbers[STEPS * 10 :].reshape(GRID)


def _answer(program: Program, *arguments: str) -> dict[str, Any]:
    done = subprocess.run([str(program.path), *arguments], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
