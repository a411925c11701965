"""The "lost in the woods" log: a wheeled robot among cylinders, MATLAB v5."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxlocmap import files
from jaxlocmap.logs.matlab import read_matrices
from jaxlocmap.logs.record import Log
from jaxlocmap.logs.text import LARGEST

_VECTORS = ("t", "v", "om", "x_true", "y_true", "th_true", "true_valid")
_SCALARS = ("d", "r_var", "b_var", "v_var", "om_var")


def read_woods(path: str | Path) -> Log:
    """Read the MATLAB file of the "lost in the woods" log.

    The file holds, for N stamps and L landmarks, in s, m and rad: `t, v, om, x_true, y_true, th_true` and
    `true_valid` (N, 1), `r, b` (N, L) with r = 0 where a landmark was not seen, `l` (L, 2) and the scalars
    `d, r_var, b_var, v_var, om_var`. There `v[k], om[k]` describe the motion from stamp k-1 to k; in the
    record odometry holds from its stamp on, so they get stamp `t[k-1]`, and the first pair, which nothing
    precedes, is dropped.

    Args:
        path: of the file, as it is or gzipped.

    Returns:
        Log with observations, odometry, truth where it is valid, `sensor_offset` (d, 0, 0) and
        `stated_variance`.
        Counts: `odometry_without_interval` (the first pair), `bad_observations` (negative or non-finite),
        `invalid_truth`.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: no MATLAB file of version 5 to 7, a truncated or damaged one, a variable that is missing,
            of another shape, not numeric or not finite, a variance that is not positive, or stamps that do not
            increase; the message starts with the path.

    Source: T. D. Barfoot, University of Toronto Institute for Aerospace Studies (UTIAS), 2009.
    """
    with files.reading(path, "a log in the form of lost in the woods"):
        return _log(path, read_matrices(path, (*_VECTORS, "l", "r", "b", *_SCALARS)))


def _log(path: str | Path, fields: dict[str, np.ndarray]) -> Log:
    stamps = fields["t"].size
    steps, landmarks = max(stamps, 2), fields["l"].shape[0]
    shapes = dict.fromkeys(_VECTORS, (steps, 1)) | dict.fromkeys(_SCALARS, (1, 1))
    shapes |= {"l": (landmarks, 2), "r": (steps, landmarks), "b": (steps, landmarks)}
    for name, expected in shapes.items():
        if fields[name].shape != expected:
            raise ValueError(f"{path}: {name}: expected shape {expected}, got {fields[name].shape}")
        if name not in ("r", "b") and not np.all(np.abs(fields[name]) <= LARGEST):
            raise ValueError(f"{path}: {name}: expected finite values of a size up to {LARGEST:g}")
    time, distance, bearing = fields["t"][:, 0], fields["r"], fields["b"]
    if not np.all(np.diff(time) > 0):
        raise ValueError(f"{path}: t: expected increasing stamps, got {np.sum(np.diff(time) <= 0)} that do not")
    seen = np.isfinite(distance) & np.isfinite(bearing) & (distance > 0)
    step, row = np.nonzero(seen)
    valid = fields["true_valid"][:, 0] != 0
    pose = np.hstack([fields["x_true"], fields["y_true"], fields["th_true"]])
    scalar = {name: float(fields[name][0, 0]) for name in _SCALARS}
    for name in _SCALARS[1:]:
        if not scalar[name] > 0:
            raise ValueError(f"{path}: {name}: expected a variance > 0, got {scalar[name]}")
    return Log(
        name=Path(path).name,
        landmarks=fields["l"],
        odometry_time=time[:-1],
        odometry=np.hstack([fields["v"], fields["om"]])[1:],
        observation_time=time[step],
        observation_landmark=row.astype(np.int32),
        observation=np.column_stack([distance[seen], bearing[seen]]),
        truth_time=time[valid],
        truth=pose[valid],
        sensor_offset=np.array([scalar["d"], 0.0, 0.0]),
        stated_variance={
            "v": scalar["v_var"],
            "w": scalar["om_var"],
            "range": scalar["r_var"],
            "bearing": scalar["b_var"],
        },
        counts={
            "odometry_without_interval": 1,
            "bad_observations": int(np.sum(~seen & (distance != 0))),
            "invalid_truth": int(np.sum(~valid)),
        },
    )
