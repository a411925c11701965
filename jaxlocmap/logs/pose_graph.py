"""Files of pose graphs: g2o, TORO and iSAM in, g2o out."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks, files
from jaxlocmap.graph import Graph
from jaxlocmap.logs.text import lines, numbers, whole
from jaxlocmap.poses import compose
from jaxlocmap.se2 import POSE

_VERTICES = ("VERTEX_SE2", "VERTEX2", "VERTEX")
_POSE = ("x", "y", "theta")
_MOVED = ("dx", "dy", "dtheta")
# Of the six numbers after a relative pose, the entries of the matrix they are.
_G2O = ("I11", "I12", "I13", "I22", "I23", "I33")
_TORO = ("I11", "I12", "I22", "I33", "I13", "I23")
_ISAM = ("R11", "R12", "R13", "R22", "R23", "R33")
_EDGES = {"EDGE_SE2": _G2O, "EDGE2": _TORO, "EDGE": _TORO, "ODOMETRY": _ISAM}
_SAME = 1e-9  # m, rad: two vertices of one id that agree to this are one
_LARGEST = 1e30  # information of a millionth of a nanometre
_SINGULAR = 1e-9  # an eigenvalue of scaled information that is smaller is zero


class GraphFile(NamedTuple):
    """A pose graph as a file has it."""

    graph: Graph  # float64 where JAX has it; poses in order of their ids
    ids: np.ndarray  # (N,) int64, increasing
    poses: np.ndarray | None  # (N, 3) float64 m, m, rad, as the file has them; None where it has none
    fixed: int  # the pose that stays: the one that the file fixes, else the first
    has_fix: bool  # the file fixes one
    odometry_line: np.ndarray  # (N - 1,) int64 of the file; 0 where there is no edge to the next pose
    loop_line: np.ndarray  # (L,) int64
    # `repeated_vertices`, `repeated_edges` (they count twice), `missing_odometry` (between poses of neighbouring ids),
    # `singular_information`, and lines of tags that are not read, by tag.
    counts: dict[str, int]


class _Edge(NamedTuple):
    line: int
    a: int
    b: int
    moved: tuple[float, ...]
    information: np.ndarray


def read_graph(path: str | Path, *, isam: bool = False) -> GraphFile:
    """Read a pose graph in the plane.

    The edge from a pose to that of the next id, or the first of several, is its odometry; all others are loops. What
    the six numbers of an edge are is told by its tag:

        EDGE_SE2 a b dx dy dtheta I11 I12 I13 I22 I23 I33    g2o
        EDGE2    a b dx dy dtheta I11 I12 I22 I33 I13 I23    TORO
        EDGE2, ODOMETRY, with `isam`: R11 R12 R13 R22 R23 R33, the information being Rᵀ R

    Args:
        path: plain or gzipped text.
        isam: EDGE2 is iSAM's, whose tag is TORO's.

    Raises:
        FileNotFoundError: nothing at `path`.
        ValueError: no text, no edge, a line with missing, extra or non-numeric fields, an edge from a pose to itself
            or to one that is not among the vertices, two different poses of one id, information with a negative
            eigenvalue, several fixed poses, or ODOMETRY without `isam`; the message starts with the path and, where
            there is one, the line.

    Source: Kümmerle et al. 2011 (g2o); Grisetti, Stachniss & Burgard 2009 (TORO); Kaess, Ranganathan & Dellaert 2008
    (iSAM).
    """
    with files.reading(path, "a pose graph"):
        return _read(path, isam)


def _read(path: str | Path, isam: bool) -> GraphFile:
    vertices: dict[int, tuple[int, np.ndarray]] = {}
    edges: list[_Edge] = []
    fixed: list[tuple[int, int]] = []
    counts = {"repeated_vertices": 0}
    unread: dict[str, int] = {}
    for number, line in lines(path):
        where = f"{path}:{number}"
        tag, *fields = line.split()
        if tag in _VERTICES:
            id, pose = _vertex(tag, fields, where)
            if id in vertices and not np.allclose(vertices[id][1], pose, rtol=0, atol=_SAME):
                raise ValueError(
                    f"{where}: expected one pose of vertex {id}, got {pose.tolist()} and, in line {vertices[id][0]}, "
                    f"{vertices[id][1].tolist()}"
                )
            counts["repeated_vertices"] += id in vertices
            vertices.setdefault(id, (number, pose))
        elif tag in _EDGES:
            if tag == "ODOMETRY" and not isam:
                raise ValueError(f"{where}: expected g2o or TORO, got ODOMETRY, a tag of iSAM: say that it is iSAM")
            edges.append(_edge(tag, fields, number, where, isam))
        elif tag == "FIX":
            if not fields:
                raise ValueError(f"{where}: expected FIX and the id of a vertex, got no id")
            fixed += [(number, whole("id", field, where, least=0)) for field in fields]
        else:
            unread[f"lines_{tag[:40]}"] = unread.get(f"lines_{tag[:40]}", 0) + 1
    if not edges:
        tags = ", ".join(sorted(unread)[:5]).replace("lines_", "")
        raise ValueError(f"{path}: expected edges (EDGE_SE2 or EDGE2), got none{': ' + tags if tags else ''}")
    ids = np.array(sorted(vertices) if vertices else sorted({end for e in edges for end in (e.a, e.b)}))
    row = {int(id): k for k, id in enumerate(ids)}
    for e in edges:
        for end in (e.a, e.b):
            if end not in row:
                raise ValueError(f"{path}:{e.line}: expected edges between vertices of the file, got vertex {end}")
    if len(fixed) > 1:
        raise ValueError(f"{path}:{fixed[1][0]}: expected one fixed vertex, got {fixed[0][1]} and {fixed[1][1]}")
    for number, id in fixed:
        if id not in row:
            raise ValueError(f"{path}:{number}: expected a vertex of the file to be fixed, got vertex {id}")
    graph, odometry_line, loop_line, repeated = _graph(edges, row)
    counts |= {
        "repeated_edges": repeated,
        "missing_odometry": int(np.sum(odometry_line == 0)),
        "singular_information": sum(_least(e.information) <= 0 for e in edges),
    }
    poses = np.array([vertices[id][1] for id in ids.tolist()]) if vertices else None
    return GraphFile(
        graph, ids, poses, row[fixed[0][1]] if fixed else 0, bool(fixed), odometry_line, loop_line, counts | unread
    )


def _vertex(tag: str, fields: list[str], where: str) -> tuple[int, np.ndarray]:
    if len(fields) != 1 + POSE:
        raise ValueError(f"{where}: expected {tag} id x y theta, got {len(fields)} fields after the tag")
    return whole("id", fields[0], where, least=0), np.array(numbers(fields[1:], _POSE, where))


def _edge(tag: str, fields: list[str], number: int, where: str, isam: bool) -> _Edge:
    names = _ISAM if isam else _EDGES[tag]
    if len(fields) != 2 + POSE + len(names):
        wanted = " ".join([tag, "a", "b", *_MOVED, *names])
        raise ValueError(f"{where}: expected {wanted}, got {len(fields)} fields after the tag")
    a, b = (whole("id", field, where, least=0) for field in fields[:2])
    if a == b:
        raise ValueError(f"{where}: expected an edge between two vertices, got one from {a} to itself")
    moved = numbers(fields[2 : 2 + POSE], _MOVED, where)
    values = numbers(fields[2 + POSE :], names, where, finite=False)
    if not np.max(np.abs(values)) < _LARGEST:
        raise ValueError(f"{where}: expected finite information of a size below {_LARGEST:g}, got {values}")
    matrix = np.zeros((POSE, POSE))
    for name, value in zip(names, values, strict=True):
        matrix[int(name[1]) - 1, int(name[2]) - 1] = value
    information = matrix.T @ matrix if isam else np.triu(matrix) + np.triu(matrix, 1).T
    if _least(information) < 0:
        raise ValueError(
            f"{where}: expected positive semi-definite information, got eigenvalues "
            f"{np.linalg.eigvalsh(information).tolist()}: is it in the order of {tag}, {' '.join(names)}?"
        )
    return _Edge(number, a, b, tuple(moved), information)


def _least(information: np.ndarray) -> float:
    """The least eigenvalue of the matrix scaled to a diagonal of 1 or 0, so that units do not matter; 0 where that is
    rounding.
    """
    variance = np.diagonal(information)
    empty = variance == 0
    if np.any(variance < 0) or np.any(information[empty]):
        return -1.0
    per = 1 / np.sqrt(np.where(empty, np.inf, variance))
    least = float(np.linalg.eigvalsh(per[:, None] * information * per)[0])
    return 0.0 if abs(least) <= _SINGULAR else least


def _graph(edges: list[_Edge], row: dict[int, int]) -> tuple[Graph, np.ndarray, np.ndarray, int]:
    """The graph, the lines of its odometry and of its loops, and how many edges are there twice."""
    n = len(row)
    odometry, information = np.zeros((n - 1, POSE)), np.zeros((n - 1, POSE, POSE))
    odometry_line = np.zeros(n - 1, np.int64)
    loops: list[_Edge] = []
    for e in edges:
        k = row[e.a]
        if row[e.b] == k + 1 and not odometry_line[k]:
            odometry[k], information[k], odometry_line[k] = e.moved, e.information, e.line
        else:
            loops.append(e)
    repeated = len(edges) - len({(e.a, e.b, e.moved, e.information.tobytes()) for e in edges})
    graph = Graph(
        jnp.asarray(odometry),
        jnp.asarray(information),
        jnp.array([(row[e.a], row[e.b]) for e in loops], jnp.int32).reshape(-1, 2),
        jnp.asarray(np.array([e.moved for e in loops]).reshape(-1, POSE)),
        jnp.asarray(np.array([e.information for e in loops]).reshape(-1, POSE, POSE)),
    )
    return graph, odometry_line, np.array([e.line for e in loops], np.int64), repeated


def chained(file: GraphFile) -> np.ndarray:
    """The poses by odometry, (N, 3) float64, from that of the first pose, or the origin."""
    poses = np.zeros((len(file.ids), POSE)) if file.poses is None else file.poses.copy()
    for k, moved in enumerate(np.asarray(file.graph.odometry, np.float64)):
        poses[k + 1] = compose(poses[k], moved)
    return poses


def write_g2o(path: str | Path, graph: Graph, poses: np.ndarray, ids: np.ndarray, *, fixed: int = 0) -> None:
    """Write vertices, the fixed one and edges, each number so that it reads back exactly; packed if the name ends in
    `.gz`.

    Edges without information are left out.

    Args:
        path: of the file to write.
        graph: of N poses.
        poses: (N, 3) m, m, rad.
        ids: (N,) whole numbers, increasing.
        fixed: the pose that is fixed.

    Raises:
        ValueError: a wrong shape, a pose that is not finite, or ids that do not increase.
    """
    poses, ids = np.asarray(poses, np.float64), np.asarray(ids)
    checks.shapes(poses=(poses, (graph.poses, POSE)), ids=(ids, (graph.poses,)))
    if not np.all(np.isfinite(poses)):
        raise ValueError(f"poses: expected finite values, got {np.sum(~np.isfinite(poses))} others")
    if not np.all(np.diff(ids) > 0):
        raise ValueError(f"ids: expected increasing numbers, got {np.sum(np.diff(ids) <= 0)} that do not increase")
    rows = [f"VERTEX_SE2 {id} " + " ".join(map(repr, pose)) for id, pose in zip(ids, poses.tolist(), strict=True)]
    rows.append(f"FIX {ids[fixed]}")
    chain = np.stack([np.arange(graph.poses - 1), np.arange(1, graph.poses)], axis=-1)
    upper = np.triu_indices(POSE)
    for pair, moved, information in (
        (chain, graph.odometry, graph.odometry_information),
        (graph.pair, graph.loop, graph.loop_information),
    ):
        ends, entries = ids[np.asarray(pair)], np.asarray(information, np.float64)
        for (a, b), z, omega in zip(ends, np.asarray(moved, np.float64).tolist(), entries, strict=True):
            if omega.any():
                rows.append(" ".join(["EDGE_SE2", str(a), str(b), *map(repr, [*z, *omega[upper].tolist()])]))
    text = "\n".join(rows) + "\n"
    files.write(path, gzip.compress(text.encode(), mtime=0) if Path(path).suffix == ".gz" else text)
