"""Occupancy grid: which cells a beam crosses, the log-odds update, and how good a map is.

Log-odds are in nats; cell [row, column] covers origin + resolution * ([column, row] .. [column + 1, row + 1]).
A cell index is a floor, so a map has no derivative by the pose (it is zero); by `l_occ` and `l_free` it is exact.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap.batching import any_in_batch, zero_like_any
from jaxlocmap.types import GridSpec

# Up to here, cells looked at times cells spanned, a float32 product places every cell of a beam exactly; beyond it
# takes an integer division.
_FLOAT_EXACT_CELLS = 1024 * 1024


class Beams(NamedTuple):
    """The cells of one scan: B beams of at most K cells, nearest first."""

    row: jax.Array  # (B, K) int32
    column: jax.Array  # (B, K) int32
    free: jax.Array  # (B, K) bool: the beam crosses this cell, and it lies on the map
    hit: jax.Array  # (B, K) bool: the beam ends in this cell, and it lies on the map


def cell_of(point: jax.Array, spec: GridSpec) -> jax.Array:
    """Column and row of a point: floor((p - origin) / resolution).

    Args:
        point: (..., 2) x, y in m.

    Returns:
        (..., 2) int32 column, row; may lie outside the map.
    """
    # Far and non-finite points go to a cell just as far outside, instead of wherever an integer wraps to.
    origin = jnp.broadcast_to(jnp.array(spec.origin, point.dtype), point.shape)
    cells = jnp.floor((point - origin) / spec.resolution)
    return jnp.clip(jnp.nan_to_num(cells, nan=-1e6), -1e6, 1e6).astype(jnp.int32)


def beam_cells(
    pose: jax.Array,
    ranges: jax.Array,
    beam_angles: jax.Array,
    *,
    spec: GridSpec,
    min_range: float,
    max_range: float,
) -> Beams:
    """The cells every beam of a scan crosses and ends in (Bresenham 1965), all beams at once.

    Cell j of a beam that spans n cells along its major axis and m along its minor lies at j along the major and
    ceil(j m / n - 1/2) along the minor axis.

    Args:
        pose: (3,) m, m, rad. ranges: (B,) m. beam_angles: (B,) rad, body frame.
        min_range: a range at or below is no measurement; nor is one that is not finite.
        max_range: a range at or above clears up to here and ends in no cell.

    Returns:
        `Beams`; nothing is free or hit for a robot outside the map, nor beyond the edge.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("pose", pose, (3,))
    checks.shape("beam_angles", beam_angles, (None,))
    checks.shape("ranges", ranges, np.shape(beam_angles))
    rows, columns = spec.shape
    measured = jnp.isfinite(ranges) & (ranges > min_range)
    reach = jnp.where(measured, jnp.minimum(ranges, max_range), 0.0)
    # Rotating a table of beam directions costs two products a beam; a cosine a beam costs far more.
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    beam_cos, beam_sin = jnp.cos(beam_angles), jnp.sin(beam_angles)
    direction = jnp.stack([cos * beam_cos - sin * beam_sin, sin * beam_cos + cos * beam_sin], axis=-1)
    ends = pose[None, :2] + reach[:, None] * direction

    start = cell_of(pose[:2], spec)
    span = cell_of(ends, spec) - start[None]  # (B, 2)
    j = jnp.arange(_beam_length(spec, max_range), dtype=jnp.int32)[None]  # (1, K)
    exact = j.size * _longest_span(spec, max_range) <= _FLOAT_EXACT_CELLS
    length = jnp.abs(span)
    n = jnp.max(length, axis=-1, keepdims=True)  # (B, 1)
    column, row = (
        start[i] + jnp.sign(span[:, i : i + 1]) * _cells_along(j, length[:, i : i + 1], n, float_exact=exact)
        for i in (0, 1)
    )

    on_map = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & _on_map(pose, spec) & measured[:, None]
    ends_here = (j == n) & (ranges < max_range)[:, None]
    return Beams(row, column, free=on_map & (j < n), hit=on_map & ends_here)


def _on_map(pose: jax.Array, spec: GridSpec) -> jax.Array:
    cell = cell_of(pose[:2], spec)
    inside = (cell >= 0) & (cell < jnp.array(spec.shape[::-1], cell.dtype))
    return jnp.all(inside) & jnp.isfinite(pose[2])


def _beam_length(spec: GridSpec, max_range: float) -> int:
    """Cells of the longest beam that can lie on the map: it leaves the map after the map's longer side."""
    return min(_longest_span(spec, max_range) + 1, max(spec.shape))


def _longest_span(spec: GridSpec, max_range: float) -> int:
    """Cells from a robot to the end of its longest beam, one spare for rounding."""
    return math.ceil(max_range / spec.resolution) + 1


def _cells_along(j: jax.Array, m: jax.Array, n: jax.Array, *, float_exact: bool) -> jax.Array:
    """ceil(j m / n - 1/2) for integers j, m <= n: how far along one axis cell j of a beam lies."""
    n = jnp.maximum(n, 1)
    if not float_exact:
        return (2 * j * m + n - 1) // (2 * n)
    # The argument of the floor keeps 1 / (4 n) away from every integer, more than a float32 product is off by.
    share = 1 / n.astype(jnp.float32)
    return (j.astype(jnp.float32) * (m.astype(jnp.float32) * share) + (0.5 - 0.25 * share)).astype(jnp.int32)


def update_log_odds(
    log_odds: jax.Array,
    pose: jax.Array,
    ranges: jax.Array,
    beam_angles: jax.Array,
    l_occ: jax.Array,
    l_free: jax.Array,
    *,
    spec: GridSpec,
    min_range: float,
    max_range: float,
) -> jax.Array:
    """Add one scan to the map at a given pose.

        L ← clamp(L + Σ_beams [ l_free on every cell crossed, l_occ on the terminal cell ], l_min, l_max)

    Args:
        log_odds: (rows, columns) nats. pose: (3,) m, m, rad. ranges: (B,) m. beam_angles: (B,) rad, body frame.
        l_occ, l_free: () nats, > 0 and < 0.
        spec, min_range, max_range: as in `beam_cells`.

    Returns:
        (rows, columns) nats. Source: Elfes 1989; Thrun, Burgard & Fox 2005, section 9.2.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("log_odds", log_odds, spec.shape)
    checks.shape("pose", pose, (3,))
    checks.shape("beam_angles", beam_angles, (None,))
    # Cells that are not touched get zero added, each somewhere else: one shared address would serialise the adds.
    beams, cells = len(beam_angles), _beam_length(spec, max_range)
    zero = zero_like_any(log_odds, pose, ranges, beam_angles, l_occ, l_free)
    spread = jnp.arange(beams * cells, dtype=jnp.int32).reshape(beams, cells) % log_odds.size + zero
    zeros = jnp.full(spread.shape, zero.astype(log_odds.dtype))

    def change() -> tuple[jax.Array, jax.Array]:
        touched = beam_cells(pose, ranges, beam_angles, spec=spec, min_range=min_range, max_range=max_range)
        flat = jnp.where(touched.free | touched.hit, touched.row * spec.shape[1] + touched.column, spread)
        return flat, jnp.where(touched.hit, l_occ, jnp.where(touched.free, l_free, zeros)).astype(zeros.dtype)

    # The branch also keeps the compiler from merging this arithmetic into the scatter, where it runs cell by cell.
    flat, amount = jax.lax.cond(any_in_batch(_on_map(pose, spec)), change, lambda: (spread, zeros))
    summed = log_odds.ravel().at[flat].add(amount, mode="promise_in_bounds")
    return jnp.clip(summed.reshape(log_odds.shape), spec.l_min, spec.l_max)


def probability(log_odds: jax.Array) -> jax.Array:
    """Probability that a cell is occupied, 1 / (1 + exp(-L)), any shape."""
    return jax.nn.sigmoid(log_odds)


def entropy_bits(log_odds: jax.Array) -> jax.Array:
    """Entropy of the map in bits, the sum over cells of -p log2 p - (1 - p) log2(1 - p).

    Args:
        log_odds: (rows, columns) nats.

    Returns:
        () bits; a cell never seen counts one. Source: Cover & Thomas 2006, section 2.1.
    """
    p = probability(log_odds)
    # -log p = softplus(-L) and -log(1 - p) = softplus(L): exact where p rounds to 0 or 1.
    nats = p * jax.nn.softplus(-log_odds) + (1 - p) * jax.nn.softplus(log_odds)
    return jnp.sum(nats) / math.log(2)


def brier(log_odds: jax.Array, occupied: jax.Array, where: jax.Array) -> jax.Array:
    """Mean squared distance of the occupancy probability from the truth.

    Args:
        log_odds: (rows, columns) nats. occupied: (rows, columns) bool, the known world.
        where: (rows, columns) bool, the cells to score, `log_odds != 0` for those observed.

    Returns:
        () in [0, 1]; 0.25 is what knowing nothing scores; NaN without a cell. Source: Brier 1950.
    """
    square = (probability(log_odds) - occupied.astype(log_odds.dtype)) ** 2
    return jnp.sum(jnp.where(where, square, 0)) / jnp.sum(where, dtype=square.dtype)


class Calibration(NamedTuple):
    """Of the cells the map calls p, how many are occupied? One entry a bin of probability."""

    edges: jax.Array  # (bins + 1,)
    cells: jax.Array  # (bins,) cells whose probability falls into the bin
    probability: jax.Array  # (bins,) mean probability of those cells; NaN in an empty bin
    frequency: jax.Array  # (bins,) share of those cells that are occupied; NaN in an empty bin
    error: jax.Array  # () mean of |probability - frequency| weighted by cells


def calibration(log_odds: jax.Array, occupied: jax.Array, where: jax.Array, *, bins: int = 10) -> Calibration:
    """Reliability of the occupancy probabilities against a known world.

    Args:
        log_odds: (rows, columns) nats. occupied: (rows, columns) bool. where: (rows, columns) bool, cells to score.
        bins: number of equal bins of probability.

    Returns:
        `Calibration`. Source: Murphy & Winkler 1977; the error is that of Guo et al. 2017, section 2.
    """
    p = probability(log_odds)
    index = jnp.where(where, jnp.clip((p * bins).astype(jnp.int32), 0, bins - 1), bins).ravel()

    def total(value: jax.Array) -> jax.Array:
        return jnp.zeros(bins + 1, p.dtype).at[index].add(value.ravel().astype(p.dtype))[:bins]

    cells, mean, share = total(jnp.ones_like(p)), total(p), total(occupied)
    return Calibration(
        edges=jnp.linspace(0, 1, bins + 1, dtype=p.dtype),
        cells=cells,
        probability=mean / cells,
        frequency=share / cells,
        error=jnp.sum(jnp.abs(mean - share)) / jnp.sum(cells),
    )


def endpoint_covariance(
    pose: jax.Array, cov: jax.Array, reach: jax.Array, angle: jax.Array, R: jax.Array | None = None
) -> jax.Array:
    """Covariance of the point a beam ends in: why walls turn fuzzy as the pose becomes uncertain.

        Σ = J_ray P J_rayᵀ + J_sensor R J_sensorᵀ
        J_ray = d endpoint / d pose,  J_sensor = d endpoint / d (range, angle)

    Args:
        pose: (3,) m, m, rad. cov: (3, 3) of the pose.
        reach: () m, the measured range. angle: () rad, the beam in the body frame.
        R: (2, 2) m², rad², the beam's own noise; none by default.

    Returns:
        (2, 2) m². Source: first-order propagation, Smith, Self & Cheeseman 1990.
    """
    c, s = jnp.cos(pose[2] + angle), jnp.sin(pose[2] + angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    J_ray = jnp.stack([jnp.stack([one, zero, -reach * s]), jnp.stack([zero, one, reach * c])])
    spread = J_ray @ cov @ J_ray.T
    if R is not None:
        J_sensor = jnp.stack([jnp.stack([c, -reach * s]), jnp.stack([s, reach * c])])
        spread = spread + J_sensor @ R @ J_sensor.T
    return spread
