"""Scales of a pose graph's covariances, found by gradient through the solver."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import graph, simulation
from jaxlocmap.graph.scales import Scales, _slope

pytestmark = pytest.mark.usefixtures("x64")
GRAPHS, POSES = 300, 12


@functools.cache
def drawn():
    draw = functools.partial(simulation.simulate_graph, poses=POSES, loops=3)
    return jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), GRAPHS))


@functools.cache
def wrong():
    """Odometry that says twice its errors, loops that say half of theirs."""
    truth, graphs = drawn()
    return truth, graph.scaled(graphs, Scales(jnp.array(2.0), jnp.array(0.5)))


@functools.cache
def found():
    """What the graphs that are wrong are tuned to."""
    truth, graphs = wrong()
    return graph.tune_scales(graphs, truth)


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


def test_it_is_numpys_density_of_poses_that_are_known():
    truth, graphs = (jax.tree.map(lambda x: x[0], tree) for tree in wrong())
    known = np.arange(POSES) < 9

    @jax.jit
    def solved(graphs):
        solution = graph.solve(graphs, graph.dead_reckoning(graphs))
        return solution.poses, graph.marginals(graphs, solution), graph.pose_nll(graphs, truth, jnp.asarray(known))

    poses, cov, nll = jax.tree.map(np.asarray, solved(graphs))
    error = np.asarray(truth) - poses
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    expected = sum(
        0.5 * (error[k] @ np.linalg.solve(cov[k], error[k]) + np.log(np.linalg.det(cov[k]))) for k in range(1, 9)
    )
    assert float(nll) == pytest.approx(expected, rel=1e-9)


def test_filled_up_poses_do_not_count():
    truth, graphs = jax.tree.map(np.asarray, wrong())
    each = [jax.tree.map(lambda x, i=i: x[i], graphs) for i in range(GRAPHS)]
    long = each[0]._replace(
        odometry=np.concatenate([each[0].odometry] * 2),
        odometry_information=np.concatenate([each[0].odometry_information] * 2),
    )
    more = graph.stack([*each, long])
    known = np.zeros((GRAPHS + 1, long.poses), bool)
    known[:GRAPHS, :POSES] = True
    padded = np.zeros((GRAPHS + 1, long.poses, 3))
    padded[:GRAPHS, :POSES] = truth
    filled, alone = graph.tune_scales(more, jnp.asarray(padded), jnp.asarray(known)), found()
    np.testing.assert_allclose(filled[0], alone[0], rtol=1e-4)
    assert filled[1:] == pytest.approx(alone[1:], rel=1e-8)


def test_its_slope_is_that_of_differences():
    """The mean over all graphs, by the logarithms of the scales, at scales of one."""
    truth, graphs = wrong()
    known = jnp.ones((GRAPHS, POSES), bool)

    def at(logs):
        return jax.tree.map(np.asarray, _slope(jnp.asarray(logs), graphs, truth, known))

    (_, slope), h = at(np.zeros(2)), 1e-5
    for i, along in enumerate(np.eye(2)):
        up, down = (at(step * along)[0] for step in (h, -h))
        assert slope[i] == pytest.approx((up - down) / (2 * h), rel=1e-5)


def test_what_is_not_finite_is_refused():
    truth, graphs = wrong()
    spoiled = graphs._replace(odometry=graphs.odometry.at[3, 2, 0].set(jnp.nan))
    with pytest.raises(ValueError, match=r"^graphs: expected finite poses and covariances at scales of one"):
        graph.tune_scales(spoiled, truth)
    with pytest.raises(ValueError, match=r"^truth: expected shape \(12, 3\)"):
        graph.tune_scales(graphs, truth[:, :5])
