"""Localise a robot by its laser and wheels alone and map what it sees: every scan is matched on the map of those
before, and where the robot comes back to a place, that closes a loop.

The filter matches on submaps a few metres long. Finished ones are recognised in older ones, which makes a pose graph;
its optimum is the trajectory, its covariances are those of the poses since the start, and the maps are drawn there.
With --no-closure, or on a known map, there is one map without an end: coming back corrects the pose where the old walls
are near enough to be matched, and the covariance takes nothing from it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from common import CONSOLE, command_line, count_rows, in_pieces, output_folder, params_or, saved, show, write_report
from map_log import in_radians, make_map, ready
from slam_loops import closed, drawn, false_loops, loop_doubts, loop_rows, write_loops

from jaxlocmap import Config, Gaussian, Info, Inputs, Params, State, init, plotting, run
from jaxlocmap.consistency import readable
from jaxlocmap.logs import Log, Trajectory, read, read_relations, read_trajectory, relation_errors, revisits, write_tum
from jaxlocmap.logs.relations import Relations, find_stamps, pairs
from jaxlocmap.mapping import quality
from jaxlocmap.mapping.ros import save_map
from jaxlocmap.matching import submaps
from jaxlocmap.matching.storage import LoadedLines, load_lines, save_lines
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.se2 import POSE
from jaxlocmap.types import Matcher

_ANY_SCANS = 2**30  # of a submap, whose travel ends it
_PIECE = 91  # scans between two moves of the progress bar
_OLDER = POSE  # entry of the state at which the anchor of the map begins
_START_STD = (0.2, 0.2, 0.1)  # m, m, rad: of the start on a known map
_KNOWN_STD = (0.02, 0.005)  # m, rad: errors of a known map
_STREAK = 3  # scans in a row that are refused: worth a word
_LEAST_SHARE = (0.2, 0.5)  # of a scan's points, on a map that grows and on a known one, which has every room
_MANY = 0.2  # of the scans: if more are refused, something is wrong


@dataclasses.dataclass(frozen=True)
class SlamConfig:
    """Settings of the filter, and what it reads."""

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
    log, repeated = in_order(read(config.log, config.format, fov=in_radians(config.fov)))
    if len(log.scan_odometry) != len(log.scan) or not len(log.scan):
        raise ValueError(f"{config.log}: expected laser scans with odometry, got {len(log.scan)} without")
    if config.quick:
        log = log.with_scans(slice(_PIECE))
    known = None if config.map is None else load_lines(config.map)
    scored = _scored(config, log)
    params = params_or(config.params, believed(config))
    settings = settings_of(config, log, known)
    CONSOLE.print(f"{len(log.scan)} scans of {log.scan.shape[1]} beams; compiling takes some seconds")
    began = time.perf_counter()
    info, state, took = match_log(params, log, settings, config.start, known)
    loops = closed(params, log, info, settings, config) if closes(config) else None
    poses, cov = on_the_map(info) if loops is None else (loops.poses, loops.cov)
    report = judge(log, info, settings, poses, cov)
    report["counts"] = {**log.counts, "repeated_stamps": repeated}
    report |= took | {"params": params.numbers()}
    report |= {name: _errors(log.scan_time, poses, relations) for name, relations in scored.items()}
    names = _write(out, config, log, poses, cov, settings, params, report)
    if loops is None:
        lines = None if state.submaps is None or known else np.asarray(state.submaps.lines)
    else:
        names += write_loops(out, loops, log, report)
        if config.reference is not None:
            reference = at_stamps(read_trajectory(config.reference), log.scan_time)
            report["closure"]["false_kept"] = false_loops(loops, reference)
        if config.online:
            write_tum(out / "online.tum", log.scan_time, loops.online)
            names.append("online.tum")
        lines = drawn(log, settings, poses, info.match.accepted | info.match.anew, config.half_width)
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


def in_order(log: Log) -> tuple[Log, int]:
    """The scans sorted by stamp, the first of each, and how many stamps repeated one."""
    _, first = np.unique(log.scan_time, return_index=True)
    return log.with_scans(first), len(log.scan_time) - len(first)


def _scored(config: SlamConfig, log: Log) -> dict[str, Relations]:
    """What the trajectory is to be scored by; read before anything is computed."""
    scored = {}
    if config.relations is not None:
        scored["relations"] = read_relations(config.relations)
    if config.reference is not None:
        reference = read_trajectory(config.reference)
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


def at_stamps(reference: Trajectory, time: np.ndarray) -> np.ndarray:
    """The poses of a reference at the stamps of scans, (S, 3), NaN where it has none."""
    place, known = find_stamps(reference.time, time)
    return np.where(known[:, None], reference.pose[place], np.nan)


def believed(config: SlamConfig) -> Params:
    return submaps.with_defaults(Params.from_std(odometry=config.odometry))


def settings_of(config: SlamConfig, log: Log, known: LoadedLines | None) -> Config:
    """Submaps, one map without an end, or one that is known."""
    reach = min(config.max_range, log.scan_max_range)
    submap = closes(config)
    half_width = reach + 2 * config.submap_length if submap else config.half_width
    matcher = Matcher(
        submap_scans=_ANY_SCANS if submap else None,
        submap_length=config.submap_length,
        resolution=0.1 if known is None else known.resolution,
        half_width=half_width if known is None else known.half_width,
        steps=20,
        window=config.window,
        least_share=_LEAST_SHARE[known is not None],
        known_std=None if known is None else _KNOWN_STD,
    )
    return Config(
        dt=1.0,  # a scan, whatever time it took: the noise of the odometry grows with the way
        motion="odometry",
        matcher=matcher,
        max_range=reach,
        scanner_offset=config.laser_offset,
    )


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def _piece(
    params: Params, state: State, inputs: Inputs, beam_angles: jax.Array, *, config: Config
) -> tuple[State, Info]:
    return run(params, state, inputs, beam_angles=beam_angles, config=config)


def match_log(
    params: Params, log: Log, config: Config, start: tuple[float, float, float], known: LoadedLines | None
) -> tuple[Info, State, dict[str, float]]:
    """`run` in equal pieces so that a bar can move; the last is filled up with scans of nothing.

    Returns:
        What every scan reports, the last state, and seconds: of compiling, and of a scan.
    """
    scans, angles = len(log.scan), jnp.asarray(log.beam_angles, jnp.float32)
    steps = np.concatenate([np.zeros((1, POSE)), between(log.scan_odometry[:-1], log.scan_odometry[1:])])
    fill = -scans % _PIECE
    inputs = Inputs(
        dt=jnp.ones(scans + fill),
        control=jnp.asarray(np.concatenate([steps, np.zeros((fill, POSE))]), jnp.float32),
        landmark=jnp.zeros((scans + fill, 0), jnp.int32),
        z=jnp.zeros((scans + fill, 0, 2)),
        valid=jnp.zeros((scans + fill, 0), bool),
        ranges=jnp.asarray(np.concatenate([log.scan, np.full((fill, log.scan.shape[1]), np.nan)]), jnp.float32),
    )
    std = jnp.array(_START_STD if known else (0.0, 0.0, 0.0))
    state = init(Gaussian(jnp.array(start), jnp.diag(std**2)), config=config)
    if known is not None and config.matcher is not None:
        state = state._replace(submaps=submaps.known(jnp.asarray(known.lines), config.matcher, state.belief.mean.dtype))
    began = time.perf_counter()
    first = jax.tree.map(lambda x: x[:_PIECE], inputs)
    program = _piece.lower(params, state, first, angles, config=config).compile()
    compiled = time.perf_counter()

    def turn(state: State, piece: Inputs) -> tuple[State, Info]:
        return program(params, state, piece, angles)

    state, info = in_pieces(turn, state, inputs, scans, _PIECE, "matching")
    each = 1e3 * (time.perf_counter() - compiled) / (scans + fill)
    return info, state, {"compile_s": compiled - began, "ms_per_scan": each}


def on_the_map(info: Info) -> tuple[np.ndarray, np.ndarray]:
    """The poses on the map, (S, 3): those that its lines were drawn at; and the covariances of the poses since the
    start, (S, 3, 3).
    """
    mean = np.asarray(info.belief.mean, np.float64)
    local = np.asarray(jax.vmap(lambda mean: submaps.relative_pose(mean, _OLDER)[0])(info.belief.mean), np.float64)
    poses = compose(mean[:, _OLDER : _OLDER + POSE], local)
    poses[:, 2] = wrapped(poses[:, 2])
    return poses, np.asarray(info.belief.cov, np.float64)[:, :POSE, :POSE]


def judge(log: Log, info: Info, config: Config, poses: np.ndarray, cov: np.ndarray) -> dict[str, Any]:
    """What the matches say of themselves."""
    match, matcher = info.match, config.matcher
    if matcher is None:
        raise ValueError("config.matcher: expected a Matcher, got None")
    refused = jax.tree.map(np.asarray, submaps.refusals(match, matcher))
    tried = int(match.tried.sum())
    at = np.concatenate([[-1], np.flatnonzero(match.accepted | match.anew), [len(match.accepted)]])
    streaks = np.diff(at) - 1
    longest = int(np.argmax(streaks))
    sigma = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0))
    return {
        "log": log.name,
        "scans": len(log.scan),
        "beams": log.scan.shape[1],
        "path_m": float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()),
        "matched": int(match.accepted.sum()),
        "tried": tried,
        "refused": {name: int(reason.sum()) for name, reason in refused._asdict().items()},
        "refused_most_in_a_row": int(streaks[longest]),
        "refused_most_from_s": float(log.scan_time[at[longest] + 1]) if streaks[longest] else None,
        "nis_mean": float(match.nis[match.accepted].mean()) if match.accepted.any() else None,
        "nis_median": float(np.median(match.nis[match.accepted])) if match.accepted.any() else None,
        "points_used": float((match.used / np.maximum(match.points, 1))[match.tried].mean()) if tried else 0.0,
        "flagged": int((~info.ok).sum()),
        "sigma_position_end_m": float(np.hypot(sigma[-1, 0], sigma[-1, 1])),
        "sigma_position_most_m": float(np.hypot(sigma[:, 0], sigma[:, 1]).max()),
        "sigma_heading_end_rad": float(sigma[-1, 2]),
    }


def doubts(report: Mapping[str, Any], config: SlamConfig) -> list[str]:
    """What a user should know before trusting the result."""
    said, scans, refused = [], report["scans"], report["refused"]
    if report["matched"] + 1 < (1 - _MANY) * scans:
        reasons = ", ".join(f"{name} {count}" for name, count in refused.items())
        where = "is it the map of this place, and --start on it" if config.map else "do --odometry and --fov fit"
        said.append(f"{scans - report['matched']} of {scans} scans were not matched ({reasons}): {where}?")
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
    local, spec, mapping = ready(seen, config.resolution, config.max_range)
    log_odds, _, _ = make_map(params, local, mapping)
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


if __name__ == "__main__":
    command_line(main, SlamConfig)
