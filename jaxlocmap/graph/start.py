"""A start for the solvers: headings first, then places."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap._internal.trig import arctan2, sin_cos
from jaxlocmap.graph import methods
from jaxlocmap.graph.factors import Graph, check, dead_reckoning, root, walked
from jaxlocmap.graph.loop_space import System, minus_loops
from jaxlocmap.graph.prefix import prefix_sum
from jaxlocmap.se2 import POSE, wrap


def chordal(graph: Graph, first: jax.Array | None = None, *, method: str | None = None) -> jax.Array:
    """Poses from two linear least squares: of the headings as complex numbers c that need not have length 1,

        Σ kappa |c_b - exp(i theta_z) c_a|²

    kappa the information of the heading, and then of the places with those headings. No start is needed, and no
    dead reckoning is trusted; false loops pull at it like any others.

    Args:
        graph: of N poses.
        first: (3,) m, m, rad, the first of them; the origin by default.
        method: how the linear systems are solved, as of `solve`.

    Returns:
        (N, 3); those of `dead_reckoning` where the graph does not tie all poses together.

    Source: Martinec & Pajdla 2007 (headings as chords); Carlone, Tron, Daniilidis & Dellaert 2015.

    Raises:
        ValueError: a wrong shape or an unknown method.
    """
    check(graph)
    first = jnp.zeros(POSE, graph.odometry.dtype) if first is None else first
    checks.shape("first", first, (POSE,))
    return _chordal(graph, first, methods.resolve(method, graph))


@functools.partial(jax.jit, static_argnames="method")
def _chordal(graph: Graph, first: jax.Array, method: str) -> jax.Array:
    found = _places(graph, _headings(graph, first, method), first, method)
    return jnp.where(jnp.all(jnp.isfinite(found)), found, dead_reckoning(graph, first))


def _headings(graph: Graph, first: jax.Array, method: str) -> jax.Array:
    """Each heading turned back by its odometry is d, so that odometry links are differences of d; d_0 = 1."""
    theta = first[2] + prefix_sum(graph.odometry[:, 2])
    a, b = graph.pair.T
    sin, cos = sin_cos(theta[a] + graph.loop[:, 2] - theta[b])
    length = jnp.sqrt(jnp.maximum(graph.loop_information[:, 2, 2], 0))
    kappa = graph.odometry_information[:, 2, 2]
    system = System(
        information=Matrix([[kappa, 0], [0, kappa]]),
        covariance=Matrix([[1 / kappa, 0], [0, 1 / kappa]]),
        pair=graph.pair,
        after=Matrix([[length, 0], [0, length]]),
        before=Matrix([[-length * cos, length * sin], [-length * sin, -length * cos]]),
    )
    residual = length * (1 - cos), -length * sin
    delta = _least_squares(system, residual, method)
    return theta + arctan2(delta[1], 1 + delta[0])


def _places(graph: Graph, theta: jax.Array, first: jax.Array, method: str) -> jax.Array:
    """The places from which, headings given, the errors are linear."""
    x, y = walked(theta, graph.odometry, first)
    a, b = graph.pair.T
    omega = graph.odometry_information
    sin, cos = sin_cos(theta[:-1] + graph.odometry[:, 2])
    R = Matrix([[cos, -sin], [sin, cos]])
    information = R @ Matrix([[omega[:, 0, 0], omega[:, 0, 1]], [omega[:, 0, 1], omega[:, 1, 1]]]) @ R.T
    determinant = information[0, 0] * information[1, 1] - information[0, 1] * information[1, 0]
    adjugate = Matrix([[information[1, 1], -information[0, 1]], [-information[1, 0], information[0, 0]]])
    omega = graph.loop_information
    U, _ = root(Matrix([[omega[:, 0, 0], omega[:, 0, 1]], [omega[:, 0, 1], omega[:, 1, 1]]]))
    sin, cos = sin_cos(theta[a] + graph.loop[:, 2])
    after = U @ Matrix([[cos, sin], [-sin, cos]])
    sin, cos = sin_cos(graph.loop[:, 2])
    measured = U @ Matrix([[cos, sin], [-sin, cos]]) @ Matrix([[graph.loop[:, 0]], [graph.loop[:, 1]]])
    residual = after @ Matrix([[x[b] - x[a]], [y[b] - y[a]]]) - measured
    system = System(information, adjugate.scale(1 / determinant), graph.pair, after)
    dx, dy = _least_squares(system, (residual[0, 0], residual[1, 0]), method)
    return jnp.stack([x + dx, y + dy, wrap(theta)], axis=-1)


def _least_squares(system: System, residual: tuple[jax.Array, ...], method: str) -> tuple[jax.Array, ...]:
    """The minimum over x of the system's chain at zero and its loops at residuals, r of (L,)."""
    zero = jnp.zeros(len(system.information[0, 0]) + 1, residual[0].dtype)
    slope = minus_loops(system, residual, (zero,) * system.after.shape[1])
    return methods.factorised(system, method).solve(slope)
