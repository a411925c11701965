"""Make an occupancy map of a laser log at its given poses, as a picture and for ROS map_server."""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from common import CONSOLE, command_line, count_rows, output_folder, params_or, progress_bar, saved, show, write_report

from jaxlocmap import Config, GridSpec, Params, map_scans, plotting
from jaxlocmap.logs import Log, read
from jaxlocmap.mapping import quality
from jaxlocmap.mapping.ros import FREE, OCCUPIED, save_map
from jaxlocmap.simulation import course_params
from jaxlocmap.step import map_spec

_PIECE = 91  # scans between two moves of the progress bar
_MIN_RANGE = 0.05  # m, at or below is no measurement
_FEW = 0.05  # of the ranges: if fewer lie below the limit, they may be in another unit
_MARGIN = 1.0  # m around everything seen
_MOST_CELLS = 20_000  # along one side: 1.6 GB of log-odds


@dataclasses.dataclass(frozen=True)
class MapLogConfig:
    """Settings of the map, and what it is made from."""

    log: tyro.conf.Positional[Path]
    """The log, plain or gzipped."""
    format: Literal["carmen"]
    """How the log is written."""
    resolution: float = 0.05
    """Side of a cell, m."""
    max_range: float = 20.0
    """A range at or beyond, or no return at all, clears up to here and marks nothing, m."""
    fov: float | None = None
    """Degrees from the first beam to the last, symmetric about straight ahead, whatever the log says; where it says
    nothing, 180 are assumed."""
    laser_offset: tuple[float, float, float] | None = None
    """DX DY DTHETA of the scanner, m, m, rad, seen from the poses in the log, where those are the robot's; FLASER and
    ROBOTLASER1 lines should hold the scanner's own."""
    params: Path | None = None
    """JSON file of which l_occ and l_free matter; the course's by default."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/map_log")
    """Folder for map.pgm, map.yaml, map.png and report.json."""
    quick: bool = False
    """The first 91 scans alone."""


def main(config: MapLogConfig) -> dict[str, Any]:
    """Make the map, write it, the picture and the report."""
    _check(config)
    out = output_folder(config.out)
    log = read(config.log, config.format, fov=in_radians(config.fov), laser_offset=config.laser_offset)
    if config.quick:
        log = log.with_scans(slice(_PIECE))
    params = params_or(config.params, course_params())
    mapped, spec, settings = ready(log, config.resolution, config.max_range)
    CONSOLE.print(
        f"{len(log.scan)} scans of {log.scan.shape[1]} beams onto {spec.shape[0]} x {spec.shape[1]} cells",
    )
    say_doubts(log, settings.max_range)
    log_odds, seconds, compile_s = make_map(params, mapped, settings)
    cells = save_map(out, log_odds, spec, name="map")
    report = {
        "log": log.name,
        "scans": len(log.scan),
        "beams": log.scan.shape[1],
        "beam_angles_from": log.beam_angles_from,
        "beams_span_deg": math.degrees(log.beam_angles[-1] - log.beam_angles[0]),
        "max_range": settings.max_range,
        "ranges_below_max": int(np.sum(log.scan < settings.max_range)),
        "cells": cells.size,
        "shape": list(cells.shape),
        "origin": list(spec.origin),
        "resolution": config.resolution,
        "seen": int(np.sum(log_odds != 0)),
        "occupied": int(np.sum(cells == OCCUPIED)),
        "free": int(np.sum(cells == FREE)),
        "entropy_bits": float(quality.entropy_bits(jnp.asarray(log_odds))),
        "counts": log.counts,
        "mapping_s": seconds,
        "compile_s": compile_s,
        "scans_per_s": len(log.scan) / seconds,
    }
    write_report(out, report)
    plotting.map_figure(
        out / "map.png",
        log_odds,
        spec,
        log.truth,
        title=f"{log.name}: {report['scans']} scans, cells of {config.resolution:g} m",
    )
    show(
        log.name,
        [
            ("scans, beams", f"{report['scans']}, {report['beams']}", ""),
            ("cells", f"{report['cells']} ({cells.shape[0]} x {cells.shape[1]})", ""),
            ("occupied, free", f"{report['occupied']}, {report['free']}", ""),
            ("entropy", f"{report['entropy_bits']:.0f} bits", ""),
            ("mapping", f"{seconds:.2f} s, {report['scans_per_s']:.0f} scans/s", ""),
            ("compilation", f"{compile_s:.2f} s", ""),
            *count_rows(log.counts),
        ],
    )
    saved(out, "map.pgm", "map.yaml", "map.png", "report.json")
    return report


def _check(config: MapLogConfig) -> None:
    """Refuse an option out of its range, before anything is read or written."""
    if not (math.isfinite(config.resolution) and config.resolution > 0):
        raise ValueError(f"resolution: expected metres > 0, got {config.resolution}")
    if not (math.isfinite(config.max_range) and config.max_range > _MIN_RANGE):
        raise ValueError(f"max_range: expected metres > {_MIN_RANGE}, got {config.max_range}")
    in_radians(config.fov)
    if config.laser_offset is not None and not np.all(np.isfinite(config.laser_offset)):
        raise ValueError(f"laser_offset: expected finite DX DY DTHETA, got {config.laser_offset}")


def in_radians(fov: float | None) -> float | None:
    """The option of that name, degrees, as the readers take it.

    Raises:
        ValueError: out of its range.
    """
    if fov is not None and not 0 < fov <= 360:
        raise ValueError(f"fov: expected degrees in (0, 360], got {fov}")
    return None if fov is None else math.radians(fov)


def say_doubts(log: Log, max_range: float) -> None:
    """Say what had to be assumed of a log, and what looks wrong in it."""
    if log.beam_angles_from == "assumed":
        first, last = np.rad2deg(log.beam_angles[[0, -1]])
        say = f"the log does not say where its beams point: assumed {first:g} to {last:g} degrees"
        CONSOLE.print(say, soft_wrap=True)
    below, measured = int(np.sum(log.scan < max_range)), int(np.sum(~np.isnan(log.scan)))
    if below < _FEW * measured:
        say = f"only {below} of {measured} ranges lie below the limit of {max_range:g} m: is the unit metres?"
        CONSOLE.print(say, soft_wrap=True)


def ready(log: Log, resolution: float, max_range: float) -> tuple[Log, GridSpec, Config]:
    """A log ready to be mapped in single precision.

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
    return local, spec, Config(grid=grid, min_range=_MIN_RANGE, max_range=reach)


@np.errstate(over="ignore", invalid="ignore")  # a glitch may be as large as numbers get
def extent(log: Log, resolution: float) -> GridSpec:
    """A grid that holds the path and every beam up to its end, with a margin, its origin on a whole cell.

    Args:
        log: with ranges that are finite or NaN.

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


def make_map(params: Params, log: Log, config: Config) -> tuple[np.ndarray, float, float]:
    """Log-odds, the seconds mapping took and the seconds compiling took."""
    scans, angles = len(log.scan), log.beam_angles.astype(np.float32)
    fill = -scans % _PIECE  # scans without a measurement change nothing
    ranges = np.concatenate([log.scan, np.full((fill, log.scan.shape[1]), np.nan)]).astype(np.float32)
    poses = np.concatenate([log.truth, np.zeros((fill, 3))]).astype(np.float32)
    log_odds = jnp.zeros(map_spec(config).shape)
    began = time.perf_counter()
    mapped = jax.jit(functools.partial(map_scans, config=config), donate_argnums=1)
    program = mapped.lower(params, log_odds, poses[:_PIECE], ranges[:_PIECE], beam_angles=angles).compile()
    compiled = time.perf_counter()
    with progress_bar("mapping", scans) as progress:
        for begin in range(0, scans, _PIECE):
            piece = slice(begin, begin + _PIECE)
            log_odds = program(params, log_odds, poses[piece], ranges[piece], beam_angles=angles)
            log_odds.block_until_ready()
            progress(min(begin + _PIECE, scans))
    return np.asarray(log_odds), time.perf_counter() - compiled, compiled - began


if __name__ == "__main__":
    command_line(main, MapLogConfig)
