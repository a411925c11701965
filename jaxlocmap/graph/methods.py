"""Which way a linear system of a pose graph is solved."""

from __future__ import annotations

import numpy as np

from jaxlocmap import checks
from jaxlocmap.graph import loop_space, sparse
from jaxlocmap.graph.factors import Graph

MOST_LOOPS = 150  # beyond, the dense system of the loops takes longer than a sparse one of the poses
METHODS = ("loop_space", "scipy", "sparsax")


def resolve(method: str | None, graph: Graph) -> str:
    """The method by its name; None chooses by how many loops there are, whether odometry is a chain without gaps (taken
    for granted under `jit`), and by what is installed.

    Raises:
        ValueError: an unknown name. ImportError: `sparsax` asked for where it cannot be used.
    """
    if method is None:
        if _broken(graph):
            return "scipy"  # which flags what CHOLMOD refuses for the whole call
        if graph.loops <= MOST_LOOPS:
            return "loop_space"
        return "sparsax" if sparse.has_sparsax() else "scipy"
    checks.named("method", method, dict.fromkeys(METHODS), "None")
    if method == "sparsax" and not sparse.has_sparsax():
        raise ImportError("method: expected sparsax to be installed, numbers to be float64 and the device to be a CPU")
    return method


def _broken(graph: Graph) -> bool:
    """Whether a link of the chain is known to lack information."""
    information = graph.odometry_information
    if not checks.is_concrete(information):
        return False
    known = np.asarray(information, np.float64)
    try:
        np.linalg.cholesky(known[np.isfinite(known).all(axis=(-2, -1))])
    except np.linalg.LinAlgError:
        return True
    return False


def factorised(system: loop_space.System, method: str) -> loop_space.LoopSpace | sparse.Sparse:
    """The system, ready to be solved."""
    if method == "loop_space":
        return loop_space.factorised(system)
    return sparse.factorised(system, sparsax=method == "sparsax")
