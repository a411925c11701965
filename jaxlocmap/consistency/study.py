"""A consistency study: one simulated run scored against its truth, and the totals of many basis.

totals = monte_carlo(Study(scenario, config), key, runs, params, world, noise, prior).value
report = summarise(totals, config)
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxlocmap import checks, motion, sensors, simulation
from jaxlocmap._internal.batching import cond, scan, sum_over_runs, zero_of
from jaxlocmap._internal.random import words_of
from jaxlocmap.consistency.match_scoring import match_totals, no_matches, score_match
from jaxlocmap.consistency.scoring import (
    PHASES,
    Latest,
    MapTotals,
    ObservationTally,
    PerStep,
    Totals,
    map_totals,
    no_observations,
    no_steps,
    run_totals,
    score_observation,
    score_step,
)
from jaxlocmap.consistency.summary import median_nees, pose_means, summarise
from jaxlocmap.parameters import Params
from jaxlocmap.pipeline import init
from jaxlocmap.se2 import POSE
from jaxlocmap.simulation.world import World
from jaxlocmap.step import Observed, clamp_map, correct, turn
from jaxlocmap.types import Config, Gaussian, State

__all__ = [
    "MapTotals",
    "RandomBuildings",
    "Study",
    "Totals",
    "median_nees",
    "pose_means",
    "reference_study",
    "summarise",
]


@dataclasses.dataclass(frozen=True)
class Study:
    """One run of a consistency study: simulate, filter and score, all in one loop. Hashable, so `monte_carlo` compiles
    it once.

    Its loop turns as `pipeline.run` does over a drive of `simulation.simulate`; it keeps neither the measurements nor
    the beliefs, which would have to travel to memory and back.
    """

    scenario: simulation.Scenario
    config: Config  # with a grid, the run maps too

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        world: World,
        noise: simulation.Noise,
        prior: Gaussian,
        *,
        add_up: Callable[[Any], Any] = lambda own: own,
    ) -> Totals:
        """Totals of the run that `key` stands for.

        Args:
            key: of this run.
            params: the filter's.
            world, noise: as their fields say.
            prior: (n,), (n, n) of the longer of the true state and the filter's; each begins with its first entries.
            add_up: what becomes of everything that is to be added up over runs, each step's as soon as it is there.

        Raises:
            ValueError: a configuration that is not of the scenario's robot, or a wrong shape.
        """
        params.check()
        self.scenario.check(self.config)
        dtype = prior.mean.dtype
        key, world = self._surroundings(key, world)
        params, world, noise = jax.tree.map(lambda x: jnp.asarray(x, dtype), (params, world, noise))
        config, scenario = self.config, self.scenario
        model, sensor = motion.resolve(config.motion), sensors.resolve(config.sensor)
        checks.shape("prior.mean", prior.mean, (max(model.dim, scenario.dim),))
        start_key, key = jax.random.split(key)
        truth = simulation.draw_start(start_key, prior, scenario=scenario)
        zero = zero_of(key, params, world, noise, prior)
        words, targets = words_of(key), simulation.targets(world, scenario=scenario)
        number = jnp.arange(len(targets), dtype=jnp.int32)
        beam_angles = scenario.beam_angles().astype(dtype)

        def detect(truth: jax.Array, k: jax.Array, belief: Gaussian, latest: Latest) -> Any:
            """Detect one target after the other, and correct by it."""

            def one(carry: tuple[Gaussian, ObservationTally], now: tuple[Any, ...]) -> tuple[Any, Latest]:
                belief, tally = carry
                j, x, y, latest = now
                draws = simulation.draw_detection(words, k, j, scenario=scenario, dtype=dtype)
                target = jnp.stack([x, y])
                z, valid = simulation.detect(draws, truth, target, world, noise, scenario=scenario)
                belief, observation, used = correct(params, belief, z, target, j, valid, config=config)
                one_more, latest = score_observation(observation, valid, used, latest)
                return (belief, jax.tree.map(jnp.add, tally, one_more)), latest

            begin = belief, no_observations(dtype, sensor.dim)
            (belief, tally), latest = scan(one, begin, (number, targets[:, 0], targets[:, 1], latest))
            return belief, tally, latest

        def rest(truth: jax.Array, k: jax.Array, belief: Gaussian, latest: Latest) -> Any:
            del truth, k
            return belief, no_observations(dtype, sensor.dim), latest

        def one_step(carry: tuple[Any, ...], k: jax.Array) -> tuple[tuple[Any, ...], PerStep]:
            truth, state, latest, steps, observations, matches, anchors = carry
            draws = simulation.draw_drive(words, k, scenario=scenario, dtype=dtype)
            truth, control = simulation.drive(draws, k, truth, noise, scenario=scenario)

            def observe(belief: Gaussian) -> Observed:
                belief, *seen = cond(scenario.detector.active(k), detect, rest, truth, k, belief, latest, zero=zero)
                return Observed(belief, seen, jnp.zeros((), dtype), seen[0].unusable == 0)

            ranges = None
            if config.grid is not None or config.matcher is not None:
                draws = simulation.draw_scan(words, k, scenario=scenario, dtype=dtype)
                ranges = simulation.simulate_scan(draws, truth, world, noise, scenario=scenario)
            state, (seen, latest), match, ok = turn(
                params,
                state,
                control,
                jnp.asarray(scenario.dt, dtype),
                observe=observe,
                ranges=ranges,
                beam_angles=beam_angles,
                config=config,
            )
            phase = PHASES * k // scenario.steps
            stepped, error_square, variance = score_step(
                state.belief.first(model.dim), truth, ok, phase, angles=model.angles
            )
            at_step = PerStep(
                stepped.scored, stepped.nees, error_square, variance, seen.observed, seen.nis, seen.accepted
            )
            steps, observations = jax.tree.map(jnp.add, (steps, observations), (stepped, seen))
            if match is not None and config.matcher is not None:
                matched, anchors = score_match(match, truth[:POSE], anchors, config.matcher)
                matches = jax.tree.map(jnp.add, matches, matched)
            return (truth, state, latest, steps, observations, matches, anchors), add_up(at_step)

        none = jnp.zeros(len(targets), dtype)
        begin = (
            truth,
            init(prior.first(model.dim), config=config),
            Latest(none != 0, (none,) * sensor.dim),
            no_steps(dtype, whole_state=min(model.dim, scenario.dim) > POSE),
            no_observations(dtype, sensor.dim),
            None if config.matcher is None else no_matches(dtype),
            None if config.matcher is None else (truth[:POSE], truth[:POSE]),
        )
        ended, per_step = scan(one_step, begin, jnp.arange(scenario.steps), zero=zero)
        truth, state, _, steps, observations, matches, _ = ended
        state = clamp_map(state, config=config)
        of_map = map_totals(state.log_odds, world, config)
        of_run = run_totals(
            steps,
            observations,
            truth,
            state.belief.first(model.dim),
            of_map,
            None if matches is None else match_totals(matches),
            length=scenario.steps,
            exact_start=scenario.exact_prior,
        )
        return Totals(**per_step._asdict(), **add_up(of_run))

    def summed(self, key: jax.Array, counted: jax.Array, *args: Any, **kwargs: Any) -> Totals:
        """Under `vmap(..., axis_name=batching.RUNS)`, the totals of all runs that are `counted` (() bool), added up
        step by step: what `monte_carlo` computes.

        Args:
            key, *args, **kwargs: as of a call.
        """
        return self(key, *args, **kwargs, add_up=functools.partial(sum_over_runs, counted=counted))

    def carried(
        self, key: jax.Array, params: Params, world: World, noise: simulation.Noise, prior: Gaussian, *_: Any
    ) -> State:
        """What fills memory in the loop over time: the state of the filter, whose map outweighs all else.

        Args:
            key, params, world, noise, prior: as of a call.
        """
        del key, params, world, noise
        return init(prior.first(motion.resolve(self.config.motion).dim), config=self.config)

    def _surroundings(self, key: jax.Array, world: World) -> tuple[jax.Array, World]:
        """What stands around a run, and the key of the rest of it."""
        return key, world


class RandomBuildings(Study):
    """The same with a building of its own for every run, drawn by `simulation.random_building`: of the world that it is
    called with, the landmarks alone count.
    """

    def _surroundings(self, key: jax.Array, world: World) -> tuple[jax.Array, World]:
        world_key, key = jax.random.split(key)
        return key, simulation.random_building(world_key)._replace(landmarks=world.landmarks)


def reference_study(scenario: simulation.Scenario, config: Config, noise: simulation.Noise) -> tuple[Study, Params]:
    """The study of a filter that is told the truth, and what it is told: the robot's own noise and motion model.

    Its ANEES is what this start and this gate make of an honest covariance. It maps nothing.
    """
    told = dataclasses.replace(config, motion=simulation.own_motion(scenario), grid=None)
    return Study(scenario, told), simulation.own_params(noise, scenario)
