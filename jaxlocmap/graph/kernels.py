"""Robust kernels: how much a loop counts, by its chi-square.

    objective = Σ odometry eᵀ Omega e + Σ loops rho(eᵀ Omega e)

A step of Gauss-Newton weighs each loop by w = rho'. With s = eᵀ Omega e and the scale c, by default such that w is 1/2
at the 0.99 quantile of chi-square with 3 degrees of freedom (`gnc`: 1 below, 0 above):

| kernel | rho(s) | w |
|---|---|---|
| quadratic | s | 1 |
| huber | s for s <= c², else 2 c √s - c² | min(1, c / √s) |
| cauchy | c² log(1 + s / c²) | 1 / (1 + s / c²) |
| geman_mcclure | c² s / (c² + s) | (c² / (c² + s))² |
| dcs | s for s <= c, else c (3 s - c) / (c + s) | min(1, 2 c / (c + s))² |
| gnc | min(s, c²) | 1 or 0 |

Source: Huber 1964; Zhang 1997 (Cauchy, Geman-McClure); Agarwal, Tipaldi, Spinello, Stachniss & Burgard 2013 (dynamic
covariance scaling, whose c is `phi`); Yang, Antonante, Tzoumas & Carlone 2020 (graduated non-convexity).
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from jaxlocmap import checks

GOOD = 11.344866730144373  # 0.99 of chi-square with 3 degrees of freedom: what a good loop stays below
_SCALES = {  # all count a loop half there, or decide
    "quadratic": math.inf,
    "huber": math.sqrt(GOOD) / 2,
    "cauchy": math.sqrt(GOOD),
    "geman_mcclure": math.sqrt(GOOD / (math.sqrt(2) - 1)),
    "dcs": GOOD / (2 * math.sqrt(2) - 1),
    "gnc": math.sqrt(GOOD),
}
NAMES = tuple(_SCALES)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Kernel:
    """A robust kernel. A pytree: the scale may be traced, mapped and differentiated by; the name is static.

    Raises:
        ValueError: a name that is none of the table above; a scale that is not positive.
        TypeError: a scale that is no number.
    """

    name: str = dataclasses.field(default="quadratic", metadata={"static": True})
    scale: jax.Array | float | None = None  # c, > 0; None: that of the kernel

    def __post_init__(self) -> None:
        checks.named("kernel", self.name, _SCALES, "a Kernel")
        if isinstance(self.scale, (int, float)):
            checks.number("scale", self.scale)
            if not self.scale > 0:
                raise ValueError(f"scale: expected a number > 0, got {self.scale}")

    @property
    def c(self) -> jax.Array | float:
        """The scale."""
        return _SCALES[self.name] if self.scale is None else self.scale

    def rho(self, square: jax.Array) -> jax.Array:
        """What loops add to the objective, from s = eᵀ Omega e >= 0."""
        c = self.c
        if self.name == "quadratic":
            return square
        if self.name == "huber":
            far = square > c**2
            return jnp.where(far, 2 * c * jnp.sqrt(jnp.where(far, square, 1)) - c**2, square)
        if self.name == "cauchy":
            return c**2 * jnp.log1p(square / c**2)
        if self.name == "geman_mcclure":
            return c**2 * square / (c**2 + square)
        if self.name == "dcs":
            return jnp.where(square > c, c * (3 * square - c) / (c + square), square)
        return jnp.minimum(square, c**2)

    def weight(self, square: jax.Array) -> jax.Array:
        """The derivative of `rho`."""
        c = self.c
        if self.name == "quadratic":
            return jnp.ones_like(square)
        if self.name == "huber":
            return c / jnp.sqrt(jnp.maximum(square, c**2))
        if self.name == "cauchy":
            return 1 / (1 + square / c**2)
        if self.name == "geman_mcclure":
            return (c**2 / (c**2 + square)) ** 2
        if self.name == "dcs":
            return jnp.minimum(1, 2 * c / (c + square)) ** 2
        return (square <= c**2).astype(square.dtype)


def gnc_weight(square: jax.Array, mu: jax.Array, c: jax.Array | float) -> jax.Array:
    """The weight of a truncated quadratic made smooth: convex at mu = 0, itself at mu = ∞.

        w = 1 for s <= c² mu / (mu + 1), 0 for s >= c² (mu + 1) / mu, else c √(mu (mu + 1) / s) - mu

    Source: Yang et al. 2020, equation 14.
    """
    between = c * jnp.sqrt(mu * (mu + 1) / jnp.maximum(square, jnp.finfo(square.dtype).tiny)) - mu
    return jnp.clip(between, 0, 1)
