"""One scan against a map of lines: the pose it fits best, given where the robot is believed to be."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, inverse, stack_scalars
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import Points
from jaxlocmap.se2 import POSE, boxminus
from jaxlocmap.types import GridSpec

_CONVERGED = 0.1  # squared length of a step, by the information of the scan, below which no more are needed
_SEARCH_POINTS = 60  # of a scan, evenly spread, that a search over a window looks at
_SEARCH_STEPS = (0.1, 0.1, 0.05)  # m, m, rad: between the poses it looks at, at most


class Match(NamedTuple):
    """What one scan says of the robot's pose in the frame of the map."""

    pose: jax.Array  # (3,) m, m, rad: the most probable one, given the scan and the belief before
    information: jax.Array  # (3, 3) 1/m^2, 1/m^2, 1/rad^2 on the diagonal: of the scan alone, not of the belief
    score: jax.Array  # (3,) 1/m, 1/m, 1/rad: derivative of the scan's log density there; the belief's is its opposite
    converged: jax.Array  # () bool: one more step would change little
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

    Derivatives go forward through the steps. They are those of what is computed, of any order, which standard errors
    need. The implicit derivative at the optimum takes a little less time, but it is that of steps that have converged
    to the last digit, and its second one is another.

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

    def fit(pose: jax.Array) -> tuple[line_grid.Fit, jax.Array]:
        """How the scan fits at a pose, and the step from there."""
        found = line_grid.fit(lines, pose, points, scale, spec=spec, at=at)
        back = boxminus(pose, mean)
        gain = inverse(Matrix.identity(POSE) + P @ Matrix.symmetric(found.hessian * information))
        pull = P @ Matrix([[x * information] for x in found.slope]) + Matrix([[x] for x in back])
        return found, -stack_scalars([x for (x,) in (gain @ pull).rows])

    pose, _ = jax.lax.scan(lambda pose, _: (pose + fit(pose)[1], None), mean if start is None else start, length=steps)
    found, left = fit(pose)
    Lambda = found.hessian * information
    return Match(
        pose=pose,
        information=Lambda,
        score=-found.slope * information,
        converged=left @ Lambda @ left < _CONVERGED,
        points=jnp.sum(points.valid, dtype=jnp.int32),
        used=jnp.sum(found.used, dtype=jnp.int32),
    )


def search(
    lines: jax.Array,
    mean: jax.Array,
    cov: jax.Array,
    points: Points,
    scale: jax.Array,
    *,
    spec: GridSpec,
    window: tuple[float, float],
    at: int | jax.Array = 0,
) -> jax.Array:
    """Where to begin a match that may be farther off than `lines.REACH`: the best of many poses about the mean.

    A pose's score is twice the number of points that lie on lines there, each by its weight in `lines.fit` but read
    from the nearest cell alone, less half the squared distance from the mean in standard deviations. The poses reach
    three of these to either side, or as far as the window.

    Args:
        lines, mean, cov, points, scale, spec, at: as of `match`.
        window: m, rad: how far to either side at most, static.

    Returns:
        (3,), of derivative zero. Source: Olson 2009 (correlative matching).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(mean=(mean, (POSE,)), cov=(cov, (POSE, POSE)), scale=(scale, ()))
    every = -(-len(points.xy) // _SEARCH_POINTS)
    points = jax.tree.map(lambda x: x[::every], points)
    sigma = jnp.sqrt(jnp.maximum(jnp.diagonal(cov), jnp.finfo(cov.dtype).tiny))
    widest = (window[0], window[0], window[1])
    reach = jnp.minimum(3 * sigma, jnp.asarray(widest, cov.dtype))
    counts = [2 * math.ceil(width / step - 1e-9) + 1 for width, step in zip(widest, _SEARCH_STEPS, strict=True)]
    steps = [jnp.linspace(-1, 1, count, dtype=cov.dtype) * reach[i] for i, count in enumerate(counts)]
    shifts = jnp.stack([shift.ravel() for shift in jnp.meshgrid(steps[0], steps[1], indexing="ij")], axis=-1)

    def turned(turn: jax.Array) -> jax.Array:
        """The score of every shift at one heading."""
        heading = jnp.zeros(POSE, mean.dtype).at[2].set(mean[2] + turn)
        placed = line_grid.placed(heading, points)
        score = jax.vmap(lambda shift: line_grid.overlap(lines, mean[:2] + shift, placed, scale, spec=spec, at=at))(
            shifts
        )
        away = jnp.sum((shifts / sigma[None, :2]) ** 2, axis=-1) + (turn / sigma[2]) ** 2
        return 2 * score - away / 2

    scores = jax.lax.map(turned, steps[2])
    best = jnp.argmax(scores.ravel())
    shift, turn = shifts[best % len(shifts)], steps[2][best // len(shifts)]
    return jax.lax.stop_gradient(mean + jnp.concatenate([shift, turn[None]]))
