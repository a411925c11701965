"""Range-bearing sensor: what a pose should see of a landmark, how that changes with the pose, and which landmark
an anonymous observation belongs to.

The sensor sits at `sensor_offset = (dx, dy, dtheta)` in the body frame.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, mahalanobis, sandwich
from jaxlocmap._internal.trig import arctan2, sin_cos
from jaxlocmap.motion import wrap

Offset = tuple[float, float, float]

_TOUCHING = 1e-9  # m^2: closer than this, a landmark has no bearing


def sensor_pose(pose: jax.Array, offset: Offset) -> tuple[jax.Array, jax.Array, jax.Array, Matrix]:
    """Where a sensor stands that is mounted at an offset from the robot's centre.

        s = (x + dx cos(theta) - dy sin(theta), y + dx sin(theta) + dy cos(theta), theta + dtheta)

    Args:
        pose: (3,) m, m, rad. offset: (dx, dy, dtheta) m, m, rad in the body frame.

    Returns:
        x, y (), m; heading (), rad, not wrapped; 3x3 `Matrix`, ds / dpose.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("pose", pose, (3,))
    dx, dy, dtheta = offset
    heading = pose[2] + dtheta if dtheta else pose[2]
    if dx == 0 and dy == 0:
        return pose[0], pose[1], heading, Matrix.identity(3)
    s, c = sin_cos(pose[2])
    right, up = dx * c - dy * s, dx * s + dy * c
    return pose[0] + right, pose[1] + up, heading, Matrix([[1, 0, -up], [0, 1, right], [0, 0, 1]])


def observe(pose: jax.Array, landmark: jax.Array, sensor_offset: Offset = (0.0, 0.0, 0.0)) -> jax.Array:
    """Expected observation: range and bearing from the sensor to a landmark.

        [ |l - s|,  atan2(l_y - s_y, l_x - s_x) - theta - dtheta ],  s the sensor's position

    Args:
        pose: (3,) m, m, rad. landmark: (2,) m, world frame.
        sensor_offset: (dx, dy, dtheta) m, m, rad in the body frame.

    Returns:
        (2,) range m, bearing rad wrapped; no gradient where the landmark lies on the sensor.
        Source: Thrun, Burgard & Fox 2005, section 6.6.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("landmark", landmark, (2,))
    x, y, heading, _ = sensor_pose(pose, sensor_offset)
    dx, dy = landmark[0] - x, landmark[1] - y
    return jnp.stack([jnp.hypot(dx, dy), wrap(arctan2(dy, dx) - heading)])


def linearise(
    pose: jax.Array, landmark: jax.Array, z: jax.Array, sensor_offset: Offset = (0.0, 0.0, 0.0)
) -> tuple[jax.Array, Matrix, jax.Array]:
    """Residual of an observation and the Jacobian of its expectation.

    Args:
        pose: (3,) m, m, rad. landmark: (2,) m. z: (2,) range m, bearing rad.
        sensor_offset: (dx, dy, dtheta) m, m, rad in the body frame.

    Returns:
        residual: (2,) z minus `observe`, bearing wrapped. H: 2x3 `Matrix`, d observe / d pose.
        defined: () bool, False where the landmark lies on the sensor and has no bearing (H is then that of a
        landmark one metre away, so that gradients stay finite).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(landmark=(landmark, (2,)), z=(z, (2,)))
    x, y, heading, J = sensor_pose(pose, sensor_offset)
    dx, dy = landmark[0] - x, landmark[1] - y
    q = dx * dx + dy * dy
    defined = q > _TOUCHING
    # Safe on both sides of the select: sqrt and atan2 at 0 have NaN gradients even where they are not chosen.
    dx, dy, q = jnp.where(defined, dx, 1.0), jnp.where(defined, dy, 0.0), jnp.where(defined, q, 1.0)
    r = jnp.sqrt(q)
    residual = jnp.stack([z[0] - r, wrap(z[1] - arctan2(dy, dx) + heading)])
    H = Matrix([[-dx / r, -dy / r, 0], [dy / q, -dx / q, -1]]) @ J
    return residual, H, defined


def associate(
    mean: jax.Array,
    cov: jax.Array,
    z: jax.Array,
    landmarks: jax.Array,
    R: jax.Array,
    sensor_offset: Offset = (0.0, 0.0, 0.0),
) -> jax.Array:
    """The landmark an anonymous observation most likely came from: the smallest Mahalanobis distance.

        argmin_j  r_jᵀ (H_j P H_jᵀ + R)⁻¹ r_j

    Args:
        mean: (3,) m, m, rad. cov: (3, 3). z: (2,) range m, bearing rad.
        landmarks: (L, 2) m. R: (2, 2) m², rad².
        sensor_offset: (dx, dy, dtheta) m, m, rad in the body frame.

    Returns:
        () int32 row of `landmarks`. Source: Thrun, Burgard & Fox 2005, section 7.5 (there with the maximum
        likelihood; the determinant of S differs little between landmarks, and the gate uses the distance).

    Raises:
        ValueError: a wrong shape, or no landmark.
    """
    checks.shapes(mean=(mean, (3,)), cov=(cov, (3, 3)), z=(z, (2,)), landmarks=(landmarks, (None, 2)), R=(R, (2, 2)))
    if not len(landmarks):
        raise ValueError("landmarks: expected at least one to choose from, got (0, 2)")
    P, noise = Matrix.symmetric(cov), Matrix.symmetric(R)

    def distance(landmark: jax.Array) -> jax.Array:
        residual, H, defined = linearise(mean, landmark, z, sensor_offset)
        d2 = mahalanobis(sandwich(H, P) + noise, (residual[0], residual[1]))
        return jnp.where(defined, d2, jnp.inf)

    return jnp.argmin(jax.vmap(distance)(landmarks)).astype(jnp.int32)
