"""Covariances of the poses of a graph, in a frame that is said."""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.graph import methods
from jaxlocmap.graph.factors import Graph, check, components, prepared
from jaxlocmap.graph.gauss_newton import system_at
from jaxlocmap.graph.loop_space import LoopSpace
from jaxlocmap.graph.solver import Solution
from jaxlocmap.graph.sparse import Sparse

Frame = Literal["pose", "body", "world"]
_FRAMES = ("body", "pose", "world")


def marginals(
    graph: Graph, solution: Solution, *, frame: Frame = "pose", fixed: int = 0, method: str | None = None
) -> jax.Array:
    """The covariance of every pose, given one of them.

        H⁻¹, H = Σ Mᵀ Omega M of odometry + Σ w Mᵀ Omega M of loops

    It is that of the measurements' own information: no factor is taken from the residuals.

    Args:
        graph: of N poses.
        solution: of `solve`; the loops count by its weights.
        frame: what the covariance is of, static:
            "pose": x, y and theta, that is, truth minus estimate in the world;
            "body": the twist in the robot's frame, X = X̂ Exp(delta), as GTSAM has it;
            "world": the twist in the world, X = Exp(xi) X̂.
        fixed: the pose that is given, static.
        method: as of `solve`.

    Returns:
        (N, 3, 3) m², m rad, rad²; zero for the pose that is given.

    Raises:
        ValueError: a wrong shape, an unknown frame or method.
    """
    check(graph)
    _check_frame(frame)
    if not 0 <= fixed < graph.poses:
        raise ValueError(f"fixed: expected a pose of 0 to {graph.poses - 1}, got {fixed}")
    return _marginals(graph, solution.poses, solution.weights, frame, fixed, methods.resolve(method, graph))


def relative_covariances(
    graph: Graph, solution: Solution, pair: jax.Array, *, frame: Frame = "pose", method: str | None = None
) -> jax.Array:
    """The covariance of poses b seen from poses a, A⁻¹ B.

    Args:
        graph, solution, method: as of `marginals`.
        pair: (K, 2) int32, a and b.
        frame: static: "pose": of x, y and theta of b in the frame of a; "body": of the twist in the frame of b;
            "world": of the difference of the two twists in the world, xi_b - xi_a.

    Returns:
        (K, 3, 3).

    Raises:
        ValueError: as `marginals`.
    """
    check(graph)
    _check_frame(frame)
    checks.shape("pair", pair, (None, 2))
    checks.dtype("pair", pair, np.integer)
    return _relative(graph, solution.poses, solution.weights, pair, frame, methods.resolve(method, graph))


def _check_frame(frame: str) -> None:
    if frame not in _FRAMES:
        raise ValueError(f"frame: expected one of {list(_FRAMES)}, got {frame!r}")


@functools.partial(jax.jit, static_argnames=("frame", "fixed", "method"))
def _marginals(graph: Graph, poses: jax.Array, weights: jax.Array, frame: str, fixed: int, method: str) -> jax.Array:
    system = _factorised(graph, poses, weights, method)
    every = jnp.arange(len(poses), dtype=jnp.int32)
    cov = system.covariances(jnp.stack([0 * every + fixed, every], axis=-1)) if fixed else system.marginals()
    heading = poses[:, 2] if frame == "body" else jnp.zeros_like(poses[:, 2])
    return cov if frame == "world" else _carried(cov, poses, heading)


@functools.partial(jax.jit, static_argnames=("frame", "method"))
def _relative(
    graph: Graph, poses: jax.Array, weights: jax.Array, pair: jax.Array, frame: str, method: str
) -> jax.Array:
    cov = _factorised(graph, poses, weights, method).covariances(pair)
    heading = poses[pair[:, 1 if frame == "body" else 0], 2]
    return cov if frame == "world" else _carried(cov, poses[pair[:, 1]], heading)


def _factorised(graph: Graph, poses: jax.Array, weights: jax.Array, method: str) -> LoopSpace | Sparse:
    system, *_ = system_at(prepared(graph), graph.pair, components(poses), lambda _: weights)
    return methods.factorised(system, method)


def _carried(cov: jax.Array, poses: jax.Array, heading: jax.Array) -> jax.Array:
    """Covariances of twists in the world as those of places and headings, in axes turned by a heading."""
    sin, cos = sin_cos(heading)
    x, y, _ = components(poses)
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    # R(heading)ᵀ (v + omega J t)
    T = jnp.stack(
        [
            jnp.stack([cos, sin, -cos * y + sin * x], axis=-1),
            jnp.stack([-sin, cos, sin * y + cos * x], axis=-1),
            jnp.stack([zero, zero, one], axis=-1),
        ],
        axis=-2,
    )
    return jnp.einsum("kij,kjl,kml->kim", T, cov, T)
