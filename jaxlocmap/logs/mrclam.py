"""UTIAS multi-robot cooperative localisation and mapping (MRCLAM): five robots among fifteen landmarks."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jaxlocmap import files
from jaxlocmap.logs.record import Log
from jaxlocmap.logs.text import table

_ROBOTS = range(1, 6)  # subjects that move; the others are landmarks


def read_mrclam(folder: str | Path, robot: int) -> Log:
    """Read one robot of an MRCLAM data set.

    Files in the folder, each as it is or as `.gz`, columns in s, m and rad: `Barcodes.dat` (subject,
    barcode), `Landmark_Groundtruth.dat` (subject, x, y, sd x, sd y), `RobotN_Odometry.dat` (time, v, omega),
    `RobotN_Measurement.dat` (time, barcode, range, bearing; its header says subject) and, where the data set
    has them, `RobotN_Groundtruth.dat` (time, x, y, heading).

    Args:
        folder: of the data set.
        robot: its number, 1 to 5.

    Returns:
        Log with landmarks in the order of their file, odometry, observations, and truth or none. Counts of
        observations dropped: `other_robots` (a robot's barcode, its own included), `unknown_barcodes` (misreads:
        not in the table), `unmapped_landmarks` (in the table, position not given), `bad_observations` (range not
        positive).

    Raises:
        FileNotFoundError: no such folder, or a file missing in it.
        ValueError: no such robot (the message names those there are), a line with missing, extra, non-numeric
            or non-finite columns (path and line), a file without rows, a subject or barcode listed twice, or
            no observation of a landmark at all.

    Source: Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping
    dataset", International Journal of Robotics Research 30(8), 2011.
    """
    folder = Path(folder)
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected the folder of an MRCLAM data set, got a file")
    with files.reading(folder, "an MRCLAM data set"):
        return _read(folder, robot)


def _read(folder: Path, robot: int) -> Log:
    matches = [re.match(r"Robot(\d+)_.*\.dat", path.name) for path in folder.iterdir()]
    robots = sorted({int(match[1]) for match in matches if match})
    if robot not in robots:
        raise ValueError(f"{folder}: no robot {robot!r}; robots there: {robots or 'none'}")

    codes = table(_find(folder, "Barcodes.dat"), ("subject", "barcode"), integer=("subject", "barcode"))
    places_path = _find(folder, "Landmark_Groundtruth.dat")
    places = table(places_path, ("subject", "x", "y", "sd x", "sd y"), integer=("subject",))
    for path, column, what in (
        (folder / "Barcodes.dat", codes[:, 0], "subject"),
        (folder / "Barcodes.dat", codes[:, 1], "barcode"),
        (places_path, places[:, 0], "subject"),
    ):
        values, times = np.unique(column, return_counts=True)
        if np.any(times > 1):
            raise ValueError(f"{path}: {what} {int(values[times > 1][0])} is listed more than once")
    row_of_subject = {int(subject): row for row, subject in enumerate(places[:, 0])}
    subject_of_barcode = {int(barcode): int(subject) for subject, barcode in codes}

    odometry = table(_find(folder, f"Robot{robot}_Odometry.dat"), ("time", "v", "omega"))
    seen_path = _find(folder, f"Robot{robot}_Measurement.dat")
    seen = table(seen_path, ("time", "barcode", "range", "bearing"), integer=("barcode",))
    subject = np.array([subject_of_barcode.get(int(barcode), -1) for barcode in seen[:, 1]])
    row = np.array([row_of_subject.get(s, -1) for s in subject], np.int32)
    unknown, moving = subject < 0, np.isin(subject, _ROBOTS)
    unmapped = ~unknown & ~moving & (row < 0)
    bad = ~unknown & ~moving & ~unmapped & (seen[:, 2] <= 0)
    counts = {
        "other_robots": int(np.sum(moving)),
        "unknown_barcodes": int(np.sum(unknown)),
        "unmapped_landmarks": int(np.sum(unmapped)),
        "bad_observations": int(np.sum(bad)),
    }
    kept = ~(unknown | moving | unmapped | bad)
    if not np.any(kept):
        raise ValueError(f"{seen_path}: no observation of a landmark in {len(seen)} rows: dropped {counts}")
    try:
        truth_path = _find(folder, f"Robot{robot}_Groundtruth.dat")
    except FileNotFoundError:
        truth = np.zeros((0, 4))
    else:
        truth = table(truth_path, ("time", "x", "y", "heading"))
    return Log(
        name=f"{folder.name} robot {robot}",
        landmarks=places[:, 1:3],
        odometry_time=odometry[:, 0],
        odometry=odometry[:, 1:],
        observation_time=seen[kept, 0],
        observation_landmark=row[kept],
        observation=seen[kept, 2:],
        truth_time=truth[:, 0],
        truth=truth[:, 1:],
        counts=counts,
    )


def _find(folder: Path, name: str) -> Path:
    """The file as it is, or else gzipped."""
    for path in (folder / name, folder / f"{name}.gz"):
        if path.exists() or path.is_symlink():  # a link to nothing is told and not passed over
            return path
    raise FileNotFoundError(f"{folder / name}: no such file, nor with .gz")
