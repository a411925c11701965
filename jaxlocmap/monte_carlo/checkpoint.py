"""A study's finished parts on disk, so that it can go on after any kind of end."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlocmap import files
from jaxlocmap.monte_carlo.lock import Lock
from jaxlocmap.monte_carlo.plan import MOST_PARTS, Plan, digest

_SYNC_EVERY = 1.0  # s; forcing a file to disk takes milliseconds, a quick study's part less
_FOLDER, _MANIFEST = "parts", "manifest.json"
_LARGEST_MANIFEST = 2**20  # bytes
_LOCK = ".lock-"  # and the number of the process
_MARK = "jaxlocmap study"  # what a manifest is known by
_PART_MARK = b"jaxlocmap part\n"  # and the file of a part


class Checkpoint:
    """Where a study keeps its finished parts: a folder `parts` of its own, in the folder of its report.

    A part's file is written under another name and then renamed, so it is there whole or not at all. Its checksum
    spans its numbers, its place and its study: a file that is damaged or from elsewhere is told, and its part done
    again. Once a second all files written since are forced to disk, so a power cut costs little more than a second.
    Nothing is overwritten or removed but what a manifest of a study names.
    """

    def __init__(
        self,
        folder: Path | str,
        settings: Mapping[str, Any] | None = None,
        *,
        resume: bool = False,
        discard: bool = False,
        say: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        """Nothing is touched before a study starts.

        Args:
            folder: in which `parts` is made, and may hold whatever else. Several processes of one study may share it or
                have one each.
            settings: plain values by name that the study was asked for; to go on, they must be the same.
            resume: go on with the parts that are there.
            discard: start anew where there are any.
            say: called with a sentence on what is found, discarded or damaged.
        """
        self.folder: Path = Path(folder) / _FOLDER
        self.settings: dict[str, Any] = dict(settings or {})
        self.say: Callable[[str], None] = say
        self.resume: bool = resume
        self.discard: bool = discard
        self.runs_kept: int = 0  # in this process's parts
        self._manifest: dict[str, Any] = {}
        self._lock: Lock | None = None
        self._synced, self._unsynced = -math.inf, list[Path]()

    def recorded_chunk(self) -> int | None:
        """The chunk of the study that is to go on, if there is one."""
        return (self._found() or {}).get("chunk") if self.resume else None

    def check(self, manifest: Mapping[str, Any]) -> None:
        """See whether a study could go on here, and touch nothing.

        Args:
            manifest: of the study, from the function of that name.

        Raises:
            ValueError: it should go on, but the folder belongs to another study, every difference of which is named,
                or its manifest is damaged or missing. Or it should neither go on nor discard what is there, and
                something is. Or what is there is not a study's.
            BlockingIOError: another study is working there.
        """
        if self.folder.is_symlink():
            raise ValueError(f"parts: expected a folder, got a link: {self.folder}")
        if self._lock is None:
            Lock.check(self._lock_file())
        found, asked = self._found(), self._asked(manifest)
        self._check_foreign(found)
        if found is None:
            self._check_damage()
            return
        if not (self.resume or self.discard) and (runs := self._runs_there(found)):
            whose = "this" if found == asked else "another"
            raise ValueError(
                f"parts: expected resume or discard, since {self.folder} holds {runs:,} finished runs of {whose} study"
            )
        if self.resume and found != asked:
            names = [name for name in {**found, **asked} if found.get(name) != asked.get(name)]
            differences = "; ".join(f"{name} was {found.get(name)!r}, is {asked.get(name)!r}" for name in names)
            raise ValueError(f"resume: expected the study that {self.folder} belongs to, got another: {differences}")

    def _check_foreign(self, found: Mapping[str, Any] | None) -> None:
        """Raise where a file stands in a study's way that neither its manifest names nor a study has written."""
        named, manifest = self._named(found), self.folder / _MANIFEST
        foreign = [file for file in self._part_files() if not ((file in named and file.is_file()) or _is_part(file))]
        if found is None and manifest.exists() and not _may_be_manifest(manifest):
            foreign.append(manifest)
        if foreign:
            names = ", ".join(file.name for file in foreign[:3])
            raise ValueError(f"parts: expected a study's files in {self.folder}, got others: {names}; none was touched")

    def _check_damage(self) -> None:
        """Raise where there is no manifest to go by and something that may be lost."""
        there, manifest = self._part_files(), self.folder / _MANIFEST
        if (there or manifest.exists()) and not self.discard:
            what = "damaged" if manifest.exists() else "missing"
            raise ValueError(
                f"parts: expected a study to go on with in {self.folder}, got {len(there)} finished parts whose "
                f"{_MANIFEST} is {what}; discard starts anew"
            )

    def open(self, manifest: Mapping[str, Any], parts: Iterable[int]) -> set[int]:
        """Make the folder ready for a study.

        Args:
            manifest: of the study.
            parts: numbers of those this process works on.

        Returns:
            Those of `parts` that are finished and undamaged.

        Raises:
            ValueError, BlockingIOError: as `check`. OSError: the folder cannot be read or written.
        """
        self.check(manifest)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = self._lock or Lock(self._lock_file())
        found, asked = self._found(), self._asked(manifest)
        if not self.resume or found is None:
            self._discard(found)
            self._write(
                _MANIFEST, json.dumps({"made by": _MARK, "digest": _own_digest(asked), **asked}, indent=1).encode()
            )
        self._manifest = asked
        whole = {part for part in parts if self._is_whole(part)}
        self.runs_kept = sum(map(self._plan(asked).runs_of, whole))
        return whole

    def save(self, part: int, arrays: Sequence[np.ndarray]) -> None:
        """Keep a finished part.

        Raises:
            OSError: it cannot be written, as on a full disk; what was kept before stays.
        """
        contents = io.BytesIO()
        for array in arrays:
            np.lib.format.write_array(contents, np.asarray(array), allow_pickle=False)
        try:
            self._write(_name(part), _PART_MARK + self._checksum(part, contents.getvalue()) + contents.getvalue())
        except OSError as error:
            raise OSError(
                f"parts: expected to keep part {part} in {self.folder}, got: {error.strerror}; "
                f"{self.runs_kept} finished runs are kept there"
            ) from error
        self.runs_kept += self._plan(self._manifest).runs_of(part)

    def load(self, part: int) -> tuple[np.ndarray, ...]:
        """The arrays of a finished part.

        Raises:
            OSError: there is none. ValueError: it is damaged, or not of this study.
        """
        file = self.folder / _name(part)
        whole = file.read_bytes() if file.is_file() or not file.exists() else b""  # a pipe would be waited for
        begin = len(_PART_MARK) + hashlib.sha256().digest_size
        contents = whole[begin:]
        if whole[:begin] != _PART_MARK + self._checksum(part, contents):
            raise ValueError(f"parts: expected part {part} of this study in {self.folder}, got a damaged file")
        stream, arrays = io.BytesIO(contents), []
        while stream.tell() < len(contents):
            arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
        return tuple(arrays)

    def release(self) -> None:
        """Let another study work in the folder; what is kept stays."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None

    def clear(self) -> None:
        """Remove what is kept, and the folder if nothing else is in it: for when the study's report is written.

        Raises:
            BlockingIOError: another study has begun to work there.
        """
        found = self._found()
        if found is not None:
            self._lock = self._lock or Lock(self._lock_file())
            self._remove([*self._named(found), self.folder / _MANIFEST])
            self.release()
            for file in self.folder.glob(f"{_LOCK}*"):  # of processes that were killed
                with contextlib.suppress(OSError):
                    Lock(file).release()
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _remove(self, files_of_study: Iterable[Path]) -> None:
        for file in files_of_study:
            for path in (file, *files.left_behind(self.folder, file.name)):
                path.unlink(missing_ok=True)
        self._unsynced = []

    def _lock_file(self) -> Path:
        return self.folder / f"{_LOCK}{jax.process_index()}"

    def _found(self) -> dict[str, Any] | None:
        """The manifest in the folder; None if there is none, or none that can be believed."""
        try:
            found = json.loads(files.read(self.folder / _MANIFEST, most=_LARGEST_MANIFEST))
            if found.pop("made by") == _MARK and found.pop("digest") == _own_digest(found):
                return found if all(type(found[name]) is int and found[name] > 0 for name in Plan._fields) else None
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            pass
        return None

    def _asked(self, manifest: Mapping[str, Any]) -> dict[str, Any]:
        return json.loads(json.dumps({**self.settings, **manifest}))  # as it will be read again

    @staticmethod
    def _plan(manifest: Mapping[str, Any]) -> Plan:
        return Plan(manifest["runs"], manifest["chunk"])

    def _discard(self, found: dict[str, Any] | None) -> None:
        if self.resume:
            self.say(f"nothing to resume in {self.folder}: starting with the first run")
        elif found is not None and (runs := self._runs_there(found)):
            self.say(f"discarding {runs:,} finished runs in {self.folder}")
        elif found is None and (parts := self._part_files()):
            self.say(f"discarding {len(parts):,} finished parts in {self.folder}")
        self._remove([*self._part_files(), *self._named(found), self.folder / _MANIFEST])

    def _named(self, manifest: Mapping[str, Any] | None) -> list[Path]:
        """The files of all parts of a study, there or not; none without a manifest."""
        return [] if manifest is None else [self.folder / _name(part) for part in range(self._plan(manifest).parts)]

    def _part_files(self) -> list[Path]:
        """Files that are named like parts."""
        return [file for part in range(MOST_PARTS) if (file := self.folder / _name(part)).exists()]

    def _runs_there(self, manifest: Mapping[str, Any]) -> int:
        plan = self._plan(manifest)
        return sum(plan.runs_of(part) for part in range(plan.parts) if (self.folder / _name(part)).exists())

    def _is_whole(self, part: int) -> bool:
        try:
            self.load(part)
        except FileNotFoundError:
            return False
        except ValueError:
            self.say(f"part {part} in {self.folder} is damaged: its runs are done again")
            return False
        return True

    def _checksum(self, part: int, contents: bytes) -> bytes:
        study = json.dumps(self._manifest, sort_keys=True).encode()
        return hashlib.sha256(hashlib.sha256(study).digest() + part.to_bytes(4, "little") + contents).digest()

    def _write(self, name: str, contents: bytes) -> None:
        """All of it or nothing, whenever the program or the machine dies."""
        sync = time.monotonic() > self._synced + _SYNC_EVERY
        with files.writing(self.folder / name) as temporary:
            temporary.write_bytes(contents)
            if sync:
                for path in (*self._unsynced, temporary):
                    _sync(path)
        if sync:
            with contextlib.suppress(OSError):  # not every file system lets folders be forced to disk
                _sync(self.folder)
            self._synced, self._unsynced = time.monotonic(), []
        else:
            self._unsynced.append(self.folder / name)


def _name(part: int) -> str:
    return f"part-{part:03d}"


def _own_digest(study: Mapping[str, Any]) -> str:
    return digest(json.dumps(study, sort_keys=True).encode())


def _is_part(file: Path) -> bool:
    """Whether this is a part's file, damaged or not; an empty one holds nothing that could be lost."""
    return _begin(file, len(_PART_MARK)) in (_PART_MARK, b"")


def _may_be_manifest(file: Path) -> bool:
    """Whether this may be what is left of a study's manifest."""
    begin = _begin(file, 1000)
    return begin == b"" or (begin is not None and _MARK.encode() in begin)


def _begin(file: Path, count: int) -> bytes | None:
    """The first bytes of a file; None of a folder, or of a pipe, which would be waited for."""
    if not file.is_file():
        return None
    with file.open("rb") as stream:
        return stream.read(count)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
