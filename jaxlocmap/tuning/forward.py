"""Derivatives of a function of few numbers and much data: forward, whichever mode is asked for."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree


def forward(f: Callable[..., Any]) -> Callable[..., Any]:
    """`f(few, data)` with its derivative by `few` taken in forward mode, also under `jax.grad`.

    Reverse mode keeps something of every step of a loop, with a map in the loop a map of every step, and walks back
    through it. A filter has a handful of parameters and thousands of steps: to carry the derivative along costs as
    many more states as there are parameters, whatever the number of steps, and takes less time too. Everything else
    is as it was: derivatives of any order, by `data` as well (those in the mode asked for), under any transformation.

    Args:
        f: `(few, data) -> pytree of arrays`; few: a pytree of real numbers and arrays with few entries.

    Source: Gupta & Mehra 1974 (the sensitivity equations of a filter).
    """
    f = jax.jit(f)  # traced once, however often it is differentiated

    @jax.custom_jvp
    def with_forward(few: Any, data: Any) -> Any:
        return f(few, data)

    def rule(primals: tuple[Any, Any], tangents: tuple[Any, Any]) -> tuple[Any, Any]:
        (few, data), (few_dot, data_dot) = primals, tangents
        flat, unravel = ravel_pytree(few)

        def pushed(direction: jax.Array) -> tuple[Any, Any]:
            return jax.jvp(lambda x: f(unravel(x), data), (flat,), (direction,))

        if _is_still(few_dot):
            value = f(few, data)
            dot = jax.tree.map(jnp.zeros_like, value)
        else:
            value, slopes = jax.vmap(pushed, out_axes=(None, 0))(jnp.eye(len(flat), dtype=flat.dtype))
            along = ravel_pytree(jax.tree.map(_instantiated, few_dot, is_leaf=_is_zero))[0]
            dot = jax.tree.map(lambda slope: jnp.tensordot(along.astype(slope.dtype), slope, 1), slopes)
        if not _is_still(data_dot):
            dot = jax.tree.map(jnp.add, dot, _along_data(functools.partial(f, few), data, data_dot))
        return value, dot

    with_forward.defjvp(rule, symbolic_zeros=True)
    return with_forward


def _along_data(f: Callable[[Any], Any], data: Any, dot: Any) -> Any:
    """The derivative of f along those arrays of its data that move."""
    leaves, form = jax.tree.flatten(data)
    dots = jax.tree.leaves(dot, is_leaf=_is_zero)
    moving = [i for i, x in enumerate(dots) if not _is_zero(x)]

    def of_moving(values: list[Any]) -> Any:
        there = dict(zip(moving, values, strict=True))
        return f(jax.tree.unflatten(form, [there.get(i, leaf) for i, leaf in enumerate(leaves)]))

    return jax.jvp(of_moving, ([leaves[i] for i in moving],), ([dots[i] for i in moving],))[1]


def _is_zero(x: Any) -> bool:
    return isinstance(x, SymbolicZero)


def _is_still(dot: Any) -> bool:
    return all(_is_zero(x) for x in jax.tree.leaves(dot, is_leaf=_is_zero))


def _instantiated(x: Any) -> Any:
    return jnp.zeros(x.shape, x.dtype) if _is_zero(x) else x
