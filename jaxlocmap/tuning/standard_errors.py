"""How sure a tuning is: standard errors, correlations, and what the data cannot tell."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from jaxlocmap.parameters import Block, Params
from jaxlocmap.tuning.batch import Batch
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import BLOCKS, constrain, correlations_of, natural, unconstrain

_VAGUE = 1.0  # a standard error of a coordinate above this is said in words
_TIED = 0.95  # a correlation above this: only a combination is known
_FLAT = 1e-4  # of the largest curvature: none
_PART = 0.1  # of a direction's unit length: a parameter that has a part in it
_FEW = 20  # sequences: from fewer, standard errors come out too small


class StandardErrors(NamedTuple):
    """Of the tuned parameters, in the order of `names`. NumPy float64."""

    names: tuple[str, ...]
    estimate: np.ndarray  # (P,) in the units of `parameters.UNITS`
    standard_error: np.ndarray  # (P,) the same units; infinite where the data does not tell
    interval_95: np.ndarray  # (P, 2) from and to, the same units
    correlation: np.ndarray  # (P, P) of the estimates' errors
    hessian: np.ndarray  # (P, P) of the objective by the coordinates
    words: tuple[str, ...]  # what the data cannot tell


def standard_errors(objective: Objective, params: Params, batch: Batch, tuned: tuple[str, ...]) -> StandardErrors:
    """How far the parameters that minimise an objective would move with other data of the same kind.

        cov = H⁻¹ (Σ_n g_n g_nᵀ) H⁻¹ N / (N - 1)

    H is the Hessian of the objective by the coordinates, g_n the derivative of its gradient by how much sequence n
    counts: the infinitesimal jackknife, which for a mean is the usual sandwich. It needs nothing but sequences that are
    independent of each other, so it holds for every loss and where the filter's model does not; for errors that are
    correlated in time make the windows longer than the correlation. The blocks of one map are not independent: each
    finds the map that those before it have made. The Hessian leaves out the kinks at the bounds of a map's log-odds.

    An interval reaches as many standard errors as Student's t with N - 1 degrees says; along the logarithm, so that no
    standard deviation comes out negative, but for correlations, which it keeps within ±1. From fewer than 20 sequences
    standard errors tend to be too small all the same, and the words say so.

    Args:
        params: where the objective is at its minimum; where it is not, the words say so.
        batch: of at least two sequences, what it was tuned on.
        tuned: which parameters.

    Raises:
        ValueError: fewer than two sequences, nothing to tune, or more than the losses tell (`Objective.check_tuned`).

    Source: Efron 1982, section 6; White 1982; Giordano et al. 2019.
    """
    n = len(batch.counted)
    if n < 2:
        raise ValueError(f"batch: expected at least two sequences to compare, got {n}; cut long ones into windows")
    objective.check_tuned(tuned)
    blocks = objective.blocks
    derivatives = _derivatives(objective, tuned, params, batch)
    gradient, hessian, influence, scale = (np.asarray(x, np.float64) for x in derivatives)
    estimate = np.array([float(natural(params, blocks)[name]) for name in tuned])
    return _judge(tuned, estimate, gradient, 0.5 * (hessian + hessian.T), influence, scale, blocks)


@functools.partial(jax.jit, static_argnames=("objective", "tuned"))
def _derivatives(
    objective: Objective, tuned: tuple[str, ...], params: Params, batch: Batch
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Of the objective by the coordinates: gradient (P,), Hessian (P, P), and each sequence's influence on the gradient
    (N, P); and of the parameters in their units by the coordinates (P, P).
    """
    whole = unconstrain(params, objective.blocks)
    theta = jnp.stack([whole[name] for name in tuned]).astype(jnp.asarray(batch.prior.mean).dtype)

    def at(theta: jax.Array) -> Params:
        return constrain(whole | dict(zip(tuned, theta, strict=True)), objective.blocks, others=params)

    def tallied(theta: jax.Array) -> tuple[jax.Array, dict[str, tuple[jax.Array, ...]]]:
        sums, _ = objective.tallies(at(theta), batch)
        return jnp.stack(jax.tree.leaves(sums), axis=-1), sums

    def first(theta: jax.Array) -> tuple[jax.Array, tuple[jax.Array, dict[str, tuple[jax.Array, ...]]]]:
        slope, sums = jax.jacfwd(tallied, has_aux=True)(theta)
        return jnp.sum(slope, axis=0), (slope, sums)

    # n: sequences, k, l: what they add up, i, j: coordinates
    second_of_sum, (slope, tallies) = jax.jacfwd(first, has_aux=True)(theta)
    leaves, form = jax.tree.flatten(tallies)
    each = jnp.stack(leaves, axis=-1)

    def total(sums: jax.Array) -> jax.Array:
        return objective.value(jax.tree.unflatten(form, list(sums)))[0]

    sums, slope_of_sum = jnp.sum(each, axis=0), jnp.sum(slope, axis=0)
    weight, bend = jax.grad(total)(sums), jax.hessian(total)(sums)
    hessian = jnp.einsum("k,kij->ij", weight, second_of_sum)
    hessian = hessian + jnp.einsum("kl,ki,lj->ij", bend, slope_of_sum, slope_of_sum)
    influence = jnp.einsum("k,nki->ni", weight, slope) + jnp.einsum("kl,nl,ki->ni", bend, each, slope_of_sum)
    scale = jax.jacfwd(lambda x: jnp.stack([natural(at(x), objective.blocks)[name] for name in tuned]))(theta)
    return jnp.einsum("k,ki->i", weight, slope_of_sum), hessian, influence, scale


def _judge(
    names: tuple[str, ...],
    estimate: np.ndarray,
    gradient: np.ndarray,
    hessian: np.ndarray,
    influence: np.ndarray,
    scale: np.ndarray,
    blocks: tuple[Block, ...] = BLOCKS,
) -> StandardErrors:
    n = len(influence)
    meat = influence.T @ influence * n / (n - 1)
    curvature, axes = np.linalg.eigh(hessian)
    # Along an axis of no curvature any value does as well; what lies along it has no error, or an infinite one.
    steep = np.max(np.abs(curvature), initial=1e-300)
    bent, flat = curvature > _FLAT * steep, np.abs(curvature) <= _FLAT * steep
    inverse = (axes[:, bent] / curvature[bent]) @ axes[:, bent].T
    cov = inverse @ meat @ inverse
    lost: np.ndarray = np.any(np.abs(axes[:, ~bent]) > _PART, axis=1)
    natural_cov = scale @ cov @ scale.T
    error = np.sqrt(np.maximum(np.diag(natural_cov), 0))
    safe = np.where(error > 0, error, 1)
    correlation = natural_cov / np.outer(safe, safe)
    to_go = np.abs(inverse @ gradient)  # a Newton step
    words = [_tied(names, axes[:, i]) for i in np.flatnonzero(flat)]
    words += [
        f"{_together(names, axes[:, i])}: no minimum, the loss falls further along here"
        for i in np.flatnonzero(~bent & ~flat)
    ]
    for i, name in enumerate(names):
        if lost[i]:
            continue
        own = np.sqrt(cov[i, i])
        if own > _VAGUE:
            words.append(f"{name}: known to no more than a factor of {np.exp(min(own, 99.0)):.2g} (one standard error)")
        if to_go[i] > own:
            words.append(f"{name}: not yet at its minimum, some {to_go[i] / own:.2g} standard errors away")
    words += [
        f"{names[i]} and {names[j]}: known in combination, hardly apart (correlation {correlation[i, j]:+.3f})"
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _TIED and not (lost[i] or lost[j])
    ]
    if n < _FEW:
        vague = 100 / np.sqrt(2 * (n - 1))
        words.append(f"{n} sequences are few: standard errors are known to some {vague:.0f} %, and come out too small")
    error = np.where(lost, np.inf, error)
    return StandardErrors(
        names, estimate, error, _interval(names, estimate, error, n, blocks), correlation, hessian, tuple(words)
    )


def _interval(
    names: tuple[str, ...], estimate: np.ndarray, error: np.ndarray, n: int, blocks: tuple[Block, ...]
) -> np.ndarray:
    """What holds the value in 95 of 100 tunings, (P, 2), from n sequences."""
    reach = scipy.special.stdtrit(n - 1, 0.975) * error
    ends, correlations = [], correlations_of(blocks)
    real = [block.name for block in blocks if block.kind == "real"]
    for name, value, far in zip(names, estimate, reach, strict=True):
        if name in correlations:
            ends.append((max(value - far, -1.0), min(value + far, 1.0)))
        elif name in real:
            ends.append((value - far, value + far))
        else:
            factor = np.exp(far / abs(value))
            ends.append(sorted((value / factor, value * factor)))
    return np.array(ends)


def _tied(names: tuple[str, ...], axis: np.ndarray) -> str:
    """What a direction without curvature means."""
    if np.sum(np.abs(axis) > _PART) == 1:
        return f"{names[np.argmax(np.abs(axis))]}: the loss does not depend on it here"
    return f"{_together(names, axis)}: the loss stays the same"


def _together(names: tuple[str, ...], axis: np.ndarray) -> str:
    """A direction in words."""
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    up = [name for name, part in zip(names, axis, strict=True) if part > _PART]
    down = [name for name, part in zip(names, axis, strict=True) if part < -_PART]
    together = " can change together" if len(up) + len(down) > 1 else ""
    return ", ".join(up) + together + (f" against {', '.join(down)}" if down else "")
