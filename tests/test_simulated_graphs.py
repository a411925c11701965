"""Simulated pose graphs: their noise is what they say, and the false loops are false."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import graph as pose_graph
from jaxlocmap.simulation import simulate_graph


@functools.cache
def many():
    draw = functools.partial(simulate_graph, poses=30, loops=6, false=3)
    return jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), 200))


def test_shapes():
    truth, graph = many()
    assert truth.shape == (200, 30, 3)
    assert graph.pair.shape == (200, 9, 2)
    np.testing.assert_allclose(truth[:, 0], 0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(*np.moveaxis(np.diff(truth[..., :2], axis=1), -1, 0)), 1, rtol=1e-4)
    apart = graph.pair[..., 1] - graph.pair[..., 0]
    assert int(apart.min()) == 5
    assert int(graph.pair.max()) < 30


def test_errors_at_the_truth_are_what_the_graph_says(x64):
    """χ² of three numbers each: mean 3, standard error √(6 / n); five of these."""
    truth, graph = many()
    chain, loops = jax.jit(jax.vmap(pose_graph.chi2))(graph, truth)
    for squares in (np.asarray(chain), np.asarray(loops[:, :6])):
        assert abs(squares.mean() - 3) < 5 * np.sqrt(6 / squares.size)
    assert np.median(loops[:, 6:]) > 1000


def test_graphs_differ():
    _, graph = many()
    assert len({pair.tobytes() for pair in np.asarray(graph.pair)}) == 200


@pytest.mark.parametrize("settings", [{"poses": 5}, {"loops": -1}, {"false": -1}])
def test_refused(settings):
    with pytest.raises(ValueError, match="poses, loops, false: expected > 5, >= 0, >= 0"):
        simulate_graph(jax.random.key(0), **settings)


def test_dtype_is_that_of_the_session():
    assert many()[0].dtype == jnp.zeros(()).dtype
