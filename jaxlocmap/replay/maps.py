"""A map of a laser log, made at the poses that the log has."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.logs import Log
from jaxlocmap.parameters import Params
from jaxlocmap.pipeline import map_scans
from jaxlocmap.step import map_spec
from jaxlocmap.types import Config, GridSpec

PIECE = 91  # scans between two calls of `progress`
MIN_RANGE = 0.05  # m, at or below is no measurement
_FEW = 0.05  # of the ranges: if fewer lie below the limit, they may be in another unit
_MARGIN = 1.0  # m around everything seen
_MOST_CELLS = 20_000  # along one side: 1.6 GB of log-odds


def scan_doubts(log: Log, max_range: float) -> list[str]:
    """What had to be assumed of a log's scans, and what looks wrong in them, in words."""
    said = []
    if log.beam_angles_from == "assumed":
        first, last = np.rad2deg(log.beam_angles[[0, -1]])
        said.append(f"the log does not say where its beams point: assumed {first:g} to {last:g} degrees")
    below, measured = int(np.sum(log.scan < max_range)), int(np.sum(~np.isnan(log.scan)))
    if below < _FEW * measured:
        said.append(f"only {below} of {measured} ranges lie below the limit of {max_range:g} m: is the unit metres?")
    return said


def mappable(log: Log, resolution: float, max_range: float) -> tuple[Log, GridSpec, Config]:
    """A log ready to be mapped in single precision.

    Args:
        log: scans, each with a pose.
        resolution: of the map, m.
        max_range: a range at or beyond clears up to here and marks nothing, m.

    Returns:
        The log with its poses in the frame of the grid, where no coordinate is large, and every range finite or NaN,
        no return being the largest there is; where the grid lies in the world; and the settings to map with, their
        grid at the origin. What the scanner cannot see is not cleared, even where `max_range` is larger.

    Raises:
        ValueError: no scan, no pose, no range below the limit, or a map too large for its resolution.
    """
    if not len(log.scan) or len(log.truth) != len(log.scan):
        raise ValueError(f"{log.name}: expected laser scans, each with a pose, got {len(log.scan)}, {len(log.truth)}")
    reach = min(max_range, log.scan_max_range)
    if not np.any(log.scan < reach):
        least = np.min(log.scan, where=~np.isnan(log.scan), initial=np.inf)
        raise ValueError(
            f"{log.name}: no range lies below the limit of {reach:g} m, the smallest is {least:g}: is the unit metres?"
        )
    log = dataclasses.replace(log, scan=np.minimum(log.scan, reach))
    spec = extent(log, resolution)
    local = dataclasses.replace(log, truth=log.truth - [*spec.origin, 0.0])
    grid = dataclasses.replace(spec, origin=(0.0, 0.0))
    return local, spec, Config(grid=grid, min_range=MIN_RANGE, max_range=reach)


@np.errstate(over="ignore", invalid="ignore")  # a glitch may be as large as numbers get
def extent(log: Log, resolution: float) -> GridSpec:
    """A grid that holds the path and every beam up to its end, with a margin, its origin on a whole cell.

    Args:
        log: with ranges that are finite or NaN.
        resolution: side of a cell, m.

    Raises:
        ValueError: too many cells; the message names the line of the pose farthest from the others.
    """
    angles, position = log.truth[:, 2:] + log.beam_angles, log.truth[:, :2]
    reach = np.nan_to_num(log.scan)
    ends = [position[:, i, None] + reach * f(angles) for i, f in ((0, np.cos), (1, np.sin))]
    low, high = ([f(np.append(p, position[:, i])) for i, p in enumerate(ends)] for f in (np.min, np.max))
    size = max(b - a for a, b in zip(low, high, strict=True)) + 2 * _MARGIN
    if not size / resolution <= _MOST_CELLS:
        away = np.hypot(*(position - np.median(position, axis=0)).T)
        far = int(np.argmax(away))
        line = f":{log.scan_line[far]}" if len(log.scan_line) else f", scan {far}"
        raise ValueError(
            f"resolution: expected {size / _MOST_CELLS:.2g} m or more for a map of {size:.6g} m, got {resolution:g}; "
            f"{log.name}{line}: the pose ({position[far, 0]:g}, {position[far, 1]:g}) lies {away[far]:.6g} m from the "
            f"middle of the path, the longest range is {reach.max():g} m"
        )
    first = [math.floor((p - _MARGIN) / resolution) for p in low]
    last = [math.ceil((p + _MARGIN) / resolution) for p in high]
    return GridSpec(
        origin=(first[0] * resolution, first[1] * resolution),
        resolution=resolution,
        shape=(last[1] - first[1], last[0] - first[0]),
    )


def make_map(
    params: Params, log: Log, config: Config, progress: Callable[[int], None] = lambda done: None
) -> tuple[np.ndarray, float, float]:
    """Map the scans of a log at its poses, piece by piece.

    Args:
        params: of which `l_occ` and `l_free` matter.
        log: as `mappable` returns it.
        config: as `mappable` returns it.
        progress: called with the number of scans done so far.

    Returns:
        Log-odds (rows, columns), the seconds mapping took and the seconds compiling took.
    """
    scans, angles = len(log.scan), log.beam_angles.astype(np.float32)
    fill = -scans % PIECE  # scans without a measurement change nothing
    ranges = np.concatenate([log.scan, np.full((fill, log.scan.shape[1]), np.nan)]).astype(np.float32)
    poses = np.concatenate([log.truth, np.zeros((fill, 3))]).astype(np.float32)
    log_odds = jnp.zeros(map_spec(config).shape)
    began = time.perf_counter()
    mapped = jax.jit(functools.partial(map_scans, config=config), donate_argnums=1)
    program = mapped.lower(params, log_odds, poses[:PIECE], ranges[:PIECE], beam_angles=angles).compile()
    compiled = time.perf_counter()
    for begin in range(0, scans, PIECE):
        piece = slice(begin, begin + PIECE)
        log_odds = program(params, log_odds, poses[piece], ranges[piece], beam_angles=angles)
        log_odds.block_until_ready()
        progress(min(begin + PIECE, scans))
    return np.asarray(log_odds), time.perf_counter() - compiled, compiled - began
