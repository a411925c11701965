"""Sine, cosine and arctangent as vector code.

On a CPU, `jnp.sin`, `jnp.cos` and `jnp.arctan2` are one call of the C library for every number, and a filter of a few
states spends most of its time in them. In float32 these are polynomials instead (Moshier 1989, Cephes: sinf, cosf,
atanf): sine and cosine are right to 1e-7, an arctangent to four units in the last place. In any other precision they
are those of `jnp`. Derivatives are exact.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

# pi / 2 in three parts, the first two of few digits, so that their products with a whole number are exact.
_HALF_PI = (1.5703125, 4.837512969970703125e-4, 7.549789948768648e-8)


@jax.custom_jvp
def sin_cos(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine of an angle in rad, any shape.

    The float32 form is for headings: beyond some thousand turns it loses digits.
    """
    if angle.dtype != jnp.float32:
        return jnp.sin(angle), jnp.cos(angle)
    quarter = jnp.floor(angle * (2 / math.pi) + 0.5)
    x = angle
    for part in _HALF_PI:
        x = x - quarter * part
    z = x * x
    sin = x * (1 + z * (-1.6666654611e-1 + z * (8.3321608736e-3 + z * -1.9515295891e-4)))
    cos = 1 + z * (-0.5 + z * (4.166664568298827e-2 + z * (-1.388731625493765e-3 + z * 2.443315711809948e-5)))
    quarter = quarter.astype(jnp.int32)
    swapped, down, left = (quarter & 1) == 1, (quarter & 2) == 2, ((quarter + 1) & 2) == 2
    sin, cos = jnp.where(swapped, cos, sin), jnp.where(swapped, sin, cos)
    return jnp.where(down, -sin, sin), jnp.where(left, -cos, cos)


@sin_cos.defjvp
def _(primals: Any, tangents: Any) -> Any:
    sin, cos = sin_cos(*primals)
    return (sin, cos), (cos * tangents[0], -sin * tangents[0])


@jax.custom_jvp
def arctan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """Angle of the point (x, y) in [-pi, pi], rad, any shape; 0 at the origin, which has no derivative."""
    if x.dtype != jnp.float32 or y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    across, up = jnp.abs(x), jnp.abs(y)
    longer = jnp.maximum(across, up)
    slope = jnp.minimum(across, up) / jnp.where(longer > 0, longer, 1)
    steep = slope > math.sqrt(2) - 1  # tan(pi / 8)
    t = jnp.where(steep, (slope - 1) / (slope + 1), slope)
    z = t * t
    tail = -3.33329491539e-1 + z * (1.99777106478e-1 + z * (-1.38776856032e-1 + z * 8.05374449538e-2))
    angle = t + t * z * tail + jnp.where(steep, math.pi / 4, 0)
    angle = jnp.where(up > across, math.pi / 2 - angle, angle)
    angle = jnp.where(x < 0, math.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)


@arctan2.defjvp
def _(primals: Any, tangents: Any) -> Any:
    (y, x), (dy, dx) = primals, tangents
    return arctan2(y, x), (x * dy - y * dx) / (x * x + y * y)
