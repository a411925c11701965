"""Poses (x, y, theta), and states whose first three entries are one: angles, differences and the frame of a sensor."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap._internal.trig import sin_cos

POSE = 3  # entries of a pose
HEADING = (2,)  # the entry of a pose that is an angle

Offset = tuple[float, float, float]  # (dx, dy, dtheta) m, m, rad in the body frame


def wrap(angle: jax.Array) -> jax.Array:
    """The angle in [-pi, pi), to rounding; inside, all but the last below pi come back bit for bit. Derivative 1."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) * (0.5 / jnp.pi))


def wrap_entries(x: jax.Array, angles: tuple[int, ...]) -> jax.Array:
    """A vector (n,) with those entries wrapped that are angles."""
    return jnp.stack([wrap(x[i]) if i in angles else x[i] for i in range(len(x))]) if angles else x


def boxminus(a: jax.Array, b: jax.Array, angles: tuple[int, ...] = HEADING) -> jax.Array:
    """A minus b, (n,), the entries that are angles wrapped. Source: Hertzberg et al. 2013."""
    return wrap_entries(a - b, angles)


def between(a: jax.Array, b: jax.Array) -> tuple[jax.Array, Matrix, Matrix]:
    """Pose b in the frame of pose a, a⁻¹ ∘ b.

    Args:
        a, b: (3,) m, m, rad.

    Returns:
        (3,), its heading wrapped, and its derivatives by a and by b, 3x3 each.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(a=(a, (POSE,)), b=(b, (POSE,)))
    s, c = sin_cos(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    by_a = Matrix([[-c, -s, y], [s, -c, -x], [0, 0, -1]])
    by_b = Matrix([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return jnp.stack([x, y, wrap(b[2] - a[2])]), by_a, by_b


def compose(pose: jax.Array, offset: Offset) -> tuple[jax.Array, Matrix]:
    """The pose of what is mounted at an offset from the robot's centre.

        s = (x + dx cos(theta) - dy sin(theta), y + dx sin(theta) + dy cos(theta), theta + dtheta)

    Args:
        pose: (3,) m, m, rad.
        offset: (dx, dy, dtheta) m, m, rad in the body frame. Static: zeros cost nothing.

    Returns:
        s (3,), its heading not wrapped, and ds / dpose, a 3x3 `Matrix`.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("pose", pose, (POSE,))
    dx, dy, dtheta = offset
    if not any(offset):
        return pose, Matrix.identity(POSE)
    heading = pose[2] + dtheta if dtheta else pose[2]
    if dx == 0 and dy == 0:
        return jnp.stack([pose[0], pose[1], heading]), Matrix.identity(POSE)
    s, c = sin_cos(pose[2])
    right, up = dx * c - dy * s, dx * s + dy * c
    return jnp.stack([pose[0] + right, pose[1] + up, heading]), Matrix([[1, 0, -up], [0, 1, right], [0, 0, 1]])
