"""A submap matched on an older one."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap.graph.trail import Trail
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points
from jaxlocmap.matching.scan_match import match, search
from jaxlocmap.poses import between
from jaxlocmap.se2 import POSE, boxminus
from jaxlocmap.types import GridSpec

_STEPS = 10  # of Gauss-Newton, a match
_MANY = (4, 8)  # scans of a submap are filled up to multiples of these, so that few sizes are compiled

Drawn = tuple[np.ndarray, np.ndarray]  # (A,) int32 numbers of scans, -1 for none, and (A, 3) float32 their places


class Registration(NamedTuple):
    """What matching a submap on an older one found."""

    moved: jax.Array  # (3,) m, m, rad: the younger anchor in the frame of the older one, by the scans alone
    cov: jax.Array  # (3, 3) of it: of the match, and of how the scans lie in either submap
    correlation: jax.Array  # () share of the points that lie on lines, each by its weight
    share: jax.Array  # () share of the points that lie on lines
    std: jax.Array  # () m, of the place matched, in its worst direction, from the points alone
    nis: jax.Array  # () squared Mahalanobis distance from what the graph expects
    converged: jax.Array  # () bool


@functools.partial(jax.jit, static_argnames=("spec", "window", "most"))
def register(
    points: Points,
    old: Drawn,
    new: Drawn,
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
        old: the scans drawn in the older submap, and their places in its frame.
        new: those of the younger one that are matched.
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
    placed = jax.vmap(line_grid.placed)(jnp.asarray(new[1]), seen)
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


Placed = tuple[np.ndarray, np.ndarray]  # numbers of scans (n,), where they lie in the submap (n, 3) m, m, rad


class SubmapScans:
    """Which scans are in each submap of a trail, where they lie, and how well that is known."""

    def __init__(self, trail: Trail) -> None:
        n = trail.submaps
        own = [np.flatnonzero(trail.drawn & (trail.submap == k)) for k in range(n)]
        self.matched: list[Placed] = [(scans, trail.place[scans]) for scans in own]  # those matched on the submap
        self.drawn: list[Placed] = []  # these and the ones before them, matched on the submap before
        for k, (scans, places) in enumerate(self.matched):
            early = np.arange(trail.begun[k], scans[0] if len(scans) else trail.begun[k])
            early = early[trail.drawn[early] & (trail.submap[early] == k - 1)]
            if len(early):
                edge = np.broadcast_to(trail.edge[k - 1], (len(early), POSE))
                scans, places = (
                    np.concatenate([early, scans]),
                    np.concatenate([between(edge, trail.place[early]), places]),
                )
            self.drawn.append((scans, places))
        none = np.zeros((1, POSE)), np.zeros((1, POSE, POSE))
        # (N, 3, 3) covariance of a scan's place: an average over those of the submap.
        self.spread: np.ndarray = np.stack(
            [(trail.place_cov[scans] if len(scans) else none[1]).mean(axis=0) for scans in own]
        )
        self.middle: np.ndarray = np.stack(
            [(trail.place[scans] if len(scans) else none[0]).mean(axis=0) for scans in own]
        )
        self._most = [
            -(-max(len(scans) for scans, _ in part) // many) * many
            for part, many in zip((self.matched, self.drawn), _MANY, strict=True)
        ]

    def query(self, k: int) -> Drawn:
        """The scans of submap k that are to be matched on another."""
        scans, places = self.matched[k]
        return _filled(scans, places, self._most[0])

    def map(self, k: int) -> Drawn:
        """All scans drawn in submap k."""
        scans, places = self.drawn[k]
        return _filled(scans, places, self._most[1])


def _filled(scans: np.ndarray, places: np.ndarray, size: int) -> Drawn:
    fill = size - len(scans)
    return (
        np.concatenate([scans, np.full(fill, -1)]).astype(np.int32),
        np.concatenate([places, np.zeros((fill, POSE))]).astype(np.float32),
    )
