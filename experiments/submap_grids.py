"""One global occupancy grid or submaps, on a long drive: what closing loops costs either, and how good the maps are.

A global grid cannot be moved: once a loop corrects the poses, what was drawn at the old ones is wrong until all scans
are drawn again. A submap's grid is drawn once, in the frame of its anchor, and moves as a whole; the global map is put
together from the submaps when somebody asks for it.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from evidence import replace_table
from rich.table import Table
from slam_study import SlamDrives, SlamStudyConfig, without_loops

from jaxlocmap import Config, GridSpec, map_scans, plotting, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.graph.closure import scan_poses
from jaxlocmap.graph.trail import Trail
from jaxlocmap.mapping import grid, quality
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.poses import compose

_PIECE = 48  # scans that one program draws
_MARGIN = 2.0  # m of a submap's grid beyond what its scans reach


@dataclasses.dataclass(frozen=True)
class SubmapGridsConfig:
    """The drive."""

    scenario: Literal["loop", "building"] = "building"
    """The world and the drive."""
    match_every: int = 5
    """Steps between two scans."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/submap_grids")
    """Folder for report.json, open.png and closed.png."""
    quick: bool = False
    """The first 1,500 steps alone."""


@dataclasses.dataclass
class Way:
    """How a map was kept."""

    name: str
    log_odds: np.ndarray
    cells: int = 0  # written, redrawing included
    seconds: float = 0.0
    pause: float = 0.0  # s, the longest between two scans
    kept: int = 0  # bytes of grids


def main(config: SubmapGridsConfig) -> dict[str, Any]:
    """Drive once, keep the map in every way, score; write the report, the figures and the table."""
    out = output_folder(config.out)
    merge_kernels()
    drives = SlamDrives(
        SlamStudyConfig(scenario=config.scenario, match_every=config.match_every, steps=1500 if config.quick else None)
    )
    CONSOLE.print(f"one drive of {config.scenario}, {drives.scenario.steps} steps; compiling takes some seconds")
    one = jax.tree.map(lambda x: np.asarray(x)[0], drives.drives(jax.random.split(jax.random.key(config.seed), 1)))
    truth, ranges, _ = one
    trail, closed = drives.closed(*one)
    with jax.enable_x64(True):
        opened, _ = scan_poses(trail, without_loops(closed))
        poses, _ = scan_poses(trail, closed)
    spec = drives.scenario.config(motion="euler", gate_probability=0.99, grid=True).grid
    if spec is None:
        raise ValueError("scenario: expected one with a grid")
    draw = _Drawing(drives, spec)
    accepted = closed.attempts.pair[closed.attempts.accepted]
    # A loop is known once the younger submap's scans are all there.
    events = sorted({int(np.flatnonzero(trail.submap == j)[-1]) for j in accepted[:, 1]})
    ways = _ways(draw, trail, ranges, opened, poses, np.asarray(closed.solution.poses, np.float64), events)
    occupied = simulation.occupancy(drives.world, spec)
    report: dict[str, Any] = {
        "scenario": config.scenario,
        "scans": len(ranges),
        "submaps": trail.submaps,
        "loops": len(accepted),
        "closures": len(events),
        "rmse_open_m": _rmse(opened, truth),
        "rmse_closed_m": _rmse(poses, truth),
        "ways": [_scored(way, occupied, len(ranges)) for way in ways],
    }
    write_report(out, report)
    for way, path, at in ((ways[0], "open.png", opened), (ways[-1], "closed.png", poses)):
        title = f"{config.scenario}: {way.name}"
        walls = np.asarray(drives.world.segments)
        plotting.map_figure(out / path, way.log_odds, spec, at, truth=truth, segments=walls, title=title)
    _show(report)
    if config.write:
        replace_table("submaps", _table(report))
    saved(out, "report.json", "open.png", "closed.png")
    return report


class _Drawing:
    """Scans drawn into grids, a piece at a time so that one program serves."""

    def __init__(self, drives: SlamDrives, spec: GridSpec) -> None:
        settings: Config = drives.scenario.config(motion="euler", gate_probability=0.99, grid=True)
        reach = settings.max_range + _MARGIN + 4.0
        size = 2 * int(np.ceil(reach / spec.resolution))
        corner = -size / 2 * spec.resolution
        self.spec = spec
        self.small = GridSpec((corner, corner), spec.resolution, (size, size))
        self._params, self._angles = drives.params, drives.scenario.beam_angles()
        # Bounds are for reading: sums are kept without, so that submaps can be added up.
        wide = {"l_min": -1e6, "l_max": 1e6}
        self._of = {
            shape: dataclasses.replace(settings, grid=dataclasses.replace(one, **wide))
            for shape, one in ((spec.shape, spec), (self.small.shape, self.small))
        }
        self._program = jax.jit(map_scans, static_argnames="config")

    def add(self, log_odds: np.ndarray, poses: np.ndarray, ranges: np.ndarray) -> np.ndarray:
        """A grid with scans added; read it through `clamped`."""
        config = self._of[log_odds.shape]
        fill = -len(poses) % _PIECE
        poses = np.concatenate([poses, np.zeros((fill, 3))]).astype(np.float32)
        ranges = np.concatenate([ranges, np.full((fill, ranges.shape[1]), np.nan)]).astype(np.float32)
        sums = jnp.asarray(log_odds)
        for k in range(0, len(poses), _PIECE):
            piece = slice(k, k + _PIECE)
            sums = self._program(
                self._params, sums, poses[piece], ranges[piece], beam_angles=self._angles, config=config
            )
        return np.asarray(sums)

    def clamped(self, log_odds: np.ndarray) -> np.ndarray:
        """A grid as it is read."""
        return np.asarray(grid.clamp(jnp.asarray(log_odds), self.spec))

    def cells(self, ranges: np.ndarray) -> np.ndarray:
        """How many cells each scan writes, (S,)."""
        empty = np.zeros(self.small.shape, np.float32)
        with progress_bar("counting cells", len(ranges)) as progress:
            counts = []
            for scan in ranges:
                counts.append(int(np.count_nonzero(self.add(empty, np.zeros((1, 3)), scan[None]))))
                progress(len(counts))
        return np.array(counts)


def _ways(
    draw: _Drawing,
    trail: Trail,
    ranges: np.ndarray,
    opened: np.ndarray,
    poses: np.ndarray,
    anchors: np.ndarray,
    events: list[int],
) -> list[Way]:
    empty = np.zeros(draw.spec.shape, np.float32)
    draw.add(empty, poses[:1], ranges[:1])  # compiled
    draw.add(np.zeros(draw.small.shape, np.float32), np.zeros((1, 3)), ranges[:1])
    cells = draw.cells(ranges)
    scans = len(ranges)

    began = time.perf_counter()
    log_odds = draw.add(empty, opened, ranges)
    once = time.perf_counter() - began
    kept = empty.nbytes
    left = Way("one grid, loops open", draw.clamped(log_odds), int(cells.sum()), once, once / scans, kept)

    redrawn = Way("one grid, redrawn at every closure", empty, int(cells.sum()), once, 0.0, kept + ranges.nbytes)
    with progress_bar("redrawing", len(events)) as progress:
        for k, last in enumerate(events):
            began = time.perf_counter()
            log_odds = draw.add(empty, poses[: last + 1], ranges[: last + 1])
            took = time.perf_counter() - began
            redrawn.cells += int(cells[: last + 1].sum())
            redrawn.seconds += took
            redrawn.pause = max(redrawn.pause, took)
            progress(k + 1)
    redrawn.log_odds = draw.clamped(draw.add(empty, poses, ranges))

    began, own = time.perf_counter(), []
    for k in range(trail.submaps):
        members = trail.submap == k
        own.append(draw.add(np.zeros(draw.small.shape, np.float32), trail.place[members], ranges[members]))
    drawn = time.perf_counter() - began
    began = time.perf_counter()
    merged, moved = empty.copy(), 0
    for anchor, sums in zip(anchors, own, strict=True):
        moved += _add_submap(merged, sums, anchor, draw)
    longest = time.perf_counter() - began
    sizes = 4 * sum(int(np.count_nonzero(sums)) for sums in own)
    submaps = Way("submaps, put together at the end", draw.clamped(merged), int(cells.sum()) + moved, drawn + longest)
    submaps.pause, submaps.kept = longest, sizes + empty.nbytes
    return [left, redrawn, submaps]


def _add_submap(whole: np.ndarray, sums: np.ndarray, anchor: np.ndarray, draw: _Drawing) -> int:
    """Add what a submap knows to the global grid, each cell where its centre comes to lie; how many cells."""
    row, column = np.nonzero(sums)
    small, spec = draw.small, draw.spec
    centre = np.stack([column + 0.5, row + 0.5, np.zeros(len(row))], axis=-1) * small.resolution
    centre[:, :2] += small.origin
    placed = compose(np.broadcast_to(anchor, centre.shape), centre)
    at = np.floor((placed[:, :2] - spec.origin) / spec.resolution).astype(int)
    inside = np.all((at >= 0) & (at < np.array(spec.shape)[::-1]), axis=1)
    np.add.at(whole, (at[inside, 1], at[inside, 0]), sums[row[inside], column[inside]])
    return int(inside.sum())


def _rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(((poses[:, :2] - truth[:, :2]) ** 2).sum(axis=1).mean()))


def _scored(way: Way, occupied: jax.Array, scans: int) -> dict[str, Any]:
    log_odds = jnp.asarray(way.log_odds)
    seen, wall = log_odds != 0, np.asarray(occupied)
    believed = way.log_odds > 0
    return {
        "name": way.name,
        "cells": way.cells,
        "cells_per_scan": way.cells / scans,
        "ms_per_scan": 1e3 * way.seconds / scans,
        "longest_pause_ms": 1e3 * way.pause,
        "kilobytes": way.kept / 1024,
        "brier": float(quality.brier(log_odds, occupied, seen)),
        "walls_found": float((believed & wall).sum() / max((np.asarray(seen) & wall).sum(), 1)),
        "false_walls": float((believed & ~wall).sum() / max(believed.sum(), 1)),
    }


def _rows(report: dict[str, Any]) -> list[list[str]]:
    return [
        [
            way["name"],
            f"{way['cells_per_scan']:,.0f}",
            f"{way['ms_per_scan']:.2f}",
            f"{way['longest_pause_ms']:.1f}",
            f"{way['kilobytes']:,.0f}",
            f"{way['brier']:.4f}",
            f"{100 * way['walls_found']:.0f} %, {100 * way['false_walls']:.0f} %",
        ]
        for way in report["ways"]
    ]


_HEADS = ("map", "cells written a scan", "ms a scan", "longest pause, ms", "KiB", "Brier", "walls found, false")


def _table(report: dict[str, Any]) -> str:
    rows = [f"| {' | '.join(_HEADS)} |", "|---" * len(_HEADS) + "|"]
    return "\n".join(rows + [f"| {' | '.join(row)} |" for row in _rows(report)])


def _show(report: dict[str, Any]) -> None:
    title = (
        f"{report['scenario']}: {report['scans']} scans, {report['submaps']} submaps, {report['loops']} loops at "
        f"{report['closures']} closures; position RMSE {report['rmse_open_m']:.3f} m open, "
        f"{report['rmse_closed_m']:.3f} m closed"
    )
    table = Table(*_HEADS, title=title, title_justify="left")
    for row in _rows(report):
        table.add_row(*row)
    CONSOLE.print(table)


if __name__ == "__main__":
    command_line(main)
