"""One scan against a map of lines: the pose it fits best, given where the robot is believed to be."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, inverse, stack_scalars
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points
from jaxlocmap.se2 import POSE, boxminus
from jaxlocmap.types import GridSpec

_SEARCH_POINTS = 60  # of a scan, evenly spread, that a search over a window looks at


class Match(NamedTuple):
    """What one scan says of the robot's pose in the frame of the map."""

    pose: jax.Array  # (3,) m, m, rad: the most probable one, given the scan and the belief before
    information: jax.Array  # (3, 3) 1/m^2, 1/m^2, 1/rad^2 on the diagonal: of the scan alone, not of the belief
    score: jax.Array  # (3,) 1/m, 1/m, 1/rad: derivative of the scan's log density there; the belief's is its opposite
    points: jax.Array  # () int32, points of the scan that have a normal
    used: jax.Array  # () int32, those of them that lie on a line of the map


def match(
    lines: jax.Array,
    mean: jax.Array,
    cov: jax.Array,
    points: Points,
    std: jax.Array,
    scale: jax.Array,
    *,
    spec: GridSpec,
    steps: int = 10,
    at: int | jax.Array = 0,
    start: jax.Array | None = None,
) -> Match:
    """The pose that maximises the density of scan and belief together, by Gauss-Newton steps:

        min  Σ w r² / std² + |ξ - mean|² in cov⁻¹
        ξ ← ξ - (I + P Λ)⁻¹ (P Σ w J r / std² + ξ - mean),  Λ = Σ w Jᵀ J / std²

    Nothing is inverted that may be singular: neither P, which is zero where the pose is known, nor Λ, which is singular
    in a corridor. There the pose stays along the corridor where the belief has it.

    Args:
        lines, points, scale, spec, at: as of `lines.fit`.
        mean: (3,) m, m, rad, the pose in the map's frame that is believed.
        cov: (3, 3) its covariance.
        std: () m, of a point about its line.
        steps: how many, static.
        start: (3,) where to begin; the mean by default (`search`).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(mean=(mean, (POSE,)), cov=(cov, (POSE, POSE)), std=(std, ()))
    P, information = Matrix.symmetric(cov), 1 / std**2

    def step(pose: jax.Array, _: None) -> tuple[jax.Array, None]:
        found = line_grid.fit(lines, pose, points, scale, spec=spec, at=at)
        back = boxminus(pose, mean)
        gain = inverse(Matrix.identity(POSE) + P @ Matrix.symmetric(found.hessian * information))
        pull = P @ Matrix([[x * information] for x in found.slope]) + Matrix([[x] for x in back])
        return pose - stack_scalars([x for (x,) in (gain @ pull).rows]), None

    pose, _ = jax.lax.scan(step, mean if start is None else start, length=steps)
    found = line_grid.fit(lines, pose, points, scale, spec=spec, at=at)
    return Match(
        pose=pose,
        information=found.hessian * information,
        score=-found.slope * information,
        points=jnp.sum(points.valid, dtype=jnp.int32),
        used=jnp.sum(found.used, dtype=jnp.int32),
    )
