"""What is tuned: named blocks of numbers, each with units and a transform, and the record that holds them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import checks, files
from jaxlocmap._internal.linalg import Matrix, block_diagonal


class Block(NamedTuple):
    """A named block of `Params`, as a motion model or a sensor brings it. Hashable, so static under jit."""

    name: str  # of the entry of `Params`
    components: tuple[str, ...]  # of a covariance, what it is the noise of; of a number, its name again
    units: tuple[str, ...]  # of the components
    kind: str = "covariance"  # or, of a number, "positive", "negative" or "real"

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the entry: (m, m) of a covariance, () of a number."""
        return (len(self.components),) * 2 if self.kind == "covariance" else ()

    @property
    def correlations(self) -> tuple[str, ...]:
        """Names of the correlations of a covariance, row by row below the diagonal: "a_b" of components a and b. One
        component has none, nor has a number.
        """
        pairs = [(i, j) for i in range(len(self.components)) for j in range(i)]
        return tuple(f"{self.components[j]}_{self.components[i]}" for i, j in pairs)


Q = Block("Q", ("v", "w"), ("m/s", "rad/s"))
R = Block("R", ("range", "bearing"), ("m", "rad"))
L_OCC = Block("l_occ", ("l_occ",), ("nats",), "positive")
L_FREE = Block("l_free", ("l_free",), ("nats",), "negative")


class Params(NamedTuple):
    """Everything that is tuned: the noise the filter believes in and the inverse sensor model.

    All leaves are arrays, so a batch of parameters is a `vmap` and a gradient is a `grad`. The filter reads the upper
    triangles of covariances, so a gradient by an off-diagonal entry stands in the upper triangle alone.
    """

    Q: jax.Array | None  # (2, 2) covariance of (v, omega) over one nominal period, (m/s)^2, (rad/s)^2
    R: jax.Array | None  # (2, 2) covariance of (range, bearing), m^2, rad^2
    l_occ: jax.Array  # () log-odds added to a beam's terminal cell, nats, > 0
    l_free: jax.Array  # () log-odds added to every cell a beam crosses, nats, < 0
    gate_probability: jax.Array | float | None = None  # () in (0, 1], 1 for no gate; None: that of `Config`
    blocks: Mapping[str, jax.Array] = {}  # what motion models and sensors bring, by `Block.name`

    @classmethod
    def from_std(
        cls,
        *,
        v: float | None = None,
        w: float | None = None,
        range: float | None = None,
        bearing: float | None = None,
        l_occ: float = 0.85,
        l_free: float = -0.40,
        **blocks: float | Sequence[float],
    ) -> Params:
        """Diagonal covariances from standard deviations.

        Args:
            v, w: m/s, rad/s, of Q; both None for a motion model that has no Q.
            range, bearing: m, rad, of R; both None for a sensor that has no R.
            l_occ, l_free: nats.
            **blocks: the standard deviations of other blocks, by `Block.name`: `gps=(0.5, 0.5)`.

        Raises:
            ValueError: a standard deviation that is not positive and finite, `l_occ <= 0` or `l_free >= 0`.
        """

        def covariance(**std: float | None) -> jax.Array | None:
            if all(value is None for value in std.values()):
                return None
            for name, value in std.items():
                if value is None or not (math.isfinite(value) and value > 0):
                    raise ValueError(f"{name}: expected a positive, finite standard deviation, got {value}")
            return jnp.diag(jnp.array([float(value or 0) ** 2 for value in std.values()]))

        others = {}
        for name, std in blocks.items():
            values = np.atleast_1d(np.asarray(std, float)).tolist()
            others[name] = covariance(**{f"{name}[{i}]" if len(values) > 1 else name: x for i, x in enumerate(values)})
        params = cls(
            Q=covariance(v=v, w=w),
            R=covariance(range=range, bearing=bearing),
            l_occ=jnp.array(float(l_occ)),
            l_free=jnp.array(float(l_free)),
            blocks={name: value for name, value in others.items() if value is not None},
        )
        params.check()
        return params

    def block(self, block: Block) -> jax.Array:
        """The entry of a block.

        Raises:
            ValueError: there is none, or of another shape.
        """
        value = getattr(self, block.name) if block.name in _FIELDS else self.blocks.get(block.name)
        if value is None:
            what = f"covariance of ({', '.join(block.components)})" if block.shape else "number"
            raise ValueError(f"params.{block.name}: expected the {what} {block.shape}, got none (Params.from_std)")
        checks.shape(f"params.{block.name}", value, block.shape)
        return value

    def covariance(self, blocks: tuple[Block, ...]) -> Matrix:
        """The blocks along the diagonal, zero elsewhere.

        Raises:
            ValueError: as `block`.
        """
        return block_diagonal(*(Matrix.symmetric(self.block(block)) for block in blocks))

    def with_block(self, block: Block, value: jax.Array) -> Params:
        """The parameters with another entry for a block."""
        if block.name in _FIELDS:
            return self._replace(**{block.name: value})
        return self._replace(blocks={**self.blocks, block.name: value})

    def check(self) -> None:
        """Raise if a value cannot be used; values that are still being traced pass.

        Raises:
            ValueError: wrong shapes, a covariance not symmetric positive definite, `l_occ` or `l_free`
                not finite or of the wrong sign, a gate's probability outside (0, 1].
        """
        for name, value in (("Q", self.Q), ("R", self.R)):
            if value is not None:
                checks.covariance(name, value, 2, definite=True)
        for name, value, sign in (("l_occ", self.l_occ, 1), ("l_free", self.l_free, -1)):
            checks.shape(name, value, ())
            if checks.is_concrete(value) and not (np.isfinite(value) and sign * float(value) > 0):
                wanted = "> 0" if sign > 0 else "< 0"
                raise ValueError(f"{name}: expected a finite value {wanted} nats, got {value}")
        if (gate := self.gate_probability) is not None:
            checks.shape("gate_probability", gate, ())
            if checks.is_concrete(gate) and not 0 < float(gate) <= 1:
                raise ValueError(f"gate_probability: expected a probability in (0, 1], 1 for no gate, got {gate}")
        for name, value in self.blocks.items():
            if np.ndim(value) == 2:
                checks.covariance(name, value, len(value), definite=True)
            else:
                checks.shape(name, value, ())
                if checks.is_concrete(value) and not np.isfinite(value):
                    raise ValueError(f"{name}: expected a finite number, got {value}")

    def numbers(self) -> dict[str, Any]:
        """The entries by name, as lists and numbers, ready for JSON; the gate's probability only where there is one."""
        entries = {name: getattr(self, name) for name in _FIELDS} | dict(self.blocks)
        if self.gate_probability is not None:
            entries["gate_probability"] = self.gate_probability
        return {name: None if value is None else np.asarray(value).tolist() for name, value in entries.items()}

    def save(self, path: str | Path) -> None:
        """Write `{"Q": ..., "R": ..., "l_occ": ..., "l_free": ...}` and the other blocks by name as JSON."""
        files.write(path, json.dumps(self.numbers(), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Params:
        """Read what `save` wrote. A field that is none of `Params` is a block.

        Raises:
            ValueError: not JSON, a missing or non-numeric field, or a value that `check` refuses; the message starts
                with the path.
        """
        with files.reading(path, f"a JSON object with {_FIELDS}"):
            try:
                fields = json.loads(files.read(path, most=files.SETTINGS))
            except (json.JSONDecodeError, UnicodeDecodeError) as error:
                raise ValueError(f"expected a JSON object with {_FIELDS}: {error}") from None
            if not isinstance(fields, dict) or not set(fields) >= set(_FIELDS):
                got = sorted(fields) if isinstance(fields, dict) else type(fields).__name__
                raise ValueError(f"expected the fields {_FIELDS}, got {got}")
            values = {name: _array(name, value) for name, value in fields.items()}
            own: dict[str, Any] = {name: values.pop(name, None) for name in (*_FIELDS, "gate_probability")}
            params = cls(**own, blocks={name: value for name, value in values.items() if value is not None})
            params.check()
        return params


_FIELDS = ("Q", "R", "l_occ", "l_free")


def _array(name: str, value: object) -> jax.Array | None:
    if value is None and name in ("Q", "R"):
        return None
    array = np.asarray(value)
    if array.dtype.kind not in "if":
        raise ValueError(f"{name}: expected numbers, got {value!r}")
    return jnp.asarray(array.astype(float))
