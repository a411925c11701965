"""The map over runs against a plain Python loop, whatever the chunk, the devices and the number of runs."""

import os
import re
import textwrap
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import ended, start

from jaxlocmap._internal import batching
from jaxlocmap.monte_carlo import chunks, hosts, monte_carlo, use_all_cores


class Outcome(NamedTuple):
    mean: jax.Array  # ()
    walk: jax.Array  # (3,)
    positive: jax.Array  # () bool


def one_run(key, scale, shift):
    """A small run: a random walk of three steps."""
    walk = shift + scale * jnp.cumsum(jax.random.normal(key, (3,)))
    return Outcome(walk.mean(), walk, walk[-1] > 0)


KEY, ARGS = jax.random.key(7), (2.0, 0.5)


@pytest.fixture(scope="module")
def loop():
    """Every run of the study in a Python loop, stacked."""
    args = tuple(map(jnp.asarray, ARGS))
    alone = jax.jit(one_run)
    runs = [alone(jax.random.fold_in(KEY, i), *args) for i in range(23)]
    return jax.tree.map(lambda *each: np.stack(each), *runs)


def assert_close(got, expected, rtol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol), got, expected)


def sums(runs):
    return jax.tree.map(lambda x: x.sum(0, dtype=np.float64), runs)


class AddedUp:
    """A run that knows how to be added up, and whose sum can be told from that of its runs."""

    def __call__(self, key):
        return jnp.zeros(3)

    def summed(self, key, counted):
        return batching.sum_over_runs(jax.random.uniform(key, (3,)), counted)


# --- What comes back ---


@pytest.mark.parametrize(("runs", "chunk"), [(23, 256), (23, 23), (23, 7), (23, 1), (1, 4), (8, 4)])
def test_the_sums_are_those_of_a_python_loop(loop, runs, chunk, tolerance):
    # The chunk changes the order of the additions and the vector code of the runs: rounding, nothing more.
    value = monte_carlo(one_run, KEY, runs, *ARGS, chunk=chunk).value
    assert_close(value, sums(jax.tree.map(lambda x: x[:runs], loop)), tolerance(1e-13, 1e-5))
    assert {leaf.dtype for leaf in jax.tree.leaves(value)} == {np.dtype(np.float64)}


@pytest.mark.parametrize("chunk", [3, 7, 16])
def test_a_run_that_can_be_added_up_as_it_goes_is(chunk, tolerance):
    study = AddedUp()
    expected = sum(np.float64(jax.random.uniform(jax.random.fold_in(KEY, i), (3,))) for i in range(7))
    value = monte_carlo(study, KEY, 7, chunk=chunk).value
    np.testing.assert_allclose(value, expected, rtol=tolerance(1e-13, 1e-6))
    assert not monte_carlo(study, KEY, 7, chunk=chunk, keep_runs=True).value.any()


@pytest.mark.parametrize("chunk", [256, 7, 1])
def test_kept_runs_are_those_of_a_python_loop_in_order(loop, chunk, tolerance):
    value = monte_carlo(one_run, KEY, 23, *ARGS, chunk=chunk, keep_runs=True).value
    assert value.walk.shape == (23, 3)
    assert_close(value._replace(positive=0), loop._replace(positive=0), tolerance(1e-13, 1e-5))
    np.testing.assert_array_equal(value.positive, loop.positive)


def test_a_run_does_not_depend_on_how_many_follow(tolerance):
    few, many = (monte_carlo(one_run, KEY, runs, *ARGS, chunk=8, keep_runs=True).value for runs in (5, 11))
    assert_close(few.walk, many.walk[:5], tolerance(1e-13, 1e-5))


def test_runs_differ_and_another_key_is_another_study():
    first, other = (
        monte_carlo(one_run, jax.random.key(seed), 11, *ARGS, chunk=8, keep_runs=True).value.walk for seed in (1, 2)
    )
    assert len(np.unique(np.concatenate([first, other])[:, 0])) == 22


def test_runs_past_the_end_of_the_study_are_not_counted_even_if_they_are_no_number():
    # Run 5 is the first that only fills up the last chunk.
    def spoiled(key, last):
        return jnp.where(jnp.all(jax.random.key_data(key) == last), jnp.nan, 1.0)

    past = jax.random.key_data(jax.random.fold_in(KEY, 5))
    assert monte_carlo(spoiled, KEY, 5, past, chunk=3).value == 5
    assert np.isnan(monte_carlo(spoiled, KEY, 6, past, chunk=3).value)


def test_totals_over_chunks_are_added_in_double_precision():
    def one_large(key, large):
        return jnp.where(jnp.all(jax.random.key_data(key) == large), jnp.float32(2**24), jnp.float32(1))

    # In float32, 2^24 + 1 is 2^24.
    first = jax.random.key_data(jax.random.fold_in(KEY, 0))
    assert monte_carlo(one_large, KEY, 4, first, chunk=1).value == 2**24 + 3


def test_progress_counts_the_runs_done():
    done = []
    monte_carlo(one_run, KEY, 23, *ARGS, chunk=7, progress=done.append)
    assert done == [7, 14, 21, 23]


@pytest.mark.parametrize("wrong", [0, -1, 2.5, 5.0, True, "5", np.float32(5)])
@pytest.mark.parametrize("name", ["runs", "chunk"])
def test_anything_but_a_whole_number_from_one_on_is_refused(name, wrong):
    numbers = {"runs": 5, "chunk": 5} | {name: wrong}
    with pytest.raises(
        ValueError, match=f"^{name}: expected at least 1, a whole number, got {re.escape(repr(wrong))}$"
    ):
        monte_carlo(one_run, KEY, numbers["runs"], *ARGS, chunk=numbers["chunk"])


def test_a_chunk_is_no_larger_than_the_study_and_time_is_told():
    began = time.perf_counter()
    result = monte_carlo(one_run, KEY, 5, *ARGS, chunk=100)
    assert 0 < result.run_s < time.perf_counter() - began
    assert (result.chunk, result.processes, result.resumed_runs) == (5, 1, 0)


def test_whole_numbers_may_be_numpy_s():
    assert monte_carlo(one_run, KEY, np.int64(5), *ARGS, chunk=np.uint8(2)).chunk == 2


def test_more_runs_than_an_index_can_count_are_refused():
    with pytest.raises(ValueError, match=r"^runs: expected at most 2147483647, got 2147483648$"):
        monte_carlo(one_run, KEY, 2**31, *ARGS)


def test_a_study_without_a_device_or_a_key_is_refused():
    with pytest.raises(ValueError, match="devices: expected at least one"):
        monte_carlo(one_run, KEY, 5, *ARGS, devices=())
    with pytest.raises(TypeError, match=r"key: expected one made by jax\.random\.key, got 0"):
        monte_carlo(one_run, 0, 5, *ARGS)
    for key in (np.int32(3), jax.random.split(KEY), jnp.zeros((2, 2), np.uint32)):
        with pytest.raises(TypeError, match=r"key: expected one made by jax\.random\.key, got"):
            monte_carlo(one_run, key, 5, *ARGS)
    with pytest.raises(ValueError, match="one_run: expected it to return arrays, got None"):
        monte_carlo(lambda key: None, KEY, 5)


def test_leaves_of_several_types_add_up_in_their_own_places():
    def several(key):
        bits = jax.random.bits(key, (2, 3), jnp.uint8)
        return {"b": bits, "a": jnp.float16(0.5), "c": (bits > 127, jnp.zeros((0, 4)), jnp.float32(3))}

    value = monte_carlo(several, KEY, 21, chunk=4).value
    runs = monte_carlo(several, KEY, 21, chunk=4, keep_runs=True).value
    assert {leaf.dtype.name for leaf in jax.tree.leaves(runs)} >= {"uint8", "float16", "bool", "float32"}
    jax.tree.map(lambda total, each: np.testing.assert_array_equal(total, each.sum(0, np.float64)), value, runs)


def large_count(key):
    del key
    return jnp.array(2**30, jnp.int32)


def test_counts_do_not_wrap_around():
    assert monte_carlo(large_count, KEY, 10).value == 10 * 2.0**30


# --- Compiling ---


def test_a_study_is_compiled_once_whatever_its_values():
    traces = []

    def traced(key, scale):
        traces.append(scale.shape)
        return scale * jax.random.normal(key)

    first = monte_carlo(traced, KEY, 8, 1.0, chunk=4)
    assert first.compile_s > 0
    assert len(traces) == 1
    again = monte_carlo(traced, KEY, 8, 1.0, chunk=4)
    changed = monte_carlo(traced, jax.random.key(3), 80, 2.0, chunk=4)
    assert len(traces) == 1
    assert again.compile_s == changed.compile_s == 0
    assert again.value == first.value != changed.value
    # Another shape is another program.
    monte_carlo(traced, KEY, 8, np.ones(2), chunk=4)
    assert len(traces) == 2


# --- Devices ---

SCRIPT = """
    import jax, jax.numpy as jnp, numpy as np
    from jaxlocmap.monte_carlo import monte_carlo, use_all_cores

    if {two}:
        jax.config.update("jax_num_cpu_devices", 2)
    else:
        assert use_all_cores() == len(jax.local_devices()) == {cores}
        assert use_all_cores() == {cores}  # once more changes nothing
        assert use_all_cores(1) == 1
    jax.config.update("jax_enable_x64", {x64})

    def one_run(key, scale):
        return scale * jnp.cumsum(jax.random.normal(key, (3,)))

    key, devices = jax.random.key(0), jax.local_devices()
    one = monte_carlo(one_run, key, 13, 2.0, chunk=3, devices=devices[:1])
    every = monte_carlo(one_run, key, 13, 2.0, chunk=3)
    np.testing.assert_array_equal(every.value, one.value)  # to the last bit
    assert (one.devices, every.devices, every.processes) == (1, len(devices), 1)
    one = monte_carlo(one_run, key, 13, 2.0, chunk=3, keep_runs=True, devices=devices[:1])
    every = monte_carlo(one_run, key, 13, 2.0, chunk=3, keep_runs=True)
    assert every.value.shape == (13, 3)
    np.testing.assert_array_equal(every.value, one.value)
    done = []
    monte_carlo(one_run, key, 13, 2.0, chunk=3, progress=done.append)
    assert done == [min(3 * len(devices) * (i + 1), 13) for i in range(len(done))], done
    assert done[-1] == 13
    assert monte_carlo(one_run, key, 13, 2.0).chunk == -(-13 // len(devices))  # few runs keep all devices busy
    print(len(devices), "devices")
"""


@pytest.mark.slow
@pytest.mark.parametrize("two", [True, False], ids=["two_devices", "all_cores"])
def test_all_devices_together_give_what_one_gives(two, tmp_path):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    script = textwrap.dedent(SCRIPT.format(two=two, cores=cores, x64=jax.config.jax_enable_x64))
    (tmp_path / "script.py").write_text(script)
    # As users compile it.
    status, said, err = ended(start(tmp_path / "script.py", XLA_FLAGS="", JAX_DISABLE_MOST_OPTIMIZATIONS="0"))
    assert status == 0, err
    assert said == f"{2 if two else cores} devices\n"


def test_asking_for_all_cores_too_late_leaves_the_devices_as_they_are():
    before = jax.local_devices()
    assert use_all_cores() == len(before)
    assert use_all_cores(len(before)) == len(before)
    assert jax.local_devices() == before


def test_more_devices_than_exist_are_refused():
    there = len(jax.local_devices())
    with pytest.raises(ValueError, match=rf"^devices: expected at most {there}, the .*, got {there + 1}$"):
        use_all_cores(there + 1)
    with pytest.raises(ValueError, match=r"^devices: expected at least 1, a whole number, got 0$"):
        use_all_cores(0)


@pytest.mark.parametrize(("quota", "expected"), [("max 100000", None), ("150000 100000", 2), ("1000 100000", 1)])
def test_a_container_s_quota_counts_as_cores(monkeypatch, quota, expected):
    monkeypatch.setattr(hosts.os, "sched_getaffinity", lambda _: range(16), raising=False)
    monkeypatch.setattr(hosts.Path, "read_text", lambda _: quota)
    assert hosts.cores() == (expected or 16)


def test_precisions_are_compiled_apart(x64):
    def one(key):
        return jnp.asarray(0.1, float)

    assert monte_carlo(one, KEY, 2, keep_runs=True).value.dtype == np.float64
    with jax.enable_x64(False):
        assert monte_carlo(one, KEY, 2, keep_runs=True).value.dtype == np.float32


def test_the_last_runs_there_can_be_are_counted_once():
    """Their chunk reaches past the largest index."""
    run = chunks.OneRun.of(lambda key: jnp.ones(()), False, KEY, ())
    program = chunks.compile(run, 100, tuple(jax.local_devices()[:1]))
    last = 2**31 - 1
    runs, shared = program.place((np.int32(last), (KEY, ())))
    assert program.compute(np.array([last - 30], np.int32), runs, *shared)[0][0, 0] == 30
