"""Records that travel between the modules, with the shape and unit of every field beside it."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks, files


class Params(NamedTuple):
    """Everything that is tuned: the noise the filter believes in and the inverse sensor model.

    All leaves are arrays, so a batch of parameters is a `vmap` and a gradient is a `grad`. The filter reads the upper
    triangles of Q and R, so a gradient by an off-diagonal entry stands in the upper triangle alone.
    """

    Q: jax.Array  # (2, 2) covariance of (v, omega) over one nominal period, (m/s)^2, (rad/s)^2
    R: jax.Array  # (2, 2) covariance of (range, bearing), m^2, rad^2
    l_occ: jax.Array  # () log-odds added to a beam's terminal cell, nats, > 0
    l_free: jax.Array  # () log-odds added to every cell a beam crosses, nats, < 0

    @classmethod
    def from_std(
        cls,
        *,
        v: float,
        w: float,
        range: float,
        bearing: float,
        l_occ: float = 0.85,
        l_free: float = -0.40,
    ) -> Params:
        """Diagonal Q and R from standard deviations (m/s, rad/s, m, rad).

        Raises:
            ValueError: a deviation that is not positive and finite, `l_occ <= 0` or `l_free >= 0`.
        """
        for name, value in (("v", v), ("w", w), ("range", range), ("bearing", bearing)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: expected a positive, finite deviation, got {value}")
        params = cls(
            Q=jnp.diag(jnp.array([v**2, w**2])),
            R=jnp.diag(jnp.array([range**2, bearing**2])),
            l_occ=jnp.array(float(l_occ)),
            l_free=jnp.array(float(l_free)),
        )
        params.check()
        return params

    def check(self) -> None:
        """Raise if a value cannot be used; values that are still being traced pass.

        Raises:
            ValueError: wrong shapes, Q or R not symmetric positive definite, `l_occ` or `l_free`
                not finite or of the wrong sign.
        """
        checks.covariance("Q", self.Q, 2, definite=True)
        checks.covariance("R", self.R, 2, definite=True)
        for name, value, sign in (("l_occ", self.l_occ, 1), ("l_free", self.l_free, -1)):
            checks.shape(name, value, ())
            if checks.is_concrete(value) and not (np.isfinite(value) and sign * float(value) > 0):
                wanted = "> 0" if sign > 0 else "< 0"
                raise ValueError(f"{name}: expected a finite value {wanted} nats, got {value}")

    def save(self, path: str | Path) -> None:
        """Write `{"Q": ..., "R": ..., "l_occ": ..., "l_free": ...}` as JSON."""
        fields = {name: np.asarray(value).tolist() for name, value in self._asdict().items()}
        files.write(path, json.dumps(fields, indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Params:
        """Read what `save` wrote.

        Raises:
            ValueError: not JSON, a missing, unknown or non-numeric field, or a value that `check` refuses;
                the message starts with the path.
        """
        with files.reading(path, f"a JSON object with {cls._fields}"):
            try:
                fields = json.loads(files.read(path, most=files.SETTINGS))
            except (json.JSONDecodeError, UnicodeDecodeError) as error:
                raise ValueError(f"expected a JSON object with {cls._fields}: {error}") from None
            if not isinstance(fields, dict) or set(fields) != set(cls._fields):
                got = sorted(fields) if isinstance(fields, dict) else type(fields).__name__
                raise ValueError(f"expected exactly the fields {cls._fields}, got {got}")
            values = {name: np.asarray(value) for name, value in fields.items()}
            for name, value in values.items():
                if value.dtype.kind not in "if":
                    raise ValueError(f"{name}: expected numbers, got {fields[name]!r}")
            params = cls(**{name: jnp.asarray(value.astype(float)) for name, value in values.items()})
            params.check()
        return params


class Gaussian(NamedTuple):
    """A belief about the pose (x, y, theta)."""

    mean: jax.Array  # (3,) m, m, rad; heading wrapped to [-pi, pi)
    cov: jax.Array  # (3, 3) m^2, m rad, rad^2


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
    gate_probability: Any = 0.99  # in (0, 1): share of good observations let in; None: no gate
    gate_softness: float = 0.0  # >= 0, of the squared distance: 0 decides, more weighs (`ekf.update`), for derivatives
    # m, m, rad: where the landmark sensor sits in the body frame. Scans are mapped from the pose itself.
    sensor_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grid: GridSpec | None = None  # None: localisation alone
    min_range: float = 0.05  # m: a range at or below is no measurement
    max_range: float = 8.0  # m: a range at or above clears cells up to here and marks none

    def __post_init__(self) -> None:
        freeze_tuples(self, "sensor_offset")
        for name in ("dt", "gate_softness", "min_range", "max_range"):
            checks.number(name, getattr(self, name))
        gate = None if isinstance(self.gate_probability, jax.Array) else self.gate_probability
        if gate is not None:
            checks.number("gate_probability", gate)
        if not (math.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt: expected seconds > 0, got {self.dt}")
        if gate is not None and not 0 < gate < 1:
            raise ValueError(
                f"gate_probability: expected a probability inside (0, 1), or None for no gate, "
                f"got {self.gate_probability}"
            )
        if not 0 <= self.gate_softness < math.inf:
            raise ValueError(f"gate_softness: expected a finite width >= 0, got {self.gate_softness}")
        check_offset(self.sensor_offset)
        if not 0 <= self.min_range < self.max_range < math.inf:
            raise ValueError(
                f"min_range, max_range: expected 0 <= min_range < max_range, got {self.min_range}, {self.max_range}"
            )


def check_offset(offset: tuple[float, ...]) -> None:
    """Raise unless this is where a sensor can sit.

    Raises:
        ValueError: not three finite numbers.
    """
    if len(offset) != 3 or not all(math.isfinite(c) for c in offset):
        raise ValueError(f"sensor_offset: expected finite (dx, dy, dtheta), got {offset}")


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
    """What the robot measured, one row a step. M observation slots, B beams.

    Step k: control k moves the pose over `dt[k]`, the slots of step k correct it, its scan goes into the map.
    """

    dt: jax.Array  # (T,) s, >= 0
    control: jax.Array  # (T, 2) v m/s, omega rad/s
    landmark: jax.Array  # (T, M) int32: row of `landmarks`, -1 (or any below 0) for unknown
    z: jax.Array  # (T, M, 2) range m, > 0, bearing rad
    valid: jax.Array  # (T, M) bool: the slot holds an observation
    ranges: jax.Array | None = None  # (T, B) m; None without a scanner


class State(NamedTuple):
    """What the next step needs: the carry of the scan."""

    belief: Gaussian
    log_odds: jax.Array | None  # (rows, columns) nats; None without a grid
    log_likelihood: jax.Array  # () nats: sum over every observation so far, let in or not


class Info(NamedTuple):
    """What one step reports. Entries of empty slots are zero. What the gate refuses is no fault: see `accepted`."""

    belief: Gaussian  # after the step's corrections
    innovation: jax.Array  # (M, 2) m, rad: z minus its prediction, bearing wrapped
    S: jax.Array  # (M, 2, 2) covariance of the innovation
    nis: jax.Array  # (M,) squared Mahalanobis distance of the innovation, gated or not
    accepted: jax.Array  # (M,) bool: the gate let it in; a soft one would give it half its weight or more
    log_likelihood: jax.Array  # (M,) nats: log density of the innovation, gated or not
    row: jax.Array  # (M,) int32: row of `landmarks` the observation was taken for, -1 in an empty slot
    ok: jax.Array  # () bool: inputs finite, covariance positive semi-definite


class Truth(NamedTuple):
    """What really happened, known to the simulation or a tracking system."""

    pose: jax.Array  # (T, 3) m, m, rad
