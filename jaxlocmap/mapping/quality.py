"""How good a map is: entropy, Brier score and calibration against a known world."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.batching import scan
from jaxlocmap.mapping.grid import probability


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
        log_odds: (rows, columns) nats.
        occupied: (rows, columns) bool, the known world.
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
        log_odds: (rows, columns) nats.
        occupied: (rows, columns) bool.
        where: (rows, columns) bool, cells to score.
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
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(row, log_odds[0], occupied[0], where[0]))
    columns, _ = scan(add_row, none, (log_odds, occupied, where))
    return jax.tree.map(lambda x: jnp.sum(x, axis=-1), columns)
