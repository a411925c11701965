"""Simulated robots: keys in, `Truth` and `Inputs` out.

A world is data (walls, landmarks), so is the plant's noise; both may differ from run to run under `vmap`. What the
filter believes, its `Params`, is no part of a simulation. All randomness is a `Draws` of standard normals, so a
program with a generator of its own can hand in its numbers through `roll_out`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.motion import wrap
from jaxlocmap.types import Config, Gaussian, GridSpec, Inputs, Params, Truth


class World(NamedTuple):
    """What stands around the robot."""

    segments: jax.Array  # (S, 2, 2) m: walls, from point to point
    landmarks: jax.Array  # (L, 2) m


class Noise(NamedTuple):
    """Standard deviations of the plant and its sensors: the truth that `Params` tries to describe."""

    heading: jax.Array | float = 0.005  # rad a step, what the plant adds to its turn
    v: jax.Array | float = 0.02  # m/s, measured speed against commanded
    w: jax.Array | float = 0.01  # rad/s, measured yaw rate against commanded
    range: jax.Array | float = 0.08  # m, landmark detector
    bearing: jax.Array | float = 0.02  # rad, landmark detector
    scan: jax.Array | float = 0.03  # m, each beam


class Draws(NamedTuple):
    """Standard normal numbers, one simulation's worth."""

    heading: jax.Array  # (T,)
    control: jax.Array  # (T, 2)
    sighting: jax.Array  # (ceil(T / sight_period), L, 2)
    scan: jax.Array | None  # (T, B); None without a scanner


_COURSE_GRID = GridSpec(origin=(0.0, 0.0), resolution=0.2, shape=(120, 120))


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A drive and the sensors on board. Frozen and hashable, so static under jit."""

    name: str
    steps: int
    command: Callable[[jax.Array, jax.Array], jax.Array]  # (step, true pose) -> (v, omega) to drive
    start: tuple[float, float, float]  # m, m, rad: mean of the prior
    prior_std: tuple[float, float, float] = (0.05**0.5, 0.05**0.5, 0.02**0.5)  # m, m, rad
    dt: float = 0.1  # s
    sight_range: float = 7.5  # m: the detector reports landmarks whose measured range is below
    sight_period: int = 5  # steps between two looks of the detector, the first at step 0
    beams: int = 61
    half_view: float = 1.2  # rad: beams from -half_view to half_view
    max_range: float = 8.0  # m
    min_range: float = 0.05  # m
    grid: GridSpec = _COURSE_GRID
    exact_prior: bool = True  # the true start is the prior's mean; otherwise it is drawn from the prior

    def prior(self) -> Gaussian:
        """The belief at step -1, in the default float type."""
        return Gaussian(jnp.array(self.start), jnp.diag(jnp.array(self.prior_std) ** 2))

    def beam_angles(self) -> jax.Array:
        """(B,) rad, body frame."""
        return jnp.asarray(np.linspace(-self.half_view, self.half_view, self.beams), jnp.result_type(float))

    def config(self, *, motion: Any = "arc", gate_probability: float | None = 0.99, grid: bool = True) -> Config:
        """The filter's settings that fit this robot."""
        return Config(
            dt=self.dt,
            motion=motion,
            gate_probability=gate_probability,
            grid=self.grid if grid else None,
            min_range=self.min_range,
            max_range=self.max_range,
        )


def room() -> World:
    """A room of 12 x 12 m with one box in it and four landmarks."""
    corners = [
        [(0.0, 0.0), (12.0, 0.0), (12.0, 12.0), (0.0, 12.0)],
        [(4.5, 4.0), (7.5, 4.0), (7.5, 6.5), (4.5, 6.5)],
    ]
    walls = [(ring[i], ring[(i + 1) % 4]) for ring in corners for i in range(4)]
    return World(
        segments=jnp.array(walls),
        landmarks=jnp.array([[2.0, 10.0], [10.0, 2.5], [9.5, 10.5], [2.0, 5.5]]),
    )


def course_params() -> Params:
    """The noise the course's filter believes in, which is not the plant's: R is too wide, Q's yaw rate too narrow."""
    return Params.from_std(v=0.02, w=0.03, range=0.15, bearing=0.03)


def _capstone_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    k = k.astype(pose.dtype)
    return jnp.stack([0.35 + 0.05 * jnp.sin(0.05 * k), 0.25 * jnp.sin(0.03 * k)])


_LOOP_CENTRE, _LOOP_RADIUS, _LOOP_STEPS = (6.0, 5.4), 3.0, 600  # m, m, steps a lap


def _loop_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    """Round a circle, steered by the true pose, so that the drive stays in free space however long it lasts."""
    del k
    dx, dy = pose[0] - _LOOP_CENTRE[0], pose[1] - _LOOP_CENTRE[1]
    outside = jnp.hypot(dx, dy) - _LOOP_RADIUS
    off_course = wrap(pose[2] - jnp.arctan2(dy, dx) - jnp.pi / 2)
    v = 2 * jnp.pi * _LOOP_RADIUS / (_LOOP_STEPS * 0.1)
    return jnp.stack([jnp.asarray(v, pose.dtype), v / _LOOP_RADIUS + 0.5 * outside - 1.0 * off_course])


CAPSTONE = Scenario(name="capstone", steps=240, command=_capstone_command, start=(1.0, 1.0, 0.0))
"""The drive of the course: 24 s along a smooth path from the lower left. The path crosses the box, because the plant
knows no collisions: near the end the robot stands inside it and its beams end on the box's inner sides."""

LOOP = Scenario(
    name="loop",
    steps=2 * _LOOP_STEPS,
    command=_loop_command,
    start=(9.0, 5.4, float(np.pi) / 2),
    exact_prior=False,
)
"""Two laps of a circle of 3 m around the box, through free space: the steady state of a filter. Its prior is honest:
the true start is drawn from it."""

SCENARIOS = {scenario.name: scenario for scenario in (CAPSTONE, LOOP)}


def draw_pose(key: jax.Array, prior: Gaussian) -> jax.Array:
    """A true pose (3,), m, m, rad, from the prior, so that the prior is honest.

    To start exactly where the filter believes, use `prior.mean`.
    """
    variance, axes = jnp.linalg.eigh(prior.cov)  # unlike Cholesky, content with a variance of zero
    spread = jnp.sqrt(jnp.maximum(variance, 0)) * jax.random.normal(key, (3,), prior.mean.dtype)
    pose = prior.mean + axes @ spread
    return pose.at[2].set(wrap(pose[2]))


def draw(key: jax.Array, *, scenario: Scenario, landmarks: int, scan: bool = True) -> Draws:
    """The standard normals of one simulation, in the default float type.

    Args:
        key: of this simulation alone. scenario: static. landmarks: how many the world has.
        scan: whether the robot has its scanner on.
    """
    heading, control, sighting, beams = jax.random.split(key, 4)
    looks = -(-scenario.steps // scenario.sight_period)
    return Draws(
        heading=jax.random.normal(heading, (scenario.steps,)),
        control=jax.random.normal(control, (scenario.steps, 2)),
        sighting=jax.random.normal(sighting, (looks, landmarks, 2)),
        scan=jax.random.normal(beams, (scenario.steps, scenario.beams)) if scan else None,
    )


def simulate(
    key: jax.Array,
    world: World,
    noise: Noise,
    start: jax.Array,
    *,
    scenario: Scenario,
    scan: bool = True,
) -> tuple[Truth, Inputs]:
    """One drive: `draw`, then `roll_out`.

    Args:
        key: of this drive alone. world, noise: as their fields say.
        start: (3,) m, m, rad, the true pose at step -1: the prior's mean, or one from `draw_pose`.
        scenario: static. scan: False leaves out the scanner, which costs most of a simulation.

    Returns:
        The true poses and what the robot measured, as `roll_out` says.
    """
    draws = draw(key, scenario=scenario, landmarks=len(world.landmarks), scan=scan)
    return roll_out(draws, world, noise, start, scenario=scenario)


def roll_out(draws: Draws, world: World, noise: Noise, start: jax.Array, *, scenario: Scenario) -> tuple[Truth, Inputs]:
    """One drive with given random numbers.

        x ← x + v cos(theta) dt,  y ← y + v sin(theta) dt,  theta ← wrap(theta + omega dt + heading noise)

    Args:
        draws: standard normals. world, noise: as their fields say.
        start: (3,) m, m, rad, the true pose at step -1.
        scenario: static.

    Returns:
        The true poses, and what the robot measured: the commanded control with noise; every `sight_period` steps the
        range and bearing of each landmark nearer than `sight_range`, slot j holding landmark j; a scan a step if
        `draws.scan` is there (noise is added after the cut at `max_range`, as the course has it).
    """
    steps = jnp.arange(scenario.steps)

    def drive(pose: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, Any]:
        k, kick = now
        control = scenario.command(k, pose)
        pose = jnp.stack(
            [
                pose[0] + control[0] * jnp.cos(pose[2]) * scenario.dt,
                pose[1] + control[0] * jnp.sin(pose[2]) * scenario.dt,
                wrap(pose[2] + control[1] * scenario.dt + noise.heading * kick),
            ]
        )
        return pose, (pose, control)

    _, (poses, controls) = jax.lax.scan(drive, start, (steps, draws.heading))
    control = controls + draws.control * jnp.stack([jnp.asarray(noise.v), jnp.asarray(noise.w)])[None]

    count = len(world.landmarks)
    looking = slice(None, None, scenario.sight_period)
    delta = world.landmarks[None] - poses[looking, None, :2]
    exact = jnp.stack(
        [
            jnp.hypot(delta[..., 0], delta[..., 1]),
            jnp.arctan2(delta[..., 1], delta[..., 0]) - poses[looking, None, 2],
        ],
        axis=-1,
    )
    z = exact + draws.sighting * jnp.stack([jnp.asarray(noise.range), jnp.asarray(noise.bearing)])[None, None]
    z = z.at[..., 1].set(wrap(z[..., 1]))
    sighted = z[..., 0] < scenario.sight_range
    inputs = Inputs(
        dt=jnp.full(scenario.steps, scenario.dt, poses.dtype),
        control=control,
        landmark=jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32)[None], (scenario.steps, count)),
        z=jnp.zeros((scenario.steps, count, 2), poses.dtype).at[looking].set(z),
        valid=jnp.zeros((scenario.steps, count), bool).at[looking].set(sighted),
        ranges=None if draws.scan is None else _scan(draws.scan, poses, world, noise, scenario),
    )
    return Truth(poses), inputs


def _scan(draws: jax.Array, poses: jax.Array, world: World, noise: Noise, scenario: Scenario) -> jax.Array:
    cast = jax.vmap(lambda pose: ray_cast(pose, scenario.beam_angles(), world.segments, scenario.max_range))
    return jnp.maximum(cast(poses) + draws * noise.scan, scenario.min_range)


def ray_cast(pose: jax.Array, beam_angles: jax.Array, segments: jax.Array, max_range: float) -> jax.Array:
    """Distance along each beam to the nearest wall, `max_range` where there is none.

    Args:
        pose: (3,) m, m, rad. beam_angles: (B,) rad, body frame. segments: (S, 2, 2) m.

    Returns:
        (B,) m.
    """
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    table_cos, table_sin = jnp.cos(beam_angles), jnp.sin(beam_angles)
    dx = (cos * table_cos - sin * table_sin)[:, None]  # (B, 1)
    dy = (sin * table_cos + cos * table_sin)[:, None]
    wall = segments[:, 1] - segments[:, 0]  # (S, 2)
    away = pose[None, :2] - segments[:, 0]  # (S, 2)
    # pose + t d = a + s wall, by Cramer's rule
    wall_x, wall_y, away_x, away_y = wall[None, :, 0], wall[None, :, 1], away[None, :, 0], away[None, :, 1]
    det = dx * wall_y - dy * wall_x  # (B, S)
    safe = jnp.where(jnp.abs(det) < 1e-9, 1, det)  # a beam along the wall does not hit it
    s = (dx * away_y - dy * away_x) / safe
    t = (wall_x * away_y - wall_y * away_x) / safe
    hits = (jnp.abs(det) >= 1e-9) & (s >= 0) & (s <= 1) & (t >= 0)
    return jnp.min(jnp.where(hits, t, max_range), axis=1, initial=max_range)


def occupancy(world: World, spec: GridSpec) -> jax.Array:
    """The true map: the cells a wall runs through. A wall along the edge of two cells occupies both.

    Returns:
        (rows, columns) bool.
    """
    rows, columns = spec.shape
    dtype = world.segments.dtype
    low_x = spec.origin[0] + spec.resolution * jnp.arange(columns, dtype=dtype)[None, :, None]
    low_y = spec.origin[1] + spec.resolution * jnp.arange(rows, dtype=dtype)[:, None, None]
    first, along = (x[None, None] for x in (world.segments[:, 0], world.segments[:, 1] - world.segments[:, 0]))
    reach = spec.resolution * 1e-3  # a wall on the edge must not depend on rounding
    enter, leave = jnp.zeros((), dtype), jnp.ones((), dtype)
    # Clip every wall against every cell, one axis after the other (Liang & Barsky 1984).
    for axis, low in ((0, low_x), (1, low_y)):
        near, far = low - reach - first[..., axis], low + spec.resolution + reach - first[..., axis]
        step = along[..., axis]
        safe = jnp.where(step != 0, step, 1)
        t0, t1 = jnp.minimum(near / safe, far / safe), jnp.maximum(near / safe, far / safe)
        between = (near <= 0) & (far >= 0)
        across = jnp.broadcast_to(step != 0, near.shape)
        enter = jnp.maximum(enter, jnp.where(across, t0, jnp.where(between, 0, jnp.inf)))
        leave = jnp.minimum(leave, jnp.where(across, t1, jnp.where(between, 1, -jnp.inf)))
    return jnp.any(enter <= leave, axis=-1)
