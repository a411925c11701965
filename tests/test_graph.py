"""Pose graphs: against a dense reference with numerical Jacobians, in limiting cases, in batches, and their faults."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.stats

from jaxlocmap import graph as pose_graph
from jaxlocmap.graph import Graph, Kernel, sparse
from jaxlocmap.graph.prefix import prefix_sum, suffix_sum
from jaxlocmap.poses import between, compose

pytestmark = pytest.mark.usefixtures("x64")
N, L = 8, 4
STD = np.array([0.1, 0.08, 0.05])
METHODS = [
    "loop_space",
    "scipy",
    pytest.param("sparsax", marks=pytest.mark.skipif(not sparse.has_sparsax(), reason="no sparsax")),
]


def information(rng, std=STD):
    """A full matrix whose standard deviations are about `std`."""
    A = np.eye(3) + 0.15 * rng.normal(size=(3, 3))
    return (A @ A.T) / np.outer(std, std)


def drawn(seed, poses=N, loops=L, false=0):
    """The true poses, and a graph of measurements with the noise that their information says; the last loops false."""
    rng = np.random.default_rng(seed)
    steps = np.column_stack([np.ones(poses - 1), 0.2 * rng.normal(size=poses - 1), 0.5 * rng.normal(size=poses - 1)])
    truth = np.zeros((poses, 3))
    for k in range(poses - 1):
        truth[k + 1] = compose(truth[k], steps[k])
    pair = np.array([rng.choice(poses, 2, replace=False) for _ in range(loops)]).reshape(-1, 2)

    def measured(exact):
        omega = np.array([information(rng) for _ in exact]).reshape(-1, 3, 3)
        noise = [np.linalg.solve(np.linalg.cholesky(omega_k).T, rng.normal(size=3)) for omega_k in omega]
        # The error e = Z⁻¹ (A⁻¹ B) is the noise.
        z = [compose(x, between(np.asarray(e), np.zeros(3))) for x, e in zip(exact, noise, strict=True)]
        return np.array(z).reshape(-1, 3), omega

    odometry, odometry_information = measured(between(truth[:-1], truth[1:]))
    loop, loop_information = measured(between(truth[pair[:, 0]], truth[pair[:, 1]]))
    if false:
        loop[-false:] = rng.uniform(-1, 1, (false, 3)) * [poses / 3, poses / 3, 3]
    arrays = odometry, odometry_information, pair.astype(np.int32), loop, loop_information
    return truth, Graph(*map(jnp.asarray, arrays))


def edges_of(graph):
    chain = [(k, k + 1, z, info) for k, (z, info) in enumerate(zip(*map(np.asarray, graph[:2]), strict=True))]
    pair, loop, omega = map(np.asarray, graph[2:])
    return chain + [(int(a), int(b), z, info) for (a, b), z, info in zip(pair, loop, omega, strict=True)]


@functools.cache
def optimum(seed=0):
    _, graph = drawn(seed)
    return reference.graph_optimum(np.asarray(pose_graph.dead_reckoning(graph)), edges_of(graph))


# Compiled once each, and not operation by operation.
chi2 = jax.jit(pose_graph.chi2)
dead_reckoning = jax.jit(pose_graph.dead_reckoning)
stacked = jax.jit(lambda *graphs: pose_graph.stack(graphs))


def with_entry(graph, field, at, value):
    """The graph with one entry of a field set."""
    changed = np.array(getattr(graph, field))
    changed[at] = value
    return graph._replace(**{field: jnp.asarray(changed)})


def blocks(cov):
    return np.array([cov[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(cov) // 3)])


COUNTS = [0, 1, 31, 32, 33, 100]


@functools.cache
def summed():
    """Rows of every count, and both their sums."""
    rows = [np.random.default_rng(0).normal(size=(count, 2)) for count in COUNTS]
    both = jax.jit(lambda rows: [(prefix_sum(x), suffix_sum(x)) for x in rows])
    return dict(zip(COUNTS, zip(rows, both(rows), strict=True), strict=True))


@pytest.mark.parametrize("count", COUNTS)
def test_prefix_sums(count):
    x, (before, after) = summed()[count]
    expected = np.concatenate([np.zeros((1, 2)), np.cumsum(x, axis=0)])
    np.testing.assert_allclose(before, expected, atol=1e-12)
    np.testing.assert_allclose(after, expected[-1] - expected[:-1], atol=1e-12)


def test_errors_and_squares():
    truth, graph = drawn(3)
    both = jax.jit(lambda *at: (pose_graph.errors(*at), pose_graph.chi2(*at)))
    (chain, loops), squares = jax.tree.map(np.asarray, both(graph, jnp.asarray(truth)))
    squares = np.concatenate(squares)
    for k, (a, b, z, omega) in enumerate(edges_of(graph)):
        e = reference.graph_error(truth[a], truth[b], z)
        np.testing.assert_allclose(np.concatenate([chain, loops])[k], e, atol=1e-12)
        np.testing.assert_allclose(squares[k], e @ omega @ e, rtol=1e-10)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("start", [None, "odometry"])
def test_optimum(method, start):
    _, graph = drawn(0)
    begin = None if start is None else dead_reckoning(graph)
    # Huber's kernel is the quadratic one up to its scale; from a start it is compiled anyway, for the test of kernels.
    kernel = Kernel("huber", 1e6) if start and method == "loop_space" else "quadratic"
    solution = pose_graph.solve(graph, begin, kernel=kernel, method=method)
    poses, least, _ = optimum()
    assert solution.converged
    assert solution.finite
    np.testing.assert_allclose(solution.poses, poses, atol=1e-6)
    np.testing.assert_allclose(solution.chi2, least, rtol=1e-7)
    np.testing.assert_allclose(solution.objective, least, rtol=1e-7)
    np.testing.assert_array_equal(solution.weights, np.ones(L))
    if start:
        squares = chi2(graph, begin)
        np.testing.assert_allclose(solution.chi2_start, np.sum(squares[0]) + np.sum(squares[1]), rtol=1e-12)


FIXED = 3
PAIRS = np.array([[2, 6], [5, 1], [0, 7]], np.int32)


@functools.cache
def covariances(method):
    """Of the optimum, those of every frame, given the first pose and another, in one program: marginals by their frame
    and the pose that is given, and those of pairs, the last of which are of each pose seen from the other that is.
    """
    _, graph = drawn(0)
    pair = np.concatenate([PAIRS, np.stack([np.full(N, FIXED), np.arange(N)], axis=-1).astype(np.int32)])

    @jax.jit
    def found(*at):
        marginals = functools.partial(pose_graph.marginals, *at, method=method)
        relative = functools.partial(pose_graph.relative_covariances, *at, pair, method=method)
        alone = {("pose", 0): marginals(), ("world", FIXED): marginals(fixed=FIXED, frame="world")}
        alone |= {(frame, 0): marginals(frame=frame) for frame in ("body", "world")}
        return alone, {"pose": relative(), "world": relative(frame="world")}

    return found(graph, pose_graph.solve(graph, method=method))


@pytest.mark.parametrize("method", METHODS)
def test_covariances(method):
    marginals, relative = covariances(method)
    poses, _, cov = optimum()
    expected = blocks(cov)
    np.testing.assert_allclose(marginals["pose", 0], expected, rtol=1e-4, atol=1e-7)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    for frame, T in (
        ("body", [[c, s, 0 * c], [-s, c, 0 * c], [0 * c, 0 * c, 0 * c + 1]]),
        # xi = (v, omega): t moves by v + omega J t, so v = dt - dtheta J t.
        ("world", [[0 * c + 1, 0 * c, poses[:, 1]], [0 * c, 0 * c + 1, -poses[:, 0]], [0 * c, 0 * c, 0 * c + 1]]),
    ):
        T = np.moveaxis(np.array(T), -1, 0)
        wanted = np.einsum("kij,kjl,kml->kim", T, expected, T)
        np.testing.assert_allclose(marginals[frame, 0], wanted, rtol=1e-4, atol=1e-7)
    # Of one pose seen from another, by differences of `between` on the joint covariance.
    for (a, b), got in zip(PAIRS, relative["pose"][: len(PAIRS)], strict=True):
        J = np.zeros((3, 3 * N))
        for which in (a, b):
            for i in range(3):
                up, down = poses.copy(), poses.copy()
                up[which, i] += 1e-6
                down[which, i] -= 1e-6
                J[:, 3 * which + i] = (between(up[a], up[b]) - between(down[a], down[b])) / 2e-6
        np.testing.assert_allclose(got, J @ cov @ J.T, rtol=1e-4, atol=1e-7)
        if a == 0:
            np.testing.assert_allclose(got, expected[b], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_another_pose_given(method):
    marginals, relative = covariances(method)
    given = marginals["world", FIXED]
    np.testing.assert_allclose(given, relative["world"][len(PAIRS) :], atol=1e-12)
    np.testing.assert_allclose(given[FIXED], 0, atol=1e-12)
    _, graph = drawn(0)
    solution = pose_graph.solve(graph, method=method)
    with pytest.raises(ValueError, match=r"fixed: expected a pose of 0 to 7, got 8"):
        pose_graph.marginals(graph, solution, fixed=8)


def exact(seed):
    """A graph without noise."""
    truth, graph = drawn(seed)
    a, b = np.asarray(graph.pair).T
    return truth, graph._replace(
        odometry=jnp.asarray(between(truth[:-1], truth[1:])), loop=jnp.asarray(between(truth[a], truth[b]))
    )


def test_chordal_start_is_exact_without_noise():
    truth, graph = exact(5)
    first = np.array([3.0, -2.0, 1.0])
    expected = compose(np.broadcast_to(first, truth.shape), truth)
    found = pose_graph.chordal(graph, jnp.asarray(first))
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(reference.wrap(np.asarray(found[:, 2]) - expected[:, 2]), 0, atol=1e-9)


def test_noise_free_has_no_error():
    truth, graph = exact(5)
    solution = pose_graph.solve(graph)
    assert solution.converged
    np.testing.assert_allclose(solution.poses[:, :2], truth[:, :2], atol=1e-9)
    assert solution.chi2 < 1e-15


def without_loops():
    """The true poses, and a graph of odometry alone."""
    truth, graph = drawn(0)
    return truth, graph._replace(
        **{name: jnp.asarray(np.asarray(getattr(graph, name))[:0]) for name in Graph._fields[2:]}
    )


def test_without_loops_odometry_comes_back():
    _, graph = without_loops()
    solution = pose_graph.solve(graph)
    assert solution.converged
    np.testing.assert_allclose(solution.poses, dead_reckoning(graph), atol=1e-12)
    _, _, cov = reference.graph_optimum(np.asarray(solution.poses), edges_of(graph), steps=1)
    np.testing.assert_allclose(pose_graph.marginals(graph, solution), blocks(cov), rtol=1e-4, atol=1e-7)


def test_two_equal_edges_count_twice():
    _, graph = drawn(0)
    twice = graph
    for field in Graph._fields[2:]:
        twice = with_entry(twice, field, 1, np.asarray(getattr(graph, field))[0])
    once = with_entry(graph, "loop_information", 0, 2 * np.asarray(graph.loop_information)[0])
    once = with_entry(once, "loop_information", 1, 0)
    np.testing.assert_allclose(pose_graph.solve(twice).poses, pose_graph.solve(once).poses, atol=1e-8)


# --- Kernels ---

NAMES = ["quadratic", "huber", "cauchy", "geman_mcclure", "dcs", "gnc"]


SQUARES = np.array([0.01, 0.5, 0.9, 1.2, 5.0, 11.0, 12.0, 400.0])
AT_TWO = {  # a square, and its weight at a scale of two
    "cauchy": (4.0, 1 / 2),
    "geman_mcclure": (4.0, 1 / 4),
    "huber": (16.0, 1 / 2),
    "dcs": (6.0, 1 / 4),
    "gnc": (4.1, 0),
}


@functools.cache
def weighed():
    """What every kernel makes of some squares."""

    @jax.jit
    def of_all():
        found = {}
        for name in NAMES:
            kernel = Kernel(name)
            slopes = jax.vmap(jax.grad(kernel.rho))(jnp.asarray(SQUARES))
            quantile = kernel.weight(jnp.array(scipy.stats.chi2.ppf(0.99, 3)))
            found[name] = kernel.weight(jnp.asarray(SQUARES)), slopes, kernel.rho(jnp.array([1e-6])), quantile
        return found, {name: Kernel(name, 2.0).weight(jnp.array(square)) for name, (square, _) in AT_TWO.items()}

    return of_all()


@pytest.mark.parametrize("name", NAMES)
def test_weight_is_the_derivative_of_rho(name):
    weights, slopes, near_zero, _ = weighed()[0][name]
    np.testing.assert_allclose(weights, slopes, atol=1e-12)
    assert np.all(np.diff(weights) <= 1e-12)
    np.testing.assert_allclose(near_zero, [1e-6], rtol=1e-5)


def test_kernels_at_their_scale():
    for name, weight in weighed()[1].items():
        assert float(weight) == pytest.approx(AT_TWO[name][1])


@pytest.mark.parametrize("name", NAMES[1:-1])
def test_usual_scales_count_a_loop_half_at_the_quantile(name):
    assert float(weighed()[0][name][-1]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("tukey",), "kernel: expected one of"), (("huber", 0.0), "scale: expected a number > 0, got 0.0")],
)
def test_kernels_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        Kernel(*arguments)


TARGET = np.random.default_rng(3).normal(size=(N, 3))


@functools.partial(jax.jit, static_argnames=("name", "method"))
def solved_with_slopes(graph, scale, log_scale, *, name, method):
    """The solution with a robust kernel, a score of its poses, and the score's slopes by odometry, loops, the kernel's
    scale and the logarithm of what the loops' information is multiplied by. Solved as finely as can be: slopes are
    those of an optimum, and at the default tolerance one with these kernels is so far off it that they err by 4e-4.
    """

    def score(odometry, loop, scale, log_scale):
        information = graph.loop_information * jnp.exp(log_scale)
        moved = graph._replace(odometry=odometry, loop=loop, loop_information=information)
        solution = pose_graph.solve(moved, kernel=Kernel(name, scale), method=method, tolerance=1e-15)
        return jnp.sum(solution.poses * TARGET), solution

    of = jax.value_and_grad(score, argnums=(0, 1, 2, 3), has_aux=True)
    (value, solution), slopes = of(graph.odometry, graph.loop, scale, log_scale)
    return solution, value, slopes


DERIVED = {"scipy": ("cauchy", 0, 0), "loop_space": ("geman_mcclure", 1, 1)}  # a kernel, and the graph that is drawn


def robustly(graph, name):
    """Solved with a kernel, by a program that other tests need too."""
    for method, (derived, *_) in DERIVED.items():
        if name == derived:
            return solved_with_slopes(graph, float(Kernel(name).c), 0.0, name=name, method=method)[0]
    if name == "huber":
        return pose_graph.solve(graph, dead_reckoning(graph), kernel=Kernel("huber", Kernel("huber").c))
    return pose_graph.solve(graph, kernel=name)


@pytest.mark.parametrize("name", ["cauchy", "geman_mcclure", "dcs", "huber"])
def test_robust_optimum_has_no_slope(name):
    _, graph = drawn(1, false=1)
    solution = robustly(graph, name)
    assert solution.converged
    weights = np.concatenate([np.ones(N - 1), solution.weights])
    _, g, H = reference.graph_linear(np.asarray(solution.poses), edges_of(graph), weights)
    assert g @ np.linalg.solve(H, g) < 1e-6
    squares = chi2(graph, solution.poses)
    np.testing.assert_allclose(solution.weights, Kernel(name).weight(squares[1]), rtol=1e-6)


@functools.cache
def without_false_loops():
    """A graph, and its optimum from the truth, which is so near that a few steps take it there."""
    truth, graph = drawn(2, poses=40, loops=12)
    return graph, reference.graph_optimum(truth, edges_of(graph), steps=6)[0]


@pytest.mark.parametrize("false", [3, 6])
def test_false_loops_are_found(false):
    """Of six, or of three and three more that say nothing, which count in full."""
    clean, poses = without_false_loops()
    _, wrong = drawn(7, poses=40, loops=6, false=6)
    wrong = with_entry(wrong, "loop_information", slice(false, None), 0)
    joined = clean._replace(
        **{name: np.concatenate([getattr(clean, name), getattr(wrong, name)]) for name in Graph._fields[2:]}
    )
    solution = pose_graph.solve(joined, kernel="gnc")
    assert solution.converged
    np.testing.assert_array_equal(solution.weights, [1.0] * 12 + [0.0] * false + [1.0] * (6 - false))
    np.testing.assert_allclose(solution.poses, poses, atol=1e-6)


# --- Batches ---


@functools.cache
def batch(count=5):
    return stacked(*(drawn(seed, loops=L - seed % 2)[1] for seed in range(count)))


@functools.cache
def solved_in_batch():
    return jax.jit(jax.vmap(functools.partial(pose_graph.solve)))


def test_batch_is_a_loop():
    graphs = batch()
    together = solved_in_batch()(graphs)
    for k in range(5):
        alone = pose_graph.solve(jax.tree.map(lambda x, k=k: jnp.asarray(np.asarray(x)[k]), graphs))
        np.testing.assert_allclose(together.poses[k], alone.poses, atol=1e-8)
        assert together.iterations[k] == alone.iterations


def test_filling_up_changes_nothing():
    small = drawn(1, poses=6, loops=2)[1]
    poses, least, _ = reference.graph_optimum(np.asarray(dead_reckoning(small)), edges_of(small))
    both = jax.tree.map(np.asarray, stacked(small, drawn(0)[1]))
    filled = pose_graph.solve(jax.tree.map(lambda x: jnp.asarray(x[0]), both))
    np.testing.assert_allclose(np.asarray(filled.poses)[:6], poses, atol=1e-8)
    np.testing.assert_allclose(filled.chi2, least, rtol=1e-8)


@pytest.mark.parametrize("field", Graph._fields[:2] + Graph._fields[3:])
def test_one_graph_that_is_no_number_spoils_no_other(field):
    graphs = batch()
    bad = with_entry(graphs, field, (2, 0), np.nan)
    good, spoiled = solved_in_batch()(graphs), solved_in_batch()(bad)
    others = np.array([0, 1, 3, 4])
    for name, a, b in zip(good._fields, good, spoiled, strict=True):
        np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others], err_msg=name)
    np.testing.assert_array_equal(spoiled.converged, [True, True, False, True, True])
    np.testing.assert_array_equal(spoiled.finite, [True, True, False, True, True])


def test_values_do_not_compile_again():
    with jax.log_compiles(False):
        solve = solved_in_batch()
        solve(batch())
        before = solve._cache_size()
        solve(batch()._replace(odometry=batch().odometry * 1.01))
        assert solve._cache_size() == before


def test_float32():
    _, graph = drawn(0)
    single = graph._replace(**{n: x.astype(jnp.float32) for n, x in graph._asdict().items() if n != "pair"})
    solution = pose_graph.solve(single)
    assert solution.converged
    assert solution.poses.dtype == jnp.float32
    np.testing.assert_allclose(solution.poses, optimum()[0], atol=2e-4)
    np.testing.assert_allclose(pose_graph.marginals(single, solution), blocks(optimum()[2]), rtol=2e-2, atol=1e-5)


# --- Derivatives ---


@pytest.mark.parametrize("method", DERIVED)
def test_gradient(method):
    """By measurements, information and the scale of a kernel, along one direction, against a difference over 6e-5 of
    it, whose error is a millionth: its next term goes by the square of what the poses move by in deviations.
    """
    name, seed, false = DERIVED[method]
    _, graph = drawn(seed, false=false)
    solved = functools.partial(solved_with_slopes, name=name, method=method)
    *_, slopes = solved(graph, 3.0, 0.0)
    rng = np.random.default_rng(4)
    for moves in ((1, 1, 0, 1), (0, 0, 1, 0)):  # the kernel's scale by itself: little depends on it
        along = [k * rng.normal(size=np.shape(x)) for k, x in zip(moves, slopes, strict=True)]
        expected = []
        for step in (3e-5, -3e-5):
            odometry, loop, scale, log_scale = (step * x for x in along)
            moved = graph._replace(odometry=graph.odometry + odometry, loop=graph.loop + loop)
            expected.append(float(solved(moved, float(3 + scale), float(log_scale))[1]))
        found = sum(np.sum(x * np.asarray(slope)) for x, slope in zip(along, slopes, strict=True))
        np.testing.assert_allclose(found, (expected[0] - expected[1]) / 6e-5, rtol=1e-5)


# --- Statistics ---


def test_covariance_of_the_last_pose_holds():
    """300 graphs of 8 poses. The mean NEES of consistent ones is 3, its standard error √(6 / 300) = 0.14; four of
    these, and 0.1 for the bend of the errors, which is not in a covariance.
    """
    drawn_ones = [drawn(100 + seed) for seed in range(300)]
    marginals = jax.jit(jax.vmap(functools.partial(pose_graph.marginals, frame="body")))
    nees = []
    for first in range(0, 300, 5):  # in batches of which the program is there
        some = drawn_ones[first : first + 5]
        graphs = jax.tree.map(lambda *x: np.stack(x), *(graph for _, graph in some))
        solution = solved_in_batch()(graphs)
        assert solution.converged.all()
        error = between(np.asarray(solution.poses)[:, -1], np.array([truth[-1] for truth, _ in some]))
        cov = np.asarray(marginals(graphs, solution))[:, -1]
        nees += [e @ np.linalg.solve(P, e) for e, P in zip(error, cov, strict=True)]
    assert abs(np.mean(nees) - 3) < 4 * np.sqrt(6 / 300) + 0.1


# --- Faults ---


def test_parts_that_nothing_ties():
    _, graph = drawn(0)
    graph = with_entry(with_entry(graph, "odometry_information", 3, 0), "pair", slice(None), [0, 2])
    solution = pose_graph.solve(graph)
    assert not solution.converged
    (said,) = pose_graph.faults(graph, solution)
    assert "the graph has 2 parts: nothing ties 4 poses, such as 4, to the first" in said


def test_a_missing_link_that_a_loop_bridges():
    truth, graph = exact(5)
    pair = np.array([[2, 5], [0, 4], [1, 7], [6, 3]], np.int32)
    a, b = pair.T
    graph = graph._replace(pair=jnp.asarray(pair), loop=jnp.asarray(between(truth[a], truth[b])))
    graph = with_entry(with_entry(graph, "odometry_information", 3, 0), "odometry", 3, 9.0)
    solution = pose_graph.solve(graph)
    assert solution.converged
    np.testing.assert_allclose(solution.poses[:, :2], truth[:, :2], atol=1e-7)
    refused = pose_graph.solve(graph, method="loop_space")
    assert not refused.converged
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(refused.good_odometry)), [3])
    assert "odometry: the information of 1 is not positive definite, the first number 3" in pose_graph.faults(
        graph, refused
    )


@pytest.mark.parametrize("method", METHODS)
def test_indefinite_information(method):
    _, graph = drawn(0)
    bad = np.diag([1.0, -1.0, 1.0])
    for field, at in (("odometry_information", 2), ("loop_information", 1)):
        wrong = with_entry(graph, field, at, bad)
        if method == "sparsax" and field == "odometry_information":
            continue  # CHOLMOD refuses a matrix that is not positive definite for the whole call
        solution = pose_graph.solve(wrong, method=method)
        assert not solution.converged
        assert any(f"the first number {at}" in said for said in pose_graph.faults(wrong, solution))


def test_too_few_steps():
    """Of a graph without loops, from other poses than its odometry's."""
    truth, graph = without_loops()
    solution = pose_graph.solve(graph, jnp.asarray(truth), steps=1)
    assert not solution.converged
    assert pose_graph.faults(graph, solution) == ["not settled after 1 steps: the poses are the best on the way"]
    np.testing.assert_allclose(solution.poses[:, :2], truth[:, :2], atol=1e-12)
    np.testing.assert_allclose(reference.wrap(np.asarray(solution.poses)[:, 2] - truth[:, 2]), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (
            {"pair": jnp.array([[0, 9]] * L, jnp.int32)},
            ValueError,
            r"pair: expected two different poses of 0 to 7, got \[0, 9\]",
        ),
        ({"pair": jnp.array([[3, 3]] * L, jnp.int32)}, ValueError, "pair: expected two different poses"),
        ({"pair": jnp.zeros((L, 2))}, TypeError, "pair: expected dtype integer"),
        ({"loop": jnp.zeros((L + 1, 3))}, ValueError, "loop: expected shape"),
        ({"odometry_information": jnp.zeros((N - 1, 3))}, ValueError, "odometry_information: expected shape"),
    ],
)
def test_graphs_refused(change, error, words):
    _, graph = drawn(0)
    with pytest.raises(error, match=words):
        pose_graph.solve(graph._replace(**change))


def test_arguments_refused():
    _, graph = drawn(0)
    solution = pose_graph.solve(graph)
    for call, words in (
        (lambda: pose_graph.solve(graph, method="magic"), "method: expected one of"),
        (lambda: pose_graph.solve(graph, kernel="magic"), "kernel: expected one of"),
        (lambda: pose_graph.solve(graph, steps=0), "steps: expected at least 1, got 0"),
        (lambda: pose_graph.solve(graph, tolerance=0.0), r"tolerance: expected a share inside \(0, 1\), got 0.0"),
        (lambda: pose_graph.solve(graph, jnp.zeros((3, 3))), "start: expected shape"),
        (lambda: pose_graph.marginals(graph, solution, frame="map"), "frame: expected one of"),
        (lambda: pose_graph.stack([]), "graphs: expected at least one, got none"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_kernel_is_a_pytree():
    kernel = jax.tree.map(lambda x: 2 * x, Kernel("huber", 1.5))
    assert dataclasses.astuple(kernel) == ("huber", 3.0)
