"""The correction of a Kalman filter in Joseph form, with derivatives written by hand."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap._internal.linalg import Matrix, forward, ldl, mirrored, quadratic_form, solve, values


class Corrected(NamedTuple):
    """What an observation makes of a belief, before the gate is asked."""

    shift: tuple[Any, ...]  # of the mean
    cov: tuple[tuple[Any, ...], ...]  # rows
    S: tuple[tuple[Any, ...], ...]  # rows
    nis: Any
    log_likelihood: Any


def correct(P: Matrix, H: Matrix, R: Matrix, r: tuple[Any, ...]) -> Corrected:
    """The correction of `ekf.update`, of a state of dimension n by an observation of dimension m.

        S = H P Hᵀ + R,  K = P Hᵀ S⁻¹,  P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ

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
        S = quadratic_form(H, P) + R
        L, D = ldl(S)
        K = Matrix(solve(L, D, row) for row in (P @ H.T).rows)  # S is symmetric: row i of K solves S k = (P Hᵀ)_i
        return S, L, D, K, Matrix.identity(len(P.rows)) - K @ H

    @jax.custom_jvp
    def corrected(entries: list[Any]) -> Corrected:
        P, H, R, r = matrices(rebuild(entries))
        S, L, D, K, A = gain(P, H, R)
        definite = functools.reduce(jnp.logical_and, [(d > 0) & (d < jnp.inf) for d in D])
        distance: Any = sum(y * y / d for y, d in zip(forward(L, r), D, strict=True))
        nis = jnp.where(definite, distance, jnp.nan)
        log_det = sum(jnp.log(d) for d in D)
        return Corrected(
            shift=column(K @ Matrix([x] for x in r)),
            cov=(quadratic_form(A, P) + quadratic_form(K, R)).rows,
            S=S.rows,
            nis=nis,
            log_likelihood=-0.5 * (nis + log_det + m * math.log(2 * math.pi)),
        )

    @corrected.defjvp
    def _(primals: Any, tangents: Any) -> tuple[Corrected, Corrected]:
        P, H, R, r = matrices(rebuild(*primals))
        dP, dH, dR, dr = matrices(rebuild(*tangents, structure=0))
        _, L, D, K, A = gain(P, H, R)
        e = solve(L, D, r)
        E = Matrix([x] for x in e)
        through_H = dH @ (P @ H.T)
        dS = quadratic_form(H, dP) + through_H + through_H.T + dR
        pull = column(dS @ E)
        through_A = K @ dH @ (P @ A.T)
        d_nis = sum(x * (2 * y - z) for x, y, z in zip(e, dr, pull, strict=True))
        d_log_det = sum(solve(L, D, dS.T.rows[i])[i] for i in range(m))
        d_shift = dP @ (H.T @ E) + P @ (dH.T @ E) + K @ Matrix([y - z] for y, z in zip(dr, pull, strict=True))
        d_cov = quadratic_form(A, dP) + quadratic_form(K, dR) - through_A - through_A.T
        tangent = Corrected(column(d_shift), d_cov.rows, dS.rows, d_nis, -0.5 * (d_nis + d_log_det))
        return corrected(*primals), tangent

    def matrices(rows: Any) -> tuple[Matrix, Matrix, Matrix, tuple[Any, ...]]:
        P, H, R, r = rows
        return Matrix(P), Matrix(H), Matrix(R), r

    def column(matrix: Matrix) -> tuple[Any, ...]:
        return tuple(row[0] for row in matrix.rows)

    return corrected(entries)


def correct_array(P: jax.Array, H: Matrix, R: Matrix, r: jax.Array) -> Corrected:
    """`correct` of a state too large to unroll: P (n, n), r (m,), derivatives as JAX takes them."""
    H_array, R_array = H.array(P.dtype), R.array(P.dtype)
    P = mirrored(P)
    cross = P @ H_array.T
    S = H_array @ cross + R_array
    L, D = ldl(Matrix.symmetric(S))
    definite = functools.reduce(jnp.logical_and, [(d > 0) & (d < jnp.inf) for d in D])
    distance: Any = sum(y * y / d for y, d in zip(forward(L, tuple(r)), D, strict=True))
    nis = jnp.where(definite, distance, jnp.nan)
    K = jnp.linalg.solve(S, cross.T).T
    A = jnp.eye(len(P), dtype=P.dtype) - K @ H_array
    cov = A @ P @ A.T + K @ R_array @ K.T
    log_det = sum(jnp.log(d) for d in D)
    log_likelihood = -0.5 * (nis + log_det + len(r) * math.log(2 * math.pi))
    return Corrected(tuple(K @ r), tuple(mirrored(cov)), Matrix.symmetric(S).rows, nis, log_likelihood)
