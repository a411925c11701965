"""Derivatives of the optimum by what it depends on, from the equation that it solves."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jaxlocmap.graph import methods
from jaxlocmap.graph.factors import Components, Graph, components, linearised, prepared, squares
from jaxlocmap.graph.gauss_newton import slope, system_at
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.loop_space import Vectors
from jaxlocmap.se2 import POSE

_REFINEMENTS = 20  # of a linear solve with second derivatives, by conjugate gradients


def at_optimum(
    graph: Graph, first: jax.Array, optimum: jax.Array, kernel: Kernel, weights: jax.Array, method: str
) -> jax.Array:
    """The optimum, with its derivatives."""

    def half_slope(rest: jax.Array) -> jax.Array:
        poses = components(jnp.concatenate([first[None], rest]))
        edges = prepared(graph)
        at = linearised(*edges, graph.pair, poses)
        w = weights * kernel.weight(squares(edges[1], at[1].error))
        return from_twists(slope(edges, graph.pair, at, w), poses)

    def from_twists(g: Vectors, poses: Components) -> jax.Array:
        """A slope by twists as one by (x, y, theta)."""
        x, y, _ = poses
        return jnp.stack([g[0], g[1], g[2] + y * g[0] - x * g[1]], axis=-1)[1:]

    def tangent(matrix: Any, b: jax.Array) -> jax.Array:
        """Solve with the whole second derivative, by conjugate gradients; that of Gauss-Newton comes near."""
        poses = components(jax.lax.stop_gradient(optimum))
        still, robust, share = jax.lax.stop_gradient((graph, kernel, weights))
        system, *_ = system_at(prepared(still), graph.pair, poses, lambda s: share * robust.weight(s))
        near = methods.factorised(system, method)

        def nearly(v: jax.Array) -> jax.Array:
            v = jnp.concatenate([jnp.zeros((1, POSE), v.dtype), v])
            x, y, _ = poses
            turn = v[:, 2] - y * v[:, 0] + x * v[:, 1]
            vx, vy, omega = near.solve((v[:, 0], v[:, 1], turn))
            return jnp.stack([vx - omega * y, vy + omega * x, omega], axis=-1)[1:]

        def conjugate(matvec: Any, b: jax.Array) -> jax.Array:
            x, _ = jax.scipy.sparse.linalg.cg(matvec, b, tol=1e-10, maxiter=_REFINEMENTS, M=nearly)
            return x

        return jax.lax.custom_linear_solve(matrix, b, conjugate, symmetric=True)

    rest = jax.lax.custom_root(half_slope, optimum[1:], lambda _, x: x, tangent)
    return jnp.concatenate([first[None], rest])
