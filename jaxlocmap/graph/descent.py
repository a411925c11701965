"""From a start to a minimum.

Gauss-Newton without damping may let the objective rise at first, and so finds minima that damped methods do not; the
best poses on the way are kept, and where it does not settle the search goes on from them with steps that must descend.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap.graph import kernels
from jaxlocmap.graph.factors import Components, Graph, components, linearised, moved, prepared, squares
from jaxlocmap.graph.gauss_newton import Step, gauss_newton
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.se2 import POSE, wrap

_FREE = 20  # steps of Gauss-Newton that may go up
_SHORTEST = 1e-6  # of a step that must descend, as a share of Gauss-Newton's
_MU_GROWS = 1.4  # graduated non-convexity, every second step
_BINARY = 1e-3  # a weight this near to 0 or 1 is one
_MOST_MU = 1e6


class _Search(NamedTuple):
    poses: Components  # where to look next
    best: Components
    step: Step  # at the best
    length: jax.Array  # () of the last step that must descend
    iterations: jax.Array  # () int32
    converged: jax.Array  # () bool
    over: jax.Array  # () bool


class Found(NamedTuple):
    """Where a search ended."""

    poses: jax.Array
    iterations: jax.Array
    converged: jax.Array


def descend(
    graph: Graph, start: jax.Array, kernel: Kernel, weights: jax.Array, method: str, steps: int, tolerance: float
) -> Found:
    """The least objective from a start (N, 3), loops weighed by `weights` (L,) and the kernel."""
    edges, dtype = prepared(graph), start.dtype
    rounding = float(jnp.finfo(dtype).eps) ** (2 / 3)

    def turn(now: _Search) -> _Search:
        step = gauss_newton(edges, graph.pair, now.poses, kernel, weights, method)
        usable = jnp.isfinite(step.objective) & jnp.isfinite(step.decrease)
        better = usable & ~(step.objective >= now.step.objective)
        settled = usable & (step.decrease <= tolerance * (step.objective + rounding))
        # One that settles above the best has found another, worse optimum, unless it is the same to rounding.
        settled &= better | (step.objective <= now.step.objective * (1 + 10 * tolerance) + rounding)
        kept = better | settled
        best = jax.tree.map(lambda a, b: jnp.where(kept, a, b), (now.poses, step), (now.best, now.step))
        iterations = now.iterations + 1
        free = iterations < _FREE
        length = jnp.where(free | better, jnp.where(free, 1, jnp.minimum(2 * now.length, 1)), now.length / 2)
        ahead = moved(now.poses, step.twist)
        back = moved(best[0], best[1].twist, length)
        free &= usable
        poses = jax.tree.map(lambda a, b: jnp.where(free, a, b), ahead, back)
        poses = jax.tree.map(lambda a, b: jnp.where(settled, a, b), now.poses, poses)
        nothing = ~jnp.isfinite(best[1].objective) | (length < _SHORTEST)
        over = settled | nothing | (iterations >= steps)
        return _Search(poses, best[0], best[1], length, iterations, settled, over)

    zero, none = jnp.zeros_like(start[:, 0]), jnp.zeros((), bool)
    worst = jnp.full((), jnp.inf, dtype)
    first = components(start)
    begun = _Search(
        first, first, Step(worst, (zero,) * POSE, worst), jnp.ones((), dtype), jnp.zeros((), jnp.int32), none, none
    )
    end = jax.lax.while_loop(lambda now: ~now.over, turn, begun)
    # The step promised by the last linear system is worth taking: it costs nothing more.
    last = jax.tree.map(lambda a, b: jnp.where(end.converged, a, b), moved(end.best, end.step.twist), end.best)
    return Found(jnp.stack([last[0], last[1], wrap(last[2])], axis=-1), end.iterations, end.converged)


class _Graduation(NamedTuple):
    poses: Components
    weights: jax.Array
    mu: jax.Array
    iterations: jax.Array
    over: jax.Array


def graduated(
    graph: Graph, start: jax.Array, kernel: Kernel, method: str, steps: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Poses and weights, 0 or 1, by a truncated quadratic that begins convex."""
    edges = prepared(graph)
    quadratic = Kernel("quadratic")

    def turn(now: _Graduation) -> _Graduation:
        poses = now.poses
        square = squares(edges[1], linearised(*edges, graph.pair, poses)[1].error)
        weights = kernels.gnc_weight(square, now.mu, kernel.c)
        step = gauss_newton(edges, graph.pair, poses, quadratic, weights, method)
        poses = moved(poses, step.twist)
        step = gauss_newton(edges, graph.pair, poses, quadratic, weights, method)
        poses = moved(poses, step.twist)
        binary = jnp.all((weights < _BINARY) | (weights > 1 - _BINARY))
        over = binary | ~jnp.isfinite(step.objective) | (now.mu > _MOST_MU) | (now.iterations + 2 >= steps)
        return _Graduation(poses, weights, now.mu * _MU_GROWS, now.iterations + 2, over)

    first = components(start)
    square = squares(edges[1], linearised(*edges, graph.pair, first)[1].error)
    worst = jnp.max(square, initial=0)
    c2 = kernel.c**2
    all_good = ~(2 * worst > c2)
    mu = c2 / jnp.where(all_good, 1, 2 * worst - c2)
    begun = _Graduation(first, jnp.ones_like(square), mu, jnp.zeros((), jnp.int32), all_good | ~jnp.isfinite(worst))
    end = jax.lax.while_loop(lambda now: ~now.over, turn, begun)
    return jnp.stack(end.poses, axis=-1), jnp.round(end.weights), end.iterations
