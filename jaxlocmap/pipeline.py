"""The loop: predict the pose, correct it, put the scan into the map. The only scans over time.

`step` is one turn, `run` scans it, `map_scans` is the map's half alone. All are pure; `jit`, `vmap`, `grad` and
`shard_map` apply as they are, and no value of `params`, `inputs` or `landmarks` is ever compiled in.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap import sensors as sensor
from jaxlocmap._internal.batching import any_in_batch, cond, scan, zero_like_any
from jaxlocmap.mapping import grid
from jaxlocmap.step import Sighting, correct, is_measurement, map_scan, map_spec, predict, sound
from jaxlocmap.types import Config, Gaussian, Info, Inputs, Params, State

# rad², of a heading that is uniform on the circle.
_UNKNOWN_HEADING = np.pi**2 / 3


def init(prior: Gaussian, *, config: Config) -> State:
    """The state before the first step: the prior is the pose at step -1, and the map knows nothing.

    Args:
        prior: mean (3,) m, m, rad; cov (3, 3). Its dtype is the dtype of everything that follows.
        config: `config.grid` None leaves out the map.

    Raises:
        ValueError: wrong shapes; a grid so far out that the dtype cannot hold its corners to a millimetre; or, when
            they can be looked at, a mean that is not finite or as far out, a covariance that is not positive
            semi-definite, or in float32 a heading variance above π²/3 rad², that of a heading nobody knows.
        TypeError: a prior that is not floating point.
    """
    mean, cov = (jnp.asarray(x) for x in prior)
    checks.shape("prior.mean", mean, (3,))
    for name, value in (("mean", mean), ("cov", cov)):
        checks.dtype(f"prior.{name}", value, np.floating)
    if checks.is_concrete(mean) and not np.all(np.isfinite(mean)):
        raise ValueError(f"prior.mean: expected finite x, y, theta, got {mean.tolist()}")
    checks.resolved("prior.mean", mean[:2], mean.dtype)
    checks.covariance("prior.cov", cov, 3)
    heading = np.asarray(cov)[2, 2] if checks.is_concrete(cov) else 0
    if mean.dtype != np.float64 and heading > _UNKNOWN_HEADING:
        raise ValueError(
            f"prior.cov: expected a heading variance up to {_UNKNOWN_HEADING:.3g} rad², that of a heading nobody "
            f"knows, got {heading:.4g}: in {mean.dtype} the first correction would leave no covariance; give "
            "that much, or use float64 (jax.config.update('jax_enable_x64', True))"
        )
    if config.grid is not None:
        checks.resolved("config.grid", grid.corners(config.grid), mean.dtype)
    return State(
        belief=Gaussian(mean, cov.astype(mean.dtype)),
        log_odds=None if config.grid is None else jnp.zeros(config.grid.shape, mean.dtype),
        log_likelihood=jnp.zeros((), mean.dtype),
    )


def step(
    params: Params,
    state: State,
    inputs: Inputs,
    *,
    landmarks: jax.Array | None = None,
    beam_angles: jax.Array | None = None,
    config: Config,
) -> tuple[State, Info]:
    """One step: predict, correct by every observation slot in turn, update the map at the corrected pose.

    Args:
        params: what is tuned. state: from `init` or the step before. inputs: those of one step, no time axis.
        landmarks: (L, 2) m, world frame; needed if there are slots.
        beam_angles: (B,) rad, body frame; needed if there is a grid and a scan.
        config: static.

    Returns:
        The next state, and what the step reports. `Info.ok` is False where a control is not finite (the robot is
        then taken to stand still, its covariance growing by Q), a step length is not finite or negative (a nominal
        step is taken, without the control), an observation is not finite, has a range that is not above zero or cannot
        be used (it is left out), the covariance has broken down, or the pose or an observed landmark is so far out that
        the state's dtype cannot hold it to a millimetre.

    Raises:
        ValueError: shapes that do not fit, an unknown motion model, a grid in `config` but none in `state`, or a
            landmark, when it can be looked at, so far out that the state's dtype cannot hold it to a millimetre.
        TypeError: landmark ids that are not integers, a `valid` that is not boolean.
    """
    state, info = advance(params, state, inputs, landmarks=landmarks, beam_angles=beam_angles, config=config)
    return settle(state, config=config), info


def advance(
    params: Params,
    state: State,
    inputs: Inputs,
    *,
    landmarks: jax.Array | None = None,
    beam_angles: jax.Array | None = None,
    config: Config,
) -> tuple[State, Info]:
    """`step` inside a loop: the same, but cells of the map may stay below l_min until `settle`, which any number of
    steps can share (`grid.add_scan` says why that changes nothing).
    """
    _check_step(params, state, inputs, landmarks, beam_angles, config)
    if config.grid is not None and state.log_odds is None:
        raise ValueError("state.log_odds: expected a map, as init makes with this config, got None")
    dtype = state.belief.mean.dtype  # pinned in init: a carry must not change dtype
    params, inputs, landmarks, beam_angles = jax.tree.map(
        lambda x: jnp.asarray(x, dtype if jnp.issubdtype(jnp.result_type(x), jnp.floating) else None),
        (params, inputs, landmarks, beam_angles),
    )
    belief, moved = predict(params, state.belief, inputs.control, inputs.dt, config=config)
    belief, slots, observed = _correct_landmarks(params, belief, inputs, landmarks, config)
    # A second source of corrections goes here: a scan matched against `settle(state).log_odds`, which the map below
    # has not yet seen. It takes (params, belief, inputs, log_odds) and returns a belief and what it reports, as above.
    log_odds = state.log_odds
    if log_odds is not None and inputs.ranges is not None and beam_angles is not None:
        log_odds = map_scan(params, log_odds, belief.mean, inputs.ranges, beam_angles, config=config)

    log_likelihood = state.log_likelihood + jnp.sum(slots.log_likelihood)
    info = Info(
        belief=belief,
        **slots._asdict(),
        ok=moved & observed & sound(belief),
    )
    return State(belief, log_odds, log_likelihood), info


def settle(state: State, *, config: Config) -> State:
    """The state after `advance` as `step` leaves it: the map within its bounds."""
    if state.log_odds is None or config.grid is None:
        return state
    return state._replace(log_odds=grid.clamp(state.log_odds, config.grid))


def collect_info(state: State, info: Info, aside: Any) -> Info:
    """Keep every step's `Info`, never the grid."""
    del state, aside
    return info


def run(
    params: Params,
    state: State,
    inputs: Inputs,
    *,
    landmarks: jax.Array | None = None,
    beam_angles: jax.Array | None = None,
    config: Config,
    collect: Callable[[State, Info, Any], Any] = collect_info,
    aside: Any = None,
) -> tuple[State, Any]:
    """`step` over time.

    Args:
        params, state, landmarks, beam_angles, config: as in `step`.
        inputs: leading axis T everywhere.
        collect: `(state, info, aside_k) -> pytree`, what to keep of each step; `Info` by default. Keep little: what
            is kept is stored T times a run.
        aside: pytree with leading axis T handed to `collect` step by step, such as the truth.

    Returns:
        The last state, and what `collect` returned with a leading axis T. `run` over all steps and `run` over the
        first and then the rest give the same numbers.

    Raises:
        ValueError, TypeError: as `step`; also leading axes that differ, and, when they can be looked at, a negative
            step length, Q or R not positive definite, `l_occ` or `l_free` of the wrong sign.
    """
    _check_run(params, inputs)

    zero = zero_like_any(params, state, inputs, landmarks, beam_angles)
    state = jax.tree.map(lambda x: x + zero.astype(x.dtype), state)

    def body(state: State, now: tuple[Inputs, Any]) -> tuple[State, Any]:
        state, info = advance(params, state, now[0], landmarks=landmarks, beam_angles=beam_angles, config=config)
        return state, collect(settle(state, config=config), info, now[1])

    state, collected = scan(body, state, (inputs, aside))
    return settle(state, config=config), collected


def map_scans(
    params: Params,
    log_odds: jax.Array,
    poses: jax.Array,
    ranges: jax.Array,
    *,
    beam_angles: jax.Array,
    config: Config,
) -> jax.Array:
    """Mapping alone, at given poses.

    Args:
        params: `l_occ` and `l_free` matter. log_odds: (rows, columns) nats, zeros for a new map.
        poses: (T, 3) m, m, rad. ranges: (T, B) m. beam_angles: (B,) rad, body frame.
        config: with a grid.

    Returns:
        (rows, columns) nats; the same as `run` makes at the same poses.

    Raises:
        ValueError: no grid in `config`, shapes that do not fit, parameters that `Params.check` refuses, or a grid or,
            when it can be looked at, a pose so far out that the poses' dtype cannot hold it to a millimetre.
    """
    params.check()
    checks.shape("poses", poses, (None, 3))
    checks.resolved("poses", poses[:, :2], jnp.result_type(poses))
    checks.shape("ranges", ranges, (len(poses), len(beam_angles)))

    zero = zero_like_any(params, log_odds, poses, ranges, beam_angles)
    log_odds = jnp.asarray(log_odds)
    log_odds = log_odds + zero.astype(log_odds.dtype)
    params = Params(*(jnp.asarray(x, log_odds.dtype) for x in params))

    def body(log_odds: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return map_scan(params, log_odds, now[0], now[1], beam_angles, config=config), None

    log_odds, _ = scan(body, log_odds, (poses, ranges))
    return grid.clamp(log_odds, map_spec(config))


def _correct_landmarks(
    params: Params, belief: Gaussian, inputs: Inputs, landmarks: jax.Array | None, config: Config
) -> tuple[Gaussian, Sighting, jax.Array]:
    """The belief after every slot in turn, what each slot reports, and whether every observation could be used."""
    slots = inputs.valid.shape[0]
    zero = zero_like_any(params, belief, inputs, landmarks)
    real = zero.astype(belief.mean.dtype)
    empty = Sighting(
        innovation=jnp.full((slots, 2), real),
        S=jnp.full((slots, 2, 2), real),
        nis=jnp.full(slots, real),
        accepted=jnp.full(slots, zero != 0),
        log_likelihood=jnp.full(slots, real),
        row=jnp.full(slots, zero - 1),
    )
    if landmarks is None or slots == 0:
        return belief, empty, jnp.array(True)
    usable = inputs.valid & is_measurement(inputs.z[:, 0], inputs.z[:, 1]) & (inputs.landmark < len(landmarks))

    def associate(belief: Gaussian, z: jax.Array, landmark: jax.Array) -> jax.Array:
        best = sensor.associate(*belief, z, landmarks, params.R, config.sensor_offset)
        return jnp.where(landmark < 0, best, landmark)

    def slot(belief: Gaussian, now: tuple[Any, ...]) -> tuple[Gaussian, tuple[Sighting, jax.Array]]:
        z_range, z_bearing, landmark, usable = now
        z, unknown = jnp.stack([z_range, z_bearing]), any_in_batch(usable & (landmark < 0))
        row = cond(unknown, associate, lambda belief, z, landmark: landmark, belief, z, landmark)
        position = landmarks[jnp.maximum(row, 0)]
        belief, report, used = correct(params, belief, z, position, row, usable, config=config)
        return belief, (report, used)

    def somebody(belief: Gaussian, z: jax.Array) -> tuple[Gaussian, tuple[Sighting, jax.Array]]:
        z = jnp.where(usable[:, None], z, 0)
        return scan(slot, belief, (z[:, 0], z[:, 1], inputs.landmark.astype(jnp.int32), usable))

    def nobody(belief: Gaussian, _: jax.Array) -> tuple[Gaussian, tuple[Sighting, jax.Array]]:
        return belief, (empty, usable)

    belief, (report, used) = cond(any_in_batch(usable), somebody, nobody, belief, inputs.z)
    return belief, report, jnp.all(used == inputs.valid)


def _check_step(
    params: Params,
    state: State,
    inputs: Inputs,
    landmarks: jax.Array | None,
    beam_angles: jax.Array | None,
    config: Config,
) -> None:
    for name, value, shape in (
        ("params.Q", params.Q, (2, 2)),
        ("params.R", params.R, (2, 2)),
        ("state.belief.mean", state.belief.mean, (3,)),
        ("state.belief.cov", state.belief.cov, (3, 3)),
        ("state.log_likelihood", state.log_likelihood, ()),
    ):
        checks.shape(name, value, shape)
    checks.shape("inputs.dt", inputs.dt, ())
    checks.shape("inputs.control", inputs.control, (2,))
    checks.shape("inputs.valid", inputs.valid, (None,))
    slots = np.shape(inputs.valid)[0]
    checks.shape("inputs.landmark", inputs.landmark, (slots,))
    checks.shape("inputs.z", inputs.z, (slots, 2))
    for name, value in (("dt", inputs.dt), ("control", inputs.control), ("z", inputs.z)):
        checks.dtype(f"inputs.{name}", value, np.floating)
    checks.dtype("inputs.landmark", inputs.landmark, np.integer)
    checks.dtype("inputs.valid", inputs.valid, np.bool_)
    if slots:
        if landmarks is None:
            raise ValueError(f"landmarks: expected (L, 2) for the {slots} observation slots, got None")
        checks.shape("landmarks", landmarks, (None, 2))
        checks.dtype("landmarks", landmarks, np.floating)
        checks.resolved("landmarks", landmarks, state.belief.mean.dtype)
        if not len(landmarks):
            raise ValueError(f"landmarks: expected at least one for the {slots} observation slots, got (0, 2)")
    if config.grid is not None and inputs.ranges is not None:
        if beam_angles is None:
            raise ValueError("beam_angles: expected (B,) for the ranges to map, got None")
        checks.shape("beam_angles", beam_angles, (None,))
        checks.dtype("beam_angles", beam_angles, np.floating)
        checks.shape("inputs.ranges", inputs.ranges, np.shape(beam_angles))
        checks.dtype("inputs.ranges", inputs.ranges, np.floating)


def _check_run(params: Params, inputs: Inputs) -> None:
    params.check()
    checks.shape("inputs.dt", inputs.dt, (None,))
    steps = np.shape(inputs.dt)[0]
    for name, value in inputs._asdict().items():
        if value is not None and np.shape(value)[:1] != (steps,):
            raise ValueError(f"inputs.{name}: expected {steps} steps as inputs.dt has, got {np.shape(value)}")
    if checks.is_concrete(inputs.dt) and np.any(np.asarray(inputs.dt) < 0):
        k = int(np.argmax(np.asarray(inputs.dt) < 0))
        raise ValueError(f"inputs.dt: expected seconds >= 0, got {float(inputs.dt[k]):g} at step {k}")
