"""Loop closure: finished submaps recognised in older ones, and the graph that they make.

A new submap's scans, laid out as the filter believes they were taken, are matched as one on the map of an older submap,
which is drawn again from its scans. Where to look, and how far, is what the graph itself says of their relative pose.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap.filters import ekf
from jaxlocmap.graph import methods
from jaxlocmap.graph.covariance import marginals, relative_covariances
from jaxlocmap.graph.factors import Graph, dead_reckoning
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.registration import Registration, SubmapScans, register
from jaxlocmap.graph.solver import Solution, solve
from jaxlocmap.graph.trail import Trail
from jaxlocmap.matching.normals import Points
from jaxlocmap.poses import between, compose, wrapped
from jaxlocmap.se2 import POSE
from jaxlocmap.types import GridSpec

_LEVELS = 4  # windows to choose from, each half as wide as the one before
_ROUND = 64  # the loops of a graph are filled up to a multiple, so that few sizes are compiled


@dataclasses.dataclass(frozen=True)
class Closure:
    """How loops are looked for and which are believed. Frozen and hashable, so static under jit.

    Raises:
        ValueError: a field outside the range given beside it.
        TypeError: a field that is no number.
    """

    candidates: int = 6  # older submaps that a new one is matched on at most, the nearest; >= 1
    apart: int = 3  # submaps, >= 2, between the two of a loop and one more: neighbours share scans
    reach: float = 4.0  # m, > 0: between the middles of two submaps, and three standard deviations more
    window: tuple[float, float] = (1.5, 0.3)  # m, rad, > 0: how far to search at most
    least_correlation: float = 0.5  # in (0, 1): of the points, each by its weight
    least_share: float = 0.7  # in (0, 1): of the points on lines of the older submap
    most_std: float = 0.03  # m, > 0: of the place matched, in its worst direction
    gate_probability: float = 0.999  # in (0, 1): share of good loops let in
    scale: float = 1.0  # > 0: standard deviations of loops are this times what matches and filter say
    points: int = 1200  # of a submap that are matched at most, about; >= 10

    def __post_init__(self) -> None:
        for name, least in (("candidates", 1), ("apart", 2), ("points", 10)):
            value = getattr(self, name)
            checks.number(name, value)
            if int(value) != value or value < least:
                raise ValueError(f"Closure.{name}: expected a whole number of at least {least}, got {value}")
        for name in ("least_correlation", "least_share", "gate_probability"):
            checks.number(name, getattr(self, name))
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"Closure.{name}: expected a value inside (0, 1), got {getattr(self, name)}")
        for name in ("reach", "most_std", "scale"):
            checks.number(name, getattr(self, name))
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Closure.{name}: expected a finite number > 0, got {getattr(self, name)}")
        if len(self.window) != 2 or not all(0 < x < math.inf for x in self.window):
            raise ValueError(f"Closure.window: expected two finite numbers > 0, m and rad, got {self.window}")


class Attempts(NamedTuple):
    """All loops that were looked for, K of them. NumPy."""

    pair: np.ndarray  # (K, 2) int: the older and the younger submap
    found: Registration  # arrays (K, ...)
    accepted: np.ndarray  # (K,) bool


class Closed(NamedTuple):
    """A trail whose loops are closed."""

    graph: Graph  # its loops are the attempts that were accepted, in their order, and some without information
    solution: Solution
    attempts: Attempts
    online: np.ndarray  # (N, 3) m, m, rad: each anchor as it was known when its submap was finished


def believed(found: Registration, closure: Closure) -> np.ndarray:
    """Which registrations are taken for loops, () or (K,) bool."""
    return (
        np.asarray(found.converged)
        & (np.asarray(found.correlation) >= closure.least_correlation)
        & (np.asarray(found.share) >= closure.least_share)
        & (np.asarray(found.std) <= closure.most_std)
        & (np.asarray(found.nis) < float(ekf.gate_threshold(closure.gate_probability, POSE)))
    )


def close_loops(
    trail: Trail,
    points: Points,
    std: float | jax.Array,
    scale: float | jax.Array,
    *,
    spec: GridSpec,
    closure: Closure,
    first: np.ndarray | None = None,
    kernel: Kernel | str = "gnc",
    progress: Callable[[int], None] = lambda done: None,
) -> Closed:
    """Look for loops submap by submap in the order of time, each with the graph of all loops before it; then solve the
    whole graph.

    Args:
        trail: of a filter, N submaps, S scans.
        points: of its scans, (S, B, ...).
        std, scale: m, as of `scan_match.match`.
        spec: of a submap's map, static.
        closure: how.
        first: (3,) m, m, rad, of the first anchor; the origin by default.
        kernel: of the loops at the end; on the way they count in full, as the gate let them in.
        progress: told how many submaps are done.

    Source: Hess, Kohler, Rapp & Andor 2016 (submaps); Olson 2009 (correlative matching); Neira & Tardós 2001 (gates by
    joint covariances).

    Raises:
        ValueError: a trail without submaps.
    """
    n = trail.submaps
    if not n:
        raise ValueError("trail: expected at least one submap, got none: no scan had points enough")
    scans, growing = SubmapScans(trail), _Growing(trail, closure)
    begin = jnp.zeros(POSE) if first is None else jnp.asarray(first)
    dtype = points.xy.dtype
    pairs: list[tuple[int, int]] = []
    found: list[Registration] = []
    accepted: list[bool] = []
    online = np.zeros((n, POSE))
    whole = growing.graph(growing.most)
    method = methods.resolve(None, whole)
    solution = solve(whole, dead_reckoning(whole, begin), method=method)
    for j in range(n):
        poses = np.asarray(solution.poses, np.float64)
        online[j] = poses[j]
        before = growing.count
        old = np.arange(max(j - closure.apart + 1, 0))
        if len(old):
            # Of all submaps, so that one program serves.
            every = np.stack([np.arange(n), np.full(n, j)], axis=-1).astype(np.int32)
            covs = relative_covariances(whole, solution, jnp.asarray(every), method=method)
            apart = np.asarray(covs, np.float64)[old]
            means = between(poses[old], poses[j])
            for i in _nearest(scans, means, apart, j, closure):
                spread = closure.scale**2 * (scans.spread[i] + scans.spread[j])
                result = register(
                    points,
                    scans.map(i),
                    scans.query(j),
                    *(np.asarray(x, dtype) for x in (means[i], apart[i], spread, std, scale)),
                    spec=spec,
                    window=_window(apart[i] + spread, closure),
                    most=closure.points,
                )
                result = jax.tree.map(np.asarray, result)
                pairs.append((i, j))
                found.append(result)
                accepted.append(bool(believed(result, closure)))
                if accepted[-1]:
                    growing.add(i, j, result)
        if growing.count > before:
            whole = growing.graph(growing.most)
            solution = solve(whole, solution.poses, method=method)
        progress(j + 1)
    final = growing.graph(min(-(-growing.count // _ROUND) * _ROUND, growing.most))
    return Closed(
        final,
        solve(final, dead_reckoning(final, begin), kernel=kernel),
        Attempts(np.array(pairs, int).reshape(-1, 2), _stacked(found), np.array(accepted, bool)),
        online,
    )


class _Growing:
    """The graph of a trail, with room for loops."""

    def __init__(self, trail: Trail, closure: Closure) -> None:
        self.most = max(trail.submaps * closure.candidates, 1)
        self.count = 0
        self._odometry = trail.edge, np.linalg.inv(trail.edge_cov)
        self._pair = np.tile(np.array([[0, 1]], np.int32), (self.most, 1))
        self._loop, self._information = np.zeros((self.most, POSE)), np.zeros((self.most, POSE, POSE))

    def add(self, i: int, j: int, found: Registration) -> None:
        """One more loop."""
        self._pair[self.count], self._loop[self.count] = (i, j), found.moved
        self._information[self.count] = np.linalg.inv(np.asarray(found.cov, np.float64))
        self.count += 1

    def graph(self, loops: int) -> Graph:
        """With that many loops, filled up with some that say nothing."""
        if len(self._odometry[0]) == 0:
            loops = 0  # there is no other pose
        arrays = (*self._odometry, self._pair[:loops], self._loop[:loops], self._information[:loops])
        return Graph(*map(jnp.asarray, arrays))


def _stacked(found: list[Registration]) -> Registration:
    like = Registration._make([np.zeros(POSE), np.zeros((POSE, POSE)), *np.zeros(5)])
    return jax.tree.map(lambda one, *each: np.array(each).reshape(len(each), *np.shape(one)), like, *found)


def _nearest(scans: SubmapScans, means: np.ndarray, covs: np.ndarray, j: int, closure: Closure) -> list[int]:
    """The submaps whose middles may lie within reach of that of submap j."""
    distance = np.hypot(*(compose(means, scans.middle[j]) - scans.middle[: len(means)])[:, :2].T)
    slack = 3 * np.sqrt(np.linalg.eigvalsh(covs[:, :2, :2])[:, -1])
    order = np.argsort(distance - slack)
    return [int(i) for i in order[: closure.candidates] if distance[i] - slack[i] < closure.reach]


def _window(cov: np.ndarray, closure: Closure) -> tuple[float, float]:
    """The least of a few windows that holds three standard deviations, or the widest; each is compiled once."""
    sigma = np.sqrt(np.diagonal(cov))
    for level in reversed(range(1, _LEVELS)):
        across, turn = (w / 2**level for w in closure.window)
        if 3 * max(sigma[:2]) <= across and 3 * sigma[2] <= turn:
            return across, turn
    return closure.window


def scan_poses(trail: Trail, closed: Closed) -> tuple[np.ndarray, np.ndarray]:
    """Where every scan of a trail was taken, (S, 3), and the covariance of x, y and theta given the first anchor,
    (S, 3, 3): that of the submap's anchor, and of the scan in it. NaN for scans before the first submap.
    """
    anchors = np.asarray(closed.solution.poses, np.float64)
    cov = np.asarray(marginals(closed.graph, closed.solution), np.float64)
    k = np.maximum(trail.submap, 0)
    poses = compose(anchors[k], trail.place)
    by_anchor, by_place = np.zeros((2, len(k), POSE, POSE))
    by_anchor[:] = np.eye(POSE)
    by_anchor[:, 0, 2], by_anchor[:, 1, 2] = anchors[k, 1] - poses[:, 1], poses[:, 0] - anchors[k, 0]
    cos, sin = np.cos(anchors[k, 2]), np.sin(anchors[k, 2])
    by_place[:, 0, 0], by_place[:, 0, 1], by_place[:, 1, 0], by_place[:, 1, 1] = cos, -sin, sin, cos
    by_place[:, 2, 2] = 1
    of_anchor = np.einsum("sij,sjk,slk->sil", by_anchor, cov[k], by_anchor)
    total = of_anchor + np.einsum("sij,sjk,slk->sil", by_place, trail.place_cov, by_place)
    poses[:, 2] = wrapped(poses[:, 2])
    poses[trail.submap < 0], total[trail.submap < 0] = np.nan, np.nan
    return poses, total
