"""Simulated robots: keys in, `Truth` and `Inputs` out.

A world is data (walls, landmarks), so is the plant's noise; both may differ from run to run under `vmap`. What the
filter believes, its `Params`, is no part of a simulation. `drive`, `sight` and `look_round` each make one step out of
given random numbers, so that a study can simulate and filter in one loop and keep neither; `roll_out` makes a whole
drive of them, also for a program with a generator of its own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal import batching
from jaxlocmap._internal.random import Words, normals, uniforms, words_of
from jaxlocmap._internal.trig import arctan2, sin_cos
from jaxlocmap.motion import wrap
from jaxlocmap.sensors import sensor_pose
from jaxlocmap.simulation.scenario import Noise, Scenario
from jaxlocmap.simulation.world import World, ray_cast
from jaxlocmap.types import Gaussian, Inputs, Truth


class Draws(NamedTuple):
    """The random numbers of a drive; what they are for is said where they are used."""

    drive: jax.Array  # (T, 3)
    sighting: jax.Array  # (T, L, 2), or (T, L, 5) with outliers; used at the steps at which the detector looks
    scan: jax.Array | None = None  # (T, B); None without a scanner


# Where each use of a step's random numbers begins.
_DRIVE, _SIGHTINGS, _SCAN = 0, 1 << 20, 1 << 30


def draw_pose(key: jax.Array, prior: Gaussian) -> jax.Array:
    """A true pose (3,), m, m, rad, from the prior, so that the prior is honest.

    To start exactly where the filter believes, use `prior.mean`.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(mean=(prior.mean, (3,)), cov=(prior.cov, (3, 3)))
    variance, axes = jnp.linalg.eigh(prior.cov)  # unlike Cholesky, content with a variance of zero
    spread = jnp.sqrt(jnp.maximum(variance, 0)) * jax.random.normal(key, (3,), prior.mean.dtype)
    pose = prior.mean + axes @ spread
    return pose.at[2].set(wrap(pose[2]))


def draw_drive(words: Words, k: jax.Array, dtype: Any) -> jax.Array:
    """Random numbers for `drive` at step k, (3,). words: of this drive alone, from `normals.words_of`.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("k", k, ())
    return normals(words, k, _DRIVE, 3, dtype)


def drive(
    draws: jax.Array, k: jax.Array, pose: jax.Array, noise: Noise, *, scenario: Scenario
) -> tuple[jax.Array, jax.Array]:
    """One step of the plant.

        x ← x + v cos(theta) dt,  y ← y + v sin(theta) dt,  theta ← wrap(theta + omega dt + heading noise)

    Args:
        draws: (3,) standard normals: for heading, v, omega. k: () step, from 0. pose: (3,) m, m, rad, the true pose
            before. noise: as its fields say. scenario: static.

    Returns:
        The true pose (3,), and the commanded control with noise (2,), as the robot measures it.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(draws=(draws, (3,)), k=(k, ()), pose=(pose, (3,)))
    _check_noise(noise)
    v, w = scenario.command(k, pose)
    sin, cos = sin_cos(pose[2])
    moved = [
        pose[0] + v * cos * scenario.dt,
        pose[1] + v * sin * scenario.dt,
        wrap(pose[2] + w * scenario.dt + noise.heading * draws[0]),
    ]
    return jnp.stack(moved), jnp.stack([v + noise.v * draws[1], w + noise.w * draws[2]])


def draw_sighting(words: Words, k: jax.Array, j: jax.Array, *, scenario: Scenario, dtype: Any) -> jax.Array:
    """Random numbers for `sight` of landmark j at step k, (2,) or, with outliers, (5,).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(k=(k, ()), j=(j, ()))
    normal = normals(words, k, _SIGHTINGS + 4 * j, 2, dtype)
    if not scenario.outliers:
        return normal
    uniform = uniforms(words, k, _SIGHTINGS + 4 * j + 1, 3, dtype)
    return jnp.stack([*normal, *uniform])


def sight(
    draws: jax.Array, pose: jax.Array, landmark: jax.Array, noise: Noise, *, scenario: Scenario
) -> tuple[jax.Array, jax.Array]:
    """What the detector makes of a landmark.

    Whether it reports one is decided by the true distance: a cut of what it measures would let through more of the
    readings that came out short, and noise so picked is no longer the noise that it has.

    Args:
        draws: (2,) standard normals for range and bearing; with `scenario.outliers` (5,), then uniform over (0, 1):
            whether the sighting is false, and of what range and bearing.
        pose: (3,) m, m, rad, the true one. landmark: (2,) m. noise: as its fields say. scenario: static.

    Returns:
        Range and bearing (2,) m, rad, and whether the detector reports them, which it does of landmarks nearer than
        `sight_range`. Within a few deviations of a landmark noise can make the range negative; the filter then leaves
        it out.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(draws=(draws, (_sighting_draws(scenario),)), landmark=(landmark, (2,)))
    _check_noise(noise)
    x, y, heading, _ = sensor_pose(pose, scenario.sensor_offset)
    dx, dy = landmark[0] - x, landmark[1] - y
    distance = jnp.sqrt(dx * dx + dy * dy)
    near = distance < scenario.sight_range
    reach = distance + noise.range * draws[0]
    bearing = arctan2(dy, dx) - heading + noise.bearing * draws[1]
    if scenario.outliers:  # of what it reports, so that the rate is the share
        false = draws[2] < noise.outlier_rate
        reach = jnp.where(false, draws[3] * scenario.sight_range, reach)
        bearing = jnp.where(false, (2 * draws[4] - 1) * jnp.pi, bearing)
    return jnp.stack([reach, wrap(bearing)]), near


def _sighting_draws(scenario: Scenario) -> int:
    return 5 if scenario.outliers else 2


def _check_noise(noise: Noise) -> None:
    checks.shapes(**{f"noise.{name}": (value, ()) for name, value in noise._asdict().items()})


def draw_scan(words: Words, k: jax.Array, *, scenario: Scenario, dtype: Any) -> jax.Array:
    """Random numbers for `look_round` at step k, (B,).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("k", k, ())
    return normals(words, k, _SCAN, scenario.beams, dtype)


def look_round(draws: jax.Array, pose: jax.Array, world: World, noise: Noise, *, scenario: Scenario) -> jax.Array:
    """A scan of the walls, (B,) m. Noise is added after the cut at `max_range`, as the course has it.

    Args:
        draws: (B,) standard normals. pose: (3,) m, m, rad, the true one. world, noise: as their fields say.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("draws", draws, (scenario.beams,))
    _check_noise(noise)
    angles = scenario.beam_angles().astype(pose.dtype)
    exact = ray_cast(pose, angles, world.segments, scenario.max_range)
    return jnp.maximum(exact + draws * noise.scan, scenario.min_range)


def simulate(
    key: jax.Array,
    world: World,
    noise: Noise,
    start: jax.Array,
    *,
    scenario: Scenario,
    scan: bool = True,
) -> tuple[Truth, Inputs]:
    """One drive.

    Args:
        key: of this drive alone. world, noise: as their fields say.
        start: (3,) m, m, rad, the true pose at step -1: the prior's mean, or one from `draw_pose`. Its dtype is that
            of everything that follows.
        scenario: static. scan: False leaves out the scanner, which costs most of a simulation.

    Returns:
        The true poses and what the robot measured, both with a leading axis T: the control with noise; every
        `sight_period` steps, landmarks in reach, slot j holding landmark j; a scan a step.

    Raises:
        ValueError: a wrong shape; a batch of drives is a `vmap`.
    """
    checks.shapes(start=(start, (3,)), landmarks=(world.landmarks, (None, 2)))
    checks.shape("key", key, () if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else (None,))
    words, dtype, landmarks = words_of(key), start.dtype, jnp.arange(len(world.landmarks))

    def numbers(k: jax.Array) -> Draws:
        return Draws(
            drive=draw_drive(words, k, dtype),
            sighting=jax.vmap(lambda j: draw_sighting(words, k, j, scenario=scenario, dtype=dtype))(landmarks),
            scan=draw_scan(words, k, scenario=scenario, dtype=dtype) if scan else None,
        )

    return roll_out(jax.vmap(numbers)(jnp.arange(scenario.steps)), world, noise, start, scenario=scenario)


def roll_out(draws: Draws, world: World, noise: Noise, start: jax.Array, *, scenario: Scenario) -> tuple[Truth, Inputs]:
    """`simulate` with given random numbers.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(start=(start, (3,)), landmarks=(world.landmarks, (None, 2)))
    checks.shape("draws.drive", draws.drive, (scenario.steps, 3))
    sightings = (scenario.steps, len(world.landmarks), _sighting_draws(scenario))
    checks.shape("draws.sighting", draws.sighting, sightings)
    if draws.scan is not None:
        checks.shape("draws.scan", draws.scan, (scenario.steps, scenario.beams))

    def body(pose: jax.Array, now: tuple[jax.Array, Draws]) -> tuple[jax.Array, tuple[Truth, Inputs]]:
        k, draws = now
        pose, control = drive(draws.drive, k, pose, noise, scenario=scenario)
        z, near = jax.vmap(lambda d, landmark: sight(d, pose, landmark, noise, scenario=scenario))(
            draws.sighting, world.landmarks
        )
        valid = near & scenario.looks(k)
        inputs = Inputs(
            dt=jnp.asarray(scenario.dt, pose.dtype),
            control=control,
            landmark=jnp.arange(len(valid), dtype=jnp.int32),
            z=jnp.where(valid[:, None], z, 0),
            valid=valid,
            ranges=None if draws.scan is None else look_round(draws.scan, pose, world, noise, scenario=scenario),
        )
        return pose, (Truth(pose), inputs)

    return batching.scan(body, start, (jnp.arange(scenario.steps), draws))[1]
