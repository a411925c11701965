"""Where the beams of a laser scanner point, from what a log says of its fan."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

_FIT = 0.1  # of the spacing: how far a stated one may be off for rounding
_NEAR = 0.25  # of a beam, or of a degree: the same number but for rounding
_TURN = 2 * math.pi * (1 + 1e-3)  # rad, with room for rounding in a log


class Fan(NamedTuple):
    """What is said of a scanner; None where nothing is."""

    beams: int
    fov: float | None = None  # rad, from the first edge to the last
    spacing: float | None = None  # rad between neighbouring beams
    start: float | None = None  # rad, the first beam in the scanner's frame; else the fan is symmetric
    max_range: float = math.inf  # m, a range at or beyond means no return


def check_fov(name: str, value: float) -> None:
    """Raise unless `value` is an angle in (0, 2 pi].

    Raises:
        ValueError: it is not; the message starts with `name`.
    """
    if not 0 < value <= _TURN:
        raise ValueError(f"{name}: expected an angle in (0, 2 pi] rad, got {value}")


def fits(fan: Fan) -> bool:
    """Whether field of view, spacing and number of beams agree, as far as they are said."""
    if fan.fov is None or fan.spacing is None:
        return True
    return min(abs(fan.fov / gaps / fan.spacing - 1) for gaps in (fan.beams - 1, fan.beams)) < _FIT


def directions(fan: Fan) -> np.ndarray:
    """Angle of each beam, counter-clockwise: beam k at start + k spacing.

    A field of view is divided into n - 1 spacings, both edges having a beam, or into n where the last edge has
    none: whichever fits the stated spacing. Where none is stated the last edge is left out by 1 or 2 beams a
    degree exactly (180 beams over 180 degrees, not 181) and by a whole turn, whose edges are one. A spacing
    without field of view leaves the last edge out where n of them are a multiple of 90 degrees.

    Args:
        fan: with `fov` or `spacing`.

    Returns:
        (beams,) rad in the scanner's frame.

    Raises:
        ValueError: field of view, spacing and number of beams do not fit, or span more than a turn.
    """
    n, fov, spacing = fan.beams, fan.fov, fan.spacing
    if fov is None:
        assert spacing is not None
        quarters = n * spacing / (math.pi / 2)
        gaps = n if round(quarters) > 0 and abs(quarters - round(quarters)) < _NEAR * spacing else n - 1
        fov = gaps * spacing
    elif spacing is None:
        degrees = math.degrees(fov)
        whole_turn = abs(degrees - 360) < _NEAR and (n - 1) % 360 != 0
        gaps = n if whole_turn or any(abs(n - each * degrees) < _NEAR for each in (1, 2)) else n - 1
    else:
        if not fits(fan):
            raise ValueError(
                f"beam angles: {n} beams {math.degrees(spacing):g} degrees apart do not span a field of view of "
                f"{math.degrees(fov):g}: the log contradicts itself, expected the true one from the user"
            )
        gaps = min(n - 1, n, key=lambda gaps: abs(fov / gaps - spacing))
    if fov > _TURN:
        raise ValueError(
            f"beam angles: {n} beams {math.degrees(fov / gaps):g} degrees apart span {math.degrees(fov):g}, more "
            f"than a turn: expected the true field of view from the user"
        )
    start = -fov / 2 if fan.start is None else fan.start
    return start + np.arange(n) * fov / gaps
