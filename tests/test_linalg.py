"""Unrolled matrices against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxlocmap._internal.linalg import (
    SMALL,
    Matrix,
    forward,
    is_psd,
    jacobians,
    ldl,
    mahalanobis,
    quadratic_form,
    solve,
    stack_scalars,
)


def random_psd(rng, n, rank=None):
    A = rng.normal(size=(n, rank or n))
    return A @ A.T


def dense(matrix):
    return np.array([[float(x) for x in row] for row in matrix.rows])


def entries(n, m):
    """n x m numbers of which many are structure: the integers 0, 1 and -1."""
    entry = st.one_of(st.sampled_from([0, 1, -1]), st.floats(-4, 4, width=32))
    return st.lists(st.lists(entry, min_size=m, max_size=m), min_size=n, max_size=n)


@given(a=entries(3, 2), b=entries(2, 3), c=entries(3, 3))
def test_products_sums_and_transposes_are_numpys_whatever_is_structure(a, b, c):
    result = (Matrix(a) @ Matrix(b) - Matrix(c) + Matrix(c).T.scale(-1)).T
    expected = (np.array(a) @ np.array(b) - np.array(c) - np.array(c).T).T
    np.testing.assert_allclose(dense(result), expected, rtol=1e-12, atol=1e-12)  # Python floats: a few roundings


def test_structure_leaves_no_trace_in_the_program():
    shear = Matrix([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    jaxpr = jax.make_jaxpr(lambda P: quadratic_form(shear, Matrix.of(P)).array(P.dtype))(jnp.eye(3))
    assert not {"mul", "add", "dot_general"} & {eqn.primitive.name for eqn in jaxpr.eqns}


def test_quadratic_form_is_the_product_and_symmetric_to_the_last_bit(tolerance):
    rng = np.random.default_rng(0)
    A, P = rng.normal(size=(3, 3)), random_psd(rng, 3)
    result = np.asarray(quadratic_form(Matrix.of(jnp.array(A)), Matrix.symmetric(jnp.array(P))).array(float))
    np.testing.assert_array_equal(result, result.T)
    np.testing.assert_allclose(result, A @ P @ A.T, rtol=tolerance(1e-13, 1e-5))


def test_symmetric_reads_the_upper_triangle():
    np.testing.assert_array_equal(dense(Matrix.symmetric(np.array([[1.0, 2.0], [9.0, 3.0]]))), [[1, 2], [2, 3]])


@pytest.mark.parametrize("n", [1, 2, 3])
def test_factor_and_solves_are_numpys(n, tolerance):
    rng = np.random.default_rng(n)
    S, b = random_psd(rng, n) + np.eye(n), rng.normal(size=n)
    rtol = tolerance(1e-12, 1e-4)  # condition of S is below 100
    L, D = ldl(Matrix.of(jnp.array(S)))
    r = tuple(jnp.array(b))
    np.testing.assert_allclose(dense(L) @ np.diag(D) @ dense(L).T, S, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(dense(L) @ np.array(forward(L, r)), b, rtol=rtol, atol=rtol)
    np.testing.assert_allclose(np.array(solve(L, D, r)), np.linalg.solve(S, b), rtol=rtol, atol=rtol)
    np.testing.assert_allclose(mahalanobis(Matrix.of(jnp.array(S)), r), b @ np.linalg.solve(S, b), rtol=rtol)


def test_stacked_scalars_are_numpys_array():
    rng = np.random.default_rng(0)
    for shape in ((1,), (3,), (1, 1), (2, 3), (3, 1)):
        expected = np.asarray(jnp.array(rng.normal(size=shape)))
        # As a function takes them apart and puts them together, for one and for many.
        rebuilt = jax.jit(lambda x, shape=shape: stack_scalars(parts(x, shape)))
        np.testing.assert_array_equal(rebuilt(expected), expected)
        np.testing.assert_array_equal(jax.vmap(rebuilt)(expected[None].repeat(4, 0)), expected[None].repeat(4, 0))


def parts(x, shape):
    if len(shape) == 1:
        return [x[i] for i in range(shape[0])]
    return tuple([x[i, j] for j in range(shape[1])] for i in range(shape[0]))


@pytest.mark.parametrize("n", [3, SMALL, SMALL + 1])
def test_jacobians_are_those_of_a_known_function(n, tolerance):
    """Of [x' A y, |x|^2, sin(y_0) x_(n-1)] by x and by y."""
    rng = np.random.default_rng(n)
    A, x, y = rng.normal(size=(n, 2)), rng.normal(size=n), rng.normal(size=2)
    arrays = jnp.asarray(x), jnp.asarray(y)
    by_x, by_y = jacobians(lambda x, y: jnp.stack([x @ A @ y, x @ x, jnp.sin(y[0]) * x[-1]]), *arrays)
    assert isinstance(by_x, Matrix) == isinstance(by_y, Matrix) == (n <= SMALL)
    got = [j.array(arrays[0].dtype) if isinstance(j, Matrix) else j for j in (by_x, by_y)]
    last = np.eye(n)[-1]
    np.testing.assert_allclose(got[0], [A @ y, 2 * x, np.sin(y[0]) * last], rtol=0, atol=tolerance(1e-12, 1e-4))
    slope = [x @ A, np.zeros(2), [np.cos(y[0]) * x[-1], 0]]
    np.testing.assert_allclose(got[1], slope, rtol=0, atol=tolerance(1e-12, 1e-4))


def test_reading_an_entry_of_a_stacked_matrix_costs_nothing():
    """The compiled program of a batch holds the one entry that is asked for, and nothing of how it was stacked."""

    def entry(x):
        return stack_scalars([[x[0], x[1]], [x[2], 2 * x[3]]])[1, 0]

    program = jax.jit(jax.vmap(entry, in_axes=1)).lower(jnp.ones((4, 50))).compile().as_text()
    assert "slice(" in program
    assert "concatenate(" not in program
    assert "multiply(" not in program


def psd(P):
    return bool(is_psd(jnp.asarray(P, float)))


@given(seed=st.integers(0, 10_000), rank=st.sampled_from([1, 2, 3]), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_semi_definite_matrices_pass_singular_or_not_in_any_unit(seed, rank, scale):
    rng = np.random.default_rng(seed)
    units = np.diag([scale, 1.0, 1.0])
    assert psd(units @ random_psd(rng, 3, rank) @ units)


@given(seed=st.integers(0, 10_000), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_clearly_negative_eigenvalue_is_seen(seed, scale):
    """One eigenvalue a hundredth of the largest below zero; the check allows for rounding only."""
    rng = np.random.default_rng(seed)
    V, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    units = np.diag([scale, 1.0, 1.0])
    assert not psd(units @ V @ np.diag([1.0, rng.uniform(0.0, 1.0), -0.01]) @ V.T @ units)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
def test_a_matrix_with_an_entry_that_is_no_number_is_refused(bad, place):
    P = np.eye(3)
    P[place] = P[place[::-1]] = bad
    assert not psd(P)


@pytest.mark.parametrize("diagonal", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1)])
def test_a_negative_variance_is_refused(diagonal):
    assert not psd(np.diag(np.array(diagonal, float)))


def test_no_uncertainty_at_all_is_semi_definite():
    assert psd(np.zeros((3, 3)))


@pytest.mark.parametrize("place", [(0, 1), (0, 2), (1, 2)])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("other", [1.0, 0.0])
def test_a_correlation_beyond_one_by_more_than_rounding_is_seen(place, sign, other, tolerance):
    """Also where the third variance is zero, and with it the determinant whatever the two are."""
    beyond = tolerance(1e-12, 1e-4)
    for excess, fine in ((-beyond, True), (0, True), (beyond, False)):
        P = np.diag([4.0, 1.0, 0.25])
        P[3 - sum(place), 3 - sum(place)] *= other
        P[place] = P[place[::-1]] = sign * (1 + excess) * np.sqrt(P[place[0], place[0]] * P[place[1], place[1]])
        assert psd(P) is fine


def test_roundings_add_up_in_a_large_matrix(tolerance):
    """A pose and its clone, corrected time and again: a correlation of one, off by a thousand roundings."""
    rounding, beyond = tolerance(1e3 * 2.0**-52, 1e3 * 2.0**-23), tolerance(1e-11, 1e-2)
    for excess, fine in ((-beyond, True), (0, True), (rounding, True), (beyond, False)):
        P = np.diag([4.0, *np.ones(14)])
        P[0, 7] = P[7, 0] = 2 * (1 + excess)
        assert psd(P) is fine


def test_what_the_largest_variance_leaves_of_a_variance_of_zero_is_rounding(tolerance):
    """Of a clone of a pose that is known exactly, beside poses that are not."""
    rounding, beyond = tolerance(2.0**-52, 2.0**-23), tolerance(1e-6, 1e-2)
    for size, fine in ((rounding, True), (beyond, False)):
        P = np.diag([size**2 / 2, *np.ones(14)])
        P[0, 7] = P[7, 0] = size
        assert psd(P) is fine


@pytest.mark.parametrize("signs", [(-1, -1, -1), (-1, 1, 1), (1, -1, 1), (1, 1, -1)])
def test_a_determinant_below_zero_by_more_than_rounding_is_seen(signs, tolerance):
    """Correlations of a half whose product is negative leave an eigenvalue of zero; no two of them show more."""
    beyond, place = tolerance(1e-12, 1e-4), ([0, 0, 1], [1, 2, 2])
    for half, fine in ((0.5 - beyond, True), (0.5, True), (0.5 + beyond, False)):
        P = np.eye(3)
        P[place] = P[place[::-1]] = np.array(signs) * half
        assert psd(P) is fine
