"""Standard normal numbers from a key and two counters, cheap enough to be drawn inside a loop.

The generator is that of `jax.random`, Threefry-2x32 with 20 rounds (Salmon et al. 2011). JAX compiles it on a CPU as a
loop over memory, and throws away one word of two; written out, it runs in registers, and both words are used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap._internal.trig import sin_cos

Words = tuple[jax.Array, jax.Array]  # two uint32, () each

_FEW = 8
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def threefry(key: Words, counter: Words) -> Words:
    """Two pseudo-random words from two words of key and two of counter, uint32 of any shape."""
    keys = (*key, key[0] ^ key[1] ^ np.uint32(0x1BD11BDA))
    a, b = counter[0] + keys[0], counter[1] + keys[1]
    for group in range(5):
        for distance in _ROTATIONS[group % 2]:
            a = a + b
            b = a ^ ((b << np.uint32(distance)) | (b >> np.uint32(32 - distance)))
        a = a + keys[(group + 1) % 3]
        b = b + keys[(group + 2) % 3] + np.uint32(group + 1)
    return a, b


def words_of(key: jax.Array) -> Words:
    """Two words of key for `normals` from a key of `jax.random`, whatever generator that is for."""
    data = jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key
    counter = (data[2], data[3]) if len(data) == 4 else (jnp.zeros_like(data[0]), jnp.zeros_like(data[1]))
    return threefry((data[0], data[1]), counter)


def lanes(count: int) -> int:
    """How many lanes the draw of so many numbers takes: two numbers a lane, or one where more than 8 are drawn."""
    return -(-count // 2) if count <= _FEW else count


def uniforms(key: Words, step: jax.Array, lane: Any, count: int, dtype: Any) -> jax.Array:
    """Numbers (count,) evenly spread over (0, 1), neither end included.

    Args:
        key: from `words_of`.
        step: () integer, >= 0.
        lane: () integer, >= 0, where to begin in what this key and step have to give, so that uses apart take lanes
            apart (`lanes`).
        count: how many.
        dtype: floating point; multiples of 2**-24 in all of them, so that the same key gives the same numbers.
    """
    return _draw(lambda words: (_uniform(words[0], dtype), _uniform(words[1], dtype)), key, step, lane, count)


def normals(key: Words, step: jax.Array, lane: Any, count: int, dtype: Any) -> jax.Array:
    """Standard normal numbers (count,), arguments as in `uniforms`. Source: Box & Muller 1958.

        √(-2 log u₁) cos φ and, where there are few, √(-2 log u₁) sin φ, with φ = 2π u₂ - π

    u₁ being at least 2**-24, none is further out than 5.77: one of 1e8 normal numbers would be.
    """

    def pair(words: Words) -> tuple[jax.Array, jax.Array]:
        first, second = (_uniform(word, dtype) for word in words)
        reach, (sin, cos) = jnp.sqrt(-2 * jnp.log(first)), sin_cos(2 * math.pi * second - math.pi)
        return reach * cos, reach * sin

    return _draw(pair, key, step, lane, count)


def _uniform(word: jax.Array, dtype: Any) -> jax.Array:
    return ((word >> np.uint32(9)).astype(jnp.int32).astype(dtype) + 0.5) * 2.0**-23


def _draw(numbers: Callable[[Words], Words], key: Words, step: jax.Array, lane: Any, count: int) -> jax.Array:
    """Numbers (count,) from a function of two words to two numbers."""
    step, lane = jnp.asarray(step, jnp.uint32), jnp.asarray(lane, jnp.uint32)
    if count <= _FEW:  # one by one, so that each lies in memory beside that of the next run
        pairs = (numbers(threefry(key, (step, lane + np.uint32(i)))) for i in range(lanes(count)))
        return jnp.stack([number for pair in pairs for number in pair][:count])
    # The second numbers are left alone: to put them behind the first would cost more than to draw again.
    every = lane + jnp.arange(count, dtype=jnp.uint32)
    return numbers(threefry(key, (jnp.full_like(every, step), every)))[0]
