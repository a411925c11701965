"""One step: predict, observe, match, map. Its order stands in `turn` and nowhere else; there is no loop here."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks, motion, sensors
from jaxlocmap._internal.batching import any_in_batch, cond, zero_in_shard_map
from jaxlocmap._internal.linalg import is_psd, stack_scalars
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid
from jaxlocmap.matching import submaps as matching
from jaxlocmap.parameters import Params
from jaxlocmap.se2 import HEADING, POSE
from jaxlocmap.types import Config, Gaussian, GridSpec, State


class Observed(NamedTuple):
    """What the observations of a step make of the belief."""

    belief: Gaussian
    report: Any  # what the loop wants to keep of them
    log_likelihood: jax.Array  # () nats, summed over them
    ok: jax.Array  # () bool: every one could be used


class Observation(NamedTuple):
    """What the filter reports of one observation: the middle of `Info`."""

    innovation: jax.Array
    S: jax.Array
    nis: jax.Array
    accepted: jax.Array
    log_likelihood: jax.Array
    row: jax.Array


class Turned(NamedTuple):
    """What `turn` makes of a step."""

    state: State
    report: Any  # of the observations
    match: matching.MatchReport | None  # None without a matcher or a scanner
    ok: jax.Array  # () bool: control, step length and observations could be used, and the belief is valid


def turn(
    params: Params,
    state: State,
    control: jax.Array,
    dt: jax.Array,
    *,
    observe: Callable[[Gaussian], Observed],
    ranges: jax.Array | None,
    beam_angles: jax.Array | None,
    config: Config,
) -> Turned:
    """Predict the belief, correct it by what is observed and by the scan, add the scan to the map at the corrected
    pose.

    Args:
        params: what is tuned.
        state: of the step before. Cells of its map may lie below `l_min` until they are read through `clamp_map`,
            which any number of steps can share (`grid.add_scan` says why that changes nothing).
        control: (c,), moves the pose over this step.
        dt: () s.
        observe: corrects the belief by one observation after the other (`correct`): recorded or simulated ones.
        ranges: (B,) m; None without a scanner.
        beam_angles: (B,) rad; None without a scanner.
        config: static.

    Raises:
        ValueError: a wrong shape, or a block that `params` lacks.
    """
    predicted, moved = predict(params, state.belief, control, dt, config=config)
    observed = observe(predicted)
    belief, log_odds, submaps, report = observed.belief, state.log_odds, state.submaps, None
    if ranges is not None and beam_angles is not None:
        if submaps is not None and config.matcher is not None:
            belief, submaps, report = match(
                params, belief, submaps, ranges, beam_angles, before=state.belief.mean, config=config
            )
        if log_odds is not None:
            log_odds = map_scan(params, log_odds, belief.mean, ranges, beam_angles, config=config)
    ok = moved & observed.ok & is_valid(belief)
    state = State(belief, log_odds, state.log_likelihood + observed.log_likelihood, submaps)
    return Turned(state, observed.report, report, ok)


def match(
    params: Params,
    belief: Gaussian,
    submaps: matching.Submaps,
    ranges: jax.Array,
    beam_angles: jax.Array,
    *,
    before: jax.Array,
    config: Config,
) -> tuple[Gaussian, matching.Submaps, matching.MatchReport]:
    """The belief corrected by the scan, if one is due to be matched. before: (n,) mean after the step before."""
    matcher = config.matcher
    if matcher is None:
        raise ValueError("config.matcher: expected the Matcher that the submaps were made for, got None")

    def now(belief: Gaussian, submaps: matching.Submaps) -> Any:
        return matching.match_scan(
            params,
            belief,
            submaps,
            ranges,
            before=before,
            scanner=config.scanner(beam_angles),
            matcher=matcher,
            angles=state_angles(config),
            temperature=config.gate_temperature,
        )

    def not_now(belief: Gaussian, submaps: matching.Submaps) -> Any:
        return belief, matching.travelled(submaps, before, belief.mean), matching.no_match(belief.mean.dtype)

    due = any_in_batch(submaps.steps % matcher.period == 0)  # all runs of a batch are at the same step
    zero = zero_in_shard_map(params, belief, submaps, ranges, beam_angles, before)
    belief, submaps, report = cond(due, now, not_now, belief, submaps, zero=zero)
    return belief, submaps._replace(steps=submaps.steps + 1), report


def state_dim(config: Config) -> int:
    """Entries of the filter's state: those of the motion model, and of the submaps if scans are matched."""
    return motion.resolve(config.motion).dim + (matching.EXTRA if config.matcher is not None else 0)


def state_angles(config: Config) -> tuple[int, ...]:
    """Those of them that are angles."""
    model, whole = motion.resolve(config.motion), state_dim(config)
    return (*model.angles, *range(model.dim + HEADING[0], whole, POSE))


def clamp_map(state: State, *, config: Config) -> State:
    """The state as it is read, its map within its bounds."""
    if state.log_odds is None or config.grid is None:
        return state
    return state._replace(log_odds=grid.clamp(state.log_odds, config.grid))


def predict(
    params: Params, belief: Gaussian, control: jax.Array, dt: jax.Array, *, config: Config
) -> tuple[Gaussian, jax.Array]:
    """The moved belief, and whether control and step length were usable. Without a control the robot is taken to
    stand still, with a belief that grows by its noise all the same; without a step length, for a nominal step.

    Raises:
        ValueError: a wrong shape, or a block of noise that `params` lacks.
    """
    checks.shapes(control=(control, (None,)), dt=(dt, ()))
    model = motion.resolve(config.motion)
    timed = jnp.isfinite(dt) & (dt >= 0)
    usable = timed
    for i in range(len(control)):
        usable = usable & jnp.isfinite(control[i])
    mean, cov = ekf.predict(
        *belief,
        jnp.stack([jnp.where(usable, control[i], 0) for i in range(len(control))]),
        jnp.where(timed, dt, config.dt),
        params.covariance(model.noise),
        motion=model,
        nominal_dt=config.dt,
    )
    return Gaussian(mean, cov), usable


def correct(
    params: Params,
    belief: Gaussian,
    z: jax.Array,
    landmark: jax.Array | None,
    row: jax.Array,
    usable: jax.Array,
    *,
    config: Config,
) -> tuple[Gaussian, Observation, jax.Array]:
    """Correct the belief by one observation.

    Args:
        params: with the noise of the sensor.
        belief: before.
        z: (m,). What the sensor cannot have measured, such as a range that is not above zero, is left out.
        landmark: (2,) m. One so far out that its dtype cannot hold it to a millimetre is no place to measure from. A
            sensor that observes none takes no notice.
        row: () int32 of the landmark in its list, to be reported.
        usable: () bool; False leaves the belief as it is.
        config: static.

    Returns:
        The belief after, what is reported of the observation (all zero, row -1, if it was not used), and () bool
        whether it was used.

    Raises:
        ValueError: a wrong shape, or a block of noise that `params` lacks.
    """
    sensor = sensors.resolve(config.sensor)
    m, n = sensor.dim, state_dim(config)
    checks.shapes(mean=(belief.mean, (n,)), cov=(belief.cov, (n, n)))
    checks.shapes(z=(z, (m,)), row=(row, ()), usable=(usable, ()))
    landmark = landmark if sensor.landmarks else None
    usable = usable & sensor.is_measurement(z)
    z = jnp.stack([jnp.where(usable, z[i], 0) for i in range(m)])  # what is no number would spoil derivatives
    offset = config.sensor_offset
    residual, H, defined = sensors.linearise(belief.mean, landmark, z, sensor=sensor, offset=offset)
    used = usable & defined
    if landmark is not None:
        used = used & is_held(landmark[0], landmark[1])
    update = ekf.update(
        *belief,
        residual,
        H,
        params.covariance((sensor.noise,)),
        threshold=_gate_threshold(params, config, m, z.dtype),
        temperature=config.gate_temperature,
        valid=used,
        angles=state_angles(config),
    )

    def known(x: jax.Array) -> jax.Array:
        return jnp.where(used, x, jnp.zeros_like(x))

    S = update.S
    report = Observation(
        innovation=jnp.stack([known(update.innovation[i]) for i in range(m)]),
        S=stack_scalars([[known(S[i, j]) for j in range(m)] for i in range(m)]),
        nis=known(update.nis),
        accepted=update.accepted,
        log_likelihood=known(update.log_likelihood),
        row=jnp.where(used, row, -1),
    )
    return Gaussian(update.mean, update.cov), report, used & jnp.isfinite(update.nis)


def _gate_threshold(params: Params, config: Config, dimension: int, dtype: Any) -> Any:
    if params.gate_probability is None:
        return ekf.gate_threshold(config.gate_probability, dimension)
    return ekf.gate_threshold(jnp.asarray(params.gate_probability, dtype), dimension)


def map_scan(
    params: Params, log_odds: jax.Array, mean: jax.Array, ranges: jax.Array, beam_angles: jax.Array, *, config: Config
) -> jax.Array:
    """The map after one more scan, taken at the pose that a state's mean (n,) begins with; to be read clamped."""
    amounts = params.l_occ, params.l_free
    scanner, spec = config.scanner(beam_angles), map_spec(config)
    return grid.add_scan(log_odds, mean[:POSE], ranges, *amounts, scanner=scanner, spec=spec)


def is_valid(belief: Gaussian) -> jax.Array:
    """Whether a belief is finite, its covariance positive semi-definite, and its place one that its dtype can hold to a
    millimetre.

    Raises:
        ValueError: a wrong shape.
    """
    mean, cov = belief
    checks.shape("cov", cov, (None, None))
    checks.shapes(mean=(mean, (len(cov),)), cov=(cov, (len(cov), len(cov))))
    rest = functools.reduce(jnp.add, [mean[i] for i in range(2, len(mean))])
    return is_psd(cov) & is_held(mean[0], mean[1]) & jnp.isfinite(rest)


def is_held(x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether a place, m, is one that its dtype can hold to a millimetre. Any shape."""
    far = checks.farthest(x.dtype)
    return (jnp.abs(x) < far) & (jnp.abs(y) < far)


def map_spec(config: Config) -> GridSpec:
    """The grid's, or an error if there is none."""
    if config.grid is None:
        raise ValueError("config.grid: expected the GridSpec that the map was made for, got None")
    return config.grid
