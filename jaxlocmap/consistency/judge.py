"""The whole report for poses and covariances of any filter: arrays in, a verdict out."""

from __future__ import annotations

import itertools
import math
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxlocmap import checks
from jaxlocmap.consistency.innovations import Innovations, innovation_fields
from jaxlocmap.consistency.means import Mean, average, run_averages, student_t
from jaxlocmap.consistency.report import PoseMeans, pose_fields, share_in_band
from jaxlocmap.consistency.statistics import (
    COVERAGE_LEVELS,
    WITHIN_TWO_SIGMA,
    PoseScore,
    chi2_band,
    chi2_quantile,
    score_pose,
)
from jaxlocmap.consistency.verdict import Basis, verdict
from jaxlocmap.se2 import POSE

_PHASES = 10  # equal parts of a drive
_SYMMETRIC = 1e-6  # of √(variance · variance): entries of a covariance may differ from their mirror images by so much


def judge(
    truth: ArrayLike,
    mean: ArrayLike,
    cov: ArrayLike,
    *,
    time: ArrayLike | None = None,
    valid: ArrayLike | None = None,
    pose: tuple[int, int, int] = (0, 1, 2),
    innovations: Innovations | None = None,
    gate_probability: float | None = None,
) -> dict[str, Any]:
    """Can the covariance of a filter be believed? N runs of T steps, or one run without the axis of runs.

    Args:
        truth: (N, T, 3) or (T, 3) m, m, rad; or as long as `mean`, of which `pose` then chooses too.
        mean: (N, T, n) or (T, n), the estimate, n >= 3.
        cov: (N, T, n, n) or (T, n, n), its covariance.
        time: (T,) s, for the words and figures; the steps' numbers by default. A step that is missing in every run may
            share its stamp with the next.
        valid: (N, T) or (T,) bool, False where a step is missing; those that are not finite are missing too.
        pose: which entries of the state are x, y and the heading.
        innovations: for NIS, whiteness and gate; none by default.
        gate_probability: the share of good observations the gate is to let in; None: no gate.

    Returns:
        The fields of the report of `jaxlocmap study`, ready for JSON: ANEES with its band, NEES over time,
        in ten equal phases and of each axis, coverage of the 50, 90, 95 and 99 % ellipsoids, shares within ±2σ,
        each with its 95 % interval, and `verdict`. Of many runs the bands come from the spread between them; of one run
        from the correlation time of its values, and `independent_samples` says how many independent ones it is worth.
        `dishonest` lists the phases outside their bands. `counts` says what was left out.

    Raises:
        ValueError: shapes that do not belong together, an entry of `pose` that is none, or stamps that do not increase.

    Source: Bar-Shalom, Li & Kirubarajan 2001, section 5.4.
    """
    truth, mean, cov, valid = _poses(truth, mean, cov, valid, pose)
    runs, steps = valid.shape
    stamps = np.arange(steps, dtype=float) if time is None else np.asarray(time, np.float64)
    checks.shape("time", stamps, (steps,))
    later = np.diff(stamps) > 0
    if not np.all(later | ((np.diff(stamps) == 0) & ~valid[:, :-1].any(0))):
        raise ValueError(f"time: expected increasing stamps, got {np.sum(~later)} that do not")

    known = valid & np.isfinite(truth).all(-1)
    finite = known & np.isfinite(mean).all(-1) & np.isfinite(cov).all((-1, -2))
    symmetric = _is_symmetric(cov)
    score = _score(truth, mean, cov)
    scored = finite & symmetric & score.scored
    counts = {
        "missing": int(np.sum(~valid)),
        "not_finite": int(np.sum(valid & ~finite)),
        "not_symmetric": int(np.sum(finite & ~symmetric)),
        "not_positive_definite": int(np.sum(finite & symmetric & ~score.scored)),
    }
    nees = np.where(scored, score.nees, np.nan)
    axis = np.where(scored[..., None], np.stack(score.axis_nees, -1), np.nan)
    diverged = _diverged(known, scored, np.asarray(score.diverged))
    means, spans = _means(nees, axis, diverged, stamps)
    runs_judged = int(known.any(1).sum())
    basis = Basis(
        runs=runs_judged,
        steps=int(scored.sum()),
        diverged=int(diverged.sum()) if runs_judged > 1 else 0,
        gate=gate_probability is not None,
    )
    square, variance = (
        np.where(scored[..., None], np.stack(x, -1), np.nan) for x in (score.error_square, score.variance)
    )
    per_step = _over_runs(nees)
    band = chi2_band(POSE, max(basis.runs, 1))
    rms = np.sqrt(_over_all(square))
    report = {
        "runs": runs,
        "steps": steps,
        "time": stamps.tolist(),
        "scored_steps": basis.steps,
        "counts": counts,
        **pose_fields(means),
        "anees_median_run": float(np.median(run_averages(nees))) if basis.steps else math.nan,
        "nees_median": float(np.nanmedian(nees)) if basis.steps else math.nan,
        "nees_per_step": per_step.tolist(),
        "nees_band_95": band,
        **share_in_band(per_step[scored.any(0)], band),
        "rmse_per_step": np.sqrt(_over_runs(square)).tolist(),
        "sigma_per_step": np.sqrt(_over_runs(variance)).tolist(),
        "rmse_position_m": float(np.hypot(rms[0], rms[1])),
        "rmse_yaw_rad": float(rms[2]),
        "diverged_runs": int(diverged.sum()),
        "dishonest": _dishonest(means, truth, scored, spans, stamps),
        "verdict": verdict(means, basis),
    }
    if innovations is not None:
        report |= innovation_fields(innovations, runs, steps, gate_probability)
    return report


def _poses(truth: Any, mean: Any, cov: Any, valid: Any, pose: tuple[int, int, int]) -> tuple[np.ndarray, ...]:
    """Truth and mean (N, T, 3), cov (N, T, 3, 3) and valid (N, T), float64."""
    truth, mean, cov = (np.asarray(x, np.float64) for x in (truth, mean, cov))
    if mean.ndim not in (2, 3):
        raise ValueError(f"mean: expected shape (runs, steps, n) or (steps, n), got {mean.shape}")
    if mean.ndim == 2:
        truth, mean, cov = truth[None], mean[None], cov[None]
        valid = None if valid is None else np.asarray(valid)[None]
    runs, steps, size = mean.shape
    if len(pose) != POSE or len(set(pose)) != POSE or not all(0 <= i < size for i in pose):
        raise ValueError(f"pose: expected three different entries of a state of {size}, got {pose}")
    checks.shape("cov", cov, (runs, steps, size, size))
    if truth.shape != (runs, steps, POSE):
        checks.shape("truth", truth, (runs, steps, size))
        truth = truth[..., list(pose)]
    valid = np.ones((runs, steps), bool) if valid is None else np.asarray(valid)
    checks.shape("valid", valid, (runs, steps))
    checks.dtype("valid", valid, np.bool_)
    if not steps or not runs:
        raise ValueError(f"mean: expected at least one step, got shape {mean.shape}")
    rows = np.array(pose)
    return truth, mean[..., rows], cov[..., rows[:, None], rows[None]], valid


def _is_symmetric(cov: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
        apart = np.abs(cov - np.swapaxes(cov, -1, -2))
        return np.all(apart <= _SYMMETRIC * sigma[..., :, None] * sigma[..., None, :], axis=(-1, -2))


def _score(truth: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> PoseScore:
    """`score_pose` of every step of every run, in float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _score_all(truth, mean, cov))


@jax.jit
def _score_all(truth: jax.Array, mean: jax.Array, cov: jax.Array) -> PoseScore:
    return jax.vmap(jax.vmap(score_pose))(truth, mean, cov)


def _diverged(known: np.ndarray, scored: np.ndarray, diverged: np.ndarray) -> np.ndarray:
    """Runs (N,) that diverged at any step, or whose belief at their last step with truth is none."""
    last = known.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    ended = scored[np.arange(len(known)), last]
    return np.any(diverged & scored, axis=1) | (known.any(1) & ~ended)


def _over_runs(values: np.ndarray) -> np.ndarray:
    """Mean over runs (T, ...) of values (N, T, ...), NaN where there is none."""
    count = np.sum(np.isfinite(values), axis=0)
    return np.where(count > 0, np.nansum(values, axis=0) / np.maximum(count, 1), np.nan)


def _over_all(values: np.ndarray) -> np.ndarray:
    known = np.isfinite(values).all(-1)
    return np.mean(values[known], axis=0) if known.any() else np.full(values.shape[-1], np.nan)


def _means(nees: np.ndarray, axis: np.ndarray, diverged: np.ndarray, time: np.ndarray) -> tuple[PoseMeans, list[slice]]:
    known = np.isfinite(nees)

    def shares(inside: np.ndarray, expected: float) -> Mean:
        return average(np.where(known, inside, np.nan), expected, expected * (1 - expected))

    steps = nees.shape[1]
    edges = np.unique(np.arange(_PHASES + 1) * steps // _PHASES)
    spans = [slice(int(a), int(b)) for a, b in itertools.pairwise(edges)]
    whole = average(nees, POSE)
    # One run is judged as it is; so are many that have all diverged.
    kept = ~diverged if len(nees) > 1 and not diverged.all() else slice(None)
    means = PoseMeans(
        nees=whole,
        undiverged_nees=average(nees[kept], POSE),
        axis_nees=tuple(average(axis[kept, :, i], 1) for i in range(POSE)),
        within_two_sigma=tuple(shares(axis[..., i] <= 4, WITHIN_TWO_SIGMA) for i in range(POSE)),
        covered=tuple(shares(nees < chi2_quantile(level, POSE), level) for level in COVERAGE_LEVELS),
        phases=tuple(_phase(nees[kept], span, whole) for span in spans),
        phase_spans=tuple((float(time[span.start]), float(time[span.stop - 1])) for span in spans),
    )
    return means, spans


def _phase(nees: np.ndarray, span: slice, whole: Mean) -> Mean:
    """A part of the drive. That of a single run is too short to tell its own correlation time: it takes the run's."""
    part = average(nees[:, span], POSE)
    if len(nees) > 1 or not part.samples:
        return part
    count, all_steps = np.isfinite(nees[0, span]).sum(), np.isfinite(nees).sum()
    samples = max(whole.samples * count / all_steps, 1.0)
    reach = student_t(samples) * math.sqrt(2 * POSE / samples)
    error = float(np.nanstd(nees[0, span])) / math.sqrt(samples)
    return Mean(part.value, error, samples, (POSE - reach, POSE + reach))


def _dishonest(
    means: PoseMeans, truth: np.ndarray, scored: np.ndarray, spans: list[slice], time: np.ndarray
) -> list[dict[str, Any]]:
    """When and where: the phases whose NEES lies outside their bands, widened because there are several of them."""
    found = []
    for phase, span in zip(means.phases, spans, strict=True):
        widened = student_t(phase.samples, 1 - 0.05 / len(spans)) / student_t(phase.samples)
        reach = widened * (phase.band_95[1] - phase.band_95[0]) / 2
        if not abs(phase.value - POSE) > reach:
            continue
        here = truth[:, span][scored[:, span]]
        found.append(
            {
                "from_s": float(time[span.start]),
                "to_s": float(time[span.stop - 1]),
                "anees": phase.value,
                "side": "over-confident" if phase.value > POSE else "under-confident",
                "x_m": [float(here[:, 0].min()), float(here[:, 0].max())],
                "y_m": [float(here[:, 1].min()), float(here[:, 1].max())],
            }
        )
    return found
