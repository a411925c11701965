"""Localise a robot by its laser and wheels alone and map what it sees: every scan is matched on the map of those
before, and where the robot comes back to a place, that closes a loop.

The filter matches on submaps a few metres long. Finished ones are recognised in older ones, which makes a pose graph;
its optimum is the trajectory, its covariances are those of the poses since the start, and the maps are drawn there.
With --no-closure, or on a known map, there is one map without an end: coming back corrects the pose where the old walls
are near enough to be matched, and the covariance takes nothing from it.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import tyro

from jaxlocmap import Config, Params, plotting
from jaxlocmap.cli.console import CONSOLE, count_rows, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.cli.options import in_radians, params_or
from jaxlocmap.cli.slam_loops import loop_doubts, loop_rows, write_loops
from jaxlocmap.consistency import readable
from jaxlocmap.graph.trail import trail_of
from jaxlocmap.logs import Log, Trajectory, read, read_relations, read_trajectory, relation_errors, revisits, write_tum
from jaxlocmap.logs.relations import Relations, pairs
from jaxlocmap.mapping import quality
from jaxlocmap.mapping.ros import save_map
from jaxlocmap.matching.storage import load_lines, save_lines
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.poses import compose
from jaxlocmap.replay import loops as replay_loops
from jaxlocmap.replay import maps, scans
from jaxlocmap.se2 import POSE

_STREAK = 3  # scans in a row that are refused: worth a word
_MANY = 0.2  # of the scans: if more are refused, something is wrong


@dataclasses.dataclass(frozen=True)
class SlamConfig:
    """Localise a robot by its laser and wheels alone, map what it sees, and close loops."""

    log: tyro.conf.Positional[Path]
    """The log, plain or gzipped: scans with the odometry of each."""
    format: Literal["carmen"]
    """How the log is written."""
    map: Path | None = None
    """A map of lines that this program wrote: localise on it and leave it as it is."""
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose to start from, m, m, rad: the frame of what is written, or on the known map, to within some 0.2 m and 0.1
    rad."""
    odometry: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Errors of the wheels along, across and in heading after a metre, m, m, rad; a turn of a radian counts as half a
    metre."""
    window: tuple[float, float] = (0.4, 0.4)
    """How far from the odometry a scan is searched at most, m, rad; less where the covariance is small."""
    half_width: float = 40.0
    """Of the matching map about the start, m: what lies beyond is not matched on."""
    closure: bool = True
    """Look for places seen before, and close the loops."""
    submap_length: float = 5.0
    """Of travel in a submap, m, a turn of a radian counted as half a metre."""
    kernel: Literal["gnc", "quadratic", "huber", "cauchy", "geman_mcclure", "dcs"] = "gnc"
    """How loops count that do not fit the others."""
    online: bool = False
    """Also write each pose as it was known when its submap was finished, before later loops."""
    max_range: float = 20.0
    """Ranges at or beyond are no walls, m."""
    fov: float | None = None
    """Degrees from the first beam to the last, symmetric about straight ahead, whatever the log says; where it says
    nothing, 180 are assumed."""
    laser_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """DX DY DTHETA of the scanner, m, m, rad, seen from the robot's odometry."""
    params: Path | None = None
    """JSON file of parameters, `odometry` and those of matching among them; takes the place of `--odometry`."""
    relations: Path | None = None
    """Score the trajectory by relations known from elsewhere: t1 t2 dx dy dz droll dpitch dyaw a line."""
    reference: Path | None = None
    """Score it by a trajectory in TUM format with the log's stamps: how the robot moved between two visits of a
    place."""
    resolution: float = 0.05
    """Side of a cell of the occupancy map, m."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/slam")
    """Folder for estimate.tum, map.pgm, map.yaml, map.png, lines.npz and report.json; and of closed loops graph.g2o,
    poses.csv, graph.png and, if asked for, online.tum."""
    quick: bool = False
    """The first 91 scans alone."""


def main(config: SlamConfig) -> dict[str, Any]:
    """Run the filter over the log; write the trajectory, both maps, the picture and the report."""
    _check(config)
    out = output_folder(config.out)
    merge_kernels()
    log, repeated = scans.in_order(read(config.log, config.format, fov=in_radians(config.fov)))
    if len(log.scan_odometry) != len(log.scan) or not len(log.scan):
        raise ValueError(f"{config.log}: expected laser scans with odometry, got {len(log.scan)} without")
    if config.quick:
        log = log.with_scans(slice(scans.PIECE))
    known = None if config.map is None else load_lines(config.map)
    reference = None if config.reference is None else read_trajectory(config.reference)
    scored = _scored(config, log, reference)
    params = params_or(config.params, scans.believed(config.odometry))
    settings = scans.settings_of(
        log,
        submap_length=config.submap_length if closes(config) else None,
        half_width=config.half_width,
        window=config.window,
        max_range=config.max_range,
        laser_offset=config.laser_offset,
        known=known,
    )
    CONSOLE.print(f"{len(log.scan)} scans of {log.scan.shape[1]} beams; compiling takes some seconds")
    began = time.perf_counter()
    with progress_bar("matching", len(log.scan)) as progress:
        info, state, took = scans.match_log(params, log, settings, config.start, known, progress)
    loops = None
    if closes(config):
        trail, how = trail_of(info.match), {"start": config.start, "kernel": config.kernel}
        with progress_bar("closing loops", trail.submaps) as progress:
            loops = replay_loops.closed(params, log, trail, settings, progress=progress, **how)
    poses, cov = scans.on_the_map(info) if loops is None else (loops.poses, loops.cov)
    report = scans.match_report(log, info, settings, poses, cov)
    report["counts"] = {**log.counts, "repeated_stamps": repeated}
    report |= took | {"params": params.numbers()}
    report |= {name: _errors(log.scan_time, poses, relations) for name, relations in scored.items()}
    names = _write(out, config, log, poses, cov, settings, params, report)
    if loops is None:
        lines = None if state.submaps is None or known else np.asarray(state.submaps.lines)
    else:
        names += write_loops(out, loops, log, report)
        if reference is not None:
            there = scans.at_stamps(reference, log.scan_time)
            report["closure"]["false_kept"] = replay_loops.false_loops(loops, there)
        if config.online:
            write_tum(out / "online.tum", log.scan_time, loops.online)
            names.append("online.tum")
        lines = replay_loops.drawn(log, settings, poses, info.match.accepted | info.match.anew, config.half_width)
    if lines is not None and settings.matcher is not None:
        save_lines(out / "lines.npz", lines, dataclasses.replace(settings.matcher, half_width=config.half_width))
        names.append("lines.npz")
    report["wall_s"] = time.perf_counter() - began
    report["careful"] = said = doubts(report, config)
    write_report(out, report)
    for sentence in said:
        CONSOLE.print(f"careful: {sentence}", soft_wrap=True)
    _show(log.name, report)
    saved(out, *names, "report.json")
    return report


def _check(config: SlamConfig) -> None:
    """Refuse an option out of its range, before anything is read or written."""
    for name in ("start", "laser_offset"):
        if not np.all(np.isfinite(getattr(config, name))):
            raise ValueError(f"{name}: expected three finite numbers, got {getattr(config, name)}")
    for name in ("max_range", "resolution", "submap_length"):
        if not 0 < getattr(config, name) < math.inf:
            raise ValueError(f"{name}: expected metres > 0, got {getattr(config, name)}")
    in_radians(config.fov)


def _scored(config: SlamConfig, log: Log, reference: Trajectory | None) -> dict[str, Relations]:
    """What the trajectory is to be scored by; read before anything is computed."""
    scored = {}
    if config.relations is not None:
        scored["relations"] = read_relations(config.relations)
    if reference is not None:
        scored["revisits"] = revisits(reference.time, reference.pose)
    for name, relations in scored.items():
        _, _, there = pairs(log.scan_time, relations)
        if not there.any():
            span = f"{log.scan_time[0]:.3f} to {log.scan_time[-1]:.3f} s"
            raise ValueError(f"{name}: expected pairs of stamps of the log, {span}, got none: do their clocks differ?")
    return scored


def closes(config: SlamConfig) -> bool:
    """Whether loops are looked for."""
    return config.closure and config.map is None


def doubts(report: Mapping[str, Any], config: SlamConfig) -> list[str]:
    """What a user should know before trusting the result."""
    said, count, refused = [], report["scans"], report["refused"]
    if report["matched"] + 1 < (1 - _MANY) * count:
        reasons = ", ".join(f"{name} {count}" for name, count in refused.items())
        where = "is it the map of this place, and --start on it" if config.map else "do --odometry and --fov fit"
        said.append(f"{count - report['matched']} of {count} scans were not matched ({reasons}): {where}?")
    if (most := report["refused_most_in_a_row"]) >= _STREAK:
        said.append(
            f"{most} scans in a row were not matched, from {report['refused_most_from_s']:.3f} s on: there the pose is "
            "odometry, and what follows may be matched on the wrong wall"
        )
    if report["nis_mean"] is not None and report["nis_mean"] > 2 * POSE:
        said.append(f"matches lie {report['nis_mean']:.1f} from the odometry (3 expected): --odometry is too small")
    if report["flagged"]:
        said.append(f"{report['flagged']} steps are flagged: odometry that is not finite, or no covariance")
    return said + loop_doubts(report)


def _errors(time: np.ndarray, poses: np.ndarray, relations: Relations) -> dict[str, Any]:
    error = relation_errors(time, poses, relations)
    degrees = np.rad2deg(error.rotation)
    return {
        "scored": len(degrees),
        "given": len(relations.time),
        "translation_m": float(error.translation.mean()),
        "translation_std_m": float(error.translation.std()),
        "translation_median_m": float(np.median(error.translation)),
        "rotation_deg": float(degrees.mean()),
        "rotation_median_deg": float(np.median(degrees)),
    }


def _write(
    out: Path,
    config: SlamConfig,
    log: Log,
    poses: np.ndarray,
    cov: np.ndarray,
    settings: Config,
    params: Params,
    report: dict[str, Any],
) -> list[str]:
    """The trajectory, and the occupancy map made at its poses; the names of what was written."""
    write_tum(out / "estimate.tum", log.scan_time, poses)
    seen = dataclasses.replace(log, truth=compose(poses, config.laser_offset), truth_time=log.scan_time)
    local, spec, mapping = maps.mappable(seen, config.resolution, config.max_range)
    with progress_bar("mapping", len(log.scan)) as progress:
        log_odds, _, _ = maps.make_map(params, local, mapping, progress)
    cells = save_map(out, log_odds, spec, name="map")
    how = "with loops closed" if closes(config) else "matched one after the other"
    title = f"{log.name}: {len(poses)} scans {how}, cells of {config.resolution:g} m"
    plotting.map_figure(out / "map.png", log_odds, spec, poses, cov=cov, title=title)
    report |= {"entropy_bits": float(quality.entropy_bits(jnp.asarray(log_odds))), "shape": list(cells.shape)}
    return ["estimate.tum", "map.pgm", "map.yaml", "map.png"]


def _show(name: str, report: Mapping[str, Any]) -> None:
    refused = ", ".join(f"{reason} {count}" for reason, count in report["refused"].items())
    rows = [
        ("scans, beams", f"{report['scans']}, {report['beams']}", ""),
        ("path", f"{report['path_m']:.0f} m", ""),
        ("matched", f"{report['matched']} of {report['tried']}", ""),
        ("refused", refused, ""),
        ("NIS of matches, mean", readable(report["nis_mean"]), "3"),
        ("points on lines", f"{100 * report['points_used']:.0f} %", ""),
        ("1 sigma since the start, at the end", f"{report['sigma_position_end_m']:.3f} m", ""),
        ("a scan, compilation", f"{report['ms_per_scan']:.2f} ms, {report['compile_s']:.1f} s", ""),
        ("entropy of the map", f"{report['entropy_bits']:.0f} bits", ""),
        *loop_rows(report),
        ("seconds in all", f"{report['wall_s']:.1f}", ""),
    ]
    for kind in ("relations", "revisits"):
        if kind in report:
            score = report[kind]
            rows += [
                (f"{kind} scored", f"{score['scored']} of {score['given']}", ""),
                ("  translation", f"{score['translation_m']:.3f} m, median {score['translation_median_m']:.3f} m", ""),
                ("  rotation", f"{score['rotation_deg']:.2f}°, median {score['rotation_median_deg']:.2f}°", ""),
            ]
    show(name, [*rows, *count_rows(report["counts"])])
