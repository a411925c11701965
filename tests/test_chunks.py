"""Chunks chosen from shapes, against bytes counted by hand; a chunk that memory does not hold."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import batching, chunks
from jaxlocmap.monte_carlo import monte_carlo

KEY = jax.random.key(0)


def vector(*shape):
    return jnp.ones(shape, jnp.float32)


def need(function, *args):
    return chunks.run_bytes(jax.make_jaxpr(function)(*args))


# --- Bytes of a run ---


def looping(x):
    """Carries 100 floats, makes 3,000 in its body, stacks 20 times 7."""

    def body(carry, _):
        wide = carry[:, None] * vector(1, 30)
        return carry + wide.sum(1), carry[:7]

    return jax.lax.scan(body, x, length=20)


def test_a_loop_needs_its_carry_and_the_largest_value_of_its_body():
    # Outside it: the last carry and what was stacked.
    assert need(looping, vector(100)) == (4 * (100 + 3000), 4 * (100 + 20 * 7))


def test_the_same_is_seen_through_calls_and_branches():
    alone = need(looping, vector(100))
    assert need(jax.jit(looping), vector(100)) == alone
    branched = need(lambda x: jax.lax.cond(x.sum() > 0, lambda: looping(x)[0], lambda: x), vector(100))
    assert branched.working == alone.working
    assert alone.resident <= branched.resident <= alone.resident + 4 * 100 + 16  # and the branch's result


def test_a_loop_in_a_loop_adds_its_need_to_the_outer_carry():
    def outer(x, y):
        return jax.lax.scan(lambda carry, _: (carry + looping(x)[0].sum(), None), y, length=3)

    assert need(outer, vector(100), vector(10)).working == 4 * (10 + 100 + 3000)


def test_a_while_loop_counts_all_it_carries():
    def until(x):
        return jax.lax.while_loop(lambda c: c[1] < 5, lambda c: (c[0] * 2, c[1] + 1), (x, jnp.int32(0)))

    assert need(until, vector(50)).working == 4 * (50 + 1 + 50)


def test_without_a_loop_the_largest_value_counts_and_what_is_dead_does_not():
    def straight(x):
        a = x * 2  # 1,000 floats, alive until b is made
        b = a + 1
        return b.sum() * 3

    assert need(straight, vector(1000)) == (4000, 8000)


def test_what_is_summed_over_the_runs_counts_for_no_run():
    def add_up(x, counted):
        def body(carry, _):
            return 2 * carry, (batching.sum_over_runs(carry, counted), carry[:7])

        return jax.lax.scan(body, x, length=20)

    jaxpr = jax.make_jaxpr(add_up, axis_env=[(batching.RUNS, 1)])(vector(100), True)
    assert chunks.run_bytes(jaxpr).resident == 4 * (100 + 20 * 7)


# --- The choice ---


def chosen(function, *args, runs=10**9, devices=1, platform="cpu"):
    return chunks.from_shapes(jax.make_jaxpr(function)(*args), runs, devices, platform)


@pytest.mark.parametrize("size", [1, 100, 3000, 10**5, 10**7])
def test_a_chunk_fills_the_cache_or_the_memory_and_neither_overflows(size):
    def grid(x):
        return jax.lax.fori_loop(0, 9, lambda _, c: c + 1, x)

    chunk, each = chosen(grid, vector(size)), need(grid, vector(size))
    assert chunk % 8 == 0
    assert 8 <= chunk <= chunks.CPU.most
    loads = (chunk + 8) * np.array(each) > (chunks.CPU.working, chunks.CPU.resident)
    assert any(loads) or chunk == chunks.CPU.most
    assert all(chunk * np.array(each) <= (chunks.CPU.working, chunks.CPU.resident)) or chunk == 8
    assert chosen(grid, vector(size), platform="gpu") >= chunk


def test_what_a_run_stacks_limits_the_chunk_too():
    def stacking(x):
        return jax.lax.scan(lambda c, _: (c + 1, c), x, length=10**5)

    fit = chunks.CPU.resident // need(stacking, vector(1)).resident
    assert chosen(stacking, vector(1)) == fit // 8 * 8 < chunks.CPU.most


def test_a_run_without_any_array_gets_the_largest_chunk():
    assert chosen(lambda: (), runs=10**9) == chunks.CPU.most


def test_many_runs_are_cut_alike_for_any_number_of_devices_and_few_evenly():
    def tiny(x):
        return x + 1

    most = chunks.CPU.most
    assert {chosen(tiny, vector(1), runs=1000 * most, devices=n) for n in (1, 2, 3, 64)} == {most}
    for runs, devices, expected in [(5, 2, 3), (most, 2, most // 2), (most + 2, 1, most // 2 + 1), (1, 8, 1)]:
        assert chosen(tiny, vector(1), runs=runs, devices=devices) == expected
    for runs in (7 * most + 1, 8 * most, 8 * most + 1, 3 * most - 1):
        chunk = chosen(tiny, vector(1), runs=runs, devices=2)
        turns = -(-runs // (2 * chunk))
        assert turns == -(-runs // (2 * most))  # no more than with the whole chunk
        assert turns * 2 * chunk - runs < 2 * turns  # and the last one is as full as the others


# --- Memory ---


def hungry(key):
    return jax.lax.scan(lambda c, z: (c + z, c * z), jnp.zeros(()), jax.random.normal(key, (240,)))[1]


def test_a_chunk_larger_than_memory_is_refused_before_it_starts():
    with pytest.raises(ValueError, match=r"chunk: expected one that fits into the memory, got 1000000000 runs") as told:
        monte_carlo(hungry, KEY, 10**9, chunk=10**9)
    # Each run holds its 240 random numbers at least.
    number = jnp.zeros(()).dtype.itemsize
    assert float(str(told.value).split("about ")[1].split(" GB")[0].replace(",", "")) > 240 * number


def test_the_estimate_says_what_would_fit(monkeypatch):
    monkeypatch.setattr(chunks, "_available", lambda device: 10**9)
    sizes = SimpleNamespace(temp_size_in_bytes=9 * 10**8, output_size_in_bytes=10**8, argument_size_in_bytes=0)
    compiled, device = SimpleNamespace(memory_analysis=lambda: sizes), SimpleNamespace(platform="cpu")
    chunks.check_memory(compiled, 100, [device])
    with pytest.raises(ValueError, match=r"100 runs on each of 2 devices, which need about 2\.0 GB of 1\.0 .* 50 fit$"):
        chunks.check_memory(compiled, 100, [device, device])
    accelerator = SimpleNamespace(platform="gpu")  # each has a memory of its own
    chunks.check_memory(compiled, 100, [accelerator, accelerator])
    sizes.temp_size_in_bytes += 1
    with pytest.raises(ValueError, match="chunk: expected one that fits"):
        chunks.check_memory(compiled, 100, [accelerator, accelerator])


def test_the_memory_left_is_what_the_machine_and_its_control_groups_leave(monkeypatch):
    files = {"/proc/meminfo": ["MemTotal: 9000 kB", "MemAvailable: 5000 kB"], "/proc/self/cgroup": ["0::/job/step"]}
    monkeypatch.setattr(chunks, "_lines", lambda path: files.get(path, []))
    device = SimpleNamespace(platform="cpu")
    assert chunks._available(device) == 5000 * 1024
    files |= {"/sys/fs/cgroup/job/step/memory.max": ["max"], "/sys/fs/cgroup/job/step/memory.current": ["7"]}
    assert chunks._available(device) == 5000 * 1024
    files |= {"/sys/fs/cgroup/memory.max": ["1000"], "/sys/fs/cgroup/memory.current": ["300"]}
    assert chunks._available(device) == 700
    files.clear()
    assert chunks._available(device) > 2**28  # all the memory there is, where the system says no more
