"""Can the covariance of a pose graph be believed, with and without false loops? Simulated graphs, a thousand at a time,
each kernel: NEES of the poses, and which loops are kept.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from evidence import replace_table
from rich.table import Table

from jaxlocmap import graph, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.consistency import mean_over_runs, readable
from jaxlocmap.graph.kernels import NAMES
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.se2 import POSE, wrap

_KEPT = 0.5


@dataclasses.dataclass(frozen=True)
class GraphStudyConfig:
    """What is simulated."""

    graphs: int = 1000
    """How many, each of its own shape."""
    poses: int = 100
    """Of a graph."""
    loops: int = 10
    """Of a graph, that are true."""
    false: tuple[int, ...] = (0, 2, 10)
    """How many more are false; a study for each."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/graph_study")
    """Folder for report.json."""
    quick: bool = False
    """Fifty graphs, the first of `false` alone."""


def main(config: GraphStudyConfig) -> dict[str, Any]:
    """Simulate, solve, score; write the report and print the table."""
    out = output_folder(config.out)
    merge_kernels()
    if config.graphs < 2:
        raise ValueError(f"graphs: expected at least 2, got {config.graphs}")
    count = min(config.graphs, 50) if config.quick else config.graphs
    shares = list(config.false[:1] if config.quick else config.false)
    began, studies = time.perf_counter(), []
    CONSOLE.print(f"{count} graphs of {config.poses} poses and {config.loops} loops; compiling takes some seconds")
    with jax.enable_x64(True), progress_bar("kernels", len(shares) * len(NAMES)) as progress:
        for false in shares:
            keys = jax.random.split(jax.random.key(config.seed), count)
            draw = functools.partial(simulation.simulate_graph, poses=config.poses, loops=config.loops, false=false)
            truth, graphs = jax.jit(jax.vmap(draw))(keys)
            for kernel in NAMES:
                studies.append({"false": false, "kernel": kernel, **_study(truth, graphs, kernel, config.loops)})
                progress(len(studies))
    report = {"graphs": count, "poses": config.poses, "loops": config.loops, "seed": config.seed, "studies": studies}
    report["wall_s"] = time.perf_counter() - began
    write_report(out, report)
    _show(report)
    if config.write:
        replace_table("graphs", _table(report))
    saved(out, "report.json")
    return report


def _study(truth: jax.Array, graphs: graph.Graph, kernel: str, loops: int) -> dict[str, Any]:
    def one(truth: jax.Array, g: graph.Graph) -> Any:
        # From odometry, whatever the kernel: it is what the false loops cannot touch.
        solution = graph.solve(g, graph.dead_reckoning(g), kernel=kernel)
        cov = graph.marginals(g, solution)
        error = truth - solution.poses
        error = error.at[:, 2].set(wrap(error[:, 2]))[1:]
        nees = jnp.sum(error * jnp.linalg.solve(cov[1:], error[..., None])[..., 0], axis=-1)
        return nees, jnp.sum(error[:, :2] ** 2, axis=-1), solution.weights, solution.converged

    solve = jax.jit(jax.vmap(one)).lower(truth, graphs).compile()
    began = time.perf_counter()
    nees, squares, weights, converged = jax.tree.map(np.asarray, solve(truth, graphs))
    seconds = time.perf_counter() - began
    kept, true = weights > _KEPT, np.arange(weights.shape[1]) < loops
    right = np.sum(kept & true)
    fields: dict[str, Any] = {}
    for name, values in (("last_pose", nees[:, -1]), ("poses", nees.mean(axis=1))):
        mean = mean_over_runs(float(values.sum()), float((values**2).sum()), len(values), POSE)
        fields |= {f"{name}_anees": mean.value, f"{name}_anees_band_95": mean.band_95}
    return {
        **fields,
        "last_pose_nees_median": float(np.median(nees[:, -1])),
        "rmse_position_m": float(np.sqrt(squares.mean())),
        "precision": float(right / max(kept.sum(), 1)),
        "recall": float(right / max(len(kept) * loops, 1)),
        "converged": int(converged.sum()),
        "seconds": seconds,
    }


def _table(report: dict[str, Any]) -> str:
    heads = (
        "false loops",
        "kernel",
        "NEES of the last pose (3)",
        "median (2.37)",
        "position RMSE",
        "precision, recall",
    )
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for study in report["studies"]:
        rows.append(
            f"| {study['false']} | {study['kernel']} | {readable(study['last_pose_anees'])} "
            f"| {readable(study['last_pose_nees_median'])} | {study['rmse_position_m']:.3g} m "
            f"| {study['precision']:.3f}, {study['recall']:.3f} |"
        )
    return "\n".join(rows)


def _show(report: dict[str, Any]) -> None:
    names = ["false", "kernel", "NEES", "95 % band", "median", "RMSE m", "precision", "recall", "conv.", "s"]
    title = f"{report['graphs']} graphs, {report['poses']} poses, {report['loops']} true loops; NEES of the last pose"
    table = Table(*names, title=title, title_justify="left")
    for study in report["studies"]:
        low, high = study["last_pose_anees_band_95"]
        table.add_row(
            str(study["false"]),
            study["kernel"],
            readable(study["last_pose_anees"]),
            f"{low:.3g}-{high:.3g}",
            readable(study["last_pose_nees_median"]),
            f"{study['rmse_position_m']:.3g}",
            f"{study['precision']:.4f}",
            f"{study['recall']:.4f}",
            str(study["converged"]),
            f"{study['seconds']:.2f}",
        )
    CONSOLE.print(table)


if __name__ == "__main__":
    command_line(main)
