"""A process with all imported that a program imports. Whoever asks it, over the socket at its standard input, for a
program gets a fork that becomes it: a start as from a command line, without the second and more that the imports take.
No backend of JAX starts in here: that could not be forked.

A question is the name of a folder, which holds the program's arguments and environment and gets what it says, and a
pipe that is told its number and, when it has ended, its exit status.
"""

import json
import os
import runpy
import socket
import sys

import jax
import tyro

import jaxlocmap.cli.main  # noqa: F401 to have it imported
from jaxlocmap.cli.compute import ComputeConfig


def become(arguments, environment):
    """The program, with what JAX read of the environment when it was imported."""
    os.environ.clear()
    os.environ.update(environment)
    jax.config.update("jax_compilation_cache_dir", environment.get("JAX_COMPILATION_CACHE_DIR") or None)
    jax.config.update("jax_disable_most_optimizations", environment["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1")
    sys.orig_argv = [sys.executable, *arguments]
    if arguments[0] == "-m":
        sys.argv = arguments[1:]
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = arguments
        runpy.run_path(arguments[0], run_name="__main__")


def keep_watch(program, told):
    """Tell the program's number and, once it has ended, its exit status."""
    os.write(told, program.to_bytes(8))
    os.write(told, os.waitstatus_to_exitcode(os.waitpid(program, 0)[1]).to_bytes(8, signed=True))
    os._exit(0)


def main():
    asked, watches = socket.socket(fileno=os.dup(0)), []
    while True:
        folder, told, *_ = socket.recv_fds(asked, 4096, 1)
        if not folder:
            for watch in watches:
                os.waitpid(watch, 0)
            return
        watches.append(os.fork())
        if not watches[-1]:
            break
        os.close(*told)
    if program := os.fork():
        keep_watch(program, *told)
    os.close(*told)
    asked.close()
    flags = os.O_WRONLY | os.O_CREAT
    for number, (file, how) in enumerate([(os.devnull.encode(), os.O_RDONLY), (b"out", flags), (b"err", flags)]):
        os.dup2(os.open(os.path.join(folder, file), how, 0o600), number)
    with open(os.path.join(folder, b"request")) as request:
        become(*json.load(request))


if __name__ == "__main__":
    tyro.cli(ComputeConfig, args=[])  # which imports more at the first call
    main()
