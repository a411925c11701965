"""Loop closure: finished submaps recognised in older ones, and the graph that they make.

A new submap's scans, laid out as the filter believes they were taken, are matched as one on the map of an older submap,
which is drawn again from its scans. Where to look, and how far, is what the graph itself says of their relative pose.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap.filters import ekf
from jaxlocmap.graph import methods
from jaxlocmap.graph.covariance import relative_covariances
from jaxlocmap.graph.factors import Graph
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.solver import Solution, solve
from jaxlocmap.graph.trail import Trail
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points
from jaxlocmap.matching.scan_match import match, search
from jaxlocmap.poses import between
from jaxlocmap.se2 import POSE, boxminus
from jaxlocmap.types import GridSpec

_STEPS = 10  # of Gauss-Newton, a match
_ROUND = 64  # loops
_LEVELS = 4  # windows to choose from, each half as wide as the one before


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
        for name in ("reach", "most_std"):
            checks.number(name, getattr(self, name))
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Closure.{name}: expected finite metres > 0, got {getattr(self, name)}")
        if len(self.window) != 2 or not all(0 < x < math.inf for x in self.window):
            raise ValueError(f"Closure.window: expected two finite numbers > 0, m and rad, got {self.window}")


class Registration(NamedTuple):
    """What matching a submap on an older one found."""

    moved: jax.Array  # (3,) m, m, rad: the younger anchor in the frame of the older one, by the scans alone
    cov: jax.Array  # (3, 3) of it: of the match, and of how the scans lie in either submap
    correlation: jax.Array  # () share of the points that lie on lines, each by its weight
    share: jax.Array  # () share of the points that lie on lines
    std: jax.Array  # () m, of the place matched, in its worst direction, from the points alone
    nis: jax.Array  # () squared Mahalanobis distance from what the graph expects
    converged: jax.Array  # () bool


class Attempts(NamedTuple):
    """All loops that were looked for, K of them. NumPy."""

    pair: np.ndarray  # (K, 2) int: the older and the younger submap
    found: Registration  # arrays (K, ...)
    accepted: np.ndarray  # (K,) bool


class Closed(NamedTuple):
    """A trail whose loops are closed."""

    graph: Graph  # its loops are the attempts that were accepted
    solution: Solution
    attempts: Attempts
    online: np.ndarray  # (N, 3) m, m, rad: each anchor as it was known when its submap was finished


@functools.partial(jax.jit, static_argnames=("spec", "window", "most"))
def register(
    points: Points,
    old: tuple[jax.Array, jax.Array],
    new: tuple[jax.Array, jax.Array],
    mean: jax.Array,
    cov: jax.Array,
    spread: jax.Array,
    std: jax.Array,
    scale: jax.Array,
    *,
    spec: GridSpec,
    window: tuple[float, float],
    most: int,
) -> Registration:
    """Match the scans of a submap on the map of an older one.

    Args:
        points: of all S scans, (S, B, ...).
        old: (A,) int32 scans of the older submap, -1 for none, and (A, 3) their places in its frame.
        new: (C,) and (C, 3) those of the younger one.
        mean: (3,) m, m, rad: the younger anchor in the frame of the older one, as the graph has it.
        cov: (3, 3) its covariance.
        spread: (3, 3) covariance of how scans lie in the two submaps, added to that of the match.
        std, scale: () m, as of `scan_match.match`.
        spec: of the older map, static.
        window: m, rad: how far to search, static.
        most: points of the younger submap that are matched, about, static.
    """
    lines = jnp.zeros((*spec.shape, line_grid.SUMS), mean.dtype)

    def drawn(k: jax.Array, lines: jax.Array) -> jax.Array:
        scan = jax.tree.map(lambda x: x[jnp.maximum(old[0][k], 0)], points)
        return line_grid.add_points(lines, old[1][k], scan, spec=spec, counts=old[0][k] >= 0)

    lines = jax.lax.fori_loop(0, len(old[0]), drawn, lines)
    every = max(1, len(new[0]) * points.xy.shape[1] // most)
    seen = jax.tree.map(lambda x: x[jnp.maximum(new[0], 0), ::every], points)
    seen = seen._replace(valid=seen.valid & (new[0] >= 0)[:, None])
    placed = jax.vmap(line_grid.placed)(new[1], seen)
    query = Points(
        jnp.stack([placed.x.ravel(), placed.y.ravel()], axis=-1),
        jnp.stack([placed.normal_x.ravel(), placed.normal_y.ravel()], axis=-1),
        placed.valid.ravel(),
    )
    start = search(lines, mean, cov + spread, query, scale, spec=spec, window=window)
    found = match(lines, mean, cov + spread, query, std, scale, spec=spec, steps=_STEPS, start=start)
    fit = line_grid.fit(lines, found.pose, query, scale, spec=spec)
    count = jnp.maximum(found.points, 1).astype(mean.dtype)
    # Away from what the graph expects again, to where the scans alone would have it.
    information = found.information + jnp.diag(jnp.full(POSE, 1.0, mean.dtype))
    alone = found.pose + jnp.linalg.solve(information, found.score)
    of_match = jnp.linalg.inv(information)
    total = of_match + spread
    off = boxminus(alone, mean)
    return Registration(
        moved=alone,
        cov=(total + total.T) / 2,
        correlation=jnp.sum(fit.weight) / count,
        share=found.used.astype(mean.dtype) / count,
        std=jnp.sqrt(jnp.linalg.eigvalsh(of_match[:2, :2])[-1]),
        nis=off @ jnp.linalg.solve(total + cov, off),
        converged=found.converged,
    )


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
        kernel: of the loops at the end; on the way they count in full, as the gate let them in.
        progress: told how many submaps are done.

    Source: Hess, Kohler, Rapp & Andor 2016 (submaps); Olson 2009 (correlative matching); Neira & Tardós 2001 (gates by
    joint covariances).
    """
    n = trail.submaps
    scans = _Scans(trail)
    capacity = max(n * closure.candidates, 1)
    pair = np.tile(np.array([[0, 1]], np.int32), (capacity, 1))
    loop, information = np.zeros((capacity, POSE)), np.zeros((capacity, POSE, POSE))
    odometry, odometry_information = jnp.asarray(trail.edge), jnp.asarray(np.linalg.inv(trail.edge_cov))
    dtype = points.xy.dtype
    attempts: list[tuple[int, int]] = []
    found: list[Registration] = []
    accepted: list[bool] = []
    online = np.zeros((n, POSE))
    count, changed, solution = 0, True, None

    def graph(size: int) -> Graph:
        return Graph(
            odometry,
            odometry_information,
            jnp.asarray(pair[:size], jnp.int32),
            jnp.asarray(loop[:size]),
            jnp.asarray(information[:size]),
        )

    whole = graph(capacity)
    method = methods.resolve(None, whole)
    for j in range(n):
        if n < 2:
            break
        if changed or solution is None:
            solution = solve(whole, None if solution is None else solution.poses, method=method)
            changed = False
        poses = np.asarray(solution.poses)
        online[j] = poses[j]
        old = np.arange(max(j - closure.apart + 1, 0))
        if len(old):
            every = np.stack([np.arange(n), np.full(n, j)], axis=-1).astype(np.int32)
            apart = np.asarray(relative_covariances(whole, solution, jnp.asarray(every), method=method))[old]
            means = between(poses[old], poses[j])
            for i in _nearest(scans, means, apart, j, closure):
                spread = scans.spread[i] + scans.spread[j]
                result = register(
                    points,
                    scans.old(i),
                    scans.new(j),
                    *(np.asarray(x, dtype) for x in (means[i], apart[i], spread, std, scale)),
                    spec=spec,
                    window=_window(apart[i] + spread, closure),
                    most=closure.points,
                )
                result = Registration(*(np.asarray(x) for x in result))
                good = bool(believed(result, closure))
                attempts.append((i, j))
                found.append(result)
                accepted.append(good)
                if good:
                    pair[count], loop[count] = (i, j), result.moved
                    information[count] = np.linalg.inv(np.asarray(result.cov, np.float64))
                    count, changed = count + 1, True
            if changed:
                whole = graph(capacity)
        progress(j + 1)
    final = graph(min(_rounded(count, _ROUND), capacity)) if count else graph(0)
    tried = (
        Registration(*(np.stack([getattr(f, name) for f in found]) for name in Registration._fields)) if found else None
    )
    return Closed(
        final,
        solve(final, jnp.asarray(online) if n < 2 else None, kernel=kernel),
        Attempts(np.array(attempts, int).reshape(-1, 2), tried, np.array(accepted, bool)),  # type: ignore[arg-type]
        online,
    )


class _Scans:
    """Which scans are drawn in each submap, and where."""

    def __init__(self, trail: Trail) -> None:
        n = trail.submaps
        self._new: list[np.ndarray] = [np.flatnonzero(trail.drawn & (trail.submap == k)) for k in range(n)]
        self._early: list[np.ndarray] = []
        for k in range(n):
            first = np.arange(trail.begun[k], self._new[k][0] if len(self._new[k]) else trail.begun[k])
            self._early.append(first[trail.drawn[first] & (trail.submap[first] == k - 1)] if k else first[:0])
        self._trail = trail
        self._most_new = _rounded(max(len(x) for x in self._new), 4)
        self._most_old = _rounded(max(len(a) + len(b) for a, b in zip(self._new, self._early, strict=True)), 8)
        self.spread = np.stack(
            [trail.place_cov[x].mean(axis=0) if len(x) else np.zeros((POSE, POSE)) for x in self._new]
        )
        self.middle = np.stack([trail.place[x].mean(axis=0) if len(x) else np.zeros(POSE) for x in self._new])

    def new(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Scans that were matched on submap k, and their places in its frame, filled up."""
        return _filled(self._new[k], self._trail.place[self._new[k]], self._most_new)

    def old(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """All scans drawn in submap k, and their places in its frame, filled up."""
        early = self._early[k]
        places = self._trail.place[self._new[k]]
        if len(early):
            edge = np.broadcast_to(self._trail.edge[k - 1], (len(early), POSE))
            places = np.concatenate([between(edge, self._trail.place[early]), places])
        return _filled(np.concatenate([early, self._new[k]]), places, self._most_old)


def _rounded(size: int, to: int) -> int:
    """The next multiple: runs that differ a little share what was compiled for one."""
    return -(-size // to) * to


def _filled(index: np.ndarray, places: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    fill = size - len(index)
    return (
        np.concatenate([index, np.full(fill, -1)]).astype(np.int32),
        np.concatenate([places, np.zeros((fill, POSE))]).astype(np.float32),
    )


def _window(cov: np.ndarray, closure: Closure) -> tuple[float, float]:
    """The least of a few windows that holds three standard deviations, or the widest; each is compiled once."""
    sigma = np.sqrt(np.diagonal(cov))
    for level in reversed(range(1, _LEVELS)):
        across, turn = (w / 2**level for w in closure.window)
        if 3 * max(sigma[:2]) <= across and 3 * sigma[2] <= turn:
            return across, turn
    return closure.window


def _nearest(scans: _Scans, means: np.ndarray, covs: np.ndarray, j: int, closure: Closure) -> list[int]:
    """The submaps whose middles may lie within reach of that of submap j."""
    cos, sin = np.cos(means[:, 2]), np.sin(means[:, 2])
    x, y, _ = scans.middle[j]
    away = np.stack([means[:, 0] + cos * x - sin * y, means[:, 1] + sin * x + cos * y], axis=-1)
    distance = np.hypot(*(away - scans.middle[: len(means), :2]).T)
    slack = 3 * np.sqrt(np.linalg.eigvalsh(covs[:, :2, :2])[:, -1])
    order = np.argsort(distance - slack)
    return [int(i) for i in order[: closure.candidates] if distance[i] - slack[i] < closure.reach]
