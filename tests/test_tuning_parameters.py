"""Coordinates: there and back, nothing invalid anywhere, and what people call the parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxlocmap import Params
from jaxlocmap.tuning import NAMES, UNITS, constrain, natural, unconstrain

TILTED = Params(
    Q=jnp.array([[0.04, -0.003], [-0.003, 0.01]]),
    R=jnp.array([[0.02, 0.004], [0.004, 0.003]]),
    l_occ=jnp.array(0.7),
    l_free=jnp.array(-2.1),
)


def test_there_and_back(tolerance):
    back = constrain(unconstrain(TILTED))
    assert (back.gate_probability, back.blocks) == (None, {})
    for name in ("Q", "R", "l_occ", "l_free"):
        got, expected = getattr(back, name), getattr(TILTED, name)
        np.testing.assert_allclose(got, expected, rtol=tolerance(1e-13, 2e-5), err_msg=name)


@given(st.lists(st.floats(-1e30, 1e30, allow_nan=False), min_size=8, max_size=8))
def test_no_coordinates_are_invalid(values):
    params = constrain(dict(zip(NAMES, map(jnp.asarray, values), strict=True)))
    params.check()
    correlations = [natural(params)[name] for name in ("v_w", "range_bearing")]
    assert all(abs(float(r)) <= 0.996 for r in correlations)


@pytest.mark.parametrize("name", ["Q", "R", "l_occ", "l_free"])
def test_a_batch_of_parameters_is_refused_by_name(name):
    many = TILTED._replace(**{name: jnp.stack([getattr(TILTED, name)] * 5)})
    for function in (unconstrain, natural):
        with pytest.raises(ValueError, match=rf"^params\.{name}: expected shape .*, got \(5"):
            function(many)


def test_a_batch_of_coordinates_is_refused_by_name():
    with pytest.raises(ValueError, match=r"^range: expected shape \(\), got \(5,\)$"):
        constrain(unconstrain(TILTED) | {"range": jnp.zeros(5)})


def test_people_call_them_by_these_names(tolerance):
    got = natural(TILTED)
    assert tuple(got) == NAMES == tuple(UNITS)
    expected = (0.2, 0.1, -0.003 / 0.02, 0.02**0.5, 0.003**0.5, 0.004 / (0.02 * 0.003) ** 0.5, 0.7, -2.1)
    np.testing.assert_allclose([float(x) for x in got.values()], expected, rtol=tolerance(1e-12, 1e-5))


def test_a_coordinate_is_the_logarithm_of_a_deviation(tolerance):
    params = Params.from_std(v=0.02, w=0.05, range=0.08, bearing=0.02)
    moved = constrain({name: x + jnp.log(2.0) for name, x in unconstrain(params).items() if name[0] != "_"})
    assert float(natural(moved)["l_free"]) == pytest.approx(-0.8, rel=tolerance(1e-12, 1e-5))
    longer = unconstrain(params) | {"w": unconstrain(params)["w"] + jnp.log(3.0)}
    assert float(natural(constrain(longer))["w"]) == pytest.approx(0.15, rel=tolerance(1e-12, 1e-5))


@pytest.mark.parametrize("name", NAMES)
def test_limits_are_the_documented_ones(name, tolerance):
    """1e-5 and 1e5 of each unit; correlations of 10 / sqrt(1 + 10²)."""
    limit = 10 / 101**0.5 if name in ("v_w", "range_bearing") else None
    level = {each: jnp.zeros(()) for each in NAMES}
    for sign in (-1, 1):
        got = float(natural(constrain(level | {name: jnp.array(sign * 99.0)}))[name])
        expected = (sign * limit) if limit else (-1 if name == "l_free" else 1) * 1e5**sign
        assert got == pytest.approx(expected, rel=tolerance(1e-9, 1e-4))


def test_at_its_limit_a_coordinate_has_no_slope():
    at = unconstrain(TILTED) | {"v": jnp.asarray(100.0)}
    slope = jax.grad(lambda c: constrain(c).Q[0, 0])(at)
    assert float(slope["v"]) == 0
    inside = jax.grad(lambda c: constrain(c).Q[0, 0])(unconstrain(TILTED))
    assert float(inside["v"]) > 0
