"""Files of the user's: written whole or not at all, read within limits, and every fault with the file's path."""

from __future__ import annotations

import contextlib
import gzip
import io
import os
import re
import secrets
import zlib
from collections.abc import Iterator
from pathlib import Path

_LIMIT, _MOST_BYTES = "JAXLOCMAP_MAX_BYTES", 2**27  # 128 MiB: the largest public logs have some 100
SETTINGS = 2**16  # bytes, at most, of a file of settings: parsers of such files are slow, and take far more memory
_LONGEST_WORDS = 1000  # characters
_TEMPORARY = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{16}\.writing(?P<suffix>\.[^.]+)?")


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[Path]:
    """A new file beside `path` that takes its place at the end, unless something is raised; then it is removed.

    It has a random name, so that no link or file of somebody else's is in its way. Where `path` is a link, the link is
    replaced, and what it points to stays as it is.

    Yields:
        The path to write to, of the same suffix, in the same folder.

    Raises:
        OSError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.writing{path.suffix}")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    try:
        yield temporary
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None and error.errno:  # as of a full disk
            error.filename = str(path)
        raise


def write(path: str | Path, contents: bytes | str) -> None:
    """Write a whole file, text as UTF-8; a failure leaves what was there.

    Raises:
        OSError: as `writing`.
    """
    with writing(path) as temporary:
        temporary.write_bytes(contents.encode() if isinstance(contents, str) else contents)


def left_behind(folder: Path, name: str) -> list[Path]:
    """What `writing` had begun for a file of that name where the process was killed."""
    found = []
    for file in folder.glob(f".{name}.*"):
        match = _TEMPORARY.fullmatch(file.name)
        if match and match["name"] == name:
            found.append(file)
    return found


def most_bytes() -> int:
    """How many bytes of a file, unpacked, are read at most: what the environment says, 128 MiB by default.

    Raises:
        ValueError: the environment says something that is no number of bytes.
    """
    said = os.environ.get(_LIMIT, str(_MOST_BYTES))
    if not (said.isascii() and said.isdecimal() and int(said[:20]) > 0):
        raise ValueError(f"{_LIMIT}: expected a number of bytes > 0, got {said[:40]!r}")
    return int(said[:20])


def too_large(path: str | Path, what: str = "a file") -> ValueError:
    """The error for what goes beyond the limit."""
    return ValueError(f"{path}: expected {what} of at most {most_bytes():,} bytes, got more; {_LIMIT} raises the limit")


def read(path: str | Path, *, most: int | None = None) -> bytes:
    """The content of a regular file.

    Args:
        path: of the file.
        most: bytes, where a file of its kind is small; else `most_bytes`.

    Raises:
        FileNotFoundError: nothing at `path`. ValueError: a folder or a device, or more than `most`.
    """
    path = Path(path)
    if not path.exists():
        what = "a link to nothing" if path.is_symlink() else "no such file"
        raise FileNotFoundError(f"{path}: {what}")
    if not path.is_file():
        raise ValueError(f"{path}: expected a file, got a folder or a device")
    limit = most or most_bytes()
    with path.open("rb") as stream:
        data = stream.read(limit + 1)
    if len(data) > limit and most:
        raise ValueError(f"{path}: expected a file of at most {most:,} bytes, got more")
    if len(data) > limit:
        raise too_large(path)
    return data


def unzipped(path: str | Path, data: bytes) -> bytes:
    """What is packed in the bytes of a gzip file.

    Raises:
        ValueError: truncated or damaged, or more than `most_bytes`; the message starts with the path.
    """
    limit = most_bytes()
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            content = stream.read(limit + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path}: truncated or damaged gzip: {error}") from None
    if len(content) > limit:
        raise too_large(path, "unpacked content")
    return content


@contextlib.contextmanager
def reading(path: str | Path, what: str) -> Iterator[None]:
    """Whatever goes wrong with the content of a file leaves as a ValueError that starts with its path.

    Args:
        path: of the file. Of a ValueError it is put before the words, unless they start with it, or with that of a file
            below it; and they are cut where they are long. Others, such as a stack that is too deep, say what was
            expected.
        what: is expected of it, for the message.
    """
    try:
        yield
    except OSError:
        raise
    except ValueError as error:
        said = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        if len(said) > (most := len(f"{path}: ") + _LONGEST_WORDS):  # they may quote the file
            said = f"{said[:most]} ..."
        raise ValueError(said) from None
    except Exception as error:  # of whatever kind: of a library that reads pictures, none is foreseen
        raise ValueError(f"{path}: expected {what}, got one that cannot be read: {type(error).__name__}") from error
