"""A long scan over time in equal pieces, all of one compiled program, with a call between any two of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def in_pieces(
    turn: Callable[[Any, Any], tuple[Any, Any]],
    state: Any,
    inputs: Any,
    steps: int,
    size: int,
    progress: Callable[[int], None],
) -> tuple[Any, Any]:
    """A scan over time in equal pieces.

    Args:
        turn: (state, inputs of a piece) -> (state, what it reports of each step).
        inputs: of all steps and those that fill up the last piece.
        steps: how many count.
        size: steps of a piece.
        progress: called with the number of steps done so far.

    Returns:
        The last state, and the reports of the steps that count, as NumPy arrays.
    """
    reports = []
    for begin in range(0, steps, size):
        state, report = turn(state, jax.tree.map(lambda x, begin=begin: x[begin : begin + size], inputs))
        reports.append(jax.tree.map(np.asarray, report))
        progress(min(begin + size, steps))
    return state, jax.tree.map(lambda *pieces: np.concatenate(pieces)[:steps], *reports)
