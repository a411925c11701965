"""Innovations of any filter: NIS, whiteness and gate."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxlocmap import checks
from jaxlocmap.consistency.means import average, mean_lag_one
from jaxlocmap.consistency.report import by_component
from jaxlocmap.consistency.statistics import chi2_band, whiten
from jaxlocmap.consistency.verdict import gate_verdict


class Innovations(NamedTuple):
    """What a filter made of its observations: N runs of T steps with M slots, observations of dimension m.

    The axis of runs may be left out, as may that of slots where a step has one observation at most.
    """

    innovation: ArrayLike  # (N, T, M, m) the observation minus what was expected of it
    S: ArrayLike  # (N, T, M, m, m) its covariance
    observed: ArrayLike | None = None  # (N, T, M) bool; by default where every number of both is finite
    accepted: ArrayLike | None = None  # (N, T, M) bool: the gate let it in
    landmark: ArrayLike | None = None  # (N, T, M) int: of which it is; by default that of its slot


def innovation_fields(given: Innovations, runs: int, steps: int, gate: float | None) -> dict[str, Any]:
    """The fields of a report that hold what is known of the innovations; arguments as of `judge`."""
    innovation, S = (np.asarray(x, np.float64) for x in (given.innovation, given.S))
    innovation, slots = _with_axes(innovation, S, runs, steps)
    size = innovation.shape[-1]
    S = S.reshape(*innovation.shape, size)
    finite = np.isfinite(innovation).all(-1) & np.isfinite(S).all((-1, -2))
    shape = runs, steps, slots
    observed = np.asarray(finite) if given.observed is None else _flags("observed", given.observed, shape)
    white = _whiten(innovation, S)
    scored: np.ndarray = (
        observed & finite & np.isfinite(white).all(-1) & (np.diagonal(S, axis1=-2, axis2=-1) > 0).all(-1)
    )
    nis = np.where(scored, np.sum(white**2, -1), np.nan)
    over_runs = average(nis.reshape(runs, -1), size)
    count = scored.sum((0, 2))
    total = np.nansum(nis, axis=(0, 2))
    report: dict[str, Any] = {
        "observations": int(observed.sum()),
        "unscored_observations": int(np.sum(observed & ~scored)),
        "nis_mean": over_runs.value,
        "nis_degrees": size,
        "nis_standard_error": over_runs.standard_error,
        "nis_band_95": over_runs.band_95,
        "nis_per_step": [float(t / n) if n else None for t, n in zip(total, count, strict=True)],
        "nis_chi2_band_95": [chi2_band(size, int(n)) if n else None for n in count],
        **_whiteness(white, scored, given.landmark),
    }
    if given.accepted is None:
        return report
    accepted = _flags("accepted", given.accepted, shape) & observed
    share = float(accepted.sum() / observed.sum()) if observed.any() else math.nan
    streak = max(_longest_refusal(observed[run], accepted[run]) for run in range(runs))
    return report | {
        "gate_accept_rate": share,
        "gate_nominal_rate": gate,
        "longest_rejection": streak,
        "gate_verdict": gate_verdict(share, gate, int(observed.sum()), streak),
    }


def _with_axes(innovation: np.ndarray, S: np.ndarray, runs: int, steps: int) -> tuple[np.ndarray, int]:
    """Innovations as (N, T, M, m), and M."""
    if S.shape != (*innovation.shape, innovation.shape[-1] if innovation.ndim else 0):
        raise ValueError(f"S: expected shape (..., m, m) for innovations {innovation.shape}, got {S.shape}")
    size = innovation.shape[-1]
    slots = innovation.size // max(runs * steps * size, 1)
    fits = [(runs, steps, slots, size), (runs, steps, size)]
    if runs == 1:
        fits += [shape[1:] for shape in fits]
    if innovation.shape not in fits:
        raise ValueError(f"innovation: expected shape ({runs}, {steps}, slots, m), got {innovation.shape}")
    return innovation.reshape(runs, steps, slots, size), slots


def _flags(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(value)
    checks.dtype(name, value, np.bool_)
    if value.size != math.prod(shape):
        raise ValueError(f"{name}: expected shape {shape}, got {value.shape}")
    return value.reshape(shape)


def _whiten(innovation: np.ndarray, S: np.ndarray) -> np.ndarray:
    size = innovation.shape[-1]
    with jax.enable_x64(True):
        flat = _whiten_all(innovation.reshape(-1, size), S.reshape(-1, size, size))
        return np.asarray(flat).reshape(innovation.shape)


@jax.jit
def _whiten_all(innovation: jax.Array, S: jax.Array) -> jax.Array:
    return jax.vmap(whiten)(innovation, S)


def _whiteness(white: np.ndarray, scored: np.ndarray, landmark: ArrayLike | None) -> dict[str, Any]:
    """Correlation of each whitened innovation with the one before it of the same landmark, and its band.

    Nothing but zero is expected where no gate and no detector chooses by what is measured.
    """
    runs, _, slots, size = white.shape
    of = np.broadcast_to(np.arange(slots), scored.shape) if landmark is None else np.asarray(landmark)
    if of.size != scored.size:
        raise ValueError(f"landmark: expected shape {scored.shape}, got {of.shape}")
    of = of.reshape(scored.shape)
    correlations, pairs = [], 0
    for run in range(runs):
        step, slot = np.nonzero(scored[run])
        order = np.lexsort((step, of[run, step, slot]))
        values, ids = white[run, step, slot][order], of[run, step, slot][order]
        same = ids[1:] == ids[:-1]
        if same.any():
            before, after = values[:-1][same], values[1:][same]
            squares = np.sum(before**2 + after**2, axis=0)
            correlations.append(2 * np.sum(before * after, axis=0) / np.where(squares > 0, squares, 1))
            pairs += int(same.sum())
    each = np.reshape(correlations, (-1, size))
    correlation, reach = mean_lag_one(each.sum(0), np.square(each).sum(0), len(each), pairs)
    return {
        "innovation_lag_one": by_component(correlation),
        "innovation_lag_one_band_95": by_component(reach),
    }


def _longest_refusal(observed: np.ndarray, accepted: np.ndarray) -> int:
    """The longest streak of observations of a run that the gate refused one after the other."""
    taken = np.flatnonzero(accepted[observed])
    edges = np.concatenate([[-1], taken, [int(observed.sum())]])
    return int(np.max(np.diff(edges)) - 1)
