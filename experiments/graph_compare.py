"""Pose graphs beside GTSAM in one sitting: time to the same optimum, many small graphs at once, covariances, and false
loops. Needs the extra `benchmark`.

Both are given the same edges. GTSAM 4.3 measures an edge's error by the logarithm of SE(2), this library as g2o does,
so optima differ a little, and each is only timed on its own. Times leave compilation out.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gtsam  # pyright: ignore[reportMissingImports] comes with the extra `benchmark` alone
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from evidence import replace_table

from jaxlocmap import graph, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import output_folder, progress_bar, saved, show, write_report
from jaxlocmap.graph.kernels import GOOD
from jaxlocmap.graph.sparse import has_sparsax
from jaxlocmap.logs import read_graph
from jaxlocmap.poses import between

_FALSE = 0.2  # share of false loops among the true ones
_SEEDS = 3
_TOLERANCE = 1e-5  # relative, GTSAM's own for Gauss-Newton
_TIMES = 5  # of each, by turns; medians


@dataclasses.dataclass(frozen=True)
class GraphCompareConfig:
    """Which graphs."""

    data: tyro.conf.Positional[Path]
    """Folder with input_M3500_g2o.g2o and CSAIL_P_toro.graph."""
    graphs: int = 1000
    """Simulated graphs of 100 poses and 10 loops."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/graph_compare")
    """Folder for report.json."""
    quick: bool = False
    """Fifty simulated graphs, one measurement of each."""


def main(config: GraphCompareConfig) -> dict[str, Any]:
    """Time both by turns, compare covariances and loops; write the report and print the table."""
    out = output_folder(config.out)
    jax.config.update("jax_enable_x64", True)
    times = 1 if config.quick else _TIMES
    report: dict[str, Any] = {"gtsam": version("gtsam")}
    with progress_bar("comparing", 4) as progress:
        report["m3500"] = _large(config.data / "input_M3500_g2o.g2o", times)
        progress(1)
        report["csail"] = _large(config.data / "CSAIL_P_toro.graph", times)
        progress(2)
        report["batch"] = _batch(config, 50 if config.quick else config.graphs, times)
        progress(3)
        report["false_loops"] = _false_loops(config.data / "CSAIL_P_toro.graph", config.seed)
        progress(4)
    write_report(out, report)
    _show(report)
    if config.write:
        replace_table("gtsam", _table(report))
    saved(out, "report.json")
    return report


def _by_turns(times: int, **jobs: Callable[[], Any]) -> dict[str, float]:
    """Median seconds of each, run once before."""
    for job in jobs.values():
        job()
    took: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(times):
        for name, job in jobs.items():
            began = time.perf_counter()
            job()
            took[name].append(time.perf_counter() - began)
    return {name: float(np.median(seconds)) for name, seconds in took.items()}


def _peers(g: graph.Graph) -> gtsam.NonlinearFactorGraph:
    """The same edges, the first pose fixed."""
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(0, 0, 0), gtsam.noiseModel.Constrained.All(3)))
    chain = [(k, k + 1) for k in range(g.poses - 1)]
    for pairs, moved, information in (
        (chain, g.odometry, g.odometry_information),
        (g.pair, g.loop, g.loop_information),
    ):
        for (a, b), z, omega in zip(np.asarray(pairs), np.asarray(moved), np.asarray(information), strict=True):
            noise = gtsam.noiseModel.Gaussian.Information(omega)
            factors.add(gtsam.BetweenFactorPose2(int(a), int(b), gtsam.Pose2(*z), noise))
    return factors


def _values(poses: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(np.asarray(poses)):
        values.insert(k, gtsam.Pose2(*pose))
    return values


def _large(path: Path, times: int) -> dict[str, Any]:
    """One public graph, from the chordal start, which is not timed."""
    file = read_graph(path)
    g, start = file.graph, graph.chordal(file.graph)
    factors, values = _peers(g), _values(np.asarray(start))

    def ours(method: str) -> Callable[[], Any]:
        return lambda: jax.block_until_ready(graph.solve(g, start, method=method, tolerance=_TOLERANCE))

    methods = ["scipy", *(["sparsax"] if has_sparsax() else []), *(["loop_space"] if g.loops < 300 else [])]
    jobs = {method: ours(method) for method in methods}
    seconds = _by_turns(times, gtsam=lambda: gtsam.GaussNewtonOptimizer(factors, values).optimize(), **jobs)
    solution = graph.solve(g, start)
    best = gtsam.GaussNewtonOptimizer(factors, values).optimize()
    # The same point for both, and measurements that fit it: where errors are zero, so is the difference of conventions.
    a, b = np.asarray(g.pair).T
    poses = np.asarray(solution.poses)
    fitting = g._replace(odometry=between(poses[:-1], poses[1:]), loop=between(poses[a], poses[b]))
    marginals = gtsam.Marginals(_peers(fitting), _values(poses))
    cov = np.asarray(graph.marginals(jax.tree.map(jnp.asarray, fitting), solution, frame="body"))
    every = np.array([marginals.marginalCovariance(k) for k in range(1, g.poses, max(1, g.poses // 200))])
    own = cov[1 :: max(1, g.poses // 200)]
    off = np.abs(every - own).max(axis=(1, 2)) / np.abs(every).max(axis=(1, 2))
    every_of_ours = _by_turns(1, ours=lambda: jax.block_until_ready(graph.marginals(g, solution)))["ours"]
    return {
        "poses": g.poses,
        "loops": g.loops,
        "chi2": float(solution.chi2),
        "chi2_when_timed": {
            method: float(graph.solve(g, start, method=method, tolerance=_TOLERANCE).chi2) for method in methods
        },
        "gtsam_error_at_its_optimum": float(2 * factors.error(best)),
        "seconds": seconds,
        "ratio": {name: seconds[name] / seconds["gtsam"] for name in jobs},
        "marginals_s": every_of_ours,
        "marginals_off": float(off.max()),
    }


def _batch(config: GraphCompareConfig, count: int, times: int) -> dict[str, Any]:
    """Many small graphs from dead reckoning: GTSAM one after the other, this library all at once."""
    keys = jax.random.split(jax.random.key(config.seed), count)
    _, graphs = jax.jit(jax.vmap(simulation.simulate_graph))(keys)
    start = jax.jit(jax.vmap(graph.dead_reckoning))(graphs)
    ones = [jax.tree.map(lambda x, k=k: np.asarray(x[k]), graphs) for k in range(count)]
    factors = [_peers(one) for one in ones]
    values = [_values(one) for one in np.asarray(start)]
    solve = jax.jit(jax.vmap(lambda g, s: graph.solve(g, s, tolerance=_TOLERANCE)))
    solution = solve(graphs, start)
    cov = jax.jit(jax.vmap(lambda g, s: graph.marginals(g, s, frame="body")))

    def gtsam_all() -> list[gtsam.Values]:
        return [gtsam.GaussNewtonOptimizer(f, v).optimize() for f, v in zip(factors, values, strict=True)]

    found = gtsam_all()

    def gtsam_covariances() -> Any:
        for f, best in zip(factors[: max(count // 5, 1)], found, strict=False):
            marginals = gtsam.Marginals(f, best)
            for k in range(1, 100):
                marginals.marginalCovariance(k)

    seconds = _by_turns(
        times,
        gtsam=gtsam_all,
        ours=lambda: jax.block_until_ready(solve(graphs, start)),
        gtsam_marginals=gtsam_covariances,
        marginals=lambda: jax.block_until_ready(cov(graphs, solution)),
    )
    seconds["gtsam_marginals"] *= count / max(count // 5, 1)

    def loss(odometry: jax.Array, g: graph.Graph, s: jax.Array) -> jax.Array:
        return jnp.sum(graph.solve(g._replace(odometry=odometry), s).poses[-1] ** 2)

    value = jax.jit(jax.vmap(lambda g, s: loss(g.odometry, g, s)))
    gradient = jax.jit(jax.vmap(lambda g, s: jax.value_and_grad(loss)(g.odometry, g, s)))
    seconds |= _by_turns(
        times,
        value=lambda: jax.block_until_ready(value(graphs, start)),
        value_and_gradient=lambda: jax.block_until_ready(gradient(graphs, start)),
    )
    return {
        "graphs": count,
        "chi2_mean": float(solution.chi2[:count].mean()),
        "degrees_of_freedom": 30,
        "converged": int(solution.converged[:count].sum()),
        "seconds": seconds,
        "gtsam_over_ours": seconds["gtsam"] / seconds["ours"],
        "gtsam_over_ours_marginals": seconds["gtsam_marginals"] / seconds["marginals"],
        "gradient_over_value": seconds["value_and_gradient"] / seconds["value"],
    }


def with_false_loops(g: graph.Graph, poses: np.ndarray, share: float, seed: int) -> tuple[graph.Graph, np.ndarray]:
    """The graph with loops between random poses that say anything within its size; and which loops are true."""
    rng, count = np.random.default_rng(seed), int(share * g.loops)
    first = rng.integers(0, g.poses - 10, count)
    second = np.minimum(first + 10 + rng.integers(0, g.poses, count) % (g.poses - first - 10), g.poses - 1)
    anywhere = rng.uniform(-1, 1, (count, 3)) * [*np.ptp(poses[:, :2], axis=0) / 2, np.pi]
    usual = np.median(np.asarray(g.loop_information), axis=0)
    more = (np.stack([first, second], axis=-1), anywhere, np.broadcast_to(usual, (count, 3, 3)))
    joined = [jnp.concatenate([a, jnp.asarray(b, a.dtype)]) for a, b in zip(g[2:], more, strict=True)]
    return graph.Graph(g.odometry, g.odometry_information, *joined), np.arange(g.loops + count) < g.loops


def _false_loops(path: Path, seed: int) -> list[dict[str, Any]]:
    """Graduated non-convexity from odometry, both."""
    g = read_graph(path).graph
    clean = np.asarray(graph.solve(g).poses)
    rows = []
    for k in range(_SEEDS):
        spoiled, true = with_false_loops(g, clean, _FALSE, seed + k)
        solution = graph.solve(spoiled, kernel="gnc")
        kept = np.asarray(solution.weights) > 0.5
        factors = _peers(spoiled)
        start = _values(np.asarray(graph.dead_reckoning(spoiled)))
        params = gtsam.GncLMParams()
        params.setKnownInliers(list(range(g.poses)))
        params.setLossType(gtsam.GncLossType.TLS)
        optimizer = gtsam.GncLMOptimizer(factors, start, params)
        optimizer.setInlierCostThresholds(GOOD / 2)
        began = time.perf_counter()
        optimizer.optimize()
        took = time.perf_counter() - began
        seconds = _by_turns(3, ours=lambda g=spoiled: jax.block_until_ready(graph.solve(g, kernel="gnc")))["ours"]
        theirs = np.asarray(optimizer.getWeights())[g.poses :] > 0.5
        off = np.asarray(solution.poses) - clean
        rows.append(
            {
                "seed": seed + k,
                "precision": float((kept & true).sum() / max(kept.sum(), 1)),
                "recall": float((kept & true).sum() / true.sum()),
                "off_m": float(np.hypot(off[:, 0], off[:, 1]).max()),
                "seconds": seconds,
                "gtsam_precision": float((theirs & true).sum() / max(theirs.sum(), 1)),
                "gtsam_recall": float((theirs & true).sum() / true.sum()),
                "gtsam_seconds": took,
            }
        )
    return rows


def _table(report: dict[str, Any]) -> str:
    rows = ["| what | GTSAM | here | ratio |", "|---|---|---|---|"]
    for name in ("m3500", "csail"):
        one = report[name]
        for method, seconds in one["seconds"].items():
            if method != "gtsam":
                rows.append(
                    f"| {name.upper()} to χ² {one['chi2']:.6g}, `{method}` | {1e3 * one['seconds']['gtsam']:.0f} ms "
                    f"| {1e3 * seconds:.1f} ms | {one['ratio'][method]:.2f} |"
                )
    one = report["batch"]
    for what, theirs, ours in (
        ("solved", "gtsam", "ours"),
        ("all covariances", "gtsam_marginals", "marginals"),
    ):
        a, b = one["seconds"][theirs], one["seconds"][ours]
        rows.append(f"| {one['graphs']:,} graphs of 100 poses: {what} | {a:.2f} s | {b:.3f} s | {b / a:.3f} |")
    a, b = (np.mean([row[name] for row in report["false_loops"]]) for name in ("gtsam_seconds", "seconds"))
    good = all(row["precision"] == row["recall"] == 1 for row in report["false_loops"])
    rows.append(
        f"| CSAIL and 20 % false loops, non-convexity graduated{', all told apart' if good else ''} "
        f"| {a:.2f} s | {b:.3f} s | {b / a:.3f} |"
    )
    return "\n".join(rows)


def _show(report: dict[str, Any]) -> None:
    rows = []
    for name in ("m3500", "csail"):
        one = report[name]
        rows.append((f"{name}: {one['poses']} poses, {one['loops']} loops, χ²", f"{one['chi2']:.6g}", ""))
        rows.append(("  GTSAM, Gauss-Newton", f"{1e3 * one['seconds']['gtsam']:.1f} ms", ""))
        for method, ratio in one["ratio"].items():
            rows.append((f"  {method}", f"{1e3 * one['seconds'][method]:.1f} ms: {ratio:.2f} of GTSAM's", ""))
        rows.append(("  all covariances", f"{1e3 * one['marginals_s']:.1f} ms", ""))
        rows.append(("  largest difference from GTSAM's", f"{one['marginals_off']:.1e}", ""))
    one = report["batch"]
    took = one["seconds"]
    rows += [
        (f"{one['graphs']} graphs at once, mean χ²", f"{one['chi2_mean']:.2f}", "30"),
        (
            "  GTSAM, ours",
            f"{1e3 * took['gtsam']:.0f}, {1e3 * took['ours']:.0f} ms: {one['gtsam_over_ours']:.1f} times",
            "",
        ),
        (
            "  all covariances",
            f"{1e3 * took['gtsam_marginals']:.0f}, {1e3 * took['marginals']:.0f} ms: "
            f"{one['gtsam_over_ours_marginals']:.1f} times",
            "",
        ),
        ("  value and gradient over value", f"{one['gradient_over_value']:.2f}", ""),
    ]
    for one in report["false_loops"]:
        rows.append(
            (
                f"CSAIL and 20 % false loops, seed {one['seed']}",
                f"precision {one['precision']:.3f}, recall {one['recall']:.3f}, off {one['off_m']:.1e} m",
                "",
            )
        )
        ratio = one["seconds"] / one["gtsam_seconds"]
        rows.append(
            ("  ours, GTSAM", f"{1e3 * one['seconds']:.0f}, {1e3 * one['gtsam_seconds']:.0f} ms: {ratio:.2f}", "")
        )
    show("pose graphs beside GTSAM", rows)


if __name__ == "__main__":
    command_line(main)
