"""Motion models: a transition and its Jacobians. Those of a differential drive are here.

A pose is (x, y, theta), a control (v, omega) in the body frame. To bring your own model, of any state that begins with
a pose, write the transition and call `from_transition`. Here the state has the bias of a gyro, which wanders: its drift
is an input that nobody measures, with noise in a block of its own. The simulated robot has the same bias, so the study
shows what it costs to ignore it:

```python
import dataclasses
import jax
import jax.numpy as jnp
from jaxlocmap import Block, motion, parameters, simulation
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.monte_carlo import monte_carlo

DRIFT = Block("gyro", ("drift",), ("rad/s²",))


def transition(state, u, dt):  # x, y, theta, bias; v, omega as the gyro says, drift of the bias
    pose = motion.ARC.transition(state[:3], jnp.stack([u[0], u[1] - state[3]]), dt)
    return jnp.append(pose, state[3] + u[2] * dt)


GYRO = motion.from_transition(transition, dim=4, noise=(parameters.Q, DRIFT))
loop, noise = simulation.LOOP, simulation.Noise(w=0.05, blocks={"gyro": 0.02})
scenario = dataclasses.replace(loop, plant=GYRO, start=(*loop.start, 0.0), prior_std=(*loop.prior_std, 0.05))
for model in (GYRO, motion.ARC):
    config = scenario.config(motion=model, gate_probability=None, grid=False)
    scene = (simulation.own_params(noise, scenario), simulation.room(), noise, scenario.prior())
    report = summarise(monte_carlo(Study(scenario, config), jax.random.key(0), 60, *scene).value, config)
    print(report["anees"], report["anees_band_95"], report["verdict"])
```

`tuned=("drift",)` tunes how far the bias wanders. States of up to 12 entries are unrolled, larger ones take matrix
products.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, jacobians
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.parameters import Block, Q
from jaxlocmap.se2 import HEADING, POSE, wrap


class MotionModel(NamedTuple):
    """How a control moves a state whose first three entries are the robot's pose. Functions and names, so a model is
    hashable and static under jit.

    Noise enters as an error of the input u: the control, followed by as many zeros as the blocks of `noise` have
    components more. Those are what drives the rest of the state and nobody measures, such as the rate of a drifting
    bias. The models of this module raise ValueError for anything but one pose, control and step length; a batch is a
    `vmap`.
    """

    transition: Callable[..., Any]  # (state (n,), u (q,), dt () s) -> state (n,), angles wrapped
    jacobians: Callable[..., Any]  # same arguments -> F = df/dstate (n, n), G = df/du (n, q)
    dim: int = POSE  # n
    angles: tuple[int, ...] = HEADING  # entries of the state that are angles
    noise: tuple[Block, ...] = (Q,)  # of u over one nominal period, q components in all

    @property
    def inputs(self) -> int:
        """The length q of u."""
        return sum(len(block.components) for block in self.noise)

    def full_input(self, control: jax.Array, name: str = "control") -> jax.Array:
        """The control, followed by zeros: u (q,).

        Raises:
            ValueError: a control that ends within a block of the noise, or has more entries than all of them.
        """
        ends = list(itertools.accumulate(len(block.components) for block in self.noise))
        if np.ndim(control) != 1 or len(control) not in ends:
            wanted = " or ".join(f"({end})" for end in ends)
            raise ValueError(f"{name}: expected shape {wanted}, got {np.shape(control)}")
        rest = self.inputs - len(control)
        return jnp.concatenate([control, jnp.zeros(rest, control.dtype)]) if rest else control


def _sinc(h: jax.Array) -> tuple[jax.Array, jax.Array]:
    """sin(h)/h and its derivative: series near zero, where the closed form of the derivative cancels."""
    small = jnp.abs(h) < 0.25
    safe = jnp.where(small, 1.0, h)
    sin, cos = sin_cos(safe)
    s = sin / safe
    q = h * h
    value = 1 - q / 6 * (1 - q / 20 * (1 - q / 42 * (1 - q / 72 * (1 - q / 110))))
    slope = -h / 3 * (1 - q / 10 * (1 - q / 28 * (1 - q / 54 * (1 - q / 88))))
    return jnp.where(small, value, s), jnp.where(small, slope, (cos - s) / safe)


def _moved(pose: jax.Array, dx: jax.Array, dy: jax.Array, turn: jax.Array) -> jax.Array:
    return jnp.stack([pose[0] + dx, pose[1] + dy, wrap(pose[2] + turn)])


def _check(pose: jax.Array, control: jax.Array, dt: jax.Array) -> None:
    checks.shapes(pose=(pose, (3,)), control=(control, (2,)), dt=(dt, ()))


def _euler_transition(pose: jax.Array, control: jax.Array, dt: jax.Array) -> jax.Array:
    _check(pose, control, dt)
    step, (sin, cos) = control[0] * dt, sin_cos(pose[2])
    return _moved(pose, step * cos, step * sin, control[1] * dt)


def _euler_jacobians(pose: jax.Array, control: jax.Array, dt: jax.Array) -> tuple[Matrix, Matrix]:
    _check(pose, control, dt)
    s, c = sin_cos(pose[2])
    step = control[0] * dt
    F = Matrix([[1, 0, -step * s], [0, 1, step * c], [0, 0, 1]])
    G = Matrix([[c * dt, 0], [s * dt, 0], [0, dt]])
    return F, G


def _arc_transition(pose: jax.Array, control: jax.Array, dt: jax.Array) -> jax.Array:
    _check(pose, control, dt)
    half = 0.5 * control[1] * dt
    chord = control[0] * dt * _sinc(half)[0]
    sin, cos = sin_cos(pose[2] + half)
    return _moved(pose, chord * cos, chord * sin, control[1] * dt)


def _arc_jacobians(pose: jax.Array, control: jax.Array, dt: jax.Array) -> tuple[Matrix, Matrix]:
    _check(pose, control, dt)
    v, half = control[0], 0.5 * control[1] * dt
    s, slope = _sinc(half)
    sin, cos = sin_cos(pose[2] + half)
    chord = v * dt * s
    F = Matrix([[1, 0, -chord * sin], [0, 1, chord * cos], [0, 0, 1]])
    lever = 0.5 * v * dt * dt
    G = Matrix(
        [
            [s * dt * cos, lever * (slope * cos - s * sin)],
            [s * dt * sin, lever * (slope * sin + s * cos)],
            [0, dt],
        ]
    )
    return F, G


EULER = MotionModel(_euler_transition, _euler_jacobians)
"""First order: x + v cos(theta) dt, y + v sin(theta) dt, theta + omega dt (Thrun, Burgard & Fox 2005, section 5.4)."""

ARC = MotionModel(_arc_transition, _arc_jacobians)
"""Constant (v, omega) over the step: the exact arc, written as its chord v dt sinc(omega dt / 2) in the direction
theta + omega dt / 2, which needs no branch at omega = 0. Exact Jacobians. The default."""

CAPSTONE = MotionModel(_arc_transition, _euler_jacobians)
"""The mean on the exact arc, the covariance with first-order Jacobians: a common mixture, kept for comparison."""

ODOMETRY_NOISE = Block("odometry", ("x", "y", "theta"), ("m", "m", "rad"))  # that builds up over a metre of travel
_TURN, _LEAST = 0.5, 0.05  # m a radian, m: what a turn counts beside travel, and a step at least


def _odometry_path(control: jax.Array) -> jax.Array:
    """m, square root of what the noise grows with."""
    return (control[0] ** 2 + control[1] ** 2 + (_TURN * control[2]) ** 2 + _LEAST**2) ** 0.25


def _check_odometry(pose: jax.Array, control: jax.Array, dt: jax.Array) -> None:
    checks.shapes(pose=(pose, (3,)), control=(control, (3,)), dt=(dt, ()))


def _odometry_transition(pose: jax.Array, control: jax.Array, dt: jax.Array) -> jax.Array:
    _check_odometry(pose, control, dt)
    sin, cos = sin_cos(pose[2])
    return _moved(pose, cos * control[0] - sin * control[1], sin * control[0] + cos * control[1], wrap(control[2]))


def _odometry_jacobians(pose: jax.Array, control: jax.Array, dt: jax.Array) -> tuple[Matrix, Matrix]:
    _check_odometry(pose, control, dt)
    s, c = sin_cos(pose[2])
    F = Matrix([[1, 0, -s * control[0] - c * control[1]], [0, 1, c * control[0] - s * control[1]], [0, 0, 1]])
    k = _odometry_path(control)
    return F, Matrix([[k * c, -k * s, 0], [k * s, k * c, 0], [0, 0, k]])


ODOMETRY = MotionModel(_odometry_transition, _odometry_jacobians, noise=(ODOMETRY_NOISE,))
"""What the wheels say between two steps: the control is the displacement (dx, dy, dtheta) in the frame of the pose
before, and its variance grows with the way, √(dx² + dy² + (0.5 m dtheta)²), at least 5 cm. Time plays no part: let
every step last a nominal period. After Thrun, Burgard & Fox 2005, section 5.4."""

MODELS = {"euler": EULER, "arc": ARC, "capstone": CAPSTONE, "odometry": ODOMETRY}


def from_transition(
    transition: Callable[..., jax.Array],
    *,
    dim: int = POSE,
    angles: tuple[int, ...] = HEADING,
    noise: tuple[Block, ...] = (Q,),
) -> MotionModel:
    """A model from its transition alone; the Jacobians come from forward-mode differentiation.

    Args:
        transition: `(state (n,), u (q,), dt () s) -> state (n,)`, differentiable, angles wrapped with `se2.wrap`; the
            first three entries of the state are the pose in m, m, rad. Make the model once and keep it: a new one is
            a new program to compile.
        dim: n.
        angles: entries of the state that are angles; the heading, 2, is one.
        noise: the blocks of `Params` that u = (v, omega, ...) has the noise of, q components in all.

    Returns:
        A model that raises ValueError where an argument, or what the transition makes of them, is of another shape.

    Raises:
        ValueError: a state without a pose, or angles that are none of its entries.
    """
    if dim < POSE or not set(HEADING) <= set(angles) <= set(range(dim)):
        raise ValueError(f"dim, angles: expected a pose, its heading {HEADING[0]} an angle, got {dim} and {angles}")
    inputs = sum(len(block.components) for block in noise)

    def checked(state: jax.Array, u: jax.Array, dt: jax.Array) -> jax.Array:
        checks.shapes(state=(state, (dim,)), u=(u, (inputs,)), dt=(dt, ()))
        moved = transition(state, u, dt)
        checks.shape("transition(state, u, dt)", moved, (dim,))
        return moved

    def by_state_and_input(state: jax.Array, u: jax.Array, dt: jax.Array) -> list[Any]:
        return jacobians(lambda state, u: checked(state, u, dt), state, u)

    return MotionModel(checked, by_state_and_input, dim, tuple(angles), tuple(noise))


def resolve(model: str | MotionModel) -> MotionModel:
    """The model of that name; a model passes through.

    Raises:
        ValueError: an unknown name.
    """
    return model if isinstance(model, MotionModel) else checks.named("motion", model, MODELS, "a MotionModel")


def from_wheels(left: jax.Array, right: jax.Array, wheel_base: float, *, gyro: jax.Array | None = None) -> jax.Array:
    """Control of a differential drive: v = (right + left) / 2, omega = (right - left) / wheel_base.

    Args:
        left, right: speed of each wheel over the ground, m/s, any shape.
        wheel_base: distance between the wheels, m, > 0.
        gyro: measured yaw rate, rad/s, any shape that broadcasts; takes the place of the wheels' own, which slip
            spoils first.

    Returns:
        (..., 2) v m/s, omega rad/s. Source: Siegwart, Nourbakhsh & Scaramuzza 2011, section 3.2.

    Raises:
        ValueError: `wheel_base` not positive.
    """
    _require_base(wheel_base)
    omega = (right - left) / wheel_base if gyro is None else gyro
    return jnp.stack(jnp.broadcast_arrays((right + left) / 2, omega), axis=-1)


def to_wheels(control: jax.Array, wheel_base: float) -> tuple[jax.Array, jax.Array]:
    """Wheel speeds (left, right), m/s, of a control (..., 2): v ∓ omega wheel_base / 2. Inverse of `from_wheels`.

    Raises:
        ValueError: `wheel_base` not positive, or a last axis that is not (v, omega).
    """
    _require_base(wheel_base)
    if control.shape[-1:] != (2,):
        raise ValueError(f"control: expected shape (..., 2), got {control.shape}")
    v, swing = control[..., 0], control[..., 1] * (wheel_base / 2)
    return v - swing, v + swing


def _require_base(wheel_base: float) -> None:
    if not wheel_base > 0:
        raise ValueError(f"wheel_base: expected metres > 0, got {wheel_base}")
