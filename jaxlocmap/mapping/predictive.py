"""How well a map predicts the next scan: what tells a good inverse sensor model from a bad one without a true map.

Before a scan goes into the map, the map says of every cell a beam crosses or ends in how likely it is occupied; the
beam then says whether it was.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.batching import scan
from jaxlocmap.mapping import grid
from jaxlocmap.mapping.rays import flat_cells, longest_crossing, trace
from jaxlocmap.se2 import POSE
from jaxlocmap.types import GridSpec, Scanner

BINS = 10  # of probability


class PredictiveScore(NamedTuple):
    """Sums over the cells of beams; a cell that several beams cross counts as often."""

    log_loss: jax.Array  # () nats
    cells: jax.Array  # ()
    bin_cells: jax.Array  # (BINS,) cells by the probability the map gave them
    bin_probability: jax.Array  # (BINS,) sum of those probabilities
    bin_hits: jax.Array  # (BINS,) how many of those cells a beam ended in


def scan_log_loss(
    log_odds: jax.Array, pose: jax.Array, ranges: jax.Array, *, scanner: Scanner, spec: GridSpec
) -> tuple[jax.Array, jax.Array]:
    """Log-loss of a scan under the map before it.

        Σ_beams [ Σ_crossed -log(1 - p) - log p_end ],   p = 1 / (1 + exp(-L))

    Args:
        log_odds: (rows, columns) nats; values outside the bounds of `spec` count as at them.
        pose: (3,) m, m, rad, of the robot.
        ranges: (B,) m.
        scanner: with B beams.
        spec: static.

    Returns:
        () nats, and the number of cells, (). A cell never seen costs log 2. Source: Good 1952 (the score).

    Raises:
        ValueError: a wrong shape.
    """
    return _log_loss(*_before(log_odds, pose, ranges, scanner, spec))


def _log_loss(ends: _Cells, crossed: _Cells) -> tuple[jax.Array, jax.Array]:
    loss = jnp.sum(jnp.where(ends.seen, jax.nn.softplus(-ends.log_odds), 0))
    loss = loss + jnp.sum(jnp.where(crossed.seen, jax.nn.softplus(crossed.log_odds), 0))
    return loss, (jnp.sum(ends.seen) + jnp.sum(crossed.seen)).astype(loss.dtype)


def predict_scans(
    l_occ: jax.Array,
    l_free: jax.Array,
    poses: jax.Array,
    ranges: jax.Array,
    counted: jax.Array,
    *,
    scanner: Scanner,
    spec: GridSpec,
    bins: bool = False,
) -> PredictiveScore:
    """Map scan after scan into an empty map, each predicted by the map before it.

    Args:
        l_occ: () nats, > 0.
        l_free: () nats, < 0.
        poses: (T, 3) m, m, rad, of the robot.
        ranges: (T, B) m.
        counted: (T,) bool, the scans that are scored; all are mapped.
        scanner: with B beams.
        spec: static.
        bins: fill the bins too, which takes longer; zero otherwise.

    Returns:
        `PredictiveScore` of this drive. Its derivative by `l_occ` and `l_free` is exact (zero where a cell sits at a
        bound of `spec`); by the poses it is zero.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("poses", poses, (None, POSE))
    checks.shape("ranges", ranges, (len(poses), len(scanner.beam_angles)))
    checks.shape("counted", counted, (len(poses),))
    dtype = jnp.result_type(l_occ)
    poses, ranges, scanner = jax.tree.map(lambda x: jnp.asarray(x, dtype), (poses, ranges, scanner))

    def body(
        carry: tuple[jax.Array, PredictiveScore], now: tuple[jax.Array, ...]
    ) -> tuple[tuple[jax.Array, PredictiveScore], None]:
        (log_odds, total), (pose, ranges, counts) = carry, now
        ends, crossed = _before(log_odds, pose, ranges, scanner, spec)
        loss, cells = _log_loss(ends, crossed)
        binned = (total.bin_cells, total.bin_probability, total.bin_hits)
        if bins:
            more = _binned(ends, crossed)
            binned = tuple(a + jnp.where(counts, b, 0) for a, b in zip(binned, more, strict=True))
        total = PredictiveScore(
            total.log_loss + jnp.where(counts, loss, 0), total.cells + jnp.where(counts, cells, 0), *binned
        )
        return (grid.add_scan(log_odds, pose, ranges, l_occ, l_free, scanner=scanner, spec=spec), total), None

    zero, none = jnp.zeros((), dtype), jnp.zeros(BINS, dtype)
    start = (jnp.zeros(spec.shape, dtype), PredictiveScore(zero, zero, none, none, none))
    return scan(body, start, (poses, ranges, counted))[0][1]


class _Cells(NamedTuple):
    log_odds: jax.Array  # within the bounds
    seen: jax.Array  # bool: there is such a cell, and it lies on the map


def _before(
    log_odds: jax.Array, pose: jax.Array, ranges: jax.Array, scanner: Scanner, spec: GridSpec
) -> tuple[_Cells, _Cells]:
    """What the map says of the cells that beams end in (B,) and cross (B, K)."""
    checks.shape("log_odds", log_odds, spec.shape)
    rays = trace(pose, ranges, scanner, spec=spec)
    j = jnp.arange(longest_crossing(spec, scanner.max_range), dtype=jnp.int32)[None]

    def said(cells: jax.Array, seen: jax.Array) -> _Cells:
        there = jnp.where(seen, cells, 0)
        return _Cells(jnp.clip(log_odds.ravel()[there], spec.l_min, spec.l_max), seen)

    ends = said(flat_cells(rays, rays.last[:, None], spec)[:, 0], rays.last >= 0)
    return ends, said(flat_cells(rays, j, spec), j < rays.free[:, None])


def _binned(ends: _Cells, crossed: _Cells) -> tuple[jax.Array, jax.Array, jax.Array]:
    values = jnp.concatenate([ends.log_odds, crossed.log_odds.ravel()])
    seen = jnp.concatenate([ends.seen, crossed.seen.ravel()]).astype(values.dtype)
    hits = jnp.where(jnp.arange(len(values)) < len(ends.seen), seen, 0)
    p = grid.probability(values)
    rows = jnp.clip((p * BINS).astype(jnp.int32), 0, BINS - 1)
    sums = [jnp.zeros(BINS, p.dtype).at[rows].add(x) for x in (seen, seen * p, hits)]
    return sums[0], sums[1], sums[2]
