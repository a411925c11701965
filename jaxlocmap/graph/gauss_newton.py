"""One step of Gauss-Newton: the errors of a graph made linear at some poses, and the system they give."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap._internal.linalg import Matrix, inverse
from jaxlocmap.graph import methods
from jaxlocmap.graph.factors import Components, Edges, Linear, linearised, root, squares
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.loop_space import System, Vectors
from jaxlocmap.se2 import POSE


def both(edges: tuple[Edges, Edges], pair: jax.Array, poses: Components) -> tuple[tuple[Edges, Linear], ...]:
    """Odometry and loops, each with its errors at some poses."""
    return tuple(zip(edges, linearised(*edges, pair, poses), strict=True))


class Step(NamedTuple):
    """Of Gauss-Newton, at some poses."""

    objective: jax.Array  # ()
    twist: Vectors  # towards the minimum
    decrease: jax.Array  # () of the objective, promised


def system_at(
    edges: tuple[Edges, Edges], pair: jax.Array, poses: Components, weight: Callable[[jax.Array], jax.Array]
) -> tuple[System, Vectors, jax.Array, jax.Array]:
    """The linear system of Gauss-Newton at some poses, the objective's slope by the twists, and the squares of odometry
    and loops; `weight` gives the weights of loops from their squares.
    """
    (chain, chain_at), (loops, loops_at) = both(edges, pair, poses)
    chain_squares, loop_squares = squares(chain, chain_at.error), squares(loops, loops_at.error)
    w = weight(loop_squares)
    M, (U, _) = chain_at.derivative, root(loops.information)
    omega_inverse, _ = inverted(chain.information)
    back = _inverse_derivative(M)
    system = System(
        information=M.T @ chain.information @ M,
        covariance=back @ omega_inverse @ back.T,
        pair=pair,
        after=(U @ loops_at.derivative).scale(jnp.sqrt(w)),
    )
    g = slope(edges, pair, (chain_at, loops_at), w)
    return system, g, chain_squares, loop_squares


def slope(edges: tuple[Edges, Edges], pair: jax.Array, at: tuple[Linear, Linear], w: jax.Array) -> Vectors:
    """Half the derivative of the objective by the twists, (N,) each, none of the first pose."""
    pulls = []
    for one, lin in zip(edges, at, strict=True):
        pull = lin.derivative.T @ one.information @ Matrix([[e] for e in lin.error])
        pulls.append(jnp.stack([row for (row,) in pull.rows], axis=-1))
    chain, loops = pulls[0], pulls[1] * w[:, None]
    g = jnp.zeros((len(chain) + 1, POSE), chain.dtype)
    g = g.at[1:].add(chain).at[:-1].add(-chain).at[pair[:, 1]].add(loops).at[pair[:, 0]].add(-loops)
    return tuple(g.at[0].set(0)[:, i] for i in range(POSE))


def inverted(information: Matrix) -> tuple[Matrix, jax.Array]:
    """Omega⁻¹, and whether Omega is positive definite."""
    U, good = root(information)
    for i in range(POSE):
        good &= U[i, i] > 0
    return inverse(information), good


def _inverse_derivative(M: Matrix) -> Matrix:
    """Of M = [[Rᵀ, Rᵀ J t], [0, 1]]: [[R, -J t], [0, 1]]."""
    cos, sin = M[0, 0], M[0, 1]
    u, v = M[0, 2], M[1, 2]
    return Matrix([[cos, -sin, sin * v - cos * u], [sin, cos, -sin * u - cos * v], [0, 0, 1]])


def gauss_newton(
    edges: tuple[Edges, Edges], pair: jax.Array, poses: Components, kernel: Kernel, weights: jax.Array, method: str
) -> Step:
    """A step from some poses, loops weighed by `weights` (L,) and the kernel."""
    system, g, chain, loops = system_at(edges, pair, poses, lambda s: weights * kernel.weight(s))
    twist = tuple(-x for x in methods.factorised(system, method).solve(g))
    decrease = -jnp.sum(jnp.stack(g) * jnp.stack(twist))
    return Step(jnp.sum(chain) + jnp.sum(weights * kernel.rho(loops)), twist, decrease)
