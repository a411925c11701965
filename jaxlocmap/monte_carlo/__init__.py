"""The map over runs: in chunks, over all devices of all processes, with a checkpoint on disk. It knows no robot."""

from jaxlocmap.monte_carlo.hosts import use_all_cores
from jaxlocmap.monte_carlo.run import Result, monte_carlo

__all__ = ["Result", "monte_carlo", "use_all_cores"]
