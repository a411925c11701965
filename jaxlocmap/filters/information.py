"""Correction by what is known as information, which may be singular: nothing is known of some directions."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, inverse, mirrored
from jaxlocmap.se2 import HEADING, wrap_entries


def update(
    mean: jax.Array,
    cov: jax.Array,
    H: jax.Array,
    information: jax.Array,
    gradient: jax.Array,
    *,
    angles: tuple[int, ...] = HEADING,
    poses: tuple[int, ...] = (),
) -> tuple[jax.Array, jax.Array]:
    """Correct the belief by the log density of something observed of y = h(x), a quadratic about its expectation:

        log p = gᵀ (y - h(mean)) - (y - h(mean))ᵀ Λ (y - h(mean)) / 2
        M = (I + Λ H P Hᵀ)⁻¹,  K = P Hᵀ M Λ
        x ← x + P Hᵀ M g,  P ← (I - K H) P (I - K H)ᵀ + P Hᵀ M Λ Mᵀ H P

    An observation z of y with covariance R is Λ = R⁻¹ and g = Λ (z - h(mean)). Λ is not inverted. The last line is
    Joseph's form: it stays positive semi-definite whatever the rounding of M.

    Args:
        mean: (n,) state.
        cov: (n, n).
        H: (3, n) Jacobian of h at the mean.
        information: (3, 3) Λ, positive semi-definite.
        gradient: (3,) g.
        angles: entries of the state that are angles, static.
        poses: entries at which poses in the world begin, static: those that h observes relative to each other. Their
            errors are taken for motions of the world about its origin, so that their covariance at the new mean is
            another. A turn of the whole world, of which h tells nothing, then stays unknown however often h is
            observed at means that differ.

    Returns:
        mean (n,), cov (n, n), symmetric. Source: Maybeck 1979, section 5.7 (the information form); Barrau & Bonnabel
        2017 (errors as motions of the world).

    Raises:
        ValueError: a wrong shape.
    """
    n = len(mean)
    checks.shapes(cov=(cov, (n, n)), H=(H, (3, n)), information=(information, (3, 3)), gradient=(gradient, (3,)))
    PH = cov @ H.T
    M = inverse(Matrix.identity(3) + Matrix.symmetric(information) @ Matrix.symmetric(H @ PH)).array(cov.dtype)
    C = PH @ M
    K = C @ information
    rest = K @ PH.T
    cov = cov - rest - rest.T + K @ (H @ PH) @ K.T + C @ information @ C.T
    shift = C @ gradient
    T = jnp.eye(n, dtype=cov.dtype)
    for i in poses:
        T = T.at[i, i + 2].set(-shift[i + 1]).at[i + 1, i + 2].set(shift[i])
    if poses:
        cov = T @ cov @ T.T
    return wrap_entries(mean + shift, angles), mirrored(cov)
