"""The generator against JAX's own, its streams, and the distribution of what they give."""

import functools

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxlocmap._internal import random

FAILURE = 1e-6  # probability with which a statistical bound is missed by a right program
COUNT = 1 << 17  # numbers that a statistic is taken of
KEY = (jnp.uint32(0x243F6A88), jnp.uint32(0x85A308D3))

draw = functools.partial(jax.jit, static_argnums=(3, 4))
draw_normals, draw_uniforms = draw(random.normals), draw(random.uniforms)


def words(value):
    return tuple(jnp.uint32(x) for x in value)


# --- The generator ---


@pytest.mark.parametrize(
    ("key", "counter", "expected"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_the_words_its_authors_publish(key, counter, expected):
    """kat_vectors of Random123, threefry2x32 with 20 rounds."""
    assert tuple(map(int, random.threefry(words(key), words(counter)))) == expected


def test_the_generator_is_jaxs_bit_for_bit():
    key, counter = np.random.default_rng(0).integers(2**32, size=(2, 2, 500), dtype=np.uint32)
    counter[:, :2] = [[0, 2**32 - 1], [2**32 - 1, 0]]
    got = jax.jit(random.threefry)(tuple(key), tuple(counter))
    jaxs = jax.vmap(jax.extend.random.threefry_2x32, in_axes=(1, 1), out_axes=1)(key, counter)
    np.testing.assert_array_equal(got, jaxs)


@pytest.mark.parametrize("kind", ["threefry2x32", "rbg"])
def test_every_key_of_jax_has_words_of_its_own(kind):
    keys = jax.random.split(jax.random.key(0, impl=kind), 200)
    every = np.column_stack(jax.vmap(random.words_of)(keys))
    assert every.dtype == np.uint32
    assert len(np.unique(every, axis=0)) == len(keys)
    np.testing.assert_array_equal(np.ravel(random.words_of(keys[7])), every[7])  # alone as in a batch


@pytest.mark.parametrize("kind", ["threefry2x32", "rbg"])
def test_every_word_of_a_key_matters_to_both_of_its_words(kind):
    data = np.arange(1, 1 + jax.random.key_data(jax.random.key(0, impl=kind)).size, dtype=np.uint32)
    every = np.array([data, *(data + 2**31 * np.eye(data.size, dtype=np.uint32))], np.uint32)
    got = np.array([random.words_of(jax.random.wrap_key_data(jnp.array(each), impl=kind)) for each in every])
    assert all(len(np.unique(column)) == len(every) for column in got.T)
    np.testing.assert_array_equal(random.words_of(jnp.array(data)), got[0])  # as a plain array


# --- Streams ---
# --- Streams ---


def counters_of(monkeypatch, *draws):
    """The counters (step, lane), and which of the two numbers of each, that each of these draws took."""
    taken = []

    def recording(key, counter):
        del key
        taken.append(np.stack([np.atleast_1d(np.asarray(x)) for x in counter], axis=-1))
        return counter

    monkeypatch.setattr(random, "threefry", recording)
    every = []
    for form, step, lane, count in draws:
        taken.clear()
        form(KEY, step, lane, count, jnp.float32)
        both = range(2) if count <= 8 else range(1)
        pairs = [(*counter, word) for counter in np.concatenate(taken).tolist() for word in both]
        every.append(pairs[:count])
    return every


def test_uses_that_take_lanes_apart_share_nothing(monkeypatch):
    """Two numbers a lane, or one where many are drawn at once."""
    draws = [(random.normals, 0, 0, 3), (random.uniforms, 0, 2, 8), (random.normals, 0, 6, 61)]
    draws += [(form, step, lane, count) for step in (1, 2**31) for form, _, lane, count in draws]
    every = [use for uses in counters_of(monkeypatch, *draws) for use in uses]
    assert len(every) == len(set(every)) == 3 * (3 + 8 + 61)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 61])
def test_numbers_are_those_of_the_counters_they_say(count):
    """Both numbers of each counter, one after the other; where many are drawn at once, the first alone."""
    step, lane = 5, 40
    uniform = (np.array([random.threefry(KEY, words((step, lane + i))) for i in range(count)]) >> 9) + 0.5
    uniform /= 2**23
    turn = 2 * np.pi * uniform[:, 1] - np.pi
    normal = np.sqrt(-2 * np.log(uniform[:, :1])) * np.column_stack([np.cos(turn), np.sin(turn)])
    for draw_some, pairs, off in ((draw_uniforms, uniform, 0), (draw_normals, normal, 4e-6)):
        expected = pairs.ravel()[:count] if count <= 8 else pairs[:, 0]
        np.testing.assert_allclose(draw_some(KEY, step, lane, count, jnp.float32), expected, rtol=0, atol=off)


def streams(kind):
    """Pairs of neighbouring streams, (2, COUNT), that differ in step, lane, key word or run."""
    number = jnp.arange(COUNT // 2, dtype=jnp.uint32)

    def stream(key, step, lane):
        return draw_normals(key, step, lane, 2, jnp.float32)

    if kind == "steps":
        one, other = (jax.vmap(stream, (None, 0, None))(KEY, 2 * number + i, 7) for i in (0, 1))
    elif kind == "lanes":
        one, other = (jax.vmap(stream, (None, None, 0))(KEY, 7, 2 * number + i) for i in (0, 1))
    elif kind == "steps and lanes exchanged":
        one, other = (
            jax.vmap(stream, (None, 0, None))(KEY, number, 3),
            jax.vmap(stream, (None, None, 0))(KEY, 3, number),
        )
    else:
        runs = jax.vmap(lambda i: random.words_of(jax.random.fold_in(jax.random.key(0), i)))
        one, other = (jax.vmap(stream, (0, None, None))(runs(2 * number + i), 0, 0) for i in (0, 1))
    return np.asarray(one, np.float64).ravel(), np.asarray(other, np.float64).ravel()


@pytest.mark.parametrize("kind", ["steps", "lanes", "steps and lanes exchanged", "runs"])
def test_neighbouring_streams_have_nothing_in_common(kind):
    one, other = streams(kind)
    bound = scipy.stats.norm.isf(FAILURE / 2) / np.sqrt(COUNT)  # a product of two normals has variance one
    assert abs(np.mean(one * other)) < bound
    assert abs(np.mean(one[0::2] * one[1::2])) < bound * np.sqrt(2)  # the two numbers of a counter
    assert abs(np.mean((one**2 - 1) * (other**2 - 1))) < 2 * bound  # of a square, two
    # Of 2**23 values, equal ones are a coincidence: Poisson.
    assert np.sum(one == other) <= scipy.stats.poisson.isf(FAILURE, COUNT / 2**23)


# --- Distribution ---


@functools.cache
def sample(form, count):
    """COUNT numbers, drawn `count` at a time, as a filter does: step after step."""
    steps = jnp.arange(-(-COUNT // count))
    every = jax.jit(jax.vmap(lambda k: form(KEY, k, 0, count, jnp.float32)))(steps)
    return np.asarray(every, np.float64).ravel()[:COUNT]


def assert_distributed(values, distribution):
    """Kolmogorov and Smirnov's bound for the largest gap between sample and distribution."""
    gap = scipy.stats.kstest(values, distribution.cdf).statistic
    assert gap < np.sqrt(np.log(2 / FAILURE) / 2 / values.size)


@pytest.mark.parametrize("count", [3, 61])
def test_normals_are_standard_normal(count):
    values, reach = sample(random.normals, count), scipy.stats.norm.isf(FAILURE / 2)
    # Moments and the variance of each power: E x^2n - (E x^n)^2.
    for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs(np.mean(values**power) - moment) < reach * np.sqrt(variance / values.size)
    assert_distributed(values, scipy.stats.norm)
    # The largest of so many: the tails are there, and do not reach further than they should.
    low, high = scipy.stats.norm.isf(1 - np.array([FAILURE, 1 - FAILURE]) ** (1 / values.size))
    assert low < max(-values.min(), values.max())
    assert values.max() < high
    assert values.min() > -high


@pytest.mark.parametrize("count", [3, 61])
def test_uniforms_are_even(count):
    values = sample(random.uniforms, count)
    assert_distributed(values, scipy.stats.uniform)
    assert values.min() > 0
    assert values.max() < 1


@pytest.mark.parametrize("dtype", [jnp.float32, float])
def test_the_first_and_last_word_give_numbers(monkeypatch, dtype):
    """Neither end of (0, 1) is reached, so no normal is infinite, and none is no number."""
    ends = jnp.uint32(0), jnp.uint32(2**32 - 1)
    monkeypatch.setattr(random, "threefry", lambda *_: ends)
    low, high = random.uniforms(KEY, 0, 0, 2, dtype)
    assert (float(low), float(high)) == (2.0**-24, 1 - 2.0**-24)
    far, aside = random.normals(KEY, 0, 0, 2, dtype)
    assert float(far) == pytest.approx(-np.sqrt(48 * np.log(2)), rel=1e-6)  # 5.77: beyond are 1e-8 of a normal's
    assert float(aside) == pytest.approx(0, abs=4e-6)
    monkeypatch.setattr(random, "threefry", lambda *_: ends[::-1])
    assert float(random.normals(KEY, 0, 0, 1, dtype)[0]) == pytest.approx(-np.sqrt(2.0**-23), rel=1e-5)


# --- However they are drawn ---


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("count", [3, 61])
def test_both_precisions_give_the_same_numbers(count):
    """Uniforms exactly; normals but for what sine and cosine are off by in float32."""
    for step in range(20):
        single, double = (draw_uniforms(KEY, step, 9, count, dtype) for dtype in (jnp.float32, jnp.float64))
        assert (single.dtype, double.dtype) == (jnp.float32, jnp.float64)
        np.testing.assert_array_equal(single, double)
        single, double = (draw_normals(KEY, step, 9, count, dtype) for dtype in (jnp.float32, jnp.float64))
        assert (single.dtype, double.dtype) == (jnp.float32, jnp.float64)
        np.testing.assert_allclose(single, double, rtol=0, atol=4e-6)


@pytest.mark.parametrize("count", [2, 9])
def test_a_batch_and_a_loop_give_what_each_gives_alone(count):
    steps, lanes = jnp.arange(6), 5 * jnp.arange(6) + 1
    keys = jax.vmap(random.words_of)(jax.random.split(jax.random.key(1), 6))
    alone = [draw_normals((keys[0][i], keys[1][i]), steps[i], lanes[i], count, jnp.float32) for i in range(len(steps))]
    together = jax.vmap(lambda key, k, lane: draw_normals(key, k, lane, count, jnp.float32))(keys, steps, lanes)
    _, in_a_loop = jax.lax.scan(
        lambda carry, now: (carry, draw_normals(*now, count, jnp.float32)), None, (keys, steps, lanes)
    )
    # The logarithm may be rounded differently in another program.
    np.testing.assert_allclose(together, alone, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(in_a_loop, alone, rtol=1e-6, atol=1e-7)
