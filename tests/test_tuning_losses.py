"""Losses against their formulas in NumPy; what a refused or false observation costs; what cannot be judged."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from drives import CONFIG, ONLY_POSES, OWN, SHORT, drives, like

from jaxlocmap import Block, Params, Sensor, simulation, tuning
from jaxlocmap._internal.linalg import Matrix
from jaxlocmap.mapping.predictive import PredictiveScore
from jaxlocmap.tuning import losses
from jaxlocmap.tuning.filtering import check_batch, filtered
from jaxlocmap.tuning.losses import LOSSES

OTHER = Params.from_std(v=0.05, w=0.1, range=0.12, bearing=0.01, l_free=-0.43)  # ten times -0.4 is just l_min


@jax.jit
def _reported(params, batch):
    return filtered(params, batch, config=ONLY_POSES, collect=lambda info, _: info)


def reported(params, batch):
    """What the filter reports of a batch, as NumPy arrays, and the truth."""
    info = _reported(params, batch)
    return jax.tree.map(lambda x: np.asarray(x, np.float64), info), np.asarray(batch.truth, np.float64)


ALL = tuning.Objective(CONFIG, tuple((name, 0.5 + i) for i, name in enumerate(sorted(LOSSES))))
OF_POSES = tuple(name for name in ALL.names if name != "map")


@functools.cache
def _program():
    f = tuning.coordinates_objective(ALL, OTHER, tuning.NAMES)

    @jax.jit
    def program(params, moved, batch):
        def judged(coordinates):
            total, terms = f(coordinates, batch)
            return terms, (total, terms)

        at = tuning.unconstrain(params)
        slopes, (total, terms) = jax.jacrev(judged, has_aux=True)({name: at[name] + moved[name] for name in at})
        return total, terms, slopes

    return program


def judged(params, batch, moved=None):
    """The total, every loss, and the slope of each by every coordinate, as numbers, where the coordinates of `params`
    have moved: the one program for drives with scans of this module.
    """
    moved = dict.fromkeys(tuning.NAMES, 0.0) | (moved or {})
    return jax.tree.map(float, _program()(params, moved, batch))


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


def by_hand(info, truth, counted, known):
    """Over observations of steps that count, and over steps that count and whose truth is known."""
    seen = (info.row >= 0) & counted[..., None]
    judged = counted & known
    e = errors(info, truth)
    density = np.exp(info.log_likelihood[seen])
    nees = nees_of(info, truth)
    log_det = np.linalg.slogdet(info.belief.cov)[1]
    return {
        "innovation_nll": -np.log(0.99 * density + 0.01 / (2 * np.pi * ONLY_POSES.max_range)).mean(),
        "pose_nll": 0.5 * (nees + log_det + 3 * np.log(2 * np.pi))[judged].mean(),
        "mse": (e**2).sum(-1)[judged].mean(),
        "nees": from_chi(nees[judged], 3),
        "nis": from_chi(info.nis[seen], 2),
    }


def some_of(batch):
    """Every step but a few that do not count, a few whose truth is unknown, and slots that hold nothing."""
    steps = np.arange(12)
    counted, known = np.array(batch.counted), np.array(batch.known)
    counted[0, 8:], counted[1, ::3], known[2, :5], known[1, 1] = False, False, False, False
    valid = np.array(batch.inputs.valid)
    valid[3, :, 1], valid[0, steps > 5, 2] = False, False
    inputs = batch.inputs._replace(valid=jnp.asarray(valid))
    return batch._replace(counted=jnp.asarray(counted), known=jnp.asarray(known), inputs=inputs)


@pytest.mark.parametrize(
    ("params", "change"),
    [(OTHER, lambda batch: batch), (OTHER, some_of), (OWN._replace(Q=OWN.Q / 400, R=OWN.R / 100), some_of)],
    ids=["all that is there", "what is counted and known", "beyond the far quantile"],
)
def test_losses_are_their_formulas(params, change, tolerance):
    batch = change(drives())
    info, truth = reported(params, batch)
    expected = by_hand(info, truth, np.asarray(batch.counted), np.asarray(batch.known))
    assert set(expected) == set(OF_POSES)
    total, got, _ = judged(params, batch)
    assert total == pytest.approx(sum(w * got[n] for n, w in ALL.weights), rel=tolerance(1e-12, 1e-5))
    for name, value in expected.items():
        assert got[name] == pytest.approx(value, rel=tolerance(1e-10, 1e-3), abs=tolerance(0, 1e-5)), name


@pytest.mark.parametrize("name", sorted(LOSSES))
def test_a_loss_has_a_function_of_its_own(name):
    """The same program, which is shorter to write out of drives without a slot for observations."""
    config, batch = CONFIG if name == "map" else ONLY_POSES, drives()
    inputs = batch.inputs
    none = {field: getattr(inputs, field)[:, :, :0] for field in ("landmark", "z", "valid")}
    batch = batch._replace(inputs=inputs._replace(**none))
    objective = tuning.Objective(config, ((name, 1.0),))
    programs = (lambda *args: getattr(losses, name)(*args, config=config)), (lambda *args: objective(*args)[0])
    mine, its = (str(jax.make_jaxpr(program)(OTHER, batch)) for program in programs)
    assert mine == its


def test_the_map_is_mapped_where_it_is_told(tolerance):
    objective, batch = tuning.Objective(CONFIG, (("map", 1.0),)), drives()
    of_map = jax.jit(lambda batch: objective(OTHER, batch)[0])
    at_truth = batch._replace(poses=batch.truth)
    exact = float(of_map(at_truth))
    assert exact != pytest.approx(judged(OTHER, batch)[1]["map"], rel=1e-5)
    blind = at_truth._replace(inputs=batch.inputs._replace(valid=np.zeros_like(batch.inputs.valid)))
    assert float(of_map(blind)) == pytest.approx(exact, rel=tolerance(1e-13, 1e-6))


@pytest.mark.parametrize("names", [OF_POSES, ("map",)], ids=["of poses", "map"])
def test_gradients_are_what_differences_give(names, x64):
    tuned = tuning.SENSOR_MODEL if names == ("map",) else tuning.FULL_NOISE
    batch, h = drives(), 1e-5
    along = {key: (-1.0) ** i * (1 + 0.1 * i) for i, key in enumerate(tuned)}

    def there(step):
        return judged(OTHER, batch, {key: step * along[key] for key in tuned})

    slopes, up, down = there(0.0)[2], there(h)[1], there(-h)[1]
    for name in names:
        slope = sum(slopes[name][key] * along[key] for key in tuned)
        assert slope == pytest.approx((up[name] - down[name]) / (2 * h), rel=1e-5, abs=1e-8), name


def test_scipy_takes_the_same_gradient(x64):
    start, batch, names = simulation.course_params(), drives(), ("range", "bearing")

    def slope(x):
        _, terms, slopes = judged(start, batch, dict(zip(names, x.tolist(), strict=True)))
        return terms["innovation_nll"], np.array([slopes["innovation_nll"][name] for name in names])

    found = scipy.optimize.minimize(slope, np.zeros(2), jac=True, method="L-BFGS-B")
    assert found.success
    assert found.fun < slope(np.zeros(2))[0] - 0.1
    assert np.all(np.abs(found.jac) < 1e-3)
    with pytest.raises(ValueError, match="tuned: expected some of"):
        tuning.coordinates_objective(ALL, start, ("speed",))


def with_one_false_reading(metres):
    batch = drives()
    z = np.array(batch.inputs.z)
    n, k, j = np.argwhere(np.asarray(batch.inputs.valid))[-1]
    z[n, k, j, 0] += metres
    return batch._replace(inputs=batch.inputs._replace(z=jnp.asarray(z))), int(np.asarray(batch.inputs.valid).sum())


def test_a_refused_observation_pays_what_an_outlier_pays(tolerance):
    (far, count), (further, _) = with_one_false_reading(3.0), with_one_false_reading(4.0)
    (good, _), price = with_one_false_reading(0.0), math.log(2 * math.pi * ONLY_POSES.max_range / 0.01)
    each = [judged(OWN, batch)[1] for batch in (good, far, further)]
    costs = [losses["innovation_nll"] * count for losses in each]
    assert costs[1] == pytest.approx(costs[2], rel=tolerance(1e-9, 1e-5))  # bounded: as far off as you please
    best = -float(reported(OWN, good)[0].log_likelihood.max())
    assert costs[1] - costs[0] < price - best + 1
    assert price > -best  # no free reward: it costs more than the best observation gains
    # And its distance counts in `nis`, by its logarithm.
    nis = [losses["nis"] for losses in each]
    assert nis[0] < nis[1] < nis[2] < nis[1] * 1.5


def test_to_refuse_everything_is_no_way_to_win():
    batch = drives()
    certain = OWN._replace(Q=OWN.Q * 1e-4, R=OWN.R * 1e-4)  # nothing passes the gate after the first
    sure, own = (judged(params, batch)[1] for params in (certain, OWN))
    for loss in ("innovation_nll", "nis"):
        assert sure[loss] > own[loss] + 1


def test_a_soft_gate_tells_the_gradient_what_it_does(x64):
    """Over 2 % of a deviation to either side the loss changes as much as its slopes add up to, though false readings
    pass in and out; behind a gate that decides, it does not.
    """
    fix = Sensor(
        Block("fix", ("east", "north"), ("m", "m")),
        expected=lambda state, _: state[:2],
        jacobian=lambda state, _: Matrix([[1, 0, 0], [0, 1, 0]]),
        landmarks=False,  # the shortest program that there is
    )
    # Where false readings lie within half a metre, many lie near the gate: at four deviations of a decimetre.
    noise = simulation.Noise(outlier_rate=0.4, blocks={"fix": 0.1})
    detector = dict(outliers=True, period=2, max_range=0.5)
    lying = like(SHORT, name="lying", steps=60, detector=detector, robot=dict(sensor=fix))
    batch = tuning.simulated(jax.random.key(2), 64, simulation.room(), noise, scenario=lying)
    own, h = simulation.own_params(noise, lying), 0.02
    places, weights = np.polynomial.legendre.leggauss(6)
    missed = {}
    for temperature in (0.0, 2.0):
        config = lying.config(motion="euler", gate_probability=0.9999, grid=False)
        config = dataclasses.replace(config, gate_temperature=temperature)
        objective = tuning.Objective(config, (("innovation_nll", 1.0),))

        @jax.jit
        @jax.vmap
        def sloped(step, objective=objective):
            def loss(step):
                at = tuning.unconstrain(own, objective.blocks)
                at |= {"east": at["east"] + step}
                return objective(tuning.constrain(at, objective.blocks), batch)[0]

            return jax.jvp(loss, (step,), (jnp.ones_like(step),))

        value, slope = (np.asarray(x) for x in sloped(h * np.array([-1, *places, 1])))
        change, added_up = float(value[-1] - value[0]), h * float(np.sum(weights * slope[1:-1]))
        missed[temperature] = abs(change - added_up) / (2 * h)
    assert missed[2.0] < 1e-3 < 0.1 < missed[0.0]


def test_the_map_is_told_the_configuration_and_the_batch(monkeypatch):
    """Each sequence with its own poses, ranges and count, and the limits of the laser by their names."""
    told = []

    def predict_scans(l_occ, l_free, poses, ranges, counted, **how):
        told.append(how)
        total = l_occ + 2 * l_free + jnp.sum(poses) + jnp.sum(ranges) + jnp.sum(jnp.where(counted, 1.0, 0.0))
        return PredictiveScore(total, jnp.sum(jnp.where(counted, 1.0, 0.0)), *[jnp.zeros(3)] * 3)

    monkeypatch.setattr(losses, "predict_scans", predict_scans)
    batch = some_of(drives())
    config = dataclasses.replace(CONFIG, min_range=0.3, max_range=7.0, scanner_offset=(0.1, 0.0, 0.2))
    got = losses.predictive_score(jnp.array(0.5), jnp.array(-0.25), batch, batch.truth, config=config, bins=True)
    counted = np.asarray(batch.counted).sum(1)
    rest = np.asarray(batch.truth).sum((1, 2)) + np.asarray(batch.inputs.ranges).sum((1, 2))
    np.testing.assert_allclose(got.log_loss, counted + rest, rtol=1e-4)
    np.testing.assert_array_equal(got.cells, counted)
    scanner = told[0].pop("scanner")
    assert told[0] == {"spec": CONFIG.grid, "bins": True}
    assert (scanner.min_range, scanner.max_range, scanner.offset) == (0.3, 7.0, (0.1, 0.0, 0.2))
    np.testing.assert_array_equal(scanner.beam_angles, batch.beam_angles)
    for missing in (
        {"config": ONLY_POSES},
        {"batch": batch._replace(beam_angles=None)},
        {"batch": batch._replace(inputs=batch.inputs._replace(ranges=None))},
    ):
        args = {"batch": batch, "config": CONFIG} | missing
        with pytest.raises(ValueError, match=r"loss `map`: expected config\.grid, batch\.inputs\.ranges and"):
            losses.predictive_score(jnp.array(0.5), jnp.array(-0.25), args["batch"], batch.truth, config=args["config"])


def test_a_map_has_no_slope_by_the_poses(monkeypatch):
    def filtered(params, batch, **_):
        return {}, jnp.ones((4, 12)), jnp.broadcast_to(params.R[0, 0], (4, 12, 3))

    def predictive_score(l_occ, l_free, batch, poses, **_):
        each = l_occ * jnp.sum(poses, axis=(1, 2))
        return PredictiveScore(each, jnp.ones(4), *[jnp.zeros(3)] * 3)

    monkeypatch.setattr(losses, "filtered", filtered)
    monkeypatch.setattr(losses, "predictive_score", predictive_score)
    objective = tuning.Objective(CONFIG, (("map", 1.0),))
    value, slope = jax.jit(jax.value_and_grad(lambda params: objective(params, drives())[0]))(OWN)
    sums = 36 * float(OWN.R[0, 0])
    assert float(value) == pytest.approx(float(OWN.l_occ) * sums, rel=1e-5)
    assert float(slope.l_occ) == pytest.approx(sums, rel=1e-5)
    assert not np.any(slope.R)


def test_far_quantile_and_shares_are_the_documented_ones():
    assert (losses.OUTLIER_SHARE, losses.LEVER) == (0.01, 1.0)
    far = math.sqrt(scipy.stats.chi2.isf(1e-4, 2))
    for beyond, expected in ((-0.01, far - 0.01), (0.0, far), (1.0, far + math.log(2))):
        got = float(losses._distance(jnp.asarray((far + beyond) ** 2), 2))
        assert got == pytest.approx(expected, rel=1e-5)
    assert np.isfinite(float(jax.grad(lambda x: losses._distance(x, 2))(jnp.array(0.0))))


# --- what cannot be judged


def test_what_lies_in_steps_that_do_not_count_is_nothing_to_tune_on():
    batch = drives()
    odd = np.arange(12) % 2 == 1
    valid = np.asarray(batch.inputs.valid)
    assert valid.any()
    for half in (odd, ~odd):
        some = jnp.broadcast_to(jnp.asarray(half), (4, 12))
        unseen = batch.inputs._replace(valid=jnp.asarray(valid & ~half[:, None]))
        refused("expected an observation for the loss `nis`, got none", (("nis", 1.0),), counted=some, inputs=unseen)
        refused("a step with a known pose for the loss `mse`", (("mse", 1.0),), counted=some, known=~some)
    refused("expected scans", (("map", 1.0),), config=CONFIG, beam_angles=None)


def test_a_gate_that_lets_in_only_what_does_not_count():
    """What it refuses are the readings of the steps that count, 30 m off."""
    batch = drives()
    counted = jnp.broadcast_to(jnp.arange(12) >= 8, (4, 12))
    off = np.where(np.arange(12) >= 8, 30.0, 0.0)[:, None, None] * np.array([1.0, 0.0])
    z = np.asarray(batch.inputs.z) + off.astype(np.asarray(batch.inputs.z).dtype)
    count = int(np.asarray(batch.inputs.valid)[:, 8:].sum())
    refused(f"the gate refuses all {count} observations", counted=counted, inputs=batch.inputs._replace(z=z))


def refused(match, objective=(("innovation_nll", 1.0),), params=OWN, config=ONLY_POSES, **changes):
    with pytest.raises(ValueError, match=match):
        tuning.Objective(config, objective).check(params, drives()._replace(**changes))


def test_a_log_without_truth():
    refused("the true poses, which the loss `pose_nll` needs, got None", (("pose_nll", 1.0),), truth=None)
    nowhere = jnp.zeros_like(drives().known)
    refused("a step with a known pose for the loss `nees`, got none", (("nees", 1.0),), known=nowhere)


def test_a_batch_in_which_nothing_is_observed():
    inputs = drives().inputs
    blind = inputs._replace(valid=jnp.zeros_like(inputs.valid))
    refused("expected an observation for the loss `innovation_nll`, got none", inputs=blind)
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
        "loss `pose_nll`: expected a finite value at the start, got none for 1 of 4 sequences, the first being "
        "number 2",
        (("pose_nll", 1.0),),
        prior=prior,
    )


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ((), "expected at least one of"),
        ((("speed", 1.0),), "expected one of .* got 'speed'"),
        ((("pose_nll", 0.0),), "weight of pose_nll: expected a positive number, got 0.0"),
        ((("pose_nll", math.nan),), "weight of pose_nll"),
        ((("pose_nll", math.inf),), "weight of pose_nll"),
        ((("pose_nll", 1.0), ("nis", -1.0)), "weight of nis: expected a positive number, got -1.0"),
        ((("map", 1.0),), "config.grid: expected the GridSpec"),
    ],
)
def test_an_objective_that_is_none(weights, message):
    with pytest.raises(ValueError, match=message):
        tuning.Objective(ONLY_POSES, weights)


def test_a_batch_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match=r"batch.truth: expected shape \(4, 12, 3\), got \(4, 11, 3\)"):
        losses.pose_nll(OWN, drives()._replace(truth=drives().truth[:, :11]), config=ONLY_POSES)
    batch = drives()
    for name, change in {
        "counted": {"counted": batch.counted[0]},
        "prior.mean": {"prior": batch.prior._replace(mean=batch.prior.mean[:3])},
        "prior.cov": {"prior": batch.prior._replace(cov=batch.prior.cov[:3])},
        "inputs.dt": {"inputs": batch.inputs._replace(dt=batch.inputs.dt[:, :5])},
        "known": {"known": batch.known[:, :5]},
        "poses": {"poses": batch.truth[..., :2]},
    }.items():
        with pytest.raises(ValueError, match=rf"^batch\.{name}: expected shape"):
            check_batch(batch._replace(**change))


@pytest.mark.parametrize("name", ["prior.mean", "truth", "poses", "landmarks"])
def test_a_place_that_the_prior_s_dtype_cannot_hold_is_named(name):
    batch = drives()
    single = jax.tree.map(lambda x: np.asarray(x, np.float32), batch.prior)
    places = {"truth": np.asarray(batch.truth), "landmarks": np.asarray(batch.landmarks)}
    places["poses"] = places["truth"]
    batch = batch._replace(prior=single, poses=places["poses"])
    heading = single._replace(mean=single.mean + np.array([0, 0, 4e5], np.float32))
    check_batch(batch._replace(prior=heading))  # of a heading nothing is asked
    far = {"prior": single._replace(mean=single.mean + np.float32(4e5))}
    with pytest.raises(ValueError, match=rf"^batch\.{name}: expected coordinates that float32 holds"):
        check_batch(batch._replace(**far if name == "prior.mean" else {name: places[name] + 4e5}))
