"""What `slam` writes and says of closed loops."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import graph, plotting
from jaxlocmap.logs import Log, write_csv, write_g2o
from jaxlocmap.poses import compose
from jaxlocmap.replay.loops import KEPT, Loops


def write_loops(out: Path, loops: Loops, log: Log, report: dict[str, Any]) -> list[str]:
    """The graph, the poses with their covariances and the picture; what the report says of them."""
    found, solution = loops.closed, loops.closed.solution
    accepted = found.attempts.pair[found.attempts.accepted]
    weights = np.asarray(solution.weights)[: len(accepted)]
    report["closure"] = {
        "submaps": loops.trail.submaps,
        "tried": len(found.attempts.accepted),
        "accepted": len(accepted),
        "kept": int(np.sum(weights > KEPT)),
        "chi2": float(solution.objective),
        "converged": bool(solution.converged),
        "seconds": loops.seconds,
    }
    anchors = np.asarray(solution.poses, np.float64)
    write_g2o(out / "graph.g2o", found.graph, anchors, np.arange(len(anchors)))
    write_csv(out / "poses.csv", log.scan_time, loops.poses, loops.cov)
    with jax.enable_x64(True):
        begin = np.asarray(graph.dead_reckoning(found.graph, jnp.asarray(anchors[0])))
    trail = loops.trail
    before = compose(begin[np.maximum(trail.submap, 0)], trail.place)
    title = f"{log.name}: {trail.submaps} submaps, {len(accepted)} loops, drawn between the submaps' middles"
    plotting.graph_figure(
        out / "graph.png", loops.poses, loops.cov, trail.middle[accepted], weights, before=before, title=title
    )
    return ["graph.g2o", "poses.csv", "graph.png"]


def loop_rows(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Rows of the table."""
    if "closure" not in report:
        return []
    said = report["closure"]
    return [
        ("submaps", str(said["submaps"]), ""),
        ("loops tried, accepted, kept", f"{said['tried']}, {said['accepted']}, {said['kept']}", ""),
        ("closing loops", f"{said['seconds']:.1f} s", ""),
        *([("false loops kept", str(said["false_kept"]), "0")] if "false_kept" in said else []),
    ]


def loop_doubts(report: Mapping[str, Any]) -> list[str]:
    """What a user should know of the loops before trusting the result."""
    if "closure" not in report:
        return []
    said, doubts = report["closure"], []
    if not said["accepted"]:
        doubts.append("no loop was closed: the poses are those of the filter, and so is their covariance")
    if said["kept"] < 0.9 * said["accepted"]:
        doubts.append(
            f"{said['accepted'] - said['kept']} of {said['accepted']} loops do not fit the others: false ones?"
        )
    if not said["converged"]:
        doubts.append("the graph of the loops did not converge: the poses are the best on the way")
    return doubts
