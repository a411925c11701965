"""How sure a tuning is: standard errors, correlations, and what the data cannot tell."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special
from jax.flatten_util import ravel_pytree

from jaxlocmap.parameters import Block, Params
from jaxlocmap.tuning.batch import Batch, in_dtype_of
from jaxlocmap.tuning.losses import Objective
from jaxlocmap.tuning.parameters import BLOCKS, correlations_of, natural, unconstrain
from jaxlocmap.tuning.slopes import Evaluation, evaluate, params_at
from jaxlocmap.types import Config

_STEP = 1e-2  # of a coordinate, a logarithm: wide enough for what a gate lets in to change evenly
_ROUGH = "the gate decides, so the gradient jumps: standard errors are rough, with gate_temperature they are not"
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
    finds the map that those before it have made.

    H is made of differences of exact gradients, a hundredth of a coordinate to either side, by the program that a fit
    has compiled; where the gradient is smooth, that is good to some 1e-4 of it. A gate that decides makes the gradient
    jump at every observation that it comes to refuse: H is then rough, and the words say so; with
    `Config.gate_temperature` there are no jumps. The bounds of a map's log-odds make kinks, which are part of H.

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
    params = in_dtype_of(batch, params)
    whole = unconstrain(params, blocks)
    at = {name: whole[name] for name in tuned}
    here = evaluate(objective, at, params, batch)

    def gradient(name: str, step: float) -> np.ndarray:
        moved = at | {name: at[name] + jnp.asarray(step, at[name].dtype)}
        return _in_order(evaluate(objective, moved, params, batch).gradient, tuned)

    hessian = np.stack([(gradient(name, _STEP) - gradient(name, -_STEP)) / (2 * _STEP) for name in tuned])
    estimate, scale = (np.asarray(x, np.float64) for x in _in_units(blocks, tuned, params, batch))
    sure = _judge(
        tuned,
        estimate,
        _in_order(here.gradient, tuned),
        0.5 * (hessian + hessian.T),
        _influence(objective, here, tuned),
        scale,
        blocks,
    )
    return sure._replace(words=(*sure.words, _ROUGH)) if _jumps(objective.config, here) else sure


def _jumps(config: Config, here: Evaluation) -> bool:
    """Whether the gradient jumps where the gate comes to refuse an observation."""
    gated = here.accepted is not None and np.any(here.accepted > 0) and config.gate_probability is not None
    return bool(gated and not config.gate_temperature)


def _influence(objective: Objective, here: Evaluation, tuned: tuple[str, ...]) -> np.ndarray:
    """The derivative of the gradient by how much each sequence counts, (N, P)."""
    each = np.stack(jax.tree.leaves(here.sums), axis=1).astype(np.float64)  # (N, K): what sequence n adds to tally k
    of_tally = jax.tree.map(
        lambda _, slopes: np.stack([slopes[name] for name in tuned], axis=1), here.sums, here.slopes
    )
    slope = np.stack(jax.tree.leaves(of_tally), axis=1).astype(np.float64)  # (N, K, P)
    weight, bend = (np.asarray(x, np.float64) for x in _by_tallies(objective, jax.tree.map(np.sum, here.sums)))
    return np.einsum("k,nki->ni", weight, slope) + np.einsum("kl,nl,ki->ni", bend, each, slope.sum(axis=0))


@functools.partial(jax.jit, static_argnums=0)
def _by_tallies(objective: Objective, sums: Any) -> tuple[jax.Array, jax.Array]:
    """Gradient (K,) and Hessian (K, K) of the objective by what its tallies add up to."""
    flat, unravel = ravel_pytree(sums)

    def total(flat: jax.Array) -> jax.Array:
        return objective.value(unravel(flat))[0]

    return jax.grad(total)(flat), jax.hessian(total)(flat)


def _in_order(values: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray:
    return np.array([values[name] for name in names], np.float64)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _in_units(
    blocks: tuple[Block, ...], tuned: tuple[str, ...], params: Params, batch: Batch
) -> tuple[jax.Array, jax.Array]:
    """The tuned parameters in their units, (P,), and their derivatives by the coordinates, (P, P)."""
    whole = unconstrain(params, blocks)

    def of_coordinates(theta: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = params_at(blocks, dict(zip(tuned, theta, strict=True)), params, batch)
        values = jnp.stack([natural(at, blocks)[name] for name in tuned])
        return values, values

    scale, values = jax.jacfwd(of_coordinates, has_aux=True)(jnp.stack([whole[name] for name in tuned]))
    return values, scale


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
