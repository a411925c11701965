"""How a scan fits an occupancy grid, a map of lines or another scan, and the pose at which it fits best."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap._internal.linalg import Matrix, inverse
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.mapping import grid
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points
from jaxlocmap.se2 import boxminus
from jaxlocmap.types import GridSpec

WEAK = (0.5, 0.5, 0.2)  # m, m, rad: standard deviations of a belief that leaves a match to the scan
_PAIR = 0.5  # m: points of two scans farther apart than this do not belong together
_PARALLEL = 0.8  # least cosine between their normals
_STEPS = 10  # of Gauss-Newton


class Fit(NamedTuple):
    """How the points of a scan fit at one pose. B points."""

    residual: jax.Array  # (B,) m, or as a probability
    slope: jax.Array  # (B, 3) its derivative by the pose
    weight: jax.Array  # (B,) 0 where not used

    @property
    def hessian(self) -> jax.Array:
        """Σ w Jᵀ J, (3, 3)."""
        return self.slope.T @ (self.weight[:, None] * self.slope)

    @property
    def pull(self) -> jax.Array:
        """Σ w Jᵀ r, (3,)."""
        return self.slope.T @ (self.weight * self.residual)

    @property
    def used(self) -> jax.Array:
        """() int32, points that say anything of the pose."""
        return jnp.sum((self.weight > 0) & jnp.any(self.slope != 0, axis=1), dtype=jnp.int32)


def on_occupancy(log_odds: jax.Array, pose: jax.Array, xy: jax.Array, hit: jax.Array, *, spec: GridSpec) -> Fit:
    """Residual 1 - M(q), M the probability of being occupied, read between the centres of four cells.

    Args:
        log_odds: (rows, columns) nats; read clamped.
        pose: (3,) m, m, rad.
        xy: (B, 2) m, where beams end, in the robot's frame.
        hit: (B,) bool; the others do not count.
        spec: of the grid.

    Source: Kohlbrecher, von Stryk, Meyer & Klingauf 2011, section IV.
    """
    sin, cos = sin_cos(pose[2])
    arm_x, arm_y = cos * xy[:, 0] - sin * xy[:, 1], sin * xy[:, 0] + cos * xy[:, 1]
    index, share = [], []
    for value, arm, origin, cells in ((0, arm_x, 0, spec.shape[1]), (1, arm_y, 1, spec.shape[0])):
        position = (pose[value] + arm - spec.origin[origin]) * (1 / spec.resolution) - 0.5
        whole = jnp.clip(jnp.floor(position), 0, cells - 2)
        index.append(whole.astype(jnp.int32))
        share.append(position - whole)
    (column, row), (u, v) = index, share
    inside = hit & (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    cell = [[grid.probability(grid.clamp(log_odds[row + i, column + j], spec)) for j in (0, 1)] for i in (0, 1)]
    low, high = ((1 - u) * cell[i][0] + u * cell[i][1] for i in (0, 1))
    by_x = ((1 - v) * (cell[0][1] - cell[0][0]) + v * (cell[1][1] - cell[1][0])) * (1 / spec.resolution)
    by_y = (high - low) * (1 / spec.resolution)
    slope = -jnp.stack([by_x, by_y, by_y * arm_x - by_x * arm_y], axis=1)
    return Fit(1 - ((1 - v) * low + v * high), slope, inside.astype(u.dtype))


def on_lines(lines: jax.Array, pose: jax.Array, points: Points, scale: jax.Array, *, spec: GridSpec) -> Fit:
    """Distance of each point from the line of the map at it: `matching.lines.fit`, point by point.

    Args:
        lines, pose, points, scale, spec: as there.
    """
    found = line_grid.fit(lines, pose, points, scale, spec=spec)
    at = line_grid.placed(pose, points)
    x, y = found.direction[:, 0], found.direction[:, 1]
    return Fit(found.residual, jnp.stack([x, y, y * at.arm_x - x * at.arm_y], axis=1), found.weight)


def on_scan(reference: Points, pose: jax.Array, points: Points, scale: jax.Array) -> Fit:
    """Distance of each point from the tangent at the nearest point of another scan.

    Args:
        reference: points of the other scan, in its own frame.
        pose: (3,) m, m, rad, of the robot in that frame.
        points: of the scan, in the robot's frame.
        scale: () m, of the Cauchy weight.

    Source: Censi 2008 (point to line).
    """
    x, y, n_x, n_y, arm_x, arm_y, valid = line_grid.placed(pose, points)
    apart = (x[:, None] - reference.xy[None, :, 0]) ** 2 + (y[:, None] - reference.xy[None, :, 1]) ** 2
    apart = jnp.where(reference.valid[None], apart, jnp.inf)
    nearest = jnp.argmin(apart, axis=1)
    (p_x, p_y), (m_x, m_y) = reference.xy[nearest].T, reference.normal[nearest].T
    residual = m_x * (x - p_x) + m_y * (y - p_y)
    near = jnp.min(apart, axis=1) < _PAIR**2
    used = valid & near & (jnp.abs(m_x * n_x + m_y * n_y) > _PARALLEL) & (jnp.abs(residual) < line_grid.REACH)
    residual = jnp.where(used, residual, 0)
    slope = jnp.stack([m_x, m_y, m_y * arm_x - m_x * arm_y], axis=1)
    return Fit(residual, slope, jnp.where(used, 1 / (1 + (residual / scale) ** 2), 0))


class Solution(NamedTuple):
    """Where a scan fits best, and what the scan alone says there."""

    pose: jax.Array  # (3,) m, m, rad
    fit: Fit  # there

    def shift(self, mean: jax.Array, variance: jax.Array) -> jax.Array:
        """From a pose (3,) to the one that the scan alone would choose, (3,) m, m, rad: (Λ + D)⁻¹ g with g and Λ of its
        log density. D is so weak that it matters only where the scan says nothing, as along a corridor.
        """
        told = self.fit.hessian / variance
        gradient = told @ boxminus(self.pose, mean) - self.fit.pull / variance
        weak = jnp.diag(jnp.asarray([1 / s**2 for s in WEAK], told.dtype))
        return inverse(Matrix.symmetric(told + weak)).array(told.dtype) @ gradient


def solve(fit: Callable[[jax.Array], Fit], mean: jax.Array, cov: jax.Array, std: jax.Array | float) -> Solution:
    """The pose that is the most probable, by Gauss-Newton steps of

        min  Σ w r² / std² + |ξ - mean|² in cov⁻¹

    Args:
        fit: at a pose.
        mean: (3,) m, m, rad.
        cov: (3, 3), which may be singular.
        std: () of a residual.
    """
    P = Matrix.symmetric(cov)

    def step(pose: jax.Array, _: None) -> tuple[jax.Array, None]:
        found = fit(pose)
        gain = inverse(Matrix.identity(len(mean)) + P @ Matrix.symmetric(found.hessian / std**2)).array(pose.dtype)
        return pose - gain @ (cov @ found.pull / std**2 + boxminus(pose, mean)), None

    pose, _ = jax.lax.scan(step, mean, length=_STEPS)
    return Solution(pose, fit(pose))
