"""A consistency study: one simulated run scored against its truth, and the totals of many judged.

totals = monte_carlo(Study(scenario, config), key, runs, params, world, noise, prior).value
report = summarise(totals, config)
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import consistency, grid, simulate
from jaxlocmap.batching import cond, scan, sum_over_runs, zero_like_any
from jaxlocmap.normals import words_of
from jaxlocmap.pipeline import init
from jaxlocmap.scoring import (
    Latest,
    MapTotals,
    PerStep,
    SightingTally,
    Totals,
    map_totals,
    no_sightings,
    no_steps,
    run_totals,
    score_sighting,
    score_step,
)
from jaxlocmap.stages import correct, map_scan, predict, sound
from jaxlocmap.types import Config, Gaussian, Params, State
from jaxlocmap.world import World

__all__ = ["MapTotals", "Study", "Totals", "summarise"]


@dataclasses.dataclass(frozen=True)
class Study:
    """One run of a consistency study: simulate, filter and score, all in one loop. Hashable, so `monte_carlo` compiles
    it once.

    Its loop is that of `pipeline.run` over a drive of `simulate.simulate`, step by step; it keeps neither the
    measurements nor the beliefs, which would have to travel to memory and back.
    """

    scenario: simulate.Scenario
    config: Config  # with a grid, the run maps too

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        world: World,
        noise: simulate.Noise,
        prior: Gaussian,
        gate_probability: jax.Array | None = None,
        *,
        add_up: Callable[[Any], Any] = lambda own: own,
    ) -> Totals:
        """Totals of the run that `key` stands for.

        Args:
            key: of this run. params: the filter's. world, noise, prior: as their fields say.
            gate_probability: takes the place of the configuration's; a value, so that a sweep over gates compiles once.
            add_up: what becomes of everything that is to be added up over runs, each step's as soon as it is there.
        """
        params.check()
        dtype = prior.mean.dtype
        params, world, noise = jax.tree.map(lambda x: jnp.asarray(x, dtype), (params, world, noise))
        config, scenario = self.config, self.scenario
        if gate_probability is not None:
            config = dataclasses.replace(config, gate_probability=gate_probability)
        zero = zero_like_any(key, params, world, noise, prior, gate_probability).astype(dtype)
        start_key, key = jax.random.split(key)
        start = prior.mean if scenario.exact_prior else simulate.draw_pose(start_key, prior)
        words = words_of(key)
        landmarks = jnp.arange(len(world.landmarks), dtype=jnp.int32)
        beam_angles = scenario.beam_angles().astype(dtype)

        def sight(pose: jax.Array, k: jax.Array, belief: Gaussian, latest: Latest) -> Any:
            """Look for one landmark after the other, and correct by it."""

            def one(carry: tuple[Gaussian, SightingTally], now: tuple[Any, ...]) -> tuple[Any, Latest]:
                belief, tally = carry
                j, x, y, latest = now
                draws = simulate.draw_sighting(words, k, j, scenario=scenario, dtype=dtype)
                landmark = jnp.stack([x, y])
                z, valid = simulate.sight(draws, pose, landmark, noise, scenario=scenario)
                belief, sighting, used = correct(params, belief, z, landmark, j, valid, config=config)
                one_more, latest = score_sighting(sighting, valid, used, latest)
                return (belief, jax.tree.map(jnp.add, tally, one_more)), latest

            places = landmarks, world.landmarks[:, 0], world.landmarks[:, 1]
            (belief, tally), latest = scan(one, (belief, no_sightings(zero)), (*places, latest))
            return belief, tally, latest

        def look_away(pose: jax.Array, k: jax.Array, belief: Gaussian, latest: Latest) -> Any:
            del pose, k
            return belief, no_sightings(zero), latest

        def turn(carry: tuple[Any, ...], k: jax.Array) -> tuple[tuple[Any, ...], PerStep]:
            pose, belief, log_odds, latest, steps, sightings = carry
            pose, control = simulate.drive(simulate.draw_drive(words, k, dtype), k, pose, noise, scenario=scenario)
            belief, moved = predict(params, belief, control, jnp.asarray(scenario.dt, dtype), config=config)
            belief, seen, latest = cond(scenario.looks(k), sight, look_away, pose, k, belief, latest)
            if log_odds is not None:
                draws = simulate.draw_scan(words, k, scenario=scenario, dtype=dtype)
                ranges = simulate.look_round(draws, pose, world, noise, scenario=scenario)
                log_odds = map_scan(params, log_odds, belief.mean, ranges, beam_angles, config=config)
            definite = sound(belief)
            ok = moved & (seen.unusable == 0) & definite
            stepped, error_square, variance = score_step(belief, pose, ok, definite)
            at_step = PerStep(
                stepped.scored, stepped.nees, error_square, variance, seen.observed, seen.nis, seen.accepted
            )
            steps, sightings = jax.tree.map(jnp.add, (steps, sightings), (stepped, seen))
            return (pose, belief, log_odds, latest, steps, sightings), add_up(at_step)

        state = jax.tree.map(lambda x: x + zero, init(prior, config=config))
        none = jnp.full(landmarks.shape, zero)
        begin = (
            start + zero_like_any(key, world, noise, prior).astype(dtype),  # whatever the filter believes
            state.belief,
            state.log_odds,
            Latest(none != 0, (none, none)),
            no_steps(zero),
            no_sightings(zero),
        )
        (pose, belief, log_odds, _, steps, sightings), per_step = scan(turn, begin, jnp.arange(scenario.steps))
        if log_odds is not None and config.grid is not None:
            log_odds = grid.clamp(log_odds, config.grid)
        of_run = run_totals(steps, sightings, pose, belief, map_totals(log_odds, world, config))
        return Totals(**per_step._asdict(), **add_up(of_run))

    def summed(self, key: jax.Array, counted: jax.Array, *args: Any, **kwargs: Any) -> Totals:
        """Under `vmap(..., axis_name=batching.RUNS)`, the totals of all runs that are `counted` (() bool), added up
        step by step: what `monte_carlo` computes.

        Args:
            key, *args, **kwargs: as of a call.
        """
        return self(key, *args, **kwargs, add_up=functools.partial(sum_over_runs, counted=counted))

    def carried(
        self, key: jax.Array, params: Params, world: World, noise: simulate.Noise, prior: Gaussian, *_: Any
    ) -> State:
        """What fills memory in the loop over time: the state of the filter, whose map outweighs all else.

        Args:
            key, params, world, noise, prior: as of a call.
        """
        del key, params, world, noise
        return init(prior, config=self.config)


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
    error_square, variance = np.stack(totals.error_square, -1), np.stack(totals.variance, -1)
    rms = np.sqrt(error_square.sum(0) / all_scored)
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
        "rmse_per_step": np.sqrt(error_square / scored[:, None]).tolist(),
        "sigma_per_step": np.sqrt(variance / scored[:, None]).tolist(),
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
