"""The command `jaxlocmap`: its help, its mistakes, and its compiled programs on disk."""

import importlib
import importlib.util
import re
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest
from programs import ON_CPU, ROOT, WALKS, ended, start

from jaxlocmap import plotting
from jaxlocmap.cli import command, compilation
from jaxlocmap.cli.main import JOBS

pytestmark = pytest.mark.usefixtures("as_a_program")


def said_by(capsys, monkeypatch, *words):
    """Exit status and output of the command, of which it is known that it ends before it computes."""
    monkeypatch.setattr(sys, "argv", ["jaxlocmap", *words])
    with pytest.raises(SystemExit) as end:
        command.command_line(JOBS, "jaxlocmap", "What it is.")
    return end.value.code, "".join(capsys.readouterr())


def test_the_help_has_a_line_for_every_job(capsys, monkeypatch):
    status, said = said_by(capsys, monkeypatch, "--help")
    assert status == 0
    for job in JOBS:
        assert re.search(rf"• {job}\b", said)
    assert "What it is." in said


@pytest.mark.parametrize("job", JOBS)
def test_the_help_of_a_job(capsys, monkeypatch, job):
    status, said = said_by(capsys, monkeypatch, job, "--help")
    assert status == 0
    for option in ("--out", "--seed", "--quick", "--no-cache", "--traceback"):
        assert option in said


@pytest.mark.parametrize("words", [(), ("fly",), ("study", "--moon", "1")])
def test_what_is_no_command_is_refused(capsys, monkeypatch, words):
    status, said = said_by(capsys, monkeypatch, *words)
    assert status == 2
    assert "Traceback" not in said


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_can_complete_it(capsys, monkeypatch, shell):
    status, said = said_by(capsys, monkeypatch, "--tyro-print-completion", shell)
    assert status in (0, None)
    assert all(job in said for job in JOBS)


def test_the_help_of_a_job_says_all_that_its_module_does(capsys, monkeypatch):
    assert "--no-closure" in said_by(capsys, monkeypatch, "slam", "--help")[1].partition("options")[0]
    assert "what the gate buys" not in " ".join(said_by(capsys, monkeypatch, "--help")[1].split())
    assert "what the gate buys" in " ".join(said_by(capsys, monkeypatch, "sweep", "--help")[1].split())


@pytest.mark.parametrize(
    ("former", "job"), [("consistency", "study"), ("localize", "localize"), ("map_log", "map"), ("tune", "tune")]
)
def test_a_former_name_is_the_job(capsys, monkeypatch, former, job):
    monkeypatch.setattr(sys, "argv", [f"{former}.py", "--help"])
    with pytest.raises(SystemExit):
        runpy.run_path(str(ROOT / "experiments" / f"{former}.py"), run_name="__main__")
    assert f"usage: jaxlocmap {job} " in capsys.readouterr().out


def test_an_error_is_one_line_unless_more_is_asked_for(capsys, monkeypatch, tmp_path):
    def leave(status, words):
        print(words, file=sys.stderr)
        sys.exit(status)

    monkeypatch.setattr(command, "_leave", leave)
    words = ("study", "--gate", "2", "--no-cache", "--out", str(tmp_path))
    status, said = said_by(capsys, monkeypatch, *words)
    line = "error: gate: expected a probability inside (0, 1), or None for no gate, got 2.0\n"
    assert (status, said) == (1, line)
    status, said = said_by(capsys, monkeypatch, *words, "--traceback")
    assert status == 1
    assert said.endswith(line)
    assert "in check_gate" in said


@pytest.fixture(scope="module")
def bare():
    """What happens where the library is alone: it is imported, and then the command asked for."""
    code = """if 1:
        import sys
        for name in ("tyro", "matplotlib", "scipy.optimize", "scipy.sparse"):
            sys.modules[name] = None
        import jaxlocmap, jaxlocmap.replay
        print("imported")
        from jaxlocmap.__main__ import main
        main()
    """
    return subprocess.run([sys.executable, "-c", code], env=ON_CPU, capture_output=True, text=True, check=False)


def test_without_its_extra_the_command_says_what_to_install(bare):
    assert (bare.returncode, bare.stderr) == (
        1,
        "error: tyro is not installed: expected pip install 'jaxlocmap[cli]'\n",
    )


def test_the_library_needs_no_matplotlib_but_for_figures(bare, monkeypatch):
    """Nor, until they are used, the parts of SciPy that take long to import."""
    assert bare.stdout == "imported\n"
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        ModuleNotFoundError, match=r"matplotlib is not installed: expected pip install 'jaxlocmap\[plot"
    ):
        importlib.reload(plotting)


# --- Compiled programs


def walks(tmp_path, *arguments, **where):
    """How many programs a start found compiled, of how many, and what it said."""
    status, said, err = ended(start(WALKS, "--out", tmp_path, "--discard", *arguments, **where))
    assert status == 0, err
    counted = re.search(r"(\d+) of (\d+) programs for the processor were compiled before", said)
    return (*map(int, counted.groups()), said) if counted else (0, 0, said)


def test_a_second_start_compiles_nothing(tmp_path):
    """Nor does the one after a start that was killed while it wrote a program."""
    where = {"JAX_COMPILATION_CACHE_DIR": "", "XDG_CACHE_HOME": str(tmp_path)}
    kept, programs, said = walks(tmp_path, **where)
    assert kept < programs
    (folder,) = (tmp_path / "jaxlocmap").iterdir()
    assert str(folder) in said
    assert walks(tmp_path, **where)[:2] == (programs, programs)
    largest = max(folder.glob("*-cache"), key=lambda file: file.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:100])
    largest.with_name(largest.name.replace("-cache", "-atime")).unlink()
    assert walks(tmp_path, **where)[:2] == (programs - 1, programs)
    assert walks(tmp_path, **where)[:2] == (programs, programs)


def test_a_folder_of_the_user_s_is_used_unless_told_not_to(tmp_path):
    where = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine")}
    assert str(tmp_path / "mine") in walks(tmp_path, **where)[2]
    files = sorted((tmp_path / "mine").iterdir())
    assert files
    assert "compiled before" not in walks(tmp_path, "--no-cache", "--seed", 5, **where)[2]
    assert sorted((tmp_path / "mine").iterdir()) == files


@pytest.fixture
def settings(monkeypatch):
    """What JAX would be told."""
    told = {}
    monkeypatch.setattr(jax.config, "update", lambda name, value: told.update({name: value}))
    monkeypatch.setattr(compilation, "folder_in_use", lambda: told.get("jax_compilation_cache_dir"))
    return told


def test_programs_are_kept_by_jax_and_processor(monkeypatch, settings, tmp_path):
    monkeypatch.setattr(compilation.platformdirs, "user_cache_path", lambda name: tmp_path / name)
    compilation.keep_on_disk()
    first = settings["jax_compilation_cache_dir"]
    assert first.startswith(str(tmp_path / "jaxlocmap" / f"jax-{jax.__version__}-"))
    assert settings["jax_persistent_cache_min_compile_time_secs"] == 0
    assert settings["jax_compilation_cache_max_size"] == 2**28
    other = tmp_path / "cpuinfo"
    other.write_text("model name : another\nflags : none\nbogomips : 1\n")
    monkeypatch.setattr(compilation, "_CPUINFO", other)
    settings.clear()
    compilation.keep_on_disk()
    second = settings["jax_compilation_cache_dir"]
    other.write_text(other.read_text().replace("bogomips : 1", "bogomips : 2"))
    settings.clear()
    compilation.keep_on_disk()
    assert settings["jax_compilation_cache_dir"] == second != first


def homeless(name):
    raise RuntimeError("Could not determine home directory.")


@pytest.mark.parametrize("where", [lambda name: Path(__file__) / name, homeless], ids=["a file", "no home"])
def test_a_folder_that_cannot_be_made_is_no_error(monkeypatch, settings, where):
    monkeypatch.setattr(compilation.platformdirs, "user_cache_path", where)
    compilation.keep_on_disk()
    assert "jax_compilation_cache_dir" not in settings


def test_a_folder_of_the_user_s_stays(settings):
    settings["jax_compilation_cache_dir"] = "mine"
    compilation.keep_on_disk()
    assert settings["jax_compilation_cache_dir"] == "mine"
    assert "jax_compilation_cache_max_size" not in settings


def test_time_inside_other_time_counts_once():
    spent, trace = compilation.Spent(), "/jax/core/compile/jaxpr_trace_duration"
    for begin, end in ((1.0, 2.0), (2.5, 3.0), (0.5, 4.0), (5.0, 5.5)):  # an inner one ends before its outer one
        spent.on_span(trace, begin, end, fun_name="f")
    spent.on_span("/jax/core/compile/backend_compile_duration", 6.0, 8.0)
    spent.on_span("/jax/something/else", 0.0, 99.0)
    spent.on_event("/jax/compilation_cache/cache_hits")
    assert spent.seconds() == {"tracing": 4.0, "lowering": 0, "compiling": 2.0}
    assert (spent.programs, spent.kept) == (1, 1)


def test_what_is_watched_is_jax_s_own(monkeypatch):
    with compilation.watched() as spent:
        jax.jit(lambda x: x * SimpleNamespace(two=2).two + 1)(1.0)
    assert spent.programs >= 1
    assert spent.seconds()["compiling"] > 0
    before = spent.programs
    jax.jit(lambda x: x * 3 + 1)(1.0)
    assert spent.programs == before
