"""Readers of robot logs, one a format, all returning one `Log`, and the steps made of it.

| format | log | owner |
|---|---|---|
| `woods` | "Lost in the woods", MATLAB file | T. D. Barfoot, University of Toronto |
| `mrclam` | UTIAS Multi-Robot Cooperative Localization and Mapping | Leung, Halpern, Barfoot & Liu, IJRR 2011 |
| `carmen` | laser scans with poses or odometry (FLASER, ROBOTLASER1, RAWLASER1) | D. Hähnel (Intel), MIT (CSAIL) |

- A pause of the odometry longer than `max_gap` stops the robot: the last command holds for the log's usual period, then
  the robot stands while its covariance grows by `Q`. Truth is not interpolated over longer gaps.
- A range at or beyond the largest that counts, or no return (inf), clears up to there and marks nothing; no other limit
  applies but the scanner's own, where the log states it.
- Beams point where the log says (ROBOTLASER1, RAWLASER1, PARAM lines) or `fov` does; else 180° are assumed, which
  `Log.beam_angles_from` says.
- What is dropped or mended is counted in `Log.counts`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxlocmap.logs.carmen import read_carmen
from jaxlocmap.logs.mrclam import read_mrclam
from jaxlocmap.logs.pose_graph import GraphFile, chained, read_graph, write_g2o
from jaxlocmap.logs.record import Log
from jaxlocmap.logs.relations import RelationErrors, Relations, read_relations, relation_errors, revisits
from jaxlocmap.logs.timeline import MAX_GAP, Timeline, to_timeline
from jaxlocmap.logs.trajectory import Pairs, Trajectory, pair, read_innovations, read_trajectory, write_csv
from jaxlocmap.logs.tum import write_tum
from jaxlocmap.logs.woods import read_woods

__all__ = [
    "FORMATS",
    "MAX_GAP",
    "GraphFile",
    "Log",
    "Pairs",
    "RelationErrors",
    "Relations",
    "Timeline",
    "Trajectory",
    "chained",
    "pair",
    "read",
    "read_carmen",
    "read_graph",
    "read_innovations",
    "read_mrclam",
    "read_relations",
    "read_trajectory",
    "read_woods",
    "relation_errors",
    "revisits",
    "to_timeline",
    "write_csv",
    "write_g2o",
    "write_tum",
]

FORMATS = ("woods", "mrclam", "carmen")


def read(path: str | Path, format: str, robot: int | None = None, **scanner: Any) -> Log:
    """Read a log of a named format.

    Args:
        path: a file for `woods` and `carmen`, a folder for `mrclam`.
        format: one of `FORMATS`.
        robot: its number, for `mrclam` only.
        **scanner: keywords of `read_carmen`, for `carmen` only.

    Raises:
        ValueError: an unknown format, `robot` missing for mrclam or given for another, `scanner` for another
            than carmen; and as the readers raise.
        FileNotFoundError: as the readers raise.
    """
    if format not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, got {format!r}")
    if (robot is None) == (format == "mrclam"):
        wanted = "a robot's number" if format == "mrclam" else "None: only mrclam has several"
        raise ValueError(f"robot: expected {wanted} for format {format}, got {robot}")
    if scanner and format != "carmen":
        raise ValueError(f"{', '.join(scanner)}: expected nothing: format {format} has no laser scanner")
    if robot is not None:
        return read_mrclam(path, robot)
    return read_woods(path) if format == "woods" else read_carmen(path, **scanner)
