"""Losses against their formulas in NumPy; what a refused or false observation costs; what cannot be judged."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from drives import CONFIG, ONLY_POSES, OWN, SHORT, drives

from jaxlocmap import Params, simulate, tuning
from jaxlocmap.tuning import losses
from jaxlocmap.tuning.filtering import filtered
from jaxlocmap.tuning.losses import LOSSES

OTHER = Params.from_std(v=0.05, w=0.1, range=0.12, bearing=0.01, l_free=-0.43)  # ten times -0.4 is just l_min


@pytest.fixture(scope="module")
def reported():
    """What the filter reports of the batch, as NumPy arrays."""
    batch = drives()
    info = jax.jit(lambda batch: filtered(OTHER, batch, config=ONLY_POSES, collect=lambda info, _: info))(batch)
    return jax.tree.map(lambda x: np.asarray(x, np.float64), info), np.asarray(batch.truth, np.float64)


@functools.partial(jax.jit, static_argnames="objective")
def judged(objective, params, batch):
    return objective(params, batch)


def alone(name, params, batch, config=ONLY_POSES):
    return float(judged(tuning.Objective(config, ((name, 1.0),)), params, batch)[0])


def errors(info, truth):
    error = truth - info.belief.mean
    error[..., 2] = (error[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return error


def nees_of(info, truth):
    e = errors(info, truth)
    return np.einsum("nti,ntij,ntj->nt", e, np.linalg.inv(info.belief.cov), e)


def from_chi(squared, degrees):
    d, far = np.sqrt(squared), math.sqrt(scipy.stats.chi2.ppf(0.9999, degrees))
    d = np.where(d > far, far + np.log1p(np.maximum(d - far, 0)), d)
    chi = scipy.stats.chi(degrees)
    return (d.mean() - chi.mean()) ** 2 + (d.std() - chi.std()) ** 2


def by_hand(info, truth):
    seen = info.row >= 0
    e = errors(info, truth)
    density = np.exp(info.log_likelihood[seen])
    nees = nees_of(info, truth)
    return {
        "innovation": -np.log(0.99 * density + 0.01 / (2 * np.pi * ONLY_POSES.max_range)).mean(),
        "pose": 0.5 * (nees + np.linalg.slogdet(info.belief.cov)[1] + 3 * np.log(2 * np.pi)).mean(),
        "state": (e**2).sum(-1).mean(),
        "nees": from_chi(nees, 3),
        "nis": from_chi(info.nis[seen], 2),
    }


def test_losses_are_their_formulas(reported, tolerance):
    expected = by_hand(*reported)
    weights = tuple((name, 0.5 + i) for i, name in enumerate(expected))
    total, got = judged(tuning.Objective(ONLY_POSES, weights), OTHER, drives())
    assert float(total) == pytest.approx(sum(w * float(got[n]) for n, w in weights), rel=tolerance(1e-12, 1e-5))
    for name, value in expected.items():
        assert float(got[name]) == pytest.approx(value, rel=tolerance(1e-10, 1e-3), abs=tolerance(0, 1e-5)), name


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_a_loss_has_a_function_of_its_own(name):
    config = CONFIG if name == "map" else ONLY_POSES
    objective = tuning.Objective(config, ((name, 1.0),))
    programs = (lambda *args: getattr(losses, name)(*args, config=config)), (lambda *args: objective(*args)[0])
    mine, its = (str(jax.make_jaxpr(program)(OTHER, drives())) for program in programs)
    assert mine == its


def test_the_map_is_mapped_where_it_is_told(tolerance):
    batch = drives()
    at_truth = batch._replace(poses=batch.truth)
    exact = alone("map", OTHER, at_truth, CONFIG)
    assert exact != alone("map", OTHER, batch, CONFIG)
    blind = at_truth._replace(inputs=batch.inputs._replace(valid=batch.inputs.valid & False))
    assert alone("map", OTHER, blind, CONFIG) == pytest.approx(exact, rel=tolerance(1e-13, 1e-6))


@pytest.mark.parametrize("names", [("innovation", "pose", "state", "nees", "nis"), ("map",)])
def test_gradients_are_what_differences_give(names, x64):
    config, tuned = (CONFIG, tuning.SENSOR_MODEL) if names == ("map",) else (ONLY_POSES, tuning.FULL_NOISE)
    objective, batch = tuning.Objective(config, tuple((name, 1.0) for name in names)), drives()
    f = tuning.coordinates_objective(objective, OTHER, tuned)
    at = {key: tuning.unconstrain(OTHER)[key] for key in tuned}
    along = {key: (-1.0) ** i * (1 + 0.1 * i) for i, key in enumerate(tuned)}
    slopes = jax.jit(jax.jacrev(lambda c: f(c, batch)[1]))(at)
    terms, h = jax.jit(lambda step: f({key: at[key] + step * along[key] for key in tuned}, batch)[1]), 1e-5
    up, down = terms(h), terms(-h)
    for name in names:
        slope = sum(float(slopes[name][key]) * along[key] for key in tuned)
        assert slope == pytest.approx((float(up[name]) - float(down[name])) / (2 * h), rel=1e-5, abs=1e-8), name


def with_one_false_reading(metres):
    batch = drives(scans=False)
    z = np.array(batch.inputs.z)
    n, k, j = np.argwhere(np.asarray(batch.inputs.valid))[-1]
    z[n, k, j, 0] += metres
    return batch._replace(inputs=batch.inputs._replace(z=jnp.asarray(z))), int(np.asarray(batch.inputs.valid).sum())


def test_a_refused_observation_pays_what_an_outlier_pays(tolerance):
    (far, count), (further, _) = with_one_false_reading(3.0), with_one_false_reading(4.0)
    (good, _), price = with_one_false_reading(0.0), math.log(2 * math.pi * ONLY_POSES.max_range / 0.01)
    costs = [alone("innovation", OWN, batch) * count for batch in (good, far, further)]
    assert costs[1] == pytest.approx(costs[2], rel=tolerance(1e-9, 1e-5))  # bounded: as far off as you please
    best = -max(float(x) for x in np.ravel(filtered_log_likelihood(good)))
    assert costs[1] - costs[0] < price - best + 1
    assert price > -best  # no free reward: it costs more than the best observation gains
    # And its distance counts in `nis`, by its logarithm.
    nis = [alone("nis", OWN, batch) for batch in (good, far, further)]
    assert nis[0] < nis[1] < nis[2] < nis[1] * 1.5


def filtered_log_likelihood(batch):
    return filtered(OWN, batch, config=ONLY_POSES, collect=lambda info, _: info.log_likelihood)


def test_to_refuse_everything_is_no_way_to_win():
    batch = drives(scans=False)
    certain = OWN._replace(Q=OWN.Q * 1e-4, R=OWN.R * 1e-4)  # nothing passes the gate after the first
    for loss in ("innovation", "nis"):
        assert alone(loss, certain, batch) > alone(loss, OWN, batch) + 1


def test_a_soft_gate_tells_the_gradient_what_it_does(x64):
    """Over 2 % of a deviation to either side the loss changes as much as its slopes add up to, though false readings
    pass in and out; behind a gate that decides, it does not.
    """
    lying = dataclasses.replace(SHORT, name="lying", steps=60, outliers=True)
    batch = tuning.simulated(jax.random.key(2), 64, simulate.room(), simulate.Noise(outlier_rate=0.1), scenario=lying)
    own, h = tuning.unconstrain(OWN), 0.02
    places, weights = np.polynomial.legendre.leggauss(6)
    missed = {}
    for softness in (0.0, 2.0):
        config = dataclasses.replace(ONLY_POSES, gate_softness=softness)
        objective = tuning.Objective(config, (("innovation", 1.0),))
        f = lambda at, batch, objective=objective: objective(tuning.constrain(own | at), batch)  # noqa: E731
        places_w = own["w"] + h * jnp.asarray([-1, *places, 1])
        value, slope = jax.jit(jax.vmap(lambda w, f=f: jax.jvp(lambda w: f({"w": w}, batch)[0], (w,), (1.0,))))(
            places_w
        )
        change, added_up = float(value[-1] - value[0]), h * float(np.sum(weights * np.asarray(slope[1:-1])))
        missed[softness] = abs(change - added_up) / (2 * h)
    assert missed[2.0] < 1e-3 < 0.1 < missed[0.0]


# --- what cannot be judged


def refused(match, objective=(("innovation", 1.0),), params=OWN, config=ONLY_POSES, **changes):
    with pytest.raises(ValueError, match=match):
        tuning.Objective(config, objective).check(params, drives()._replace(**changes))


def test_a_log_without_truth():
    refused("the true poses, which the loss `pose` needs, got None", (("pose", 1.0),), truth=None)
    nowhere = jnp.zeros_like(drives().known)
    refused("a step with a known pose for the loss `nees`, got none", (("nees", 1.0),), known=nowhere)


def test_a_batch_in_which_nothing_is_observed():
    inputs = drives().inputs
    blind = inputs._replace(valid=jnp.zeros_like(inputs.valid))
    refused("expected an observation for the loss `innovation`, got none", inputs=blind)
    refused(
        "expected scans, which the loss `map` needs",
        (("map", 1.0),),
        config=CONFIG,
        inputs=inputs._replace(ranges=None),
    )


def test_a_gate_that_refuses_everything():
    inputs = drives().inputs
    elsewhere = inputs._replace(z=np.asarray(inputs.z) + np.array([30.0, 0.0], np.asarray(inputs.z).dtype))
    refused("the gate refuses all [0-9]+ observations", inputs=elsewhere)


def test_a_start_that_is_not_finite():
    covs = np.array(drives().prior.cov)
    covs[2] = -np.eye(3)
    prior = drives().prior._replace(cov=jnp.asarray(covs))
    refused(
        "loss `pose`: expected a finite value at the start, got none for 1 of 4 sequences, the first being number 2",
        (("pose", 1.0),),
        prior=prior,
    )


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ((), "expected at least one of"),
        ((("speed", 1.0),), "expected one of .* got 'speed'"),
        ((("pose", 0.0),), "weight of pose: expected a positive number, got 0.0"),
        ((("pose", math.nan),), "weight of pose"),
        ((("map", 1.0),), "config.grid: expected the GridSpec"),
    ],
)
def test_an_objective_that_is_none(weights, message):
    with pytest.raises(ValueError, match=message):
        tuning.Objective(ONLY_POSES, weights)


def test_a_batch_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match=r"batch.truth: expected shape \(4, 12, 3\), got \(4, 11, 3\)"):
        losses.pose(OWN, drives()._replace(truth=drives().truth[:, :11]), config=ONLY_POSES)
