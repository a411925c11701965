"""The fields of a report that hold what is known of a pose's covariance, ready for JSON."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxlocmap.consistency.means import Mean, mean_over_time
from jaxlocmap.consistency.statistics import COVERAGE_LEVELS

AXES = ("x", "y", "yaw")


class PoseMeans(NamedTuple):
    """Means of the pose's statistics, over runs or over the steps of one."""

    nees: Mean  # 3 expected
    undiverged_nees: Mean  # the same of the runs that have not diverged, as are axes and phases
    axis_nees: tuple[Mean, ...]  # x, y, yaw: error² / σ², 1 expected
    within_two_sigma: tuple[Mean, ...]  # x, y, yaw: 0.954 expected
    covered: tuple[Mean, ...]  # one for each of `COVERAGE_LEVELS`
    phases: tuple[Mean, ...]  # NEES of equal parts of the drive
    phase_spans: tuple[tuple[float, float], ...]  # s, from and to, of each of them


def pose_fields(means: PoseMeans) -> dict[str, Any]:
    """The fields of a report that hold what is known of the pose's covariance.

    `x_interval_95` is a 95 % interval around the measured x, `anees_band_95` where the ANEES may lie if the filter is
    consistent.
    """
    nees = means.nees
    return {
        "anees": nees.value,
        "anees_standard_error": nees.standard_error,
        "anees_band_95": nees.band_95,
        "anees_interval_95": nees.interval_95,
        "independent_samples": nees.samples,
        "nees_phases": [
            {"from_s": begin, "to_s": end, "anees": phase.value, "band_95": phase.band_95}
            for (begin, end), phase in zip(means.phase_spans, means.phases, strict=True)
        ],
        # Where one axis is claimed too well and another too badly, the NEES of all three can look right.
        # Phases and axes are those of undiverged runs: a single lost one would outweigh the others.
        "axis_nees": _by_axis(means.axis_nees, "value"),
        "axis_nees_interval_95": _by_axis(means.axis_nees, "interval_95"),
        "within_two_sigma": _by_axis(means.within_two_sigma, "value"),
        "within_two_sigma_interval_95": _by_axis(means.within_two_sigma, "interval_95"),
        **{f"coverage_{_percent(p)}": m.value for p, m in zip(COVERAGE_LEVELS, means.covered, strict=True)},
        **{
            f"coverage_{_percent(p)}_interval_95": m.interval_95
            for p, m in zip(COVERAGE_LEVELS, means.covered, strict=True)
        },
    }


def share_in_band(nees_per_step: np.ndarray, band: tuple[float, float]) -> dict[str, Any]:
    """The share of steps (T,) whose mean NEES lies in its 95 % band, and its 95 % interval."""
    inside = (nees_per_step >= band[0]) & (nees_per_step <= band[1])
    mean = mean_over_time(inside.astype(float), 0.95, 0.95 * 0.05)  # neighbouring steps are correlated
    reach = (mean.band_95[1] - mean.band_95[0]) / 2
    name = "nees_steps_in_band"
    return {name: mean.value, f"{name}_interval_95": (max(mean.value - reach, 0.0), min(mean.value + reach, 1.0))}


def by_component(values: np.ndarray, names: tuple[str, ...] | None = None) -> dict[str, float]:
    """Values (m,) of the components of an innovation by name; without names, range and bearing or their numbers."""
    if names is None:
        names = ("range", "bearing") if len(values) == 2 else tuple(map(str, range(len(values))))
    return dict(zip(names, np.asarray(values).tolist(), strict=True))


def _by_axis(means: tuple[Mean, ...], field: str) -> dict[str, Any]:
    return {axis: getattr(mean, field) for axis, mean in zip(AXES, means, strict=True)}


def _percent(level: float) -> int:
    return round(100 * level)
