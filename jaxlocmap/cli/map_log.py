"""Map a laser log whose poses are known, for ROS map_server."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import tyro

from jaxlocmap import plotting
from jaxlocmap.cli.console import CONSOLE, count_rows, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.cli.options import in_radians, params_or
from jaxlocmap.logs import read
from jaxlocmap.mapping import quality
from jaxlocmap.mapping.ros import FREE, OCCUPIED, save_map
from jaxlocmap.replay import maps
from jaxlocmap.simulation import course_params


@dataclasses.dataclass(frozen=True)
class MapConfig:
    """Map a laser log whose poses are known, for ROS map_server."""

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
    out: Path = Path("out/map")
    """Folder for map.pgm, map.yaml, map.png and report.json."""
    quick: bool = False
    """The first 91 scans alone."""


def main(config: MapConfig) -> dict[str, Any]:
    """Make the map, write it, the picture and the report."""
    _check(config)
    out = output_folder(config.out)
    log = read(config.log, config.format, fov=in_radians(config.fov), laser_offset=config.laser_offset)
    if config.quick:
        log = log.with_scans(slice(maps.PIECE))
    params = params_or(config.params, course_params())
    mapped, spec, settings = maps.mappable(log, config.resolution, config.max_range)
    CONSOLE.print(
        f"{len(log.scan)} scans of {log.scan.shape[1]} beams onto {spec.shape[0]} x {spec.shape[1]} cells",
    )
    for sentence in maps.scan_doubts(log, settings.max_range):
        CONSOLE.print(sentence, soft_wrap=True)
    with progress_bar("mapping", len(log.scan)) as progress:
        log_odds, seconds, compile_s = maps.make_map(params, mapped, settings, progress)
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


def _check(config: MapConfig) -> None:
    """Refuse an option out of its range, before anything is read or written."""
    if not (math.isfinite(config.resolution) and config.resolution > 0):
        raise ValueError(f"resolution: expected metres > 0, got {config.resolution}")
    if not (math.isfinite(config.max_range) and config.max_range > maps.MIN_RANGE):
        raise ValueError(f"max_range: expected metres > {maps.MIN_RANGE}, got {config.max_range}")
    in_radians(config.fov)
    if config.laser_offset is not None and not np.all(np.isfinite(config.laser_offset)):
        raise ValueError(f"laser_offset: expected finite DX DY DTHETA, got {config.laser_offset}")
