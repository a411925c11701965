"""How a study is divided into chunks and parts, and what makes it the same study again."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

MOST_PARTS = 256  # at most: so little of a long study is lost when it dies


class Plan(NamedTuple):
    """A study in chunks, and its chunks in at most 256 parts of (nearly) equal size. No machine plays a role."""

    runs: int
    chunk: int  # runs

    @property
    def chunks(self) -> int:
        """How many; the last may be cut short by the end of the study."""
        return -(-self.runs // self.chunk)

    @property
    def parts(self) -> int:
        """How many."""
        return min(self.chunks, MOST_PARTS)

    def chunks_of(self, part: int) -> range:
        """The chunks of a part."""
        return range(self.chunks * part // self.parts, self.chunks * (part + 1) // self.parts)

    def runs_in(self, chunks: range) -> int:
        """How many runs are in consecutive chunks."""
        return min(chunks.stop * self.chunk, self.runs) - chunks.start * self.chunk

    def runs_of(self, part: int) -> int:
        """How many runs are in a part."""
        return self.runs_in(self.chunks_of(part))


def manifest(plan: Plan, program: str, key: jax.Array, args: Any, **others: Any) -> dict[str, Any]:
    """What makes a study what it is, in plain values by name: with the same manifest, parts are the same.

    Args:
        plan: how the runs are divided.
        program: of `chunks.lowered_text`.
        key, args: of the study.
        **others: what else must be the same.
    """
    sources = sorted(Path(__file__).parents[1].rglob("*.py"))
    return {
        **plan._asdict(),
        **others,
        "key": f"{key.dtype} {jax.random.key_data(key).tolist()}",
        "arguments": digest(*(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(args))),
        "program": digest(program.encode()),
        "precision": str(jax.dtypes.canonicalize_dtype(float)),
        "jax": f"{jax.__version__}, jaxlib {importlib.metadata.version('jaxlib')}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "jaxlocmap": f"{_version()} {digest(*(source.read_bytes() for source in sources))}",
    }


def _version() -> str:
    try:
        return importlib.metadata.version("jaxlocmap")
    except importlib.metadata.PackageNotFoundError:  # used from its sources
        return "not installed"


def digest(*contents: bytes) -> str:
    """A short fingerprint of some bytes."""
    return hashlib.sha256(b"".join(hashlib.sha256(content).digest() for content in contents)).hexdigest()[:16]
