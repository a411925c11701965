"""Other ways to correct a pose by scans: as absolute measurements, with the covariances that are in use, and relative
to a keyframe. Each filters one drive, in blocks of as many steps as lie between two matches.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from baselines import fits
from baselines.fits import Fit

from jaxlocmap import Config, GridSpec, Inputs, Params, init, run
from jaxlocmap._internal.linalg import Matrix, inverse
from jaxlocmap.filters import information
from jaxlocmap.mapping import grid
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import NO_RETURN, Points, surface_points
from jaxlocmap.matching.submaps import MATCH_SCALE, MATCH_STD
from jaxlocmap.se2 import POSE, between
from jaxlocmap.step import predict
from jaxlocmap.types import Gaussian, Matcher, Scanner

SPEC = GridSpec(origin=(-3.0, -3.0), resolution=0.1, shape=(260, 400))  # holds either world and some error
_LEAST_POINTS = 10  # that say anything of the pose, or the match does not count
_HIT, _MISS = 2.2, -0.4  # nats: log-odds of 0.9 and 0.4, as Hector SLAM adds them
_PROBABILITY_STD = 0.3  # of a residual on the occupancy grid, for the solver alone
_CERES = (20.0, 1.0, 100.0, 2.34e-4)  # weights of scan, translation and rotation, and the scale of the covariance
_RESPONSE_DROP = 0.1  # below the best response: what is less does not count
_SMEAR = 0.03  # m
_SHIFTS, _TURNS = (0.14, 15), (0.01745, 11)  # m, rad to either side, and how many
_KEYFRAME = (1.0, 0.5)  # m, rad from the last one: then a new one
_LEAST = 1e-6  # beside a matrix that may be singular, as a share of its diagonal


class Scan(NamedTuple):
    """A scan as it came and as points."""

    ranges: jax.Array  # (B,) m; `max_range` where there was no return
    hit: jax.Array  # (B,) bool
    points: Points


class Matched(NamedTuple):
    """What a match found, of which a correction is made."""

    shift: jax.Array  # (3,) m, m, rad: from the pose predicted to the best one
    fit: Fit  # at the best pose
    variance: jax.Array  # () of a residual


class Told(NamedTuple):
    """What the filter is told of its pose, as of `information.update`."""

    information: jax.Array  # (3, 3) R⁻¹
    gradient: jax.Array  # (3,)


# ---- What is taken for the covariance R of a match ------------------------------------------------------------------


def _inverse(matrix: jax.Array) -> jax.Array:
    """Also of one that is singular: a little is added to its diagonal."""
    lifted = matrix + _LEAST * jnp.diag(jnp.diagonal(matrix)) + jnp.finfo(matrix.dtype).tiny * jnp.eye(POSE)
    return inverse(Matrix.symmetric(lifted)).array(matrix.dtype)


def _measured(matched: Matched, information: jax.Array) -> Told:
    """The best pose, measured with that inverse covariance."""
    return Told(information, information @ matched.shift)


def inverse_hessian(matched: Matched) -> Told:
    """R = σ² (Σ w Jᵀ J)⁻¹."""
    return _measured(matched, matched.fit.hessian / matched.variance)


def sandwich(matched: Matched, factor: float = 1.0) -> Told:
    """R = factor · Λ⁻¹ (Σ w² r² Jᵀ J / σ⁴) Λ⁻¹, Λ = Σ w Jᵀ J / σ². Source: White 1982."""
    residual, J, weight = matched.fit
    information = matched.fit.hessian / matched.variance
    middle = J.T @ ((weight * residual / matched.variance)[:, None] ** 2 * J)
    return _measured(matched, information @ _inverse(middle) @ information / factor)


def hessian(matched: Matched) -> Told:
    """R = Σ Jᵀ J, in cells and radians, as Hector SLAM publishes it."""
    cells = jnp.diag(jnp.asarray([SPEC.resolution, SPEC.resolution, 1], matched.variance.dtype))
    return _measured(matched, _inverse(cells @ matched.fit.hessian @ cells))


def with_prior(matched: Matched) -> Told:
    """R = s (a² Σ Jᵀ J / n + diag(b², b², c²))⁻¹, of an optimiser that weighs the scan against the pose it began at,
    and the pose that it finds: with the weights a, b, c and the scale s of Cartographer 0.1.
    """
    scan, translation, rotation, scale = _CERES
    information = scan**2 / scale * matched.fit.hessian / jnp.maximum(jnp.sum(matched.fit.weight), 1)
    prior = jnp.diag(jnp.asarray([translation**2, translation**2, rotation**2], information.dtype)) / scale
    return Told(information + prior, information @ matched.shift)


def unscaled(matched: Matched) -> Told:
    """R = (Σ w Jᵀ J)⁻¹."""
    return _measured(matched, matched.fit.hessian)


def response_moments(matched: Matched, response: Callable[[jax.Array], jax.Array]) -> Told:
    """R the second moments of the responses about the best pose, as Karto has them: over shifts at the best heading and
    over turns at the best place, of the responses less than 0.1 below the best, weighted by themselves, and the larger
    the poorer the best one is (the turn's too, which Karto leaves as it is).

    Args:
        matched: as of the others.
        response: (K, 3) poses less the best one -> (K,) share of the scan that fits.

    Source: Olson 2009, section IV.
    """
    dtype = matched.variance.dtype
    (reach, shifts), (angle, turns) = _SHIFTS, _TURNS
    shift, turn = jnp.linspace(-reach, reach, shifts, dtype=dtype), jnp.linspace(-angle, angle, turns, dtype=dtype)
    x, y = (v.ravel() for v in jnp.meshgrid(shift, shift, indexing="ij"))
    best = response(jnp.zeros((1, POSE), dtype))[0]

    def weight(poses: jax.Array) -> jax.Array:
        share = response(poses)
        counted = jnp.where(share >= best - _RESPONSE_DROP, share, 0)
        return counted / jnp.maximum(jnp.sum(counted), jnp.finfo(dtype).tiny)

    moved = weight(jnp.stack([x, y, jnp.zeros_like(x)], axis=1))
    turned = weight(jnp.stack([jnp.zeros_like(turn), jnp.zeros_like(turn), turn], axis=1))
    xx, xy, yy = (jnp.sum(moved * a * b) for a, b in ((x, x), (x, y), (y, y)))
    least_shift, least_turn = (2 * reach / (shifts - 1)) ** 2 / 10, (2 * angle / (turns - 1)) ** 2
    spread = jnp.diag(jnp.stack([jnp.maximum(xx, least_shift), jnp.maximum(yy, least_shift), least_turn]))
    spread = spread.at[0, 1].set(xy).at[1, 0].set(xy).at[2, 2].max(jnp.sum(turned * turn**2))
    return _measured(matched, _inverse(spread / jnp.maximum(best, _RESPONSE_DROP)))


# What is taken for R, by the number that a filter is given.
ON_OCCUPANCY = ("σ² H⁻¹", "H itself (Hector SLAM)", "the optimiser's with its prior (Cartographer 0.1)")
ON_LINES = ("σ² H⁻¹", "sandwich", "sandwich × 30", "moments of the response (Karto)", "(JᵀJ)⁻¹ without σ²")
_Choices = list[Callable[[], Told]]


# ---- The filters -----------------------------------------------------------------------------------------------------

# (belief, memory, scan) -> (belief, memory)
_Correct = Callable[[Gaussian, Any, Scan], tuple[Gaussian, Any]]


def odometry(params: Params, prior: Gaussian, inputs: Inputs, *, scanner: Scanner, config: Config) -> Gaussian:
    """No match at all."""

    def correct(belief: Gaussian, memory: Any, scan: Scan) -> tuple[Gaussian, Any]:
        return belief, memory

    return _filtered(correct, prior, (), params, inputs, scanner, config)


def on_occupancy(
    params: Params, prior: Gaussian, inputs: Inputs, *, scanner: Scanner, config: Config, law: jax.Array
) -> Gaussian:
    """Matches on one occupancy grid, taken for absolute measurements. law: () int32, into `ON_OCCUPANCY`."""
    hit, miss = (jnp.asarray(x, prior.mean.dtype) for x in (_HIT, _MISS))

    def correct(belief: Gaussian, log_odds: jax.Array, scan: Scan) -> tuple[Gaussian, Any]:
        def fit(pose: jax.Array) -> Fit:
            return fits.on_occupancy(log_odds, pose, scan.points.xy, scan.hit, spec=SPEC)

        weak = jnp.diag(jnp.asarray(fits.WEAK, belief.mean.dtype) ** 2)
        found = fits.solve(fit, belief.mean, weak, _PROBABILITY_STD)
        residual, _, weight = found.fit
        variance = jnp.sum(weight * residual**2) / jnp.maximum(jnp.sum(weight) - POSE, 1)
        matched = Matched(found.shift(belief.mean, variance), found.fit, variance)
        choices: _Choices = [functools.partial(own, matched) for own in (inverse_hessian, hessian, with_prior)]
        belief = _absolute(belief, matched, choices, law)
        return belief, grid.add_scan(log_odds, belief.mean, scan.ranges, hit, miss, scanner=scanner, spec=SPEC)

    return _filtered(correct, prior, jnp.zeros(SPEC.shape, prior.mean.dtype), params, inputs, scanner, config)


def on_lines(
    params: Params, prior: Gaussian, inputs: Inputs, *, scanner: Scanner, config: Config, law: jax.Array
) -> Gaussian:
    """Matches on one map of lines, taken for absolute measurements. law: () int32, into `ON_LINES`."""
    std, scale = params.block(MATCH_STD), params.block(MATCH_SCALE)

    def correct(belief: Gaussian, lines: jax.Array, scan: Scan) -> tuple[Gaussian, Any]:
        def fit(pose: jax.Array) -> Fit:
            return fits.on_lines(lines, pose, scan.points, scale, spec=SPEC)

        found = fits.solve(fit, *belief, std)

        def response(shifts: jax.Array) -> jax.Array:
            def one(shift: jax.Array) -> jax.Array:
                pose = found.pose + shift
                turned = line_grid.placed(pose.at[:2].set(0), scan.points)
                return line_grid.overlap(lines, pose[:2], turned, jnp.full_like(std, _SMEAR), spec=SPEC)

            points = jnp.maximum(jnp.sum(scan.points.valid), 1).astype(std.dtype)
            return jax.vmap(one)(shifts) / points

        matched = Matched(found.shift(belief.mean, std**2), found.fit, std**2)
        belief = _absolute(
            belief,
            matched,
            [
                functools.partial(inverse_hessian, matched),
                functools.partial(sandwich, matched),
                functools.partial(sandwich, matched, 30.0),
                functools.partial(response_moments, matched, response),
                functools.partial(unscaled, matched),
            ],
            law,
        )
        return belief, line_grid.add_points(lines, belief.mean, scan.points, spec=SPEC)

    lines = jnp.zeros((*SPEC.shape, line_grid.SUMS), prior.mean.dtype)
    return _filtered(correct, prior, lines, params, inputs, scanner, config)


def _absolute(belief: Gaussian, matched: Matched, choices: _Choices, law: jax.Array) -> Gaussian:
    """The belief corrected by a match that is taken for a measurement of the pose itself."""
    told = jax.lax.switch(law, choices)
    told = jax.tree.map(lambda x: jnp.where(matched.fit.used >= _LEAST_POINTS, x, 0), told)
    return Gaussian(*information.update(*belief, jnp.eye(POSE, dtype=belief.mean.dtype), *told))


class Keyframe(NamedTuple):
    """The scan that others are matched on."""

    points: Points
    known: jax.Array  # () bool: there is one


def on_keyframes(params: Params, prior: Gaussian, inputs: Inputs, *, scanner: Scanner, config: Config) -> Gaussian:
    """Matches point to line on the scan of the last keyframe, whose pose is cloned: R = σ² (Σ w Jᵀ J)⁻¹ of the pose
    relative to it. Source: Roumeliotis & Burdick 2002 (the clone).
    """
    std, scale = params.block(MATCH_STD), params.block(MATCH_SCALE)

    def correct(belief: Gaussian, keyframe: Keyframe, scan: Scan) -> tuple[Gaussian, Any]:
        def fit(pose: jax.Array) -> Fit:
            return fits.on_scan(keyframe.points, pose, scan.points, scale)

        predicted, by_keyframe, by_pose = between(belief.mean[POSE:], belief.mean[:POSE])
        H = jnp.concatenate([by_pose.array(std.dtype), by_keyframe.array(std.dtype)], axis=1)
        found = fits.solve(fit, predicted, H @ belief.cov @ H.T, std)
        told = jnp.where(keyframe.known & (found.fit.used >= _LEAST_POINTS), found.fit.hessian / std**2, 0)
        pull = told @ found.shift(predicted, std**2)
        belief = Gaussian(*information.update(*belief, H, told, pull, angles=(2, 5), poses=(0, POSE)))
        away, _, _ = between(belief.mean[POSE:], belief.mean[:POSE])
        new = ~keyframe.known | (jnp.hypot(away[0], away[1]) > _KEYFRAME[0]) | (jnp.abs(away[2]) > _KEYFRAME[1])
        fresh = _cloned(belief), Keyframe(scan.points, new)
        return jax.tree.map(lambda a, b: jnp.where(new, a, b), fresh, (belief, keyframe))

    beams = len(scanner.beam_angles)
    nothing = jnp.zeros((beams, 2), prior.mean.dtype)
    keyframe = Keyframe(Points(nothing, nothing, jnp.zeros(beams, bool)), jnp.array(False))
    return _filtered(correct, _cloned(prior), keyframe, params, inputs, scanner, config)


def _cloned(belief: Gaussian) -> Gaussian:
    """The pose, and the pose once more."""
    twice = jnp.tile(jnp.arange(POSE), 2)
    return Gaussian(belief.mean[twice], belief.cov[twice][:, twice])


def on_submaps(params: Params, prior: Gaussian, inputs: Inputs, *, scanner: Scanner, config: Config) -> Gaussian:
    """This library's own: submaps with anchor and bias."""
    _, belief = run(
        params,
        init(prior, config=config),
        inputs,
        beam_angles=scanner.beam_angles,
        config=config,
        collect=lambda state, info, aside: info.belief.pose,
    )
    return jax.tree.map(lambda x: x[:: _matcher(config).period], belief)


def _matcher(config: Config) -> Matcher:
    if config.matcher is None:
        raise ValueError("config.matcher: expected a Matcher, got None")
    return config.matcher


def _filtered(
    correct: _Correct, prior: Gaussian, memory: Any, params: Params, inputs: Inputs, scanner: Scanner, config: Config
) -> Gaussian:
    """Beliefs about the pose after each match: at the first step and then every period."""
    if inputs.ranges is None:
        raise ValueError("inputs.ranges: expected scans, got None")
    matcher = _matcher(config)
    std = params.block(MATCH_STD)
    controls = inputs.control.reshape(-1, matcher.period, inputs.control.shape[1])
    dt = jnp.asarray(config.dt, prior.mean.dtype)

    def move(belief: Gaussian, control: jax.Array) -> tuple[Gaussian, None]:
        return predict(params, belief, control, dt, config=config)[0], None

    def block(carry: tuple[Gaussian, Any], now: tuple[jax.Array, jax.Array]) -> tuple[tuple[Gaussian, Any], Gaussian]:
        (belief, memory), (controls, ranges) = carry, now
        belief, _ = move(belief, controls[0])
        hit = ranges < scanner.max_range - NO_RETURN
        points = surface_points(ranges, std, scanner=scanner, gap=matcher.gap)
        belief, memory = correct(belief, memory, Scan(jnp.where(hit, ranges, scanner.max_range), hit, points))
        corrected = belief.pose
        belief, _ = jax.lax.scan(move, belief, controls[1:])
        return (belief, memory), corrected

    return jax.lax.scan(block, (prior, memory), (controls, inputs.ranges[:: matcher.period]))[1]
