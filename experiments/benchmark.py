"""How fast, against what: a plain C++ loop that does the same work, other libraries' filters, the course's program.

Everything that is compared runs in turns (ours, the other, ours, the other, ...) on the same cores; a ratio is the
median over the pairs. Compiling is reported apart. Takes some minutes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
from baselines import course, cpp, peers, tables
from evidence import replace_table

import jaxlocmap
from jaxlocmap import files, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.monte_carlo import Result, hosts, monte_carlo
from jaxlocmap.monte_carlo.hosts import check_count, merge_kernels, use_all_cores

Section = Literal["study", "filter", "devices", "cost"]
_SECTIONS: tuple[Section, ...] = ("study", "filter", "devices", "cost")


@dataclasses.dataclass(frozen=True)
class BenchmarkConfig:
    """What to measure."""

    only: tuple[Section, ...] | None = None
    """study: against C++ and the course's program; filter: against other libraries; devices: all over one; cost:
    compilation, memory, import. All by default, with --quick the first two."""
    pairs: int = 3
    """How often each comparison is made."""
    seconds: float = 2.0
    """That each timing of a study lasts at least."""
    seed: int = 0
    """Of all randomness."""
    write: bool = False
    """Put the tables into experiments/README.md as well."""
    out: Path = Path("out/benchmark")
    """Folder for report.json and tables.md."""
    quick: bool = False
    """A run of some seconds: one pair of each, tiny."""


class Size(NamedTuple):
    """How much is run."""

    pairs: int
    seconds: float  # a timing of a study lasts at least
    runs: int = 20_000  # of a study to begin with; a tenth with maps
    peer_runs: int = 1000
    peer_steps: int = 1000
    precisions: tuple[str, ...] = ("float64", "float32")
    memory_runs: tuple[int, int] = (20_000, 200_000)
    imports: int = 5


QUICK = Size(1, 0.0, 2000, 20, 50, ("float64",), (200, 2000), 1)
_TICKS: dict[str, Callable[[Size], int]] = {
    "study": lambda size: 3,
    "filter": lambda size: len(size.precisions) * len(peers.PEERS),
    "devices": lambda size: 1,
    "cost": lambda size: size.pairs,
}


@contextlib.contextmanager
def _ticks(total: int) -> Iterator[Callable[[], None]]:
    """A progress bar that is moved one on by each call."""
    done = itertools.count(1)
    with progress_bar("measuring", total) as progress:
        yield lambda: progress(next(done))


def main(config: BenchmarkConfig) -> dict[str, Any]:
    """Measure, write the report and the tables."""
    out = output_folder(config.out)
    check_count("pairs", config.pairs)
    if not 0 < config.seconds < math.inf:
        raise ValueError(f"seconds: expected more than 0, finite, got {config.seconds}")
    size = QUICK if config.quick else Size(config.pairs, config.seconds)
    sections = config.only or (_SECTIONS[:2] if config.quick else _SECTIONS)
    merge_kernels()
    devices = use_all_cores()
    report: dict[str, Any] = {"machine": _machine(devices), "seed": config.seed, "pairs": size.pairs}
    began = time.perf_counter()
    with _ticks(sum(_TICKS[section](size) for section in sections)) as tick, tempfile.TemporaryDirectory() as folder:
        if "study" in sections:
            report["study"] = _studies(size, config.seed, Path(folder), tick)
        if "filter" in sections:
            report["filter"] = _filters(size, config.seed, tick)
        if "devices" in sections:
            report["devices"] = _devices(size, config.seed, tick)
        if "cost" in sections:
            report["cost"] = _costs(size, tick)
    report["wall_s"] = time.perf_counter() - began
    write_report(out, report)
    shown = [table for table in (tables.overview(report), tables.filters(report)) if table.rows]
    notes = tables.notes(report)
    text = "\n".join([*(table.markdown() for table in shown), *notes])
    files.write(out / "tables.md", f"{text}\n")
    if config.write:
        replace_table("benchmark", text)
    for table in shown:
        CONSOLE.print(table.rich())
    CONSOLE.print(*notes, sep="\n")
    saved(out, "report.json", "tables.md")
    return report


# ---- Measuring ------------------------------------------------------------------------------------------------------


def _in_turns(ours: Callable[[], float], other: Callable[[], float], pairs: int) -> dict[str, Any]:
    """Measure two things in turns; `ratio` is the median of the pairs' ratios, ours over the other."""
    measured = [(ours(), other()) for _ in range(pairs)]
    ratios = [a / b for a, b in measured]
    return {
        "ours": statistics.median(a for a, _ in measured),
        "other": statistics.median(b for _, b in measured),
        "ratio": statistics.median(ratios),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
        "measured": measured,
    }


def _long_enough(
    run: Callable[[int], Any], took: Callable[[Any], float], runs: int, seconds: float
) -> tuple[int, Any, Any]:
    """How many runs take at least `seconds`, and what came of the first and the last try. What is needed for so many
    is compiled by then.
    """
    first = last = run(runs)
    while took(last) < seconds:
        runs = math.ceil(runs * min(max(1.3 * seconds / took(last), 1.5), 50))
        last = run(runs)
    return runs, first, last


def _study(mapping: bool, seed: int, devices: list[Any]) -> Callable[[int], Result]:
    """The default study, as a function of the number of runs."""
    scenario = simulation.CAPSTONE
    study = Study(scenario, scenario.config(grid=mapping))
    scene = (simulation.course_params(), simulation.room(), simulation.Noise(), scenario.prior())
    return lambda runs: monte_carlo(study, jax.random.key(seed), runs, *scene, devices=devices)


def _studies(size: Size, seed: int, folder: Path, tick: Callable[[], None]) -> dict[str, Any]:
    """Whole studies, without and with maps, against the C++ program and the course's."""
    program = cpp.build(folder)
    report: dict[str, Any] = {"cpp": None}
    if program is not None:
        parts = cpp.profile(program, max(size.runs // 20, 50))
        report["cpp"] = {"compiler": program.compiler, "command": program.command, "microseconds_a_run": parts}
    for name, mapping in (("without_map", False), ("with_map", True)):
        report[name] = _against_cpp(program, mapping, size, seed)
        tick()
    seconds = [_seconds(lambda number=number: course.run(number)) for number in range(size.pairs)]
    a_run = statistics.median(seconds)
    report["course"] = {"seconds_a_run": a_run, "ratio": report["with_map"]["ours"] * a_run, "measured": seconds}
    tick()
    return report


def _against_cpp(program: cpp.Program | None, mapping: bool, size: Size, seed: int) -> dict[str, Any]:
    study = _study(mapping, seed, jax.local_devices())
    start = size.runs // 10 if mapping else size.runs
    runs, first, last = _long_enough(study, lambda result: result.run_s, start, size.seconds)
    ours = _statistics(summarise(last.value, simulation.CAPSTONE.config(grid=mapping)))
    row = {"runs": runs, "chunk": last.chunk, "compile_s": first.compile_s, "statistics": ours}

    def speed() -> float:
        return runs / study(runs).run_s

    if program is None:
        return {**row, "ours": statistics.median(speed() for _ in range(size.pairs))}
    threads = hosts.cores()

    def other(count: int) -> dict[str, Any]:
        return cpp.study(program, count, mapping=mapping, threads=threads, seed=seed)

    count, _, found = _long_enough(other, lambda found: found["seconds"], runs, size.seconds)
    compared = _in_turns(speed, lambda: other(count)["runs_per_s"], size.pairs)
    return {**row, "cpp_statistics": found, "difference": _difference(ours, runs, found), **compared}


def _statistics(summary: dict[str, Any]) -> dict[str, float]:
    names = ("anees", "anees_standard_error", "nis_mean", "nis_standard_error", "rmse_position_m", "rmse_yaw_rad")
    found = {name: summary[name] for name in (*names, "gate_accept_rate", "coverage_95", "diverged_runs")}
    return {**found, **{name: summary["map"][name] for name in ("entropy_bits", "brier") if "map" in summary}}


def _difference(ours: dict[str, float], runs: int, found: dict[str, Any]) -> dict[str, float]:
    """How far the two programs' statistics are apart, in standard errors of the difference.

    The spread between runs is the C++ program's, which gives it for every statistic.
    """
    squares = {"mean_square_position": ours["rmse_position_m"] ** 2, "mean_square_yaw": ours["rmse_yaw_rad"] ** 2}
    names = ("anees", "nis_mean", "entropy_bits", "brier")
    values = {**squares, **{name: ours[name] for name in names if name in ours}}
    scale = math.sqrt(1 + found["runs"] / runs)
    apart = {name: (v - found[name]) / (found[f"{name}_standard_error"] * scale) for name, v in values.items()}
    refused = [1 - ours["gate_accept_rate"], 1 - found["gate_accept_rate"]]
    readings = found["observations"] / found["runs"] * runs, found["observations"]
    spread = math.sqrt(max(refused) * (1 / readings[0] + 1 / readings[1]))  # binomial, of rare refusals
    return {**apart, "gate_accept_rate": (refused[1] - refused[0]) / spread if spread else 0.0}


def _devices(size: Size, seed: int, tick: Callable[[], None]) -> dict[str, Any] | None:
    """The study without maps: all devices over one, and all over one that is kept to one core. A single JAX device of
    a CPU may use the other cores too: how many are busy stands beside it.
    """
    devices = jax.local_devices()
    busy: dict[int, list[float]] = {1: [], len(devices): []}
    if len(busy) < 2:
        tick()
        return None
    studies = {count: _study(False, seed, devices[:count]) for count in busy}
    runs = {
        count: _long_enough(study, lambda result: result.run_s, size.runs, size.seconds)[0]
        for count, study in studies.items()
    }

    def speed_with(count: int) -> float:
        before = time.process_time()
        seconds = _seconds(lambda: studies[count](runs[count]))
        busy[count].append((time.process_time() - before) / seconds)
        return runs[count] / seconds

    compared = _in_turns(lambda: speed_with(len(devices)), lambda: speed_with(1), size.pairs)
    cores = {"ours": statistics.median(busy[len(devices)]), "other": statistics.median(busy[1])}
    kept = None
    if devices[0].platform == "cpu" and hasattr(os, "sched_setaffinity"):
        arguments = ("--cores", 1, "--runs", runs[1])
        kept = _in_turns(lambda: speed_with(len(devices)), lambda: runs[1] / _probe(*arguments)["run_s"], size.pairs)
    tick()
    return {"devices": len(devices), "runs": runs, "cores_busy": cores, **compared, "one_core": kept}


def _filters(size: Size, seed: int, tick: Callable[[], None]) -> dict[str, Any]:
    """The filter alone, against each peer that is installed."""
    drives = peers.drive(size.peer_runs, size.peer_steps, seed)
    found: list[dict[str, Any]] = []
    for precision in size.precisions:
        with peers.ready(peers.OURS, drives, precision) as ours:
            speed = statistics.median(ours.steps_per_s() for _ in range(size.pairs))
            found.append({**_named(peers.OURS, precision), **ours.facts, "steps_per_s": speed})
            for peer in peers.PEERS:
                entry = _named(peer, precision)
                if precision in peer.precisions:
                    found.append(entry)
                if precision in peer.precisions and entry["version"] is not None:
                    with peers.ready(peer, drives, precision) as other:
                        compared = _in_turns(ours.steps_per_s, other.steps_per_s, size.pairs)
                        entry |= {**other.facts, **compared, "steps_per_s": compared["other"]}
                tick()
    return {"runs": size.peer_runs, "steps": size.peer_steps, "filters": found}


def _named(peer: peers.Peer, precision: str) -> dict[str, Any]:
    return {"name": peer.name, "precision": precision, "form": peer.form, "version": peer.version()}


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def _costs(size: Size, tick: Callable[[], None]) -> dict[str, Any]:
    """What a user waits for or must have, each in processes of its own: imports, compilation, memory."""
    imports = _in_turns(lambda: _import_s("jaxlocmap"), lambda: _import_s("jax"), size.imports)
    extra = [ours - jax_alone for ours, jax_alone in imports["measured"]]
    small, large, maps = [], [], []
    for _ in range(size.pairs):
        small.append(_probe("--runs", size.memory_runs[0]))
        large.append(_probe("--runs", size.memory_runs[1]))
        maps.append(_probe("--map", "--runs", size.runs // 100))
        tick()
    peaks = [big["peak_bytes"] / few["peak_bytes"] for few, big in zip(small, large, strict=True)]
    return {
        "import_over_jax_s": statistics.median(extra),
        "imports": imports,
        "compile_s": statistics.median(each["compile_s"] for each in maps),
        "compile_s_without_map": statistics.median(each["compile_s"] for each in small + large),
        "memory": {
            "runs": size.memory_runs,
            "peak_bytes": [statistics.median(each["peak_bytes"] for each in group) for group in (small, large)],
            "ratio": statistics.median(peaks),
            "ratio_min": min(peaks),
            "ratio_max": max(peaks),
        },
        "command": "python experiments/baselines/probe.py --runs N [--map]",
    }


def _import_s(module: str) -> float:
    code = f"import time; began = time.perf_counter(); import {module}; print(time.perf_counter() - began)"
    return float(_python("-c", code))


def _probe(*arguments: Any) -> dict[str, Any]:
    return json.loads(_python(str(Path(__file__).parent / "baselines" / "probe.py"), *map(str, arguments)))


def _python(*arguments: str) -> str:
    root = str(Path(jaxlocmap.__file__).parent.parent)
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, check=True
    ).stdout.splitlines()[-1]


def _machine(devices: int) -> dict[str, Any]:
    model = platform.processor()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return {
        "cpu": model,
        "cores": hosts.cores(),
        "devices": devices,
        "platform": jax.devices()[0].platform,
        "python": platform.python_version(),
        "jax": jax.__version__,
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,  # of other programs
    }


if __name__ == "__main__":
    command_line(main)
