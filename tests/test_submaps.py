"""Submaps: the algebra against NumPy, and the settings. What the filter makes of them is in `test_matching_faults`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import Gaussian, poses
from jaxlocmap.filters import information
from jaxlocmap.matching import submaps
from jaxlocmap.se2 import between
from jaxlocmap.types import Matcher


def random_cov(seed, n, rank=None):
    L = np.random.default_rng(seed).normal(size=(n, rank or n))
    return L @ L.T / n


# --- The correction by information ---


corrected = jax.jit(information.update, static_argnames=("angles", "poses"))
observed = jax.jit(submaps.relative_pose, static_argnames="anchor")


def test_an_invertible_information_is_a_kalman_correction(tolerance):
    rng = np.random.default_rng(3)
    mean, P, H, R, z = (
        rng.normal(size=5),
        random_cov(1, 5),
        rng.normal(size=(3, 5)),
        random_cov(2, 3),
        rng.normal(size=3),
    )
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    Lambda = np.linalg.inv(R)
    got = corrected(*map(jnp.asarray, (mean, P, H, Lambda, Lambda @ z)), angles=())
    np.testing.assert_allclose(got[0], mean + K @ z, rtol=0, atol=tolerance(1e-9, 1e-3))
    np.testing.assert_allclose(got[1], P - K @ S @ K.T, rtol=0, atol=tolerance(1e-9, 1e-3))


def test_what_is_not_known_is_not_corrected(tolerance):
    """Singular information, and none: as if R were infinite there."""
    P = np.diag([0.5, 0.4, 0.3, 0.2])
    H = np.eye(3, 4)
    told = np.diag([100.0, 0.0, 4.0])
    mean, cov = corrected(*map(jnp.asarray, (np.zeros(4), P, H, told, np.array([10.0, 0.0, 0.4]))), angles=())
    expected = np.diag([1 / (2 + 100), 0.4, 1 / (1 / 0.3 + 4), 0.2])
    np.testing.assert_allclose(cov, expected, rtol=0, atol=tolerance(1e-12, 1e-5))
    np.testing.assert_allclose(mean, [10 / 102, 0, 0.4 * expected[2, 2], 0], rtol=0, atol=tolerance(1e-12, 1e-5))
    unchanged = corrected(*map(jnp.asarray, (mean, P, H, np.zeros((3, 3)), np.zeros(3))), angles=())
    np.testing.assert_allclose(unchanged[1], P, rtol=0, atol=tolerance(1e-15, 1e-7))


@pytest.mark.parametrize("seed", range(5))
def test_a_covariance_stays_semi_definite(seed, tolerance):
    """Of a singular covariance, as clones make it, and strong information."""
    H, P = np.random.default_rng(seed).normal(size=(3, 6)), random_cov(seed, 6, rank=2)
    told = 1e6 * random_cov(seed + 9, 3, rank=2)
    _, cov = information.update(*map(jnp.asarray, (np.zeros(6), P, H, told, np.zeros(3))), angles=())
    np.testing.assert_array_equal(cov, np.asarray(cov).T)
    assert np.linalg.eigvalsh(np.asarray(cov, float))[0] > -tolerance(1e-12, 1e-3)


def test_a_turn_of_the_whole_world_stays_unknown_whatever_is_seen_of_two_poses(tolerance):
    """Two poses that turn together about the origin, and what is observed of one in the frame of the other. The mean
    moves with every correction; the covariance along that turn must not shrink.
    """

    def known(mean, cov):
        """Information on a turn of the world, by which both poses move: tᵀ P⁻¹ t."""
        turn = np.concatenate([[-mean[1], mean[0], 1.0], [-mean[4], mean[3], 1.0], np.zeros(3)])
        return turn @ np.linalg.solve(np.asarray(cov, float), turn)

    mean, cov = jnp.array([4.0, 1.0, 0.3, 2.0, 3.0, -0.4, 0.0, 0.0, 0.0]), jnp.asarray(random_cov(7, 9))
    before = known(mean, cov)
    told = jnp.asarray(np.diag([100.0, 400.0, 900.0]))
    for k in range(20):
        _, H = observed(mean, 3)
        pull = jnp.asarray(30 * np.sin(np.arange(3.0) + k))
        start, (mean, cov) = mean, corrected(mean, cov, H, told, pull, angles=(2, 5), poses=(0, 3))
        assert np.abs(np.asarray(mean) - np.asarray(start)).max() > 1e-3
    np.testing.assert_allclose(known(mean, cov), before, rtol=tolerance(1e-9, 2e-2))


# --- The entries of a submap ---


def test_a_pose_in_the_frame_of_another_and_its_derivatives(tolerance):
    a, b = jnp.array([1.0, -2.0, 2.5]), jnp.array([0.5, 1.0, -2.0])

    @jax.jit
    def both(a, b):
        got, *by = between(a, b)
        return got, [J.array(a.dtype) for J in by], jax.jacfwd(lambda a, b: between(a, b)[0], argnums=(0, 1))(a, b)

    got, by, expected = both(a, b)
    c, s = np.cos(2.5), np.sin(2.5)
    x, y = np.array([[c, s], [-s, c]]) @ [-0.5, 3.0]
    np.testing.assert_allclose(got, [x, y, -4.5 + 2 * np.pi], rtol=0, atol=tolerance(1e-12, 1e-5))
    for J, value in zip(by, expected, strict=True):
        np.testing.assert_allclose(J, value, rtol=0, atol=tolerance(1e-12, 1e-5))


@pytest.mark.parametrize("anchor", [3, 9])
def test_what_a_match_observes_and_its_derivative(anchor, tolerance):
    mean = np.random.default_rng(anchor).normal(size=15)
    got, H = observed(jnp.asarray(mean), anchor)
    own, bias = mean[anchor : anchor + 3], mean[anchor + 3 : anchor + 6]
    np.testing.assert_allclose(got, poses.between(own, mean[:3]) + bias, rtol=0, atol=tolerance(1e-12, 1e-5))
    expected = jax.jit(jax.jacfwd(lambda x: submaps.relative_pose(x, anchor)[0]))(jnp.asarray(mean))
    np.testing.assert_allclose(H, expected, rtol=0, atol=tolerance(1e-12, 1e-5))


@pytest.mark.parametrize("anchor", [3, 9])
def test_a_new_anchor_is_a_clone_of_the_pose(anchor):
    belief = Gaussian(jnp.asarray(np.random.default_rng(1).normal(size=15)), jnp.asarray(random_cov(1, 15)))
    got = jax.tree.map(np.asarray, jax.jit(submaps._begun, static_argnums=1)(belief, anchor))
    before, at = np.asarray(belief.cov), np.arange(anchor, anchor + 3)
    others = np.setdiff1d(np.arange(15), np.arange(anchor, anchor + 6))
    np.testing.assert_array_equal(got.mean[at], belief.mean[:3])
    np.testing.assert_array_equal(got.mean[at + 3], 0)
    np.testing.assert_array_equal(got.mean[others], np.asarray(belief.mean)[others])
    np.testing.assert_array_equal(got.cov[np.ix_(others, others)], before[np.ix_(others, others)])
    np.testing.assert_array_equal(got.cov[np.ix_(at, others)], before[np.ix_(np.arange(3), others)])
    np.testing.assert_array_equal(got.cov[np.ix_(at, at)], before[:3, :3])
    np.testing.assert_allclose(got.cov[np.ix_(at + 3, at + 3)], np.diag([0.25, 0.25, 0.04]), rtol=1e-6)
    assert not got.cov[np.ix_(at + 3, np.setdiff1d(np.arange(15), at + 3))].any()
    # Between a pose and its clone nothing is uncertain but the bias.
    _, H = observed(jnp.asarray(got.mean), anchor)
    np.testing.assert_allclose(H @ got.cov @ H.T, np.diag([0.25, 0.25, 0.04]), rtol=0, atol=1e-5)


def test_the_bias_moves_towards_the_error_of_the_pose_a_scan_is_added_at(tolerance):
    """P ← T P Tᵀ + κ² (Λ + P_rel⁻¹)⁻¹ on the bias, T x the errors after it moved."""
    mean, P, kappa = np.random.default_rng(4).normal(size=15), random_cov(4, 15), 0.3
    told = random_cov(5, 3)
    _, H = observed(jnp.asarray(mean), 9)
    rel = np.asarray(H) @ P @ np.asarray(H).T
    T = np.eye(15)
    T[12:15] -= kappa * np.asarray(H)
    expected = T @ P @ T.T
    expected[12:15, 12:15] += kappa**2 * np.linalg.inv(told + np.linalg.inv(rel))
    belief = Gaussian(jnp.asarray(mean), jnp.asarray(P))
    got = jax.jit(submaps._moved_bias, static_argnums=1)(belief, 9, *map(jnp.asarray, (kappa, H, rel, told)))
    np.testing.assert_allclose(got.cov, expected, rtol=0, atol=tolerance(1e-9, 1e-3))
    np.testing.assert_array_equal(got.mean, belief.mean)


# --- Settings ---


MATCHER = Matcher(half_width=3.0)


def test_a_map_is_known_for_a_matcher_that_leaves_it():
    lines = np.zeros((*MATCHER.spec.shape, 6))
    with pytest.raises(ValueError, match=r"^matcher.known_std: expected the standard deviations"):
        submaps.known(lines, MATCHER, np.dtype(float))
    with pytest.raises(ValueError, match=r"^lines: expected shape"):
        submaps.known(lines[1:], dataclasses.replace(MATCHER, known_std=(0.01, 0.01)), np.dtype(float))


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"period": 0}, "period"),
        ({"period": 1.5}, "period"),
        ({"submap_scans": 1}, "submap_scans"),
        ({"gate_probability": 1.0}, "gate_probability"),
        ({"least_share": 0.0}, "least_share"),
        ({"half_width": 0.05}, "half_width"),
        ({"resolution": 0.0}, "resolution"),
        ({"range_std": 0.0}, "range_std"),
        ({"gap": np.inf}, "gap"),
        ({"submap_length": 0.0}, "submap_length"),
        ({"window": (0.5, 0.0)}, "window"),
        ({"window": (0.5,)}, "window"),
        ({"known_std": (0.01, 0.0)}, "known_std"),
    ],
)
def test_a_setting_out_of_range_is_named(wrong, name):
    with pytest.raises(ValueError, match=rf"Matcher\.{name}"):
        Matcher(**wrong)
