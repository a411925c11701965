"""Extended Kalman filter of a state that begins with a pose: predict, update, gate. Bare arrays in, bare arrays out; no
loop.

Throughout, an error is truth minus estimate with angles wrapped, and Jacobians are taken at the estimate.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import scipy.special

from jaxlocmap import checks
from jaxlocmap._internal.linalg import SMALL, Matrix, mirrored, quadratic_form, stack_scalars
from jaxlocmap.filters import joseph
from jaxlocmap.motion import MotionModel
from jaxlocmap.se2 import HEADING, wrap

_LEAST_WEIGHT = 1e-6  # of an observation at a soft gate: an R of a million times its size says nothing any more


class Update(NamedTuple):
    """What a correction made of one observation of dimension m."""

    mean: jax.Array  # (n,); unchanged where not accepted, unless the gate is soft
    cov: jax.Array  # (n, n); likewise
    innovation: jax.Array  # (m,)
    S: jax.Array  # (m, m) covariance of the innovation
    nis: jax.Array  # () squared Mahalanobis distance of the innovation; NaN where S is not positive definite
    accepted: jax.Array  # () bool: below the threshold
    log_likelihood: jax.Array  # () nats, log N(innovation; 0, S)


def gate_threshold(probability: float | jax.Array | None, dimension: int) -> Any:
    """Quantile of χ² with `dimension` degrees: a good observation's distance stays below it with `probability`.

    Args:
        probability: inside (0, 1), or None for no gate. An array, also a traced one, may be 1 for no gate.
        dimension: degrees of freedom.

    Returns:
        A float, or an array where `probability` is one.

    Raises:
        ValueError: a number outside (0, 1).
    """
    if probability is None:
        return float("inf")
    if isinstance(probability, jax.Array):
        return jnp.where(probability < 1, _chi2_quantile(probability, dimension), jnp.inf)
    if not 0 < probability < 1:
        raise ValueError(f"gate probability: expected a value inside (0, 1), got {probability}")
    return float(2 * scipy.special.gammaincinv(dimension / 2, probability))


def gate_weight(nis: jax.Array, threshold: float | jax.Array, temperature: float) -> jax.Array:
    """Weight of an observation at a gate that weighs instead of deciding.

        w = 1 / (1 + exp((d² - threshold) / temperature)),  but at least one in a million

    Args:
        nis: () d², its squared Mahalanobis distance.
        threshold: of d², from `gate_threshold`.
        temperature: > 0, of d²: how wide the gate is.
    """
    return jnp.maximum(jax.nn.sigmoid((threshold - nis) / temperature), _LEAST_WEIGHT)


def _chi2_quantile(probability: jax.Array, dimension: int) -> jax.Array:
    """As `chi2.ppf`, which `jax.scipy` lacks."""
    if dimension == 2:
        return -2 * jnp.log1p(-probability)
    if dimension == 1:
        return 2 * jax.scipy.special.erfinv(probability) ** 2
    tiny, half, spread = jnp.finfo(probability.dtype).tiny, dimension / 2, 2 / (9 * dimension)
    p, q = jnp.maximum(probability, tiny), jnp.maximum(1 - probability, tiny)
    x = dimension * (1 - spread + jax.scipy.special.ndtri(p) * math.sqrt(spread)) ** 3  # Wilson & Hilferty 1931
    x = jnp.maximum(x, 2 * (p * math.gamma(half + 1)) ** (1 / half))  # the first term of the series
    for _ in range(5):  # Newton's steps on the logarithm of the smaller tail, which is all but straight
        density = jnp.exp((half - 1) * jnp.log(x / 2) - x / 2 - math.lgamma(half)) / 2
        below, above = jax.scipy.special.gammainc(half, x / 2), jax.scipy.special.gammaincc(half, x / 2)
        down = x * jnp.exp(-jnp.log(below / p) * below / (density * x))
        up = x + jnp.log(above / q) * above / density
        x = jnp.where(p < 0.5, down, up)
    return x


def predict(
    mean: jax.Array,
    cov: jax.Array,
    control: jax.Array,
    dt: jax.Array,
    Q: jax.Array | Matrix,
    *,
    motion: MotionModel,
    nominal_dt: float,
) -> tuple[jax.Array, jax.Array]:
    """Move the belief by a control.

        x ← f(x, u, dt),   P ← F P Fᵀ + G Q Gᵀ · nominal_dt / dt,   u the control, then zeros

    The ratio makes Q the noise of one nominal period whatever the step length: two half steps add as much as one
    whole. At dt = 0, where G is zero, nothing is added.

    Args:
        mean: (n,) state, beginning with the pose in m, m, rad. Entries beyond those of the motion model stand still.
        cov: (n, n).
        control: (c,), v m/s and omega rad/s for a differential drive; as long as u (q,) or shorter.
        dt: () s, >= 0.
        Q: (q, q) covariance of u over `nominal_dt` seconds.
        motion: static.
        nominal_dt: s, static.

    Returns:
        mean (n,), cov (n, n), symmetric. Source: Thrun, Burgard & Fox 2005, section 7.4.

    Raises:
        ValueError: a wrong shape, also of what the motion model returns.
    """
    n, q = motion.dim, motion.inputs
    if len(mean) > n and mean.shape * 2 == cov.shape:
        moved, front = predict(mean[:n], cov[:n, :n], control, dt, Q, motion=motion, nominal_dt=nominal_dt)
        F, _ = motion.jacobians(mean[:n], motion.full_input(control), dt)
        cross = (F.array(cov.dtype) if isinstance(F, Matrix) else F) @ cov[:n, n:]
        return jnp.concatenate([moved, mean[n:]]), jnp.block([[front, cross], [cross.T, cov[n:, n:]]])
    checks.shapes(mean=(mean, (n,)), cov=(cov, (n, n)), dt=(dt, ()), Q=(Q, (q, q)))
    u = motion.full_input(control)
    moved, (F, G) = motion.transition(mean, u, dt), motion.jacobians(mean, u, dt)
    checks.shapes(transition=(moved, (n,)), F=(F, (n, n)), G=(G, (n, q)))
    ratio = jnp.where(dt > 0, nominal_dt / jnp.where(dt > 0, dt, 1), 0)
    if n > SMALL:
        F, G, Q = (x.array(cov.dtype) if isinstance(x, Matrix) else jnp.asarray(x) for x in (F, G, Q))
        return moved, mirrored(F @ cov @ F.T + G @ Q @ G.T * ratio)
    F, G, Q = Matrix.of(F), Matrix.of(G), Matrix.symmetric(Q)
    P = quadratic_form(F, Matrix.symmetric(cov)) + quadratic_form(G, Q.scale(ratio))
    return moved, P.array(cov.dtype)


def update(
    mean: jax.Array,
    cov: jax.Array,
    residual: jax.Array,
    H: Matrix | jax.Array,
    R: jax.Array | Matrix,
    *,
    threshold: float | jax.Array = float("inf"),
    temperature: float = 0.0,
    valid: jax.Array | bool = True,
    angles: tuple[int, ...] = HEADING,
) -> Update:
    """Correct the belief by one observation of any sensor, in Joseph form, if it passes the gate.

        S = H P Hᵀ + R,  K = P Hᵀ S⁻¹,  d² = rᵀ S⁻¹ r
        if d² < threshold:  x ← x + K r,  P ← (I − K H) P (I − K H)ᵀ + K R Kᵀ

    Args:
        mean: (n,) state, beginning with the pose in m, m, rad.
        cov: (n, n).
        residual: (m,) observation minus its expectation at `mean`, angles wrapped.
        H: (m, n) Jacobian of the expectation, or (m, k) by the first k entries of the state, zero beyond.
        R: (m, m) covariance of the observation.
        threshold: gate on d², from `gate_threshold(probability, m)`; no gate by default.
        temperature: 0 for a gate that decides. Otherwise, in units of d², one that weighs: every observation corrects
            the belief, with R / w in the place of R, w its `gate_weight`. Near the threshold the correction then
            changes smoothly, so that derivatives tell what the gate does.
        valid: () bool; False leaves the belief as it is.
        angles: entries of the state that are angles, static.

    Returns:
        An `Update`; innovation, S, nis and log-likelihood are there whether or not the gate let it in.
        Source: Bucy & Joseph 1968, section 16; Bar-Shalom, Li & Kirubarajan 2001, section 5.4 (the gate); Chang 2014
        (R that grows with d²).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(mean=(mean, (None,)), residual=(residual, (None,)))
    n, m = len(mean), len(residual)
    checks.shapes(cov=(cov, (n, n)), H=(H, (m, None)), R=(R, (m, m)))
    checks.shapes(threshold=(threshold, ()), valid=(valid, ()))
    H, noise, r = Matrix.of(H), Matrix.symmetric(R), tuple(residual[i] for i in range(m))
    if H.shape[1] > n:
        raise ValueError(f"H: expected up to the {n} columns of the state, got {H.shape[1]}")
    H = Matrix(row + (0,) * (n - len(row)) for row in H.rows)
    small = n <= SMALL
    P = Matrix.symmetric(cov) if small else cov

    def correct(noise: Matrix) -> joseph.Corrected:
        return joseph.correct(P, H, noise, r) if isinstance(P, Matrix) else joseph.correct_array(P, H, noise, residual)

    reported = corrected = correct(noise)
    nis = reported.nis
    accepted = applied = jnp.logical_and(nis < threshold, valid)  # what is no number is not below, gate or none
    if temperature and not (isinstance(threshold, float) and math.isinf(threshold)):
        weight = gate_weight(nis, threshold, temperature)
        corrected, applied = correct(noise.scale(1 / weight)), jnp.logical_and(jnp.isfinite(nis), valid)

    def chosen(new: Any, old: Any) -> list[jax.Array]:
        return [jnp.where(applied, x, y) for x, y in zip(new, old, strict=True)]

    moved = [x + dx for x, dx in zip(mean, corrected.shift, strict=True)]
    moved = [wrap(x) if i in angles else x for i, x in enumerate(moved)]
    rows = P.rows if isinstance(P, Matrix) else P
    return Update(
        mean=stack_scalars(chosen(moved, mean)),
        cov=stack_scalars([chosen(new, old) for new, old in zip(corrected.cov, rows, strict=True)])
        if small
        else jnp.where(applied, jnp.asarray(corrected.cov), cov),
        innovation=residual,
        S=Matrix(reported.S).array(cov.dtype),
        nis=nis,
        accepted=accepted,
        log_likelihood=reported.log_likelihood,
    )
