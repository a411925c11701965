"""Parameters as numbers without limits, so that no step of an optimiser leads to a filter that cannot be."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap.types import Params

Coordinates = dict[str, jax.Array]
"""Each parameter by name, () and free to take any value."""

NAMES = ("v", "w", "v_w", "range", "bearing", "range_bearing", "l_occ", "l_free")
NOISE = ("v", "w", "range", "bearing")  # with Q and R diagonal
FULL_NOISE = ("v", "w", "v_w", "range", "bearing", "range_bearing")
CORRELATIONS = ("v_w", "range_bearing")
SENSOR_MODEL = ("l_occ", "l_free")
UNITS: dict[str, str] = dict(zip(NAMES, ("m/s", "rad/s", "–", "m", "rad", "–", "nats", "nats"), strict=True))

_DEVIATION = math.log(1e5)  # standard deviations and log-odds lie between 1e-5 and 1e5 of their units,
_TILT = 10.0  # and correlations within ±0.995: beyond, float32 cannot hold the matrix apart from a singular one


def check_names(tuned: tuple[str, ...]) -> None:
    """Raise unless these are some of `NAMES`.

    Raises:
        ValueError: none, or another name.
    """
    if not tuned or any(name not in NAMES for name in tuned):
        raise ValueError(f"tuned: expected some of {NAMES}, got {tuned}")


def unconstrain(params: Params) -> Coordinates:
    """The coordinates of parameters, all eight of `NAMES`. `constrain` is the way back.

        Q = L Lᵀ,  L = [[exp(v), 0], [exp(w) v_w, exp(w)]],   R likewise,   l_occ = exp(.),  l_free = -exp(.)

    Source: Pinheiro & Bates 1996, the log-Cholesky parametrisation; the entry off the diagonal is in units of its
    row's diagonal.

    Raises:
        ValueError: a wrong shape; a batch of parameters is a `vmap`.
    """
    _check_shapes(params)
    return {
        **_log_cholesky(params.Q, "v", "w"),
        **_log_cholesky(params.R, "range", "bearing"),
        "l_occ": jnp.log(params.l_occ),
        "l_free": jnp.log(-params.l_free),
    }


def constrain(coordinates: Coordinates) -> Params:
    """The parameters at coordinates: whatever these are, Q and R are positive definite and l_occ > 0 > l_free.

    Far out the coordinates have limits (1e-5 to 1e5 in the units of each; correlations to ±0.995), at which the
    derivative is zero.

    Args:
        coordinates: all eight of `NAMES`, () each.

    Returns:
        `Params` that `Params.check` accepts.

    Raises:
        ValueError: a wrong shape; a batch of coordinates is a `vmap`.
    """
    checks.shapes(**{name: (value, ()) for name, value in coordinates.items()})
    return Params(
        Q=_covariance(coordinates, "v", "w"),
        R=_covariance(coordinates, "range", "bearing"),
        l_occ=_positive(coordinates["l_occ"]),
        l_free=-_positive(coordinates["l_free"]),
    )


def natural(params: Params) -> dict[str, jax.Array]:
    """What people call the parameters, by the same names: standard deviations, correlations, log-odds.

    Raises:
        ValueError: a wrong shape; a batch of parameters is a `vmap`.
    """
    _check_shapes(params)
    return {
        **_deviations(params.Q, "v", "w"),
        **_deviations(params.R, "range", "bearing"),
        "l_occ": params.l_occ,
        "l_free": params.l_free,
    }


def _check_shapes(params: Params) -> None:
    checks.shapes(Q=(params.Q, (2, 2)), R=(params.R, (2, 2)), l_occ=(params.l_occ, ()), l_free=(params.l_free, ()))


def _log_cholesky(cov: jax.Array, first: str, second: str) -> Coordinates:
    across = cov[0, 1] / jnp.sqrt(cov[0, 0])
    rest = jnp.sqrt(cov[1, 1] - across**2)
    return {first: 0.5 * jnp.log(cov[0, 0]), second: jnp.log(rest), f"{first}_{second}": across / rest}


def _covariance(coordinates: Coordinates, first: str, second: str) -> jax.Array:
    a, b = _positive(coordinates[first]), _positive(coordinates[second])
    tilt = jnp.clip(coordinates[f"{first}_{second}"], -_TILT, _TILT)
    across = a * b * tilt
    return jnp.stack([jnp.stack([a * a, across]), jnp.stack([across, b * b * (1 + tilt * tilt)])])


def _deviations(cov: jax.Array, first: str, second: str) -> dict[str, jax.Array]:
    a, b = jnp.sqrt(cov[0, 0]), jnp.sqrt(cov[1, 1])
    return {first: a, second: b, f"{first}_{second}": cov[0, 1] / (a * b)}


def _positive(x: jax.Array) -> jax.Array:
    return jnp.exp(jnp.clip(x, -_DEVIATION, _DEVIATION))
