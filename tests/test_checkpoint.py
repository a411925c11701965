"""Finished parts on disk: whole or told, one study's alone, and a study that goes on to the same last bit."""

import contextlib
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from disks import full_disk
from programs import ended, start

from jaxlocmap.monte_carlo import checkpoint as checkpoint_module
from jaxlocmap.monte_carlo import chunks, monte_carlo
from jaxlocmap.monte_carlo.checkpoint import Checkpoint
from jaxlocmap.monte_carlo.lock import Lock
from jaxlocmap.monte_carlo.plan import Plan, manifest

STUDY = {"runs": 30, "chunk": 4, "seed": 1}  # 8 chunks, each a part, the last of 2 runs
ARRAYS = (np.arange(5.0) / 3, np.array([True, False]), np.zeros((0, 2), np.int32))


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "out" / "parts"


def at(folder, *args, **kwargs):
    """Checkpoint that are kept in the folder."""
    return Checkpoint(folder.parent, *args, **kwargs)


def opened(folder, study=STUDY, **kwargs):
    said = []
    parts = at(folder, say=said.append, **{"discard": not kwargs.get("resume")} | kwargs)
    try:
        return parts, parts.open(study, range(Plan(study["runs"], study["chunk"]).parts)), said
    finally:
        parts.release()


def the_file(folder, part):
    return next(file for file in folder.iterdir() if file.name.startswith("part-") and int(file.name[5:]) == part)


# --- How a study is split ---


@pytest.mark.parametrize(("runs", "chunk"), [(1, 1), (7, 3), (255, 1), (256, 1), (257, 1), (10_000, 7), (10**9, 512)])
def test_parts_hold_every_chunk_once_and_are_alike(runs, chunk):
    split = Plan(runs, chunk)
    pieces = [split.chunks_of(part) for part in range(split.parts)]
    assert pieces[0].start == 0
    assert pieces[-1].stop == split.chunks
    assert (split.chunks - 1) * chunk < runs <= split.chunks * chunk
    assert all(a.stop == b.start for a, b in itertools.pairwise(pieces))
    assert split.parts == min(split.chunks, 256)
    assert max(map(len, pieces)) - min(map(len, pieces)) <= 1
    assert sum(map(split.runs_of, range(split.parts))) == runs


# --- What is kept ---


def test_a_part_comes_back_as_it_was_kept(folder):
    parts, finished, said = opened(folder)
    assert (finished, said) == (set(), [])
    parts.save(3, ARRAYS)
    parts.save(7, ARRAYS[:1])
    assert parts.runs_kept == 4 + 2
    again, finished, said = opened(folder, resume=True)
    assert (finished, said) == ({3, 7}, [])
    assert again.runs_kept == 6
    assert again.recorded_chunk() == 4
    for got, kept in zip(again.load(3), ARRAYS, strict=True):
        np.testing.assert_array_equal(got, kept, strict=True)
    assert len(again.load(7)) == 1
    with pytest.raises(FileNotFoundError):
        again.load(4)


def test_every_damage_is_told(folder):
    parts, *_ = opened(folder)
    for part in range(6):
        parts.save(part, ARRAYS)
    whole = the_file(folder, 0).read_bytes()
    the_file(folder, 0).write_bytes(whole[:-1])
    the_file(folder, 1).write_bytes(b"")
    the_file(folder, 2).write_bytes(whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:])
    the_file(folder, 3).write_bytes(whole + b"\0")
    the_file(folder, 4).write_bytes(whole)  # of another place in the study
    again, finished, said = opened(folder, resume=True)
    assert finished == {5}
    assert [f"part {part} in" in sentence and "damaged" in sentence for part, sentence in enumerate(said)] == [True] * 5
    with pytest.raises(ValueError, match="part 2 of this study"):
        again.load(2)
    again.save(2, ARRAYS)
    assert opened(folder, resume=True)[1] == {2, 5}


def test_a_part_of_another_study_is_told(tmp_path):
    for seed in (1, 2):
        opened(tmp_path / str(seed) / "parts", STUDY | {"seed": seed})[0].save(0, ARRAYS)
    the_file(tmp_path / "2" / "parts", 0).replace(the_file(tmp_path / "1" / "parts", 0))
    assert opened(tmp_path / "1" / "parts", resume=True)[1] == set()


def test_another_study_is_refused_and_each_difference_named(folder):
    parts, *_ = opened(folder, settings={"gate": 0.99, "map": True})
    parts.save(0, ARRAYS)
    other = STUDY | {"seed": 2, "new": "x"}
    told = r"seed was 1, is 2; new was None, is 'x'$"
    with pytest.raises(
        ValueError, match=rf"resume: expected the study .* got another: gate was 0\.99, is None; {told}"
    ):
        opened(folder, other, resume=True, settings={"gate": None, "map": True})
    # Nothing was touched.
    assert opened(folder, resume=True, settings={"gate": 0.99, "map": True})[1] == {0}


@pytest.mark.parametrize(("seed", "whose"), [(1, "this"), (2, "another")])
def test_what_is_there_is_not_lost_by_a_new_start(folder, seed, whose):
    opened(folder)[0].save(0, ARRAYS)
    told = rf"parts: expected resume or discard, since {folder} holds 4 finished runs of {whose} study"
    with pytest.raises(ValueError, match=told):
        opened(folder, STUDY | {"seed": seed}, discard=False)
    assert opened(folder, resume=True)[1] == {0}


def test_discarding_is_said(folder):
    for part in (0, 7):
        opened(folder)[0].save(part, ARRAYS)  # each time from the start
    _, finished, said = opened(folder)
    assert finished == set()
    assert said == [f"discarding 2 finished runs in {folder}"]
    assert not list(folder.glob("part-*"))


def test_nothing_to_resume_is_said(folder):
    assert opened(folder, resume=True)[2] == [f"nothing to resume in {folder}: starting with the first run"]


DAMAGE = {
    "emptied": lambda text: "",
    "cut": lambda text: text[:-10],
    "list": lambda text: f'["jaxlocmap study", {text}]',
    "chunk": lambda text: text.replace('"chunk": 4', '"chunk": 200'),
    "true": lambda text: text.replace('"chunk": 4', '"chunk": true'),
    "nested": lambda text: '{"made by": "jaxlocmap study", "x": ' + "[" * 100_000,
    "missing": lambda text: None,
}


def damage(folder, how):
    path = folder / "manifest.json"
    text = DAMAGE[how](path.read_text())
    if text is None:
        path.unlink()
    else:
        path.write_text(text)


@pytest.mark.parametrize("how", DAMAGE)
def test_with_a_damaged_manifest_nothing_is_believed_and_nothing_lost(folder, how):
    for part in (0, 5):
        opened(folder, resume=True)[0].save(part, ARRAYS)
    damage(folder, how)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert at(folder, resume=True).recorded_chunk() is None
    told = rf"got 2 finished parts whose manifest.json is {'missing' if how == 'missing' else 'damaged'}; discard"
    for flags in ({"resume": True}, {"discard": False}):
        with pytest.raises(ValueError, match=told):
            opened(folder, **flags)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    _, finished, said = opened(folder, discard=True)
    assert (finished, said) == (set(), [f"discarding 2 finished parts in {folder}"])
    assert [file.name for file in folder.iterdir()] == ["manifest.json"]


@pytest.mark.parametrize("flags", [{"resume": True}, {"discard": True}, {"discard": False}])
@pytest.mark.parametrize("name", ["manifest.json", "part-000", "part-255"])
def test_a_user_s_own_files_are_refused_and_stay(folder, name, flags):
    folder.mkdir(parents=True)
    (folder / name).write_text('{"name": "my data"}')
    (folder / "part-000.stl").write_text("solid")
    with pytest.raises(ValueError, match=f"got others: {name}; none was touched"):
        opened(folder, **flags)
    assert sorted(file.name for file in folder.iterdir()) == sorted({name, "part-000.stl"})
    assert (folder / name).read_text() == '{"name": "my data"}'


@pytest.mark.parametrize("flags", [{"resume": True}, {"discard": True}, {"discard": False}])
def test_a_file_that_a_good_manifest_does_not_name_is_refused_and_stays(folder, flags):
    opened(folder)  # of 8 parts
    (folder / "part-200").write_text("mine")
    with pytest.raises(ValueError, match="got others: part-200; none was touched"):
        opened(folder, **flags)
    assert (folder / "part-200").read_text() == "mine"


def test_what_is_beside_a_study_s_files_stays_to_the_end(folder):
    """Names that begin as a study's do, in the folder of the report and in its own."""
    names = ["part-list.csv", "part-000.stl", "part-time-job.txt", "manifest.json.bak", "part-200", "manifest.json"]
    folder.mkdir(parents=True)
    for name in names:
        (folder.parent / name).write_text("mine")
    for name in names[:4]:
        (folder / name).write_text("mine")
    parts, *_ = opened(folder)
    parts.save(0, ARRAYS)
    opened(folder, discard=True)
    parts.clear()
    assert sorted(file.name for file in folder.iterdir()) == sorted(names[:4])
    assert all((folder.parent / name).read_text() == "mine" for name in names)


def test_links_in_the_folder_lead_nowhere(folder, tmp_path):
    outside = tmp_path / "outside.txt"
    outside.write_text("mine")
    folder.mkdir(parents=True)
    opened(folder)
    for name in ("part-001", "part-002.writing", ".part-002.writing"):
        (folder / name).symlink_to(outside)
    parts, *_ = opened(folder, resume=True)
    for part in range(8):
        parts.save(part, ARRAYS)
    assert not (folder / "part-001").is_symlink()
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").symlink_to(outside)
    with pytest.raises(ValueError, match=r"got others: manifest\.json; none was touched"):
        opened(folder, discard=True)
    (folder / "manifest.json").unlink()
    (folder / ".lock-0").symlink_to(outside)
    with pytest.raises(OSError, match=r"\.lock-0"):
        opened(folder, discard=True)
    assert outside.read_text() == "mine"


def test_a_folder_that_is_a_link_is_refused(folder, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    folder.parent.mkdir(parents=True)
    folder.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="parts: expected a folder, got a link"):
        opened(folder)
    assert not list((tmp_path / "elsewhere").iterdir())


# --- One study at a time ---


def test_a_second_study_is_refused_while_the_first_works_and_goes_on_after(folder):
    first = at(folder, discard=True)
    first.open(STUDY, range(8))
    first.save(0, ARRAYS)
    told = f"{folder}: expected a folder that no other study uses, got one in use by process {os.getpid()} on "
    for flags in ({"resume": True}, {"discard": True}):
        with pytest.raises(BlockingIOError, match=re.escape(told)):
            opened(folder, **flags)
    first.save(1, ARRAYS)
    first.release()
    assert opened(folder, resume=True)[1] == {0, 1}


@pytest.mark.slow
def test_the_lock_of_a_killed_process_holds_nobody_up(folder, tmp_path):
    (tmp_path / "killed.py").write_text(f"""if 1:
        import os, pathlib, signal
        from jaxlocmap.monte_carlo.checkpoint import Checkpoint
        parts = Checkpoint(pathlib.Path({str(folder.parent)!r}))
        parts.open({STUDY!r}, range(8))
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    status, _, err = ended(start(tmp_path / "killed.py"))
    assert status == -9, err
    assert (folder / ".lock-0").exists()
    assert opened(folder, resume=True)[1] == set()


def test_what_was_being_written_when_the_program_died_is_no_part_and_goes_with_the_study(folder):
    parts, *_ = opened(folder)
    parts.save(0, ARRAYS)
    (folder / ".part-001.0123456789abcdef.writing").write_bytes(the_file(folder, 0).read_bytes()[:9])
    assert opened(folder, resume=True)[1] == {0}
    parts.clear()
    assert not folder.exists()


def test_clearing_leaves_what_is_not_the_study_s(folder):
    parts, *_ = opened(folder)
    parts.save(0, ARRAYS)
    parts.clear()
    assert not folder.exists()
    parts, *_ = opened(folder)
    (folder / "notes.txt").write_text("mine")
    parts.clear()
    assert [file.name for file in folder.iterdir()] == ["notes.txt"]


def test_a_disk_too_full_for_a_lock_is_told_and_locks_nothing(tmp_path):
    path = tmp_path / ".lock-0"
    with full_disk(room=0), pytest.raises(OSError, match=f"File too large: '{path}'"):
        Lock(path)
    assert not path.exists()
    Lock(path).release()


def test_a_full_disk_is_told_and_keeps_what_is_kept(folder):
    parts, *_ = opened(folder)
    parts.save(0, ARRAYS)
    for part in (1, 0):  # a new one, and one that is there
        with full_disk(), pytest.raises(OSError, match=rf"keep part {part} in .*: File too large; 4 finished runs"):
            parts.save(part, ARRAYS)
    assert opened(folder, resume=True)[1] == {0}
    assert sorted(file.name for file in folder.iterdir()) == ["manifest.json", "part-000"]


def test_files_are_forced_to_disk_but_not_more_than_once_a_second(folder, monkeypatch):
    forced, now = [], [100.0]
    monkeypatch.setattr(checkpoint_module.os, "fsync", forced.append)
    monkeypatch.setattr(checkpoint_module.time, "monotonic", lambda: now[0])
    parts, *_ = opened(folder)
    assert len(forced) == 2  # the manifest and its folder
    for part, later in enumerate((0.5, 0.4, 0.2, 0.1)):
        now[0] += later
        parts.save(part, ARRAYS)
    assert len(forced) == 2 + 3 + 1  # by the third part, all three, and their folder


# --- What makes a study what it is ---


def walk(key, scale):
    return jnp.cumsum(jax.random.normal(key, (3,))) * scale


def made(function=walk, key=0, scale=2.0, runs=10):
    key = jax.random.key(key)
    program = jax.jit(function).trace(key, jnp.asarray(scale)).lower().as_text()
    return manifest(Plan(runs, 4), program, key, (jnp.asarray(scale),))


def differing(a, b):
    return {name for name in a if a[name] != b[name]}


def test_every_difference_shows_in_the_manifest():
    def with_constant(offset):
        def walk_from(key, scale):
            return walk(key, scale) + jnp.asarray(offset)

        return made(walk_from)

    assert with_constant(np.zeros(3)) == with_constant(np.zeros(3))
    assert differing(with_constant(np.zeros(3)), with_constant(np.full(3, 1e-5))) == {"program"}
    assert differing(made(), with_constant(np.zeros(3))) == {"program"}
    assert differing(made(), made(key=1)) == {"key"}
    assert differing(made(), made(scale=2.5)) == {"arguments"}
    assert differing(made(), made(runs=11)) == {"runs"}
    assert differing(made(), made(scale=np.ones(1))) == {"arguments", "program"}
    json.dumps(made())


def test_the_user_s_flags_and_what_is_wanted_are_in_the_manifest(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    plain = made()
    assert plain["xla_flags"] == ""
    monkeypatch.setenv("XLA_FLAGS", "--xla_mine=1")
    assert made()["xla_flags"] == "--xla_mine=1"
    assert differing(plain, made()) == {"xla_flags"}
    assert (plain["runs"], plain["chunk"], plain["precision"]) == (10, 4, str(jnp.zeros(()).dtype))
    one, other = (manifest(Plan(1, 1), "", jax.random.key(0), pair) for pair in (((1.0, 2.0)), (2.0, 1.0)))
    assert differing(one, other) == {"arguments"}
    assert manifest(Plan(1, 1), "", jax.random.key(0), (), keep_runs=True)["keep_runs"] is True


def test_a_study_of_sums_does_not_go_on_as_one_of_runs(folder):
    stopped(20, chunk=4, checkpoint=at(folder))
    told = r"^resume: expected the study .* got another: .*keep_runs was False, is True"
    with pytest.raises(ValueError, match=told):
        monte_carlo(walk, KEY, 30, 2.0, checkpoint=at(folder, resume=True), keep_runs=True)


@pytest.mark.slow
def test_the_manifest_is_the_same_in_another_process():
    code = f"""if 1:
        import jax, json, sys
        jax.config.update("jax_enable_x64", {jax.config.jax_enable_x64})
        jax.config.update("jax_num_cpu_devices", 2)
        jax.jit(lambda x: x * 2)(3.0)  # something else before
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        import test_checkpoint
        print(json.dumps(test_checkpoint.made()))
    """
    shared = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # a GPU, where there is one
    done = subprocess.run([sys.executable, "-c", code], env=shared, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == made()


# --- A study that is stopped and goes on ---

KEY = jax.random.key(3)


class Stop(BaseException):
    """What a progress callback may raise to end a study."""


def stopped(at, **kwargs):
    """A study of 30 runs, ended by its progress."""

    def progress(done):
        if done >= at:
            raise Stop

    with pytest.raises(Stop):
        monte_carlo(walk, KEY, 30, 2.0, progress=progress, **kwargs)


@pytest.mark.parametrize("keep_runs", [False, True])
def test_a_stopped_study_goes_on_to_the_same_last_bit(folder, keep_runs):
    kwargs = {"keep_runs": keep_runs, "devices": jax.local_devices()[:1]}
    whole = monte_carlo(walk, KEY, 30, 2.0, chunk=4, **kwargs)
    assert whole.resumed_runs == 0
    stopped(20, chunk=4, checkpoint=at(folder), **kwargs)
    the_file(folder, 1).write_bytes(b"torn")
    done = []
    parts = at(folder, resume=True)
    # The chunk need not be said again.
    result = monte_carlo(walk, KEY, 30, 2.0, checkpoint=parts, progress=done.append, **kwargs)
    np.testing.assert_array_equal(result.value, whole.value)
    assert (result.resumed_runs, result.chunk) == (16, 4)
    assert done == [20, 24, 28, 30]  # part 1, then the last three
    assert parts.runs_kept == 30
    # All is there now, so nothing is computed.
    parts = at(folder, resume=True)
    result = monte_carlo(walk, KEY, 30, 2.0, checkpoint=parts, progress=pytest.fail, **kwargs)
    np.testing.assert_array_equal(result.value, whole.value)
    assert result.resumed_runs == 30


def test_parts_of_many_chunks_go_on_as_well(folder):
    def long(resume=False, **kwargs):
        return monte_carlo(walk, KEY, 1000, 2.0, chunk=1, checkpoint=at(folder, resume=resume), **kwargs)

    whole = monte_carlo(walk, KEY, 1000, 2.0, chunk=1)

    def progress(done):
        if done >= 700:
            raise Stop

    with pytest.raises(Stop):
        long(progress=progress)
    result = long(resume=True)
    # At most the part under way is lost, of 3 or 4 runs.
    assert 696 <= result.resumed_runs <= 700
    np.testing.assert_array_equal(result.value, whole.value)


def test_a_wrong_folder_is_refused_before_anything_is_compiled_or_touched(folder):
    stopped(20, chunk=4, checkpoint=at(folder, {"motion": "arc"}))
    compiles = chunks.compile.cache_info().misses

    def other(key, scale):
        return walk(key, scale) + 1

    with pytest.raises(ValueError, match=r"motion was 'arc', is 'euler'; .*program was '\w+', is '\w+'$"):
        monte_carlo(other, KEY, 30, 2.0, chunk=4, checkpoint=at(folder, {"motion": "euler"}, resume=True))
    with pytest.raises(ValueError, match=r"another: chunk was 4, is 5$"):
        monte_carlo(walk, KEY, 30, 2.0, chunk=5, checkpoint=at(folder, {"motion": "arc"}, resume=True))
    with pytest.raises(ValueError, match=r"another: runs was 30, is 29$"):
        monte_carlo(walk, KEY, 29, 2.0, checkpoint=at(folder, {"motion": "arc"}, resume=True))
    assert len(list(folder.glob("part-*"))) >= 5
    assert chunks.compile.cache_info().misses == compiles


def test_a_study_whose_disk_is_full_ends_and_goes_on_later(folder):
    parts, kwargs = at(folder), {"chunk": 4, "devices": jax.local_devices()[:1]}
    with contextlib.ExitStack() as later:

        def progress(done):
            if done == 12:
                later.enter_context(full_disk())

        with pytest.raises(OSError, match="expected to keep part 3"):
            monte_carlo(walk, KEY, 30, 2.0, checkpoint=parts, progress=progress, **kwargs)
    assert parts.runs_kept == 12
    result = monte_carlo(walk, KEY, 30, 2.0, checkpoint=at(folder, resume=True))
    np.testing.assert_array_equal(result.value, monte_carlo(walk, KEY, 30, 2.0, chunk=4).value)
    assert result.resumed_runs == 12
