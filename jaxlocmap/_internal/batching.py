"""Loops and branches that run well under `vmap` and compile under `shard_map`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from jaxlocmap._internal.linalg import SMALL, stack_scalars

RUNS = "runs"  # the name of the axis of a chunk's runs


@custom_vmap
def any_in_batch(flags: jax.Array) -> jax.Array:
    """Whether a flag is set, in any run of the batch.

    The predicate of a `cond` that depends on the run makes both branches execute, for every run. This one does not
    depend on the run, so under `vmap` the branch stays a branch: steps at which nobody observes cost nothing. The
    branch it guards must mask per run, so that no result depends on the company a run is in.
    """
    return jnp.any(flags)


@any_in_batch.def_vmap
def _any_in_batch_vmap(axis_size: int, in_batched: list[bool], flags: jax.Array) -> tuple[jax.Array, bool]:
    del axis_size, in_batched
    return any_in_batch(flags), False


def sum_over_runs(tree: Any, counted: jax.Array) -> Any:
    """The sum of arrays over the runs that are `counted` (() bool), under `vmap(..., axis_name=RUNS)`.

    It is the same for all runs, so it can be taken inside a loop: what the loop stacks is then one sum a step instead
    of one value a run.
    """
    return jax.tree.map(lambda x: jax.lax.psum(jnp.where(counted, x, 0), RUNS), tree)


def at_once(many: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """A function of one run from a function of many: `vmap` of it, of any depth, is one call of `many`.

    Args:
        many: takes trees whose arrays lead with the axis of runs, N long, or 1 where all runs share a value that
            `many` may take as such; the arrays of its first argument are always N long. Returns an array (N, ...).

    Returns:
        The function of the same arguments without that axis.
    """

    @custom_vmap
    def batch(*trees: Any) -> jax.Array:
        return many(*trees)

    @batch.def_vmap
    def _(axis_size: int, in_batched: Any, *trees: Any) -> tuple[jax.Array, bool]:
        leaves, structure = jax.tree.flatten(trees)
        batched = jax.tree.leaves(in_batched)
        runs = max(leaf.shape[int(is_batched)] for leaf, is_batched in zip(leaves, batched, strict=True))
        first = len(jax.tree.leaves(trees[0]))

        def merge(i: int, leaf: jax.Array, is_batched: bool) -> jax.Array:
            shared = not is_batched and len(leaf) == 1
            if shared and i >= first:
                return leaf
            leaf = leaf if is_batched else leaf[None]
            leaf = jnp.broadcast_to(leaf, (axis_size, runs, *leaf.shape[2:]))
            return leaf.reshape(axis_size * runs, *leaf.shape[2:])

        merged = [merge(i, *pair) for i, pair in enumerate(zip(leaves, batched, strict=True))]
        out = batch(*jax.tree.unflatten(structure, merged))
        return out.reshape(axis_size, runs, *out.shape[1:]), True

    def one(*trees: Any) -> jax.Array:
        return batch(*jax.tree.map(lambda x: x[None], trees))[0]

    return one


def unstack(tree: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """A tree as a list in which every small vector and matrix stands entry by entry, and the function that stacks them
    again.

    A batch of 3x3 matrices lies in memory matrix by matrix, so that arithmetic on one entry strides. Entry by entry,
    each lies there run beside run, which is what vector instructions want. A loop or branch fixes what lies where.
    """
    leaves, structure = jax.tree.flatten(tree)
    leaves = [jnp.asarray(leaf) for leaf in leaves]
    shapes = [leaf.shape if _is_small(leaf.shape) else () for leaf in leaves]
    scalars = [
        leaf[i] if shape else leaf for leaf, shape in zip(leaves, shapes, strict=True) for i in np.ndindex(shape)
    ]

    def stack(scalars: list[Any]) -> Any:
        following, whole = iter(scalars), []
        for shape in shapes:
            some = [next(following) for _ in range(int(np.prod(shape)))]
            if len(shape) == 2:
                some = [some[i : i + shape[1]] for i in range(0, len(some), shape[1])]
            whole.append(stack_scalars(some) if shape else some[0])
        return jax.tree.unflatten(structure, whole)

    return scalars, stack


def _is_small(shape: tuple[int, ...]) -> bool:
    """Whether this is a vector or square matrix of a small state, or has no more entries than a 3x3 matrix."""
    if len(shape) == 2 and shape[0] != shape[1]:
        return 0 < shape[0] * shape[1] <= 9
    return len(shape) in (1, 2) and 0 < shape[0] <= SMALL


def zero_of(*trees: Any) -> jax.Array:
    """0, which differs between runs and devices, as far as `vmap` and `shard_map` are concerned, wherever any of the
    arrays does. The compiler sees that it is zero, and drops it together with what it was computed from.

    Returns:
        () int32.
    """
    zero = jnp.zeros((), jnp.int32)
    for leaf in jax.tree.leaves(trees):
        if jnp.size(leaf):
            first = jnp.ravel(leaf)[0]
            zero = zero + jnp.where(first == first, 0, 0).astype(jnp.int32)
    return zero


def zero_in_shard_map(*trees: Any) -> jax.Array | None:
    """`zero_of` there, where it saves tracing a branch twice; None elsewhere, where it saves nothing."""
    return zero_of(*trees) if _in_shard_map() else None


def scan(
    body: Callable[[Any, Any], tuple[Any, Any]],
    carry: Any,
    xs: Any,
    *,
    unroll: int = 1,
    zero: jax.Array | None = None,
) -> tuple[Any, Any]:
    """`jax.lax.scan` whose carry and results are unstacked, and whose first carry may be a constant in `shard_map`.

    Args:
        body, carry, xs, unroll: as of `jax.lax.scan`.
        zero: `zero_of` all that the loop reads. Not needed; with it the carry is batched from the start, and the body
            need not be traced again to find what becomes so.
    """
    if zero is None and _in_shard_map():
        zero = zero_of(carry, xs, body(carry, jax.tree.map(lambda x: x[0], xs)))
    scalars, stack = unstack(_add_zero(carry, zero))
    outputs: list[Callable[[list[Any]], Any]] = []

    def turn(scalars: list[Any], x: Any) -> tuple[list[Any], list[Any]]:
        carry, y = body(stack(scalars), x)
        y, stack_y = unstack(y)
        outputs.append(stack_y)
        return unstack(carry)[0], y

    scalars, ys = jax.lax.scan(turn, scalars, xs, unroll=unroll)
    return stack(scalars), jax.vmap(outputs[-1])(ys) if ys else outputs[-1](ys)


def cond(
    predicate: jax.Array,
    true: Callable[..., Any],
    false: Callable[..., Any],
    *operands: Any,
    zero: jax.Array | None = None,
) -> Any:
    """`jax.lax.cond` with operands and results unstacked, whose branches may return constants in `shard_map`.

    Args:
        predicate, true, false, *operands: as of `jax.lax.cond`.
        zero: `zero_of` all that the branches read. Not needed; with it no branch is traced twice in `shard_map`.
    """
    if not _in_shard_map():
        zero = None
    elif zero is None:
        zero = zero_of(operands, true(*operands), false(*operands))
    scalars, stack = unstack(operands)
    outputs: list[Callable[[list[Any]], Any]] = []

    def branch(function: Callable[..., Any]) -> Callable[[list[Any]], list[Any]]:
        def run(scalars: list[Any]) -> list[Any]:
            result = function(*stack(scalars))
            if zero is not None:  # an addition would go through all of a map: only where it is needed
                result = jax.tree.map(lambda x: x if _differs_already(x) else _add_zero(x, zero), result)
            scalars, stack_result = unstack(result)
            outputs.append(stack_result)
            return scalars

        return run

    results = jax.lax.cond(predicate, branch(true), branch(false), scalars)
    return outputs[-1](results)


def _in_shard_map() -> bool:
    return bool(jax.sharding.get_abstract_mesh().manual_axes)


def _add_zero(tree: Any, zero: jax.Array | None) -> Any:
    """The same values, which now differ between runs and devices wherever `zero` does, if there is one.

    `shard_map` wants both branches of a `cond`, and the carry before and after a step, to agree on that, and a constant
    agrees with nothing.
    """
    if zero is None:
        return tree
    return jax.tree.map(lambda x: jnp.logical_or(x, zero != 0) if x.dtype == bool else x + zero.astype(x.dtype), tree)


def _differs_already(x: jax.Array) -> bool:
    """Whether a value may differ along all axes of `shard_map`: then it cannot be cast to one that does."""
    for axis in jax.sharding.get_abstract_mesh().manual_axes:
        try:
            jax.lax.pcast(x, axis, to="varying")
        except ValueError:
            continue
        return False
    return True
