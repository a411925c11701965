"""Forward mode, whichever is asked for: the same derivatives, of any order, and memory that does not grow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap.tuning.forward import forward


def walk(few, data):
    """A loop with a state, which depends on a few numbers nonlinearly, and on integers among its data."""

    def body(carry, now):
        (x, total), (step, count) = carry, now
        x = jnp.sin(few["a"] * x + few["b"] * step) + 0.1 * x * count.astype(x.dtype)
        return (x, total + jnp.sum(x**2)), None

    start = data["start"], jnp.zeros((), data["start"].dtype)
    last, total = jax.lax.scan(body, start, (data["steps"], data["counts"]))[0]
    return {"last": last, "total": total}


def material(length):
    steps = np.random.default_rng(0).normal(size=length).astype(jnp.result_type(float))
    return {"start": jnp.array([0.3, -0.2]), "steps": steps, "counts": np.arange(length) % 3}


FEW = {"a": jnp.array(0.7), "b": jnp.array([0.4, 1.1])}


def total(f):
    return lambda few, data: f(few, data)["total"]


def alike(derivative, tolerance, *args):
    """`derivative` of the loop as it is and taken forward, in one program."""
    got, expected = jax.jit(lambda *args: [derivative(f)(*args) for f in (forward(walk), walk)])(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=tolerance(1e-11, 1e-4), atol=1e-6), got, expected)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, jax.hessian])
def test_derivatives_by_the_few_are_the_plain_ones(derivative, tolerance):
    alike(lambda f: derivative(total(f)), tolerance, FEW, material(7))


def test_data_have_derivatives_too(tolerance):
    def by_steps(f):
        return lambda few, data, steps: f(few, data | {"steps": steps})["total"]

    data = material(5)
    for argnums in (2, (0, 2)):
        alike(lambda f, argnums=argnums: jax.grad(by_steps(f), argnums), tolerance, FEW, data, data["steps"])


def test_it_maps_over_runs(tolerance):
    batch = {
        "start": np.ones((4, 2)) * np.arange(4.0)[:, None],
        "steps": np.ones((4, 5)),
        "counts": np.ones((4, 5), int),
    }
    alike(lambda f: jax.vmap(jax.grad(total(f)), in_axes=(None, 0)), tolerance, FEW, batch)


def test_memory_of_a_gradient_does_not_grow_with_the_loop():
    def bytes_of(f, length):
        compiled = jax.jit(jax.grad(total(f))).lower(FEW, material(length)).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    assert bytes_of(walk, 4000) > 5 * bytes_of(walk, 250)  # plain reverse mode, for comparison
    assert bytes_of(forward(walk), 4000) == bytes_of(forward(walk), 250)
