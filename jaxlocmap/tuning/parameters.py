"""Parameters as numbers without limits, so that no step of an optimiser leads to a filter that cannot be."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxlocmap import checks, motion, sensors
from jaxlocmap.matching import submaps
from jaxlocmap.parameters import L_FREE, L_OCC, Block, Params, Q, R
from jaxlocmap.types import Config

Coordinates = dict[str, jax.Array]
"""Each parameter by name, () and free to take any value."""

_INVERSE_SENSOR_MODEL = (L_OCC, L_FREE)
BLOCKS = (Q, R, *_INVERSE_SENSOR_MODEL)


def blocks_of(config: Config) -> tuple[Block, ...]:
    """The blocks that a filter with these settings has: of its motion model, its sensor, its matcher and its map."""
    own = (*motion.resolve(config.motion).noise, sensors.resolve(config.sensor).noise)
    return (*own, *(() if config.matcher is None else submaps.BLOCKS), *_INVERSE_SENSOR_MODEL)


def names_of(blocks: tuple[Block, ...]) -> tuple[str, ...]:
    """The parameters of blocks: of a covariance its standard deviations by component, then the correlations "a_b"."""
    return tuple(name for block in blocks for name in (*block.components, *block.correlations))


def correlations_of(blocks: tuple[Block, ...]) -> tuple[str, ...]:
    """The parameters that are correlations."""
    return tuple(name for block in blocks for name in block.correlations)


def units_of(blocks: tuple[Block, ...]) -> dict[str, str]:
    """The unit of each parameter; a correlation has none."""
    return {name: unit for block in blocks for name, unit in zip(block.components, block.units, strict=True)} | (
        dict.fromkeys(correlations_of(blocks), "–")
    )


NAMES = names_of(BLOCKS)
CORRELATIONS = correlations_of(BLOCKS)
UNITS = {name: units_of(BLOCKS)[name] for name in NAMES}
SENSOR_MODEL = names_of(_INVERSE_SENSOR_MODEL)
FULL_NOISE = tuple(name for name in NAMES if name not in SENSOR_MODEL)
NOISE = tuple(name for name in FULL_NOISE if name not in CORRELATIONS)  # with Q and R diagonal

_DEVIATION = math.log(1e5)  # standard deviations and log-odds lie between 1e-5 and 1e5 of their units,
_TILT = 10.0  # and correlations within ±0.995: beyond, float32 cannot hold the matrix apart from a singular one


def check_names(tuned: tuple[str, ...], blocks: tuple[Block, ...] = BLOCKS) -> None:
    """Raise unless these are parameters of the blocks.

    Raises:
        ValueError: none, or another name.
    """
    names = names_of(blocks)
    if not tuned or any(name not in names for name in tuned):
        raise ValueError(f"tuned: expected some of {names}, got {tuned}")


def unconstrain(params: Params, blocks: tuple[Block, ...] = BLOCKS) -> Coordinates:
    """The coordinates of parameters, one for each of `names_of(blocks)`. `constrain` is the way back.

        covariance = L Lᵀ,  L_ii = exp(a_i),  L_ij = L_ii a_ij below the diagonal
        positive = exp(a),  negative = -exp(a),  real = a

    Source: Pinheiro & Bates 1996, the log-Cholesky parametrisation; the entries off the diagonal are in units of their
    row's diagonal.

    Raises:
        ValueError: a wrong shape (a batch of parameters is a `vmap`), or a block that is not there.
    """
    coordinates: Coordinates = {}
    for block in blocks:
        value = params.block(block)
        if block.kind == "covariance":
            L = _cholesky(value)
            diagonal = [jnp.log(L[i][i]) for i in range(len(L))]
            below = [L[i][j] / L[i][i] for i in range(len(L)) for j in range(i)]
            coordinates |= dict(zip(names_of((block,)), [*diagonal, *below], strict=True))
        else:
            sign = -1 if block.kind == "negative" else 1
            coordinates[block.name] = value if block.kind == "real" else jnp.log(sign * value)
    return coordinates


def constrain(coordinates: Coordinates, blocks: tuple[Block, ...] = BLOCKS, *, others: Params | None = None) -> Params:
    """The parameters at coordinates: whatever these are, covariances are positive definite and signs are right.

    Far out the coordinates have limits (1e-5 to 1e5 in the units of each; correlations of two to ±0.995), at which the
    derivative is zero.

    Args:
        coordinates: all of `names_of(blocks)`, () each.
        blocks: static.
        others: what the blocks leave out, such as the gate's probability; none by default.

    Returns:
        `Params` that `Params.check` accepts.

    Raises:
        ValueError: a wrong shape; a batch of coordinates is a `vmap`.
    """
    checks.shapes(**{name: (value, ()) for name, value in coordinates.items()})
    nothing = jnp.zeros(())
    params = Params(None, None, nothing, nothing) if others is None else others
    for block in blocks:
        if block.kind == "covariance":
            value = _covariance(coordinates, block)
        elif block.kind == "real":
            value = coordinates[block.name]
        else:
            value = (-1 if block.kind == "negative" else 1) * _positive(coordinates[block.name])
        params = params.with_block(block, value)
    return params


def natural(params: Params, blocks: tuple[Block, ...] = BLOCKS) -> dict[str, jax.Array]:
    """What people call the parameters, by the same names: standard deviations, correlations, log-odds.

    Raises:
        ValueError: as `unconstrain`.
    """
    values: dict[str, jax.Array] = {}
    for block in blocks:
        value = params.block(block)
        if block.kind == "covariance":
            std = [jnp.sqrt(value[i, i]) for i in range(len(value))]
            below = [value[j, i] / (std[j] * std[i]) for i in range(len(value)) for j in range(i)]
            values |= dict(zip(names_of((block,)), [*std, *below], strict=True))
        else:
            values[block.name] = value
    return values


def _cholesky(cov: jax.Array) -> list[list[jax.Array]]:
    """The lower triangle of a covariance's Cholesky factor, reading its upper triangle."""
    L: list[list[jax.Array]] = []
    for i in range(len(cov)):
        row: list[jax.Array] = []
        for j in range(i):
            row.append((cov[j, i] - sum(row[k] * L[j][k] for k in range(j))) / L[j][j])
        row.append(jnp.sqrt(cov[i, i] - sum(x * x for x in row)))
        L.append(row)
    return L


def _covariance(coordinates: Coordinates, block: Block) -> jax.Array:
    m, tilts = len(block.components), iter(block.correlations)
    L = []
    for i in range(m):
        size = _positive(coordinates[block.components[i]])
        L.append([*(size * jnp.clip(coordinates[next(tilts)], -_TILT, _TILT) for _ in range(i)), size])
    rows = [[sum(L[i][k] * L[j][k] for k in range(min(i, j) + 1)) for j in range(m)] for i in range(m)]
    return jnp.stack([jnp.stack(row) for row in rows])


def _positive(x: jax.Array) -> jax.Array:
    return jnp.exp(jnp.clip(x, -_DEVIATION, _DEVIATION))
