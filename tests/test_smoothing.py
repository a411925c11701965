"""The smoother: against the dense joint Gaussian of a linear model, and in limiting cases."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Config, Gaussian, Inputs, Matcher, MotionModel, Params, Sensor, init, run, simulation
from jaxlocmap.motion import from_transition
from jaxlocmap.parameters import Block
from jaxlocmap.smoothing import smooth

pytestmark = pytest.mark.usefixtures("x64")
STEPS, DT = 12, 0.5
PUSH = Block("push", ("a", "b", "c"), ("m/s", "m/s", "rad/s"))
FIX = Block("fix", ("x", "y"), ("m", "m"))
PUSHED: MotionModel = from_transition(lambda state, u, dt: state + dt * u, noise=(PUSH,))
POSITION = Sensor(noise=FIX, expected=lambda state, landmark: state[:2], landmarks=False)
CONFIG = Config(dt=DT, motion=PUSHED, sensor=POSITION, gate_probability=None)
SMOOTH = jax.jit(smooth, static_argnames="config")


@functools.cache
def drive(seen=True):
    """A filtered drive of the linear model; positions are seen at every third step."""
    rng = np.random.default_rng(0)
    noise = {"push": np.diag([0.04, 0.09, 0.01]), "fix": np.array([[0.09, 0.02], [0.02, 0.16]])}
    params = Params.from_std(v=1.0, w=1.0, range=1.0, bearing=1.0)._replace(
        blocks={name: jnp.asarray(x) for name, x in noise.items()}
    )
    prior = Gaussian(jnp.array([1.0, -1.0, 0.3]), jnp.diag(jnp.array([0.5, 0.4, 0.1])))
    valid = (np.arange(STEPS) % 3 == 1)[:, None] & seen
    inputs = Inputs(
        dt=jnp.full(STEPS, DT),
        control=jnp.asarray(rng.normal(size=(STEPS, 3)) * [1, 1, 0.2]),
        landmark=jnp.zeros((STEPS, 1), jnp.int32),
        z=jnp.asarray(rng.normal(size=(STEPS, 1, 2))),
        valid=jnp.asarray(valid),
    )
    _, info = jax.jit(run, static_argnames="config")(params, init(prior, config=CONFIG), inputs, config=CONFIG)
    return params, noise, prior, inputs, info


def joint(noise, prior, inputs):
    """Mean and covariance of all states after the prior's, given everything: one dense system."""
    n = 3 * (STEPS + 1)
    H, g = np.zeros((n, n)), np.zeros(n)
    first = np.linalg.inv(prior.cov)
    H[:3, :3] += first
    g[:3] += first @ prior.mean
    W = np.linalg.inv(noise["push"] * DT**2)
    fix = np.linalg.inv(noise["fix"])
    for k in range(STEPS):
        a, b = slice(3 * k, 3 * k + 3), slice(3 * k + 3, 3 * k + 6)
        J = np.zeros((3, n))
        J[:, a], J[:, b] = -np.eye(3), np.eye(3)
        H += J.T @ W @ J
        g += J.T @ W @ (DT * np.asarray(inputs.control[k]))
        if inputs.valid[k, 0]:
            H[b, b][:2, :2] += fix
            g[b][:2] += fix @ np.asarray(inputs.z[k, 0])
    cov = np.linalg.inv(H)
    mean = cov @ g
    return mean[3:].reshape(-1, 3), np.array([cov[i : i + 3, i : i + 3] for i in range(3, n, 3)])


def test_linear_model():
    params, noise, prior, inputs, info = drive()
    mean, cov = joint(noise, prior, inputs)
    smoothed = SMOOTH(params, info.belief, inputs, config=CONFIG)
    np.testing.assert_allclose(smoothed.mean, mean, atol=1e-10)
    np.testing.assert_allclose(smoothed.cov, cov, atol=1e-10)


def test_the_last_is_the_filters_and_none_is_less_certain():
    params, _, _, inputs, info = drive()
    smoothed = SMOOTH(params, info.belief, inputs, config=CONFIG)
    np.testing.assert_array_equal(smoothed.mean[-1], info.belief.mean[-1])
    less = np.linalg.eigvalsh(np.asarray(info.belief.cov - smoothed.cov))
    assert less.min() > -1e-12
    assert less[0].max() > 0.1


def test_without_observations_nothing_changes():
    params, _, _, inputs, info = drive(seen=False)
    smoothed = SMOOTH(params, info.belief, inputs, config=CONFIG)
    np.testing.assert_allclose(smoothed.mean, info.belief.mean, atol=1e-12)
    np.testing.assert_allclose(smoothed.cov, info.belief.cov, atol=1e-12)


def test_a_control_that_is_no_number_moves_nothing():
    params, _, prior, inputs, _ = drive()
    broken = inputs._replace(control=inputs.control.at[5].set(jnp.nan))
    _, info = jax.jit(run, static_argnames="config")(params, init(prior, config=CONFIG), broken, config=CONFIG)
    smoothed = SMOOTH(params, info.belief, broken, config=CONFIG)
    assert np.isfinite(smoothed.mean).all()
    still = inputs._replace(control=inputs.control.at[5].set(0.0))
    np.testing.assert_allclose(smoothed.mean, SMOOTH(params, info.belief, still, config=CONFIG).mean, atol=1e-12)


def test_simulated_drives_are_nearer_and_covered():
    """60 drives of the course's robot, its own noise: the smoother errs less than the filter, and its NEES is 3 within
    five standard errors of the runs' averages, and 0.3 for what one linearisation leaves.
    """
    scenario, noise = simulation.CAPSTONE, simulation.Noise()
    config = scenario.config(motion="euler", gate_probability=None, grid=False)
    params, world, prior = simulation.own_params(noise, scenario), simulation.room(), scenario.prior()

    def one(key):
        first, key = jax.random.split(key)
        start = simulation.draw_start(first, prior, scenario=scenario)
        truth, inputs = simulation.simulate(key, world, noise, start, scenario=scenario, scan=False)
        _, info = run(params, init(prior, config=config), inputs, landmarks=world.landmarks, config=config)
        scores = []
        for belief in (info.belief, smooth(params, info.belief, inputs, config=config)):
            error = truth.pose - belief.mean
            error = error.at[:, 2].set(jnp.arctan2(jnp.sin(error[:, 2]), jnp.cos(error[:, 2])))
            nees = jnp.sum(error * jnp.linalg.solve(belief.cov, error[..., None])[..., 0], axis=-1)
            scores.append((jnp.mean(jnp.sum(error[:, :2] ** 2, axis=-1)), jnp.mean(nees[20:])))
        return jnp.array(scores)

    scores = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 60)))
    assert scores[:, 1, 0].mean() < 0.8 * scores[:, 0, 0].mean()
    nees = scores[:, 1, 1]
    assert abs(nees.mean() - 3) < 5 * nees.std() / np.sqrt(60) + 0.3


def test_refused():
    params, _, _, inputs, info = drive()
    with pytest.raises(ValueError, match="beliefs of a filter that matches scans are not smoothed"):
        smooth(params, info.belief, inputs, config=Config(matcher=Matcher()))
    with pytest.raises(ValueError, match="dt: expected shape"):
        smooth(params, info.belief, inputs._replace(dt=jnp.zeros(3)), config=CONFIG)
