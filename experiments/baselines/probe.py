"""One study in a process of its own: how long it compiles and runs, and how much memory it takes at most."""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
from pathlib import Path

import jax

from jaxlocmap import simulation
from jaxlocmap.consistency.study import Study
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.monte_carlo.hosts import merge_kernels, use_all_cores


def peak_bytes() -> int:
    """Of this program. Not `ru_maxrss` on Linux, which starts at the peak of the process that started this one."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def main() -> None:
    """Print one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, required=True)
    parser.add_argument("--map", action="store_true")
    parser.add_argument("--cores", type=int, help="on so many cores and no more, where the system can see to it")
    arguments = parser.parse_args()
    if arguments.cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.cores])  # before JAX counts them
    merge_kernels()
    use_all_cores()
    scenario = simulation.CAPSTONE
    study = Study(scenario, scenario.config(grid=arguments.map))
    world, noise, prior = simulation.room(), simulation.Noise(), scenario.prior()
    result = monte_carlo(study, jax.random.key(0), arguments.runs, simulation.course_params(), world, noise, prior)
    print(json.dumps({"compile_s": result.compile_s, "run_s": result.run_s, "peak_bytes": peak_bytes()}))


if __name__ == "__main__":
    main()
