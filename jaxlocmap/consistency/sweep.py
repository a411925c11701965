"""A study of every cell of a grid of two parameters: where is the filter consistent, where accurate?

Every cell sees the same random numbers, so that cells differ by their parameters alone.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxlocmap import simulation
from jaxlocmap._internal.batching import sum_over_runs
from jaxlocmap.consistency.study import Study, Totals, summarise
from jaxlocmap.consistency.verdict import readable
from jaxlocmap.parameters import Params
from jaxlocmap.types import Config, Gaussian


class Cell(NamedTuple):
    """What a cell of the grid may change."""

    params: Params
    noise: simulation.Noise


class Swept(NamedTuple):
    """A parameter that can be swept."""

    meaning: str  # on an axis
    says: str  # in a sentence, with a value
    values: tuple[float, ...]  # by default
    wanted: str  # of a value
    allows: Callable[[float], bool]
    enter: Callable[[Cell, jax.Array], Cell]  # puts a value, (), into a cell


def _scale(what: str, symbol: str, factors: np.ndarray, field: str, entry: int | None = None) -> Swept:
    """A scale of a covariance the filter believes in, or of the standard deviation of one of its two entries."""

    def enter(cell: Cell, value: jax.Array) -> Cell:
        covariance = getattr(cell.params, field)
        if entry is None:
            scaled = value * covariance
        else:
            factor = jnp.ones(2, covariance.dtype).at[entry].set(value)
            scaled = factor[:, None] * covariance * factor[None, :]
        return cell._replace(params=cell.params._replace(**{field: scaled}))

    allows = lambda value: 1e-6 <= value <= 1e6  # noqa: E731
    meaning = f"scale of {symbol}, the filter's {what} [–]"
    return Swept(meaning, symbol + " × {}", tuple(factors.tolist()), "a scale in [1e-6, 1e6]", allows, enter)


_SCALES = np.geomspace(1 / 8, 8, 9)
_FIGURES = (
    *("anees", "anees_standard_error", "anees_band_95", "nis_mean", "nis_standard_error", "nis_band_95"),
    *("gate_accept_rate", "rmse_position_m", "rmse_yaw_rad", "diverged_runs", "flagged_steps", "verdict"),
)  # of a study's report, kept of a cell

SWEPT = {
    "Q": _scale("covariance of speed and yaw rate", "Q", _SCALES, "Q"),
    "R": _scale("covariance of range and bearing", "R", _SCALES, "R"),
    "sigma_v": _scale("standard deviation of the speed", "σ_v", _SCALES**0.5, "Q", 0),
    "sigma_w": _scale("standard deviation of the yaw rate", "σ_ω", _SCALES**0.5, "Q", 1),
    "sigma_range": _scale("standard deviation of the range", "σ_range", _SCALES**0.5, "R", 0),
    "sigma_bearing": _scale("standard deviation of the bearing", "σ_bearing", _SCALES**0.5, "R", 1),
    "gate_probability": Swept(
        "gate: share of good observations it should let in [–], 1 is no gate",
        "gate {}",
        (0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 0.9999, 0.99999, 1.0),
        "a probability in (0, 1]",
        lambda value: 0 < value <= 1,
        lambda cell, value: cell._replace(params=cell.params._replace(gate_probability=value)),
    ),
    "outlier_rate": Swept(
        "share of observations that are false [–]",
        "outlier rate {}",
        (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5),
        "a share in [0, 1]",
        lambda value: 0 <= value <= 1,
        lambda cell, value: cell._replace(noise=cell.noise._replace(outlier_rate=value)),
    ),
}


@dataclasses.dataclass(frozen=True)
class SweepStudy:
    """One run of every cell of a grid. Hashable, so `monte_carlo` compiles it once, for any values of the grid."""

    study: Study
    x: str  # names in SWEPT
    y: str

    def __call__(
        self,
        key: jax.Array,
        x: jax.Array,
        y: jax.Array,
        params: Params,
        world: simulation.World,
        noise: simulation.Noise,
        prior: Gaussian,
        **how: Any,
    ) -> Totals:
        """Totals (rows, columns, ...) of the run that `key` stands for: common random numbers, the same for all cells.

        Args:
            x: (columns,). y: (rows,). The rest: as for `Study`, what the cells have in common.
        """

        def cell(x: jax.Array, y: jax.Array) -> Totals:
            here = SWEPT[self.y].enter(SWEPT[self.x].enter(Cell(params, noise), x), y)
            return self.study(key, here.params, world, here.noise, prior, **how)

        # The random numbers do not depend on the cell, so they are drawn once for all of them.
        row = jax.vmap(cell, in_axes=(0, None))
        return jax.vmap(row, in_axes=(None, 0))(x, y)

    def summed(self, key: jax.Array, counted: jax.Array, *args: Any) -> Totals:
        """As `Study.summed`."""
        return self(key, *args, add_up=functools.partial(sum_over_runs, counted=counted))


def judged_cell(totals: Totals, settings: Config) -> dict[str, Any]:
    """The figures of one cell. `misfit` is how far, as a factor's logarithm, ANEES and NIS together are off."""
    report = summarise(totals, settings)
    low, high = report["anees_band_95"]
    off = [
        abs(math.log(report[name] / expected)) if report[name] > 0 else math.inf
        for name, expected in (("anees", 3), ("nis_mean", 2))
    ]
    return {name: report[name] for name in _FIGURES} | {
        "misfit": sum(off),
        "consistent": low <= report["anees"] <= high and not report["diverged_runs"],
    }


def verdict(x: str, y: str, cells: list[dict[str, Any]]) -> str:
    """How many cells are consistent, and which one fits best. Many combinations of Q and R have an ANEES of 3; the
    NIS tells them apart.

    Args:
        x, y: what was swept, names in `SWEPT`.
        cells: as `judged_cell` reports them, each with its values of x and y.
    """
    count = sum(cell["consistent"] for cell in cells)
    best = min(cells, key=lambda cell: (not cell["consistent"], cell["misfit"]))
    where = ", ".join(SWEPT[name].says.format(shown(best[name])) for name in (x, y))
    return (
        f"{count or 'none'} of {len(cells)} cells {'is' if count < 2 else 'are'} consistent; ANEES and NIS together "
        f"fit best at {where}: ANEES {readable(best['anees'], 4)}, NIS {readable(best['nis_mean'], 4)}"
    )


def what_the_gate_buys(other: str, cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each value of the other parameter: the cell of the smallest position RMSE, and that without a gate."""
    rows = []
    for value in dict.fromkeys(cell[other] for cell in cells):
        here = [cell for cell in cells if cell[other] == value]
        without = next((cell for cell in here if cell["gate_probability"] == 1), None)
        rows.append({"value": value, "best": min(here, key=_rmse), "without": without})
    return rows


def _rmse(cell: dict[str, Any]) -> float:
    return cell["rmse_position_m"] if math.isfinite(cell["rmse_position_m"]) else math.inf


def gate_verdict(other: str, rows: list[dict[str, Any]], runs: int) -> str:
    """Where the gate buys most accuracy, in words.

    Args:
        other: what was swept beside the gate.
        rows: of `what_the_gate_buys`.
        runs: in each cell.
    """
    compared = [row for row in rows if row["without"] is not None]
    if not compared:
        return "no gate, which is gate 1, was not swept: nothing to compare with"
    row = max(compared, key=lambda row: _rmse(row["without"]) / _rmse(row["best"]))
    best, without = row["best"], row["without"]
    if best is without:
        return "the gate buys no accuracy here: without one, the position RMSE is smallest everywhere"
    gain = (
        f"position RMSE {_rmse(best):.3g} m with gate {shown(best['gate_probability'])}, {_rmse(without):.3g} m without"
    )
    lost = f"{best['diverged_runs']} of {runs} runs diverged, {without['diverged_runs']} without"
    return f"the gate buys most at {SWEPT[other].says.format(shown(row['value']))}: {gain}; {lost}"


def shown(value: float) -> str:
    """A swept value for people: three digits, more just below one, where a gate needs them."""
    return f"{value:.7g}" if 0.99 < value < 1 else f"{value:.3g}"
