"""Sensors: what one expects to measure of a state, how that changes with the state, and which landmark an anonymous
observation belongs to. Landmarks by range and bearing are here.

A sensor is a value: what it expects of a state, which entries are angles, and the name of its noise. Jacobians come
from autodiff unless they are given; `Config.sensor_offset` mounts any of them off the centre. In the place of range and
bearing, GPS or a compass (the README has a camera that sees landmarks by their bearing alone):

```python
import dataclasses
import jax
from jaxlocmap import Block, Sensor, simulation
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.monte_carlo import monte_carlo

GPS = Sensor(Block("gps", ("east", "north"), ("m", "m")), lambda state, _: state[:2], landmarks=False)
COMPASS = Sensor(Block("compass", ("heading",), ("rad",)), lambda state, _: state[2:3], angles=(0,), landmarks=False)

for sensor, std in ((GPS, 0.3), (COMPASS, 0.05)):
    noise = simulation.Noise(blocks={sensor.noise.name: std})
    robot = dataclasses.replace(simulation.LOOP.robot, sensor=sensor)
    scenario = dataclasses.replace(simulation.LOOP, robot=robot)
    config = scenario.config(motion="euler", gate_probability=None, grid=False)
    scene = (simulation.own_params(noise, scenario), simulation.room(), noise, scenario.prior())
    report = summarise(monte_carlo(Study(scenario, config), jax.random.key(0), 60, *scene).value, config)
    print(sensor.noise.name, report["anees"], report["nis_mean"], report["verdict"])
```

`Params.from_std(v=0.02, w=0.05, gps=(0.3, 0.3))` makes its parameters, `tuned=("east", "north")` tunes them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, jacobians, mahalanobis, quadratic_form
from jaxlocmap._internal.trig import arctan2
from jaxlocmap.parameters import Block, R
from jaxlocmap.se2 import POSE, Offset, compose, wrap

CENTRE: Offset = (0.0, 0.0, 0.0)

_TOUCHING = 1e-9  # m^2: closer than this, a landmark has no bearing


class Sensor(NamedTuple):
    """What a sensor measures. Functions and names, so a sensor is hashable and static under jit.

    The functions take the state with the pose of the sensor itself in the place of the robot's (`Config.sensor_offset`)
    and the position of a landmark, None where `landmarks` is False.
    """

    noise: Block  # the covariance of an observation: its components are those of z, m of them
    expected: Callable[..., Any]  # (state (n,), landmark (2,) m) -> z (m,); angles need not be wrapped
    jacobian: Callable[..., Any] | None = None  # same arguments -> (m, 3) by the pose or (m, n); None: by autodiff
    defined: Callable[..., Any] | None = None  # same arguments -> () bool: there is such an observation; None: always
    angles: tuple[int, ...] = ()  # entries of z that are angles
    positive: tuple[int, ...] = ()  # entries of z that are above zero, such as a range
    landmarks: bool = True  # it observes landmarks; False: the state alone, as GPS and compass do

    @property
    def dim(self) -> int:
        """The length m of an observation."""
        return len(self.noise.components)

    def residual(self, z: jax.Array, expected: jax.Array) -> jax.Array:
        """Z minus what is expected, (m,), angles wrapped."""
        return jnp.stack(
            [wrap(z[i] - expected[i]) if i in self.angles else z[i] - expected[i] for i in range(self.dim)]
        )

    def is_measurement(self, z: jax.Array) -> jax.Array:
        """Whether z (m,) can have been measured: () bool, finite, and above zero where it must be."""
        possible = jnp.isfinite(sum(z[i] for i in range(self.dim)))
        for i in self.positive:
            possible = possible & (z[i] > 0)
        return possible


def _to_landmark(state: jax.Array, landmark: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """dx, dy, dx² + dy² to the landmark and whether it has a bearing; if not, those of one a metre ahead along x: sqrt
    and atan2 at 0 have NaN gradients even where they are not chosen.
    """
    dx, dy = landmark[0] - state[0], landmark[1] - state[1]
    q = dx * dx + dy * dy
    defined = q > _TOUCHING
    return jnp.where(defined, dx, 1.0), jnp.where(defined, dy, 0.0), jnp.where(defined, q, 1.0), defined


def _expected_range_bearing(state: jax.Array, landmark: jax.Array) -> jax.Array:
    dx, dy, q, _ = _to_landmark(state, landmark)
    return jnp.stack([jnp.sqrt(q), arctan2(dy, dx) - state[2]])


def _range_bearing_jacobian(state: jax.Array, landmark: jax.Array) -> Matrix:
    dx, dy, q, _ = _to_landmark(state, landmark)
    r = jnp.sqrt(q)
    return Matrix([[-dx / r, -dy / r, 0], [dy / q, -dx / q, -1]])


RANGE_BEARING = Sensor(
    noise=R,
    expected=_expected_range_bearing,
    jacobian=_range_bearing_jacobian,
    defined=lambda state, landmark: _to_landmark(state, landmark)[3],
    angles=(1,),
    positive=(0,),
)
"""Range and bearing of landmarks, not defined where a landmark lies on the sensor (Thrun, Burgard & Fox 2005,
section 6.6)."""

SENSORS = {"range_bearing": RANGE_BEARING}


def resolve(sensor: str | Sensor) -> Sensor:
    """The sensor of that name; a sensor passes through.

    Raises:
        ValueError: an unknown name.
    """
    return sensor if isinstance(sensor, Sensor) else checks.named("sensor", sensor, SENSORS, "a Sensor")


def observe(
    state: jax.Array, landmark: jax.Array | None, *, sensor: Sensor = RANGE_BEARING, offset: Offset = CENTRE
) -> jax.Array:
    """What a sensor expects to measure.

        z = h(state with the pose of the sensor, landmark),  of `RANGE_BEARING`
        [ |l - s|,  atan2(l_y - s_y, l_x - s_x) - theta - dtheta ],  s the sensor's position

    Args:
        state: (n,), beginning with the pose in m, m, rad.
        landmark: (2,) m, world frame; None if the sensor observes none.
        sensor: static.
        offset: (dx, dy, dtheta) m, m, rad of the sensor in the body frame; static.

    Returns:
        (m,) in the units of the sensor's noise, angles wrapped.

    Raises:
        ValueError: a wrong shape.
    """
    at_sensor, _ = mounted(state, landmark, sensor, offset)
    z = sensor.expected(at_sensor, landmark)
    return jnp.stack([wrap(z[i]) if i in sensor.angles else z[i] for i in range(sensor.dim)])


def linearise(
    state: jax.Array,
    landmark: jax.Array | None,
    z: jax.Array,
    *,
    sensor: Sensor = RANGE_BEARING,
    offset: Offset = CENTRE,
) -> tuple[jax.Array, Matrix, jax.Array]:
    """Residual of an observation and the Jacobian of its expectation.

    Args:
        state, landmark, sensor, offset: as in `observe`.
        z: (m,) the observation.

    Returns:
        residual: (m,) z minus `observe`, angles wrapped.
        H: m x 3 or m x n `Matrix`, d observe / d state; zero beyond its columns.
        defined: () bool, False where there is no such observation, as of the bearing of a landmark on the sensor.

    Raises:
        ValueError: a wrong shape.
    """
    at_sensor, J = mounted(state, landmark, sensor, offset)
    checks.shape("z", z, (sensor.dim,))
    expected = sensor.expected(at_sensor, landmark)
    checks.shape(f"expected {sensor.noise.name}", expected, (sensor.dim,))
    if sensor.jacobian is not None:
        H = Matrix.of(sensor.jacobian(at_sensor, landmark))
    else:
        H = Matrix.of(*jacobians(lambda state: sensor.expected(state, landmark), at_sensor))
    if H.shape not in ((sensor.dim, POSE), (sensor.dim, len(state))):
        raise ValueError(f"jacobian of {sensor.noise.name}: expected {sensor.dim} x 3 or x {len(state)}, got {H.shape}")
    by_pose = Matrix(row[:POSE] for row in H.rows) @ J
    H = Matrix(front + back[POSE:] for front, back in zip(by_pose.rows, H.rows, strict=True))
    defined = jnp.array(True) if sensor.defined is None else sensor.defined(at_sensor, landmark)
    return sensor.residual(z, expected), H, defined


def associate(
    mean: jax.Array,
    cov: jax.Array,
    z: jax.Array,
    landmarks: jax.Array,
    R: jax.Array,
    *,
    sensor: Sensor = RANGE_BEARING,
    offset: Offset = CENTRE,
) -> jax.Array:
    """The landmark an anonymous observation most likely came from: the smallest Mahalanobis distance.

        argmin_j  r_jᵀ (H_j P H_jᵀ + R)⁻¹ r_j

    Args:
        mean: (n,) state.
        cov: (n, n).
        z: (m,) the observation.
        landmarks: (L, 2) m.
        R: (m, m) its covariance.
        sensor, offset: as in `observe`.

    Returns:
        () int32 row of `landmarks`. Source: Thrun, Burgard & Fox 2005, section 7.5 (there with the maximum
        likelihood; the determinant of S differs little between landmarks, and the gate uses the distance).

    Raises:
        ValueError: a wrong shape, or no landmark.
    """
    n, m = len(mean), sensor.dim
    checks.shapes(mean=(mean, (None,)), cov=(cov, (n, n)), z=(z, (m,)), landmarks=(landmarks, (None, 2)), R=(R, (m, m)))
    if not len(landmarks):
        raise ValueError("landmarks: expected at least one to choose from, got (0, 2)")
    noise = Matrix.symmetric(R)

    def distance(landmark: jax.Array) -> jax.Array:
        residual, H, defined = linearise(mean, landmark, z, sensor=sensor, offset=offset)
        S = quadratic_form(H, Matrix.symmetric(cov[: H.shape[1], : H.shape[1]])) + noise  # H is zero beyond
        d2 = mahalanobis(S, tuple(residual[i] for i in range(m)))
        return jnp.where(defined, d2, jnp.inf)

    return jnp.argmin(jax.vmap(distance)(landmarks)).astype(jnp.int32)


def mounted(state: jax.Array, landmark: Any, sensor: Sensor, offset: Offset) -> tuple[jax.Array, Matrix]:
    """The state with the sensor's pose in the place of the robot's, and the Jacobian of the one by the other."""
    if np.ndim(state) != 1 or len(state) < POSE:
        raise ValueError(f"state: expected shape (n), n of at least {POSE}, got {np.shape(state)}")
    if sensor.landmarks:
        checks.shape("landmark", landmark, (2,))
    pose, J = compose(state[:POSE], offset)
    return (pose if len(state) == POSE else jnp.concatenate([pose, state[POSE:]])), J
