"""Trajectories in the TUM format, for tools such as evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from jaxlocmap import checks, files


def write_tum(path: str | Path, time: ArrayLike, pose: ArrayLike) -> None:
    """Write one line `timestamp x y z qx qy qz qw` a pose, each number so that it reads back exactly.

    A heading theta becomes the quaternion (0, 0, sin(theta / 2), cos(theta / 2)); z is 0.

    Args:
        path: of the file to write.
        time: (T,) s, strictly increasing, T >= 1.
        pose: (T, 3) m, m, rad.

    Raises:
        ValueError: wrong shapes, no pose, a value that is not finite, or stamps that do not increase.

    Source: Sturm, Engelhard, Endres, Burgard and Cremers, "A benchmark for the evaluation of RGB-D SLAM
    systems", IROS 2012.
    """
    time, pose = np.asarray(time, np.float64), np.asarray(pose, np.float64)
    checks.shape("time", time, (None,))
    checks.shape("pose", pose, (len(time), 3))
    if not len(time):
        raise ValueError("time: expected at least one pose, got none")
    for name, value in (("time", time), ("pose", pose)):
        if not np.all(np.isfinite(value)):
            raise ValueError(f"{name}: expected finite values, got {np.sum(~np.isfinite(value))} others")
    if not np.all(np.diff(time) > 0):
        raise ValueError(f"time: expected increasing stamps, got {np.sum(np.diff(time) <= 0)} that do not")
    zero, half = np.zeros(len(time)), pose[:, 2] / 2
    columns = (time, pose[:, 0], pose[:, 1], zero, zero, zero, np.sin(half), np.cos(half))
    rows = np.column_stack(columns).tolist()
    files.write(path, "".join(" ".join(map(repr, row)) + "\n" for row in rows))
