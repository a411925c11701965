"""What the totals of a study say: the report of many simulated runs."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from jaxlocmap import consistency, sensors
from jaxlocmap.consistency.match_scoring import match_fields
from jaxlocmap.consistency.scoring import NEES_EDGES, PHASES, MapTotals, phase_edges
from jaxlocmap.se2 import POSE
from jaxlocmap.types import Config


def _mean_over_runs(
    total: np.ndarray, square: np.ndarray, runs: np.ndarray, expected: float, variance: float | None = None
) -> consistency.Mean:
    return consistency.mean_over_runs(float(total), float(square), round(float(runs)), expected, variance)


def pose_means(totals: Any, config: Config) -> consistency.PoseMeans:
    """The means over runs of the pose's statistics; arguments as of `summarise`."""
    runs, sums, squares = totals.scored_runs, totals.average, totals.average_square
    kept, kept_squares = totals.undiverged, totals.undiverged_square

    def shares(total: np.ndarray, square: np.ndarray, expected: float) -> consistency.Mean:
        return _mean_over_runs(total, square, runs, expected, expected * (1 - expected))

    axes, levels = range(POSE), consistency.COVERAGE_LEVELS
    steps = len(totals.nees)
    edges = phase_edges(steps)
    return consistency.PoseMeans(
        nees=_mean_over_runs(sums.nees, squares.nees, runs, POSE),
        undiverged_nees=_mean_over_runs(kept.nees, kept_squares.nees, totals.undiverged_runs, POSE),
        axis_nees=tuple(
            _mean_over_runs(kept.axis_nees[i], kept_squares.axis_nees[i], totals.undiverged_runs, 1) for i in axes
        ),
        within_two_sigma=tuple(
            shares(sums.within_two_sigma[i], squares.within_two_sigma[i], consistency.WITHIN_TWO_SIGMA) for i in axes
        ),
        covered=tuple(shares(sums.covered[i], squares.covered[i], level) for i, level in enumerate(levels)),
        phases=tuple(
            _mean_over_runs(kept.phase_nees[i], kept_squares.phase_nees[i], totals.whole_runs, POSE)
            for i in range(PHASES)
        ),
        phase_spans=tuple((config.dt * (a + 1), config.dt * b) for a, b in itertools.pairwise(edges)),
    )


def median_nees(bins: np.ndarray) -> float:
    """Median of the runs' average NEES from `Totals.nees_bins`, to a few per cent of itself; NaN without a run."""
    below = np.cumsum(bins)
    if not below[-1] > 0:
        return math.nan
    half = below[-1] / 2
    i = int(np.argmax(below >= half))
    if i in (0, len(bins) - 1):
        return float(NEES_EDGES[0] if i == 0 else math.inf)
    share = (half - below[i - 1]) / bins[i]
    return float(NEES_EDGES[i - 1] * (NEES_EDGES[i] / NEES_EDGES[i - 1]) ** share)


def summarise(totals: Any, config: Config, reference: Any = None) -> dict[str, Any]:
    """Judge the totals of a study.

    Args:
        totals: `Totals` of NumPy arrays, summed over runs.
        config: the filter's.
        reference: `Totals` of a study, of other random numbers, whose filter is told the robot's own noise, from the
            same start and behind the same gate (`reference_study`). What it shows takes the place of 3 in the verdict:
            an exact start and a gate move the ANEES of an honest filter too. None: 3 is expected.

    Returns:
        The statistics by name, ready for JSON. The lag-one value of "bearing" is that of the bearing given the range,
        since innovations are whitened in that order; zero is expected of it without a gate. `anees_band_95` comes from
        the spread between runs around 3; `nees_band_95` is the χ² band of one step's mean over runs, and
        `nees_steps_in_band` the share of steps in it. `axis_nees` and `nees_phases` are those of undiverged
        runs: a single lost one would outweigh all others.
    """
    runs = round(float(totals.runs))
    steps = len(totals.nees)
    scored = np.where(totals.scored > 0, totals.scored, np.nan)
    all_scored = float(totals.scored.sum())
    observations = round(float(totals.observed.sum()))
    means = pose_means(totals, config)
    sensor = sensors.resolve(config.sensor)
    nis = _mean_over_runs(totals.run_nis[0], totals.run_nis[1], totals.observing_runs, sensor.dim)
    per_step = totals.nees / scored
    band = consistency.chi2_band(POSE, runs)
    error_square, variance = np.stack(totals.error_square, -1), np.stack(totals.variance, -1)
    rms = np.sqrt(error_square.sum(0) / max(all_scored, 1))
    rate = float(totals.accepted.sum()) / observations if observations else math.nan
    lag, lag_reach = consistency.mean_lag_one(
        totals.lag_one[0], totals.lag_one[1], round(float(totals.lag_runs)), float(totals.lag_pairs)
    )
    diverged = round(float(totals.diverged))
    observing = totals.observed > 0
    basis = consistency.Basis(
        runs=runs,
        steps=round(all_scored),
        diverged=diverged,
        exact_start=bool(totals.exact_starts > 0),
        gate=config.gate_probability is not None,
        reference=None if reference is None else pose_means(reference, config),
        reference_diverged=(0, 0)
        if reference is None
        else (round(float(reference.diverged)), round(float(reference.runs))),
    )
    report = {
        "runs": runs,
        "steps": steps,
        **consistency.pose_fields(means),
        "anees_undiverged": means.undiverged_nees.value,
        "anees_undiverged_interval_95": means.undiverged_nees.interval_95,
        "anees_median_run": median_nees(totals.nees_bins),
        "anees_reference": None if basis.reference is None else basis.reference.nees.value,
        "exact_start": basis.exact_start,
        "nis_mean": nis.value,
        "nis_standard_error": nis.standard_error,
        "nis_band_95": nis.band_95,
        "nees_per_step": per_step.tolist(),
        "nees_band_95": band,
        **consistency.share_in_band(per_step[totals.scored > 0], band),
        "nis_per_step": [
            float(total / count) if count else None for total, count in zip(totals.nis, totals.observed, strict=True)
        ],
        "nis_chi2_band_95": [
            consistency.chi2_band(sensor.dim, round(float(count))) if count else None for count in totals.observed
        ],
        "rmse_per_step": np.sqrt(error_square / scored[:, None]).tolist(),
        "sigma_per_step": np.sqrt(variance / scored[:, None]).tolist(),
        "rmse_position_m": float(np.hypot(rms[0], rms[1])),
        "rmse_yaw_rad": float(rms[2]),
        "observations": observations,
        "observing_steps": int(observing.sum()),
        "gate_accept_rate": rate,
        "gate_nominal_rate": config.gate_probability,
        "gate_verdict": consistency.gate_verdict(rate, config.gate_probability, observations),
        "innovation_lag_one": consistency.by_component(lag, sensor.noise.components),
        "innovation_lag_one_band_95": consistency.by_component(lag_reach, sensor.noise.components),
        "diverged_runs": diverged,
        "unscored_observations": round(float(totals.unscored_observations)),
        "unscored_steps": round(runs * steps - all_scored),
        "flagged_steps": round(float(totals.flagged_steps)),
        "verdict": consistency.verdict(means, basis),
    }
    if totals.state is not None:
        report |= _state_fields(totals.state)
    if totals.match is not None:
        report |= match_fields(totals.match)
    if totals.map is not None:
        report["map"] = _map_fields(totals.map, runs)
    return report


def _state_fields(totals: Any) -> dict[str, Any]:
    dim = round(float(totals.entries / np.maximum(totals.scored_runs, 1)))
    nees = _mean_over_runs(totals.nees, totals.nees_square, totals.scored_runs, dim)
    return {"state_dimension": dim, "state_anees": nees.value, "state_anees_band_95": nees.band_95}


def _map_fields(totals: MapTotals, runs: int) -> dict[str, Any]:
    cells, mapped = totals.cells, bool(totals.scored)
    some = np.maximum(cells, 1)
    base_rate = float(totals.occupied.sum() / cells.sum()) if mapped else math.nan
    return {
        "entropy_bits": float(totals.entropy_bits) / runs,
        "brier": float(totals.brier / totals.scored) if mapped else math.nan,
        # What a map scores that knows how many of the seen cells are occupied, but not which.
        "brier_base_rate": base_rate * (1 - base_rate),
        "calibration_error": float(np.abs(totals.probability - totals.occupied).sum() / cells.sum())
        if mapped
        else math.nan,
        "calibration_cells": (cells / runs).tolist(),
        "calibration_probability": np.where(cells > 0, totals.probability / some, 0).tolist(),
        "calibration_frequency": np.where(cells > 0, totals.occupied / some, 0).tolist(),
    }
