"""What `tune --match` tunes on and judges by: a filter that matches scans, in rooms and buildings drawn anew."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import Gaussian, Params, simulation, tuning
from jaxlocmap.cli.tune_sources import GATE_TEMPERATURE, Evidence, Source, Wanted, judged_by_study
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.simulation import KNOWN_START_STD, MATCH_GAP, random_room, with_known_start, world_of
from jaxlocmap.simulation.scenario import LOOP_CENTRE, LOOP_RADIUS
from jaxlocmap.types import Matcher

MATCHING_NOISE = ("v", "w", "match_std", "match_scale", "map_length")
MATCHER = Matcher(period=5, gap=MATCH_GAP)
_STEPS = 300  # of a drive: some six submaps
_CLEAR = 0.4  # m: how far from the circle of the loop the box of a room must stand
_JUDGES = (dataclasses.replace(simulation.LOOP, steps=2400), simulation.BUILDING)


def from_drawn_worlds(motion: str, runs: int, judge_runs: int, wanted: Wanted) -> Source:
    """Drives of 30 s without landmarks: half of them round a room whose box is drawn, half of them somewhere on the
    tour of a building whose doors and furniture are. The loop's own room and the building itself judge, on long drives.
    """
    noise, steps = simulation.Noise(), 100 if wanted.quick else _STEPS
    key = jax.random.key(wanted.seed)

    def drives(i: int, count: int) -> tuning.Batch:
        of_rooms, of_buildings = jax.random.split(jax.random.fold_in(key, i))
        rooms, buildings = in_rooms(of_rooms, count // 2, steps), in_buildings(of_buildings, count - count // 2, steps)
        return tuning.join(rooms, buildings)

    judges = [with_known_start(dataclasses.replace(x, steps=200) if wanted.quick else x) for x in _JUDGES]

    def evidence(params: Params) -> Evidence:
        return {judge.name: _studied(judge, params, noise, motion, judge_runs, key, wanted) for judge in judges}

    config = simulation.LOOP.config(motion=motion, gate_probability=wanted.gate, grid=False)
    train = drives(0, runs)
    return Source(
        f"rooms and buildings drawn anew, {motion} motion, {runs} runs",
        wanted.start or with_defaults(simulation.course_params()),
        dataclasses.replace(config, matcher=MATCHER, gate_temperature=GATE_TEMPERATURE),
        train,
        drives(1, max(runs // 4, 2)),
        train,
        evidence,
        simulation.LOOP.dt,
    )


def in_rooms(key: jax.Array, count: int, steps: int) -> tuning.Batch:
    """Drives of the loop in rooms of which each has its box elsewhere, clear of the circle driven."""
    of_rooms, of_drives = jax.random.split(key)
    rooms = jax.vmap(random_room)(jax.random.split(of_rooms, 40 * count))  # a third of them will do
    box = np.asarray(rooms.segments)[:, 4:].reshape(40 * count, -1, 2) - LOOP_CENTRE
    low, high = box.min(axis=1), box.max(axis=1)
    nearest = np.linalg.norm(np.maximum(np.maximum(low, -high), 0), axis=1)
    farthest = np.linalg.norm(np.maximum(-low, high), axis=1)
    clear = np.flatnonzero((nearest > LOOP_RADIUS + _CLEAR) | (farthest < LOOP_RADIUS - _CLEAR))[:count]
    worlds = simulation.World(rooms.segments[clear], jnp.zeros((count, 0, 2)))
    scenario = with_known_start(dataclasses.replace(simulation.LOOP, steps=steps))
    noise = simulation.Noise()
    return tuning.simulated(of_drives, count, worlds, noise, scenario=scenario, scans=True, worlds=True)


def in_buildings(key: jax.Array, count: int, steps: int) -> tuning.Batch:
    """Drives through buildings, each from another place on: one after the other along the tour."""
    of_worlds, of_drives = jax.random.split(key)
    a_round = simulation.BUILDING.steps // 3
    scenario = with_known_start(dataclasses.replace(simulation.RANDOM_BUILDING, steps=a_round))
    worlds = jax.vmap(simulation.random_building)(jax.random.split(of_worlds, count))
    noise = simulation.Noise()
    whole = tuning.simulated(of_drives, count, worlds, noise, scenario=scenario, scans=True, worlds=True)
    truth = np.asarray(whole.truth)
    known = np.broadcast_to(np.diag(np.square(KNOWN_START_STD)), (*truth.shape, truth.shape[-1]))
    pieces = tuning.windows(whole, steps, run_in=0, beliefs=Gaussian(jnp.asarray(truth), jnp.asarray(known)))
    per_round = -(-a_round // steps)
    return tuning.pick(pieces, np.arange(count) * per_round + np.arange(count) % per_round)


def _studied(
    scenario: simulation.Scenario,
    params: Params,
    noise: simulation.Noise,
    motion: str,
    runs: int,
    key: jax.Array,
    wanted: Wanted,
) -> dict[str, Any]:
    """A study without landmarks, as `study --match --no-landmarks --exact-prior --no-map` makes it."""
    config = scenario.config(motion=motion, gate_probability=wanted.judge_gate, grid=False)
    config = dataclasses.replace(config, matcher=MATCHER)
    world = world_of(scenario)
    world = world._replace(landmarks=world.landmarks[:0])
    return judged_by_study(jax.random.fold_in(key, 3), runs, params, world, noise, scenario=scenario, config=config)
