"""The record every reader returns: the streams of one robot's log as they were stored."""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import field

import numpy as np

from jaxlocmap import checks
from jaxlocmap.logs.text import LARGEST

_NUMBERS = functools.partial(np.zeros, 0)
_INTS = functools.partial(np.zeros, 0, np.int32)
_PAIRS = functools.partial(np.zeros, (0, 2))
_POSES = functools.partial(np.zeros, (0, 3))
_SCANS = functools.partial(np.zeros, (0, 0))
_ZERO = functools.partial(np.zeros, 3)


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """One robot's log, float64 NumPy, each stream in file order; length 0 where a stream is absent.

    Bearings and beam angles are counter-clockwise from straight ahead. `sensor_offset` is where the landmark
    sensor sits in the body frame; it moves no laser: `scan` is seen from the poses in `truth`, which a reader of
    laser logs gives for the scanner itself.

    Raises:
        ValueError: streams whose shapes do not belong together, a stamp or value that is not finite (`scan`
            may hold NaN and infinity) or larger than 1e12, a observation of a row that `landmarks` does not have, or a
            maximum range that is not positive.
    """

    name: str
    landmarks: np.ndarray = field(default_factory=_PAIRS)  # (L, 2) m, world frame
    odometry_time: np.ndarray = field(default_factory=_NUMBERS)  # (N,) s
    odometry: np.ndarray = field(default_factory=_PAIRS)  # (N, 2) v m/s, omega rad/s, in force until the next
    observation_time: np.ndarray = field(default_factory=_NUMBERS)  # (K,) s
    observation_landmark: np.ndarray = field(default_factory=_INTS)  # (K,) int32: row of `landmarks`, -1 unknown
    observation: np.ndarray = field(default_factory=_PAIRS)  # (K, 2) range m, bearing rad
    scan_time: np.ndarray = field(default_factory=_NUMBERS)  # (S,) s
    scan: np.ndarray = field(default_factory=_SCANS)  # (S, B) m, inf: no return, NaN: no measurement
    scan_line: np.ndarray = field(default_factory=_INTS)  # (S,) int32: line of the file; (0,) where there are none
    scan_odometry: np.ndarray = field(default_factory=_POSES)  # (S, 3) m, m, rad: where the wheels say, or (0, 3)
    beam_angles: np.ndarray = field(default_factory=_NUMBERS)  # (B,) rad, scanner's frame
    beam_angles_from: str = ""  # "log", "user" or "assumed": who says them
    scan_max_range: float = math.inf  # m, how far the scanner sees, where the log or the user says
    truth_time: np.ndarray = field(default_factory=_NUMBERS)  # (J,) s
    truth: np.ndarray = field(default_factory=_POSES)  # (J, 3) m, m, rad; tracked, or corrected by SLAM
    sensor_offset: np.ndarray = field(default_factory=_ZERO)  # (3,) m, m, rad in the body frame
    stated_variance: dict[str, float] | None = None  # v (m/s)^2, w (rad/s)^2, range m^2, bearing rad^2
    counts: dict[str, int] = field(default_factory=dict)  # what was dropped or repaired: how often

    def __post_init__(self) -> None:
        stamps, observations = len(self.odometry_time), len(self.observation_time)
        scans, beams, poses = len(self.scan_time), len(self.beam_angles), len(self.truth_time)
        for name, shape in (
            ("landmarks", (None, 2)),
            ("odometry_time", (stamps,)),
            ("odometry", (stamps, 2)),
            ("observation_time", (observations,)),
            ("observation_landmark", (observations,)),
            ("observation", (observations, 2)),
            ("scan_time", (scans,)),
            ("scan", (scans, beams)),
            ("scan_line", (scans if len(self.scan_line) else 0,)),
            ("scan_odometry", (scans if len(self.scan_odometry) else 0, 3)),
            ("beam_angles", (beams,)),
            ("truth_time", (poses,)),
            ("truth", (poses, 3)),
            ("sensor_offset", (3,)),
        ):
            value = getattr(self, name)
            checks.shape(name, value, shape)
            if name != "scan" and not np.all(np.isfinite(value)):
                raise ValueError(f"{name}: expected finite values, got {np.sum(~np.isfinite(value))} others")
            size = np.abs(value).max(initial=0) if name != "scan" else 0
            if size > LARGEST:
                raise ValueError(f"{name}: expected numbers of a size up to {LARGEST:g}, got {size:g}")
        if not self.scan_max_range > 0:
            raise ValueError(f"scan_max_range: expected metres > 0, got {self.scan_max_range}")
        rows = self.observation_landmark
        if observations and not (rows.min() >= -1 and rows.max() < len(self.landmarks)):
            raise ValueError(
                f"observation_landmark: expected rows from -1 to {len(self.landmarks) - 1}, "
                f"got {rows.min()} to {rows.max()}"
            )

    def with_scans(self, kept: slice | np.ndarray) -> Log:
        """The log with these of its scans alone, and with their poses if it has one for each."""
        names = ["scan_time", "scan", "scan_line", "scan_odometry"]
        if len(self.truth_time) == len(self.scan_time):
            names += ["truth_time", "truth"]
        return dataclasses.replace(self, **{name: x[kept] for name in names if len(x := getattr(self, name))})
