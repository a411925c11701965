"""Scenarios: a drive, the robot that drives it, and the noise of both. What the filter believes is no part of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import motion, sensors
from jaxlocmap._internal.trig import arctan2
from jaxlocmap.motion import MotionModel
from jaxlocmap.parameters import Block, Params, Q, R
from jaxlocmap.se2 import POSE, wrap
from jaxlocmap.simulation.world import World, building, room
from jaxlocmap.types import Config, Gaussian, GridSpec


class Noise(NamedTuple):
    """Standard deviations of the robot and its sensors: the truth that `Params` tries to describe."""

    heading: jax.Array | float = 0.005  # rad a step, what the plant of the course adds to its turn
    v: jax.Array | float = 0.02  # m/s, measured speed against commanded
    w: jax.Array | float = 0.01  # rad/s, measured yaw rate against commanded
    range: jax.Array | float = 0.08  # m, landmark detector
    bearing: jax.Array | float = 0.02  # rad, landmark detector
    scan: jax.Array | float = 0.03  # m, each beam
    outlier_rate: jax.Array | float = 0.0  # share of observations that are false, where `Detector.outliers`
    blocks: Mapping[str, Any] = {}  # (m,) or (), of the components of other blocks, by `Block.name`

    def std(self, block: Block) -> list[Any]:
        """Of the components of a block, () each.

        Raises:
            ValueError: no or another number of them.
        """
        if block == Q:
            return [self.v, self.w]
        if block == R:
            return [self.range, self.bearing]
        std, m = self.blocks.get(block.name), len(block.components)
        if std is None or np.shape(std) not in ((m,), ()):
            got = "none" if std is None else f"shape {np.shape(std)}"
            raise ValueError(f"noise.blocks[{block.name!r}]: expected {m} standard deviations, got {got}")
        return [std[i] for i in range(m)] if np.ndim(std) else [std] * m


@dataclasses.dataclass(frozen=True)
class Detector:
    """When the robot's sensor reports a landmark. Frozen and hashable, so static under jit.

    Raises:
        ValueError: a period below one step, a reach that is none, or a field of view outside (0, 2π].
    """

    max_range: float = 7.5  # m: landmarks nearer than this are reported
    min_range: float = 0.0  # m: unless nearer than this
    field_of_view: float = 2 * math.pi  # rad, centred on the sensor's heading
    period: int = 5  # steps between two detections, the first at step 0
    occlusion: bool = False  # walls hide the landmarks behind them
    outliers: bool = False  # some observations are false: ranges anywhere within reach, angles anywhere

    def __post_init__(self) -> None:
        if self.period < 1:
            raise ValueError(f"Detector.period: expected at least 1 step, got {self.period}")
        if not 0 <= self.min_range < self.max_range:
            got = f"{self.min_range}, {self.max_range}"
            raise ValueError(f"Detector.min_range, max_range: expected 0 <= min_range < max_range, got {got}")
        if not 0 < self.field_of_view <= 2 * math.pi:
            raise ValueError(f"Detector.field_of_view: expected an angle in (0, 2π], got {self.field_of_view}")

    def active(self, k: jax.Array) -> jax.Array:
        """Whether the detector reports anything at step k."""
        return k % self.period == 0


MATCH_GAP = 0.8  # m: `Matcher.gap` for the course's 61 beams, whose ends lie far apart
KNOWN_START_STD = (1e-3, 1e-3, 1e-3)  # m, m, rad
_COURSE_GRID = GridSpec(origin=(0.0, 0.0), resolution=0.2, shape=(120, 120))


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A drive and the robot that drives it. Frozen and hashable, so static under jit.

    Raises:
        ValueError: no steps or beams, or a start that is no state of the plant.
    """

    name: str
    steps: int
    command: Callable[[jax.Array, jax.Array], jax.Array]  # (step, true pose) -> control to drive
    start: tuple[float, ...]  # m, m, rad, ...: mean of the prior
    prior_std: tuple[float, ...] = (0.05**0.5, 0.05**0.5, 0.02**0.5)  # m, m, rad, ...
    exact_prior: bool = True  # the true start is the prior's mean; otherwise it is drawn from the prior
    # What filter and robot have in common: the period, the sensor, where sensor and scanner sit, the scanner's ranges.
    robot: Config = Config(grid=_COURSE_GRID)  # noqa: RUF009 (frozen)
    plant: MotionModel | None = None  # how the state moves under its noise; None: as the course's robot (`drive`)
    detector: Detector = Detector()
    beams: int = 61
    half_view: float = 1.2  # rad: beams from -half_view to half_view

    def __post_init__(self) -> None:
        for name in ("steps", "beams"):
            if getattr(self, name) < 1:
                raise ValueError(f"Scenario.{name}: expected at least 1, got {getattr(self, name)}")
        least = POSE if self.plant is None else self.plant.dim
        if not len(self.start) == len(self.prior_std) >= least:
            got = f"{len(self.start)} and {len(self.prior_std)} entries"
            raise ValueError(f"Scenario.start, prior_std: expected the {least} of the plant's state or more, got {got}")

    @property
    def dt(self) -> float:
        """The period of a step, s."""
        return self.robot.dt

    @property
    def dim(self) -> int:
        """Entries of the true state."""
        return POSE if self.plant is None else self.plant.dim

    def prior(self) -> Gaussian:
        """The belief at step -1, in the default float type."""
        return Gaussian(jnp.array(self.start), jnp.diag(jnp.array(self.prior_std) ** 2))

    def beam_angles(self) -> jax.Array:
        """(B,) rad, in the scanner's frame."""
        return jnp.asarray(np.linspace(-self.half_view, self.half_view, self.beams), jnp.result_type(float))

    def config(self, *, motion: Any = "arc", gate_probability: float | None = 0.99, grid: bool = True) -> Config:
        """The filter's settings that fit this robot."""
        spec = self.robot.grid if grid else None
        return dataclasses.replace(self.robot, motion=motion, gate_probability=gate_probability, grid=spec)

    def check(self, config: Config) -> None:
        """Raise unless these are settings of a filter on this robot.

        Raises:
            ValueError: a setting that both have in common is another one.
        """
        for name in ("dt", "sensor", "sensor_offset", "scanner_offset", "min_range", "max_range"):
            ours, theirs = getattr(self.robot, name), getattr(config, name)
            same = sensors.resolve(theirs) == sensors.resolve(ours) if name == "sensor" else theirs == ours
            if not same:
                raise ValueError(f"config.{name}: expected that of the scenario, {ours}, got {theirs}")


def course_params() -> Params:
    """The noise the course's filter believes in, which is not the plant's: R is too wide, Q's yaw rate too narrow."""
    return Params.from_std(v=0.02, w=0.03, range=0.15, bearing=0.03)


def own_params(noise: Noise, scenario: Scenario) -> Params:
    """The robot's own noise, for a filter whose motion model is `own_motion`.

    The heading noise that the course's plant adds to a step is what a yaw rate's would be that acts for its length.
    """
    blocks = {}
    for block in (*motion.resolve(own_motion(scenario)).noise, sensors.resolve(scenario.robot.sensor).noise):
        std = [float(x) for x in noise.std(block)]
        if scenario.plant is None and block == Q:
            std[1] = math.hypot(std[1], float(noise.heading) / scenario.dt)
        blocks |= {block.name: std} if block not in (Q, R) else dict(zip(block.components, std, strict=True))
    return Params.from_std(**blocks)


def own_motion(scenario: Scenario) -> str | MotionModel:
    """The plant's motion model, for `Config.motion`."""
    return "euler" if scenario.plant is None else scenario.plant


def _capstone_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    k = k.astype(pose.dtype)
    return jnp.stack([0.35 + 0.05 * jnp.sin(0.05 * k), 0.25 * jnp.sin(0.03 * k)])


LOOP_CENTRE, LOOP_RADIUS, _LOOP_STEPS = (6.0, 5.4), 3.0, 600  # m, m, steps a lap


def _loop_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    """Round a circle, steered by the true pose, so that the drive stays in free space however long it lasts."""
    del k
    dx, dy = pose[0] - LOOP_CENTRE[0], pose[1] - LOOP_CENTRE[1]
    outside = jnp.hypot(dx, dy) - LOOP_RADIUS
    off_course = wrap(pose[2] - arctan2(dy, dx) - jnp.pi / 2)
    v = 2 * jnp.pi * LOOP_RADIUS / (_LOOP_STEPS * 0.1)
    return jnp.stack([jnp.asarray(v, pose.dtype), v / LOOP_RADIUS + 0.5 * outside - 1.0 * off_course])


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

_TOUR = np.array(
    [
        *((5, 10), (29, 10), (29, 6), (27, 4), (11, 4), (7, 4), (5, 6), (5, 10), (5, 14), (7, 16), (11, 16), (27, 16)),
        *((29, 14), (29, 10), (17, 10), (5, 10)),
    ],
    float,
)  # m, corners of a closed path through the building
_TOUR_SPEED, _TOUR_AHEAD = 0.48, 0.5  # m/s along it; m that the point steered for is ahead at the start


def _tour_command(k: jax.Array, pose: jax.Array) -> jax.Array:
    """Round the building after a point that moves along the tour, steered by the true pose."""
    lengths = np.hypot(*np.diff(_TOUR, axis=0).T)
    marks = jnp.asarray(np.concatenate([[0.0], np.cumsum(lengths)]), pose.dtype)
    along = jnp.mod(_TOUR_SPEED * 0.1 * k.astype(pose.dtype) + _TOUR_AHEAD, float(lengths.sum()))
    dx, dy = (jnp.interp(along, marks, jnp.asarray(_TOUR[:, i], pose.dtype)) - pose[i] for i in (0, 1))
    bearing = wrap(arctan2(dy, dx) - pose[2])
    v = jnp.clip(jnp.hypot(dx, dy), 0, 0.6) * jnp.maximum(jnp.cos(bearing), 0)
    return jnp.stack([v, jnp.clip(1.5 * bearing, -1.0, 1.0)])


BUILDING = Scenario(
    name="building",
    steps=7200,
    command=_tour_command,
    start=(5.0, 10.0, 0.0),
    robot=Config(grid=GridSpec(origin=(-1.0, -1.0), resolution=0.2, shape=(110, 180))),
)
"""Three rounds through the rooms and the corridor of `world.building`, where there is no landmark."""

RANDOM_BUILDING = dataclasses.replace(BUILDING, name="random_building")
"""The same rounds, of a building that `world.random_building` draws."""

SCENARIOS = {scenario.name: scenario for scenario in (CAPSTONE, LOOP, BUILDING, RANDOM_BUILDING)}


def scenario_of(name: str) -> Scenario:
    """The scenario of that name.

    Raises:
        ValueError: there is none.
    """
    if name not in SCENARIOS:
        raise ValueError(f"scenario: expected one of {sorted(SCENARIOS)}, got {name!r}")
    return SCENARIOS[name]


def world_of(scenario: Scenario) -> World:
    """What stands around the robot of a scenario; for random_building, one of those it may be."""
    return building() if scenario.name in (BUILDING.name, RANDOM_BUILDING.name) else room()


def with_known_start(scenario: Scenario) -> Scenario:
    """The scenario of a robot whose filter knows the start, to `KNOWN_START_STD`."""
    return dataclasses.replace(scenario, exact_prior=False, prior_std=KNOWN_START_STD)
