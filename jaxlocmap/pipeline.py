"""The scans over time: `step` is one turn over what was recorded, `run` scans it, `map_scans` is the map's part alone.

All are pure; `jit`, `vmap`, `grad` and `shard_map` apply as they are, and no value of `params`, `inputs` or `landmarks`
is ever compiled in. Each compiles once for a config and shapes, with `jax.jit` around it or without.

```python
import jax
import jax.numpy as jnp
from jaxlocmap import Config, Gaussian, GridSpec, Inputs, Params, init, run

steps, beams = 50, 31
params = Params.from_std(v=0.02, w=0.03, range=0.15, bearing=0.03)  # a NamedTuple of arrays: what is tuned
config = Config(dt=0.1, motion="arc", grid=GridSpec(origin=(-5.0, -5.0), resolution=0.1, shape=(100, 100)))
prior = Gaussian(mean=jnp.zeros(3), cov=jnp.diag(jnp.array([0.05, 0.05, 0.02])))
inputs = Inputs(
    dt=jnp.full(steps, 0.1),  # s
    control=jnp.tile(jnp.array([0.3, 0.1]), (steps, 1)),  # v m/s, omega rad/s
    landmark=jnp.zeros((steps, 1), jnp.int32),  # row of `landmarks`, -1 if unknown
    z=jnp.tile(jnp.array([2.0, 0.5]), (steps, 1, 1)),  # range m, bearing rad
    valid=jnp.arange(steps)[:, None] == 0,  # seen at step 0 alone
    ranges=jnp.full((steps, beams), 2.5),  # m
)
scene = dict(landmarks=jnp.array([[1.8, 1.0]]), beam_angles=jnp.linspace(-1.5, 1.5, beams))
state, info = run(params, init(prior, config=config), inputs, **scene, config=config)
print(state.belief.mean, info.nis[0], state.log_odds.shape)


def surprise(params):  # negative log-likelihood of what was observed
    return -run(params, init(prior, config=config), inputs, **scene, config=config)[0].log_likelihood


print(jax.grad(surprise)(params).R)
```

`Info` holds the innovation, its covariance, its squared Mahalanobis distance, the gate's decision and the
log-likelihood of every observation, let in or not. The order of a step stands in `step.turn`, which takes what observes
as a function: a loop of your own calls it with another one.

What is differentiable: `run` by `Q`, `R`, the prior, controls and observations, exactly, through every accepted
correction. By `l_occ` and `l_free`: the log-odds exactly, zero where a cell sits at its clamp. The derivative is zero
of the map by the pose (a cell index is a floor) and of anything by the gate's decision (a comparison): an observation
that the gate refuses still gives its log-likelihood, and that a derivative, but no longer moves the pose. With
`Config.gate_temperature` there is no decision to leave out. Derivatives of a correction are written by hand, of any
order (`filters.joseph`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks, motion, sensors
from jaxlocmap._internal.batching import any_in_batch, cond, scan, zero_in_shard_map
from jaxlocmap.mapping import grid
from jaxlocmap.matching import submaps
from jaxlocmap.parameters import Params
from jaxlocmap.se2 import POSE
from jaxlocmap.step import Observation, Observed, clamp_map, correct, map_scan, map_spec, state_dim, turn
from jaxlocmap.types import Config, Gaussian, Info, Inputs, State

# rad², of a heading that is uniform on the circle.
_UNKNOWN_HEADING = np.pi**2 / 3


def init(prior: Gaussian, *, config: Config) -> State:
    """The state before the first step: the prior is the pose at step -1, and the map knows nothing.

    Args:
        prior: mean (n,), cov (n, n) of the state of the motion model, which begins with the pose in m, m, rad. Its
            dtype is the dtype of everything that follows.
        config: `config.grid` None leaves out the map.

    Raises:
        ValueError: wrong shapes; an unknown motion model; a grid so far out that the dtype cannot hold its corners to a
            millimetre; or, when they can be looked at, a mean that is not finite or as far out, a covariance that is
            not positive semi-definite, or in float32 a heading variance above π²/3 rad², that of a heading nobody
            knows.
        TypeError: a prior that is not floating point.
    """
    mean, cov = (jnp.asarray(x) for x in prior)
    n = motion.resolve(config.motion).dim
    checks.shape("prior.mean", mean, (n,))
    for name, value in (("mean", mean), ("cov", cov)):
        checks.dtype(f"prior.{name}", value, np.floating)
    if checks.is_concrete(mean) and not np.all(np.isfinite(mean)):
        raise ValueError(f"prior.mean: expected finite x, y, theta{', ...' * (n > POSE)}, got {mean.tolist()}")
    checks.resolved("prior.mean", mean[:2], mean.dtype)
    checks.covariance("prior.cov", cov, n)
    heading = np.asarray(cov)[2, 2] if checks.is_concrete(cov) else 0
    if mean.dtype != np.float64 and heading > _UNKNOWN_HEADING:
        raise ValueError(
            f"prior.cov: expected a heading variance up to {_UNKNOWN_HEADING:.3g} rad², that of a heading nobody "
            f"knows, got {heading:.4g}: in {mean.dtype} the first correction would leave no covariance; give "
            "that much, or use float64 (jax.config.update('jax_enable_x64', True))"
        )
    if config.grid is not None:
        checks.resolved("config.grid", grid.corners(config.grid), mean.dtype)
    belief = Gaussian(mean, cov.astype(mean.dtype))
    return State(
        belief=belief if config.matcher is None else submaps.extended(belief, config.matcher),
        log_odds=None if config.grid is None else jnp.zeros(config.grid.shape, mean.dtype),
        log_likelihood=jnp.zeros((), mean.dtype),
        submaps=None if config.matcher is None else submaps.empty(config.matcher, mean.dtype),
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
        params: what is tuned.
        state: from `init` or the step before.
        inputs: those of one step, no time axis.
        landmarks: (L, 2) m, world frame; needed if there are slots of a sensor that observes landmarks.
        beam_angles: (B,) rad, in the scanner's frame; needed if there is a grid and a scan.
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
    _check_landmarks(state, inputs, landmarks, config)
    state, info = _turned(params, state, inputs, landmarks, beam_angles, config)
    return clamp_map(state, config=config), info


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
    _check_landmarks(state, inputs, landmarks, config)
    # Compiled once where nobody compiles it. A caller's own `collect` may hold traced values, which must not be kept.
    whole = _run if collect is collect_info else _scanned
    return whole(params, state, inputs, landmarks, beam_angles, aside, config=config, collect=collect)


def _scanned(
    params: Params,
    state: State,
    inputs: Inputs,
    landmarks: jax.Array | None,
    beam_angles: jax.Array | None,
    aside: Any,
    *,
    config: Config,
    collect: Callable[[State, Info, Any], Any],
) -> tuple[State, Any]:
    def body(state: State, now: tuple[Inputs, Any]) -> tuple[State, Any]:
        state, info = _recorded_turn(params, state, now[0], landmarks, beam_angles, config)
        return state, collect(clamp_map(state, config=config), info, now[1])

    zero = zero_in_shard_map(params, state, inputs, landmarks, beam_angles)
    state, collected = scan(body, state, (inputs, aside), zero=zero)
    return clamp_map(state, config=config), collected


_run = jax.jit(_scanned, static_argnames=("config", "collect"), inline=True)


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
        params: `l_occ` and `l_free` matter.
        log_odds: (rows, columns) nats, zeros for a new map.
        poses: (T, 3) m, m, rad, of the robot.
        ranges: (T, B) m.
        beam_angles: (B,) rad, in the scanner's frame.
        config: with a grid.

    Returns:
        (rows, columns) nats; the same as `run` makes at the same poses.

    Raises:
        ValueError: no grid in `config`, shapes that do not fit, parameters that `Params.check` refuses, or a grid or,
            when it can be looked at, a pose so far out that the poses' dtype cannot hold it to a millimetre.
    """
    params.check()
    checks.shape("poses", poses, (None, POSE))
    checks.resolved("poses", poses[:, :2], jnp.result_type(poses))
    checks.shape("ranges", ranges, (len(poses), len(beam_angles)))
    return _mapped(params, jnp.asarray(log_odds), poses, ranges, beam_angles, config=config)


@functools.partial(jax.jit, static_argnames="config", inline=True)
def _mapped(
    params: Params,
    log_odds: jax.Array,
    poses: jax.Array,
    ranges: jax.Array,
    beam_angles: jax.Array,
    *,
    config: Config,
) -> jax.Array:
    params = jax.tree.map(lambda x: jnp.asarray(x, log_odds.dtype), params)

    def body(log_odds: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return map_scan(params, log_odds, now[0], now[1], beam_angles, config=config), None

    log_odds, _ = scan(body, log_odds, (poses, ranges))
    return grid.clamp(log_odds, map_spec(config))


def _recorded_turn(
    params: Params,
    state: State,
    inputs: Inputs,
    landmarks: jax.Array | None,
    beam_angles: jax.Array | None,
    config: Config,
) -> tuple[State, Info]:
    """`step.turn` over what was recorded in a step."""
    _check_step(params, state, inputs, landmarks, beam_angles, config)
    dtype = state.belief.mean.dtype  # pinned in init: a carry must not change dtype
    params, inputs, landmarks, beam_angles = jax.tree.map(
        lambda x: jnp.asarray(x, dtype if jnp.issubdtype(jnp.result_type(x), jnp.floating) else None),
        (params, inputs, landmarks, beam_angles),
    )
    turned = turn(
        params,
        state,
        inputs.control,
        inputs.dt,
        observe=lambda belief: _observe_slots(params, belief, inputs, landmarks, config),
        ranges=inputs.ranges,
        beam_angles=beam_angles,
        config=config,
    )
    return turned.state, Info(turned.state.belief, **turned.report._asdict(), ok=turned.ok, match=turned.match)


_turned = jax.jit(_recorded_turn, static_argnames="config", inline=True)


def _observe_slots(
    params: Params, belief: Gaussian, inputs: Inputs, landmarks: jax.Array | None, config: Config
) -> Observed:
    """The belief corrected by every slot in turn."""
    sensor, dtype = sensors.resolve(config.sensor), belief.mean.dtype
    slots, m = inputs.valid.shape[0], sensor.dim
    empty = Observation(
        innovation=jnp.zeros((slots, m), dtype),
        S=jnp.zeros((slots, m, m), dtype),
        nis=jnp.zeros(slots, dtype),
        accepted=jnp.zeros(slots, bool),
        log_likelihood=jnp.zeros(slots, dtype),
        row=jnp.full(slots, -1, jnp.int32),
    )
    if slots == 0:
        return Observed(belief, empty, jnp.zeros((), dtype), jnp.array(True))
    possible = inputs.valid & jax.vmap(sensor.is_measurement)(inputs.z)
    rows = inputs.landmark.astype(jnp.int32)
    if landmarks is None or not sensor.landmarks:
        rows, landmarks = jnp.zeros_like(rows), jnp.zeros((1, 2), dtype)
    possible = possible & (rows < len(landmarks))

    zero = zero_in_shard_map(params, belief, inputs, landmarks)

    def associate(belief: Gaussian, z: jax.Array, row: jax.Array) -> jax.Array:
        R = params.block(sensor.noise)
        best = sensors.associate(*belief, z, landmarks, R, sensor=sensor, offset=config.sensor_offset)
        return jnp.where(row < 0, best, row)

    def slot(belief: Gaussian, now: tuple[Any, ...]) -> tuple[Gaussian, tuple[Observation, jax.Array]]:
        *z, row, usable = now
        z = jnp.stack(z)
        if sensor.landmarks:
            unknown = any_in_batch(usable & (row < 0))
            row = cond(unknown, associate, lambda belief, z, row: row, belief, z, row, zero=zero)
        landmark = landmarks[jnp.maximum(row, 0)]
        belief, report, used = correct(params, belief, z, landmark, row, usable, config=config)
        return belief, (report, used)

    def somebody(belief: Gaussian, z: jax.Array) -> tuple[Gaussian, tuple[Observation, jax.Array]]:
        z = jnp.where(possible[:, None], z, 0)
        return scan(slot, belief, (*(z[:, i] for i in range(m)), rows, possible), zero=zero)

    def nobody(belief: Gaussian, _: jax.Array) -> tuple[Gaussian, tuple[Observation, jax.Array]]:
        return belief, (empty, possible)

    belief, (report, used) = cond(any_in_batch(possible), somebody, nobody, belief, inputs.z, zero=zero)
    return Observed(belief, report, jnp.sum(report.log_likelihood), jnp.all(used == inputs.valid))


def _check_step(
    params: Params,
    state: State,
    inputs: Inputs,
    landmarks: jax.Array | None,
    beam_angles: jax.Array | None,
    config: Config,
) -> None:
    model, sensor = motion.resolve(config.motion), sensors.resolve(config.sensor)
    for block in model.noise:
        params.block(block)
    n = state_dim(config)
    checks.shape("state.belief.mean", state.belief.mean, (n,))
    checks.shape("state.belief.cov", state.belief.cov, (n, n))
    checks.shape("state.log_likelihood", state.log_likelihood, ())
    if config.grid is not None and state.log_odds is None:
        raise ValueError("state.log_odds: expected a map, as init makes with this config, got None")
    checks.shape("inputs.dt", inputs.dt, ())
    model.full_input(inputs.control, "inputs.control")
    checks.shape("inputs.valid", inputs.valid, (None,))
    slots = np.shape(inputs.valid)[0]
    checks.shape("inputs.landmark", inputs.landmark, (slots,))
    checks.shape("inputs.z", inputs.z, (slots, sensor.dim))
    for name, value in (("dt", inputs.dt), ("control", inputs.control), ("z", inputs.z)):
        checks.dtype(f"inputs.{name}", value, np.floating)
    checks.dtype("inputs.landmark", inputs.landmark, np.integer)
    checks.dtype("inputs.valid", inputs.valid, np.bool_)
    if slots:
        params.block(sensor.noise)
    if slots and sensor.landmarks:
        if landmarks is None:
            raise ValueError(f"landmarks: expected (L, 2) for the {slots} observation slots, got None")
        checks.shape("landmarks", landmarks, (None, 2))
        checks.dtype("landmarks", landmarks, np.floating)
        if not len(landmarks):
            raise ValueError(f"landmarks: expected at least one for the {slots} observation slots, got (0, 2)")
    if config.matcher is not None and state.submaps is None:
        raise ValueError("state.submaps: expected submaps, as init makes with this config, got None")
    if (config.grid is not None or config.matcher is not None) and inputs.ranges is not None:
        if beam_angles is None:
            raise ValueError("beam_angles: expected (B,) for the ranges to map or to match, got None")
        checks.shape("beam_angles", beam_angles, (None,))
        checks.dtype("beam_angles", beam_angles, np.floating)
        checks.shape("inputs.ranges", inputs.ranges, np.shape(beam_angles))
        checks.dtype("inputs.ranges", inputs.ranges, np.floating)


def _check_landmarks(state: State, inputs: Inputs, landmarks: Any, config: Config) -> None:
    """Raise where landmarks that can be looked at, which no traced ones can, are too far out."""
    observed = np.shape(inputs.valid)[-1:] != (0,) and sensors.resolve(config.sensor).landmarks
    if observed and landmarks is not None and jnp.issubdtype(jnp.result_type(landmarks), jnp.floating):
        checks.resolved("landmarks", landmarks, state.belief.mean.dtype)


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
