"""Scoring of matched scans while a simulated run goes on, and what many runs say of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import consistency
from jaxlocmap.consistency import statistics
from jaxlocmap.matching.submaps import MatchReport, Refusals, refusals
from jaxlocmap.se2 import POSE, between
from jaxlocmap.types import Gaussian, Matcher


class Relative(NamedTuple):
    """Of poses relative to another; sums over one run."""

    scored: jax.Array  # ()
    nees: jax.Array  # ()
    error_square: jax.Array  # (3,) m², m², rad²
    variance: jax.Array  # (3,) the same of the filter's own


class MatchTally(NamedTuple):
    """What a run adds up of its matches; at one step, of that step."""

    tried: jax.Array  # ()
    accepted: jax.Array  # ()
    nis: jax.Array  # ()
    used: jax.Array  # () share of the points that lay on lines
    refused: Refusals  # () each, by reason; several may hold at once
    anew: jax.Array  # () times that the submaps began anew, the first beginning not counted
    pose: Relative  # relative to the anchor of the submap matched on, after the match
    edge: Relative  # between the anchors of finished submaps


class MatchTotals(NamedTuple):
    """What a run adds to a study."""

    sums: MatchTally
    runs: jax.Array  # (2,) runs with a pose scored, with an edge scored
    nees: jax.Array  # (2,) the run's average of either
    nees_square: jax.Array  # (2,) their squares


def no_matches(dtype: Any) -> MatchTally:
    """The tally before the first match."""
    zero, each = jnp.zeros((), dtype), jnp.zeros(POSE, dtype)
    none = Relative(zero, zero, each, each)
    return MatchTally(zero, zero, zero, zero, Refusals(zero, zero, zero, zero), zero, none, none)


def score_match(
    report: MatchReport, truth: jax.Array, anchors: tuple[jax.Array, jax.Array], matcher: Matcher
) -> tuple[MatchTally, tuple[jax.Array, jax.Array]]:
    """The tally of one step.

    Args:
        report: of the step.
        truth: (3,) the true pose after the step.
        anchors: (3,) each, where the robot really was when the older and the younger submap began.
        matcher: that made the report, static.

    Returns:
        The tally, and the anchors after the step.
    """
    dtype = truth.dtype
    tried = report.tried.astype(dtype)
    tally = MatchTally(
        tried=tried,
        accepted=report.accepted.astype(dtype),
        nis=report.nis,
        used=tried * report.used.astype(dtype) / jnp.maximum(report.points, 1).astype(dtype),
        refused=Refusals(*(reason.astype(dtype) for reason in refusals(report, matcher))),
        anew=(report.anew & (report.submap >= 0)).astype(dtype),
        pose=_relative(anchors[0], truth, report.relative, report.tried),
        edge=_relative(*anchors, report.edge, report.finished),
    )
    older = jnp.where(report.finished, anchors[1], anchors[0])
    older = jnp.where(report.anew, truth, older)
    return tally, (older, jnp.where(report.begun, truth, anchors[1]))


def _relative(a: jax.Array, b: jax.Array, belief: Gaussian, counts: jax.Array) -> Relative:
    exact, _, _ = between(a, b)
    score = statistics.score_pose(exact, *belief)
    counted = counts & score.scored

    def kept(values: tuple[jax.Array, ...]) -> jax.Array:
        return jnp.stack([jnp.where(counted, value, 0) for value in values])

    nees = jnp.where(counted, score.nees, 0)
    return Relative(counted.astype(nees.dtype), nees, kept(score.error_square), kept(score.variance))


def match_totals(sums: MatchTally) -> MatchTotals:
    """What a run adds to a study."""
    both = (sums.pose, sums.edge)
    average = jnp.stack([one.nees / jnp.maximum(one.scored, 1) for one in both])
    scored = jnp.stack([(one.scored > 0).astype(average.dtype) for one in both])
    return MatchTotals(sums, scored, average, average**2)


def match_fields(totals: Any) -> dict[str, Any]:
    """What the matches of a study say, by name, ready for JSON.

    Those refused are counted by reason (`submaps.Refusals`), of which several may hold at once. A scan with too few
    points is not matched at all, so it is none of the `matches`.

    Args:
        totals: `MatchTotals` of NumPy arrays, summed over runs.
    """
    sums = totals.sums
    tried = float(sums.tried)
    some = max(tried, 1)
    fields: dict[str, Any] = {
        "matches": round(tried),
        "match_accept_rate": float(sums.accepted) / some,
        "match_nis_mean": float(sums.nis) / some,
        "match_points_used": float(sums.used) / some,
        **{f"match_refused_{reason}": round(float(count)) for reason, count in sums.refused._asdict().items()},
        "submaps_begun_anew": round(float(sums.anew)),
    }
    for i, (name, one) in enumerate((("relative", sums.pose), ("edge", sums.edge))):
        runs = round(float(totals.runs[i]))
        mean = consistency.mean_over_runs(float(totals.nees[i]), float(totals.nees_square[i]), runs, POSE)
        count = max(float(one.scored), 1)
        rms, sigma = (np.sqrt(np.asarray(x, float) / count) for x in (one.error_square, one.variance))
        fields |= {
            f"{name}_anees": mean.value,
            f"{name}_anees_band_95": mean.band_95,
            f"{name}_count": round(float(one.scored)),
            f"{name}_rmse_position_m": float(np.hypot(rms[0], rms[1])),
            f"{name}_sigma_position_m": float(np.hypot(sigma[0], sigma[1])),
            f"{name}_rmse_yaw_rad": float(rms[2]),
            f"{name}_sigma_yaw_rad": float(sigma[2]),
        }
    return fields
