"""Simulated robots: keys in, `Truth` and `Inputs` out.

A world is data (walls, landmarks), so is the plant's noise; both may differ from run to run under `vmap`. What the
filter believes, its `Params`, is no part of a simulation. `drive`, `sight` and `look_round` each make one step out of
given random numbers, so that a study can simulate and filter in one loop and keep neither; `roll_out` makes a whole
drive of them, also for a program with a generator of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import batching, checks
from jaxlocmap.landmarks import sensor_pose
from jaxlocmap.motion import wrap
from jaxlocmap.normals import Words, normals, uniforms, words_of
from jaxlocmap.trig import arctan2, sin_cos
from jaxlocmap.types import Config, Gaussian, GridSpec, Inputs, Params, Truth, check_offset, freeze_tuples
from jaxlocmap.world import World, occupancy, ray_cast, room  # noqa: F401 (a simulation needs its world too)


class Noise(NamedTuple):
    """Standard deviations of the plant and its sensors: the truth that `Params` tries to describe."""

    heading: jax.Array | float = 0.005  # rad a step, what the plant adds to its turn
    v: jax.Array | float = 0.02  # m/s, measured speed against commanded
    w: jax.Array | float = 0.01  # rad/s, measured yaw rate against commanded
    range: jax.Array | float = 0.08  # m, landmark detector
    bearing: jax.Array | float = 0.02  # rad, landmark detector
    scan: jax.Array | float = 0.03  # m, each beam
    outlier_rate: jax.Array | float = 0.0  # share of sightings that are false, where `Scenario.outliers`


class Draws(NamedTuple):
    """The random numbers of a drive; what they are for is said where they are used."""

    drive: jax.Array  # (T, 3)
    sighting: jax.Array  # (T, L, 2), or (T, L, 5) with outliers; used at the steps at which the detector looks
    scan: jax.Array | None = None  # (T, B); None without a scanner


# Where each use of a step's random numbers begins.
_DRIVE, _SIGHTINGS, _SCAN = 0, 1 << 20, 1 << 30

_COURSE_GRID = GridSpec(origin=(0.0, 0.0), resolution=0.2, shape=(120, 120))


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A drive and the sensors on board. Frozen and hashable, so static under jit.

    Raises:
        ValueError: no steps, looks or beams, or a place of the detector that is none.
        TypeError: a place that is no tuple of numbers.
    """

    name: str
    steps: int
    command: Callable[[jax.Array, jax.Array], jax.Array]  # (step, true pose) -> (v, omega) to drive
    start: tuple[float, float, float]  # m, m, rad: mean of the prior
    prior_std: tuple[float, float, float] = (0.05**0.5, 0.05**0.5, 0.02**0.5)  # m, m, rad
    dt: float = 0.1  # s
    sight_range: float = 7.5  # m: the detector reports landmarks nearer than this
    sight_period: int = 5  # steps between two looks of the detector, the first at step 0
    beams: int = 61
    half_view: float = 1.2  # rad: beams from -half_view to half_view
    max_range: float = 8.0  # m
    min_range: float = 0.05  # m
    grid: GridSpec = _COURSE_GRID
    outliers: bool = False  # some sightings are false: at any range within reach, in any direction
    exact_prior: bool = True  # the true start is the prior's mean; otherwise it is drawn from the prior
    sensor_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, m, rad: landmark detector in the body frame

    def __post_init__(self) -> None:
        freeze_tuples(self, "sensor_offset")
        check_offset(self.sensor_offset)
        for name in ("steps", "sight_period", "beams"):
            if getattr(self, name) < 1:
                raise ValueError(f"Scenario.{name}: expected at least 1, got {getattr(self, name)}")

    def looks(self, k: jax.Array) -> jax.Array:
        """Whether the detector looks at step k."""
        return k % self.sight_period == 0

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
            sensor_offset=self.sensor_offset,
            grid=self.grid if grid else None,
            min_range=self.min_range,
            max_range=self.max_range,
        )


def course_params() -> Params:
    """The noise the course's filter believes in, which is not the plant's: R is too wide, Q's yaw rate too narrow."""
    return Params.from_std(v=0.02, w=0.03, range=0.15, bearing=0.03)


def own_params(noise: Noise, dt: float) -> Params:
    """The robot's own noise, for a filter with `euler` motion, which is the plant's model: the heading noise of a step
    is what a yaw rate's would be that acts for its length.
    """
    w = (float(noise.w) ** 2 + (float(noise.heading) / dt) ** 2) ** 0.5
    return Params.from_std(v=float(noise.v), w=w, range=float(noise.range), bearing=float(noise.bearing))


def _capstone_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    k = k.astype(pose.dtype)
    return jnp.stack([0.35 + 0.05 * jnp.sin(0.05 * k), 0.25 * jnp.sin(0.03 * k)])


_LOOP_CENTRE, _LOOP_RADIUS, _LOOP_STEPS = (6.0, 5.4), 3.0, 600  # m, m, steps a lap


def _loop_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    """Round a circle, steered by the true pose, so that the drive stays in free space however long it lasts."""
    del k
    dx, dy = pose[0] - _LOOP_CENTRE[0], pose[1] - _LOOP_CENTRE[1]
    outside = jnp.hypot(dx, dy) - _LOOP_RADIUS
    off_course = wrap(pose[2] - arctan2(dy, dx) - jnp.pi / 2)
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
