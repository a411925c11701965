"""What a scan saw of surfaces: points with a normal each, in the robot's frame."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap.types import Scanner

_RADIUS = 0.3  # m: beams that end within it are fitted by one line, and the next on each side if it is not farther
_NEIGHBOURS = 8  # beams on each side at most: a normal needs no more
NO_RETURN = 0.15  # m below `max_range`: there a beam without a return, max_range and noise, looks like a hit


class Points(NamedTuple):
    """Where the beams of a scan end. B beams."""

    xy: jax.Array  # (B, 2) m, in the robot's frame
    normal: jax.Array  # (B, 2) of length 1, of either sign
    valid: jax.Array  # (B,) bool: the beam hit something, and what it hit has a normal


def surface_points(ranges: jax.Array, std: jax.Array | float, *, scanner: Scanner, gap: float) -> Points:
    """The points of a scan and the normals of the surfaces they lie on, from a line fitted to each point and its
    neighbours by principal axes.

    A point has no normal where the beam did not return; a beam beside it did not, or ended farther than `gap`; the
    smaller eigenvalue of its neighbourhood exceeds (2 std)²; the larger is not 4 times the smaller; or the point lies
    more than 3 std off its own line.

    Args:
        ranges: (B,) m, neighbouring beams side by side.
        std: () m, standard deviation of a range.
        scanner: with B beams.
        gap: m: the ends of neighbouring beams farther apart than this are taken to lie on two surfaces.

    Source: Diebel, Reutersward, Thrun, Davis & Gupta 2004 (normals by principal axes).

    Raises:
        ValueError: a wrong shape.
    """
    beams = len(scanner.beam_angles)
    checks.shapes(ranges=(ranges, (beams,)), std=(std, ()))
    dx, dy, turn = scanner.offset
    hit = jnp.isfinite(ranges) & (ranges > scanner.min_range) & (ranges < scanner.max_range - NO_RETURN)
    reach, angles = jnp.where(hit, ranges, 1), scanner.beam_angles + turn
    x, y = dx + reach * jnp.cos(angles), dy + reach * jnp.sin(angles)

    one = jnp.ones_like(x)
    count, sums, between = one, [jnp.zeros_like(x)] * 5, hit
    for side in (1, -1):
        connected, last_x, last_y = hit, x, y
        for k in range(1, min(_NEIGHBOURS, beams - 1) + 1):
            # Beyond the first and last beam the shifted array wraps; no beam there is connected.
            there = (jnp.arange(beams) + side * k >= 0) & (jnp.arange(beams) + side * k < beams)
            next_x, next_y, next_hit = (jnp.roll(v, -side * k) for v in (x, y, hit))
            near = (next_x - last_x) ** 2 + (next_y - last_y) ** 2 < gap**2
            rx, ry = next_x - x, next_y - y
            connected = connected & there & next_hit & near
            if k == 1:
                between = between & connected
            else:
                connected = connected & (rx**2 + ry**2 <= _RADIUS**2)
            count = count + jnp.where(connected, 1, 0)
            terms = (rx, ry, rx * rx, rx * ry, ry * ry)
            sums = [total + jnp.where(connected, term, 0) for total, term in zip(sums, terms, strict=True)]
            last_x, last_y = next_x, next_y

    mean_x, mean_y, xx, xy, yy = (total / count for total in sums)
    xx, xy, yy = xx - mean_x**2, xy - mean_x * mean_y, yy - mean_y**2
    half, middle = (xx - yy) / 2, (xx + yy) / 2
    squared = half**2 + xy**2
    root = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
    least, most = middle - root, middle + root
    # An eigenvector of the smaller one is orthogonal to both rows of the matrix less it: take the longer row.
    by_first = xx > yy
    normal_x, normal_y = jnp.where(by_first, xy, least - yy), jnp.where(by_first, least - xx, xy)
    squared = normal_x**2 + normal_y**2
    known = between & (squared > 0)
    scale = jax.lax.rsqrt(jnp.where(known, squared, 1))
    normal_x, normal_y = normal_x * scale, normal_y * scale
    off_line = jnp.abs(normal_x * mean_x + normal_y * mean_y)
    valid = known & (least <= (2 * std) ** 2) & (most >= 4 * least) & (off_line <= 3 * std)
    return Points(jnp.stack([x, y], axis=-1), jnp.stack([normal_x, normal_y], axis=-1), valid)
