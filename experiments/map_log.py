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

from jaxlocmap import Config, GridSpec, Params, grid, map_scans, plotting
from jaxlocmap.logs import Log, read
from jaxlocmap.mapfile import FREE, OCCUPIED, save_map
from jaxlocmap.simulate import course_params

_PIECE = 91  # scans between two moves of the progress bar
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
    """A longer range clears up to here and marks nothing, m."""
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
    out = output_folder(config.out)
    for name, value in (("resolution", config.resolution), ("max_range", config.max_range)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name}: expected metres > 0, got {value}")
    log = read(config.log, config.format)
    if not len(log.scan_time) or not len(log.truth_time):
        raise ValueError(f"{config.log}: expected laser scans with poses, got {len(log.scan_time)} scans")
    if config.quick:
        log = first_scans(log, _PIECE)
    params = params_or(config.params, course_params())
    spec = extent(log, config)
    settings = Config(grid=spec, min_range=0.05, max_range=config.max_range)
    CONSOLE.print(
        f"{len(log.scan)} scans of {log.scan.shape[1]} beams onto {spec.shape[0]} x {spec.shape[1]} cells",
        highlight=False,
    )
    log_odds, seconds, compile_s = _map(params, log, settings, spec)
    cells = save_map(out, log_odds, spec, name="map")
    report = {
        "log": log.name,
        "scans": len(log.scan),
        "beams": log.scan.shape[1],
        "cells": cells.size,
        "shape": list(cells.shape),
        "origin": list(spec.origin),
        "resolution": config.resolution,
        "seen": int(np.sum(log_odds != 0)),
        "occupied": int(np.sum(cells == OCCUPIED)),
        "free": int(np.sum(cells == FREE)),
        "entropy_bits": float(grid.entropy_bits(jnp.asarray(log_odds))),
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


def first_scans(log: Log, count: int) -> Log:
    """The same log, cut short."""
    cut = {name: getattr(log, name)[:count] for name in ("scan_time", "scan", "truth_time", "truth")}
    return dataclasses.replace(log, **cut)


def extent(log: Log, config: MapLogConfig) -> GridSpec:
    """A grid that holds the path and every point hit, with a margin, its origin on a whole cell."""
    angles = log.truth[:, 2:] + log.beam_angles
    hit = np.isfinite(log.scan) & (log.scan < config.max_range)
    reach = np.where(hit, log.scan, 0.0)
    x, y = (log.truth[:, i : i + 1] + reach * f(angles) for i, f in ((0, np.cos), (1, np.sin)))
    size = max(float(np.ptp(p)) for p in (x, y)) + 2 * _MARGIN
    if size / config.resolution > _MOST_CELLS:
        finest = size / _MOST_CELLS
        raise ValueError(f"resolution: expected {finest:.2g} m or more for {size:.0f} m, got {config.resolution}")
    # Of stray returns far outside, one in a thousand may be cut off.
    low = [math.floor((np.quantile(p, 0.0005) - _MARGIN) / config.resolution) for p in (x, y)]
    high = [math.ceil((np.quantile(p, 0.9995) + _MARGIN) / config.resolution) for p in (x, y)]
    return GridSpec(
        origin=(low[0] * config.resolution, low[1] * config.resolution),
        resolution=config.resolution,
        shape=(high[1] - low[1], high[0] - low[0]),
    )


def _map(params: Params, log: Log, config: Config, spec: GridSpec) -> tuple[np.ndarray, float, float]:
    """Log-odds, the seconds mapping took and the seconds compiling took."""
    scans = len(log.scan)
    fill = -scans % _PIECE  # scans without a return change nothing
    ranges = np.concatenate([log.scan, np.full((fill, log.scan.shape[1]), np.nan)]).astype(np.float32)
    poses = np.concatenate([log.truth, np.zeros((fill, 3))]).astype(np.float32)
    log_odds = jnp.zeros(spec.shape)
    began = time.perf_counter()
    mapped = jax.jit(functools.partial(map_scans, config=config), donate_argnums=1)
    program = mapped.lower(
        params, log_odds, poses[:_PIECE], ranges[:_PIECE], beam_angles=jnp.asarray(log.beam_angles)
    ).compile()
    compiled = time.perf_counter()
    with progress_bar("mapping", scans) as progress:
        for begin in range(0, scans, _PIECE):
            piece = slice(begin, begin + _PIECE)
            log_odds = program(params, log_odds, poses[piece], ranges[piece], beam_angles=jnp.asarray(log.beam_angles))
            log_odds.block_until_ready()
            progress(min(begin + _PIECE, scans))
    return np.asarray(log_odds), time.perf_counter() - compiled, compiled - began


if __name__ == "__main__":
    command_line(main, MapLogConfig)
