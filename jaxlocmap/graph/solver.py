"""The most likely poses of a graph: from a start to an optimum, and what became of it."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap.graph import methods
from jaxlocmap.graph.descent import descend, graduated
from jaxlocmap.graph.factors import Graph, check, components, dead_reckoning, prepared, root, squares
from jaxlocmap.graph.gauss_newton import both, inverted
from jaxlocmap.graph.implicit import at_optimum
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.start import chordal
from jaxlocmap.se2 import POSE


class Solution(NamedTuple):
    """The most likely poses, and what became of the graph. The fields of a batch lead with its axis."""

    poses: jax.Array  # (N, 3) m, m, rad
    weights: jax.Array  # (L,) of the loops, by the kernel: 1 counts in full, 0 not at all
    chi2_start: jax.Array  # () Σ eᵀ Omega e of all edges at the start
    chi2: jax.Array  # () the same at the poses
    objective: jax.Array  # () what was minimised: loops by the kernel
    iterations: jax.Array  # () int32, linear systems solved
    converged: jax.Array  # () bool
    finite: jax.Array  # () bool: measurements, information, start and result are numbers
    good_odometry: jax.Array  # (N - 1,) bool: its information is positive definite; semi-definite for a sparse method
    good_loop: jax.Array  # (L,) bool: its information is positive semi-definite


def solve(
    graph: Graph,
    start: jax.Array | None = None,
    *,
    kernel: Kernel | str = "quadratic",
    method: str | None = None,
    steps: int = 100,
    tolerance: float | None = None,
) -> Solution:
    """Minimise Σ eᵀ Omega e of odometry and Σ rho(eᵀ Omega e) of loops over all poses but the first.

    Works under `jit`, `vmap` over graphs of equal numbers of poses and loops (`stack`) and `grad`. Derivatives of the
    poses are those of the optimum (implicit function theorem), by measurements, information and the kernel's scale; by
    the start there is none but that of the first pose. Those of weights by `gnc` are zero: they are a choice.

    Args:
        graph: of N poses and L loops.
        start: (N, 3) m, m, rad, the first of which stays as it is. None: `chordal` for the quadratic kernel, where all
            loops are trusted; `dead_reckoning` for any other, as false loops spoil a chordal start.
        kernel: of the loops, or its name (`kernels`).
        method: how linear systems are solved, static: "loop_space" for batches and up to some 150 loops, "scipy" or
            "sparsax" for large graphs (`sparse`); None chooses by size.
        steps: at most, static.
        tolerance: > 0, static: it ends with the step that promises to lower the objective by less than this share; by
            default 4e-11 in float64. For derivatives under a robust kernel give 1e-15: there steps shrink linearly,
            and the formula of the derivatives holds at the optimum.

    Returns:
        `Solution`. A graph that has no finite optimum is flagged (`converged`, `finite`); `faults` says why in words.

    Source: Kümmerle et al. 2011 (Gauss-Newton on poses); Yang et al. 2020 (graduated non-convexity); Kalman 1960 (the
    system of the loops is that of an innovation).

    Raises:
        ValueError: a wrong shape, a pair that is none of the graph, an unknown kernel or method, no step, a
            tolerance out of its range.
        ImportError: `sparsax` asked for where it cannot be used.
    """
    check(graph)
    if steps < 1:
        raise ValueError(f"steps: expected at least 1, got {steps}")
    if start is not None:
        checks.shape("start", start, (graph.poses, POSE))
    kernel = Kernel(kernel) if isinstance(kernel, str) else kernel
    finest = float(jnp.finfo(graph.odometry.dtype).eps) ** (2 / 3)
    share = finest if tolerance is None else tolerance
    if not 0 < share < 1:
        raise ValueError(f"tolerance: expected a share inside (0, 1), got {tolerance}")
    return _solve(graph, start, kernel, methods.resolve(method, graph), steps, share)


@functools.partial(jax.jit, static_argnames=("method", "steps", "tolerance"))
def _solve(
    graph: Graph, start: jax.Array | None, kernel: Kernel, method: str, steps: int, tolerance: float
) -> Solution:
    if start is None:
        start = chordal(graph, method=method) if kernel.name == "quadratic" else dead_reckoning(graph)
    fixed = jax.lax.stop_gradient((graph, start, kernel))
    taken = jnp.zeros((), jnp.int32)
    weights = jnp.ones(graph.loops, start.dtype)
    final = kernel
    if kernel.name == "gnc":
        begun, weights, taken = graduated(*fixed, method, steps)
        final = Kernel("quadratic")
        fixed = (fixed[0], begun, final)
    found = descend(*fixed, weights, method, steps, tolerance)
    poses = at_optimum(graph, start[0], found.poses, final, weights, method)

    edges = prepared(graph)
    chain, loops = (squares(e, lin.error) for e, lin in both(edges, graph.pair, components(poses)))
    good_odometry, good_loop = (root(e.information)[1] for e in edges)
    if method == "loop_space":
        good_odometry &= inverted(edges[0].information)[1]
    before = [jnp.sum(squares(e, lin.error)) for e, lin in both(edges, graph.pair, components(start))]
    objective = jnp.sum(chain) + jnp.sum(weights * final.rho(loops))
    return Solution(
        poses=poses,
        weights=weights * final.weight(loops),
        chi2_start=before[0] + before[1],
        chi2=jnp.sum(chain) + jnp.sum(loops),
        objective=objective,
        iterations=taken + found.iterations,
        converged=found.converged & jnp.all(good_odometry) & jnp.all(good_loop),
        finite=jnp.isfinite(objective + before[0] + before[1]),
        good_odometry=good_odometry,
        good_loop=good_loop,
    )


def faults(graph: Graph, solution: Solution, start: jax.Array | None = None) -> list[str]:
    """Why one graph did not converge, in words; empty where it did. Not for use under `jit`.

    Args:
        graph, solution: of `solve`, one graph, not a batch.
        start: as it was given to `solve`.
    """
    if bool(solution.converged):
        return []
    said = []
    for name, value in (*graph._asdict().items(), *([] if start is None else [("start", start)])):
        value = np.asarray(value)
        wrong = ~np.isfinite(value).all(axis=tuple(range(1, value.ndim)))
        if wrong.any():
            said.append(f"{name}: {wrong.sum()} are not finite, the first number {np.argmax(wrong)}")
    for name, good in (("odometry", solution.good_odometry), ("loop", solution.good_loop)):
        wrong = ~np.asarray(good)
        if wrong.any() and not said:
            wanted = "definite" if name == "odometry" else "semi-definite"
            which = f"the information of {wrong.sum()} is not positive {wanted}, the first number {np.argmax(wrong)}"
            said.append(f"{name}: {which}")
    part = parts(graph)
    if part.max():
        lost = np.flatnonzero(part != part[0])
        said.append(
            f"the graph has {part.max() + 1} parts: nothing ties {len(lost)} poses, such as {lost[0]}, to the first"
        )
    return said or [f"not settled after {int(solution.iterations)} steps: the poses are the best on the way"]


def parts(graph: Graph) -> np.ndarray:
    """Which part of the graph each pose is in, (N,) from 0, that of the first pose."""
    from scipy.sparse import coo_matrix, csgraph  # takes its time, and is needed here alone

    n = graph.poses
    chain = np.any(np.asarray(graph.odometry_information), axis=(1, 2))
    tied = np.any(np.asarray(graph.loop_information), axis=(1, 2))
    a, b = np.asarray(graph.pair)[tied].T
    k = np.flatnonzero(chain)
    ends = np.concatenate([k, a]), np.concatenate([k + 1, b])
    return csgraph.connected_components(coo_matrix((np.ones(len(ends[0])), ends), shape=(n, n)), directed=False)[1]
