"""Streams of different rates become one timeline of steps."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from jaxlocmap.logs.record import Log
from jaxlocmap.types import Inputs

# s. Robots drive on through pauses of their loggers: of the pauses of 0.7 to 1 s in MRCLAM's dataset 6, with stamps
# usually 0.01 s apart and a robot under way, it went on in 94 %. None exceeds 1.4 s.
MAX_GAP = 1.5
# As many times less room must a table of fewer slots take to be worth further steps.
_WORTH = 8


class Timeline(NamedTuple):
    """A log as steps, float64 NumPy. The prior of a filter is the belief at `time[0]`, since `dt[0]` is 0."""

    time: np.ndarray  # (T,) s, increasing; steps that share the observations of one stamp have the same
    inputs: Inputs  # of NumPy arrays; `ranges` (T, B) m, inf: no return, NaN: no measurement, or no scan at this step
    truth: np.ndarray  # (T, 3) m, m, rad at `time`, heading in [-pi, pi); NaN where not `truth_valid`
    truth_valid: np.ndarray  # (T,) bool; of the steps at one stamp only the last, which has seen all
    counts: dict[str, float]  # what the reader and `to_timeline` dropped or repaired: how often, gaps also in s


def to_timeline(
    log: Log,
    *,
    max_range: float | None = None,
    start: float | None = None,
    stop: float | None = None,
    max_gap: float = MAX_GAP,
) -> Timeline:
    """Merge the streams of a log: one step for every distinct stamp of odometry, observation or scan.

    Step k moves the pose from the previous stamp to its own with the odometry in force in between, then
    come its observations, then its scan; `dt[k] >= 0`, and `dt[0]` is 0. Events at one stamp share a step, which
    is the same as a step each with `dt` 0. In a gap of the odometry, an interval longer than `max_gap` or that long
    after its last stamp, the command holds for the usual period of the log (the median of its intervals); then the
    robot stands: a step of its own begins there, and the command is (0, 0) up to the next one, so that the covariance
    grows by Q as in any other step. The number of slots M is the largest number of observations at one stamp, at least
    1; unused slots hold landmark 0, z 0, valid False. Where that would be a table of mostly unused slots (one stamp
    with thousands of observations), M is smaller and such a stamp has several steps, `dt` 0 from the second on and the
    scan in the last, which comes to the same.

    The counts of the log are joined by: `backward_stamps` (stamps of odometry, observations and scans below the
    one before; sorted, ties in file order), `backward_truth` (the same for truth), `duplicate_odometry`,
    `duplicate_scans`, `duplicate_truth` (same stamp; the last one wins), `duplicate_observations` (same stamp,
    landmark and values; one is kept), observations or scans dropped: `beyond_max_range`, `before_odometry`
    (before the first command the motion is unknown), `before_start`, `after_stop`; and the gaps among the steps:
    `odometry_gaps`, `odometry_gap_seconds` (how long the robot was taken to stand in them) and `truth_gaps`.

    Args:
        log: with odometry.
        max_range: m; observations at or beyond are dropped. None: all are kept.
        start: s; steps before are dropped, and the command then in force stays in force. To start from a
            known pose pass the first stamp of the truth.
        stop: s; steps after are dropped.
        max_gap: s, > 0; the longest interval over which a command holds, and over which truth is interpolated.

    Raises:
        ValueError: no odometry, odometry whose usual period is longer than `max_gap`, truth that shares no time with it
            (clocks that differ), no step left between start and stop, or a setting outside its range.
    """
    if not len(log.odometry_time):
        raise ValueError(
            f"{log.name}: no odometry, so no steps: for mapping take scan_time, scan and truth from the log"
        )
    if max_range is not None and not max_range > 0:
        raise ValueError(f"max_range: expected metres > 0, or None, got {max_range}")
    if not max_gap > 0:
        raise ValueError(f"max_gap: expected seconds > 0, got {max_gap}")
    if len(log.truth_time):
        check_overlap(log.name, log.truth_time, log.odometry_time, "odometry")
    counts: dict[str, float] = dict(log.counts)
    streams = (log.odometry_time, log.observation_time, log.scan_time)
    counts["backward_stamps"] = sum(backward(stream) for stream in streams)
    odometry_rows = last_at_each_stamp(log.odometry_time)
    counts["duplicate_odometry"] = len(log.odometry_time) - len(odometry_rows)
    odometry_time, odometry = log.odometry_time[odometry_rows], log.odometry[odometry_rows]
    observation_rows = _distinct_observations(log, counts)
    if max_range is not None:
        near = log.observation[observation_rows, 0] < max_range
        counts["beyond_max_range"] = int(np.sum(~near))
        observation_rows = observation_rows[near]
    scan_rows = last_at_each_stamp(log.scan_time)
    counts["duplicate_scans"] = len(log.scan_time) - len(scan_rows)

    first, last = _window(start, stop)
    seen, scanned = log.observation_time[observation_rows], log.scan_time[scan_rows]
    both = np.concatenate([seen, scanned])
    begin = max(first, odometry_time[0])
    counts["before_odometry"] = int(np.sum(both < odometry_time[0]))
    counts["before_start"] = int(np.sum(both < begin)) - counts["before_odometry"]
    counts["after_stop"] = int(np.sum((both >= begin) & (both > last)))
    stands_from = _stands_from(log.name, odometry_time, both.max(initial=-math.inf), max_gap)
    time = np.unique(np.concatenate([odometry_time, both, stands_from[np.isfinite(stands_from)]]))
    time = time[(time >= begin) & (time <= last)]
    if not len(time):
        raise ValueError(f"{log.name}: no step between start {start} and stop {stop}")
    observation_rows = observation_rows[(seen >= time[0]) & (seen <= time[-1])]
    time, slots = _spread(time, log.observation_time[observation_rows])
    scan_rows = scan_rows[(scanned >= time[0]) & (scanned <= time[-1])]

    previous = np.concatenate([time[:1], time[:-1]])
    in_force = np.searchsorted(odometry_time, previous, side="right") - 1
    stands = previous >= stands_from[in_force]
    control = np.where(stands[:, None], 0.0, odometry[in_force])
    stood = stands & (time > previous)
    counts["odometry_gaps"] = len(np.unique(in_force[stood]))
    counts["odometry_gap_seconds"] = round(float(np.sum((time - previous)[stood])), 3)
    landmark, z, valid = _fill(log, observation_rows, time, slots)
    ranges = None
    if len(log.scan_time):
        ranges = np.full((len(time), log.scan.shape[1]), np.nan)
        ranges[np.searchsorted(time, log.scan_time[scan_rows], side="right") - 1] = log.scan[scan_rows]
    arrays: tuple[Any, ...] = (time - previous, control, landmark, z, valid, ranges)
    counts["backward_truth"] = backward(log.truth_time)
    truth_rows = last_at_each_stamp(log.truth_time)
    counts["duplicate_truth"] = len(log.truth_time) - len(truth_rows)
    truth_time = log.truth_time[truth_rows]
    truth, truth_valid = interpolate(truth_time, log.truth[truth_rows], time, max_gap)
    after = np.searchsorted(truth_time, time[~truth_valid])
    counts["truth_gaps"] = len(np.unique(after[(after > 0) & (after < len(truth_time))]))
    earlier = np.append(np.diff(time) == 0, False)  # of several steps at a stamp
    truth_valid &= ~earlier
    truth[earlier] = np.nan
    return Timeline(time, Inputs(*arrays), truth, truth_valid, counts)


def check_overlap(name: str, truth: np.ndarray, time: np.ndarray, what: str) -> None:
    """Raise unless two clocks have some time in common.

    Args:
        name: of the file.
        truth, time: s, in any order, of the truth and of `what`.

    Raises:
        ValueError: they have none; says what each spans.
    """
    if truth.min() > time.max() or truth.max() < time.min():
        spans = ", ".join(
            f"{of} from {stamps.min():.3f} to {stamps.max():.3f} s" for of, stamps in (("truth", truth), (what, time))
        )
        raise ValueError(f"{name}: truth and {what}: no overlap in time: {spans}; do their clocks differ?")


def _stands_from(name: str, odometry_time: np.ndarray, last: float, max_gap: float) -> np.ndarray:
    """Stamp (N,) from which the robot is taken to stand, the command being old; inf where the next one is in time.

    Args:
        name: of the log.
        odometry_time: (N,) s, increasing.
        last: s, of the last observation or scan.
    """
    intervals = np.diff(odometry_time)
    usual = float(np.median(intervals)) if len(intervals) else max_gap
    if usual > max_gap:
        raise ValueError(
            f"{name}: odometry: expected stamps at most max_gap = {max_gap:g} s apart, they usually are {usual:.3f} s "
            f"apart: a longer max_gap lets a command hold until the next"
        )
    holds = np.append(intervals, last - odometry_time[-1]) <= max_gap
    return np.where(holds, np.inf, odometry_time + usual)


def backward(time: np.ndarray) -> int:
    """How many stamps lie below the one before."""
    return int(np.sum(np.diff(time) < 0))


def last_at_each_stamp(time: np.ndarray) -> np.ndarray:
    """Rows in order of time; of rows with one stamp the last in the file."""
    order = np.argsort(time, kind="stable")
    keep = np.diff(time[order], append=np.inf) > 0
    return order[keep]


def _distinct_observations(log: Log, counts: dict[str, float]) -> np.ndarray:
    """Rows in order of time, ties in file order, without exact repetitions."""
    events = np.column_stack([log.observation_time, log.observation_landmark, log.observation])
    _, rows = np.unique(events, axis=0, return_index=True)
    counts["duplicate_observations"] = len(events) - len(rows)
    rows = np.sort(rows)
    return rows[np.argsort(log.observation_time[rows], kind="stable")]


def _window(start: float | None, stop: float | None) -> tuple[float, float]:
    first = -math.inf if start is None else float(start)
    last = math.inf if stop is None else float(stop)
    if not first <= last:
        raise ValueError(f"start, stop: expected start <= stop in seconds, got {start}, {stop}")
    return first, last


def _spread(time: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, int]:
    """The stamps of the steps, some more than once if need be, and the number of slots M of each.

    Args:
        time: (T,) s, strictly increasing.
        seen: (K,) s, of observations, each in `time`.
    """
    observations = np.bincount(np.searchsorted(time, seen), minlength=len(time))

    def steps(slots: int) -> np.ndarray:
        return np.maximum(-(-observations // slots), 1)

    most = max(int(observations.max()), 1)
    choices = [most, *(2**i for i in range(most.bit_length()))]
    room = [int(steps(slots).sum()) * (slots + 1) for slots in choices]  # a step itself takes about as much as a slot
    best = int(np.argmin(room))
    slots = choices[best] if _WORTH * room[best] < room[0] else most
    return np.repeat(time, steps(slots)), slots


def _fill(log: Log, rows: np.ndarray, time: np.ndarray, slots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Put observations, in order of time, into the slots of the steps: landmark (T, M), z (T, M, 2), valid (T, M)."""
    first = np.searchsorted(time, log.observation_time[rows])
    place = np.arange(len(rows)) - np.searchsorted(first, first)
    step, slot = first + place // slots, place % slots
    shape = (len(time), slots)
    landmark, z, valid = np.zeros(shape, np.int32), np.zeros((*shape, 2)), np.zeros(shape, bool)
    landmark[step, slot] = log.observation_landmark[rows]
    z[step, slot] = log.observation[rows]
    valid[step, slot] = True
    return landmark, z, valid


def interpolate(
    stamps: np.ndarray, poses: np.ndarray, time: np.ndarray, max_gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 3) at `time`, headings along the shorter way round, and whether each is known (T,)."""
    truth = np.full((len(time), 3), np.nan)
    if not len(stamps):
        return truth, np.zeros(len(time), bool)
    left = np.clip(np.searchsorted(stamps, time, side="right") - 1, 0, None)
    # A step on a sample needs no neighbour, so gaps on either side do not matter there.
    right = np.where(stamps[left] == time, left, np.minimum(left + 1, len(stamps) - 1))
    gap = stamps[right] - stamps[left]
    valid = (stamps[left] <= time) & (time <= stamps[right]) & (gap <= max_gap)
    left, right, gap, at = left[valid], right[valid], gap[valid], time[valid]
    share = np.where(gap > 0, (at - stamps[left]) / np.where(gap > 0, gap, 1.0), 0.0)
    change = poses[right] - poses[left]
    change[:, 2] = _wrap(change[:, 2])
    truth[valid] = poses[left] + share[:, None] * change
    truth[:, 2] = _wrap(truth[:, 2])
    return truth, valid


def _wrap(angle: np.ndarray) -> np.ndarray:
    """Angles in [-pi, pi)."""
    wrapped = np.mod(angle + np.pi, 2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)  # mod rounds a tiny negative angle up to 2 pi
