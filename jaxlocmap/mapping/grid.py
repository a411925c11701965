"""Occupancy grid: the log-odds update, and how good a map is.

Log-odds are in nats; cell [row, column] covers origin + resolution * ([column, row] .. [column + 1, row + 1]). The
derivative of a map by the pose is zero (`beams` takes floors); by `l_occ` and `l_free` it is exact.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.batching import any_in_batch, at_once, zero_like_any
from jaxlocmap.mapping.rays import Lines, flat_cells, longest_crossing, on_map, trace
from jaxlocmap.types import GridSpec


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
        spec, min_range, max_range: as in `beams.beam_cells`.

    Returns:
        (rows, columns) nats. Source: Elfes 1989; Thrun, Burgard & Fox 2005, section 9.2.

    Raises:
        ValueError: a wrong shape, a grid so far out that the pose's dtype cannot hold its corners to a millimetre, a
            `max_range` of more than about a million cells, or a batch of maps that have 2**31 cells or more together.
    """
    limits: dict[str, Any] = {"spec": spec, "min_range": min_range, "max_range": max_range}
    return clamp(add_scan(log_odds, pose, ranges, beam_angles, l_occ, l_free, **limits), spec)


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
    beam_angles: jax.Array,
    l_occ: jax.Array,
    l_free: jax.Array,
    *,
    spec: GridSpec,
    min_range: float,
    max_range: float,
) -> jax.Array:
    """`update_log_odds` for a loop over scans: the lower clamp is left to one `clamp` after the last.

    A cell that is crossed falls, and a fall below l_min needs no clamp until the cell is raised or read. So a scan
    clamps the cells its beams end in, before and after it raises them, instead of every cell of the map. What `clamp`
    makes of the result is what clamping after every scan gives.

    Args, source and errors as in `update_log_odds`; cells of `log_odds` may lie below l_min.
    """
    checks.shapes(log_odds=(log_odds, spec.shape), l_occ=(l_occ, ()), l_free=(l_free, ()))
    checks.resolved("grid", corners(spec), jnp.result_type(pose))

    def lines(pose: jax.Array, ranges: jax.Array) -> Lines:
        return trace(pose, ranges, beam_angles, spec=spec, min_range=min_range, max_range=max_range)

    # At a branch the compiler writes down what it has; it would otherwise repeat a beam's arithmetic for every cell.
    zero = zero_like_any(log_odds, pose, ranges, beam_angles)
    none = jax.tree.map(lambda x: jnp.full(x.shape, zero.astype(x.dtype)), jax.eval_shape(lines, pose, ranges))
    none = none._replace(last=none.last - 1)
    seen = jax.lax.cond(any_in_batch(on_map(pose, spec)), lines, lambda *_: none, pose, ranges)
    l_occ, l_free = (jnp.asarray(x, log_odds.dtype) for x in (l_occ, l_free))
    return _adder(spec, max_range)(log_odds.ravel(), seen, l_occ, l_free).reshape(spec.shape)


@functools.lru_cache(maxsize=64)
def _adder(spec: GridSpec, max_range: float) -> Callable[..., jax.Array]:
    """The function that adds a scan to a flat map: (log_odds (cells,), lines, l_occ (), l_free ()) -> (cells,).

    It takes a batch of maps for one long map with one long list of cells: scattering into that costs a third of
    scattering into many.
    """
    size, cells = math.prod(spec.shape), longest_crossing(spec, max_range)

    def index(lines: Lines, first: Any, outside: int) -> tuple[jax.Array, jax.Array]:
        """Where the cells that beams end in (B,) and cross (B, K) lie in an array whose entry `first` is the map's own
        first; `outside`, which is no entry, for the rest.
        """
        j = jnp.arange(cells, dtype=jnp.int32)[None]
        crossed = jnp.where(j < lines.free[:, None], first + flat_cells(lines, j, spec), outside)
        ends = first + flat_cells(lines, lines.last[:, None], spec)[:, 0]
        return jnp.where(lines.last >= 0, ends, outside), crossed

    def add(flat: jax.Array, ends: jax.Array, crossed: jax.Array, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        strict: dict[str, Any] = {"mode": "drop", "wrap_negative_indices": False}
        flat = flat.at[ends].set(jnp.maximum(flat.at[ends].get(mode="clip"), spec.l_min), **strict)
        flat = flat.at[ends].add(l_occ, **strict).at[crossed].add(l_free, **strict)
        return flat.at[ends].set(jnp.minimum(flat.at[ends].get(mode="clip"), spec.l_max), **strict)

    def many(flats: jax.Array, lines: Lines, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        runs, beams = len(flats), lines.free.shape[1]
        outside = runs * size
        if outside >= 2**31:
            raise ValueError(
                f"log_odds: expected fewer than 2**31 cells in a batch of maps, whose index is an int32, got {runs:,} "
                f"maps of {size:,} cells, {outside:,}"
            )
        lines = jax.tree.map(lambda x: jnp.broadcast_to(x, (runs, *x.shape[1:])), lines)

        def whole(lines: Lines) -> tuple[jax.Array, jax.Array]:
            return jax.vmap(index, in_axes=(0, 0, None))(lines, jnp.arange(runs, dtype=jnp.int32) * size, outside)

        def nowhere(lines: Lines) -> tuple[jax.Array, jax.Array]:
            none = outside + zero_like_any(flats, lines)
            return jnp.full((runs, beams), none), jnp.full((runs, beams, cells), none)

        def amount(value: jax.Array, count: int) -> jax.Array:
            return value[0] if len(value) == 1 else jnp.repeat(value, count)

        # The second branch to write down what is there, this time where each cell of a beam lies.
        ends, crossed = jax.lax.cond(jnp.any(lines.free > 0), whole, nowhere, lines)
        occ, free = amount(l_occ, beams), amount(l_free, beams * cells)
        return add(flats.ravel(), ends.ravel(), crossed.ravel(), occ, free).reshape(runs, size)

    @jax.custom_jvp
    def adder(flat: jax.Array, lines: Lines, l_occ: jax.Array, l_free: jax.Array) -> jax.Array:
        return at_once(many)(flat, lines, l_occ, l_free)

    @adder.defjvp
    def _(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        flat, lines, *amounts = primals
        ends, crossed = index(lines, 0, size)

        def plain(flat: jax.Array, *amounts: jax.Array) -> jax.Array:
            return add(flat, ends, crossed, *amounts)

        return jax.jvp(plain, (flat, *amounts), (tangents[0], *tangents[2:]))

    return adder


def probability(log_odds: jax.Array) -> jax.Array:
    """Probability that a cell is occupied, 1 / (1 + exp(-L)), any shape."""
    return jax.nn.sigmoid(log_odds)


def entropy_bits(log_odds: jax.Array) -> jax.Array:
    """Entropy of the map in bits, the sum over cells of -p log2 p - (1 - p) log2(1 - p).

    Args:
        log_odds: (rows, columns) nats.

    Returns:
        () bits; a cell never seen counts one. Source: Cover & Thomas 2006, section 2.1.

    Raises:
        ValueError: not one map.
    """
    checks.shape("log_odds", log_odds, (None, None))
    return jnp.sum(_bits(log_odds))


def _bits(log_odds: jax.Array) -> jax.Array:
    # With q = exp(-|L|), the smaller probability is q / (1 + q), and nothing cancels where that is close to none.
    size = jnp.abs(log_odds)
    q = jnp.exp(-size)
    return (jnp.log1p(q) + size * q / (1 + q)) / math.log(2)


def brier(log_odds: jax.Array, occupied: jax.Array, where: jax.Array) -> jax.Array:
    """Mean squared distance of the occupancy probability from the truth.

    Args:
        log_odds: (rows, columns) nats. occupied: (rows, columns) bool, the known world.
        where: (rows, columns) bool, the cells to score, `log_odds != 0` for those observed.

    Returns:
        () in [0, 1]; 0.25 is what knowing nothing scores; NaN without a cell. Source: Brier 1950.
    """
    sums = score(log_odds, occupied, where)
    return sums.square / jnp.sum(sums.cells)


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
    sums = score(log_odds, occupied, where, bins=bins)
    return Calibration(
        edges=jnp.linspace(0, 1, bins + 1, dtype=log_odds.dtype),
        cells=sums.cells,
        probability=sums.probability / sums.cells,
        frequency=sums.occupied / sums.cells,
        error=jnp.sum(jnp.abs(sums.probability - sums.occupied)) / jnp.sum(sums.cells),
    )


class Score(NamedTuple):
    """Sums over the cells of a map."""

    entropy_bits: jax.Array  # () over all cells
    square: jax.Array  # () of probability minus truth, squared, over the scored cells, as are the rest
    cells: jax.Array  # (bins,) cells by the probability the map gives them
    probability: jax.Array  # (bins,) of those probabilities
    occupied: jax.Array  # (bins,) how many of those cells are occupied


def score(log_odds: jax.Array, occupied: jax.Array, where: jax.Array, *, bins: int = 10) -> Score:
    """What `entropy_bits`, `brier` and `calibration` are made of, in one pass over the map; arguments as theirs.

    Raises:
        ValueError: not one map, or a truth of another shape.
    """
    checks.shape("log_odds", log_odds, (None, None))
    checks.shapes(occupied=(occupied, log_odds.shape), where=(where, log_odds.shape))
    each_bin = jnp.arange(bins, dtype=jnp.int32)[:, None]

    def row(L: jax.Array, occupied: jax.Array, where: jax.Array) -> Score:
        p, truth = probability(L), occupied.astype(L.dtype)
        index = jnp.where(where, jnp.clip((p * bins).astype(jnp.int32), 0, bins - 1), bins)
        chosen = index[None] == each_bin
        return Score(
            entropy_bits=_bits(L),
            square=jnp.where(where, (p - truth) ** 2, 0),
            cells=chosen.astype(L.dtype),
            probability=jnp.where(chosen, p[None], 0),
            occupied=jnp.where(chosen, truth[None], 0),
        )

    def add_row(sums: Score, now: tuple[jax.Array, ...]) -> tuple[Score, None]:
        return jax.tree.map(jnp.add, sums, row(*now)), None

    # Row by row, every column by itself, is vector code; a scatter would add one cell after the other.
    zero = zero_like_any(log_odds, occupied, where).astype(log_odds.dtype)
    none = jax.tree.map(lambda x: jnp.full(x.shape, zero), jax.eval_shape(row, log_odds[0], occupied[0], where[0]))
    columns, _ = jax.lax.scan(add_row, none, (log_odds, occupied, where))
    return jax.tree.map(lambda x: jnp.sum(x, axis=-1), columns)


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

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(pose=(pose, (3,)), cov=(cov, (3, 3)), reach=(reach, ()), angle=(angle, ()))
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
