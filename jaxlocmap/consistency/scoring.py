"""Scoring of a simulated run while it goes on: what is added up, step by step and observation by observation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import consistency
from jaxlocmap.mapping import grid
from jaxlocmap.simulation.world import World, occupancy
from jaxlocmap.step import Sighting
from jaxlocmap.types import Config, Gaussian

PHASES = 4  # equal parts of a drive, each with an average NEES of its own
# Edges of the bins in which runs are counted by their average NEES, for a median: 5 % apart. What lies beyond counts in
# the first and the last bin.
NEES_EDGES = np.exp(np.arange(math.log(0.1), math.log(1e4), 0.05))


class MapTotals(NamedTuple):
    """Of the map at the end of a run, scored on the cells it has seen."""

    entropy_bits: jax.Array  # ()
    brier: jax.Array  # (), 0 for a run that has seen no cell
    scored: jax.Array  # () 1 if the run has seen any cell
    cells: jax.Array  # (bins,) cells by the probability the map gives them
    probability: jax.Array  # (bins,) sum of those probabilities
    occupied: jax.Array  # (bins,) how many of those cells are occupied


class Averages(NamedTuple):
    """Of one run, over its scored steps."""

    nees: jax.Array  # ()
    within_two_sigma: jax.Array  # (3,) share of steps
    covered: jax.Array  # (levels,) share of steps inside each ellipsoid of `consistency.COVERAGE_LEVELS`


class Undiverged(NamedTuple):
    """Of one run that has not diverged: averages that a single diverged one would outweigh. Else zero."""

    nees: jax.Array  # () over its scored steps
    axis_nees: jax.Array  # (3,) the same of each axis alone, error² / σ²
    phase_nees: jax.Array  # (PHASES,) over each phase, if every step is scored


class Totals(NamedTuple):
    """What a run adds to a study. Every entry is a sum, over steps or observations, then over runs."""

    runs: jax.Array  # ()
    exact_starts: jax.Array  # () runs whose true start was the prior's mean
    scored_runs: jax.Array  # () runs with any step scored
    scored: jax.Array  # (T,) steps whose covariance is one and whose NEES is finite
    nees: jax.Array  # (T,)
    error_square: tuple[jax.Array, ...]  # x, y, yaw: (T,) each, m², m², rad²
    variance: tuple[jax.Array, ...]  # the same of the filter's own
    average: Averages
    average_square: Averages  # of each run's average, squared
    undiverged_runs: jax.Array  # () scored runs that have not diverged
    whole_runs: jax.Array  # () of these, with every step scored
    undiverged: Undiverged
    undiverged_square: Undiverged  # of each run's average, squared
    nees_bins: jax.Array  # (len(NEES_EDGES) + 1,) scored runs by their average NEES
    run_nis: jax.Array  # (2,) the run's average NIS, and its square
    observing_runs: jax.Array  # () runs with any observation scored
    observed: jax.Array  # (T,) observations whose NIS is finite
    unscored_observations: jax.Array  # () the others: a reading or a belief that is no number
    nis: jax.Array  # (T,)
    accepted: jax.Array  # (T,)
    lag_one: jax.Array  # (2, 2) the run's correlations at lag one of range and bearing, and their squares
    lag_runs: jax.Array  # () runs with any pair of observations of one landmark
    lag_pairs: jax.Array  # ()
    flagged_steps: jax.Array  # () steps whose `Info.ok` is False
    diverged: jax.Array  # () 1 if the run lost the robot at any step, or ended without a finite belief
    map: MapTotals | None


class StepTally(NamedTuple):
    """What a run adds up of its steps; at one step, of that step."""

    scored: jax.Array  # ()
    nees: jax.Array  # ()
    axis_nees: jax.Array  # (3,)
    within_two_sigma: jax.Array  # (3,)
    covered: jax.Array  # (levels,)
    phase_nees: jax.Array  # (PHASES,)
    flagged: jax.Array  # ()
    lost: jax.Array  # ()


class SightingTally(NamedTuple):
    """What a run adds up of its observations; at one step, of that step."""

    observed: jax.Array  # ()
    nis: jax.Array  # ()
    accepted: jax.Array  # ()
    unscored: jax.Array  # ()
    unusable: jax.Array  # ()
    lag_products: jax.Array  # (2,)
    lag_squares: jax.Array  # (2,) mean of both members' squares
    lag_pairs: jax.Array  # ()


class Latest(NamedTuple):
    """The last observation of each landmark."""

    seen: jax.Array  # (L,) bool: there was one
    white: tuple[jax.Array, jax.Array]  # (L,) each: its innovation, whitened


class PerStep(NamedTuple):
    """What is kept of each step: the fields of `Totals` of the same name."""

    scored: jax.Array
    nees: jax.Array
    error_square: tuple[jax.Array, ...]
    variance: tuple[jax.Array, ...]
    observed: jax.Array
    nis: jax.Array
    accepted: jax.Array


def phase_edges(steps: int) -> list[int]:
    """The first step of each phase of a drive, and the step after the last: step k is in phase PHASES k // steps."""
    return [-(-i * steps // PHASES) for i in range(PHASES + 1)]


def no_steps(zero: jax.Array) -> StepTally:
    """The tally before the first step. zero: () of the dtype to count in."""
    three, levels = jnp.full(3, zero), jnp.full(len(consistency.COVERAGE_LEVELS), zero)
    return StepTally(zero, zero, three, three, levels, jnp.full(PHASES, zero), zero, zero)


def no_sightings(zero: jax.Array) -> SightingTally:
    """The tally before the first observation. zero: () of the dtype to count in."""
    pair = jnp.full(2, zero)
    return SightingTally(zero, zero, zero, zero, zero, pair, pair, zero)


def score_step(
    belief: Gaussian, truth: jax.Array, ok: jax.Array, phase: jax.Array
) -> tuple[StepTally, tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """The tally of one step, and its squared error and variance along x, y, yaw.

    Args:
        belief, truth: after the step.
        ok: () bool, as in `Info`.
        phase: () int32, which part of the drive the step belongs to, the same for all runs.
    """
    dtype = truth.dtype
    score = consistency.score_pose(truth, *belief)
    scored, nees = score.scored, score.nees
    quantiles = [consistency.chi2_quantile(p, consistency.POSE_DIMENSION) for p in consistency.COVERAGE_LEVELS]
    tally = StepTally(
        scored=scored.astype(dtype),
        nees=nees,
        axis_nees=jnp.stack(score.axis_nees),
        within_two_sigma=jnp.stack([(scored & (ratio <= 4)).astype(dtype) for ratio in score.axis_nees]),
        covered=jnp.stack([(scored & (nees < quantile)).astype(dtype) for quantile in quantiles]),
        phase_nees=jnp.stack([nees * (phase == i).astype(dtype) for i in range(PHASES)]),
        flagged=(~ok).astype(dtype),
        lost=score.lost.astype(dtype),
    )
    return tally, score.error_square, score.variance


def score_sighting(
    sighting: Sighting, valid: jax.Array, used: jax.Array, latest: Latest
) -> tuple[SightingTally, Latest]:
    """The tally of one observation of one landmark, and what the next one is to be compared with."""
    dtype = sighting.nis.dtype
    white = consistency.whiten(sighting.innovation, sighting.S)
    # What the filter could not use has S zero; where the belief has broken down, nothing whitens to a number.
    measured = (sighting.S[0, 0] > 0) & jnp.isfinite(white[0] ** 2 + white[1] ** 2)
    paired = measured & latest.seen
    tally = SightingTally(
        observed=measured.astype(dtype),
        nis=jnp.where(measured, sighting.nis, 0),
        accepted=sighting.accepted.astype(dtype),
        unscored=(valid & ~measured).astype(dtype),
        unusable=(valid & ~used).astype(dtype),
        lag_products=jnp.stack([jnp.where(paired, white[i] * latest.white[i], 0) for i in range(2)]),
        lag_squares=jnp.stack([jnp.where(paired, (white[i] ** 2 + latest.white[i] ** 2) / 2, 0) for i in range(2)]),
        lag_pairs=paired.astype(dtype),
    )
    first, second = (jnp.where(measured, white[i], latest.white[i]) for i in range(2))
    return tally, Latest(latest.seen | measured, (first, second))


def run_totals(
    steps: StepTally,
    sightings: SightingTally,
    truth: jax.Array,
    belief: Gaussian,
    of_map: MapTotals | None,
    *,
    length: int,
    exact_start: bool,
) -> dict[str, Any]:
    """What one run of `length` steps adds to a study: the fields of `Totals` that are not `PerStep`, by name."""
    dtype = steps.nees.dtype
    some, seen = jnp.maximum(steps.scored, 1), jnp.maximum(sightings.observed, 1)
    average = Averages(*(x / some for x in (steps.nees, steps.within_two_sigma, steps.covered)))
    run_nis = sightings.nis / seen
    ended = jnp.all(jnp.isfinite(truth - belief.mean)) & jnp.all(jnp.isfinite(jnp.diagonal(belief.cov)))
    diverged = (steps.lost > 0) | ~ended
    scored = steps.scored > 0
    kept = scored & ~diverged
    whole = kept & (steps.scored == length)
    spans = jnp.asarray(np.maximum(np.diff(phase_edges(length)), 1), dtype)
    undiverged = Undiverged(
        nees=jnp.where(kept, average.nees, 0),
        axis_nees=jnp.where(kept, steps.axis_nees / some, 0),
        phase_nees=jnp.where(whole, steps.phase_nees / spans, 0),
    )
    # Each run is counted at its lowest edge that lies above; differences make bins of these.
    below = jnp.concatenate([average.nees < jnp.asarray(NEES_EDGES, dtype), jnp.full(1, scored)]) & scored
    bins = below.astype(dtype) - jnp.concatenate([jnp.zeros(1, dtype), below[:-1].astype(dtype)])
    paired, squares = sightings.lag_pairs > 0, sightings.lag_squares
    # Zero where nothing is paired, or where all innovations are exactly zero.
    lag_one = sightings.lag_products / jnp.where(squares > 0, squares, 1)
    return dict(
        runs=jnp.ones((), dtype),
        exact_starts=jnp.full((), exact_start, dtype),
        scored_runs=scored.astype(dtype),
        average=average,
        average_square=jax.tree.map(jnp.square, average),
        undiverged_runs=kept.astype(dtype),
        whole_runs=whole.astype(dtype),
        undiverged=undiverged,
        undiverged_square=jax.tree.map(jnp.square, undiverged),
        nees_bins=bins,
        run_nis=jnp.stack([run_nis, run_nis**2]),
        observing_runs=(sightings.observed > 0).astype(dtype),
        unscored_observations=sightings.unscored,
        lag_one=jnp.stack([lag_one, lag_one**2]),
        lag_runs=paired.astype(dtype),
        lag_pairs=sightings.lag_pairs,
        flagged_steps=steps.flagged,
        diverged=diverged.astype(dtype),
        map=of_map,
    )


def map_totals(log_odds: jax.Array | None, world: World, config: Config) -> MapTotals | None:
    """The final map (rows, columns) against the world it is of; None without a map."""
    if log_odds is None or config.grid is None:
        return None
    occupied, seen = occupancy(world, config.grid), log_odds != 0
    sums = grid.score(log_odds, occupied, seen)
    return MapTotals(
        entropy_bits=sums.entropy_bits,
        brier=sums.square / jnp.maximum(jnp.sum(sums.cells), 1),
        scored=jnp.any(seen).astype(log_odds.dtype),
        cells=sums.cells,
        probability=sums.probability,
        occupied=sums.occupied,
    )
