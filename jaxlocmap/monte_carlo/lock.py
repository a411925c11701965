"""One study at a time in a folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import json
import os
import socket
import stat
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # not on Windows, where there is no lock then
    fcntl = None


class Lock:
    """A locked file, which says who has it. The system gives it free when the process ends."""

    def __init__(self, path: Path) -> None:
        """Take it.

        Args:
            path: made if need be; in a folder that exists.

        Raises:
            BlockingIOError: another process has it; says which. OSError: it is a link, or cannot be written.
        """
        self.path = path
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                os.close(handle)
                raise OSError(f"{path}: expected a file, got a pipe or a device")
            self._file = os.fdopen(handle, "r+")
            _take(self._file, path)
            if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
                break
            self._file.close()  # the one who had it has removed it
        try:
            self._file.truncate()
            os.write(handle, json.dumps({"process": os.getpid(), "host": socket.gethostname()}).encode())
        except OSError as error:
            self.release()
            error.filename = str(path)  # a full disk names no file
            raise

    def release(self) -> None:
        """Give it free, and remove the file."""
        self.path.unlink(missing_ok=True)
        self._file.close()

    @staticmethod
    def check(path: Path) -> None:
        """Raise where another process has it; touch nothing.

        Raises:
            BlockingIOError: as above.
        """
        if path.is_file() and not path.is_symlink():
            with path.open("r+") as file:
                _take(file, path)


def _take(file: IO[str], path: Path) -> None:
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        try:
            owner = json.loads(file.read(1000))
            who = f"process {int(owner['process'])} on {str(owner['host'])[:100]!r}"
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
            who = "another process"
        finally:
            file.close()
        raise BlockingIOError(
            f"{path.parent}: expected a folder that no other study uses, got one in use by {who}"
        ) from None
