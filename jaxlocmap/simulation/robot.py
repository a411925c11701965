"""Simulated robots: keys in, `Truth` and `Inputs` out.

`drive`, `detect` and `simulate_scan` each make one step out of given random numbers, so that a study can simulate and
filter in one loop and keep neither; `roll_out` makes a whole drive of them, also for a program with a generator of its
own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxlocmap import checks, sensors
from jaxlocmap._internal import batching
from jaxlocmap._internal.random import Words, lanes, normals, uniforms, words_of
from jaxlocmap._internal.trig import arctan2, sin_cos
from jaxlocmap.se2 import POSE, compose, wrap
from jaxlocmap.sensors import Sensor
from jaxlocmap.simulation.scenario import Noise, Scenario
from jaxlocmap.simulation.world import World, ray_cast
from jaxlocmap.types import Gaussian, Inputs, Truth

_ON_A_WALL = 1e-3  # m: a landmark this close behind a wall hangs on it


class Draws(NamedTuple):
    """The random numbers of a drive; what they are for is said where they are used."""

    drive: jax.Array  # (T, 3), or (T, q) for a plant with q inputs
    detection: jax.Array  # (T, L, m), or (T, L, 2 m + 1) with outliers; used where the detector is active
    scan: jax.Array | None = None  # (T, B); None without a scanner


# Where each use of a step's random numbers begins.
_DRIVE, _DETECTIONS, _SCAN = 0, 1 << 20, 1 << 30


def draw_state(key: jax.Array, prior: Gaussian) -> jax.Array:
    """A true state (n,) from the prior, so that the prior is honest.

    To start exactly where the filter believes, use `prior.mean`.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("mean", prior.mean, (None,))
    n = len(prior.mean)
    checks.shape("cov", prior.cov, (n, n))
    variance, axes = jnp.linalg.eigh(prior.cov)  # unlike Cholesky, content with a variance of zero
    spread = jnp.sqrt(jnp.maximum(variance, 0)) * jax.random.normal(key, (n,), prior.mean.dtype)
    state = prior.mean + axes @ spread
    return state.at[2].set(wrap(state[2]))


def draw_start(key: jax.Array, prior: Gaussian, *, scenario: Scenario) -> jax.Array:
    """The true state (n,) at step -1, with the n entries of the plant: the mean of the prior, or drawn from it, as the
    scenario says. Of a longer prior, which a filter may have, the first n.

    Raises:
        ValueError: a wrong shape.
    """
    return (prior.mean if scenario.exact_prior else draw_state(key, prior))[: scenario.dim]


def draw_drive(words: Words, k: jax.Array, *, scenario: Scenario, dtype: Any) -> jax.Array:
    """Random numbers for `drive` at step k, (3,) or (q,). words: of this drive alone, from `random.words_of`.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("k", k, ())
    return normals(words, k, _DRIVE, _drive_draws(scenario), dtype)


def drive(
    draws: jax.Array, k: jax.Array, state: jax.Array, noise: Noise, *, scenario: Scenario
) -> tuple[jax.Array, jax.Array]:
    """One step of the robot. Without `Scenario.plant` that of the course:

        x ← x + v cos(theta) dt,  y ← y + v sin(theta) dt,  theta ← wrap(theta + omega dt + heading noise)

    with noise on the control as it is measured. With a plant its transition, x ← f(x, u, dt), under an input u that is
    the command, which is what the robot measures, plus noise.

    Args:
        draws: (3,) standard normals for heading, v, omega; or (q,), for the inputs of the plant.
        k: () step, from 0.
        state: (n,), the true one before, beginning with the pose in m, m, rad.
        noise: as its fields say.
        scenario: static.

    Returns:
        The true state (n,), and the control (c,) as the robot measures it.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(draws=(draws, (_drive_draws(scenario),)), k=(k, ()), state=(state, (scenario.dim,)))
    _check_noise(noise)
    command, dt = scenario.command(k, state[:POSE]), scenario.dt
    if (plant := scenario.plant) is not None:
        std = [x for block in plant.noise for x in noise.std(block)]
        u = plant.full_input(command) + jnp.stack([s * draws[i] for i, s in enumerate(std)])
        return plant.transition(state, u, jnp.asarray(dt, state.dtype)), command
    v, w = command
    sin, cos = sin_cos(state[2])
    moved = [
        state[0] + v * cos * dt,
        state[1] + v * sin * dt,
        wrap(state[2] + w * dt + noise.heading * draws[0]),
    ]
    return jnp.stack(moved), jnp.stack([v + noise.v * draws[1], w + noise.w * draws[2]])


def _drive_draws(scenario: Scenario) -> int:
    return 3 if scenario.plant is None else scenario.plant.inputs


def targets(world: World, *, scenario: Scenario) -> jax.Array:
    """What the sensor reports, one slot each: the landmarks (L, 2) m; for one that observes none, a single slot."""
    return world.landmarks if _sensor(scenario).landmarks else jnp.zeros((1, 2), world.landmarks.dtype)


def draw_detection(words: Words, k: jax.Array, j: jax.Array, *, scenario: Scenario, dtype: Any) -> jax.Array:
    """Random numbers for `detect` of target j at step k, (m,) or, with outliers, (2 m + 1,).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(k=(k, ()), j=(j, ()))
    m = _sensor(scenario).dim
    first = _DETECTIONS + max(lanes(m) + lanes(m + 1), 4) * j
    normal = normals(words, k, first, m, dtype)
    if not scenario.detector.outliers:
        return normal
    uniform = uniforms(words, k, first + lanes(m), m + 1, dtype)
    return jnp.stack([*normal, *uniform])


def detect(
    draws: jax.Array, state: jax.Array, landmark: jax.Array, world: World, noise: Noise, *, scenario: Scenario
) -> tuple[jax.Array, jax.Array]:
    """What the robot's sensor makes of a landmark.

    Whether it reports one is decided by where the landmark truly is: a cut of what it measures would let through more
    of the readings that came out short, and noise so picked is no longer the noise that it has. A landmark on the
    sensor, which has no bearing, is not reported.

    Args:
        draws: (m,) standard normals for the components of an observation; with `Detector.outliers` (2 m + 1,), then
            uniform over (0, 1): whether the observation is false, and what each component then is.
        state: (n,), the true one, beginning with the pose in m, m, rad.
        landmark: (2,) m. A sensor that observes none takes no notice.
        world, noise: as their fields say.
        scenario: static.

    Returns:
        The observation (m,), and () bool whether the detector reports it: landmarks between its ranges and in its field
        of view. Within a few standard deviations of a landmark noise can make a range negative; the filter then leaves
        it out. Ranges of a false observation lie within reach, angles anywhere, the rest within reach of the truth.

    Raises:
        ValueError: a wrong shape.
    """
    sensor, detector = _sensor(scenario), scenario.detector
    checks.shapes(draws=(draws, (_detection_draws(scenario),)), state=(state, (None,)), landmark=(landmark, (2,)))
    _check_noise(noise)
    landmark_of_it = landmark if sensor.landmarks else None
    at_sensor, _ = sensors.mounted(state, landmark_of_it, sensor, scenario.robot.sensor_offset)
    std, m = noise.std(sensor.noise), sensor.dim
    exact = sensor.expected(at_sensor, landmark_of_it)
    z = [exact[i] + std[i] * draws[i] for i in range(m)]
    if detector.outliers:  # of what it reports, so that the rate is the share
        false = draws[m] < noise.outlier_rate
        z = [jnp.where(false, _false(sensor, i, exact, draws[m + 1 + i], detector.max_range), z[i]) for i in range(m)]
    z = jnp.stack([wrap(x) if i in sensor.angles else x for i, x in enumerate(z)])
    if not sensor.landmarks:
        return z, jnp.array(True)
    detected = _is_detected(at_sensor[:POSE], landmark, world, scenario)
    return z, detected if sensor.defined is None else detected & sensor.defined(at_sensor, landmark)


def _false(sensor: Sensor, i: int, exact: jax.Array, uniform: jax.Array, reach: float) -> jax.Array:
    if i in sensor.angles:
        return (2 * uniform - 1) * jnp.pi
    return uniform * reach if i in sensor.positive else exact[i] + (2 * uniform - 1) * reach


def _is_detected(pose: jax.Array, landmark: jax.Array, world: World, scenario: Scenario) -> jax.Array:
    detector = scenario.detector
    dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
    distance = jnp.sqrt(dx * dx + dy * dy)
    detected = distance < detector.max_range
    if detector.min_range > 0:
        detected = detected & (distance >= detector.min_range)
    if detector.field_of_view == 2 * jnp.pi and not detector.occlusion:
        return detected
    bearing = wrap(arctan2(dy, dx) - pose[2])
    if detector.field_of_view < 2 * jnp.pi:
        detected = detected & (jnp.abs(bearing) <= detector.field_of_view / 2)
    if detector.occlusion:
        wall = ray_cast(pose, bearing[None], world.segments, detector.max_range)[0]
        detected = detected & (distance < wall + _ON_A_WALL)
    return detected


def _sensor(scenario: Scenario) -> Sensor:
    return sensors.resolve(scenario.robot.sensor)


def _detection_draws(scenario: Scenario) -> int:
    m = _sensor(scenario).dim
    return 2 * m + 1 if scenario.detector.outliers else m


def _check_noise(noise: Noise) -> None:
    checks.shapes(**{f"noise.{name}": (x, ()) for name, x in noise._asdict().items() if name != "blocks"})


def draw_scan(words: Words, k: jax.Array, *, scenario: Scenario, dtype: Any) -> jax.Array:
    """Random numbers for `simulate_scan` at step k, (B,).

    Raises:
        ValueError: a wrong shape.
    """
    checks.shape("k", k, ())
    return normals(words, k, _SCAN, scenario.beams, dtype)


def simulate_scan(draws: jax.Array, state: jax.Array, world: World, noise: Noise, *, scenario: Scenario) -> jax.Array:
    """A scan of the walls, (B,) m. Noise is added after the cut at `max_range`, as the course has it.

    Args:
        draws: (B,) standard normals.
        state: (n,), the true one, beginning with the pose in m, m, rad.
        world, noise: as their fields say.
        scenario: static.

    Raises:
        ValueError: a wrong shape.
    """
    checks.shapes(draws=(draws, (scenario.beams,)), state=(state, (None,)))
    _check_noise(noise)
    scanner = scenario.robot.scanner(scenario.beam_angles().astype(state.dtype))
    pose, _ = compose(state[:POSE], scanner.offset)
    exact = ray_cast(pose, scanner.beam_angles, world.segments, scanner.max_range)
    return jnp.maximum(exact + draws * noise.scan, scanner.min_range)


def simulate(
    key: jax.Array,
    world: World,
    noise: Noise,
    start: jax.Array,
    *,
    scenario: Scenario,
    scan: bool = True,
) -> tuple[Truth, Inputs]:
    """One drive.

    Args:
        key: of this drive alone.
        world, noise: as their fields say.
        start: (n,), the true state at step -1, beginning with the pose in m, m, rad: the prior's mean, or one from
            `draw_state`. Its dtype is that of everything that follows.
        scenario: static.
        scan: False leaves out the scanner, which costs most of a simulation.

    Returns:
        The true states and what the robot measured, both with a leading axis T: the control; at the steps at which the
        detector is active, what it detects, slot j holding landmark j; a scan a step.

    Raises:
        ValueError: a wrong shape; a batch of drives is a `vmap`.
    """
    _check_start(start, world, scenario)
    checks.shape("key", key, () if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else (None,))
    words, dtype, slots = words_of(key), start.dtype, jnp.arange(len(targets(world, scenario=scenario)))

    def numbers(k: jax.Array) -> Draws:
        return Draws(
            drive=draw_drive(words, k, scenario=scenario, dtype=dtype),
            detection=jax.vmap(lambda j: draw_detection(words, k, j, scenario=scenario, dtype=dtype))(slots),
            scan=draw_scan(words, k, scenario=scenario, dtype=dtype) if scan else None,
        )

    return roll_out(jax.vmap(numbers)(jnp.arange(scenario.steps)), world, noise, start, scenario=scenario)


def roll_out(draws: Draws, world: World, noise: Noise, start: jax.Array, *, scenario: Scenario) -> tuple[Truth, Inputs]:
    """`simulate` with given random numbers.

    Raises:
        ValueError: a wrong shape.
    """
    _check_start(start, world, scenario)
    landmarks = targets(world, scenario=scenario)
    checks.shape("draws.drive", draws.drive, (scenario.steps, _drive_draws(scenario)))
    checks.shape("draws.detection", draws.detection, (scenario.steps, len(landmarks), _detection_draws(scenario)))
    if draws.scan is not None:
        checks.shape("draws.scan", draws.scan, (scenario.steps, scenario.beams))

    def body(state: jax.Array, now: tuple[jax.Array, Draws]) -> tuple[jax.Array, tuple[Truth, Inputs]]:
        k, draws = now
        state, control = drive(draws.drive, k, state, noise, scenario=scenario)
        z, detected = jax.vmap(lambda d, landmark: detect(d, state, landmark, world, noise, scenario=scenario))(
            draws.detection, landmarks
        )
        valid = detected & scenario.detector.active(k)
        inputs = Inputs(
            dt=jnp.asarray(scenario.dt, state.dtype),
            control=control,
            landmark=jnp.arange(len(valid), dtype=jnp.int32),
            z=jnp.where(valid[:, None], z, 0),
            valid=valid,
            ranges=None if draws.scan is None else simulate_scan(draws.scan, state, world, noise, scenario=scenario),
        )
        return state, (Truth(state), inputs)

    return batching.scan(body, start, (jnp.arange(scenario.steps), draws))[1]


def _check_start(start: jax.Array, world: World, scenario: Scenario) -> None:
    checks.shapes(start=(start, (scenario.dim,)), landmarks=(world.landmarks, (None, 2)))
