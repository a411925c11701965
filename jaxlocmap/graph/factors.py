"""What a pose graph is: N poses, odometry from each to the next, loops between any two; errors and their derivatives.

Poses are moved by twists in the world, X <- Exp(xi) X with xi = (v, omega): to first order t <- t + v + omega J t and
theta <- theta + omega, J = [[0, -1], [1, 0]]. Then the error of a relative pose changes with the difference of two
twists alone, whichever poses they are of,

    de = M (xi_b - xi_a),  M = [[R^T, R^T J t_b], [0, 1]],  R = R(theta_a + theta_z)

so that the matrix of the normal equations is a Laplacian, its weights matrices.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, quadratic_form
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.graph.prefix import prefix_sum
from jaxlocmap.se2 import POSE, wrap

Components = tuple[jax.Array, jax.Array, jax.Array]  # x, y, theta of many poses, (K,) each


class Graph(NamedTuple):
    """Relative poses between N poses: a chain of odometry, and L loops. The first pose is the frame of all.

    A relative pose z from a to b has the error e = (Z⁻¹ A⁻¹ B) as (x, y, theta), theta wrapped, as in g2o, and the
    information Omega of that error. Information of zeros makes it no measurement: a link that is missing, a loop that
    only fills up an array.
    """

    odometry: jax.Array  # (N - 1, 3) m, m, rad: pose k + 1 seen from pose k
    odometry_information: jax.Array  # (N - 1, 3, 3) 1/m², 1/(m rad), 1/rad²
    pair: jax.Array  # (L, 2) int32: a loop goes from the first to the second
    loop: jax.Array  # (L, 3) m, m, rad
    loop_information: jax.Array  # (L, 3, 3)

    @property
    def poses(self) -> int:
        """How many there are."""
        return self.odometry.shape[-2] + 1

    @property
    def loops(self) -> int:
        """How many there are, those that only fill up included."""
        return self.pair.shape[-2]


class Edges(NamedTuple):
    """What of relative poses does not change while poses are moved. K of them."""

    theta: jax.Array  # (K,) rad
    back: tuple[jax.Array, jax.Array]  # (K,) m each: R(theta)ᵀ t
    information: Matrix  # 3x3 of (K,)


class Linear(NamedTuple):
    """Errors of relative poses and their derivative by the twist of the second, at some poses. K of them."""

    error: Components
    derivative: Matrix  # 3x3 of (K,); that by the twist of the first is its negative


def check(graph: Graph) -> None:
    """Raise unless the arrays of a graph fit each other.

    Raises:
        ValueError: a wrong shape; a pair that is no pair of poses of the graph.
        TypeError: pairs that are no whole numbers.
    """
    n, loops = len(graph.odometry), len(graph.pair)
    checks.shapes(
        odometry=(graph.odometry, (None, POSE)),
        odometry_information=(graph.odometry_information, (n, POSE, POSE)),
        pair=(graph.pair, (loops, 2)),
        loop=(graph.loop, (loops, POSE)),
        loop_information=(graph.loop_information, (loops, POSE, POSE)),
    )
    checks.dtype("pair", graph.pair, np.integer)
    if checks.is_concrete(graph.pair):
        pair = np.asarray(graph.pair)
        wrong = np.flatnonzero(np.any((pair < 0) | (pair > n), axis=1) | (pair[:, 0] == pair[:, 1]))
        if len(wrong):
            raise ValueError(
                f"pair: expected two different poses of 0 to {n}, got {pair[wrong[0]].tolist()} at loop {wrong[0]}"
            )


def stack(graphs: Sequence[Graph]) -> Graph:
    """Graphs as one with a leading axis, for `vmap`; those with fewer poses or loops are filled up: with poses in one
    place after the last, and with loops without information.

    Raises:
        ValueError: no graph, or a wrong shape in one.
    """
    if not graphs:
        raise ValueError("graphs: expected at least one, got none")
    for graph in graphs:
        check(graph)
    n, loops = max(len(graph.odometry) for graph in graphs), max(len(graph.pair) for graph in graphs)

    def filled(x: jax.Array, size: int, value: Any) -> jax.Array:
        return jnp.concatenate([x, jnp.broadcast_to(jnp.asarray(value, x.dtype), (size - len(x), *x.shape[1:]))])

    parts = []
    for graph in graphs:
        parts.append(
            Graph(
                filled(graph.odometry, n, np.zeros(POSE)),
                filled(graph.odometry_information, n, np.eye(POSE)),
                filled(graph.pair, loops, [0, 1]),
                filled(graph.loop, loops, np.zeros(POSE)),
                filled(graph.loop_information, loops, np.zeros((POSE, POSE))),
            )
        )
    return Graph(*(jnp.stack(field) for field in zip(*parts, strict=True)))


def dead_reckoning(graph: Graph, first: jax.Array | None = None) -> jax.Array:
    """The poses by odometry alone, (N, 3).

    Args:
        graph: of N poses.
        first: (3,) m, m, rad, the first of them; the origin by default.
    """
    check(graph)
    first = jnp.zeros(POSE, graph.odometry.dtype) if first is None else first
    theta = first[2] + prefix_sum(graph.odometry[:, 2])
    x, y = walked(theta, graph.odometry, first)
    return jnp.stack([x, y, wrap(theta)], axis=-1)


def walked(theta: jax.Array, odometry: jax.Array, first: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The places, (N,) m each, that odometry leads to with given headings (N,)."""
    sin, cos = sin_cos(theta[:-1])
    dx, dy = odometry[:, 0], odometry[:, 1]
    return first[0] + prefix_sum(cos * dx - sin * dy), first[1] + prefix_sum(sin * dx + cos * dy)


def errors(graph: Graph, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The errors of odometry, (N - 1, 3), and of loops, (L, 3), m, m, rad.

        e = Z⁻¹ A⁻¹ B = (R(theta_a + theta_z)ᵀ (t_b - t_a) - R(theta_z)ᵀ t_z, theta_b - theta_a - theta_z)

    Args:
        graph: of N poses.
        poses: (N, 3) m, m, rad.

    Source: Kümmerle, Grisetti, Strasdat, Konolige & Burgard 2011 (g2o).
    """
    check(graph)
    checks.shape("poses", poses, (len(graph.odometry) + 1, POSE))
    chain, loops = linearised(*prepared(graph), graph.pair, components(poses))
    return jnp.stack(chain.error, axis=-1), jnp.stack(loops.error, axis=-1)


def chi2(graph: Graph, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """eᵀ Omega e of odometry, (N - 1,), and of loops, (L,). Arguments as of `errors`."""
    check(graph)
    checks.shape("poses", poses, (len(graph.odometry) + 1, POSE))
    edges = prepared(graph)
    linear = linearised(*edges, graph.pair, components(poses))
    chain, loops = (squares(e, lin.error) for e, lin in zip(edges, linear, strict=True))
    return chain, loops


def components(poses: jax.Array) -> Components:
    """Poses (K, 3) as x, y and theta, (K,) each."""
    return poses[:, 0], poses[:, 1], poses[:, 2]


def prepared(graph: Graph) -> tuple[Edges, Edges]:
    """Odometry and loops, ready to be linearised."""
    both = []
    for moved, information in (
        (graph.odometry, graph.odometry_information),
        (graph.loop, graph.loop_information),
    ):
        x, y, theta = components(moved)
        sin, cos = sin_cos(theta)
        omega = Matrix([[information[:, min(i, j), max(i, j)] for j in range(POSE)] for i in range(POSE)])
        both.append(Edges(theta, (cos * x + sin * y, cos * y - sin * x), omega))
    return both[0], both[1]


def linearised(chain: Edges, loops: Edges, pair: jax.Array, poses: Components) -> tuple[Linear, Linear]:
    """Odometry and loops at some poses."""
    before, after = tuple(p[:-1] for p in poses), tuple(p[1:] for p in poses)
    first, second = (tuple(p[pair[:, end]] for p in poses) for end in (0, 1))
    return _linear(chain, before, after), _linear(loops, first, second)


def _linear(edges: Edges, a: tuple[jax.Array, ...], b: tuple[jax.Array, ...]) -> Linear:
    sin, cos = sin_cos(a[2] + edges.theta)
    dx, dy = b[0] - a[0], b[1] - a[1]
    error = (
        cos * dx + sin * dy - edges.back[0],
        cos * dy - sin * dx - edges.back[1],
        wrap(b[2] - a[2] - edges.theta),
    )
    derivative = Matrix(
        [[cos, sin, sin * b[0] - cos * b[1]], [-sin, cos, cos * b[0] + sin * b[1]], [0, 0, jnp.ones_like(sin)]]
    )
    return Linear(error, derivative)


def squares(edges: Edges, error: Components) -> jax.Array:
    """eᵀ Omega e, (K,)."""
    row = Matrix([error])
    return quadratic_form(row, edges.information)[0, 0]


def moved(poses: Components, twist: tuple[jax.Array, ...], length: jax.Array | float = 1) -> Components:
    """Poses moved by twists in the world, times a length: t + v + omega J t, theta + omega."""
    x, y, theta = poses
    vx, vy, omega = (length * part for part in twist)
    return x + vx - omega * y, y + vy + omega * x, theta + omega


def root(information: Matrix) -> tuple[Matrix, jax.Array]:
    """U with Uᵀ U = Omega, upper triangular, for a positive semi-definite Omega; and (K,) bool, whether it is one.

    A pivot that rounding makes negative is taken for zero.
    """
    n = information.shape[0]
    eps = 64 * jnp.finfo(information[0, 0].dtype).eps
    diagonal = [information[i, i] for i in range(n)]
    rows = [list(row) for row in information.rows]
    U: list[list[Any]] = [[0] * n for _ in range(n)]
    good = jnp.isfinite(functools.reduce(jnp.add, diagonal))
    for j in range(n):
        pivot = rows[j][j]
        some = pivot > eps * diagonal[j]
        per = jnp.where(some, jax.lax.rsqrt(jnp.where(some, pivot, 1)), 0)
        good &= pivot >= -eps * diagonal[j]
        for k in range(j, n):
            U[j][k] = rows[j][k] * per
        for i in range(j + 1, n):
            # A pivot of zero has a row of zeros.
            good &= some | (rows[j][i] ** 2 <= eps**2 * jnp.abs(diagonal[i] * diagonal[j]))
            for k in range(i, n):
                rows[i][k] = rows[i][k] - U[j][i] * U[j][k]
    return Matrix(U), good
