"""States beyond a pose: a gyro's bias in the filter and in the robot, states of any size, controls of any length."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats
from drives import like

from jaxlocmap import Block, Config, Gaussian, Inputs, Params, init, motion, parameters, run, se2, simulation, tuning
from jaxlocmap._internal import linalg
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap._internal.trig import sin_cos
from jaxlocmap.consistency import nees, scoring
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.filters import ekf
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.sensors import Sensor
from jaxlocmap.step import is_valid

DRIFT = Block("gyro", ("drift",), ("rad/s²",))


def gyro_transition(state, u, dt):
    pose = motion.EULER.transition(state[:3], jnp.stack([u[0], u[1] - state[3]]), dt)
    return jnp.append(pose, state[3] + u[2] * dt)


def gyro_jacobians(state, u, dt):
    """As a user would write them who wants few products: the numbers are structure."""
    (sin, cos), step = sin_cos(state[2]), u[0] * dt
    F = Matrix([[1, 0, -step * sin, 0], [0, 1, step * cos, 0], [0, 0, 1, -dt], [0, 0, 0, 1]])
    return F, Matrix([[cos * dt, 0, 0], [sin * dt, 0, 0], [0, dt, 0], [0, 0, dt]])


GYRO = motion.MotionModel(gyro_transition, gyro_jacobians, dim=4, noise=(parameters.Q, DRIFT))
LOOP = simulation.LOOP
SCENARIO = dataclasses.replace(
    LOOP, name="gyro", plant=GYRO, start=(*LOOP.start, 0.0), prior_std=(*LOOP.prior_std, 0.05)
)
NOISE = simulation.Noise(w=0.05, blocks={"gyro": 0.02})
OWN = simulation.own_params(NOISE, SCENARIO)


def wider(model):
    """The model with one more entry, which stands still."""

    def transition(state, u, dt):
        return jnp.append(model.transition(state[:-1], u, dt), state[-1])

    def jacobians(state, u, dt):
        F, G = model.jacobians(state[:-1], u, dt)
        n, q = model.dim, model.inputs
        return Matrix([*((*row, 0) for row in F.rows), (*[0] * n, 1)]), Matrix([*G.rows, (0,) * q])

    return model._replace(transition=transition, jacobians=jacobians, dim=model.dim + 1)


def test_jacobians_by_hand_are_those_of_the_transition(tolerance):
    model = wider(GYRO)
    args = np.array([1.0, 2.0, 0.7, 0.05, 3.0]), np.array([0.4, 0.3, 0.01]), np.float64(0.1)
    left = motion.from_transition(model.transition, dim=5, noise=model.noise)
    got, expected = jax.jit(
        lambda *args: [[Matrix.of(x).array(args[0].dtype) for x in m.jacobians(*args)] for m in (model, left)]
    )(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance(1e-14, 1e-6)), got, expected)


def report_of(scenario, params, noise, model, runs):
    config = scenario.config(motion=model, gate_probability=None, grid=False)
    scene = params, simulation.room(), noise, scenario.prior()
    return summarise(monte_carlo(Study(scenario, config), jax.random.key(0), runs, *scene).value, config)


@pytest.mark.slow
def test_a_filter_that_knows_of_the_bias_is_consistent_and_one_that_does_not_is_not():
    """The bias starts with 0.05 rad/s and wanders by 0.02 rad/s² · √(0.1 s · 30 s): enough to turn an ignorant filter
    over-confident, its ANEES to three times what it should be. Of 500 runs the band of an honest one is ±3 %.

    The filter that knows has a fifth entry that its robot has not: scored is what both have, χ² of four.
    """
    start = {"start": (*SCENARIO.start, 0.0), "prior_std": (*SCENARIO.prior_std, 1.0)}
    scenario = dataclasses.replace(SCENARIO, steps=300)
    knows = report_of(dataclasses.replace(scenario, **start), OWN, NOISE, wider(GYRO), 500)
    low, high = knows["anees_band_95"]
    assert low <= knows["anees"] <= high
    low, high = knows["state_anees_band_95"]
    assert (knows["state_dimension"], low <= knows["state_anees"] <= high) == (4, True)
    assert knows["verdict"].startswith("consistent")
    ignorant = report_of(scenario, OWN, NOISE, motion.EULER, 500)
    assert ignorant["anees"] > 2 * ignorant["anees_band_95"][1]
    assert ignorant["verdict"].startswith("over-confident")
    assert "state_anees" not in ignorant


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_the_drift_of_the_bias_is_tuned_to_within_two_standard_errors():
    scenario = dataclasses.replace(SCENARIO, steps=200)
    config = scenario.config(motion=GYRO, gate_probability=None, grid=False)
    batch = tuning.simulated(jax.random.key(1), 48, simulation.room(), NOISE, scenario=scenario)
    objective = tuning.Objective(config, (("pose_nll", 1.0),))
    start = simulation.own_params(NOISE._replace(blocks={"gyro": 0.06}), scenario)
    found = tuning.fit(objective, start, batch, tuned=("drift",), epochs=3)
    sure = tuning.standard_errors(objective, found.params, batch, ("drift",))
    assert abs(sure.estimate[0] - 0.02) < 2 * sure.standard_error[0] < 0.01
    np.testing.assert_allclose(found.params.Q, start.Q, rtol=1e-12)  # through its coordinates and back
    assert tuning.units_of(objective.blocks)["drift"] == "rad/s²"


# --- any size against NumPy


def wide_model(n):
    """A pose and n - 3 more entries that push it and decay; entry 4, if there is one, is an angle."""
    rest = n - 3
    push = np.sin(np.arange(3 * rest)).reshape(3, rest) * 0.3

    def transition(state, u, dt):
        pose = motion.EULER.transition(state[:3], u[:2], dt)
        if not rest:
            return pose
        moved = pose + dt * jnp.asarray(push, state.dtype) @ state[3:]
        more = state[3:] * 0.9 + dt * u[2:]
        return se2.wrap_entries(jnp.concatenate([moved, more]), angles)

    angles = (2, 4) if n > 4 else (2,)
    block = Block("more", tuple(f"m{i}" for i in range(rest)), ("–",) * rest)
    return motion.from_transition(
        transition, dim=n, angles=angles, noise=(parameters.Q, block) if rest else (parameters.Q,)
    )


def drive_of(n, steps=7):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    prior = Gaussian(jnp.asarray(rng.normal(size=n)), jnp.asarray(A @ A.T / n * 0.02 + 0.01 * np.eye(n)))
    inputs = Inputs(
        dt=jnp.asarray(rng.uniform(0.05, 0.2, steps)),
        control=jnp.asarray(rng.normal(size=(steps, 2))),
        landmark=jnp.asarray(rng.integers(0, 3, (steps, 2)), jnp.int32),
        z=jnp.asarray(np.stack([rng.uniform(1, 4, (steps, 2)), rng.uniform(-3, 3, (steps, 2))], axis=-1)),
        valid=jnp.asarray(rng.uniform(size=(steps, 2)) < 0.7),
    )
    landmarks = jnp.asarray(rng.normal(size=(3, 2)) * 3)
    std = {"more": tuple(rng.uniform(0.1, 0.5, n - 3))} if n > 3 else {}
    return Params.from_std(v=0.1, w=0.2, range=0.3, bearing=0.2, **std), prior, inputs, landmarks


def numpy_run(model, params, prior, inputs, landmarks, nominal):
    """The textbook in NumPy, the Jacobians of the model by central differences."""
    mean, cov = (np.asarray(x, np.float64) for x in prior)
    n, q = model.dim, model.inputs
    Q = np.zeros((q, q))
    Q[:2, :2] = params.Q
    if q > 2:
        Q[2:, 2:] = params.blocks["more"]

    moved = jax.jit(model.transition)

    def f(x, u, dt):
        return np.asarray(moved(x, u, dt))

    def slope(g, x):
        h = 1e-6
        columns = [(g(x + h * e) - g(x - h * e)) for e in np.eye(len(x))]
        for column in columns:
            column[list(model.angles)] = reference.wrap(column[list(model.angles)])
        return np.array(columns).T / (2 * h)

    for k in range(len(inputs.dt)):
        dt, u = float(inputs.dt[k]), np.append(np.asarray(inputs.control[k]), np.zeros(q - 2))
        F = slope(functools.partial(f, u=u, dt=dt), mean)
        G = slope(functools.partial(lambda u, x, dt: f(x, u, dt), x=mean, dt=dt), u)
        mean, cov = f(mean, u, dt), F @ cov @ F.T + G @ Q @ G.T * nominal / dt
        for m in np.flatnonzero(inputs.valid[k]):
            h, H = reference.expected_observation(mean[:3], np.asarray(landmarks[inputs.landmark[k, m]]))
            H = np.hstack([H, np.zeros((2, n - 3))])
            r = np.asarray(inputs.z[k, m]) - h
            r[1] = reference.wrap(r[1])
            S = H @ cov @ H.T + np.asarray(params.R)
            K = cov @ H.T @ np.linalg.inv(S)
            mean = mean + K @ r
            mean[list(model.angles)] = reference.wrap(mean[list(model.angles)])
            cov = cov - K @ S @ K.T
    return mean, cov


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("n", [3, 4, 5, linalg.SMALL + 2])
def test_a_filter_of_any_size_is_the_textbook(n):
    model, (params, prior, inputs, landmarks) = wide_model(n), drive_of(n)
    config = Config(motion=model, gate_probability=None)
    assert prior.mean.dtype == jnp.float64
    state, info = run(params, init(prior, config=config), inputs, landmarks=landmarks, config=config)
    mean, cov = numpy_run(model, params, prior, inputs, landmarks, config.dt)
    np.testing.assert_allclose(state.belief.mean, mean, rtol=0, atol=1e-8)  # central differences: 1e-9 each
    np.testing.assert_allclose(state.belief.cov, cov, rtol=0, atol=1e-8)
    assert bool(jnp.all(info.ok))


@pytest.mark.usefixtures("x64")
def test_the_same_filter_unrolled_or_not(monkeypatch):
    """By fixes of its place: the search for a landmark is the same for both. Of four entries: so is an angle's wrap."""
    n = 4
    params, prior, inputs, _ = drive_of(n)
    fix = Sensor(
        Block("fix", ("east", "north"), ("m", "m")),
        expected=lambda state, _: state[:2],
        jacobian=lambda state, _: Matrix([[1, 0, 0], [0, 1, 0]]),
        landmarks=False,
    )
    near = np.asarray(prior.mean[:2]) + 0.5 * np.random.default_rng(0).normal(size=inputs.z.shape)
    inputs = inputs._replace(z=jnp.asarray(near))

    def likelihood(R):
        config = Config(motion=wide_model(n), gate_probability=0.99, sensor=fix)
        own = params._replace(blocks=params.blocks | {"fix": R})
        state, info = run(own, init(prior, config=config), inputs, config=config)
        return state.log_likelihood, (state.log_likelihood, info.accepted)

    sloped = jax.jacfwd(likelihood, has_aux=True)  # forward, as tuning takes it
    slope_unrolled, (unrolled, accepted) = jax.jit(sloped)(params.R)
    assert 0 < accepted.sum() < inputs.valid.sum()
    for module in (linalg, ekf):
        monkeypatch.setattr(module, "SMALL", 3)
    slope, (whole, _) = jax.jit(lambda R: sloped(R))(params.R)  # traced anew
    np.testing.assert_allclose(whole, unrolled, rtol=1e-10)
    np.testing.assert_allclose(slope + slope.T, slope_unrolled + slope_unrolled.T, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("n", [4, linalg.SMALL + 1])
def test_a_large_covariance_is_valid_or_not_and_has_a_nees(n, tolerance):
    rng = np.random.default_rng(0)
    A = rng.normal(size=(n, n))
    cov, error = A @ A.T + np.eye(n), rng.normal(size=n)
    valid = jax.jit(lambda mean, cov: is_valid(Gaussian(mean, cov)))
    assert valid(jnp.zeros(n), jnp.asarray(cov))
    assert valid(jnp.zeros(n), jnp.zeros((n, n)))
    values, axes = np.linalg.eigh(cov)
    below = axes @ np.diag(np.append(values[1:], -0.01 * values[-1])) @ axes.T
    assert not valid(jnp.zeros(n), jnp.asarray((below + below.T) / 2))
    for at in (2, n - 1):
        assert not valid(jnp.zeros(n).at[at].set(jnp.nan), jnp.asarray(cov))
        assert not valid(jnp.zeros(n), jnp.asarray(cov).at[at, at].set(-1.0))
        assert not valid(jnp.zeros(n), jnp.asarray(cov).at[at, at].set(jnp.nan))
    rtol = tolerance(1e-10, 1e-4)
    np.testing.assert_allclose(
        nees(jnp.asarray(error), jnp.asarray(cov)), error @ np.linalg.solve(cov, error), rtol=rtol
    )
    assert np.isnan(nees(jnp.asarray(error), -jnp.asarray(cov)))


def test_a_control_may_end_where_a_block_of_noise_does():
    seen = []

    def transition(state, u, dt):
        seen.append(u.shape)
        return state

    model = motion.from_transition(transition, noise=(parameters.Q, DRIFT))
    for control in (jnp.array([1.0, 2.0]), jnp.array([1.0, 2.0, 3.0])):
        np.testing.assert_array_equal(model.full_input(control), [1, 2, 3 if len(control) == 3 else 0])
    for wrong in ((1,), (4,), (2, 1), ()):
        with pytest.raises(ValueError, match=r"^control: expected shape \(2\) or \(3\), got"):
            model.full_input(jnp.ones(wrong))


@pytest.mark.parametrize(("dim", "angles"), [(2, (2,)), (4, ()), (4, (3,)), (4, (2, 4))])
def test_a_model_without_a_heading_is_refused(dim, angles):
    with pytest.raises(ValueError, match="dim, angles: expected a pose"):
        motion.from_transition(gyro_transition, dim=dim, angles=angles)


def test_the_parameters_of_a_model_are_asked_for_by_name():
    config = Config(motion=GYRO)
    prior = Gaussian(jnp.zeros(4), jnp.eye(4))
    inputs = jax.tree.map(jnp.asarray, tuning.no_observations(2))
    with pytest.raises(ValueError, match=r"params\.gyro: expected the covariance of \(drift\) \(1, 1\), got none"):
        run(simulation.course_params(), init(prior, config=config), inputs, config=config)
    wrong = simulation.course_params()._replace(blocks={"gyro": jnp.eye(2)})
    with pytest.raises(ValueError, match=r"params\.gyro: expected shape \(1, 1\), got \(2, 2\)"):
        run(wrong, init(prior, config=config), inputs, config=config)
    with pytest.raises(ValueError, match=r"prior\.mean: expected shape \(4\), got \(3,\)"):
        init(Gaussian(jnp.zeros(3), jnp.eye(3)), config=config)


# --- the plant


def test_a_plant_moves_by_its_own_model_under_its_own_noise(tolerance):
    """Noise-free it is the model; with noise, what it adds to the inputs has the standard deviations that are said."""
    still = simulation.Noise(v=0.0, w=0.0, blocks={"gyro": 0.0})
    scenario = dataclasses.replace(SCENARIO, steps=5)
    start = jnp.array([9.0, 5.4, 1.5, 0.1])
    simulated = jax.jit(functools.partial(simulation.simulate, scenario=scenario, scan=False))
    truth, inputs = simulated(jax.random.key(0), simulation.room(), still, start)
    state = start
    for k in range(5):
        command = scenario.command(jnp.array(k), state[:3])
        np.testing.assert_allclose(inputs.control[k], command, rtol=tolerance(1e-12, 1e-5))
        state = GYRO.transition(state, GYRO.full_input(command), jnp.asarray(0.1, state.dtype))
        np.testing.assert_allclose(truth.state[k], state, rtol=0, atol=tolerance(1e-12, 1e-5))
    assert truth.pose.shape == (5, 3)
    one = jax.jit(jax.vmap(lambda d: simulation.drive(d, jnp.array(0), start, NOISE, scenario=scenario)[0][3]))
    draws = jax.random.normal(jax.random.key(1), (4000, 3))
    bias = np.asarray(one(draws)) - 0.1
    np.testing.assert_allclose(bias, 0.1 * 0.02 * np.asarray(draws[:, 2]), rtol=0, atol=1e-6)


def test_a_study_wants_the_longer_of_the_two_states():
    config = SCENARIO.config(motion="arc", gate_probability=None, grid=False)
    with pytest.raises(ValueError, match=r"prior\.mean: expected shape \(4\), got \(3,\)"):
        Study(SCENARIO, config)(jax.random.key(0), OWN, simulation.room(), NOISE, LOOP.prior())
    with pytest.raises(ValueError, match="start, prior_std: expected the 4 of the plant's state or more"):
        dataclasses.replace(SCENARIO, start=LOOP.start, prior_std=LOOP.prior_std)


def test_a_filter_may_estimate_what_its_robot_does_not_have():
    """A bias in the filter alone: the robot starts at the first three entries."""
    scenario = like(LOOP, steps=20, start=(*LOOP.start, 0.0), prior_std=(*LOOP.prior_std, 0.01))
    params = simulation.own_params(simulation.Noise(), LOOP)._replace(blocks={"gyro": jnp.full((1, 1), 1e-6)})
    report = report_of(scenario, params, simulation.Noise(), GYRO, 200)
    assert abs(report["anees"] - 3) < 4 * report["anees_standard_error"]
    assert "state_anees" not in report


def test_the_noise_of_a_block_is_said_once_or_for_each_component():
    pair = Block("gps", ("east", "north"), ("m", "m"))
    assert simulation.Noise(blocks={"gps": 0.5}).std(pair) == [0.5, 0.5]
    assert simulation.Noise(blocks={"gps": np.array([0.5, 0.7])}).std(pair) == [0.5, 0.7]
    for blocks, got in (({}, "none"), ({"gps": np.ones(3)}, r"shape \(3,\)")):
        with pytest.raises(ValueError, match=rf"noise\.blocks\['gps'\]: expected 2 standard deviations, got {got}"):
            simulation.Noise(blocks=blocks).std(pair)


def test_whole_state_nees_counts_every_entry(tolerance):
    """Of the prior itself, drawn honestly: χ² with 4 degrees; and so a step is scored whose filter has as many."""
    prior = SCENARIO.prior()

    @jax.jit
    @jax.vmap
    def drawn(key):
        state = simulation.draw_state(key, prior)
        tally, *_ = scoring.score_step(prior, state, jnp.array(True), jnp.array(0), angles=GYRO.angles)
        return nees(se2.boxminus(state, prior.mean), prior.cov), tally

    distance, tally = drawn(jax.random.split(jax.random.key(0), 4000))
    assert scipy.stats.kstest(np.asarray(distance), "chi2", args=(4,)).pvalue > 1e-4
    np.testing.assert_allclose(tally.state_nees, distance, rtol=tolerance(1e-12, 1e-4))
    np.testing.assert_array_equal(tally.state_scored, 1)
