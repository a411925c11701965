"""Loops and branches against JAX's own, under every transformation; what stays one call, and what stays a branch."""

import functools
import itertools
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from jaxlocmap._internal import batching
from jaxlocmap._internal.linalg import SMALL


class Carry(NamedTuple):
    """Small arrays, which are kept entry by entry, and others, which are not."""

    vector: jax.Array  # (3,)
    matrix: jax.Array  # (2, 3)
    nothing: jax.Array  # (0, 3)
    large: jax.Array  # (2, 10)
    scalar: jax.Array  # ()
    count: jax.Array  # (2,) int32
    flag: jax.Array  # () bool
    none: None


def carry(seed=0):
    rng = np.random.default_rng(seed)
    reals = (jnp.asarray(rng.normal(size=shape)) for shape in ((3,), (2, 3), (0, 3), (2, 10), ()))
    return Carry(*reals, jnp.array([seed, 1], jnp.int32), jnp.array(seed % 2 == 0), None)


XS = {"push": jnp.asarray(np.random.default_rng(9).normal(size=(3, 3))), "k": jnp.arange(3, dtype=jnp.int32)}


def lane(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


def turn(carry, x):
    """Mixes everything, so that an entry out of place is seen."""
    matrix = jnp.sin(carry.matrix + x["push"][None]) * carry.scalar
    vector = jnp.where(carry.flag, carry.vector, -carry.vector) + matrix[1] * carry.large[0, 2]
    moved = carry._replace(
        vector=vector,
        matrix=matrix,
        nothing=carry.nothing + 1,
        large=carry.large * vector[0] + matrix[0, 2],
        scalar=carry.scalar + vector[2],
        count=carry.count + jnp.stack([x["k"], 2 * x["k"]]),
        flag=~carry.flag,
    )
    return moved, {"matrix": matrix.T, "large": moved.large, "scalar": vector[2], "k": x["k"], "none": None}


def chosen(cond, carry, xs):
    def true(carry, k):
        return turn(carry, lane(xs, k))

    def false(carry, k):
        moved, y = turn(carry, lane(xs, 0))
        return moved._replace(vector=moved.vector[::-1]), y | {"k": k + 7}

    return cond(carry.vector[0] > 0, true, false, carry, xs["k"][2])


FORMS = {
    "scan": [lambda carry, xs, scan=scan: scan(turn, carry, xs) for scan in (batching.scan, jax.lax.scan)],
    "cond": [functools.partial(chosen, cond) for cond in (batching.cond, jax.lax.cond)],
}
forms = pytest.mark.parametrize("forms", FORMS.values(), ids=FORMS)
# On both sides of the branch. In NumPy: to cut and to reshape them compiles nothing.
CARRIES = jax.tree.map(lambda *x: np.stack(x), *(carry(seed) for seed in range(4)))


@pytest.fixture
def close(tolerance):
    """Equal up to how a compiler may round another program."""
    return functools.partial(chex.assert_trees_all_close, rtol=tolerance(1e-12, 1e-5), atol=tolerance(1e-12, 1e-5))


@forms
def test_the_same_as_jaxs_one_by_one_in_batches_and_in_batches_of_batches(forms, close):
    ours, jaxs = (jax.jit(form) for form in forms)
    each = [jax.tree.map(np.asarray, jaxs(lane(CARRIES, i), XS)) for i in range(4)]
    for i, expected in enumerate(each):
        got = ours(lane(CARRIES, i), XS)
        chex.assert_trees_all_equal_shapes_and_dtypes(got, expected)
        close(got, expected)
    together = jax.tree.map(lambda *x: np.stack(x), *each)
    batch = jax.vmap(ours, in_axes=(0, None))
    close(batch(CARRIES, XS), together)
    pairs = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), CARRIES)
    got = jax.vmap(batch, in_axes=(0, None))(pairs, XS)
    close(got, jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), together))


@forms
def test_the_same_derivatives_as_jaxs(forms, close):
    def score(form, vector, matrix, large):
        moved, y = form(carry()._replace(vector=vector, matrix=matrix, large=large), XS)
        kept = jnp.sum(jnp.sin(y["matrix"])) + jnp.sum(y["large"])
        return jnp.sum(moved.vector**2) + moved.matrix[0, 1] * moved.matrix[1, 2] + kept

    def slopes(form, *reals):
        slope = jax.grad(functools.partial(score, form), argnums=(0, 1, 2))
        return slope(*reals), jax.jacfwd(slope)(*reals)

    ours, jaxs = (jax.jit(functools.partial(slopes, form))(*carry()[:2], carry().large) for form in forms)
    close(ours, jaxs)
    assert all(np.any(x) for x in jax.tree.leaves(ours))


@forms
def test_the_same_as_jaxs_under_shard_map(forms, close):
    """With its checks of what differs between devices."""
    runs, shared = PartitionSpec("runs"), PartitionSpec()
    mesh = Mesh(np.array(jax.devices()[:1]), ("runs",))

    def block(form, carries, xs):
        # One of the runs alone: JAX itself fails on a `cond` whose predicate differs within a batch.
        return jax.tree.map(lambda x: x[None], form(lane(carries, 0), xs))

    ours, jaxs = (
        jax.shard_map(functools.partial(block, form), mesh=mesh, in_specs=(runs, shared), out_specs=runs)
        for form in forms
    )
    close(jax.jit(ours)(CARRIES, XS), jax.jit(jaxs)(CARRIES, XS))


def test_a_loop_may_keep_nothing_and_may_have_no_turn():
    total, kept = batching.scan(lambda carry, x: (carry + x, None), jnp.zeros(3), jnp.ones((4, 3)))
    np.testing.assert_array_equal(total, np.full(3, 4.0))
    assert kept is None
    total, kept = batching.scan(lambda carry, x: (carry + x, carry), jnp.ones(3), jnp.ones((0, 3)))
    np.testing.assert_array_equal(total, np.ones(3))
    assert kept.shape == (0, 3)


# --- The program ---


def compiled_from(function, *args):
    """What the compiler is given, as text."""
    return jax.jit(function).lower(*args).as_text()


def test_small_arrays_travel_entry_by_entry_and_others_whole(monkeypatch):
    travelling = []

    def watched(name):
        real = getattr(jax.lax, name)

        def call(*args, **kwargs):
            results = real(*args, **kwargs)
            travelling.append([x.shape for x in (results[0] if name == "scan" else results)])
            return results

        monkeypatch.setattr(jax.lax, name, call)

    watched("scan")
    watched("cond")
    jax.eval_shape(lambda carry: FORMS["scan"][0](carry, XS), carry())
    assert travelling.pop() == [()] * (3 + 6) + [(0, 3), (2, 10)] + [()] * (1 + 2 + 1)
    jax.eval_shape(lambda carry: FORMS["cond"][0](carry, XS), carry())
    assert set(travelling.pop()) == {(), (0, 3), (2, 10)}


@pytest.mark.parametrize(
    ("shape", "small"),
    [
        ((SMALL,), True),
        ((3, 3), True),
        ((2, 4), True),
        ((9, 1), True),
        ((SMALL, SMALL), True),
        ((SMALL + 1,), False),
        ((SMALL + 1, SMALL + 1), False),
        ((2, 5), False),
        ((10, 1), False),
        ((0, 3), False),
        ((2, 2, 2), False),
    ],
)
def test_what_is_small_is_a_state_its_covariance_or_no_larger_than_that_of_a_pose(shape, small):
    x = np.arange(np.prod(shape)).reshape(shape)
    parts, stack = batching.unstack([jnp.array(x)])
    assert [part.shape for part in parts] == ([()] * x.size if small else [shape])
    np.testing.assert_array_equal(stack(parts)[0], x)


def test_a_branch_on_what_all_share_stays_one_in_a_batch():
    """And one on what differs does not: it would run both sides."""

    def conds(predicate):
        def branch(carry, push):
            return batching.cond(predicate(carry, push), lambda c: c.matrix, lambda c: -c.matrix, carry)

        return compiled_from(jax.vmap(branch, in_axes=(0, None)), CARRIES, XS["push"][0]).count("stablehlo.case")

    assert conds(lambda carry, push: push[0] > 0) == 1
    assert conds(lambda carry, push: batching.any_in_batch(carry.flag)) == 1
    assert conds(lambda carry, push: carry.flag) == 0


# --- One call for many runs ---


def weighed(values, scene, scale):
    """Of N runs: values (N, n), sorted, plus what may be shared, (N or 1, n), times what may be, too, (N or 1,)."""
    return jnp.sort(values, axis=1) + scene["shift"] * scale[:, None]


weigh = batching.at_once(weighed)
rng = np.random.default_rng(0)
ARGS = [rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3, 4)), rng.normal(size=(2, 3))]  # two batches of three runs
AXES = [axes for axes in itertools.product((0, None), repeat=3) if axes != (None,) * 3]


@pytest.mark.parametrize("outer", AXES)
def test_many_runs_at_once_are_a_plain_loop(outer, tolerance):
    """Whatever is batched, and at which level."""
    for inner in AXES:

        def batched(full, outer, inner):
            full = full if inner == 0 else full[:, 0]
            return full if outer == 0 else full[0]

        args = [batched(*each) for each in zip(ARGS, outer, inner, strict=True)]
        one = jax.vmap(lambda values, shift, scale: weigh(values, {"shift": shift}, scale), in_axes=inner)
        got = jax.vmap(one, in_axes=outer)(*map(jnp.asarray, args))
        values, shift, scale = (
            np.broadcast_to(x[: 2 if a == 0 else 1, : 3 if b == 0 else 1], x.shape)
            for x, a, b in zip(ARGS, outer, inner, strict=True)
        )
        expected = np.sort(values, axis=2) + shift * scale[..., None]
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance(1e-15, 1e-6))


def test_many_runs_are_one_call_and_what_they_share_stays_shared():
    values, shift, scale = map(jnp.asarray, ARGS)
    calls = []

    @batching.at_once
    def weigh(values, scene, scale):
        calls.append((values.shape, scene["shift"].shape, scale.shape))
        return weighed(values, scene, scale)

    def batch(values, scale):
        one = jax.vmap(lambda values, scale: weigh(values, {"shift": shift[0, 0]}, scale))
        return jax.vmap(one, in_axes=(0, None))(values, scale)

    assert compiled_from(batch, values, scale[0]).count("stablehlo.sort") == 1
    assert ((6, 4), (1, 4), (6,)) in calls
    # The first argument is as long as there are runs even where they share it.
    jax.eval_shape(jax.vmap(lambda scale: weigh(values[0, 0], {"shift": shift[0, 0]}, scale)), scale[0])
    assert ((3, 4), (1, 4), (3,)) in calls


def test_a_loop_told_what_differs_is_batched_in_one_pass():
    def passes(zero):
        """How often vmap goes through the body of a loop whose carry begins as a constant."""
        seen = []

        @jax.custom_batching.custom_vmap
        def add(carry, start):
            return carry + start

        @add.def_vmap
        def _(axis_size, in_batched, carry, start):
            seen.append(in_batched[0])
            return carry + start, True

        def run(start):
            def body(carry, _):
                return add(carry, start), None

            given = batching.zero_of(start) if zero else None
            return batching.scan(body, jnp.zeros(()), jnp.arange(3), zero=given)[0]

        np.testing.assert_array_equal(jax.jit(jax.vmap(run))(jnp.arange(4.0)), 3 * jnp.arange(4.0))
        return seen

    assert passes(zero=True) == [True]
    assert passes(zero=False) == [False, True]


# --- Flags and constants ---


def test_any_in_batch_is_one_answer_for_all():
    flags = jnp.array([[False, False, True], [False, False, False]])
    assert not batching.any_in_batch(flags[1])
    np.testing.assert_array_equal(jax.vmap(batching.any_in_batch)(flags), [True, True])
    np.testing.assert_array_equal(jax.vmap(jax.vmap(batching.any_in_batch))(flags), np.full((2, 3), True))
    np.testing.assert_array_equal(jax.vmap(batching.any_in_batch)(jnp.zeros((2, 3), bool)), [False, False])


@pytest.mark.parametrize("value", [np.nan, np.inf, 3, True, np.zeros((0, 3)), np.zeros((2, 2))])
def test_what_differs_between_devices_adds_nothing_whatever_its_values(value):
    given = {"real": jnp.array([1.5, -2.0]), "whole": jnp.array(3), "flags": jnp.array([True, False]), "none": None}
    for tree, like in ((given, ({"a": jnp.asarray(value)}, None)), (given | {"a": jnp.asarray(value)}, jnp.ones(1))):
        got = jax.jit(lambda tree, like: batching._add_zero(tree, batching.zero_of(like)))(tree, like)
        chex.assert_trees_all_equal_shapes_and_dtypes(got, tree)
        jax.tree.map(np.testing.assert_array_equal, got, tree)


def over_runs(function, in_axes=0):
    return jax.vmap(function, in_axes, out_axes=None, axis_name=batching.RUNS)


@pytest.mark.parametrize("in_axes", [(0, 0), (0, None), (None, 0)])
def test_a_sum_over_runs_is_of_those_counted_and_the_same_for_all(in_axes):
    values, counted = jnp.array([[1.0, 2.0], [3.0, np.nan], [5.0, 6.0]]), jnp.array([True, False, True])
    given = [x if axis == 0 else x[0] for x, axis in zip((values, counted), in_axes, strict=True)]
    every = [np.broadcast_to(x, whole.shape) for x, whole in zip(given, (values, counted), strict=True)]
    expected = np.where(every[1][:, None], every[0], 0).sum(0)
    np.testing.assert_array_equal(over_runs(batching.sum_over_runs, in_axes)(*given), expected)


def test_a_sum_over_runs_is_over_nothing_else():
    values = jnp.arange(6.0).reshape(3, 2)  # runs, cells
    cells = jax.vmap(batching.sum_over_runs, (0, None))
    np.testing.assert_array_equal(over_runs(cells)(values, jnp.ones(3, bool)), values.sum(0))


def test_a_sum_over_runs_inside_a_loop_keeps_one_number_a_turn():
    """Else the loop would stack a number of every run."""

    def run(start, counted):
        return jax.lax.scan(lambda x, _: (2 * x, batching.sum_over_runs(x, counted)), start, length=5)[1]

    starts, counted = jnp.array([1.0, 10.0, 100.0]), jnp.array([True, True, False])
    np.testing.assert_array_equal(over_runs(run)(starts, counted), [11, 22, 44, 88, 176])
    text = compiled_from(over_runs(run), starts, counted)
    assert "tensor<5xf" in text
    assert "tensor<5x3xf" not in text
    assert "tensor<3x5xf" not in text
