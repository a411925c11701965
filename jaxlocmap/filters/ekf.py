"""Extended Kalman filter of a pose: predict, update, gate. Bare arrays in, bare arrays out; no loop.

Throughout, a pose error is truth minus estimate with the heading wrapped, and Jacobians are taken at the estimate.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import scipy.special

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, forward, ldl, sandwich, solve, stack, values
from jaxlocmap.motion import MotionModel, wrap

_LEAST_WEIGHT = 1e-6  # of an observation at a soft gate: an R of a million times its size says nothing any more


class Update(NamedTuple):
    """What a correction made of one observation of dimension m."""

    mean: jax.Array  # (3,) m, m, rad; unchanged where not accepted, unless the gate is soft
    cov: jax.Array  # (3, 3); likewise
    innovation: jax.Array  # (m,)
    S: jax.Array  # (m, m) covariance of the innovation
    nis: jax.Array  # () squared Mahalanobis distance of the innovation; NaN where S is not positive definite
    accepted: jax.Array  # () bool: below the threshold
    log_likelihood: jax.Array  # () nats, log N(innovation; 0, S)


def gate_threshold(probability: float | jax.Array | None, dimension: int) -> Any:
    """Quantile of χ² with `dimension` degrees: a good observation's distance stays below it with `probability`.

    Args:
        probability: inside (0, 1), or None for no gate. With two degrees it may also be an array, up to 1 for no gate:
            -2 log(1 - p).

    Raises:
        ValueError: a number outside (0, 1), or an array with other than two degrees.
    """
    if probability is None:
        return float("inf")
    if isinstance(probability, jax.Array):
        if dimension != 2:
            raise ValueError(f"gate probability: expected a number for {dimension} degrees, got an array")
        return -2 * jnp.log1p(-probability)
    if not 0 < probability < 1:
        raise ValueError(f"gate probability: expected a value inside (0, 1), got {probability}")
    return float(2 * scipy.special.gammaincinv(dimension / 2, probability))


def predict(
    mean: jax.Array,
    cov: jax.Array,
    control: jax.Array,
    dt: jax.Array,
    Q: jax.Array,
    *,
    motion: MotionModel,
    nominal_dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Move the belief by a control.

        x ← f(x, u, dt),   P ← F P Fᵀ + G Q Gᵀ · nominal_dt / dt

    The ratio makes Q the noise of one nominal period whatever the step length: two half steps add as much as one
    whole. At dt = 0, where G is zero, nothing is added.

    Args:
        mean: (3,) m, m, rad. cov: (3, 3). control: (2,) m/s, rad/s. dt: () s, >= 0.
        Q: (2, 2) covariance of the control over `nominal_dt` seconds.

    Returns:
        mean (3,), cov (3, 3), symmetric. Source: Thrun, Burgard & Fox 2005, section 7.4.

    Raises:
        ValueError: a wrong shape, also of what the motion model returns.
    """
    checks.shapes(mean=(mean, (3,)), cov=(cov, (3, 3)), control=(control, (2,)), dt=(dt, ()), Q=(Q, (2, 2)))
    moved, (F, G) = motion.transition(mean, control, dt), motion.jacobians(mean, control, dt)
    checks.shapes(transition=(moved, (3,)), F=(F, (3, 3)), G=(G, (3, 2)))
    F, G = Matrix.of(F), Matrix.of(G)
    ratio = jnp.where(dt > 0, nominal_dt / jnp.where(dt > 0, dt, 1), 0)
    P = sandwich(F, Matrix.symmetric(cov)) + sandwich(G, Matrix.symmetric(Q).scale(ratio))
    return moved, P.array(cov.dtype)


def update(
    mean: jax.Array,
    cov: jax.Array,
    residual: jax.Array,
    H: Matrix | jax.Array,
    R: jax.Array,
    *,
    threshold: float | jax.Array = float("inf"),
    softness: float = 0.0,
    valid: jax.Array | bool = True,
) -> Update:
    """Correct the belief by one observation of any sensor, in Joseph form, if it passes the gate.

        S = H P Hᵀ + R,  K = P Hᵀ S⁻¹,  d² = rᵀ S⁻¹ r
        if d² < threshold:  x ← x + K r,  P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    Args:
        mean: (3,) m, m, rad. cov: (3, 3).
        residual: (m,) observation minus its expectation at `mean`, angles wrapped.
        H: (m, 3) Jacobian of the expectation. R: (m, m) covariance of the observation.
        threshold: gate on d², from `gate_threshold(probability, m)`; no gate by default.
        softness: 0 for a gate that decides. Otherwise, in units of d², one that weighs: every observation corrects the
            belief, with R / w in the place of R, w = 1 / (1 + exp((d² - threshold) / softness)). Near the threshold
            the correction then changes smoothly, so that derivatives tell what the gate does.
        valid: () bool; False leaves the belief as it is.

    Returns:
        An `Update`; innovation, S, nis and log-likelihood are there whether or not the gate let it in.
        Source: Bucy & Joseph 1968, section 16; Bar-Shalom, Li & Kirubarajan 2001, section 5.4 (the gate); Chang 2014
        (R that grows with d²).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("residual", residual, (None,))
    m = len(residual)
    checks.shapes(mean=(mean, (3,)), cov=(cov, (3, 3)), H=(H, (m, 3)), R=(R, (m, m)))
    checks.shapes(threshold=(threshold, ()), valid=(valid, ()))
    r = tuple(residual[i] for i in range(m))
    P = Matrix.symmetric(cov)
    H, noise = Matrix.of(H), Matrix.symmetric(R)
    reported = corrected = _correct(P, H, noise, r)
    nis = reported.nis
    accepted = applied = jnp.logical_and(nis < threshold, valid)  # what is no number is not below, gate or none
    if softness and not (isinstance(threshold, float) and math.isinf(threshold)):
        weight = jnp.maximum(jax.nn.sigmoid((threshold - nis) / softness), _LEAST_WEIGHT)
        corrected, applied = _correct(P, H, noise.scale(1 / weight), r), jnp.logical_and(jnp.isfinite(nis), valid)
    shift = corrected.shift
    moved = mean[0] + shift[0], mean[1] + shift[1], wrap(mean[2] + shift[2])

    def chosen(new: Any, old: Any) -> list[jax.Array]:
        return [jnp.where(applied, x, y) for x, y in zip(new, old, strict=True)]

    return Update(
        mean=stack(chosen(moved, mean)),
        cov=stack([chosen(new, old) for new, old in zip(corrected.cov, P.rows, strict=True)]),
        innovation=residual,
        S=Matrix(reported.S).array(cov.dtype),
        nis=nis,
        accepted=accepted,
        log_likelihood=reported.log_likelihood,
    )


class _Corrected(NamedTuple):
    """What an observation makes of a belief, before the gate is asked."""

    shift: tuple[Any, ...]  # of the mean
    cov: tuple[tuple[Any, ...], ...]  # rows
    S: tuple[tuple[Any, ...], ...]  # rows
    nis: Any
    log_likelihood: Any


def _correct(P: Matrix, H: Matrix, R: Matrix, r: tuple[Any, ...]) -> _Corrected:
    """The correction of `update`, with derivatives written by hand.

    With e = S⁻¹ r and A = I - K H,

        dS = H dP Hᵀ + dH P Hᵀ + (dH P Hᵀ)ᵀ + dR
        d(K r) = dP Hᵀ e + P dHᵀ e + K (dr - dS e)
        dP⁺ = A dP Aᵀ + K dR Kᵀ - K dH P Aᵀ - (K dH P Aᵀ)ᵀ
        d(d²) = 2 eᵀ dr - eᵀ dS e,   d log|S| = tr(S⁻¹ dS)

    There is no dK: the Joseph form is smallest at the gain it is taken at, so to first order it does not change with
    it. That, and no derivative of a division, is what makes this cheaper than differentiating the code. Source: Gupta
    & Mehra 1974.
    """
    m, (entries, rebuild) = len(r), values((P.rows, H.rows, R.rows, r))

    def gain(P: Matrix, H: Matrix, R: Matrix) -> tuple[Matrix, Matrix, tuple[Any, ...], Matrix, Matrix]:
        S = sandwich(H, P) + R
        L, D = ldl(S)
        K = Matrix(solve(L, D, row) for row in (P @ H.T).rows)  # S is symmetric: row i of K solves S k = (P Hᵀ)_i
        return S, L, D, K, Matrix.identity(len(P.rows)) - K @ H

    @jax.custom_jvp
    def correct(entries: list[Any]) -> _Corrected:
        P, H, R, r = matrices(rebuild(entries))
        S, L, D, K, A = gain(P, H, R)
        definite = functools.reduce(jnp.logical_and, [(d > 0) & (d < jnp.inf) for d in D])
        distance: Any = sum(y * y / d for y, d in zip(forward(L, r), D, strict=True))
        nis = jnp.where(definite, distance, jnp.nan)
        log_det = sum(jnp.log(d) for d in D)
        return _Corrected(
            shift=column(K @ Matrix([x] for x in r)),
            cov=(sandwich(A, P) + sandwich(K, R)).rows,
            S=S.rows,
            nis=nis,
            log_likelihood=-0.5 * (nis + log_det + m * math.log(2 * math.pi)),
        )

    @correct.defjvp
    def _(primals: Any, tangents: Any) -> tuple[_Corrected, _Corrected]:
        P, H, R, r = matrices(rebuild(*primals))
        dP, dH, dR, dr = matrices(rebuild(*tangents, structure=0))
        _, L, D, K, A = gain(P, H, R)
        e = solve(L, D, r)
        E = Matrix([x] for x in e)
        through_H = dH @ (P @ H.T)
        dS = sandwich(H, dP) + through_H + through_H.T + dR
        pull = column(dS @ E)
        through_A = K @ dH @ (P @ A.T)
        d_nis = sum(x * (2 * y - z) for x, y, z in zip(e, dr, pull, strict=True))
        d_log_det = sum(solve(L, D, dS.T.rows[i])[i] for i in range(m))
        d_shift = dP @ (H.T @ E) + P @ (dH.T @ E) + K @ Matrix([y - z] for y, z in zip(dr, pull, strict=True))
        d_cov = sandwich(A, dP) + sandwich(K, dR) - through_A - through_A.T
        tangent = _Corrected(column(d_shift), d_cov.rows, dS.rows, d_nis, -0.5 * (d_nis + d_log_det))
        return correct(*primals), tangent

    def matrices(rows: Any) -> tuple[Matrix, Matrix, Matrix, tuple[Any, ...]]:
        P, H, R, r = rows
        return Matrix(P), Matrix(H), Matrix(R), r

    def column(matrix: Matrix) -> tuple[Any, ...]:
        return tuple(row[0] for row in matrix.rows)

    return correct(entries)
