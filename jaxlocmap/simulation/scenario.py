"""Scenarios: a drive, the sensors on board, and the noise of both. What the filter believes is no part of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap._internal.trig import arctan2
from jaxlocmap.motion import wrap
from jaxlocmap.types import Config, Gaussian, GridSpec, Params, check_offset, freeze_tuples


class Noise(NamedTuple):
    """Standard deviations of the plant and its sensors: the truth that `Params` tries to describe."""

    heading: jax.Array | float = 0.005  # rad a step, what the plant adds to its turn
    v: jax.Array | float = 0.02  # m/s, measured speed against commanded
    w: jax.Array | float = 0.01  # rad/s, measured yaw rate against commanded
    range: jax.Array | float = 0.08  # m, landmark detector
    bearing: jax.Array | float = 0.02  # rad, landmark detector
    scan: jax.Array | float = 0.03  # m, each beam
    outlier_rate: jax.Array | float = 0.0  # share of sightings that are false, where `Scenario.outliers`


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
