"""Optimise a pose graph and say how far its poses can be believed: chi-square before and after, covariances of all
poses, and the loops that do not fit.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxlocmap import graph, plotting
from jaxlocmap.cli.console import CONSOLE, output_folder, saved, show, write_report
from jaxlocmap.cli.rows import pose_rows, print_verdicts
from jaxlocmap.consistency import chi2_quantile, judge, readable
from jaxlocmap.graph import Kernel, Solution
from jaxlocmap.graph.kernels import GOOD
from jaxlocmap.logs import (
    GraphFile,
    Trajectory,
    chained,
    pair,
    read_graph,
    read_trajectory,
    write_csv,
    write_g2o,
    write_tum,
)
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.se2 import POSE

_LISTED = 10  # loops that fit worst
_GRAPHS = (".g2o", ".graph", ".toro")


@dataclasses.dataclass(frozen=True)
class GraphConfig:
    """Optimise a pose graph, and say how far its poses can be believed and which loops do not fit."""

    file: tyro.conf.Positional[Path]
    """The graph, plain or gzipped: g2o or TORO, told apart by their tags, or iSAM with --isam."""
    isam: bool = False
    """EDGE2 holds the square root of the information, as iSAM writes it; TORO's tag is the same."""
    kernel: Literal["quadratic", "huber", "cauchy", "geman_mcclure", "dcs", "gnc"] = "quadratic"
    """How loops that do not fit count: in full (quadratic), less, or not at all. Against false loops: gnc."""
    scale: float | None = None
    """Of the kernel, in standard deviations; a usual one by default."""
    start: Literal["chordal", "file", "odometry"] | None = None
    """Where the search begins; by default chordal if all loops are trusted, else odometry."""
    method: Literal["loop_space", "scipy", "sparsax"] | None = None
    """How linear systems are solved; chosen by size."""
    judge: Path | None = None
    """True poses, to score the optimised ones by: a graph file, or TUM or CSV whose stamps are the vertices' ids."""
    seed: int = 0
    """Nothing here is random; every program has it."""
    out: Path = Path("out/graph")
    """Folder for graph.g2o, poses.csv, poses.tum, graph.png and report.json."""
    quick: bool = False
    """Ten steps of the search at most."""


def main(config: GraphConfig) -> dict[str, Any]:
    """Read, optimise, write the graph, the poses with their covariances, the picture and the report."""
    out = output_folder(config.out)
    jax.config.update("jax_enable_x64", True)
    kernel = Kernel(config.kernel, config.scale)
    file = read_graph(config.file, isam=config.isam)
    truth = None if config.judge is None else _truth(config.judge, file)
    name = config.start or ("chordal" if config.kernel == "quadratic" else "odometry")
    if name == "file" and file.poses is None:
        raise ValueError(f"{config.file}: expected vertices to start from, got edges alone")
    CONSOLE.print(f"{file.graph.poses} poses, {file.graph.loops} loops; compiling takes some seconds")
    began = time.perf_counter()
    start, solution, cov, seconds = _solved(config, file, name, kernel)
    poses, turn = _in_frame(np.asarray(solution.poses, np.float64), file)
    start, _ = _in_frame(np.asarray(start, np.float64), file)
    cov = turn @ cov @ turn.T
    report = _report(config, file, solution, name, seconds)
    report["wall_s"] = time.perf_counter() - began
    report["careful"] = said = _doubts(report, file, solution)
    if truth is not None:
        truth = truth._replace(pose=_as_one(truth.pose, truth.pose[_fixed(truth, file)[0]], poses[file.fixed]))
        report["judged"] = _judged(truth, file, poses, cov)
    stamps = file.ids.astype(float)
    write_g2o(out / "graph.g2o", file.graph, poses, file.ids, fixed=file.fixed)
    write_csv(out / "poses.csv", stamps, poses, cov)
    write_tum(out / "poses.tum", stamps, poses)
    weights, ends = np.asarray(solution.weights), np.asarray(file.graph.pair)
    title = f"{config.file.name}: χ² {readable(report['chi2_start'])} before, {readable(report['chi2'])} after"
    seen = None if truth is None else truth.pose
    plotting.graph_figure(out / "graph.png", poses, cov, ends, weights, before=start, truth=seen, title=title)
    write_report(out, report)
    for sentence in said:
        CONSOLE.print(f"careful: {sentence}", soft_wrap=True)
    _show(report)
    saved(out, "graph.g2o", "poses.csv", "poses.tum", "graph.png", "report.json")
    return report


def _truth(path: Path, file: GraphFile) -> Trajectory:
    """True poses with the graph's ids for stamps, that of the vertex that stays among them."""
    if Path(path.name.removesuffix(".gz")).suffix in _GRAPHS:
        true = read_graph(path)
        if true.poses is None:
            raise ValueError(f"{path}: expected vertices with true poses, got edges alone")
        truth = Trajectory(true.ids.astype(float), true.poses, None, {})
    else:
        truth = read_trajectory(path)
    if not len(_fixed(truth, file)):
        raise ValueError(f"judge: expected the true pose of vertex {file.ids[file.fixed]}, which stays, got none")
    return truth


def _fixed(truth: Trajectory, file: GraphFile) -> np.ndarray:
    """Where in the truth the vertex that stays is."""
    return np.flatnonzero(truth.time == file.ids[file.fixed])


def _solved(
    config: GraphConfig, file: GraphFile, name: str, kernel: Kernel
) -> tuple[np.ndarray, Solution, np.ndarray, dict[str, float]]:
    """Start, solution, covariances and seconds; compiled before, so that seconds are those of the work."""
    g, steps = file.graph, 10 if config.quick else 100

    def begun() -> Any:
        if name == "chordal":
            first = jnp.zeros(POSE) if file.poses is None else jnp.asarray(file.poses[0])
            return graph.chordal(g, first, method=config.method)
        return jnp.asarray(chained(file) if name == "odometry" or file.poses is None else file.poses)

    def solved() -> tuple[Any, Solution]:
        start = begun()
        return start, graph.solve(g, start, kernel=kernel, method=config.method, steps=steps)

    began = time.perf_counter()
    jax.block_until_ready(solved())
    compiled = time.perf_counter()
    start, solution = jax.block_until_ready(solved())
    done = time.perf_counter()
    cov = graph.marginals(g, solution, fixed=file.fixed, method=config.method)
    seconds = {
        "seconds": done - compiled,
        "compile_s": max(compiled - began - (done - compiled), 0.0),
        "covariances_s": time.perf_counter() - done,
    }
    return np.asarray(start), solution, np.asarray(cov, np.float64), seconds


def _in_frame(poses: np.ndarray, file: GraphFile) -> tuple[np.ndarray, np.ndarray]:
    """The poses moved as one so that the fixed one is where the file has it, and how that turns x, y and theta."""
    k = file.fixed
    at = np.zeros(POSE) if file.poses is None else file.poses[k]
    moved = _as_one(poses, poses[k], at)
    cos, sin = np.cos(at[2] - poses[k, 2]), np.sin(at[2] - poses[k, 2])
    return moved, np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _as_one(poses: np.ndarray, one: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses moved together so that one of them comes to lie elsewhere."""
    moved = compose(at, between(np.broadcast_to(one, poses.shape), poses))
    moved[:, 2] = wrapped(moved[:, 2])
    return moved


def _report(
    config: GraphConfig, file: GraphFile, solution: Solution, start: str, seconds: dict[str, float]
) -> dict[str, Any]:
    chain, loops = (np.asarray(x) for x in graph.chi2(file.graph, solution.poses))
    weights = np.asarray(solution.weights)
    dof = POSE * (len(loops) - int(np.sum(file.odometry_line == 0)))
    worst = np.argsort(-loops)
    suspicious = [int(k) for k in worst if loops[k] > GOOD or weights[k] < 0.5]
    ends = file.ids[np.asarray(file.graph.pair)]
    return {
        "graph": config.file.name,
        "poses": file.graph.poses,
        "loops": file.graph.loops,
        "kernel": config.kernel,
        "start": start,
        "chi2_start": float(solution.chi2_start),
        "chi2": float(solution.chi2),
        "chi2_odometry": float(chain.sum()),
        "objective": float(solution.objective),
        "degrees_of_freedom": dof,
        "chi2_band_95": [float(chi2_quantile(p, dof)) for p in (0.025, 0.975)] if dof > 0 else None,
        "iterations": int(solution.iterations),
        "converged": bool(solution.converged),
        **seconds,
        "loops_down_weighted": int(np.sum(weights < 0.5)),
        "loops_beyond_99": int(np.sum(loops > GOOD)),
        "suspicious": [
            {
                "line": int(file.loop_line[k]),
                "from": int(ends[k, 0]),
                "to": int(ends[k, 1]),
                "chi2": float(loops[k]),
                "weight": float(weights[k]),
            }
            for k in suspicious
        ],
        "fixed": int(file.ids[file.fixed]),
        "counts": file.counts,
    }


def _doubts(report: dict[str, Any], file: GraphFile, solution: Solution) -> list[str]:
    """What a user should know before trusting the result."""
    said = [f"not converged: {reason}" for reason in graph.faults(file.graph, solution)]
    if not file.has_fix:
        said.append(f"the file fixes no vertex: vertex {report['fixed']} stays, and covariances are given it")
    if not report["loops"]:
        said.append("no loops: the poses are those of odometry, and so is their covariance")
    band = report["chi2_band_95"]
    if band and report["kernel"] == "quadratic" and report["chi2"] > band[1]:
        factor = report["chi2"] / report["degrees_of_freedom"]
        said.append(
            f"χ² is {factor:.2g} a degree of freedom, beyond 95 % of right graphs: false loops (try --kernel gnc), or "
            "information too large by about that factor, and then covariances too small by it"
        )
    if band and report["kernel"] == "quadratic" and report["chi2"] < band[0]:
        factor = report["degrees_of_freedom"] / report["chi2"]
        said.append(
            f"χ² is {1 / factor:.2g} a degree of freedom, below 95 % of right graphs: the information is too small by "
            f"about {factor:.2g}, and the covariances too large"
        )
    return said


def _judged(truth: Trajectory, file: GraphFile, poses: np.ndarray, cov: np.ndarray) -> dict[str, Any]:
    rest = np.arange(len(poses)) != file.fixed
    estimate = Trajectory(file.ids[rest].astype(float), poses[rest], cov[rest], {})
    pairs = pair([truth], [estimate], ["poses.csv"], max_gap=0.0)
    return judge(pairs.truth, pairs.mean, pairs.cov, time=pairs.time, valid=pairs.valid)


def _show(report: dict[str, Any]) -> None:
    band = report["chi2_band_95"]
    rows = [
        ("poses, loops", f"{report['poses']}, {report['loops']}", ""),
        ("χ² at the start", f"{report['chi2_start']:.6g}", ""),
        ("χ² after", f"{report['chi2']:.6g}", f"{band[0]:.5g} to {band[1]:.5g}" if band else ""),
        ("iterations, converged", f"{report['iterations']}, {'yes' if report['converged'] else 'no'}", ""),
        ("seconds, without compiling", readable(report["seconds"]), ""),
        ("loops down-weighted below 0.5", str(report["loops_down_weighted"]), ""),
        ("loops with χ² > 11.3 (3 numbers)", str(report["loops_beyond_99"]), f"{0.01 * report['loops']:.3g} or fewer"),
    ]
    if "judged" in report:
        rows += pose_rows(report["judged"])
    for name, count in report["counts"].items():
        if count:
            rows.append((f"in the file: {name.replace('_', ' ')}", str(count), ""))
    show(report["graph"], rows)
    for loop in report["suspicious"][:_LISTED]:
        CONSOLE.print(
            f"suspicious: line {loop['line']}, vertex {loop['from']} to {loop['to']}: χ² {readable(loop['chi2'])}, "
            f"weight {loop['weight']:.2g}"
        )
    if (more := len(report["suspicious"]) - _LISTED) > 0:
        CONSOLE.print(f"and {more} more, see report.json")
    if "judged" in report:
        print_verdicts(report["judged"])
