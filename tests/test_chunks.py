"""Chunks chosen from what a run carries and what its program holds; a chunk that memory does not hold."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlocmap import simulation
from jaxlocmap.consistency.study import Study
from jaxlocmap.monte_carlo import chunks, monte_carlo
from jaxlocmap.monte_carlo.checkpoint import Checkpoint

KEY = jax.random.key(0)
DEVICES = tuple(jax.local_devices()[:1])


@dataclasses.dataclass(frozen=True)
class Silent:
    """A run that carries so many float32 through a loop."""

    size: int

    def __call__(self, key):
        start = jnp.full(self.size, jax.random.uniform(key, (), jnp.float32))
        return jax.lax.fori_loop(0, 9, lambda _, c: jnp.sin(c) + c[0], start)


class Telling(Silent):
    """One that says so."""

    def carried(self, key):
        del key
        return jnp.zeros(self.size, jnp.float32)


def run_of(function, *args):
    return chunks.OneRun.of(function, False, KEY, jax.tree.map(jnp.asarray, args))


# --- What a run says it carries ---


@pytest.mark.parametrize("limits", [chunks.CPU, chunks.ACCELERATOR], ids=["cpu", "accelerator"])
@pytest.mark.parametrize("size", [1, 100, 3000, 10**5, 10**9])
def test_the_loop_of_a_chunk_works_inside_the_cache(size, limits):
    """It reads one carry and writes another."""
    fit = chunks.foreseen(run_of(Telling(size)), limits)
    assert fit <= limits.most
    assert fit == limits.most or 8 * size * fit <= limits.working < 8 * size * (fit + 1)


@pytest.mark.parametrize("limits", [chunks.CPU, chunks.ACCELERATOR], ids=["cpu", "accelerator"])
def test_a_run_that_says_nothing_or_carries_nothing_gets_the_largest_chunk(limits):
    assert chunks.foreseen(run_of(Silent(10**9)), limits) == limits.most
    assert chunks.foreseen(run_of(Telling(0)), limits) == limits.most


@pytest.mark.parametrize("mapping", [False, True])
def test_a_study_says_what_its_map_takes(mapping):
    scenario = simulation.CAPSTONE
    config = scenario.config(grid=mapping)
    prior = jax.tree.map(lambda x: x.astype(jnp.float32), scenario.prior())
    run = run_of(Study(scenario, config), simulation.course_params(), simulation.room(), simulation.Noise(), prior)
    # Mean and covariance, the log-likelihood, and the map: written once and read once.
    size = 4 * (3 + 9 + 1 + (np.prod(config.grid.shape) if mapping else 0))
    for limits in (chunks.CPU, chunks.ACCELERATOR):
        assert chunks.foreseen(run, limits) == min(limits.working // (2 * size), limits.most)


# --- The choice ---


def test_many_runs_are_cut_alike_for_any_number_of_devices_and_few_evenly():
    most = chunks.CPU.most
    assert {chunks.even(most, 1000 * most, devices) for devices in (1, 2, 3, 64)} == {most}
    assert [chunks.even(fit, 10**9, 2) for fit in (1, 8, 9, 79, 80)] == [8, 8, 8, 72, 80]
    for runs, devices, expected in [(5, 2, 3), (most, 2, most // 2), (most + 2, 1, most // 2 + 1), (1, 8, 1)]:
        assert chunks.even(most, runs, devices) == expected
    for runs in (7 * most + 1, 8 * most, 8 * most + 1, 3 * most - 1):
        chunk = chunks.even(most, runs, 2)
        turns = -(-runs // (2 * chunk))
        assert turns == -(-runs // (2 * most))  # no more than with the whole chunk
        assert turns * 2 * chunk - runs < 2 * turns  # and the last one is as full as the others


def test_few_runs_are_not_cut_into_whole_pages():
    """At multiples of 512 runs arrays would lie whole pages apart."""
    assert [chunks.even(3000, runs, 2) for runs in (1022, 1023, 1024, 1025, 2048)] == [511, 520, 520, 513, 1032]
    assert chunks.even(512, 8 * 512, 1) == 520
    assert chunks.even(512, 9 * 512, 1) == 512  # of many turns the chunk depends on nothing else


def test_a_processor_s_cache_memory_and_runs_are_bounded_and_an_accelerator_s_are_larger():
    assert chunks.CPU == (8 * 2**20, 2 * 2**30 // 8, 3000)
    assert all(a < b for a, b in zip(chunks.CPU, chunks.ACCELERATOR, strict=True))


def choose(monkeypatch, need, runs=10**9, run=Silent(1)):
    """The chunk for programs that `need` so many bytes for a chunk, and the chunks that were compiled."""
    tried = []

    def compile(run, chunk, devices):
        tried.append(chunk)
        return SimpleNamespace(need=need(chunk))

    monkeypatch.setattr(chunks, "compile", compile)
    monkeypatch.setattr(chunks, "limits_of", lambda device: chunks.Limits(8 * 2**20, 256 * 2**20, 3000))
    return chunks.choose(run_of(run), runs, 1, DEVICES), tried


def test_what_holds_little_enough_is_compiled_once(monkeypatch):
    assert choose(monkeypatch, lambda chunk: 256 * 2**20) == (3000, [3000])
    assert choose(monkeypatch, lambda chunk: 2**20, run=Telling(14_000)) == (72, [72])
    assert choose(monkeypatch, lambda chunk: 10**20, runs=5) == (5, [5])  # no fewer than the lanes


def test_what_holds_too_much_is_compiled_again_for_as_many_as_fit(monkeypatch):
    assert choose(monkeypatch, lambda chunk: 2**20 * chunk) == (256, [3000, 256])
    # A part that does not depend on the chunk makes the first step too small.
    assert choose(monkeypatch, lambda chunk: 200 * 2**20 + 2**20 * chunk) == (56, [3000, 240, 120, 56])
    assert choose(monkeypatch, lambda chunk: 10**20)[0] == 8


def test_what_the_compiler_refuses_is_taken_smaller(monkeypatch):
    def need(chunk):
        if chunk > 200:
            raise ValueError
        return 1

    assert choose(monkeypatch, need) == (184, [3000, 184])


def test_a_run_with_a_large_carry_of_which_it_says_nothing_fits_anyway(monkeypatch):
    """With the compiler's own numbers, instead of those above."""
    monkeypatch.setattr(chunks, "CPU", chunks.CPU._replace(resident=2**20))
    monkeypatch.setattr(chunks, "limits_of", lambda device: chunks.CPU)
    chunk = chunks.choose(run_of(Silent(1000)), 10**6, 1, DEVICES)
    need = chunks.compile(run_of(Silent(1000)), chunk, DEVICES).need
    assert chunk % 8 == 0
    assert 4 * 1000 * chunk <= need <= 2**20
    assert chunk >= 2**20 // (8 * 4 * 1000)  # a few such arrays a run are all it needs


def test_an_accelerator_may_hold_a_quarter_of_the_memory_it_says_it_has():
    def device(stats):
        return SimpleNamespace(platform="gpu", memory_stats=lambda: stats)

    assert chunks.limits_of(device({"bytes_limit": 64 * 2**30})).resident == 16 * 2**30
    assert chunks.limits_of(device(None)) == chunks.limits_of(device({})) == chunks.ACCELERATOR
    assert chunks.limits_of(SimpleNamespace(platform="cpu")) == chunks.CPU


# --- Memory ---


def hungry(key):
    return jax.lax.scan(lambda c, z: (c + z, c * z), jnp.zeros(()), jax.random.normal(key, (240,)))[1]


def test_a_chunk_larger_than_memory_is_refused_before_it_starts():
    with pytest.raises(ValueError, match=r"chunk: expected one that fits into the memory, got 1000000000 runs"):
        monte_carlo(hungry, KEY, 10**9, chunk=10**9)


def test_a_program_says_what_it_holds():
    # Each run holds its 240 random numbers at least.
    need = chunks.compile(run_of(hungry), 1000, DEVICES).need
    assert 1000 * 240 * jnp.zeros(()).dtype.itemsize < need < 1000 * 240 * 8 * 16


def program(need, platform, devices, run=lambda *_: []):
    mesh = SimpleNamespace(size=devices, devices=np.array([SimpleNamespace(platform=platform)] * devices))
    return chunks.Program(run, 100, mesh, need)


def test_the_refusal_says_what_would_fit(monkeypatch):
    monkeypatch.setattr(chunks, "_available", lambda device: 10**9)
    program(10**9, "cpu", 1).check_memory()
    with pytest.raises(ValueError, match=r"100 runs on each of 2 devices, which need about 2\.0 GB of 1\.0 .* 50 fit$"):
        program(10**9, "cpu", 2).check_memory()
    program(10**9, "gpu", 2).check_memory()  # each has a memory of its own
    with pytest.raises(ValueError, match="chunk: expected one that fits"):
        program(10**9 + 1, "gpu", 2).check_memory()
    program(0, "gpu", 1).check_memory()
    monkeypatch.setattr(chunks, "_available", lambda device: None)
    program(10**20, "gpu", 1).check_memory()


REFUSAL = r"^chunk: expected one that fits into the memory, got 100 runs on each of 2 devices: RESOURCE_EXHAUSTED: Out"


def out_of_memory(*_):
    raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 894 GiB.\n and more")


def broken(*_):
    raise jax.errors.JaxRuntimeError("INTERNAL: something else")


def test_a_device_that_runs_out_of_memory_gives_the_same_kind_of_error():
    with pytest.raises(ValueError, match=REFUSAL):
        program(0, "gpu", 2, out_of_memory).compute(np.zeros(2, np.int32))
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL: something else"):
        program(0, "gpu", 2, broken).compute(np.zeros(2, np.int32))


def test_a_compiler_that_runs_out_of_memory_does_too(monkeypatch):
    lowered = SimpleNamespace(compile=out_of_memory)
    monkeypatch.setattr(chunks.jax, "jit", lambda function: SimpleNamespace(lower=lambda *_: lowered))
    with pytest.raises(ValueError, match=r"^chunk: .* got 99 runs on each of 1 devices: RESOURCE_EXHAUSTED"):
        chunks.compile(run_of(Silent(2)), 99, DEVICES)


def test_what_was_finished_when_memory_ran_out_stays(monkeypatch, tmp_path):
    compile, turns = chunks.compile, []

    def failing(*args):
        program = compile(*args)

        def run(*args):
            turns.append(args)
            return out_of_memory() if len(turns) == 30 else program.run(*args)

        return program._replace(run=run)

    failing.cache_info = compile.cache_info
    parts = Checkpoint(tmp_path)
    monkeypatch.setattr(chunks, "compile", failing)
    with pytest.raises(ValueError, match="chunk: expected one that fits"):
        monte_carlo(Silent(3), KEY, 400, chunk=8, checkpoint=parts, devices=DEVICES)
    monkeypatch.undo()
    assert 0 < parts.runs_kept <= 29 * 8
    resumed = monte_carlo(Silent(3), KEY, 400, chunk=8, checkpoint=Checkpoint(tmp_path, resume=True), devices=DEVICES)
    assert resumed.resumed_runs == parts.runs_kept
    np.testing.assert_array_equal(resumed.value, monte_carlo(Silent(3), KEY, 400, chunk=8, devices=DEVICES).value)


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
