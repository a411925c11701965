"""Occupancy grid: the log-odds update.

Log-odds are in nats; cell [row, column] covers origin + resolution * ([column, row] .. [column + 1, row + 1]). The
derivative of a map by the pose is zero (`rays` takes floors); by `l_occ` and `l_free` it is exact.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.batching import any_in_batch, at_once, cond
from jaxlocmap.mapping.rays import Rays, flat_cells, longest_crossing, on_map, trace
from jaxlocmap.se2 import POSE, compose
from jaxlocmap.types import GridSpec, Scanner


def update_log_odds(
    log_odds: jax.Array,
    pose: jax.Array,
    ranges: jax.Array,
    l_occ: jax.Array,
    l_free: jax.Array,
    *,
    scanner: Scanner,
    spec: GridSpec,
) -> jax.Array:
    """Add one scan to the map at a given pose.

        L ← clamp(L + Σ_beams [ l_free on every cell crossed, l_occ on the terminal cell ], l_min, l_max)

    Args:
        log_odds: (rows, columns) nats.
        pose: (3,) m, m, rad, of the robot.
        ranges: (B,) m, as in `rays.beam_cells`.
        l_occ: () nats, > 0.
        l_free: () nats, < 0.
        scanner: with B beams.
        spec: static.

    Returns:
        (rows, columns) nats. Source: Elfes 1989; Thrun, Burgard & Fox 2005, section 9.2.

    Raises:
        ValueError: a wrong shape, a grid so far out that the pose's dtype cannot hold its corners to a millimetre, a
            `max_range` of more than about a million cells, or a batch of maps that have 2**31 cells or more together.
    """
    return clamp(add_scan(log_odds, pose, ranges, l_occ, l_free, scanner=scanner, spec=spec), spec)


def corners(spec: GridSpec) -> list[float]:
    """Least and largest x and y of the grid, m."""
    (x, y), (rows, columns) = spec.origin, spec.shape
    return [x, y, x + columns * spec.resolution, y + rows * spec.resolution]


def clamp(log_odds: jax.Array, spec: GridSpec) -> jax.Array:
    """The log-odds within [l_min, l_max], any shape."""
    return jnp.clip(log_odds, spec.l_min, spec.l_max)


def add_scan(
    log_odds: jax.Array,
    pose: jax.Array,
    ranges: jax.Array,
    l_occ: jax.Array,
    l_free: jax.Array,
    *,
    scanner: Scanner,
    spec: GridSpec,
) -> jax.Array:
    """`update_log_odds` for a loop over scans: the lower clamp is left to one `clamp` after the last.

    A cell that is crossed falls, and a fall below l_min needs no clamp until the cell is raised or read. So a scan
    clamps the cells its beams end in, before and after it raises them, instead of every cell of the map. What `clamp`
    makes of the result is what clamping after every scan gives.

    Args, source and errors as in `update_log_odds`; cells of `log_odds` may lie below l_min.
    """
    checks.shapes(log_odds=(log_odds, spec.shape), l_occ=(l_occ, ()), l_free=(l_free, ()))
    checks.resolved("grid", corners(spec), jnp.result_type(pose))

    def rays(pose: jax.Array, ranges: jax.Array) -> Rays:
        return trace(pose, ranges, scanner, spec=spec)

    # At a branch the compiler writes down what it has; it would otherwise repeat a beam's arithmetic for every cell.
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(rays, pose, ranges))
    none = none._replace(last=none.last - 1)
    seen = cond(any_in_batch(on_map(compose(pose, scanner.offset)[0], spec)), rays, lambda *_: none, pose, ranges)
    l_occ, l_free = (jnp.asarray(x, log_odds.dtype) for x in (l_occ, l_free))
    return _adder(spec, scanner.max_range)(log_odds.ravel(), seen, l_occ, l_free).reshape(spec.shape)


@functools.lru_cache(maxsize=64)
def _adder(spec: GridSpec, max_range: float) -> Callable[..., jax.Array]:
    """The function that adds a scan to a flat map: (log_odds (cells,), rays, l_occ (), l_free ()) -> (cells,).

    It takes a batch of maps for one long map with one long list of cells: scattering into that costs a third of
    scattering into many.
    """
    size, cells = math.prod(spec.shape), longest_crossing(spec, max_range)

    def index(rays: Rays, first: Any, outside: int) -> tuple[jax.Array, jax.Array]:
        """Where the cells that beams end in (B,) and cross (B, K) lie in an array whose entry `first` is the map's own
        first; `outside`, which is no entry, for the rest.
        """
        j = jnp.arange(cells, dtype=jnp.int32)[None]
        crossed = jnp.where(j < rays.free[:, None], first + flat_cells(rays, j, spec), outside)
        ends = first + flat_cells(rays, rays.last[:, None], spec)[:, 0]
        return jnp.where(rays.last >= 0, ends, outside), crossed

    def add(flat: jax.Array, ends: jax.Array, crossed: jax.Array, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        strict: dict[str, Any] = {"mode": "drop", "wrap_negative_indices": False}
        flat = flat.at[ends].set(jnp.maximum(flat.at[ends].get(mode="clip"), spec.l_min), **strict)
        flat = flat.at[ends].add(l_occ, **strict).at[crossed].add(l_free, **strict)
        return flat.at[ends].set(jnp.minimum(flat.at[ends].get(mode="clip"), spec.l_max), **strict)

    def many(flats: jax.Array, rays: Rays, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        runs, beams = len(flats), rays.free.shape[1]
        outside = runs * size
        if outside >= 2**31:
            raise ValueError(
                f"log_odds: expected fewer than 2**31 cells in a batch of maps, whose index is an int32, got {runs:,} "
                f"maps of {size:,} cells, {outside:,}"
            )
        rays = jax.tree.map(lambda x: jnp.broadcast_to(x, (runs, *x.shape[1:])), rays)

        def whole(rays: Rays) -> tuple[jax.Array, jax.Array]:
            return jax.vmap(index, in_axes=(0, 0, None))(rays, jnp.arange(runs, dtype=jnp.int32) * size, outside)

        def nowhere(rays: Rays) -> tuple[jax.Array, jax.Array]:
            return jnp.full((runs, beams), outside, jnp.int32), jnp.full((runs, beams, cells), outside, jnp.int32)

        def amount(value: jax.Array, count: int) -> jax.Array:
            return value[0] if len(value) == 1 else jnp.repeat(value, count)

        # The second branch to write down what is there, this time where each cell of a beam lies.
        ends, crossed = cond(jnp.any(rays.free > 0), whole, nowhere, rays)
        occ, free = amount(l_occ, beams), amount(l_free, beams * cells)
        return add(flats.ravel(), ends.ravel(), crossed.ravel(), occ, free).reshape(runs, size)

    @jax.custom_jvp
    def adder(flat: jax.Array, rays: Rays, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        return at_once(many)(flat, rays, l_occ, l_free)

    @adder.defjvp
    def _(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        flat, rays, *amounts = primals
        ends, crossed = index(rays, 0, size)

        def plain(flat: jax.Array, *amounts: jax.Array) -> jax.Array:
            return add(flat, ends, crossed, *amounts)

        return jax.jvp(plain, (flat, *amounts), (tangents[0], *tangents[2:]))

    return adder


def probability(log_odds: jax.Array) -> jax.Array:
    """Probability that a cell is occupied, 1 / (1 + exp(-L)), any shape."""
    return jax.nn.sigmoid(log_odds)


def endpoint_covariance(
    pose: jax.Array, cov: jax.Array, reach: jax.Array, angle: jax.Array, R: jax.Array | None = None
) -> jax.Array:
    """Covariance of the point a beam ends in: why walls turn fuzzy as the pose becomes uncertain.

        Σ = J_ray P J_rayᵀ + J_sensor R J_sensorᵀ
        J_ray = d endpoint / d pose,  J_sensor = d endpoint / d (range, angle)

    Args:
        pose: (3,) m, m, rad.
        cov: (3, 3) of the pose.
        reach: () m, the measured range.
        angle: () rad, the beam in the body frame.
        R: (2, 2) m², rad², the beam's own noise; none by default.

    Returns:
        (2, 2) m². Source: first-order propagation, Smith, Self & Cheeseman 1990.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(pose=(pose, (POSE,)), cov=(cov, (POSE, POSE)), reach=(reach, ()), angle=(angle, ()))
    if R is not None:
        checks.shape("R", R, (2, 2))
    c, s = jnp.cos(pose[2] + angle), jnp.sin(pose[2] + angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    J_ray = jnp.stack([jnp.stack([one, zero, -reach * s]), jnp.stack([zero, one, reach * c])])
    spread = J_ray @ cov @ J_ray.T
    if R is not None:
        J_sensor = jnp.stack([jnp.stack([c, -reach * s]), jnp.stack([s, reach * c])])
        spread = spread + J_sensor @ R @ J_sensor.T
    return spread
