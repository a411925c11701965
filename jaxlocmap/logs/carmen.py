"""CARMEN logs of laser scans with the poses they were taken at."""

from __future__ import annotations

import collections
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxlocmap import files
from jaxlocmap.logs.fan import Fan, check_fov, directions, fits
from jaxlocmap.logs.record import Log
from jaxlocmap.logs.text import lines, numbers, whole
from jaxlocmap.poses import compose

_ASSUMED = math.pi  # rad, the field of view where nobody says one
_IGNORED = {"NEFF", "SYNC"}
_POSES = ("x", "y", "theta", "odom_x", "odom_y", "odom_theta")
_STAMPS = ("time", "host", "logger_time")
_HEAD = ("laser_type", "start_angle", "field_of_view", "angular_resolution", "maximum_range", "accuracy", "mode")
_DRIVEN = ("tv", "rv", "forward_safety", "side_safety", "turn_axis")
_BEFORE_AND_AFTER = {"FLASER": ((), _POSES), "ROBOTLASER1": (_HEAD, _POSES + _DRIVEN), "RAWLASER1": (_HEAD, ())}
_ODOM = ("x", "y", "theta", "tv", "rv", "accel", *_STAMPS)
_PARAM = re.compile(
    r"(?:robot|laser)_(?:front_?laser|front|laser1)_"
    r"(?:(?P<fov>fov|field_of_view)|(?P<spacing>(?:angular_)?resolution)|(?P<start>start_angle)"
    r"|(?P<max_range>max|max_?range|maximum_range)|(?P<dx>offset)|(?P<dy>side_offset)|(?P<dtheta>angular_offset))"
)


class _Scan(NamedTuple):
    fan: Fan
    ranges: np.ndarray
    pose: list[float] | None  # the scanner's x, y, theta, then the robot's by odometry; None: to be had from ODOM
    stamp: float
    line: int


class _TooShort(ValueError):
    """A line with fewer fields than it should have: the last one of a file may have been cut."""


def read_carmen(
    path: str | Path,
    *,
    fov: float | None = None,
    max_range: float | None = None,
    laser_offset: Sequence[float] | None = None,
) -> Log:
    """Read the front laser's scans and the poses it took them at.

    Reads these lines, in m, rad and s; the stamp is the last field:
    `FLASER n r1 .. rn x y theta odom_x odom_y odom_theta time host logger_time`;
    `ROBOTLASER1 laser_type start_angle field_of_view angular_resolution maximum_range accuracy mode n r1 .. rn
    m e1 .. em x y theta odom_x odom_y odom_theta tv rv forward_safety side_safety [turn_axis] time host
    logger_time`; and, where there is none of either, `RAWLASER1`, the same without the fields from x to turn_axis.
    In the first two x, y, theta is the laser's pose already, odom_x, odom_y, odom_theta the robot's.
    `RAWLASER1` gets the robot's pose by interpolation between `ODOM x y theta tv rv accel time host
    logger_time`, and the laser's place on the robot from `PARAM robot_frontlaser_offset`, `_side_offset` and
    `_angular_offset`.

    The beams of FLASER point where PARAM lines say (`laser_front_laser_fov` in degrees or rad, recognised by their
    size, `_resolution`, `_start_angle`), and else are assumed to span 180 degrees counter-clockwise from -90;
    `fan.directions` says whether both ends have a beam.

    Args:
        path: plain or gzipped text.
        fov: rad from the first beam to the last, symmetric about straight ahead, whatever the log says.
        max_range: m, how far the scanner sees, whatever the log says (maximum_range,
            `PARAM robot_front_laser_max`); a range at or beyond means no return. No limit where neither says one.
        laser_offset: (dx, dy, dtheta) m, m, rad: where the scanner sits, seen from the poses in the log, if those
            are the robot's.

    Returns:
        Log with `scan` (S, n), `scan_line` (S,), `beam_angles` (n,), `scan_odometry` (S, 3), and as truth the scanner's
        pose x, y, theta of each scan, which is as good as whatever corrected the log; RAWLASER1 without ODOM has
        neither. It has no wheel speeds: `to_timeline` refuses it. Counts: `no_return` (inf in `scan`), `bad_ranges`
        (not positive or NaN: NaN in `scan`), `other_beam_counts` (scans of another number or fan of beams than the most
        common, left out), `scans_without_pose` (RAWLASER1 outside the time of ODOM, left out), `cut_lines` (a last line
        with fields missing, left out), `unknown_lines` and `backward_stamps` (scans stay in file order).

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: not text, no scan, a line with missing (but for the last), extra or non-numeric fields, or a
            field of view that does not fit; the message starts with the path and, where there is one, the line.
            An argument out of its range.

    Source: CARMEN, the Carnegie Mellon Robot Navigation Toolkit, log format; logs in Radish, the robotics
    data set repository (D. Haehnel, for Intel).
    """
    _check_arguments(fov, max_range, laser_offset)
    with files.reading(path, "a CARMEN log"):
        return _read(path, fov, max_range, laser_offset)


def _read(path: str | Path, fov: float | None, max_range: float | None, laser_offset: Sequence[float] | None) -> Log:
    posed, raw, odometry = [], [], []
    params, unknown, short = {}, 0, None
    kind, fields, where = "", [], ""
    for number, line in lines(path):
        if short:
            raise short  # something follows it, so nothing was cut
        kind, *fields = line.split()
        where = f"{path}:{number}"
        try:
            if kind in ("FLASER", "ROBOTLASER1"):
                posed.append(_scan(kind, fields, number, where))
            elif kind == "RAWLASER1":
                raw.append(_scan(kind, fields, number, where))
            elif kind == "PARAM":
                params |= _param(fields, where)
            elif kind == "ODOM":
                odometry.append((where, fields))
            else:
                unknown += kind not in _IGNORED
        except _TooShort as error:
            short = error
    if kind == "ODOM" and len(fields) < len(_ODOM):
        short, _ = _TooShort(f"{where}: expected {len(_ODOM)} fields after ODOM"), odometry.pop()
    if not (posed or raw):
        cut = f"; {short}" if short else ""
        raise ValueError(f"{path}: no FLASER, ROBOTLASER1 or RAWLASER1 line, {unknown} lines of unknown kinds{cut}")

    scans = posed or raw
    common = collections.Counter(scan.fan for scan in scans).most_common(1)[0][0]
    same = [scan for scan in scans if scan.fan == common]
    counts = {"other_beam_counts": len(scans) - len(same), "cut_lines": int(short is not None)}
    fan, said_by = _fan(common, params, fov, max_range)
    try:
        angles = directions(fan)
    except ValueError as error:
        raise ValueError(f"{path}:{same[0].line}: {error}") from None

    mounted = laser_offset
    if posed:
        poses, driven = np.split(np.array([scan.pose for scan in same]), 2, axis=1)
    else:
        same, poses = _driven(same, odometry)
        driven = poses
        counts["scans_without_pose"] = len(scans) - counts["other_beam_counts"] - len(same)
        mounted = laser_offset or [params.get(name, 0.0) for name in ("dx", "dy", "dtheta")]
    scan, time = np.array([scan.ranges for scan in same]), np.array([scan.stamp for scan in same])
    bad = np.isnan(scan) | (scan <= 0)
    silent = ~bad & (scan >= fan.max_range)
    counts |= {
        "no_return": int(np.sum(silent)),
        "bad_ranges": int(np.sum(bad)),
        "unknown_lines": unknown,
        "backward_stamps": int(np.sum(np.diff(time) < 0)),
    }
    return Log(
        name=Path(path).name,
        scan_time=time,
        scan=np.where(bad, np.nan, np.where(silent, np.inf, scan)),
        scan_line=np.array([scan.line for scan in same], np.int32),
        scan_odometry=driven,
        beam_angles=angles,
        beam_angles_from=said_by,
        scan_max_range=fan.max_range,
        truth_time=time[: len(poses)],
        truth=poses if mounted is None else compose(poses, mounted),
        counts=counts,
    )


def _check_arguments(fov: float | None, max_range: float | None, laser_offset: Sequence[float] | None) -> None:
    if fov is not None:
        check_fov("fov", fov)
    if max_range is not None and not max_range > 0:
        raise ValueError(f"max_range: expected metres > 0, got {max_range}")
    if laser_offset is not None and not (len(laser_offset) == 3 and np.all(np.isfinite(laser_offset))):
        raise ValueError(f"laser_offset: expected finite (dx, dy, dtheta), got {laser_offset}")


def _scan(kind: str, fields: list[str], number: int, where: str) -> _Scan:
    head, middle = _BEFORE_AND_AFTER[kind]
    begin, beams = _counted(kind, fields, len(head), "beams", where)
    rest = end = begin + beams
    if head:
        rest, remissions = _counted(kind, fields, end, "remissions", where)
        rest += remissions
    expected = rest + len(middle) + len(_STAMPS)
    # Some programs write no turn_axis. The stamp at its end tells such a line from one that was cut after the host.
    without = kind == "ROBOTLASER1" and len(fields) == expected - 1 and fields[-1][0].isdecimal()
    if len(fields) != expected and not without:
        ranges = ("n", "ranges", "m", "remissions") if head else ("n", "ranges")
        raise (_TooShort if len(fields) < expected else ValueError)(
            f"{where}: expected {expected} fields after {kind} for {beams} beams "
            f"({', '.join([*head, *ranges, *middle, *_STAMPS])}), got {len(fields)}"
        )
    return _Scan(
        fan=_stated_fan(fields, beams, where) if head else Fan(beams),
        ranges=np.array(numbers(fields[begin:end], [f"range {k + 1}" for k in range(beams)], where, finite=False)),
        pose=numbers(fields[rest : rest + 6], middle[:6], where) if middle else None,
        stamp=numbers(fields[-1:], ("time",), where)[0],
        line=number,
    )


def _counted(kind: str, fields: list[str], at: int, what: str, where: str) -> tuple[int, int]:
    """Where a list that its length precedes begins, and that length."""
    if len(fields) <= at:
        raise _TooShort(
            f"{where}: expected a number of {what} as field {at + 1} after {kind}, got {len(fields)} fields"
        )
    return at + 1, whole(f"number of {what}", fields[at], where, least=2 if what == "beams" else 0)


def _stated_fan(fields: list[str], beams: int, where: str) -> Fan:
    start, fov, spacing = numbers(fields[1:4], _HEAD[1:4], where)
    (max_range,) = numbers(fields[4:5], _HEAD[4:5], where, finite=False)
    for name, value in zip(_HEAD[2:4], (fov, spacing), strict=True):
        if value:  # zero: not said
            check_fov(f"{where}: {name}", value)
    return Fan(beams, fov or None, spacing or None, start, max_range if max_range > 0 else math.inf)


def _param(fields: list[str], where: str) -> dict[str, float]:
    """What a PARAM line says of the front laser, in rad and m; nothing if it is about something else."""
    found = _PARAM.fullmatch(fields[0]) if fields else None
    if not found:
        return {}
    if len(fields) < 2:
        raise _TooShort(f"{where}: expected a value of {fields[0]}, got nothing")
    (value,) = numbers(fields[1:2], fields[:1], where)
    quantity = str(found.lastgroup)
    # CARMEN states angles in degrees, logs of other programs in rad: no scanner has a fan of 6 degrees, nor beams
    # closer than a twentieth of a degree.
    limit = {"fov": 2 * math.pi * 1.001, "start": 2 * math.pi * 1.001, "spacing": 0.05}.get(quantity, math.inf)
    if abs(value) >= limit:
        value = math.radians(value)
    if quantity in ("fov", "spacing"):
        check_fov(f"{where}: {fields[0]}", value)
    if quantity == "max_range" and not value > 0:
        raise ValueError(f"{where}: {fields[0]}: expected metres > 0, got {value}")
    return {quantity: value}


def _fan(fan: Fan, params: dict[str, float], fov: float | None, max_range: float | None) -> tuple[Fan, str]:
    """The fan as the user, the line, or else the PARAM lines say, and who that is."""
    said: dict[str, Any] = {name: params[name] for name in Fan._fields if name in params}
    said |= {name: value for name, value in fan._asdict().items() if value not in (None, math.inf)}
    if max_range is not None:
        said["max_range"] = max_range
    if fov is not None:
        user = Fan(**said | {"fov": fov, "start": None})
        return user if fits(user) else user._replace(spacing=None), "user"
    if "fov" in said or "spacing" in said:
        return Fan(**said), "log"
    return Fan(**said | {"fov": _ASSUMED, "start": None}), "assumed"


def _driven(scans: list[_Scan], odometry: list[tuple[str, list[str]]]) -> tuple[list[_Scan], np.ndarray]:
    """The scans taken while odometry ran, and the robot's pose at each; all of them and none without odometry."""
    if not odometry:
        return scans, np.zeros((0, 3))
    names = [name for name in _ODOM if name != "host"]
    rows = np.array([numbers(fields[:7] + fields[8:], names, where) for where, fields in odometry])
    time, first = np.unique(rows[:, -1], return_index=True)
    x, y, theta = rows[first, :3].T
    kept = [scan for scan in scans if time[0] <= scan.stamp <= time[-1]]
    stamps = [scan.stamp for scan in kept]
    return kept, np.stack([np.interp(stamps, time, p) for p in (x, y, np.unwrap(theta))], axis=-1)
