"""Motion models of a differential drive: a transition and its Jacobians.

A pose is (x, y, theta), a control (v, omega) in the body frame. To bring your own model, write the transition and
call `from_transition`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap._internal.trig import sin_cos


class MotionModel(NamedTuple):
    """How a control moves a pose. Two functions, so a model is hashable and static under jit.

    Those of this module raise ValueError for anything but one pose, control and step length; a batch is a `vmap`.
    """

    transition: Callable[..., Any]  # (pose (3,), control (2,), dt) -> pose (3,), heading wrapped
    jacobians: Callable[..., Any]  # same arguments -> F = df/dpose (3, 3), G = df/dcontrol (3, 2)


def wrap(angle: jax.Array) -> jax.Array:
    """The angle in [-pi, pi), to rounding; inside, all but the last below pi come back bit for bit. Derivative 1."""
    return angle - 2 * jnp.pi * jnp.floor((angle + jnp.pi) * (0.5 / jnp.pi))


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

MODELS = {"euler": EULER, "arc": ARC, "capstone": CAPSTONE}


def from_transition(transition: Callable[..., jax.Array]) -> MotionModel:
    """A model from its transition alone; the Jacobians come from forward-mode differentiation.

    Args:
        transition: `(pose (3,) m, m, rad; control (2,) m/s, rad/s; dt () s) -> pose (3,)`, differentiable, heading
            wrapped with `motion.wrap`. Make the model once and keep it: a new one is a new program to compile.

    Returns:
        A model that raises ValueError where an argument, or what the transition makes of them, is of another shape.
    """

    def checked(pose: jax.Array, control: jax.Array, dt: jax.Array) -> jax.Array:
        _check(pose, control, dt)
        moved = transition(pose, control, dt)
        checks.shape("transition(pose, control, dt)", moved, (3,))
        return moved

    return MotionModel(checked, jax.jacfwd(checked, argnums=(0, 1)))


def resolve(model: str | MotionModel) -> MotionModel:
    """The model of that name; a model passes through.

    Raises:
        ValueError: an unknown name.
    """
    if isinstance(model, MotionModel):
        return model
    if model not in MODELS:
        raise ValueError(f"motion: expected one of {sorted(MODELS)} or a MotionModel, got {model!r}")
    return MODELS[model]


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
