"""Tuning a filter that matches scans: what is tuned, its gradients against differences, and a gate that weighs."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from drives import like
from programs import Enough

from jaxlocmap import Gaussian, init, run, simulation, tuning
from jaxlocmap.matching import submaps
from jaxlocmap.tuning import losses
from jaxlocmap.tuning.filtering import filtered
from jaxlocmap.types import Matcher

# Two drives without landmarks, long enough for submaps to begin and to end.
DRIVE = like(simulation.LOOP, name="drive", steps=90, exact_prior=False, prior_std=(1e-3,) * 3)
MATCHER = Matcher(period=5, submap_scans=4, gap=0.8, resolution=0.2, half_width=10.0)
HARD = dataclasses.replace(DRIVE.config(motion="euler", grid=False), matcher=MATCHER)
CONFIG = dataclasses.replace(HARD, gate_temperature=2.0)
OWN = submaps.with_defaults(simulation.own_params(simulation.Noise(), DRIVE))
OBJECTIVE = tuning.Objective(CONFIG, (("pose_nll", 1.0),))
TUNED = ("v", "w", "match_std", "match_scale", "map_length")


@functools.cache
def drives():
    world = simulation.room()
    world = world._replace(landmarks=world.landmarks[:0])
    return tuning.simulated(jax.random.key(2), 2, world, simulation.Noise(), scenario=DRIVE, scans=True)


@functools.cache
def coordinates():
    whole = tuning.unconstrain(OWN, OBJECTIVE.blocks)
    return {name: whole[name] for name in TUNED}


@pytest.fixture(scope="module")
def sloped():
    """`pose_nll`, its derivative along a direction of the coordinates, and what the filter reports, compiled once:
    with one direction at a time the program is half as large, and reports of a program of their own would cost as much.
    """

    def judged(at, batch):
        kept = []

        def keeping(*args, collect, **how):
            def both(info, aside):
                match = info.match
                reports = info.belief.pose, match.accepted, match.tried, match.finished
                return collect(info, aside), jax.lax.stop_gradient(reports)  # they need no derivatives

            collected, reports = filtered(*args, collect=both, **how)
            kept.append(reports)
            return collected

        whole = tuning.unconstrain(OWN, OBJECTIVE.blocks)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(losses, "filtered", keeping)
            loss = OBJECTIVE(tuning.constrain(whole | at, OBJECTIVE.blocks), batch)[0]
        return loss, kept[0]

    @jax.jit
    def along(at, direction, batch):
        return jax.jvp(lambda at: judged(at, batch), (at,), (direction,), has_aux=True)

    return lambda at, direction: along(at, direction, drives())


def towards(name):
    return {other: jnp.asarray(1.0 if other == name else 0.0, x.dtype) for other, x in coordinates().items()}


def test_a_filter_that_matches_has_three_parameters_more():
    assert tuning.blocks_of(dataclasses.replace(CONFIG, matcher=None)) == tuning.parameters.BLOCKS
    names = tuning.names_of(OBJECTIVE.blocks)
    assert set(names) - set(tuning.NAMES) == {"match_std", "match_scale", "map_length"}
    assert {tuning.units_of(OBJECTIVE.blocks)[name] for name in names[-5:-2]} == {"m"}
    back = tuning.constrain(tuning.unconstrain(OWN, OBJECTIVE.blocks), OBJECTIVE.blocks)
    assert back.blocks == pytest.approx({"match_std": 0.03, "match_scale": 0.1, "map_length": 0.6})


def test_what_is_judged_is_the_pose_alone(sloped, tolerance):
    """Of the 15 entries of the state the first three, matches and all."""
    loss, _, reports = sloped(coordinates(), towards("v"))
    belief, accepted, tried, finished = jax.tree.map(np.asarray, reports)
    assert accepted.sum() == tried.sum() > 30
    assert finished.any(axis=1).all()
    error = np.asarray(drives().truth) - belief.mean
    error[..., 2] = (error[..., 2] + np.pi) % (2 * np.pi) - np.pi
    cov = belief.cov.astype(float)
    nees = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(cov), error)
    expected = 0.5 * (nees + np.linalg.slogdet(cov)[1] + 3 * np.log(2 * np.pi)).mean()
    assert float(loss) == pytest.approx(expected, rel=tolerance(1e-9, 1e-2))


@pytest.mark.parametrize("name", TUNED)
def test_a_gradient_is_what_differences_give(name, sloped, x64):
    at, along, h = coordinates(), towards(name), 1e-4
    up, down = (float(sloped(at | {name: at[name] + step}, along)[0]) for step in (h, -h))
    assert float(sloped(at, along)[1]) == pytest.approx((up - down) / (2 * h), rel=1e-4)


def test_scans_are_needed():
    batch = drives()
    without = batch._replace(inputs=batch.inputs._replace(ranges=None))
    for missing in (without, batch._replace(beam_angles=None)):
        with pytest.raises(ValueError, match=r"config\.matcher: expected batch\.inputs\.ranges and batch\.beam_angles"):
            filtered(OWN, missing, config=CONFIG, collect=lambda info, _: info)


MOVED = np.square([0.015, 0.015, 0.008])  # m², m², rad²: what is not known of a motion between two scans


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None, None, None, None))
def match(mean, cov, maps, ranges, before):
    """What `match_scan` returns with a soft gate, and the derivative of what a match observes."""
    angles, scanner = (2, 5, 8, 11, 14), CONFIG.scanner(DRIVE.beam_angles())
    settings = {"scanner": scanner, "matcher": MATCHER, "angles": angles, "temperature": 2.0}
    got = submaps.match_scan(OWN, Gaussian(mean, cov), maps, ranges, before=before, **settings)
    return got, submaps.relative_pose(mean, 3)[1]


def test_a_soft_gate_corrects_by_the_weight_of_a_match_and_maps_by_its_decision(x64):
    """From poses that are believed farther and farther off, a scan with w times its log density. Six scans before it
    have begun two submaps.
    """
    truth, scans = (np.asarray(x)[0, ::5] for x in (drives().truth, drives().inputs.ranges))
    mean, P, maps = np.zeros(15), np.zeros((15, 15)), submaps.empty(MATCHER, np.dtype(float))
    mean[:3] = truth[0]
    steps = np.diff(truth[:7], axis=0, prepend=truth[:1])

    def moved(mean, P, k):
        return np.tile(mean + np.pad(steps[k], (0, 12)), (12, 1)), P + np.diag(np.pad(MOVED, (0, 12)))

    for k in range(6):
        means, predicted = moved(mean, P, k)
        got, _ = match(means, predicted, maps, scans[k], mean)
        (mean, P), maps, _ = jax.tree.map(lambda x: np.asarray(x[0]), got)
    means, P = moved(mean, P, 6)
    means[:, 1] += np.linspace(0, 0.085, 12)
    got, slopes = jax.tree.map(np.asarray, match(means, P, maps, scans[6], mean))
    belief, after, report = got
    threshold = scipy.stats.chi2.ppf(MATCHER.gate_probability, 3)
    np.testing.assert_array_equal(report.accepted, report.nis < threshold)
    assert 0 < report.accepted.sum() < 12
    changed = (after.lines != maps.lines).any(axis=(1, 2, 3))
    np.testing.assert_array_equal(changed, report.accepted)
    assert not report.begun.any()
    assert report.converged.all()
    for i, H in enumerate(slopes):
        rel, told, moved = H @ P @ H.T, report.information[i], report.displacement[i]
        w = 1 / (1 + np.exp((report.nis[i] - threshold) / 2))
        pull = w * (told @ moved + np.linalg.solve(rel, moved))
        shift = P @ H.T @ np.linalg.solve(np.eye(3) + w * told @ rel, pull)
        np.testing.assert_allclose(belief.mean[i] - means[i], shift, rtol=0, atol=1e-3 * np.abs(shift).max())


@pytest.mark.parametrize("config", [CONFIG, HARD])
def test_the_filter_tells_a_match_how_soft_its_gate_is(config, monkeypatch):
    def told(*_, temperature, **__):
        assert temperature == config.gate_temperature
        raise Enough

    monkeypatch.setattr(submaps, "match_scan", told)
    first = jax.tree.map(lambda x: x[0], (drives().prior, drives().inputs))
    with pytest.raises(Enough):
        run(
            OWN,
            init(first[0], config=config),
            first[1],
            beam_angles=DRIVE.beam_angles(),
            config=config,
            collect=lambda *_: (),  # so that it is traced anew
        )
