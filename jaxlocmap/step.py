"""What a step is made of: predict, correct by one observation, add a scan to the map. No loop."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks
from jaxlocmap import sensors as sensor
from jaxlocmap._internal.linalg import Matrix, is_psd, stack
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid
from jaxlocmap.motion import resolve
from jaxlocmap.types import Config, Gaussian, GridSpec, Params


def predict(
    params: Params, belief: Gaussian, control: jax.Array, dt: jax.Array, *, config: Config
) -> tuple[Gaussian, jax.Array]:
    """The moved belief, and whether control and step length were usable. Without a control the robot is taken to
    stand still, with a belief that grows by Q all the same; without a step length, for a nominal step.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(control=(control, (2,)), dt=(dt, ()))
    timed = jnp.isfinite(dt) & (dt >= 0)
    usable = jnp.isfinite(control[0]) & jnp.isfinite(control[1]) & timed
    mean, cov = ekf.predict(
        *belief,
        jnp.stack([jnp.where(usable, control[0], 0), jnp.where(usable, control[1], 0)]),
        jnp.where(timed, dt, config.dt),
        params.Q,
        motion=resolve(config.motion),
        nominal_dt=config.dt,
    )
    return Gaussian(mean, cov), usable


class Sighting(NamedTuple):
    """What the filter reports of an observation: the middle of `Info`."""

    innovation: jax.Array
    S: jax.Array
    nis: jax.Array
    accepted: jax.Array
    log_likelihood: jax.Array
    row: jax.Array


def correct(
    params: Params,
    belief: Gaussian,
    z: jax.Array,
    landmark: jax.Array,
    row: jax.Array,
    usable: jax.Array,
    *,
    config: Config,
) -> tuple[Gaussian, Sighting, jax.Array]:
    """The belief after one observation z (2,) of the landmark (2,) in a row of the list, what is reported of it (all
    zero, row -1, if it was not used), and whether it was used. A range that is not above zero is no measurement, and a
    landmark so far out that its dtype cannot hold it to a millimetre is no place to measure from.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(mean=(belief.mean, (3,)), cov=(belief.cov, (3, 3)))
    checks.shapes(z=(z, (2,)), landmark=(landmark, (2,)), row=(row, ()), usable=(usable, ()))
    usable = usable & is_measurement(z[0], z[1])
    z = jnp.stack([jnp.where(usable, z[i], 0) for i in range(2)])  # what is no number would spoil derivatives
    residual, H, defined = sensor.linearise(belief.mean, landmark, z, config.sensor_offset)
    used = usable & defined & is_held(landmark[0], landmark[1])
    threshold = ekf.gate_threshold(config.gate_probability, 2)
    softness = config.gate_softness
    update = ekf.update(*belief, residual, H, params.R, threshold=threshold, softness=softness, valid=used)

    def known(x: jax.Array) -> jax.Array:
        return jnp.where(used, x, jnp.zeros_like(x))

    S = update.S
    report = Sighting(
        innovation=jnp.stack([known(update.innovation[i]) for i in range(2)]),
        S=stack([[known(S[i, j]) for j in range(2)] for i in range(2)]),
        nis=known(update.nis),
        accepted=update.accepted,
        log_likelihood=known(update.log_likelihood),
        row=jnp.where(used, row, -1),
    )
    return Gaussian(update.mean, update.cov), report, used & jnp.isfinite(update.nis)


def is_measurement(reach: jax.Array, bearing: jax.Array) -> jax.Array:
    """Whether a range, m, and a bearing, rad, can have been measured: finite, and the range above zero. Any shape."""
    return (reach > 0) & jnp.isfinite(reach + bearing)


def map_scan(
    params: Params, log_odds: jax.Array, pose: jax.Array, ranges: jax.Array, beam_angles: jax.Array, *, config: Config
) -> jax.Array:
    """The map after one more scan; bounded below only after `settle`."""
    return grid.add_scan(
        log_odds,
        pose,
        ranges,
        beam_angles,
        params.l_occ,
        params.l_free,
        spec=map_spec(config),
        min_range=config.min_range,
        max_range=config.max_range,
    )


def sound(belief: Gaussian) -> jax.Array:
    """Whether a belief is finite, its covariance positive semi-definite, and its place one that its dtype can hold to a
    millimetre.

    Raises:
        ValueError: a wrong shape.
    """
    mean, cov = belief
    checks.shapes(mean=(mean, (3,)), cov=(cov, (3, 3)))
    return is_psd(Matrix.of(cov)) & is_held(mean[0], mean[1]) & jnp.isfinite(mean[2])


def is_held(x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether a place, m, is one that its dtype can hold to a millimetre. Any shape."""
    far = checks.farthest(x.dtype)
    return (jnp.abs(x) < far) & (jnp.abs(y) < far)


def map_spec(config: Config) -> GridSpec:
    """The grid's, or an error if there is none."""
    if config.grid is None:
        raise ValueError("config.grid: expected the GridSpec that the map was made for, got None")
    return config.grid
