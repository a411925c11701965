"""From the command line to a program: its settings, what it says when it fails, and its compiled code on disk."""

from __future__ import annotations

import dataclasses
import gc
import os
import sys
import threading
import traceback
import typing
from collections.abc import Callable, Mapping
from typing import Annotated, Any, NoReturn

import jax
import tyro

from jaxlocmap.cli import compilation
from jaxlocmap.cli.console import CONSOLE

_GC = 50_000, 20, 50  # tracing makes many small objects, which are not garbage: a quarter of its time by default
Program = Callable[[Any], Any]  # of one argument, `config`, whose annotation is a dataclass of settings


@dataclasses.dataclass(frozen=True)
class Common:
    """What every program has."""

    cache: bool = True
    """Keep compiled programs on disk, so that the next start need not compile them."""
    traceback: bool = False
    """Of an error, show where it was raised as well."""


def command_line(
    programs: Program | Mapping[str, Program], name: str | None = None, description: str | None = None
) -> None:
    """Read settings from the command line and run the program; a mistake of the user's is one line, not a traceback.

    Args:
        programs: one, or several by the word that chooses among them.
        name, description: as the help has them; by default the file's name and its docstring.
    """
    options, program = _parsed(programs, name, description)
    gc.set_threshold(*_GC)
    try:
        compilation.keep_on_disk(options.cache)
        with compilation.watched() as spent:
            program()
        CONSOLE.print(spent.words(), soft_wrap=True)
    except (ValueError, TypeError, OverflowError, OSError) as error:
        if options.traceback:
            traceback.print_exc()
        _leave(1, f"error: {error}")
    except KeyboardInterrupt as stop:
        _leave(130, "; ".join(["stopped", *map(str, stop.args)]))


def _parsed(
    programs: Program | Mapping[str, Program], name: str | None, description: str | None
) -> tuple[Common, Callable[[], Any]]:
    one = callable(programs)
    by_settings = {settings_of(program): program for program in ([programs] if one else programs.values())}
    if one:
        wanted: Any = settings_of(programs)
        description = description or sys.modules[programs.__module__].__doc__
    else:
        words = tuple(
            Annotated[settings_of(p), tyro.conf.subcommand(word, description=_description(word, p))]
            for word, p in programs.items()
        )
        wanted = typing.Union[words]  # noqa: UP007 of as many as there are
    common = ("common", Annotated[Common, tyro.conf.arg(name="")], dataclasses.field(default_factory=Common))
    command = dataclasses.make_dataclass("Command", [("settings", wanted), common])
    markers = (tyro.conf.CascadeSubcommandArgs, tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)
    parsed: Any = tyro.cli(command, prog=name, description=description, config=markers)
    return parsed.common, lambda: by_settings[type(parsed.settings)](parsed.settings)


def _description(word: str, program: Program) -> str | None:
    """A line among others; of the job that is asked for, all that its module says."""
    return sys.modules[program.__module__].__doc__ if word in sys.argv else settings_of(program).__doc__


def settings_of(program: Program) -> type:
    """The dataclass of a program's settings."""
    return typing.get_type_hints(program)["config"]


def _leave(status: int, last_words: str) -> NoReturn:
    print(last_words, file=sys.stderr, flush=True)
    if jax.distributed.is_initialized() or threading.active_count() > 1:
        os._exit(status)  # JAX would wait minutes for the other processes, or crash under a thread that does
    sys.exit(status)
