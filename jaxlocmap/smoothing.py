"""A filter's beliefs corrected by what came after: the whole log as one chain of poses, solved backwards."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxlocmap import checks, motion
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap.parameters import Params
from jaxlocmap.se2 import boxminus, wrap_entries
from jaxlocmap.step import predict
from jaxlocmap.types import Config, Gaussian, Inputs


def smooth(params: Params, filtered: Gaussian, inputs: Inputs, *, config: Config) -> Gaussian:
    """The beliefs about every step given all observations, from those of the filter given the ones so far.

        C = P Fᵀ (P⁻)⁺,  x ← x + C (x_next - x⁻),  P ← P + C (P_next - P⁻) Cᵀ

    x⁻, P⁻ are predicted from the filter's belief to the next step, x_next, P_next smoothed there. It is the solution of
    the chain of steps with its observations as factors, linearised where the filter was: one step of Gauss-Newton. An
    observation that the gate refused stays out. A belief that the step before cannot move into, because that step is
    known exactly in some direction, is left in it, by the pseudo-inverse.

    Args:
        params: those of the filter.
        filtered: (T, n), (T, n, n) after each step's corrections, as `Info.belief` of `run` without a matcher.
        inputs: of the run, (T, ...).
        config: of the run, static.

    Returns:
        (T, n), (T, n, n). The last is the filter's.

    Source: Rauch, Tung & Striebel 1965; Särkkä 2013, section 9.1 (extended).

    Raises:
        ValueError: a wrong shape, or beliefs of a filter that matches scans.
    """
    model = motion.resolve(config.motion)
    n = model.dim
    if config.matcher is not None:
        raise ValueError("config.matcher: expected None: beliefs of a filter that matches scans are not smoothed")
    checks.shapes(mean=(filtered.mean, (None, n)), cov=(filtered.cov, (len(filtered.mean), n, n)))
    checks.shapes(dt=(inputs.dt, (len(filtered.mean),)))

    def body(later: Gaussian, now: tuple[Gaussian, jax.Array, jax.Array]) -> tuple[Gaussian, Gaussian]:
        belief, control, dt = now
        predicted, usable = predict(params, belief, control, dt, config=config)
        u = model.full_input(jnp.where(usable, control, 0))
        F, _ = model.jacobians(belief.mean, u, jnp.where(usable, dt, 0))
        F = F.array(belief.cov.dtype) if isinstance(F, Matrix) else F
        F = jnp.where(usable, F, jnp.eye(n, dtype=F.dtype))
        C = belief.cov @ F.T @ jnp.linalg.pinv(predicted.cov, hermitian=True)
        mean = belief.mean + C @ boxminus(later.mean, predicted.mean, model.angles)
        cov = belief.cov + C @ (later.cov - predicted.cov) @ C.T
        smoothed = Gaussian(wrap_entries(mean, model.angles), (cov + cov.T) / 2)
        return smoothed, smoothed

    last = jax.tree.map(lambda x: x[-1], filtered)
    before = jax.tree.map(lambda x: x[:-1], filtered)
    _, smoothed = jax.lax.scan(body, last, (before, inputs.control[1:], inputs.dt[1:]), reverse=True)
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), smoothed, last)
