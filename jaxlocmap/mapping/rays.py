"""Which cells the beams of a scan cross and end in.

Cell [row, column] covers origin + resolution * ([column, row] .. [column + 1, row + 1]). A cell index is a floor, so
nothing here has a derivative by the pose (it is zero).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.se2 import POSE, compose
from jaxlocmap.types import GridSpec, Scanner

# Beams of up to so many cells, on maps of up to so many, float32 places exactly; others take integer divisions.
_EXACT_SPAN, _EXACT_MAP = 1024, 1 << 24
_LONGEST_SPAN = 1 << 20  # cells: up to here those divisions do not overflow
_FAR = 2.0**29  # cells: a point beyond is as far outside as any, and a difference of two such fits an int32


class Beams(NamedTuple):
    """The cells of one scan: B beams of at most K cells, nearest first."""

    row: jax.Array  # (B, K) int32
    column: jax.Array  # (B, K) int32
    free: jax.Array  # (B, K) bool: the beam crosses this cell, and it lies on the map
    hit: jax.Array  # (B, K) bool: the beam ends in this cell, and it lies on the map


class Slopes(NamedTuple):
    """How the cells of B beams follow each other, for beams and maps that float32 places exactly."""

    slope: jax.Array  # (2, B) float32: span / n along x and y
    offset: jax.Array  # (2, B) float32, such that floor(j slope + offset) = ceil(j span / n - 1/2)

    def along(self, axis: int, j: jax.Array) -> jax.Array:
        """How many cells away cell j of every beam lies along an axis: (B, K) whole numbers."""
        return jnp.floor(j.astype(self.slope.dtype) * self.slope[axis, :, None] + self.offset[axis, :, None])


class Spans(NamedTuple):
    """The same for longer beams and larger maps, in integers."""

    span: jax.Array  # (2, B) int32: cells from the scanner's to the beam's last along x and y
    n: jax.Array  # (B,) int32: the larger of their magnitudes, at least 1

    def along(self, axis: int, j: jax.Array) -> jax.Array:
        """How many cells away cell j of every beam lies along an axis: (B, K) whole numbers."""
        span, n = self.span[axis, :, None], self.n[:, None]
        whole, rest = _times_over(j, jnp.abs(span), n)
        return jnp.sign(span) * (whole + (2 * rest > n).astype(jnp.int32))


class Rays(NamedTuple):
    """What is to be known of each of B beams to place its cells. From the scanner's, cell j of a beam lies
    ceil(j span / n - 1/2) cells away along x and y, ties towards the scanner, n being the larger span.
    """

    start: jax.Array  # (2,) int32: column and row of the scanner
    steps: Slopes | Spans
    free: jax.Array  # (B,) int32: so many cells are crossed and lie on the map, the first ones
    last: jax.Array  # (B,) int32: the j of the cell the beam ends in, -1 where it ends in none


def cell_of(point: jax.Array, spec: GridSpec) -> jax.Array:
    """Column and row of a point: floor((p - origin) / resolution).

    Args:
        point: (..., 2) x, y in m.

    Returns:
        (..., 2) int32 column, row; may lie outside the map.
    """
    return jnp.stack([_cell_along(point[..., axis], axis, spec) for axis in (0, 1)], axis=-1)


def _cell_along(coordinate: jax.Array, axis: int, spec: GridSpec) -> jax.Array:
    # Far and non-finite points go to a cell just as far outside, instead of wherever an integer wraps to.
    cell = jnp.floor((coordinate - spec.origin[axis]) / spec.resolution)
    return jnp.clip(jnp.nan_to_num(cell, nan=-_FAR), -_FAR, _FAR).astype(jnp.int32)


def on_map(pose: jax.Array, spec: GridSpec) -> jax.Array:
    """Whether a pose (3,) lies on the map and has a heading."""
    column, row = (_cell_along(pose[axis], axis, spec) for axis in (0, 1))
    rows, columns = spec.shape
    return (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & jnp.isfinite(pose[2])


def beam_cells(pose: jax.Array, ranges: jax.Array, scanner: Scanner, *, spec: GridSpec) -> Beams:
    """The cells every beam of a scan crosses and ends in (Bresenham 1965), all beams at once.

    Cell j of a beam that spans n cells along its major axis and m along its minor lies at j along the major and
    ceil(j m / n - 1/2) along the minor axis.

    Args:
        pose: (3,) m, m, rad, of the robot.
        ranges: (B,) m. At or below the scanner's `min_range`, or not finite, it is no measurement; at or above its
            `max_range` it clears up to there and ends in no cell.
        scanner: with B beams.
        spec: static.

    Returns:
        `Beams`; nothing is free or hit for a scanner outside the map, nor beyond the edge.

    Raises:
        ValueError: a wrong shape, or a `max_range` of more than about a million cells.
    """
    rays = trace(pose, ranges, scanner, spec=spec)
    j = jnp.arange(longest(spec, scanner.max_range), dtype=jnp.int32)[None]
    column, row = cells_at(rays, j)
    return Beams(row, column, free=j < rays.free[:, None], hit=j == rays.last[:, None])


def trace(pose: jax.Array, ranges: jax.Array, scanner: Scanner, *, spec: GridSpec) -> Rays:
    """The rays of a scan; arguments and errors as in `beam_cells`."""
    beam_angles, min_range, max_range = scanner.beam_angles, scanner.min_range, scanner.max_range
    checks.shape("pose", pose, (POSE,))
    checks.shape("beam_angles", beam_angles, (None,))
    checks.shape("ranges", ranges, np.shape(beam_angles))
    pose, _ = compose(pose, scanner.offset)
    limit = _span_limit(spec, max_range)
    if limit > _LONGEST_SPAN:
        raise ValueError(
            f"max_range: expected beams of up to {_LONGEST_SPAN:,} cells, got {max_range} m, {limit:,} cells of "
            f"{spec.resolution} m"
        )
    measured = jnp.isfinite(ranges) & (ranges > min_range) & on_map(pose, spec)
    reach = jnp.where(measured, jnp.minimum(ranges, max_range), 0.0)
    # Rotating a table of beam directions costs two products a beam; a cosine a beam costs far more.
    sin, cos = sin_cos(pose[2])
    beam_cos, beam_sin = jnp.cos(beam_angles), jnp.sin(beam_angles)
    ends = pose[0] + reach * (cos * beam_cos - sin * beam_sin), pose[1] + reach * (sin * beam_cos + cos * beam_sin)

    start = cell_of(pose[:2], spec)
    spans = tuple(_cell_along(end, axis, spec) - start[axis] for axis, end in enumerate(ends))
    # In float32, which is exact here: XLA gets the larger of integers' magnitudes wrong on NVIDIA's devices.
    n = jnp.maximum(*(jnp.abs(m.astype(jnp.float32)) for m in spans)).astype(jnp.int32)
    exact = limit <= _EXACT_SPAN and math.prod(spec.shape) <= _EXACT_MAP
    # A straight line that has left the map does not come back: its cells on the map are its first.
    sides = zip(spans, start, spec.shape[::-1], strict=True)
    inside = jnp.minimum(*(_cells_inside(m, n, first, cells, exact) for m, first, cells in sides))
    return Rays(
        start,
        _steps(jnp.stack(spans), jnp.maximum(n, 1), exact),
        free=jnp.where(measured, jnp.minimum(n, inside), 0),
        last=jnp.where(measured & (ranges < max_range) & (n < inside), n, -1),
    )


def _steps(span: jax.Array, n: jax.Array, exact: bool) -> Slopes | Spans:
    if not exact:
        return Spans(span, n)
    # The argument of the floor stays 1 / (4 n) away from every integer, more than a float32 product is off by.
    share = 1 / n.astype(jnp.float32)[None]
    return Slopes(span.astype(jnp.float32) * share, 0.5 - 0.25 * share * jnp.sign(span).astype(jnp.float32))


def _cells_inside(m: jax.Array, n: jax.Array, start: jax.Array, cells: int, exact: bool) -> jax.Array:
    """How many cells of a beam come before the first outside the map along one axis; more than n where none does."""
    # Outside is d cells away, which ceil(j m / n - 1/2) reaches at the first j above n (2 d - 1) / (2 m).
    d = jnp.minimum(jnp.where(m > 0, cells - start, start + 1), n + 1)
    above, below = 2 * d - 1, jnp.where(m == 0, 1, 2 * jnp.abs(m))
    if exact:  # half up, the quotient is further from every integer than any way to divide in float32 is off by
        whole = jnp.floor(((n * above).astype(jnp.float32) + 0.5) / below.astype(jnp.float32)).astype(jnp.int32)
    else:
        whole = jnp.where(above < below, _times_over(n, above, below)[0], n)
    return jnp.where(m == 0, n, whole) + 1


def _times_over(a: jax.Array, b: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Quotient and remainder of a b divided by c, whole numbers, int32.

    For 0 <= a <= 2^20, 0 <= b <= c and 0 < c <= 2^21, where a b does not fit: a is taken as 1024 times one number plus
    another.
    """
    a, b, c = (x.astype(jnp.uint32) for x in (a, b, c))
    high, low = a >> 10, a & 1023
    whole, rest = jnp.divmod(b << 10, c)
    more, rest = jnp.divmod(high * rest + low * b, c)
    return (high * whole + more).astype(jnp.int32), rest.astype(jnp.int32)


def cells_at(rays: Rays, j: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Column and row of cell j of every beam.

    Args:
        j: (1, K) or (B, 1) int32.

    Returns:
        (B, K) int32 each.
    """
    column, row = (rays.start[axis] + rays.steps.along(axis, j).astype(jnp.int32) for axis in (0, 1))
    return column, row


def flat_cells(rays: Rays, j: jax.Array, spec: GridSpec) -> jax.Array:
    """Flat index, row * columns + column, of cell j of every beam, (B, K) int32; j as in `cells_at`."""
    columns = spec.shape[1]
    across, up = (rays.steps.along(axis, j) for axis in (0, 1))
    return rays.start[0] + columns * rays.start[1] + (across + columns * up).astype(jnp.int32)


def longest(spec: GridSpec, max_range: float) -> int:
    """Cells of the longest beam that can lie on the map: it leaves the map after the map's longer side."""
    return min(_span_limit(spec, max_range) + 1, max(spec.shape))


def longest_crossing(spec: GridSpec, max_range: float) -> int:
    """So many of them at most are crossed: all, or all but the one the beam ends in."""
    return min(_span_limit(spec, max_range), max(spec.shape))


def _span_limit(spec: GridSpec, max_range: float) -> int:
    """Cells from a scanner to the end of its longest beam, one spare for rounding."""
    return math.ceil(max_range / spec.resolution) + 1
