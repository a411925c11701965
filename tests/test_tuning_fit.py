"""The descent: what it finds, keeps and counts, and what it refuses."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from drives import CONFIG, ONLY_POSES, OWN, SHORT, drives, like

from jaxlocmap import Config, Gaussian, Params, simulation, tuning
from jaxlocmap.tuning.fit import Evaluation, _line_search
from jaxlocmap.tuning.parameters import BLOCKS

OBJECTIVE = tuning.Objective(ONLY_POSES, (("innovation_nll", 1.0),))
START = simulation.course_params()


def test_it_finds_the_robots_own_noise(x64):
    """Of 400 drives with one reading in twenty false. A deviation of n errors is known to 1 / sqrt(2 n) of itself; four
    times that, and 2 % for readings that are false but near enough to be half believed. The yaw rate shows up in few of
    so short drives.
    """
    lying = like(SHORT, name="lying", steps=40, detector=dict(outliers=True))
    noise = simulation.Noise(outlier_rate=0.05)
    batch = tuning.simulated(jax.random.key(4), 400, simulation.room(), noise, scenario=lying)
    soft = dataclasses.replace(ONLY_POSES, gate_temperature=2.0)
    fit = tuning.fit(tuning.Objective(soft, (("innovation_nll", 1.0),)), START, batch)
    found, own = ({k: float(x) for k, x in tuning.natural(params).items()} for params in (fit.params, OWN))
    known = 4 / math.sqrt(2 * float(np.sum(np.asarray(batch.inputs.valid))))
    for name in ("range", "bearing"):
        assert found[name] == pytest.approx(own[name], rel=known + 0.02), name
    assert found["w"] == pytest.approx(own["w"], rel=0.1)
    assert fit.stopped_early
    assert fit.losses[fit.best_epoch] == fit.loss == min(fit.losses)
    assert not fit.trace.skipped.any()
    assert np.all(fit.trace.evaluations >= 1)


def blinded(*rows):
    """Two drives, of which those in these rows see nothing."""
    batch = jax.tree.map(np.asarray, tuning.pick(drives(scans=False), slice(0, 2)))
    valid = batch.inputs.valid.copy()
    valid[list(rows)] = False
    return batch._replace(inputs=batch.inputs._replace(valid=valid))


def test_what_is_kept_skipped_and_left_alone():
    """Of two drives one sees nothing, so that half of the minibatches of one have no loss. Steps are far too long, and
    three epochs that do not help end it.
    """
    batch, seen = blinded(1), []
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


class Bowl:
    """In place of an objective: Σ (log range)² · weight over the sequences, whose weights are in the prior's mean. What
    is judged may be told beforehand.
    """

    blocks = BLOCKS
    config = Config(gate_probability=None)

    def __init__(self, told=()):
        self.told, self.asked, self.traced = list(told), [], 0

    def check_tuned(self, tuned):
        pass

    def check(self, params, batch):
        pass

    check_batch = check_start = lambda self, *args: None

    def tallies(self, params, batch):
        self.traced += 1
        return {"bowl": (batch.prior.mean[:, 0] * (0.5 * jnp.log(params.R[0, 0])) ** 2,)}, None

    def value(self, sums):
        return sums["bowl"][0], {}

    def judged(self, params, batch):
        self.asked.append(batch)
        return (self.told.pop(0) if self.told else float(jnp.sum(self.tallies(params, batch)[0]["bowl"][0]))), {}


def weights(*values):
    values = jnp.asarray(values, float)
    mean = jnp.stack([values, 0 * values, 0 * values], axis=1)
    return tuning.Batch(Gaussian(mean, jnp.zeros((len(values), 3, 3))), None, jnp.ones((len(values), 1), bool))


def bowl(told=(), batch=None, **options):
    params = Params.from_std(v=1.0, w=1.0, range=2.0, bearing=1.0)
    objective = Bowl(told)
    options = {"tuned": ("range",), "optimiser": optax.sgd(0.1)} | options
    batch = weights(1.0, 2.0) if batch is None else batch
    return tuning.fit(objective, params, batch, **options), objective


FALLING = tuple(-float(i) for i in range(30))


@pytest.mark.parametrize(
    ("told", "options", "epochs", "best"),
    [
        (FALLING, {}, 20, 20),  # of two steps each, as said
        (FALLING, {"epochs": 3}, 3, 3),
        ((1.0, 0.0, 0.0, 0.0), {}, 3, 1),  # two without progress are the end
        ((1.0, 0.0, 0.5, 0.5, 0.5), {"patience": 3}, 4, 1),
        ((1.0, 0.0, 0.5, -1.0, 0.5, 0.5), {}, 5, 3),  # progress in between starts anew
        # Progress is a ten-thousandth of what the loss has fallen since the start, though less of it is kept.
        ((1.0, 0.0, -0.9e-4, -1.8e-4, -9.0), {}, 3, 3),
        ((1.0, 0.0, -1.1e-4, -2.2e-4, -2.2e-4, -2.2e-4), {}, 5, 3),
        ((101.0, 1.0, 0.9901, 0.9802, -9.0), {}, 3, 3),
        ((101.0, 1.0, 0.9899, 0.9798, 9.0, 9.0), {}, 5, 3),
        ((1.0, 0.0, -0.09, -0.18, -9.0), {"tolerance": 0.1}, 3, 3),
        ((1.0, 0.0, -0.11, -0.23, 9.0, 9.0), {"tolerance": 0.1}, 5, 3),
        ((1.0, 2.0, 3.0, -1.0), {}, 2, 0),  # the start, if nothing is better
    ],
)
def test_it_goes_on_while_the_loss_falls_by_its_tolerance(told, options, epochs, best):
    found, _ = bowl(told, validation=weights(1.0), **options)
    assert found.losses.tolist() == list(told[: epochs + 1])
    assert (found.best_epoch, found.loss) == (best, told[best])
    assert len(found.trace.loss) == 2 * epochs
    assert found.stopped_early == (told[:4] != FALLING[:4])
    # And what is kept is what that epoch had come to.
    way = [2.0, *np.asarray(found.trace.params["range"])[2::2]]
    if best < epochs:
        assert float(tuning.natural(found.params)["range"]) == pytest.approx(way[best], rel=1e-6)


def test_the_trace_is_of_before_each_step():
    """Of 3 x² with x = log range: slope 6 x, and a tenth of that a step."""
    found, _ = bowl(epochs=2, steps=3)
    x = math.log(2) * 0.4 ** np.arange(7)
    np.testing.assert_allclose(found.trace.loss, 3 * x[:6] ** 2, rtol=1e-5)
    np.testing.assert_allclose(found.trace.gradient_norm, 6 * x[:6], rtol=1e-5)
    np.testing.assert_allclose(found.trace.params["range"], np.exp(x[:6]), rtol=1e-5)
    np.testing.assert_array_equal(found.trace.evaluations, 1)
    np.testing.assert_allclose(found.losses, 3 * x[[0, 3, 6]] ** 2, rtol=1e-5)
    assert float(tuning.natural(found.params)["range"]) == pytest.approx(math.exp(x[6]), rel=1e-5)


@pytest.mark.parametrize("optimiser", [None, optax.sgd(0.1)], ids=["lbfgs", "sgd"])
def test_another_fit_of_the_same_shapes_compiles_nothing(optimiser):
    objective, compiled = Bowl(), []

    def listen(event, seconds, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(listen)
    starts = [Params.from_std(v=1.0, w=1.0, range=r, bearing=1.0) for r in (2.0, 3.0)]
    seen = []
    for params, batch in zip(starts, (weights(1.0, 2.0), weights(4.0, 0.5)), strict=True):
        compiled.clear()
        found = tuning.fit(objective, params, batch, tuned=("range",), optimiser=optimiser, epochs=3)
        assert found.loss < 0.5 * found.losses[0]
        seen.append((objective.traced, len(compiled)))
    (traced, first), (again, second) = seen
    assert again == traced > 0
    assert (first > 0, second) == (True, 0)
    # Nor do standard errors: the same program says how the gradient changes.
    tuning.standard_errors(objective, found.params, weights(1.0, 2.0), ("range",))
    assert objective.traced == traced


@pytest.mark.parametrize(
    ("value", "slope", "end", "evaluations"),
    [
        (lambda x: (x - 1) ** 2, lambda x: 2 * (x - 1), 1, 1),  # at once
        (lambda x: (x - 32) ** 2, lambda x: 2 * (x - 32), 4, 3),  # as far as a tenth of the slope is gone
        (lambda x: (x - 0.2) ** 2, lambda x: 2 * (x - 0.2), 0.25, 3),  # nearer, until the loss has fallen
        (lambda x: -x, lambda x: -1.0, 32, 6),  # the best of those there are
        (lambda x: (x - 0.2) ** 2 if x < 0.4 else math.nan, lambda x: 2 * (x - 0.2), 0.25, 3),  # back from no number
        (lambda x: x, lambda x: -1.0, 0, 6),  # nothing is better
    ],
)
def test_a_line_is_searched_for_a_lower_and_flatter_place(value, slope, end, evaluations):
    asked = []

    def evaluated(theta):
        asked.append(float(theta["x"]))
        return Evaluation(value(asked[-1]), {"x": slope(asked[-1])}, None, None, None)

    start = {"x": jnp.zeros(())}
    here = evaluated(start)
    there, found = _line_search(evaluated, start, {"x": jnp.ones(())}, here)
    assert float(there["x"]) == end
    assert found.loss == value(end)
    assert (found is here) == (end == 0)
    assert len(asked) - 1 == evaluations


def test_a_line_search_ends_where_the_loss_has_fallen_and_flattened():
    """Of 3 x² from log 2 the direction is that of the slope, at most one long: to x - 1, where the loss is below that
    of the start; and then Newton's step, which is exact.
    """
    found, _ = bowl(optimiser=None, epochs=2, steps=2)
    x = np.log(np.asarray(found.trace.params["range"], float))
    assert x[0] == pytest.approx(math.log(2), rel=1e-5)
    assert x[1] == pytest.approx(math.log(2) - 1, rel=1e-4)
    np.testing.assert_allclose(x[2:], 0, atol=1e-4)
    assert found.trace.evaluations.tolist()[:2] == [2, 1]
    assert not found.trace.skipped[:2].any()


def test_the_validation_set_picks_the_best():
    batch, other = weights(1.0, 2.0), weights(5.0)
    found, objective = bowl(batch=batch, validation=other, epochs=2)
    assert all(asked is other for asked in objective.asked)
    np.testing.assert_allclose(found.losses[0], 5 * math.log(2) ** 2, rtol=1e-5)
    np.testing.assert_allclose(found.trace.loss[0], 3 * math.log(2) ** 2, rtol=1e-5)
    alone, objective = bowl(batch=batch, epochs=2)
    assert not objective.asked  # the loss of the whole batch is known from the descent
    np.testing.assert_allclose(alone.losses[[0, 1]], alone.trace.loss[[0, 2]], rtol=1e-7)
    of_minibatches = bowl(batch=batch, epochs=1, minibatch=1, key=jax.random.key(0))[1]
    assert len(of_minibatches.asked) == 2
    assert all(asked is batch for asked in of_minibatches.asked)


def test_a_minibatch_is_drawn_anew_without_repetition_and_moves_by_5_percent():
    """A loss names the sequences it is of: their weights are powers of two."""
    batch = weights(*2.0 ** np.arange(6))
    options = {"batch": batch, "minibatch": 3, "epochs": 4, "steps": 5, "told": FALLING, "tolerance": 0.0}
    found, again, other = (bowl(key=jax.random.key(k), optimiser=None, **options)[0] for k in (0, 0, 1))
    x = np.log(np.asarray(found.trace.params["range"], float))
    drawn = np.asarray(found.trace.loss) / x**2
    np.testing.assert_allclose(drawn, np.round(drawn), rtol=1e-3)
    picked = (np.round(drawn).astype(int)[:, None] >> np.arange(6)) & 1
    np.testing.assert_array_equal(picked.sum(1), 3)
    assert np.all(picked.any(0))
    assert len(np.unique(drawn[:5].round())) > 1  # within an epoch,
    assert not np.array_equal(drawn[:5].round(), drawn[5:10].round())  # and from one to the next
    np.testing.assert_array_equal(found.trace.loss, again.trace.loss)
    assert not np.array_equal(found.trace.loss, other.trace.loss)
    assert x[1] - x[0] == pytest.approx(-0.05, rel=1e-4)  # Adam's first step is its rate


def test_the_limits_of_tuning_are_refused_beyond_a_thousandth():
    for deviation, inside in ((1.0005e5, True), (1.002e5, False), (0.9995e-5, True), (0.998e-5, False)):
        params = Params.from_std(v=1.0, w=deviation, range=1.0, bearing=1.0)
        if inside:
            tuning.coordinates_objective(Bowl(), params, ("v",))
        else:
            with pytest.raises(ValueError, match="w: expected a value within the limits of tuning"):
                tuning.coordinates_objective(Bowl(), params, ("v",))


@pytest.mark.parametrize("name", ["epochs", "steps", "patience"])
def test_no_epochs_and_no_steps_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
        tuning.fit(OBJECTIVE, START, drives(scans=False), **{name: 0})


@pytest.mark.parametrize("losses", [("nees",), ("nis",), ("nees", "nis"), ("nees", "map")])
def test_two_equations_do_not_tell_three_parameters(losses):
    objective = tuning.Objective(CONFIG, tuple((name, 1.0) for name in losses))
    named = "`, `".join(name for name in losses if name != "map")
    with pytest.raises(ValueError, match=rf"^tuned: the loss `{named}` compares .* two equations.* got v, w, range$"):
        tuning.fit(objective, START, drives(scans=False), tuned=("v", "w", "range", "l_occ"))
    objective.check_tuned(("v", "range", "l_occ", "l_free"))


@pytest.mark.parametrize("losses", [("nees", "pose_nll"), ("nis", "innovation_nll"), ("nees", "nis", "mse"), ("map",)])
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
    """On one drive and two, as `test_what_is_kept_skipped_and_left_alone` has them compiled."""
    one, blind = tuning.pick(blinded(), slice(0, 1)), blinded(0, 1)
    with pytest.raises(ValueError, match="expected an observation"):
        tuning.fit(OBJECTIVE, START, blind)
    with pytest.raises(ValueError, match="positive definite"):
        tuning.fit(OBJECTIVE, START._replace(Q=-START.Q), one)
    with pytest.raises(ValueError, match="validation: expected a finite loss"):
        tuning.fit(OBJECTIVE, START, one, tuned=("range",), validation=blind, optimiser=optax.sgd(1.0))
