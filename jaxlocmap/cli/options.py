"""Options that several programs have, checked."""

from __future__ import annotations

import math
from pathlib import Path

from jaxlocmap import Params


def check_gate(gate: float | None, name: str = "gate") -> None:
    """Raise unless this is what a gate can let in.

    Raises:
        ValueError: no probability inside (0, 1).
    """
    if gate is not None and not 0 < gate < 1:
        raise ValueError(f"{name}: expected a probability inside (0, 1), or None for no gate, got {gate}")


def params_or(path: Path | None, default: Params) -> Params:
    """The parameters in a file, or the default."""
    return default if path is None else Params.load(path)


def in_radians(fov: float | None) -> float | None:
    """The option of that name, degrees, as the readers take it.

    Raises:
        ValueError: out of its range.
    """
    if fov is not None and not 0 < fov <= 360:
        raise ValueError(f"fov: expected degrees in (0, 360], got {fov}")
    return None if fov is None else math.radians(fov)
