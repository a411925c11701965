"""The descent: what it finds, keeps and counts, and what it refuses."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.optimize
from drives import CONFIG, ONLY_POSES, OWN, SHORT, drives
from jax.flatten_util import ravel_pytree

from jaxlocmap import simulate, tuning

OBJECTIVE = tuning.Objective(ONLY_POSES, (("innovation", 1.0),))
START = simulate.course_params()


def test_it_finds_the_robots_own_noise(x64):
    """Of 400 drives with one reading in twenty false. A deviation of n errors is known to 1 / sqrt(2 n) of itself; four
    times that, and 2 % for readings that are false but near enough to be half believed. The yaw rate shows up in few of
    so short drives.
    """
    lying = dataclasses.replace(SHORT, name="lying", steps=40, outliers=True)
    noise = simulate.Noise(outlier_rate=0.05)
    batch = tuning.simulated(jax.random.key(4), 400, simulate.room(), noise, scenario=lying)
    soft = dataclasses.replace(ONLY_POSES, gate_softness=2.0)
    fit = tuning.fit(tuning.Objective(soft, (("innovation", 1.0),)), START, batch)
    found, own = ({k: float(x) for k, x in tuning.natural(params).items()} for params in (fit.params, OWN))
    known = 4 / math.sqrt(2 * float(np.sum(np.asarray(batch.inputs.valid))))
    for name in ("range", "bearing"):
        assert found[name] == pytest.approx(own[name], rel=known + 0.02), name
    assert found["w"] == pytest.approx(own["w"], rel=0.1)
    assert fit.stopped_early
    assert fit.losses[fit.best_epoch] == fit.loss == min(fit.losses)
    assert not fit.trace.skipped.any()
    assert np.all(fit.trace.evaluations >= 1)


def test_what_is_kept_skipped_and_left_alone():
    """Of two drives one sees nothing, so that half of the minibatches of one have no loss. Steps are far too long, and
    three epochs that do not help end it.
    """
    batch = tuning.pick(drives(scans=False), slice(0, 2))
    valid = np.array(batch.inputs.valid)
    valid[1] = False
    batch = batch._replace(inputs=batch.inputs._replace(valid=jnp.asarray(valid)))
    seen = []
    fit = tuning.fit(
        OBJECTIVE,
        START,
        batch,
        tuned=("range",),
        optimiser=optax.sgd(2.0),
        minibatch=1,
        key=jax.random.key(0),
        epochs=12,
        steps=4,
        patience=3,
        progress=seen.append,
    )
    # A step without a loss is skipped and counted.
    assert 0 < fit.trace.skipped.sum() < len(fit.trace.skipped)
    np.testing.assert_array_equal(np.isfinite(fit.trace.loss), ~fit.trace.skipped)
    moved = np.abs(np.diff(fit.trace.params["range"])) > 0
    np.testing.assert_array_equal(moved, ~fit.trace.skipped[:-1])
    # What is not tuned stays, and the best is kept.
    for name in ("v", "w", "bearing", "l_occ", "l_free"):
        np.testing.assert_allclose(tuning.natural(fit.params)[name], tuning.natural(START)[name], rtol=1e-6)
    assert np.isfinite(fit.losses).all()
    assert fit.loss == min(fit.losses) == fit.losses[fit.best_epoch] < fit.losses[0]
    assert OBJECTIVE.judged(fit.params, batch)[0] == pytest.approx(fit.loss, rel=1e-5)
    fit.params.check()
    # After every epoch the fit so far is there to be kept.
    epochs = fit.best_epoch + 3
    assert [len(so_far.losses) for so_far in seen] == list(range(2, epochs + 2))
    assert [len(so_far.trace.loss) for so_far in seen] == list(range(4, 4 * epochs + 1, 4))
    assert fit.stopped_early
    assert epochs < 12


def test_scipy_takes_the_same_gradient(x64):
    batch, names = drives(scans=False), ("range", "bearing")
    f = tuning.coordinates_objective(OBJECTIVE, START, names)
    start, unravel = ravel_pytree({name: tuning.unconstrain(START)[name] for name in names})
    slope = jax.jit(jax.value_and_grad(lambda x: f(unravel(x), batch)[0]))
    found = scipy.optimize.minimize(lambda x: jax.tree.map(np.asarray, slope(x)), start, jac=True, method="L-BFGS-B")
    assert found.success
    assert found.fun < float(slope(start)[0]) - 0.1
    assert np.all(np.abs(found.jac) < 1e-3)
    with pytest.raises(ValueError, match="tuned: expected some of"):
        tuning.coordinates_objective(OBJECTIVE, START, ("speed",))


@pytest.mark.parametrize("name", ["epochs", "steps", "patience"])
def test_no_epochs_and_no_steps_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
        tuning.fit(OBJECTIVE, START, drives(scans=False), **{name: 0})


@pytest.mark.parametrize("losses", [("nees",), ("nis",), ("nees", "nis"), ("nees", "map")])
def test_two_equations_do_not_tell_three_parameters(losses):
    objective = tuning.Objective(CONFIG, tuple((name, 1.0) for name in losses))
    named = "`, `".join(name for name in losses if name != "map")
    with pytest.raises(ValueError, match=rf"^tuned: the loss `{named}` compares .* two equations.* got v, w, range$"):
        tuning.fit(objective, START, drives(), tuned=("v", "w", "range", "l_occ"))
    objective.check_tuned(("v", "range", "l_occ", "l_free"))


@pytest.mark.parametrize("losses", [("nees", "pose"), ("nis", "innovation"), ("nees", "nis", "state"), ("map",)])
def test_beside_another_loss_they_may(losses):
    tuning.Objective(CONFIG, tuple((name, 1.0) for name in losses)).check_tuned(tuning.NAMES)


def test_a_batch_that_the_dtype_cannot_hold_is_refused():
    batch = drives(scans=False)
    far = batch._replace(landmarks=np.asarray(batch.landmarks, np.float32) + np.float32(388_096))
    far = far._replace(prior=jax.tree.map(lambda x: x.astype(jnp.float32), far.prior))
    with pytest.raises(ValueError, match=r"^batch\.landmarks: expected coordinates that float32 holds"):
        tuning.fit(OBJECTIVE, START, far)


def test_a_start_beyond_the_limits_is_refused():
    with pytest.raises(ValueError, match=r"range: expected a value within the limits of tuning.*got 1e\+06"):
        tuning.fit(OBJECTIVE, START._replace(R=START.R * jnp.array([[1e12 / 0.0225, 0], [0, 1]])), drives(scans=False))


def test_a_minibatch_needs_a_key_and_runs():
    for size, key in ((2, None), (0, jax.random.key(0)), (5, jax.random.key(0))):
        with pytest.raises(ValueError, match="minibatch: expected a key and 1 to 4 sequences"):
            tuning.fit(OBJECTIVE, START, drives(scans=False), minibatch=size, key=key)


def test_the_start_is_checked_first():
    blind = drives(scans=False)
    blind = blind._replace(inputs=blind.inputs._replace(valid=blind.inputs.valid & False))
    with pytest.raises(ValueError, match="expected an observation"):
        tuning.fit(OBJECTIVE, START, blind)
    with pytest.raises(ValueError, match="positive definite"):
        tuning.fit(OBJECTIVE, START._replace(Q=-START.Q), drives(scans=False))
    with pytest.raises(ValueError, match="validation: expected a finite loss"):
        tuning.fit(OBJECTIVE, START, drives(scans=False), validation=blind, optimiser=optax.sgd(1.0))
