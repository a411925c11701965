"""Scales of a pose graph's covariances, found by gradient through the solver."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import graph, simulation
from jaxlocmap.graph.scales import Scales

pytestmark = pytest.mark.usefixtures("x64")
GRAPHS, POSES = 300, 12


@functools.cache
def drawn():
    draw = functools.partial(simulation.simulate_graph, poses=POSES, loops=3)
    return jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), GRAPHS))


def wrong():
    """Odometry that says twice its errors, loops that say half of theirs."""
    truth, graphs = drawn()
    return truth, graph.scaled(graphs, Scales(jnp.array(2.0), jnp.array(0.5)))


def test_a_scale_is_of_standard_deviations():
    (_, graphs), (_, told) = drawn(), wrong()
    np.testing.assert_allclose(told.odometry_information, graphs.odometry_information / 4)
    np.testing.assert_allclose(told.loop_information, graphs.loop_information * 4)


def test_wrong_scales_are_found():
    """The poses of a graph err together: of each at least the three errors of the last one count, so that a scale is
    known to one part in sqrt(2 · 900), and four times that is 10 %.
    """
    truth, graphs = wrong()
    scales, before, after = graph.tune_scales(graphs, truth)
    assert float(scales.odometry) == pytest.approx(0.5, rel=0.1)
    assert float(scales.loop) == pytest.approx(2.0, rel=0.1)
    assert after < before - 0.1


def test_it_is_numpys_density_of_poses_that_are_known():
    truth, graphs = (jax.tree.map(lambda x: x[0], tree) for tree in wrong())
    known = np.arange(POSES) < 9
    solution = graph.solve(graphs, graph.dead_reckoning(graphs))
    cov, error = np.asarray(graph.marginals(graphs, solution)), np.array(truth - solution.poses)
    error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
    expected = sum(
        0.5 * (error[k] @ np.linalg.solve(cov[k], error[k]) + np.log(np.linalg.det(cov[k]))) for k in range(1, 9)
    )
    assert float(graph.pose_nll(graphs, truth, jnp.asarray(known))) == pytest.approx(expected, rel=1e-9)


def test_filled_up_poses_do_not_count():
    truth, graphs = (jax.tree.map(lambda x: x[:20], tree) for tree in wrong())
    alone = graph.tune_scales(graphs, truth)
    one = jax.tree.map(lambda x: x[0], graphs)
    long = one._replace(
        odometry=jnp.concatenate([one.odometry] * 2),
        odometry_information=jnp.concatenate([one.odometry_information] * 2),
    )
    each = [jax.tree.map(lambda x, i=i: x[i], graphs) for i in range(20)]
    more = graph.stack([*each, long])
    known = np.zeros((21, long.poses), bool)
    known[:20, :POSES] = True
    padded = jnp.zeros((21, long.poses, 3)).at[:20, :POSES].set(truth)
    filled = graph.tune_scales(more, padded, jnp.asarray(known))
    np.testing.assert_allclose(filled[0], alone[0], rtol=1e-4)
    assert filled[1:] == pytest.approx(alone[1:], rel=1e-8)


def test_its_slope_is_that_of_differences():
    truth, graphs = (jax.tree.map(lambda x: x[0], tree) for tree in wrong())
    known = jnp.ones(POSES, bool)

    @jax.jit
    def at(scales):
        return graph.pose_nll(graph.scaled(graphs, scales), truth, known)

    slope, h = jax.jit(jax.grad(at))(Scales(jnp.array(1.0), jnp.array(1.0))), 1e-5
    for name in Scales._fields:
        up, down = (at(Scales(jnp.array(1.0), jnp.array(1.0))._replace(**{name: 1.0 + d})) for d in (h, -h))
        assert float(getattr(slope, name)) == pytest.approx(float(up - down) / (2 * h), rel=1e-5)


def test_what_is_not_finite_is_refused():
    truth, graphs = (jax.tree.map(lambda x: x[:20], tree) for tree in wrong())
    spoiled = graphs._replace(odometry=graphs.odometry.at[3, 2, 0].set(jnp.nan))
    with pytest.raises(ValueError, match=r"^graphs: expected finite poses and covariances at scales of one"):
        graph.tune_scales(spoiled, truth)
    with pytest.raises(ValueError, match=r"^truth: expected shape \(12, 3\)"):
        graph.tune_scales(graphs, truth[:, :5])
