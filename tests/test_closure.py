"""Loop closure: the trail of a filter, submaps registered on older ones, and the graph that they make."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from jaxlocmap import graph as pose_graph
from jaxlocmap import simulation
from jaxlocmap.graph.closure import Closed, Closure, _window, close_loops, scan_poses
from jaxlocmap.graph.registration import SubmapScans, register
from jaxlocmap.graph.trail import Trail, trail_of
from jaxlocmap.matching.normals import surface_points
from jaxlocmap.poses import between, compose
from jaxlocmap.types import GridSpec, Scanner

SPEC = GridSpec(origin=(-9.0, -9.0), resolution=0.1, shape=(180, 180))
STD, SCALE = np.float32(0.03), np.float32(0.1)
ANGLES = np.linspace(-1.2, 1.2, 61)
EACH = 8  # scans of a submap
POINTS = 244  # of a submap that are matched: every second beam
WINDOW = (0.75, 0.12)  # m, rad: half of it is too narrow for every loop of the drive, so one program looks for all


def report(steps, **fields):
    """What matches report, all nothing but for what is given as {step: value}."""
    zero = np.zeros(steps)
    of = {name: zero.astype(bool) for name in ("due", "accepted", "anew", "begun", "finished")}
    of["due"] = np.ones(steps, bool)
    for name, at in fields.items():
        if name in of:
            of[name] = of[name].copy()
            of[name][list(at)] = True
    pose = np.arange(3.0 * steps).reshape(steps, 3)
    cov = np.arange(1.0, steps + 1)[:, None, None] * np.eye(3)
    return SimpleNamespace(**of, relative=(pose, cov), edge=(-pose, 10 * cov))


def test_trail():
    # Scan 0 begins a submap, scan 2 the younger one, which takes over at scan 4, where the next one begins.
    trail = trail_of(report(7, anew=[0], accepted=[1, 2, 3, 4, 6], begun=[2, 4], finished=[4]))
    np.testing.assert_array_equal(trail.submap, [0, 0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(trail.begun, [0, 2])
    np.testing.assert_array_equal(trail.edge, [[-12, -13, -14]])
    np.testing.assert_array_equal(trail.edge_cov, [50 * np.eye(3)])
    np.testing.assert_array_equal(trail.place[[0, 1, 6]], [[0, 0, 0], [3, 4, 5], [18, 19, 20]])
    np.testing.assert_array_equal(trail.place_cov[[0, 1]], [np.zeros((3, 3)), 2 * np.eye(3)])
    np.testing.assert_array_equal(trail.drawn, [True] * 5 + [False, True])
    np.testing.assert_array_equal(trail.middle, [2, 6])


def test_trail_begun_anew():
    # After refusals a submap begins at scan 3, where the one before believes the robot to be; the younger is lost.
    trail = trail_of(report(6, anew=[0, 3], accepted=[1, 4, 5], begun=[1]))
    np.testing.assert_array_equal(trail.submap, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(trail.begun, [0, 3])
    np.testing.assert_array_equal(trail.edge, [[9, 10, 11]])
    np.testing.assert_array_equal(trail.edge_cov, [4 * np.eye(3)])
    np.testing.assert_array_equal(trail.place[3], [0, 0, 0])


def test_trail_without_a_submap():
    trail = trail_of(report(3))
    assert trail.submaps == 0
    np.testing.assert_array_equal(trail.submap, [-1] * 3)
    with pytest.raises(ValueError, match="trail: expected at least one submap, got none"):
        close_loops(trail, None, STD, SCALE, spec=SPEC, closure=Closure())


@functools.cache
def circle():
    """A drive around the box of the room, one and a half times, cut into submaps of eight scans whose chain drifts:
    each edge has an error drawn from its own covariance; scans lie in their submaps as they were taken.
    """
    scans = 12 * EACH
    turn = np.linspace(0, 3 * np.pi, scans)
    truth = np.stack([6 + 3.2 * np.cos(turn), 5.25 + 3.2 * np.sin(turn), turn + np.pi / 2], axis=-1)
    walls = simulation.room().segments.astype(jnp.float32)
    angles = jnp.asarray(ANGLES, jnp.float32)
    cast = jax.vmap(lambda pose: simulation.ray_cast(pose, angles, walls, 8.0))
    rng = np.random.default_rng(0)
    ranges = np.asarray(cast(jnp.asarray(truth, jnp.float32))) + 0.01 * rng.normal(size=(scans, len(ANGLES)))
    scanner = Scanner(angles)
    points = jax.jit(jax.vmap(lambda r: surface_points(r, 0.03, scanner=scanner, gap=0.8)))(
        jnp.asarray(ranges, jnp.float32)
    )
    begun = np.arange(0, scans, EACH)
    submap = np.arange(scans) // EACH
    std = np.array([0.04, 0.04, 0.02])
    anchors = truth[begun]
    edge = between(anchors[:-1], anchors[1:]) + std * rng.normal(size=(len(begun) - 1, 3))
    place_cov = np.broadcast_to(np.diag([0.01, 0.01, 0.003]) ** 2, (scans, 3, 3)).copy()
    place_cov[begun] = 0
    trail = Trail(
        edge=edge,
        edge_cov=np.broadcast_to(np.diag(std**2), (len(edge), 3, 3)).copy(),
        submap=submap,
        place=between(anchors[submap], truth),
        place_cov=place_cov,
        drawn=np.ones(scans, bool),
        begun=begun,
    )
    return truth, trail, points


@functools.cache
def closed(**settings):
    truth, trail, points = circle()
    closure = Closure(candidates=3, window=WINDOW, points=POINTS, **settings)
    return close_loops(trail, points, STD, SCALE, spec=SPEC, closure=closure, first=truth[0])


def test_registration_finds_the_older_submap(x64):
    truth, trail, points = circle()
    scans = SubmapScans(trail)
    i, j = 1, 9  # a whole turn apart
    exact = between(truth[trail.begun[i]], truth[trail.begun[j]])
    off = np.array([0.25, -0.2, 0.06])
    left_out = np.zeros_like(points.valid)
    left_out[scans.query(j)[0], 1::2] = True
    found = register(
        points._replace(xy=np.where(left_out[..., None], np.float32(3), points.xy)),
        scans.map(i),
        scans.query(j),
        *(np.asarray(x, np.float32) for x in (exact + off, np.diag([0.2, 0.2, 0.1]) ** 2, scans.spread[i])),
        STD,
        SCALE,
        spec=SPEC,
        window=WINDOW,
        most=POINTS,
    )
    error = np.asarray(found.moved, np.float64) - exact
    np.testing.assert_allclose(error[:2], 0, atol=0.02)
    assert abs(reference.wrap(error[2])) < 0.01
    assert found.converged
    assert found.share > 0.8
    assert found.std < 0.02
    # By how much it is off what was expected, in standard deviations.
    moved = np.asarray(found.moved, np.float64) - exact - off
    S = np.asarray(found.cov, np.float64) + np.diag([0.2, 0.2, 0.1]) ** 2
    assert float(found.nis) == pytest.approx(moved @ np.linalg.solve(S, moved), rel=0.02)


@pytest.mark.parametrize(
    ("std", "share"),
    [((0.09, 0.09, 0.015), 8), ((0.15, 0.09, 0.015), 4), ((0.09, 0.3, 0.07), 2), ((0.09, 0.09, 0.2), 1)],
)
def test_the_window_holds_three_standard_deviations(std, share):
    """The least of the widest one, its half, quarter and eighth; or the widest."""
    closure = Closure(window=(2.4, 0.48))
    assert _window(np.diag(std) ** 2, closure) == (2.4 / share, 0.48 / share)
    assert _window(np.diag(100 * np.array(std)) ** 2, closure) == (2.4, 0.48)


def test_loops_take_the_drift_out(x64):
    truth, trail, _ = circle()
    result = closed()
    assert result.solution.converged
    assert result.attempts.accepted.sum() >= 3
    poses, cov = scan_poses(trail, result)
    error = np.hypot(*(poses - truth)[:, :2].T)
    drift = compose_chain(truth[0], trail)
    assert error.mean() < 0.06
    assert np.hypot(*(drift - truth)[:, :2].T).mean() > 2 * error.mean()
    # Loops agree with the truth, as their covariances say.
    pair = result.attempts.pair[result.attempts.accepted]
    anchors = truth[trail.begun]
    off = between(anchors[pair[:, 0]], anchors[pair[:, 1]]) - result.attempts.found.moved[result.attempts.accepted]
    off[:, 2] = reference.wrap(off[:, 2])
    nees = np.einsum("ki,kij,kj->k", off, np.linalg.inv(result.attempts.found.cov[result.attempts.accepted]), off)
    assert nees.mean() < 6
    assert np.all(np.linalg.eigvalsh(cov) > -1e-12)


def compose_chain(first, trail):
    anchors = [first]
    for edge in trail.edge:
        anchors.append(compose(anchors[-1], edge))
    return compose(np.array(anchors)[trail.submap], trail.place)


def test_online_knows_no_later_loop(x64):
    truth, trail, _ = circle()
    result = closed()
    first = result.attempts.pair[result.attempts.accepted][:, 1].min()
    chain = compose_chain(truth[0], trail)[trail.begun]
    np.testing.assert_allclose(result.online[: first + 1, :2], chain[: first + 1, :2], atol=1e-6)
    assert not np.allclose(result.online[-1, :2], chain[-1, :2], atol=1e-3)


def test_what_is_too_strict_closes_nothing(x64):
    result = closed(most_std=1e-9)
    assert not result.attempts.accepted.any()
    np.testing.assert_allclose(
        result.solution.poses, pose_graph.dead_reckoning(result.graph, jnp.asarray(circle()[0][0])), atol=1e-9
    )


def test_covariance_of_scans(x64):
    """Anchor and place moved by small amounts move the scan by what the covariance is propagated with."""
    _, trail, _ = circle()
    cov = np.diag([0.03, 0.02, 0.01]) ** 2 + 1e-5
    result = closed(most_std=1e-9)
    k = 3
    graph = result.graph
    anchors = np.asarray(result.solution.poses)
    of_anchor = np.asarray(pose_graph.marginals(graph, result.solution))[k]
    trail = trail._replace(place_cov=np.where(trail.submap[:, None, None] == k, cov, trail.place_cov))
    _, total = scan_poses(trail, result)
    s = EACH * k + 5

    def derivative(f, at):
        return np.stack([(f(at + d) - f(at - d)) / 2e-6 for d in 1e-6 * np.eye(3)], axis=-1)

    A = derivative(lambda a: compose(a, trail.place[s]), anchors[k])
    B = derivative(lambda p: compose(anchors[k], p), trail.place[s])
    np.testing.assert_allclose(total[s], A @ of_anchor @ A.T + B @ cov @ B.T, rtol=1e-5, atol=1e-9)


def test_scans_before_the_first_submap_have_no_pose(x64):
    _, trail, _ = circle()
    result = closed(most_std=1e-9)
    submap = trail.submap.copy()
    submap[:2] = -1
    poses, cov = scan_poses(trail._replace(submap=submap), result)
    assert np.isnan(poses[:2]).all()
    assert np.isnan(cov[:2]).all()
    assert np.isfinite(poses[2:]).all()


def test_one_submap_alone(x64):
    truth, trail, points = circle()
    one = Trail(
        trail.edge[:0], trail.edge_cov[:0], trail.submap[:EACH], trail.place[:EACH], trail.place_cov[:EACH],
        trail.drawn[:EACH], trail.begun[:1],
    )  # fmt: skip
    some = jax.tree.map(lambda x: x[:EACH], points)
    result = close_loops(one, some, STD, SCALE, spec=SPEC, closure=Closure(), first=truth[0])
    assert isinstance(result, Closed)
    poses, _ = scan_poses(one, result)
    np.testing.assert_allclose(poses[:, :2], truth[:EACH, :2], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"candidates": 0}, "Closure.candidates: expected a whole number of at least 1, got 0"),
        ({"apart": 1}, "Closure.apart: expected a whole number of at least 2"),
        ({"least_share": 1.0}, r"Closure.least_share: expected a value inside \(0, 1\), got 1.0"),
        ({"most_std": 0.0}, "Closure.most_std: expected a finite number > 0, got 0.0"),
        ({"window": (1.0, 0.0)}, "Closure.window: expected two finite numbers > 0"),
    ],
)
def test_closures_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        Closure(**settings)
