"""How sure a tuning is: standard errors, correlations, and what the data cannot tell."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.tuning.batch import Batch
from jaxlocmap.tuning.fit import coordinates_objective
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import constrain, natural, unconstrain
from jaxlocmap.types import Params

_VAGUE = 1.0  # a standard error of the logarithm above this: not even the order of magnitude
_TIED = 0.95  # a correlation above this: only a combination is known


class Certainty(NamedTuple):
    """Of the tuned parameters, in the order of `names`. NumPy float64."""

    names: tuple[str, ...]
    estimate: np.ndarray  # (P,) in the units of `parameters.UNITS`
    standard_error: np.ndarray  # (P,) the same units; infinite where the data does not tell
    correlation: np.ndarray  # (P, P) of the estimates' errors
    hessian: np.ndarray  # (P, P) of the objective by the coordinates
    words: tuple[str, ...]  # what the data cannot tell


def certainty(objective: Objective, params: Params, batch: Batch, tuned: tuple[str, ...]) -> Certainty:
    """How far the parameters that minimise an objective would move with other data of the same kind.

        cov = H⁻¹ (Σ_n g_n g_nᵀ) H⁻¹ N / (N - 1)

    H is the Hessian of the objective by the coordinates, g_n the derivative of its gradient by the share of sequence
    n: the infinitesimal jackknife, which for a mean is the usual sandwich. It needs nothing but sequences that are
    independent of each other, so it holds for every loss and where the filter's model does not; for errors that are
    correlated in time make the windows longer than the correlation.

    Args:
        params: where the objective is at its minimum. batch: of at least two sequences, what it was tuned on.

    Raises:
        ValueError: fewer than two sequences, or nothing to tune.

    Source: Efron 1982, section 6; White 1982; Giordano et al. 2019.
    """
    n = len(batch.counted)
    if n < 2:
        raise ValueError(f"batch: expected at least two sequences to compare, got {n}; cut long ones into windows")
    at = coordinates_objective(objective, params, tuned)
    whole = unconstrain(params)
    theta = jnp.stack([whole[name] for name in tuned]).astype(jnp.asarray(batch.prior.mean).dtype)

    def named(theta: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(tuned, theta, strict=True))

    def total(theta: jax.Array, shares: jax.Array, batch: Batch) -> jax.Array:
        return at(named(theta), (batch, shares))[0]

    @jax.jit
    def derivatives(theta: jax.Array, shares: jax.Array, batch: Batch) -> tuple[jax.Array, ...]:
        hessian = jax.jacfwd(jax.grad(total))(theta, shares, batch)
        influence = jax.jacfwd(jax.grad(total, argnums=1))(theta, shares, batch)
        scale = jax.jacfwd(lambda x: jnp.stack([natural(constrain(whole | named(x)))[name] for name in tuned]))(theta)
        return hessian, influence, scale

    parts = derivatives(theta, jnp.ones(n, theta.dtype), batch)
    hessian, influence, scale = (np.asarray(x, np.float64) for x in parts)
    estimate = np.array([float(natural(params)[name]) for name in tuned])
    return _judge(tuned, estimate, 0.5 * (hessian + hessian.T), influence, scale)


def _judge(
    names: tuple[str, ...], estimate: np.ndarray, hessian: np.ndarray, influence: np.ndarray, scale: np.ndarray
) -> Certainty:
    n = len(influence)
    meat = influence.T @ influence * n / (n - 1)
    curvature, axes = np.linalg.eigh(hessian)
    # Along an axis of no curvature any value does as well; what lies along it has no error, or an infinite one.
    flat = curvature <= 1e-6 * np.max(np.abs(curvature), initial=1e-300)
    inverse = (axes[:, ~flat] / curvature[~flat]) @ axes[:, ~flat].T
    cov = inverse @ meat @ inverse
    lost = (np.abs(axes[:, flat]) > 0.1).any(axis=1)
    vague = lost | ~(np.sqrt(np.diag(cov)) < _VAGUE)
    natural_cov = scale @ cov @ scale.T
    error = np.sqrt(np.maximum(np.diag(natural_cov), 0))
    safe = np.where(error > 0, error, 1)
    correlation = natural_cov / np.outer(safe, safe)
    words = [_tied(names, axes[:, i]) for i in np.flatnonzero(flat)]
    words += [
        f"{name}: the data does not tell its order of magnitude (its logarithm has a standard error of "
        f"{np.sqrt(cov[i, i]):.2g})"
        for i, name in enumerate(names)
        if vague[i] and not lost[i]
    ]
    words += [
        f"{names[i]} and {names[j]}: known in combination, hardly apart (correlation {correlation[i, j]:+.3f})"
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _TIED and not (lost[i] or lost[j])
    ]
    return Certainty(names, estimate, np.where(lost, np.inf, error), correlation, hessian, tuple(words))


def _tied(names: tuple[str, ...], axis: np.ndarray) -> str:
    """What a direction without curvature means."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    up = [name for name, part in zip(names, axis, strict=True) if part > 0.1]
    down = [name for name, part in zip(names, axis, strict=True) if part < -0.1]
    if len(up) + len(down) == 1:
        return f"{up[0]}: the loss does not depend on it here"
    against = f" while {', '.join(down)} fall" if down else ""
    return f"{', '.join(up)} can grow together{against}: the loss does not change"


def as_report(certainty: Certainty) -> dict[str, Any]:
    """By name, ready for JSON."""
    return {
        "standard_errors": dict(zip(certainty.names, certainty.standard_error.tolist(), strict=True)),
        "correlation": certainty.correlation.tolist(),
        "not_identified": list(certainty.words),
    }
