"""CARMEN logs of laser scans with corrected poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxlocmap.logs.record import Log
from jaxlocmap.logs.text import lines, numbers

_IGNORED = {"ODOM", "PARAM", "NEFF", "SYNC"}
_AFTER_RANGES = ("x", "y", "theta", "odom_x", "odom_y", "odom_theta", "time", "host", "logger_time")


def read_carmen(path: str | Path, *, max_range: float = 30.0) -> Log:
    """Read the front laser's scans and their poses.

    Reads lines `FLASER n r1 .. rn x y theta odom_x odom_y odom_theta time host logger_time` in m, rad and s.
    The stamp is the last field. The fan spans 180 degrees counter-clockwise from -90: beam k points at -90 +
    180 k / n degrees for n = 180 and 360, which leave out the last edge, and at -90 + 180 k / (n - 1)
    otherwise.

    Args:
        path: plain or gzipped text.
        max_range: m; a range at or beyond means no return.

    Returns:
        Log with `scan` (S, n), `beam_angles` (n,) and as truth the pose x, y, theta of each scan, which is as
        good as whatever corrected the log. It has no odometry: `to_timeline` refuses it. Counts: `no_return`
        and `bad_ranges` (negative or NaN), both NaN in `scan`; `unknown_lines` (neither FLASER nor ODOM,
        PARAM, NEFF, SYNC); `backward_stamps` (scans stay in file order).

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: not text, no FLASER line, a line with missing, extra or non-numeric fields, or one with
            another number of beams than the first; the message starts with the path and, where there is one,
            the line.

    Source: CARMEN, the Carnegie Mellon Robot Navigation Toolkit, log format; logs in Radish, the robotics
    data set repository (D. Haehnel, for Intel).
    """
    if not max_range > 0:
        raise ValueError(f"max_range: expected metres > 0, got {max_range}")
    scans, poses, stamps, unknown = [], [], [], 0
    for number, line in lines(path):
        kind, *fields = line.split()
        if kind != "FLASER":
            unknown += kind not in _IGNORED
            continue
        where = f"{path}:{number}"
        beams = _beams(fields, where)
        if scans and beams != len(scans[0]):
            raise ValueError(f"{where}: expected {len(scans[0])} beams as in the first scan, got {beams}")
        values, tail = fields[1 : beams + 1], fields[beams + 1 :]
        scans.append(numbers(values, [f"range {k + 1}" for k in range(beams)], where, finite=False))
        poses.append(numbers(tail[:3], _AFTER_RANGES[:3], where))
        stamps.append(*numbers(tail[-1:], _AFTER_RANGES[-1:], where))
    if not scans:
        raise ValueError(f"{path}: no FLASER line, {unknown} lines of unknown kinds")
    scan, time = np.array(scans), np.array(stamps)
    bad, silent = np.isnan(scan) | (scan < 0), scan >= max_range
    counts = {
        "no_return": int(np.sum(silent)),
        "bad_ranges": int(np.sum(bad)),
        "unknown_lines": unknown,
        "backward_stamps": int(np.sum(np.diff(time) < 0)),
    }
    return Log(
        name=Path(path).name,
        scan_time=time,
        scan=np.where(bad | silent, np.nan, scan),
        beam_angles=_angles(scan.shape[1]),
        truth_time=time,
        truth=np.array(poses),
        counts=counts,
    )


def _beams(fields: list[str], where: str) -> int:
    if not (fields and fields[0].isdecimal() and int(fields[0]) >= 2):
        raise ValueError(f"{where}: expected a number of beams >= 2, got {fields[0][:40] if fields else 'nothing'!r}")
    beams = int(fields[0])
    expected = 1 + beams + len(_AFTER_RANGES)
    if len(fields) != expected:
        raise ValueError(
            f"{where}: expected {expected} fields after FLASER for {beams} beams "
            f"(n, ranges, {', '.join(_AFTER_RANGES)}), got {len(fields)}"
        )
    return beams


def _angles(beams: int) -> np.ndarray:
    """Directions (beams,) rad in the body frame."""
    gaps = beams if beams in (180, 360) else beams - 1
    return np.deg2rad(-90.0 + np.arange(beams) * 180.0 / gaps)
