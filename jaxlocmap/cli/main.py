"""The jobs of the command `jaxlocmap`."""

from __future__ import annotations

from jaxlocmap.cli import graph, judge, localize, map_log, slam, study, sweep, tune
from jaxlocmap.cli.command import Program, command_line

JOBS: dict[str, Program] = {
    "study": study.main,
    "sweep": sweep.main,
    "tune": tune.main,
    "judge": judge.main,
    "localize": localize.main,
    "map": map_log.main,
    "slam": slam.main,
    "graph": graph.main,
}


def main() -> None:
    """Run one of them, as the command line says."""
    command_line(JOBS, "jaxlocmap", "Localisation and mapping whose covariance can be believed, or shown not to be.")
