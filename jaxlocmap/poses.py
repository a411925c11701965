"""Poses of whole trajectories, in float64 NumPy: what `se2` is for one pose inside a filter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def compose(poses: np.ndarray, others: np.ndarray | Sequence[float]) -> np.ndarray:
    """Poses in the frames of `poses`, moved into the frame that those are in: p + R(theta) d, theta + dtheta.

    Args:
        poses: (..., 3) m, m, rad.
        others: (..., 3) or (3,), the same for all.

    Returns:
        (..., 3), the heading not wrapped.
    """
    x, y, theta = np.moveaxis(poses, -1, 0)
    dx, dy, turn = np.moveaxis(np.asarray(others), -1, 0)
    sin, cos = np.sin(theta), np.cos(theta)
    return np.stack([x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + turn], axis=-1)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Poses b in the frames of poses a, (..., 3) each: m, m, rad, the heading wrapped."""
    x, y, turn = np.moveaxis(b - a, -1, 0)
    cos, sin = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([cos * x + sin * y, cos * y - sin * x, wrapped(turn)], axis=-1)
