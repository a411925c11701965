"""Scans matched on submaps, inside the filter: what makes the covariance of the pose one to believe in.

A pose matched on a map is not an absolute measurement, because the map was drawn at poses that share its error. So the
map is cut into submaps, and what a match tells is the pose relative to the submap's anchor, a clone of the robot's pose
at the submap's first scan, plus the submap's bias: how far its lines are off, as a match sees them. Anchor and bias are
entries of the filter's state. Two submaps live at a time: scans are matched on the older one and added to both.

The state is that of the motion model, then anchor (x, y, theta) and bias (x, y, theta) of the older submap, then those
of the younger one. What follows the model's entries stands still between scans.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks
from jaxlocmap._internal.linalg import Matrix, inverse, mirrored
from jaxlocmap.filters import ekf, information
from jaxlocmap.matching import lines as line_grid
from jaxlocmap.matching.normals import surface_points
from jaxlocmap.matching.scan_match import match, search
from jaxlocmap.parameters import Block, Params
from jaxlocmap.se2 import POSE, between, boxminus, wrap
from jaxlocmap.types import Gaussian, Matcher, Scanner

MATCH_STD = Block("match_std", ("match_std",), ("m",), "positive")  # of a point of a scan about its line
MATCH_SCALE = Block("match_scale", ("match_scale",), ("m",), "positive")  # a point that far off its line counts half
MAP_LENGTH = Block("map_length", ("map_length",), ("m",), "positive")  # of travel in which a submap's error is replaced
BLOCKS = (MATCH_STD, MATCH_SCALE, MAP_LENGTH)

EXTRA = 4 * POSE  # entries of the state beyond the motion model's
_TURN = 0.5  # m a radian: what a turn counts beside travel
_FRESH = (0.5, 0.5, 0.2)  # m, m, rad: standard deviations of a submap's bias before its first scan


class Submaps(NamedTuple):
    """Two overlapping submaps, in the carry of the filter."""

    lines: jax.Array  # (maps * rows, columns, 6): one after the other (`lines.add_points`)
    older: jax.Array  # () int32: which of the two is the older one
    scans: jax.Array  # (2,) int32: in the older, in the younger one
    travel: jax.Array  # () m: since the last scan was added, turns counted
    length: jax.Array  # () m: since the last submap began, turns counted
    steps: jax.Array  # () int32: of the filter so far
    refused: jax.Array  # () int32: matches refused in a row
    begun: jax.Array  # () int32: submaps so far


class MatchReport(NamedTuple):
    """What a step reports of matching. All zero where none was due."""

    due: jax.Array  # () bool: a scan was to be matched, whatever it saw
    tried: jax.Array  # () bool: it had points enough, and there was a submap to match it on
    displacement: jax.Array  # (3,) m, m, rad: the pose matched, in the submap's frame, minus the pose predicted
    information: jax.Array  # (3, 3) of the scan alone
    nis: jax.Array  # () squared Mahalanobis distance of the displacement by the predicted covariance
    converged: jax.Array  # () bool: the steps of Gauss-Newton sufficed
    points: jax.Array  # () int32: points of the scan that have a normal
    used: jax.Array  # () int32: those that lie on lines of the submap
    accepted: jax.Array  # () bool
    submap: jax.Array  # () int32: number of the submap matched on, from 0
    relative: Gaussian  # (3,), (3, 3) m, m, rad: the pose, corrected or not, in the frame of that submap's anchor
    begun: jax.Array  # () bool: a younger submap begins, at this pose
    anew: jax.Array  # () bool: an older one does: the first of all, or after too many refusals
    finished: jax.Array  # () bool: the older one is finished, and the younger takes its place
    edge: Gaussian  # (3,), (3, 3) m, m, rad: then the younger one's anchor in the frame of the older one's


class Refusals(NamedTuple):
    """Why a match was refused. Several reasons may hold at once."""

    points: jax.Array  # () bool: the scan has fewer points with a normal than `Matcher.least_points`
    share: jax.Array  # () bool: a smaller share of them lies on lines of the submap than `Matcher.least_share`
    nis: jax.Array  # () bool: the gate of `Matcher.gate_probability` refuses its squared Mahalanobis distance
    convergence: jax.Array  # () bool: `Matcher.steps` of Gauss-Newton did not suffice


def with_defaults(params: Params, *, std: float = 0.03, scale: float = 0.1, length: float = 0.6) -> Params:
    """The parameters with the blocks of matching added.

    Args:
        params: all others.
        std: m, of a point of a scan about its line: the noise of a range.
        scale: m, a point that far off its line counts half.
        length: m, of travel in which the error of a submap is replaced by that of new scans.
    """
    own = {block.name: jnp.asarray(value) for block, value in zip(BLOCKS, (std, scale, length), strict=True)}
    return params._replace(blocks={**own, **params.blocks})


def empty(matcher: Matcher, dtype: np.dtype) -> Submaps:
    """Submaps before the first scan."""
    rows, columns = matcher.spec.shape
    maps, path = (matcher.maps * rows, columns, line_grid.SUMS), ((), dtype)
    count = (), jnp.int32
    return Submaps(  # an array each, so that all can be donated
        lines=jnp.zeros(maps, dtype),
        older=jnp.zeros(*count),
        scans=jnp.zeros(2, jnp.int32),
        travel=jnp.zeros(*path),
        length=jnp.zeros(*path),
        steps=jnp.zeros(*count),
        refused=jnp.zeros(*count),
        begun=jnp.zeros(*count),
    )


def known(lines: jax.Array, matcher: Matcher, dtype: np.dtype) -> Submaps:
    """A map that is known, to be matched on and not changed: the only submap, its anchor the frame of the world.

    Args:
        lines: (rows, columns, 6) as `matcher.spec` has it.
        matcher: with `known_std`.
        dtype: of the filter.

    Raises:
        ValueError: a wrong shape, or a matcher that would change the map.
    """
    checks.shape("lines", lines, (*matcher.spec.shape, line_grid.SUMS))
    if matcher.known_std is None:
        raise ValueError("matcher.known_std: expected the standard deviations (m, rad) of a known map, got None")
    return empty(matcher, dtype)._replace(
        lines=jnp.asarray(lines, dtype), scans=jnp.array([1, 0], jnp.int32), begun=jnp.ones((), jnp.int32)
    )


def no_match(dtype: np.dtype) -> MatchReport:
    """The report of a step without a match."""
    none, real = jnp.zeros((), jnp.int32), jnp.zeros((), dtype)
    vector, square, false = jnp.zeros(POSE, dtype), jnp.zeros((POSE, POSE), dtype), jnp.zeros((), bool)
    pose = Gaussian(vector, square)
    return MatchReport(
        *(false, false, vector, square, real, false, none, none, false, none, pose, false, false, false, pose)
    )


def extended(belief: Gaussian, matcher: Matcher) -> Gaussian:
    """A belief of the motion model's state with room for anchors and biases."""
    n, dtype = len(belief.mean), belief.mean.dtype
    mean = jnp.zeros(n + EXTRA, dtype).at[:n].set(belief.mean)
    cov = jnp.zeros((n + EXTRA,) * 2, dtype).at[:n, :n].set(belief.cov)
    if matcher.known_std is not None:
        bias = np.arange(n + POSE, n + 2 * POSE)
        cov = cov.at[bias, bias].set(_known_variance(matcher.known_std, dtype))
    return Gaussian(mean, cov)


def travelled(submaps: Submaps, before: jax.Array, after: jax.Array) -> Submaps:
    """The submaps after the robot moved from one state (n,) to the next."""
    turn = jnp.abs(wrap(after[2] - before[2]))
    path = jnp.sqrt((after[0] - before[0]) ** 2 + (after[1] - before[1]) ** 2 + jnp.finfo(after.dtype).tiny)
    path = path + _TURN * turn
    return submaps._replace(travel=submaps.travel + path, length=submaps.length + path)


def relative_pose(mean: jax.Array, anchor: int) -> tuple[jax.Array, jax.Array]:
    """What a match on a submap observes: the pose in the frame of the anchor, plus the bias.

    Args:
        mean: (n,) state.
        anchor: entry of the state at which the submap's anchor begins; the bias follows it.

    Returns:
        (3,) m, m, rad, and its Jacobian (3, n).
    """
    at, bias = (slice(start, start + POSE) for start in (anchor, anchor + POSE))
    pose, by_anchor, by_pose = between(mean[at], mean[:POSE])
    H = jnp.zeros((POSE, len(mean)), mean.dtype)
    H = H.at[:, :POSE].set(by_pose.array(mean.dtype)).at[:, at].set(by_anchor.array(mean.dtype))
    return pose + mean[bias], H.at[:, bias].set(jnp.eye(POSE, dtype=mean.dtype))


def match_scan(
    params: Params,
    belief: Gaussian,
    submaps: Submaps,
    ranges: jax.Array,
    *,
    before: jax.Array,
    scanner: Scanner,
    matcher: Matcher,
    angles: tuple[int, ...],
    temperature: float = 0.0,
) -> tuple[Gaussian, Submaps, MatchReport]:
    """Match a scan on the older submap, correct the belief, and add the scan to both submaps.

    A scan that is refused is added to neither. After `Matcher.patience` refusals in a row the submaps are begun anew at
    the pose believed in; its covariance does not know of what the scans contradicted, such as a robot carried away.

    Args:
        params: with the blocks of matching.
        belief: (n + 12,), predicted to the time of the scan.
        submaps: so far.
        ranges: (B,) m.
        before: (n + 12,) mean after the step before, corrected: the odometry may tell of no travel, or of too much.
        scanner: with B beams.
        matcher: static.
        angles: entries of the whole state that are angles, static.
        temperature: 0 for a gate that decides. Otherwise, in units of the squared distance, one that weighs
            (`ekf.gate_weight`): a match corrects the belief with its log density times its weight. What is added to the
            map is decided all the same.

    Raises:
        ValueError: a wrong shape, or a block that `params` lacks.
    """
    std, scale, length = (params.block(block) for block in BLOCKS)
    older = len(belief.mean) - EXTRA
    younger = older + 2 * POSE
    # Which points have a normal must not hang on what is tuned: the loss would jump with every point.
    points = surface_points(ranges, matcher.range_std, scanner=scanner, gap=matcher.gap)
    usable = jnp.sum(points.valid, dtype=jnp.int32) >= matcher.least_points

    # Match on the older submap.
    number = submaps.begun - 1 - (submaps.scans[1] > 0).astype(jnp.int32)
    predicted, H = relative_pose(belief.mean, older)
    rel = H @ belief.cov @ H.T
    where = {"spec": matcher.spec, "at": submaps.older}
    start = None
    if matcher.window is not None:
        start = search(submaps.lines, predicted, rel, points, scale, window=matcher.window, **where)
    found = match(submaps.lines, predicted, rel, points, std, scale, steps=matcher.steps, start=start, **where)
    moved = boxminus(found.pose, predicted)
    nis = moved @ found.score
    tried = usable & (submaps.scans[0] > 0)
    report = no_match(nis.dtype)._replace(
        due=jnp.ones((), bool),
        tried=tried,
        displacement=jnp.where(tried, moved, 0),
        information=jnp.where(tried, found.information, 0),
        nis=jnp.where(tried, nis, 0),
        converged=tried & found.converged,
        points=found.points,
        used=jnp.where(tried, found.used, 0),
        submap=number,
    )
    refused = refusals(report, matcher)
    sound = tried & ~(refused.points | refused.share | refused.convergence)
    applied = accepted = sound & ~refused.nis
    told, gradient = found.information, found.information @ moved + found.score
    if temperature:
        weight = ekf.gate_weight(nis, ekf.gate_threshold(matcher.gate_probability, POSE), temperature)
        applied, told, gradient = sound & jnp.isfinite(nis), weight * told, weight * gradient
    poses = (0, older, younger)
    corrected = information.update(*belief, H, told, gradient, angles=angles, poses=poses)
    belief = _chosen(applied, Gaussian(*corrected), belief)
    refused = jnp.where(accepted, 0, submaps.refused + tried.astype(jnp.int32))
    submaps = travelled(submaps, before, belief.mean)
    relative = _between(belief, older, 0)
    there = submaps.scans[0] > 0
    report = report._replace(accepted=accepted, relative=Gaussian(*(jnp.where(there, x, 0) for x in relative)))
    if matcher.known_std is not None:
        belief = _other_place(belief, older, 1 - jnp.exp(-submaps.travel / length), matcher.known_std)
        return belief, submaps._replace(travel=jnp.zeros_like(submaps.travel), refused=refused), report

    # Begin submaps: the first, the next, or anew after too many refusals.
    active = submaps.scans[1] > 0
    anew = usable & (submaps.scans[0] == 0)
    full = jnp.zeros((), bool)
    if matcher.submap_scans is not None:
        full = (submaps.scans[jnp.where(active, 1, 0)] >= matcher.submap_scans) | (
            submaps.length >= matcher.submap_length
        )
        anew = usable & ((submaps.scans[0] == 0) | (refused >= matcher.patience))
    due = accepted & full
    finished = due & active
    edge = _between(belief, older, younger)
    belief = _chosen(finished, _younger_as_older(belief, older), belief)
    belief = _chosen(due, _begun(belief, younger), belief)
    belief = _chosen(anew, _begun(belief, older), belief)
    which = jnp.where(finished, 1 - submaps.older, submaps.older)
    scans = jnp.where(finished, jnp.stack([submaps.scans[1], jnp.zeros((), jnp.int32)]), submaps.scans)
    scans = jnp.where(anew, 0, scans)
    lines = submaps.lines
    if matcher.maps == 2:
        lines = line_grid.cleared(lines, jnp.where(jnp.arange(2, dtype=jnp.int32) == which, anew, due), nis)

    # Add the scan to both, and read the map after that: a read in between would cost a copy of it.
    added = jnp.stack([accepted | anew, (accepted & active) | due])
    share = 1 - jnp.exp(-submaps.travel / length)
    places = ((0, older, which), (1, younger, 1 - which))[: matcher.maps]
    spec = matcher.spec
    for place, entry, slot in places:
        pose, _ = relative_pose(belief.mean, entry)
        lines = line_grid.add_points(lines, pose, points, spec=spec, counts=added[place], at=slot)
    for place, entry, slot in places:
        kappa = jnp.maximum(1 / (scans[place] + 1).astype(std.dtype), share)
        fresh = scans[place] == 0
        pose, H = relative_pose(belief.mean, entry)
        rel = H @ belief.cov @ H.T
        own = line_grid.fit(lines, pose, points, scale, spec=spec, at=slot).hessian / std**2
        told = jnp.where((place == 0) & ~fresh, 0, own)  # the older one was matched on: the belief knows already
        belief = _chosen(added[place], _moved_bias(belief, entry, kappa, H, rel, told), belief)
    scans = scans + added.astype(jnp.int32)
    submaps = Submaps(
        lines=lines,
        older=which,
        scans=scans,
        travel=jnp.where(jnp.any(added), 0, submaps.travel),
        length=jnp.where(due | anew, 0, submaps.length),
        steps=submaps.steps,
        refused=jnp.where(anew, 0, refused),
        begun=submaps.begun + (due | anew).astype(jnp.int32),
    )
    report = report._replace(
        begun=due,
        anew=anew,
        finished=finished,
        edge=Gaussian(*(jnp.where(finished, x, 0) for x in edge)),
    )
    return belief, submaps, report


def refusals(report: MatchReport, matcher: Matcher) -> Refusals:
    """Why the match of a step was refused: no reason holds where it was let in, or none was due.

    Args:
        report: of a step, or of many: any leading shape.
        matcher: that made it.
    """
    dtype = report.nis.dtype
    return Refusals(
        points=report.due & (report.points < matcher.least_points),
        share=report.tried & (report.used.astype(dtype) < matcher.least_share * report.points.astype(dtype)),
        nis=report.tried & ~(report.nis < ekf.gate_threshold(matcher.gate_probability, POSE)),
        convergence=report.tried & ~report.converged,
    )


def _chosen(new_if: jax.Array, new: Gaussian, old: Gaussian) -> Gaussian:
    return Gaussian(*(jnp.where(new_if, a, b) for a, b in zip(new, old, strict=True)))


def _begun(belief: Gaussian, anchor: int) -> Gaussian:
    """A submap begun: its anchor a clone of the pose, its bias as before any scan."""
    n = len(belief.mean)
    source = np.arange(n)
    source[anchor : anchor + POSE] = np.arange(POSE)
    kept = np.ones(n, bool)
    kept[anchor + POSE : anchor + 2 * POSE] = False
    variance = np.zeros(n)
    variance[anchor + POSE : anchor + 2 * POSE] = np.square(_FRESH)
    dtype = belief.mean.dtype
    cov = jnp.where(np.outer(kept, kept), belief.cov[source][:, source], 0) + jnp.asarray(np.diag(variance), dtype)
    return Gaussian(jnp.where(kept, belief.mean[source], 0), cov)


def _younger_as_older(belief: Gaussian, older: int) -> Gaussian:
    source = np.arange(len(belief.mean))
    source[older : older + 2 * POSE] += 2 * POSE
    return Gaussian(belief.mean[source], belief.cov[source][:, source])


def _moved_bias(
    belief: Gaussian, anchor: int, kappa: jax.Array, H: jax.Array, rel: jax.Array, told: jax.Array
) -> Gaussian:
    """The belief after a scan was added: the submap's bias moves by `kappa` towards the error of the pose the scan was
    added at, and by as much towards that of the scan itself.

        β ← β - κ H x (as errors),  plus noise κ² (Λ + P_rel⁻¹)⁻¹
    """
    n, bias = len(belief.mean), slice(anchor + POSE, anchor + 2 * POSE)
    T = jnp.eye(n, dtype=rel.dtype).at[bias].add(-kappa * H)
    gain = inverse(Matrix.identity(POSE) + Matrix.symmetric(rel) @ Matrix.symmetric(told))
    noise = (gain @ Matrix.symmetric(rel)).array(rel.dtype)
    cov = T @ belief.cov @ T.T
    return Gaussian(belief.mean, mirrored(cov.at[bias, bias].add(kappa**2 * noise)))


def _other_place(belief: Gaussian, anchor: int, share: jax.Array, std: tuple[float, float]) -> Gaussian:
    """The belief after the robot went on over a known map, whose errors are others a little farther on: the bias keeps
    1 - share of itself, and the rest is drawn anew.
    """
    n, bias = len(belief.mean), slice(anchor + POSE, anchor + 2 * POSE)
    kept = jnp.ones(n, belief.mean.dtype).at[bias].set(1 - share)
    fresh = jnp.zeros(n, belief.mean.dtype).at[bias].set(_known_variance(std, belief.mean.dtype))
    cov = belief.cov * kept[None, :] * kept[:, None] + jnp.diag((1 - (1 - share) ** 2) * fresh)
    return Gaussian(belief.mean * kept, cov)


def _known_variance(std: tuple[float, float], dtype: np.dtype) -> jax.Array:
    return jnp.asarray((std[0], std[0], std[1]), dtype) ** 2


def _between(belief: Gaussian, a: int, b: int) -> Gaussian:
    """The pose at one entry of the state in the frame of that at another."""
    first, second = slice(a, a + POSE), slice(b, b + POSE)
    pose, by_first, by_second = between(belief.mean[first], belief.mean[second])
    H = jnp.zeros((POSE, len(belief.mean)), pose.dtype)
    H = H.at[:, first].set(by_first.array(pose.dtype)).at[:, second].set(by_second.array(pose.dtype))
    return Gaussian(pose, mirrored(H @ belief.cov @ H.T))
