"""Pose graphs of simulated drives, without scans: what a back end alone makes of measurements whose noise is known."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxlocmap.graph.factors import Graph, dead_reckoning
from jaxlocmap.se2 import POSE, between, wrap

_STEP = 1.0  # m between two poses
_TURN = 0.3  # rad, standard deviation of the turn between them
_ODOMETRY = (0.02, 0.02, 0.005)  # m, m, rad, standard deviations
_LOOPS = (0.05, 0.05, 0.02)
_APART = 5  # poses, at least, between the two of a loop


def simulate_graph(key: jax.Array, *, poses: int = 100, loops: int = 10, false: int = 0) -> tuple[jax.Array, Graph]:
    """A random walk of steps of a metre, its odometry, and loops between random poses.

    Odometry errs by 2 cm along and across and by 0.005 rad a step, a loop by 5 cm and 0.02 rad, and the graph says so.

    Args:
        key: of this graph alone.
        poses: N, static; more than 5.
        loops: that are true, static.
        false: how many more are false, the last ones, static: each anywhere as far as the walk reaches.

    Returns:
        The true poses, (N, 3) m, m, rad, the first the origin, and the graph.

    Raises:
        ValueError: too few poses, or a negative number of loops.
    """
    if poses <= _APART or loops < 0 or false < 0:
        raise ValueError(f"poses, loops, false: expected > {_APART}, >= 0, >= 0, got {poses}, {loops}, {false}")
    turns, noise, ends, more, wrong = jax.random.split(key, 5)
    dtype, every = jnp.zeros(()).dtype, loops + false
    turn = _TURN * jax.random.normal(turns, (poses - 1,))
    steps = jnp.stack([jnp.full_like(turn, _STEP), jnp.zeros_like(turn), turn], axis=-1)
    draws = jax.random.normal(noise, (poses - 1 + every, POSE))

    first = jax.random.randint(ends, (every,), 0, poses - _APART)
    second = first + jax.random.randint(more, (every,), _APART, poses - first)
    pair = jnp.stack([first, second], axis=-1).astype(jnp.int32)

    def told(std: tuple[float, ...], count: int) -> jax.Array:
        return jnp.broadcast_to(jnp.diag(jnp.asarray(std, dtype) ** -2), (count, POSE, POSE))

    exact = Graph(steps, told(_ODOMETRY, poses - 1), pair, jnp.zeros((every, POSE)), told(_LOOPS, every))
    truth = dead_reckoning(exact)
    odometry = _disturbed(steps, draws[: poses - 1] * jnp.asarray(_ODOMETRY, dtype)[None])
    moved = jax.vmap(lambda a, b: between(a, b)[0])(truth[first], truth[second])
    loop = _disturbed(moved, draws[poses - 1 :] * jnp.asarray(_LOOPS, dtype)[None])
    reach = jnp.ptp(truth[:, :2], axis=0)
    scale = jnp.concatenate([reach, jnp.full((1,), jnp.pi, dtype)])
    anywhere = jax.random.uniform(wrong, (every, POSE), minval=-1, maxval=1) * scale[None]
    loop = jnp.where((jnp.arange(every) >= loops)[:, None], anywhere, loop)

    return truth, exact._replace(odometry=odometry, loop=loop)


def _disturbed(moved: jax.Array, error: jax.Array) -> jax.Array:
    """The measurements Z of relative poses X whose errors Z⁻¹ X are given: X E⁻¹."""
    theta = wrap(moved[:, 2] - error[:, 2])
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    x, y = error[:, 0], error[:, 1]
    return jnp.stack([moved[:, 0] - cos * x + sin * y, moved[:, 1] - sin * x - cos * y, theta], axis=-1)
