"""Scales of a pose graph's covariances, found by gradient through the solver."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from test_graph import edges_of

from jaxlocmap import graph, simulation
from jaxlocmap.graph.scales import Scales, _slope

pytestmark = pytest.mark.usefixtures("x64")
GRAPHS, POSES = 300, 12
MORE = 3  # poses that the longest graph has more than the others


@functools.cache
def drawn():
    draw = functools.partial(simulation.simulate_graph, poses=POSES, loops=3)
    return jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), GRAPHS))


@functools.cache
def wrong():
    """Odometry that says twice its errors, loops that say half of theirs."""
    truth, graphs = drawn()
    told = jax.jit(graph.scaled)(graphs, Scales(jnp.array(2.0), jnp.array(0.5)))
    return jax.tree.map(np.asarray, (truth, told))


@functools.cache
def filled():
    """The graphs that are wrong, filled up to the length of one more of which no pose is known: the true poses, what is
    filled up of them where the graph has it, the graphs, and which poses are known. All tuning is of these.
    """
    truth, graphs = wrong()
    first = jax.tree.map(lambda x: x[0], graphs)
    long = first._replace(
        **{name: np.concatenate([getattr(first, name), getattr(first, name)[:MORE]]) for name in graphs._fields[:2]}
    )
    pairs = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda one: graph.stack([one, long])))(graphs))
    more = jax.tree.map(lambda x: np.concatenate([x[:, 0], x[:1, 1]]), pairs)
    known = np.zeros((GRAPHS + 1, POSES + MORE), bool)
    known[:GRAPHS, :POSES] = True
    padded = np.concatenate([truth, np.repeat(truth[:, -1:], MORE, axis=1)], axis=1)
    return np.concatenate([padded, padded[:1]]), more, known


@functools.cache
def found():
    """What they are tuned to."""
    truth, graphs, known = filled()
    return graph.tune_scales(graphs, jnp.asarray(truth), jnp.asarray(known))


def test_a_scale_is_of_standard_deviations():
    (_, graphs), (_, told) = drawn(), wrong()
    np.testing.assert_allclose(told.odometry_information, graphs.odometry_information / 4)
    np.testing.assert_allclose(told.loop_information, graphs.loop_information * 4)


def test_wrong_scales_are_found():
    """The poses of a graph err together: of each at least the three errors of the last one count, so that a scale is
    known to one part in sqrt(2 · 900), and four times that is 10 %.
    """
    scales, before, after = found()
    assert float(scales.odometry) == pytest.approx(0.5, rel=0.1)
    assert float(scales.loop) == pytest.approx(2.0, rel=0.1)
    assert after < before - 0.1


@jax.jit
def density(truth, graphs, known, scales):
    """Of the graphs that are wrong, not filled up, at some scales: one after the other, which is compiled sooner."""
    return jax.lax.map(lambda one: graph.pose_nll(graph.scaled(one[1], scales), one[0], known), (truth, graphs))


def test_it_is_numpys_density_of_poses_that_are_known():
    truth, graphs = wrong()
    known = np.arange(POSES) < 9
    nll = np.asarray(density(truth, graphs, known, Scales(jnp.array(1.0), jnp.array(1.0))))
    poses, _, cov = reference.graph_optimum(truth[0], edges_of(jax.tree.map(lambda x: x[0], graphs)), steps=8)
    error = truth[0] - poses
    error[:, 2] = reference.wrap(error[:, 2])
    each = [cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(POSES)]
    expected = sum(
        0.5 * (error[k] @ np.linalg.solve(each[k], error[k]) + np.log(np.linalg.det(each[k]))) for k in range(1, 9)
    )
    assert nll[0] == pytest.approx(expected, rel=1e-9)


def test_filled_up_poses_do_not_count():
    """The graphs by themselves are as likely before and after, and their best scales are the same: at the corner of a
    parabola through three likelihoods.
    """
    scales, *before_and_after = found()

    def alone(*at):
        nll = density(*wrong(), np.ones(POSES, bool), Scales(*map(jnp.asarray, at)))
        return np.asarray(nll).sum() / (GRAPHS * (POSES - 1))

    best, h = np.array([scales.odometry, scales.loop]), 1e-3
    assert before_and_after == pytest.approx([alone(1.0, 1.0), alone(*best)], rel=1e-8)
    least = before_and_after[1]
    for along in np.eye(2):
        up, down = (alone(*best * np.exp(step * along)) for step in (h, -h))
        assert abs(h / 2 * (down - up) / (up + down - 2 * least)) < 1e-4


def test_its_slope_is_that_of_differences():
    """The mean over all graphs, by the logarithms of the scales, at scales of one."""
    truth, graphs, known = jax.tree.map(jnp.asarray, filled())

    def at(logs):
        return jax.tree.map(np.asarray, _slope(jnp.asarray(logs), graphs, truth, known))

    (_, slope), h = at(np.zeros(2)), 1e-5
    for i, along in enumerate(np.eye(2)):
        up, down = (at(step * along)[0] for step in (h, -h))
        assert slope[i] == pytest.approx((up - down) / (2 * h), rel=1e-5)


def test_what_is_not_finite_is_refused():
    """Whatever pose it is of: by default all count."""
    truth, graphs, known = filled()
    spoiled = graphs.odometry.copy()
    spoiled[3, 2, 0] = np.nan
    lost = truth.copy()
    lost[~known] = np.nan
    for bad in ((graphs._replace(odometry=spoiled), truth), (graphs, lost)):
        with pytest.raises(ValueError, match=r"^graphs: expected finite poses and covariances at scales of one"):
            graph.tune_scales(*jax.tree.map(jnp.asarray, bad))
    with pytest.raises(ValueError, match=r"^truth: expected shape \(15, 3\)"):
        graph.tune_scales(graphs, truth[:, :5])
