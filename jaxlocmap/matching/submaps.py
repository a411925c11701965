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

    lines: jax.Array  # (2 * rows, columns, 6): one after the other (`lines.add_points`)
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
    relative: Gaussian  # (3,), (3, 3) m, m, rad: the pose corrected, in the frame of that submap's anchor
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
    none = jnp.zeros((), jnp.int32)
    lines = jnp.zeros((2 * rows, columns, line_grid.SUMS), dtype)
    path = jnp.zeros((), dtype)
    return Submaps(lines, none, jnp.zeros(2, jnp.int32), path, path, none, none, none)


def no_match(dtype: np.dtype) -> MatchReport:
    """The report of a step without a match."""
    none, real = jnp.zeros((), jnp.int32), jnp.zeros((), dtype)
    vector, square, false = jnp.zeros(POSE, dtype), jnp.zeros((POSE, POSE), dtype), jnp.zeros((), bool)
    pose = Gaussian(vector, square)
    return MatchReport(
        *(false, false, vector, square, real, false, none, none, false, none, pose, false, false, false, pose)
    )


def extended(belief: Gaussian) -> Gaussian:
    """A belief of the motion model's state with room for anchors and biases."""
    n = len(belief.mean)
    mean = jnp.zeros(n + EXTRA, belief.mean.dtype).at[:n].set(belief.mean)
    return Gaussian(mean, jnp.zeros((n + EXTRA,) * 2, belief.mean.dtype).at[:n, :n].set(belief.cov))


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

    Raises:
        ValueError: a wrong shape, or a block that `params` lacks.
    """
    std, scale, length = (params.block(block) for block in BLOCKS)
    older = len(belief.mean) - EXTRA
    younger = older + 2 * POSE
    points = surface_points(ranges, std, scanner=scanner, gap=matcher.gap)
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
    )
    accepted = tried & ~jnp.any(jnp.stack(refusals(report, matcher)))
    gradient = found.information @ moved + found.score
    poses = (0, older, younger)
    corrected = information.update(*belief, H, found.information, gradient, angles=angles, poses=poses)
    belief = _chosen(accepted, Gaussian(*corrected), belief)
    refused = jnp.where(accepted, 0, submaps.refused + tried.astype(jnp.int32))

    submaps = travelled(submaps, before, belief.mean)

    relative = _between(belief, older, 0)

    # Begin submaps: the first, the next, or anew after too many refusals.
    active = submaps.scans[1] > 0
    full = submaps.scans[jnp.where(active, 1, 0)] >= matcher.submap_scans
    full = full | (submaps.length >= matcher.submap_length)
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
    lines = submaps.lines.reshape(2, -1)
    for cleared, slot in ((due, 1 - which), (anew, which)):
        lines = lines.at[jnp.where(cleared, slot, 2)].set(0, mode="drop")
    lines = lines.reshape(submaps.lines.shape)

    # Add the scan to both.
    added = jnp.stack([accepted | anew, (accepted & active) | due])
    share = 1 - jnp.exp(-submaps.travel / length)
    for place, entry, slot in ((0, older, which), (1, younger, 1 - which)):
        kappa = jnp.maximum(1 / (scans[place] + 1).astype(std.dtype), share)
        fresh = scans[place] == 0
        pose, H = relative_pose(belief.mean, entry)
        lines = line_grid.add_points(lines, pose, points, spec=matcher.spec, counts=added[place], at=slot)
        rel = H @ belief.cov @ H.T
        own = line_grid.fit(lines, pose, points, scale, spec=matcher.spec, at=slot).hessian / std**2
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
        accepted=accepted,
        submap=number,
        relative=Gaussian(*(jnp.where(tried, x, 0) for x in relative)),
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


def _between(belief: Gaussian, a: int, b: int) -> Gaussian:
    """The pose at one entry of the state in the frame of that at another."""
    first, second = slice(a, a + POSE), slice(b, b + POSE)
    pose, by_first, by_second = between(belief.mean[first], belief.mean[second])
    H = jnp.zeros((POSE, len(belief.mean)), pose.dtype)
    H = H.at[:, first].set(by_first.array(pose.dtype)).at[:, second].set(by_second.array(pose.dtype))
    return Gaussian(pose, mirrored(H @ belief.cov @ H.T))
