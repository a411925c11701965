"""Records that travel between the modules, with the shape and unit of every field beside it."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxlocmap import checks
from jaxlocmap.se2 import POSE, Offset


class Gaussian(NamedTuple):
    """A belief about a state of n entries, the first three of which are the robot's pose (x, y, theta)."""

    mean: jax.Array  # (n,) m, m, rad, then as the motion model has it; heading wrapped to [-pi, pi)
    cov: jax.Array  # (n, n) m^2, m rad, rad^2, ...

    def first(self, n: int) -> Gaussian:
        """The belief about the first n entries, or about all if there are no more."""
        if self.mean.shape[-1] <= n:
            return self
        return Gaussian(self.mean[..., :n], self.cov[..., :n, :n])

    @property
    def pose(self) -> Gaussian:
        """The belief about the pose alone."""
        return self.first(POSE)


@dataclasses.dataclass(frozen=True)
class GridSpec:
    """Where the occupancy grid lies and how far its log-odds may go. Static under jit.

    Row is y, column is x; cell (0, 0) is the lower-left corner, at `origin`.

    Raises:
        ValueError: no cells, a resolution that is not positive, or bounds without 0 between them.
        TypeError: a field that is no number, or no pair of them.
    """

    origin: tuple[float, float]  # m, world frame
    resolution: float  # m per cell
    shape: tuple[int, int]  # rows (y), columns (x)
    l_min: float = -4.0  # nats
    l_max: float = 4.0  # nats

    def __post_init__(self) -> None:
        freeze_tuples(self, "origin", "shape")
        for name in ("resolution", "l_min", "l_max"):
            checks.number(name, getattr(self, name))
        if len(self.shape) != 2 or min(self.shape) < 1 or any(int(n) != n for n in self.shape):
            raise ValueError(f"shape: expected (rows, columns), whole numbers of at least 1, got {self.shape}")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"resolution: expected metres per cell > 0, got {self.resolution}")
        if len(self.origin) != 2 or not all(math.isfinite(c) for c in self.origin):
            raise ValueError(f"origin: expected two finite coordinates in metres, got {self.origin}")
        if not self.l_min < 0 < self.l_max:
            raise ValueError(f"l_min, l_max: expected l_min < 0 < l_max, got {self.l_min}, {self.l_max}")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings that shape the program. Frozen and hashable, so static under jit.

    Raises:
        ValueError: a field outside the range given beside it; a motion model's name is looked up by `run`.
        TypeError: a field that is no number, or an offset that is not three of them.
    """

    dt: float = 0.1  # s, > 0: the period that Q refers to
    motion: Any = "arc"  # "euler" | "arc" | "capstone" | motion.MotionModel
    gate_probability: float | None = 0.99  # in (0, 1): share of good observations let in; None: no gate
    gate_temperature: float = 0.0  # >= 0, of the squared distance: 0 decides, more weighs (`ekf.gate_weight`)
    sensor_offset: Offset = (0.0, 0.0, 0.0)  # m, m, rad: where the sensor sits in the body frame
    grid: GridSpec | None = None  # None: localisation alone
    min_range: float = 0.05  # m: a range of the scanner at or below is no measurement
    max_range: float = 8.0  # m: a range at or above clears cells up to here and marks none
    scanner_offset: Offset = (0.0, 0.0, 0.0)  # m, m, rad: where the scanner sits in the body frame
    sensor: Any = "range_bearing"  # or a sensors.Sensor: what the observation slots hold
    matcher: Matcher | None = None  # None: scans make the map and correct no pose

    def __post_init__(self) -> None:
        freeze_tuples(self, "sensor_offset", "scanner_offset")
        for name in ("dt", "gate_temperature", "min_range", "max_range"):
            checks.number(name, getattr(self, name))
        gate = self.gate_probability
        if gate is not None:
            checks.number("gate_probability", gate)
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt: expected seconds > 0, got {self.dt}")
        if gate is not None and not 0 < gate < 1:
            raise ValueError(
                f"gate_probability: expected a probability inside (0, 1), or None for no gate, "
                f"got {self.gate_probability}"
            )
        if not 0 <= self.gate_temperature < math.inf:
            raise ValueError(f"gate_temperature: expected a finite width >= 0, got {self.gate_temperature}")
        for name in ("sensor_offset", "scanner_offset"):
            offset = getattr(self, name)
            if len(offset) != 3 or not all(math.isfinite(c) for c in offset):
                raise ValueError(f"{name}: expected finite (dx, dy, dtheta), got {offset}")
        if not 0 <= self.min_range < self.max_range < math.inf:
            raise ValueError(
                f"min_range, max_range: expected 0 <= min_range < max_range, got {self.min_range}, {self.max_range}"
            )

    def scanner(self, beam_angles: jax.Array) -> Scanner:
        """The scanner with these beams, (B,) rad in its own frame."""
        return Scanner(beam_angles, self.scanner_offset, self.min_range, self.max_range)


@dataclasses.dataclass(frozen=True)
class Matcher:
    """How scans are matched on submaps of what was seen before. Frozen and hashable, so static under jit.

    Raises:
        ValueError: a field outside the range given beside it.
        TypeError: a field that is no number.
    """

    period: int = 1  # steps between two matches, the first at step 0; >= 1
    submap_scans: int | None = 10  # a new submap begins that often, and lives twice as long; >= 2; None: one map
    submap_length: float = 4.0  # m of travel, > 0, a turn of a radian counted as half a metre: or after that
    resolution: float = 0.1  # m per cell, > 0
    half_width: float = 12.0  # m of a submap about its anchor: the reach of a scan and some travel; > resolution
    range_std: float = 0.03  # m, > 0, of a range: points farther off a surface have no normal (`surface_points`)
    gap: float = 0.5  # m, > 0: ends of neighbouring beams farther apart than this lie on two surfaces
    steps: int = 10  # of Gauss-Newton; >= 1
    window: tuple[float, float] | None = None  # m, rad, > 0: how far to search before; None: not
    gate_probability: float = 0.999  # in (0, 1): share of good matches let in
    least_points: int = 10  # with a normal, that a scan must have; >= 1
    least_share: float = 0.2  # in (0, 1), of a scan's points that must lie on lines of the submap
    patience: int = 5  # matches refused in a row before the submaps are begun anew; >= 1
    known_std: tuple[float, float] | None = None  # m, rad, > 0: errors of a known map, not to be changed; None: made

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if field.name not in ("window", "known_std") and getattr(self, field.name) is not None:
                checks.number(field.name, getattr(self, field.name))
        for name, least in (("period", 1), ("submap_scans", 2), ("steps", 1), ("least_points", 1), ("patience", 1)):
            value = getattr(self, name)
            if value is not None and (int(value) != value or value < least):
                raise ValueError(f"Matcher.{name}: expected a whole number of at least {least}, got {value}")
        for name in ("window", "known_std"):
            if getattr(self, name) is not None:
                freeze_tuples(self, name)
                pair = getattr(self, name)
                if len(pair) != 2 or not all(0 < x < math.inf for x in pair):
                    raise ValueError(f"Matcher.{name}: expected two finite numbers > 0, m and rad, got {pair}")
        for name in ("gate_probability", "least_share"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"Matcher.{name}: expected a value inside (0, 1), got {getattr(self, name)}")
        for name in ("resolution", "range_std", "gap", "submap_length", "half_width"):
            least = self.resolution if name == "half_width" else 0
            if not least < getattr(self, name) < math.inf:
                raise ValueError(f"Matcher.{name}: expected finite metres > {least}, got {getattr(self, name)}")

    @property
    def maps(self) -> int:
        """How many there are at a time."""
        return 1 if self.submap_scans is None or self.known_std is not None else 2

    @property
    def spec(self) -> GridSpec:
        """The grid of a submap, in the frame of its anchor."""
        cells = 2 * math.ceil(self.half_width / self.resolution)
        corner = -cells / 2 * self.resolution
        return GridSpec(origin=(corner, corner), resolution=self.resolution, shape=(cells, cells))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scanner:
    """A laser scanner. A pytree whose beam angles are an array; the rest is static under jit."""

    beam_angles: jax.Array  # (B,) rad, in the scanner's frame
    offset: Offset = dataclasses.field(default=(0.0, 0.0, 0.0), metadata={"static": True})  # m, m, rad, body frame
    min_range: float = dataclasses.field(default=0.05, metadata={"static": True})  # m, as in `Config`
    max_range: float = dataclasses.field(default=8.0, metadata={"static": True})  # m, as in `Config`


def freeze_tuples(record: Any, *names: str) -> None:
    """Lists and arrays become tuples, so that the record can be hashed."""
    for name in names:
        value = getattr(record, name)
        if not isinstance(value, (tuple, list, np.ndarray)):
            raise TypeError(f"{name}: expected a tuple of numbers, got {value!r}")
        for entry in value:
            checks.number(name, entry)
        object.__setattr__(record, name, tuple(value))


class Inputs(NamedTuple):
    """What the robot measured, one row a step. M observation slots of m numbers (`Config.sensor`), B beams.

    Step k: control k moves the pose over `dt[k]`, the slots of step k correct it, its scan goes into the map.
    """

    dt: jax.Array  # (T,) s, >= 0
    control: jax.Array  # (T, c) v m/s, omega rad/s, or what the motion model takes
    landmark: jax.Array  # (T, M) int32: row of `landmarks`, -1 (or any below 0) for unknown; any without landmarks
    z: jax.Array  # (T, M, m) range m, > 0, bearing rad, or what the sensor measures
    valid: jax.Array  # (T, M) bool: the slot holds an observation
    ranges: jax.Array | None = None  # (T, B) m; None without a scanner


class State(NamedTuple):
    """What the next step needs: the carry of the scan."""

    belief: Gaussian
    log_odds: jax.Array | None  # (rows, columns) nats; None without a grid
    log_likelihood: jax.Array  # () nats: sum over every observation so far, let in or not
    submaps: Any = None  # matching.submaps.Submaps; None without a matcher


class Info(NamedTuple):
    """What one step reports. Entries of empty slots are zero. What the gate refuses is no fault: see `accepted`."""

    belief: Gaussian  # after the step's corrections
    innovation: jax.Array  # (M, m) m, rad for range and bearing: z minus its prediction, angles wrapped
    S: jax.Array  # (M, m, m) covariance of the innovation
    nis: jax.Array  # (M,) squared Mahalanobis distance of the innovation, gated or not
    accepted: jax.Array  # (M,) bool: the gate let it in; a soft one would give it half its weight or more
    log_likelihood: jax.Array  # (M,) nats: log density of the innovation, gated or not
    row: jax.Array  # (M,) int32: row of `landmarks` the observation was taken for, -1 in an empty slot
    ok: jax.Array  # () bool: inputs finite, covariance positive semi-definite
    match: Any = None  # matching.submaps.MatchReport; None without a matcher or a scanner


class Truth(NamedTuple):
    """What really happened, known to the simulation or a tracking system."""

    state: jax.Array  # (T, n) m, m, rad, then as the plant's motion model has it

    @property
    def pose(self) -> jax.Array:
        """(T, 3) m, m, rad."""
        return self.state[..., :POSE]
