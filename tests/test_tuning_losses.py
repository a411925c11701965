"""Losses against their formulas in NumPy; what a refused or false observation costs; what cannot be judged."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from drives import CONFIG, ONLY_POSES, OWN, SHORT, drives

from jaxlocmap import Params, simulate, tuning
from jaxlocmap.tuning import losses
from jaxlocmap.tuning.losses import LOSSES, filtered

OTHER = Params.from_std(v=0.05, w=0.1, range=0.12, bearing=0.01)


@pytest.fixture(scope="module")
def reported():
    """What the filter reports of the batch, as NumPy arrays."""
    batch = drives()
    info = jax.jit(lambda batch: filtered(OTHER, batch, config=ONLY_POSES, collect=lambda info, _: info))(batch)
    return jax.tree.map(lambda x: np.asarray(x, np.float64), info), np.asarray(batch.truth, np.float64)


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


@pytest.mark.parametrize("name", ["innovation", "pose", "state", "nees", "nis"])
def test_a_loss_is_its_formula(name, reported, tolerance):
    got = float(getattr(losses, name)(OTHER, drives(), config=ONLY_POSES))
    assert got == pytest.approx(by_hand(*reported)[name], rel=tolerance(1e-10, 1e-3), abs=tolerance(0, 1e-5))


def test_a_weighted_sum_is_one(tolerance):
    weights = (("innovation", 0.5), ("map", 2.0), ("pose", 3.0))
    objective = tuning.Objective(CONFIG, weights)
    total, terms = jax.jit(objective)(OTHER, drives())
    for name, _ in weights:
        alone = getattr(losses, name)(OTHER, drives(), config=CONFIG)
        assert float(terms[name]) == pytest.approx(float(alone), rel=tolerance(1e-12, 1e-5))
    assert float(total) == pytest.approx(sum(w * float(terms[n]) for n, w in weights), rel=tolerance(1e-12, 1e-5))


def test_the_map_is_mapped_where_it_is_told(tolerance):
    batch = drives()
    at_truth = batch._replace(poses=batch.truth)
    exact = losses.map(OTHER, at_truth, config=CONFIG)
    assert float(exact) != float(losses.map(OTHER, batch, config=CONFIG))
    blind = at_truth._replace(inputs=batch.inputs._replace(valid=batch.inputs.valid & False))
    assert float(losses.map(OTHER, blind, config=CONFIG)) == pytest.approx(float(exact), rel=tolerance(1e-13, 1e-6))


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_a_gradient_is_what_differences_give(name, x64):
    config = CONFIG if name == "map" else ONLY_POSES
    names = tuning.SENSOR_MODEL if name == "map" else tuning.FULL_NOISE
    f = tuning.coordinates_objective(tuning.Objective(config, ((name, 1.0),)), OTHER, names)
    at = {key: tuning.unconstrain(OTHER)[key] for key in names}
    value, slope = jax.jit(jax.value_and_grad(lambda c: f(c, drives())[0]))(at)
    along = {key: (-1.0) ** i * (1 + 0.1 * i) for i, key in enumerate(names)}
    h = 1e-5
    moved = jax.jit(lambda step: f({key: at[key] + step * along[key] for key in names}, drives())[0])
    difference = (float(moved(h)) - float(moved(-h))) / (2 * h)
    assert np.isfinite(float(value))
    assert sum(float(slope[key]) * along[key] for key in names) == pytest.approx(difference, rel=1e-5, abs=1e-8)


def with_one_false_reading(metres):
    batch = drives(scans=False)
    z = np.array(batch.inputs.z)
    n, k, j = np.argwhere(np.asarray(batch.inputs.valid))[-1]
    z[n, k, j, 0] += metres
    return batch._replace(inputs=batch.inputs._replace(z=jnp.asarray(z))), int(np.asarray(batch.inputs.valid).sum())


def test_a_refused_observation_pays_what_an_outlier_pays(tolerance):
    (far, count), (further, _) = with_one_false_reading(3.0), with_one_false_reading(4.0)
    (good, _), price = with_one_false_reading(0.0), math.log(2 * math.pi * ONLY_POSES.max_range / 0.01)
    costs = [float(losses.innovation(OWN, batch, config=ONLY_POSES)) * count for batch in (good, far, further)]
    assert costs[1] == pytest.approx(costs[2], rel=tolerance(1e-9, 1e-5))  # bounded: as far off as you please
    best = -max(float(x) for x in np.ravel(filtered_log_likelihood(good)))
    assert costs[1] - costs[0] < price - best + 1
    assert price > -best  # no free reward: it costs more than the best observation gains
    # And its distance counts in `nis`, by its logarithm.
    nis = [float(losses.nis(OWN, batch, config=ONLY_POSES)) for batch in (good, far, further)]
    assert nis[0] < nis[1] < nis[2] < nis[1] * 1.5


def filtered_log_likelihood(batch):
    return filtered(OWN, batch, config=ONLY_POSES, collect=lambda info, _: info.log_likelihood)


def test_to_refuse_everything_is_no_way_to_win():
    batch = drives(scans=False)
    certain = OWN._replace(Q=OWN.Q * 1e-8, R=OWN.R * 1e-8)  # nothing passes the gate after the first
    for loss in (losses.innovation, losses.nis):
        assert float(loss(certain, batch, config=ONLY_POSES)) > float(loss(OWN, batch, config=ONLY_POSES)) + 1


def test_the_gradient_does_not_lie_about_outliers(x64):
    """With false readings, some of which the gate's decision changes for, the slope that no comparison shows up in is
    the slope of what the loss really does over 4 % of a deviation, to a few per cent of what it is at the start.
    """
    lying = dataclasses.replace(SHORT, name="lying", steps=60, outliers=True)
    batch = tuning.simulated(jax.random.key(2), 64, simulate.room(), simulate.Noise(outlier_rate=0.1), scenario=lying)
    f = tuning.coordinates_objective(tuning.Objective(ONLY_POSES, (("innovation", 1.0),)), OWN, tuning.NOISE)
    slope = jax.jit(jax.value_and_grad(lambda c: f(c, batch)[0]))
    whole = tuning.unconstrain(OWN)
    at = {name: whole[name] for name in tuning.NOISE}
    start = slope({name: x + (0.7 if name == "range" else 0) for name, x in at.items()})[1]["range"]
    assert float(start) > 0.3
    for name in ("range", "bearing", "w"):
        h = 0.02
        up, down = (float(slope(at | {name: at[name] + step})[0]) for step in (h, -h))
        assert float(slope(at)[1][name]) == pytest.approx((up - down) / (2 * h), abs=0.05 * float(start))


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
