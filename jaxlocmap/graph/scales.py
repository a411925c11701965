"""How much too wide or too narrow the covariances of odometry and loops are: found by gradient through the solver."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, ldl, mahalanobis
from jaxlocmap.graph.covariance import marginals
from jaxlocmap.graph.factors import Graph, dead_reckoning
from jaxlocmap.graph.solver import solve
from jaxlocmap.se2 import POSE, boxminus

_FARTHEST = 5.0  # of the logarithm of a scale


class Scales(NamedTuple):
    """What standard deviations are to be multiplied by, dimensionless, > 0."""

    odometry: jax.Array  # ()
    loop: jax.Array  # ()


def scaled(graph: Graph, scales: Scales) -> Graph:
    """The same graph with covariances times scale²."""
    return graph._replace(
        odometry_information=graph.odometry_information / scales.odometry**2,
        loop_information=graph.loop_information / scales.loop**2,
    )


def pose_nll(graph: Graph, truth: jax.Array, known: jax.Array) -> jax.Array:
    """Negative log density of true poses under the marginals of a graph's most likely poses, their sum.

        Σ 1/2 [ eᵀ P⁻¹ e + log |P| ],  e = truth - pose

    Differentiable by measurements and information, and under `vmap`.

    Args:
        graph: of N poses; its loops are trusted.
        truth: (N, 3) m, m, rad; the first is given.
        known: (N,) bool: which of the others count.

    Returns:
        () nats, without the constant.

    Raises:
        ValueError: as `solve`; a wrong shape.
    """
    checks.shape("truth", truth, (graph.poses, POSE))
    checks.shape("known", known, (graph.poses,))
    solution = solve(graph, dead_reckoning(graph, truth[0]), method="loop_space")
    cov = marginals(graph, solution, method="loop_space")[1:]
    error = jax.vmap(boxminus)(truth[1:], solution.poses[1:])

    def one(error: jax.Array, cov: jax.Array) -> jax.Array:
        P = Matrix.symmetric(cov)
        return 0.5 * (mahalanobis(P, tuple(error)) + sum(jnp.log(d) for d in ldl(P)[1]))

    return jnp.sum(jnp.where(known[1:], jax.vmap(one)(error, cov), 0))


def _mean_nll(logs: jax.Array, graphs: Graph, truth: jax.Array, known: jax.Array) -> jax.Array:
    scales = Scales(*jnp.exp(logs))
    each = jax.vmap(lambda *one: pose_nll(scaled(one[0], scales), *one[1:]))(graphs, truth, known)
    return jnp.sum(each) / jnp.sum(known[:, 1:]).astype(each.dtype)


_slope = jax.jit(jax.value_and_grad(_mean_nll))


def tune_scales(graphs: Graph, truth: jax.Array, known: jax.Array | None = None) -> tuple[Scales, float, float]:
    """The scales at which the true poses of a batch of graphs are most likely.

    Args:
        graphs: of `stack`.
        truth: (B, N, 3) m, m, rad; the first pose of each is given.
        known: (B, N) bool: which count; all by default.

    Returns:
        The scales, and the mean of `pose_nll` over poses before (scales of one) and after, nats.

    Raises:
        ValueError: a wrong shape; poses that are not finite at scales of one.
    """
    from scipy import optimize  # takes its time, and is needed here alone

    known = jnp.ones(truth.shape[:2], bool) if known is None else known

    def value(logs: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slope = _slope(jnp.asarray(logs, truth.dtype), graphs, truth, known)
        return float(loss), np.asarray(slope, np.float64)

    start = np.zeros(len(Scales._fields))
    before = value(start)[0]
    if not np.isfinite(before):
        raise ValueError("graphs: expected finite poses and covariances at scales of one, got some that are not")
    bounds = [(-_FARTHEST, _FARTHEST)] * len(start)
    found = optimize.minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return Scales(*jnp.exp(jnp.asarray(found.x, truth.dtype))), before, float(found.fun)
