"""Scoring of a simulated run while it goes on: what is added up, step by step and observation by observation."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.consistency import statistics
from jaxlocmap.consistency.match_scoring import MatchTotals
from jaxlocmap.mapping import quality
from jaxlocmap.se2 import POSE, boxminus
from jaxlocmap.simulation.world import World, occupancy
from jaxlocmap.step import Observation
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
    covered: jax.Array  # (levels,) share of steps inside each ellipsoid of `statistics.COVERAGE_LEVELS`


class Undiverged(NamedTuple):
    """Of one run that has not diverged: averages that a single diverged one would outweigh. Else zero."""

    nees: jax.Array  # () over its scored steps
    axis_nees: jax.Array  # (3,) the same of each axis alone, error² / σ²
    phase_nees: jax.Array  # (PHASES,) over each phase, if every step is scored


class StateTotals(NamedTuple):
    """Of the whole state, where it is more than a pose and the truth of it is known."""

    scored_runs: jax.Array  # () runs with any step scored
    entries: jax.Array  # () of the state that were scored, in these runs
    nees: jax.Array  # () the run's average, over its scored steps
    nees_square: jax.Array  # () its square


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
    lag_one: jax.Array  # (2, m) the run's correlations at lag one of the components of z, and their squares
    lag_runs: jax.Array  # () runs with any pair of observations of one landmark
    lag_pairs: jax.Array  # ()
    flagged_steps: jax.Array  # () steps whose `Info.ok` is False
    diverged: jax.Array  # () 1 if the run diverged at any step, or ended without a finite belief
    map: MapTotals | None
    state: StateTotals | None = None
    match: MatchTotals | None = None


class StepTally(NamedTuple):
    """What a run adds up of its steps; at one step, of that step."""

    scored: jax.Array  # ()
    nees: jax.Array  # ()
    axis_nees: jax.Array  # (3,)
    within_two_sigma: jax.Array  # (3,)
    covered: jax.Array  # (levels,)
    phase_nees: jax.Array  # (PHASES,)
    flagged: jax.Array  # ()
    diverged: jax.Array  # ()
    state_scored: jax.Array | None  # () None where the state is a pose, or no more of it is known
    state_nees: jax.Array | None  # ()


class ObservationTally(NamedTuple):
    """What a run adds up of its observations; at one step, of that step."""

    observed: jax.Array  # ()
    nis: jax.Array  # ()
    accepted: jax.Array  # ()
    unscored: jax.Array  # ()
    unusable: jax.Array  # ()
    lag_products: jax.Array  # (m,)
    lag_squares: jax.Array  # (m,) mean of both members' squares
    lag_pairs: jax.Array  # ()


class Latest(NamedTuple):
    """The last observation of each target."""

    seen: jax.Array  # (L,) bool: there was one
    white: tuple[jax.Array, ...]  # (L,) for each component: its innovation, whitened


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


def no_steps(dtype: Any, *, whole_state: bool) -> StepTally:
    """The tally before the first step. whole_state: more than the pose is scored."""
    zero, axes = jnp.zeros((), dtype), jnp.zeros(POSE, dtype)
    levels, state = jnp.zeros(len(statistics.COVERAGE_LEVELS), dtype), zero if whole_state else None
    return StepTally(zero, zero, axes, axes, levels, jnp.zeros(PHASES, dtype), zero, zero, state, state)


def no_observations(dtype: Any, dim: int) -> ObservationTally:
    """The tally before the first observation, of a sensor whose observations have `dim` components."""
    zero, each = jnp.zeros((), dtype), jnp.zeros(dim, dtype)
    return ObservationTally(zero, zero, zero, zero, zero, each, each, zero)


def score_step(
    belief: Gaussian, truth: jax.Array, ok: jax.Array, phase: jax.Array, *, angles: tuple[int, ...]
) -> tuple[StepTally, tuple[jax.Array, ...], tuple[jax.Array, ...]]:
    """The tally of one step, and its squared error and variance along x, y, yaw.

    Args:
        belief: after the step.
        truth: (n,) the true state after the step, as much of it as there is.
        ok: () bool, as in `Info`.
        phase: () int32, which part of the drive the step belongs to, the same for all runs.
        angles: entries of the state that are angles, static.
    """
    dtype = truth.dtype
    score = statistics.score_pose(truth[:POSE], *belief.pose)
    scored, nees = score.scored, score.nees
    quantiles = [statistics.chi2_quantile(p, POSE) for p in statistics.COVERAGE_LEVELS]
    state_scored = state_nees = None
    if (known := min(len(truth), len(belief.mean))) > POSE:
        error = boxminus(truth[:known], belief.mean[:known], tuple(i for i in angles if i < known))
        distance = statistics.nees(error, belief.cov[:known, :known])
        finite = jnp.isfinite(distance)
        state_scored, state_nees = finite.astype(dtype), jnp.where(finite, distance, 0)
    tally = StepTally(
        scored=scored.astype(dtype),
        nees=nees,
        axis_nees=jnp.stack(score.axis_nees),
        within_two_sigma=jnp.stack([(scored & (ratio <= 4)).astype(dtype) for ratio in score.axis_nees]),
        covered=jnp.stack([(scored & (nees < quantile)).astype(dtype) for quantile in quantiles]),
        phase_nees=jnp.stack([nees * (phase == i).astype(dtype) for i in range(PHASES)]),
        flagged=(~ok).astype(dtype),
        diverged=score.diverged.astype(dtype),
        state_scored=state_scored,
        state_nees=state_nees,
    )
    return tally, score.error_square, score.variance


def score_observation(
    observation: Observation, valid: jax.Array, used: jax.Array, latest: Latest
) -> tuple[ObservationTally, Latest]:
    """The tally of one observation of one target, and what the next one is to be compared with."""
    dtype, m = observation.nis.dtype, len(observation.innovation)
    white = statistics.whiten(observation.innovation, observation.S)
    # What the filter could not use has S zero; where the belief has broken down, nothing whitens to a number.
    measured = (observation.S[0, 0] > 0) & jnp.isfinite(functools.reduce(jnp.add, [white[i] ** 2 for i in range(m)]))
    paired = measured & latest.seen
    pairs = [(white[i], latest.white[i]) for i in range(m)]
    tally = ObservationTally(
        observed=measured.astype(dtype),
        nis=jnp.where(measured, observation.nis, 0),
        accepted=observation.accepted.astype(dtype),
        unscored=(valid & ~measured).astype(dtype),
        unusable=(valid & ~used).astype(dtype),
        lag_products=jnp.stack([jnp.where(paired, now * before, 0) for now, before in pairs]),
        lag_squares=jnp.stack([jnp.where(paired, (now**2 + before**2) / 2, 0) for now, before in pairs]),
        lag_pairs=paired.astype(dtype),
    )
    kept = tuple(jnp.where(measured, now, before) for now, before in pairs)
    return tally, Latest(latest.seen | measured, kept)


def run_totals(
    steps: StepTally,
    observations: ObservationTally,
    truth: jax.Array,
    belief: Gaussian,
    of_map: MapTotals | None,
    of_matches: MatchTotals | None = None,
    *,
    length: int,
    exact_start: bool,
) -> dict[str, Any]:
    """What one run of `length` steps adds to a study: the fields of `Totals` that are not `PerStep`, by name."""
    dtype = steps.nees.dtype
    some, seen = jnp.maximum(steps.scored, 1), jnp.maximum(observations.observed, 1)
    average = Averages(*(x / some for x in (steps.nees, steps.within_two_sigma, steps.covered)))
    run_nis = observations.nis / seen
    ended = jnp.all(jnp.isfinite(truth)) & jnp.all(jnp.isfinite(belief.mean))
    ended = ended & jnp.all(jnp.isfinite(jnp.diagonal(belief.cov)))
    diverged = (steps.diverged > 0) | ~ended
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
    paired, squares = observations.lag_pairs > 0, observations.lag_squares
    # Zero where nothing is paired, or where all innovations are exactly zero.
    lag_one = observations.lag_products / jnp.where(squares > 0, squares, 1)
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
        observing_runs=(observations.observed > 0).astype(dtype),
        unscored_observations=observations.unscored,
        lag_one=jnp.stack([lag_one, lag_one**2]),
        lag_runs=paired.astype(dtype),
        lag_pairs=observations.lag_pairs,
        flagged_steps=steps.flagged,
        diverged=diverged.astype(dtype),
        map=of_map,
        match=of_matches,
        state=_state_totals(steps, min(len(truth), len(belief.mean))),
    )


def _state_totals(steps: StepTally, entries: int) -> StateTotals | None:
    if steps.state_scored is None or steps.state_nees is None:
        return None
    average = steps.state_nees / jnp.maximum(steps.state_scored, 1)
    scored = (steps.state_scored > 0).astype(average.dtype)
    return StateTotals(scored, entries * scored, average, average**2)


def map_totals(log_odds: jax.Array | None, world: World, config: Config) -> MapTotals | None:
    """The final map (rows, columns) against the world it is of; None without a map."""
    if log_odds is None or config.grid is None:
        return None
    occupied, seen = occupancy(world, config.grid), log_odds != 0
    sums = quality.score(log_odds, occupied, seen)
    return MapTotals(
        entropy_bits=sums.entropy_bits,
        brier=sums.square / jnp.maximum(jnp.sum(sums.cells), 1),
        scored=jnp.any(seen).astype(log_odds.dtype),
        cells=sums.cells,
        probability=sums.probability,
        occupied=sums.occupied,
    )
