"""A consistency study: one simulated run scored against its truth, and the totals of many judged.

totals = monte_carlo(Study(scenario, config), key, runs, params, world, noise, prior).value
report = summarise(totals, config)
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import consistency, grid, simulate
from jaxlocmap.pipeline import init, run
from jaxlocmap.types import Config, Gaussian, Info, Params, State

# A run has lost the robot where it is further off than this, and all but excludes that itself. The second half spares
# a filter that has seen nothing for long and says so.
_LOST_DISTANCE = 1.0  # m
_LOST_NEES = consistency.chi2_quantile(1 - 1e-6, consistency.POSE_DIMENSION)


class MapTotals(NamedTuple):
    """Of the map at the end of a run, scored on the cells it has seen."""

    entropy_bits: jax.Array  # ()
    brier: jax.Array  # (), 0 for a run that has seen no cell
    scored: jax.Array  # () 1 if the run has seen any cell
    cells: jax.Array  # (bins,) cells by the probability the map gives them
    probability: jax.Array  # (bins,) sum of those probabilities
    occupied: jax.Array  # (bins,) how many of those cells are occupied


class Totals(NamedTuple):
    """What a run adds to a study. Every entry is a sum, over steps or observations, then over runs."""

    runs: jax.Array  # ()
    scored_runs: jax.Array  # () runs with any step scored
    scored: jax.Array  # (T,) steps whose NEES is finite and not negative
    nees: jax.Array  # (T,)
    error_square: jax.Array  # (T, 3) m², m², rad²
    variance: jax.Array  # (T, 3) the filter's own
    axis_nees: jax.Array  # (3,) of each axis alone, error² / σ²
    within_two_sigma: jax.Array  # (3,)
    covered: jax.Array  # (levels,) steps inside each ellipsoid of `consistency.COVERAGE_LEVELS`
    run_nees: jax.Array  # (2,) the run's average NEES, and its square
    run_nis: jax.Array  # (2,) the run's average NIS, and its square
    observing_runs: jax.Array  # () runs with any observation scored
    observed: jax.Array  # (T,) observations whose NIS is finite
    unscored_observations: jax.Array  # () the others: a reading or a belief that is no number
    nis: jax.Array  # (T,)
    accepted: jax.Array  # (T,)
    lag_products: jax.Array  # (2,) range, bearing
    lag_squares: jax.Array  # (2,)
    lag_pairs: jax.Array  # ()
    flagged_steps: jax.Array  # () steps whose `Info.ok` is False
    diverged: jax.Array  # () 1 if the run lost the robot at any step, or ended without a finite belief
    map: MapTotals | None


class _Scored(NamedTuple):
    """What is kept of a step."""

    error: jax.Array
    variance: jax.Array
    nees: jax.Array
    nis: jax.Array
    accepted: jax.Array
    white: jax.Array
    measured: jax.Array
    ok: jax.Array


def _score(state: State, info: Info, truth: jax.Array) -> _Scored:
    del state
    error = consistency.pose_error(truth, info.belief.mean)
    white = jax.vmap(consistency.whiten)(info.innovation, info.S)
    # What the filter could not use has S zero; where the belief has broken down, nothing whitens to a number.
    measured = (info.S[:, 0, 0] > 0) & jnp.all(jnp.isfinite(white), axis=-1)
    return _Scored(
        error=error,
        variance=jnp.diagonal(info.belief.cov),
        nees=consistency.nees(error, info.belief.cov),
        nis=jnp.where(measured, info.nis, 0),
        accepted=info.accepted,
        white=jnp.where(measured[:, None], white, 0),
        measured=measured,
        ok=info.ok,
    )


@dataclasses.dataclass(frozen=True)
class Study:
    """One run of a consistency study: simulate, filter, score. Hashable, so `monte_carlo` compiles it once."""

    scenario: simulate.Scenario
    config: Config  # with a grid, the run maps too

    def __call__(
        self, key: jax.Array, params: Params, world: simulate.World, noise: simulate.Noise, prior: Gaussian
    ) -> Totals:
        """Totals of the run that `key` stands for."""
        start_key, key = jax.random.split(key)
        start = prior.mean if self.scenario.exact_prior else simulate.draw_pose(start_key, prior)
        mapping = self.config.grid is not None
        truth, inputs = simulate.simulate(key, world, noise, start, scenario=self.scenario, scan=mapping)
        state, steps = run(
            params,
            init(prior, config=self.config),
            inputs,
            landmarks=world.landmarks,
            beam_angles=self.scenario.beam_angles(),
            config=self.config,
            collect=_score,
            aside=truth.pose,
        )
        return _totals(steps, inputs.valid, _map_totals(state.log_odds, world, self.config))


def _totals(steps: _Scored, valid: jax.Array, map_totals: MapTotals | None) -> Totals:
    dtype = steps.nees.dtype
    scored = jnp.isfinite(steps.nees) & (steps.nees >= 0)  # below zero the covariance is none
    nees = jnp.where(scored, steps.nees, 0)
    run_nees = jnp.sum(nees) / jnp.maximum(jnp.sum(scored, dtype=dtype), 1)
    observed = jnp.sum(steps.measured, dtype=dtype)
    run_nis = jnp.sum(steps.nis) / jnp.maximum(observed, 1)
    quantiles = [consistency.chi2_quantile(p, consistency.POSE_DIMENSION) for p in consistency.COVERAGE_LEVELS]
    products, squares, pairs = consistency.lag_one(steps.white, steps.measured)
    far = steps.error[:, 0] ** 2 + steps.error[:, 1] ** 2 > _LOST_DISTANCE**2
    ended = jnp.all(jnp.isfinite(steps.error[-1])) & jnp.all(jnp.isfinite(steps.variance[-1]))
    diverged = jnp.any(far & (nees > _LOST_NEES)) | ~ended
    return Totals(
        runs=jnp.ones((), dtype),
        scored_runs=jnp.any(scored).astype(dtype),
        scored=scored.astype(dtype),
        nees=nees,
        error_square=jnp.where(scored[:, None], steps.error**2, 0),
        variance=jnp.where(scored[:, None], steps.variance, 0),
        axis_nees=jnp.sum(jnp.where(scored[:, None], steps.error**2 / steps.variance, 0), axis=0),
        within_two_sigma=jnp.sum(scored[:, None] & (steps.error**2 <= 4 * steps.variance), axis=0).astype(dtype),
        covered=jnp.stack([jnp.sum(scored & (nees < q)).astype(dtype) for q in quantiles]),
        run_nees=jnp.stack([run_nees, run_nees**2]),
        run_nis=jnp.stack([run_nis, run_nis**2]),
        observing_runs=(observed > 0).astype(dtype),
        observed=jnp.sum(steps.measured, axis=1).astype(dtype),
        unscored_observations=jnp.sum(valid & ~steps.measured).astype(dtype),
        nis=jnp.sum(steps.nis, axis=1),
        accepted=jnp.sum(steps.accepted, axis=1).astype(dtype),
        lag_products=products,
        lag_squares=squares,
        lag_pairs=pairs,
        flagged_steps=jnp.sum(~steps.ok).astype(dtype),
        diverged=diverged.astype(dtype),
        map=map_totals,
    )


def _map_totals(log_odds: jax.Array | None, world: simulate.World, config: Config) -> MapTotals | None:
    if log_odds is None or config.grid is None:
        return None
    occupied, seen = simulate.occupancy(world, config.grid), log_odds != 0
    bins, scored = grid.calibration(log_odds, occupied, seen), jnp.any(seen)
    return MapTotals(
        entropy_bits=grid.entropy_bits(log_odds),
        brier=jnp.where(scored, grid.brier(log_odds, occupied, seen), 0),
        scored=scored.astype(log_odds.dtype),
        cells=bins.cells,
        probability=jnp.nan_to_num(bins.probability * bins.cells),
        occupied=jnp.nan_to_num(bins.frequency * bins.cells),
    )


def _mean_over_runs(total_and_square: np.ndarray, runs: int, expected: float) -> consistency.Mean:
    total, square = (float(value) for value in total_and_square)
    return consistency.mean_over_runs(total, square, runs, expected)


def _by_axis(values: np.ndarray) -> dict[str, float]:
    return dict(zip(("x", "y", "yaw"), values.tolist(), strict=True))


def summarise(totals: Any, config: Config) -> dict[str, Any]:
    """Judge the totals of a study.

    Args:
        totals: `Totals` of NumPy arrays, summed over runs. config: the filter's.

    Returns:
        The statistics by name, ready for JSON. The lag-one value of "bearing" is that of the bearing given the range,
        since innovations are whitened in that order. `anees_band_95` comes from the spread between runs around 3;
        `nees_band_95` is the χ² band of one step's mean over runs, and `nees_steps_in_band` the share of steps in it.
    """
    runs = round(float(totals.runs))
    steps = len(totals.nees)
    scored = np.where(totals.scored > 0, totals.scored, np.nan)
    all_scored = max(float(totals.scored.sum()), 1.0)
    observations = float(totals.observed.sum())
    anees = _mean_over_runs(totals.run_nees, round(float(totals.scored_runs)), consistency.POSE_DIMENSION)
    nis = _mean_over_runs(totals.run_nis, round(float(totals.observing_runs)), 2)
    per_step = totals.nees / scored
    band = consistency.chi2_band(consistency.POSE_DIMENSION, runs)
    rms = np.sqrt(totals.error_square.sum(0) / all_scored)
    rate = float(totals.accepted.sum()) / observations if observations else math.nan
    lag = totals.lag_products / np.where(totals.lag_squares > 0, totals.lag_squares, np.nan)
    diverged = round(float(totals.diverged))
    observing = totals.observed > 0
    report = {
        "runs": runs,
        "steps": steps,
        "anees": anees.value,
        "anees_standard_error": anees.standard_error,
        "anees_band_95": anees.band_95,
        "nis_mean": nis.value,
        "nis_standard_error": nis.standard_error,
        "nis_band_95": nis.band_95,
        "nees_per_step": per_step.tolist(),
        "nees_band_95": band,
        "nees_steps_in_band": float(np.mean((per_step >= band[0]) & (per_step <= band[1]))),
        "nis_per_step": [
            float(total / count) if count else None for total, count in zip(totals.nis, totals.observed, strict=True)
        ],
        "nis_chi2_band_95": [
            consistency.chi2_band(2, round(float(count))) if count else None for count in totals.observed
        ],
        "rmse_per_step": np.sqrt(totals.error_square / scored[:, None]).tolist(),
        "sigma_per_step": np.sqrt(totals.variance / scored[:, None]).tolist(),
        # Where one axis is claimed too well and another too badly, the NEES of all three can look right.
        "axis_nees": _by_axis(totals.axis_nees / all_scored),
        "within_two_sigma": _by_axis(totals.within_two_sigma / all_scored),
        **{
            f"coverage_{round(100 * level)}": float(count) / all_scored
            for level, count in zip(consistency.COVERAGE_LEVELS, totals.covered, strict=True)
        },
        "rmse_position_m": float(np.hypot(rms[0], rms[1])),
        "rmse_yaw_rad": float(rms[2]),
        "observations": round(observations),
        "observing_steps": int(observing.sum()),
        "gate_accept_rate": rate,
        "gate_nominal_rate": config.gate_probability,
        "gate_verdict": consistency.gate_verdict(rate, config.gate_probability, round(observations)),
        "innovation_lag_one": {"range": float(lag[0]), "bearing": float(lag[1])},
        "innovation_lag_one_band_95": 1.96 / math.sqrt(float(totals.lag_pairs)) if totals.lag_pairs else None,
        "diverged_runs": diverged,
        "unscored_observations": round(float(totals.unscored_observations)),
        "unscored_steps": round(runs * steps - float(totals.scored.sum())),
        "flagged_steps": round(float(totals.flagged_steps)),
        "verdict": consistency.verdict(anees.value, anees.band_95, diverged, runs),
    }
    if totals.map is not None:
        cells = totals.map.cells
        some = np.maximum(cells, 1)
        report["map"] = {
            "entropy_bits": float(totals.map.entropy_bits) / runs,
            "brier": float(totals.map.brier / totals.map.scored) if totals.map.scored else math.nan,
            "calibration_error": float(np.abs(totals.map.probability - totals.map.occupied).sum() / cells.sum())
            if totals.map.scored
            else math.nan,
            "calibration_cells": (cells / runs).tolist(),
            "calibration_probability": np.where(cells > 0, totals.map.probability / some, 0).tolist(),
            "calibration_frequency": np.where(cells > 0, totals.map.occupied / some, 0).tolist(),
        }
    return report
