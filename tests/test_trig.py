"""Sine, cosine and arctangent: float32 polynomials against NumPy's float64, and derivatives in both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxlocmap._internal.trig import arctan2, sin_cos

CLOSE = 1.5 * 2.0**-24  # a number below one is rounded by up to 2**-25


def singles(values):
    return np.asarray(values, np.float32)


def next_to(values, steps):
    """Float32 numbers and their neighbours, `steps` on either side."""
    below = above = singles(values)
    every = [below]
    for _ in range(steps):
        below, above = np.nextafter(below, np.float32(-np.inf)), np.nextafter(above, np.float32(np.inf))
        every += [below, above]
    return np.concatenate(every)


def off_by(got, exact):
    """Distance from the exact value, float64, and the same in units of its last place in float32."""
    assert got.dtype == np.float32
    distance = np.abs(np.asarray(got, np.float64) - exact)
    return distance, distance / np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)


fast_sin_cos, fast_arctan2 = jax.jit(sin_cos), jax.jit(arctan2)

QUARTERS = np.arange(-64, 65) * (np.pi / 2)  # the angles at which a sine or cosine is 0 or 1
EIGHTHS = QUARTERS + np.pi / 4  # where one polynomial hands over to the other
HEADINGS = np.concatenate(
    [np.linspace(-100, 100, 400_001), np.linspace(-4, 4, 200_001), next_to(QUARTERS, 30), next_to(EIGHTHS, 30)]
)


@pytest.mark.parametrize("form", [sin_cos, fast_sin_cos], ids=["plain", "jit"])
def test_sine_and_cosine_are_numpys(form):
    angles = singles(HEADINGS)
    for got, exact in zip(form(angles), (np.sin, np.cos), strict=True):
        exact = exact(angles.astype(np.float64))
        distance, ulps = off_by(got, exact)
        assert distance.max() < CLOSE
        assert ulps[np.abs(exact) > 1e-3].max() < 2
        # Next to a zero what is left of the angle is small itself, and its parts of pi / 2 end at 1e-14 a quarter.
        assert distance[np.abs(exact) < 1e-4].max() < 1e-10


def test_a_thousand_turns_lose_no_digit():
    angles = singles(np.linspace(-2000 * np.pi, 2000 * np.pi, 300_001))
    for got, exact in zip(fast_sin_cos(angles), (np.sin, np.cos), strict=True):
        assert off_by(got, exact(angles.astype(np.float64)))[0].max() < CLOSE


def test_sine_and_cosine_at_nothing_are_exact():
    for zero in (0.0, -0.0):
        sin, cos = map(np.asarray, fast_sin_cos(jnp.float32(zero)))
        assert (sin, cos) == (0, 1)
        assert np.signbit(sin) == np.signbit(zero)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_angle_that_is_no_number_has_no_sine(bad):
    for dtype in (jnp.float32, float):
        assert np.all(np.isnan(fast_sin_cos(jnp.asarray(bad, dtype))))


def points():
    """Points all around, near and far, on the axes and diagonals and next to where the polynomial's argument jumps."""
    rng = np.random.default_rng(0)
    jumps = np.concatenate([s * np.arctan([t, 1 / t]) for s in (1, -1) for t in (np.sqrt(2) - 1, 1.0)])
    angle = np.concatenate([rng.uniform(-np.pi, np.pi, 300_000), next_to([*jumps, *(np.pi - jumps)], 200)])
    reach = 10 ** rng.uniform(-4, 4, angle.size)
    axis = singles([0.0, 1.0, -1.0, 1e-4, -1e-4, 1e4, -1e4])
    y, x = (v.ravel() for v in np.meshgrid(axis, axis))
    away = (x != 0) | (y != 0)
    return np.append(singles(reach * np.sin(angle)), y[away]), np.append(singles(reach * np.cos(angle)), x[away])


@pytest.mark.parametrize("form", [arctan2, fast_arctan2], ids=["plain", "jit"])
def test_arctangent_is_numpys(form):
    y, x = points()
    exact = np.arctan2(y.astype(np.float64), x.astype(np.float64))
    # A processor is off by less than 3.5, a GPU, which divides by way of a reciprocal, by 3.66.
    assert off_by(form(y, x), exact)[1].max() < 4


def test_arctangent_along_the_axes_is_exact():
    y, x = singles([0, 2, 0, -3]), singles([5, 0, -4, 0])
    np.testing.assert_array_equal(fast_arctan2(y, x), singles([0, np.pi / 2, np.pi, -np.pi / 2]))


def test_arctangent_of_a_negative_zero_is_that_of_zero_up_to_the_sign():
    for x in (1.0, -1.0):
        got = fast_arctan2(jnp.float32(-0.0), jnp.float32(x))
        assert abs(got) == np.arctan2(np.float32(0), np.float32(x))


def test_the_origin_lies_straight_ahead():
    for zero in (0.0, -0.0):
        assert fast_arctan2(jnp.float32(0.0), jnp.float32(zero)) == 0


@pytest.mark.usefixtures("x64")
def test_float64_is_jnps_to_the_last_bit():
    y, x = (v.astype(np.float64) for v in points())
    ends = np.array([0.0, -0.0, np.inf, -np.inf, np.nan])
    y, x = np.append(y, ends), np.append(x, ends[::-1])
    np.testing.assert_array_equal(arctan2(y, x), jnp.arctan2(y, x))
    angles = np.append(HEADINGS, ends)
    for got, exact in zip(sin_cos(angles), (jnp.sin, jnp.cos), strict=True):
        np.testing.assert_array_equal(got, exact(angles))


# --- Derivatives ---

TURNS = np.array([0.0, np.pi / 2, -np.pi / 2, np.pi, -np.pi, np.pi / 4, 0.3, -2.5])
PLACES = np.array([[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [0.1, -3], [-2, -0.01]], float)  # y, x


@pytest.mark.usefixtures("x64")
def test_derivatives_are_finite_differences_to_second_order():
    check_grads(fast_sin_cos, (jnp.array(TURNS),), order=2, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)
    y, x = jnp.array(PLACES[2:].T)  # where x < 0 a difference across y = 0 would jump by a turn
    check_grads(fast_arctan2, (y[:5], x[:5]), order=2, modes=("fwd", "rev"), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_in_float32_are_the_formulas(mode):
    """At the edges of a quadrant, where the form changes, as everywhere."""

    def twice(function, arguments):
        slope = mode(function, argnums=arguments)
        return jax.vmap(lambda *args: (function(*args), slope(*args), mode(slope, argnums=arguments)(*args)))

    (sin, cos), by_angle, by_angle_twice = jax.jit(twice(sin_cos, 0))(singles(TURNS))
    np.testing.assert_array_equal(by_angle, (cos, -sin))
    np.testing.assert_array_equal(by_angle_twice, (-sin, -cos))
    y, x = singles(PLACES.T)
    _, (by_y, by_x), ((yy, yx), (xy, xx)) = jax.jit(twice(arctan2, (0, 1)))(y, x)
    square = (x * x + y * y).astype(np.float64)
    np.testing.assert_allclose(by_y, x / square, rtol=1e-6)
    np.testing.assert_allclose(by_x, -y / square, rtol=1e-6)
    along, mixed = 2 * x * y / square**2, (y.astype(np.float64) ** 2 - x**2) / square**2
    for got, exact in ((yy, -along), (xx, along), (yx, mixed), (xy, mixed)):
        np.testing.assert_allclose(got, exact, rtol=1e-5, atol=1e-7)


def test_a_batch_gives_the_numbers_of_one_by_one():
    angles, (y, x) = singles(TURNS), singles(PLACES.T)
    for form, args in ((fast_sin_cos, (angles,)), (fast_arctan2, (y, x))):
        each = [form(*(np.float32(v[i]) for v in args)) for i in range(len(angles))]
        jax.tree.map(lambda batch, *one: np.testing.assert_array_equal(batch, np.array(one)), form(*args), *each)
