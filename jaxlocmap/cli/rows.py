"""Rows of a table for the fields that every report of a filter's consistency has, and its verdicts below the table."""

from __future__ import annotations

from typing import Any

from jaxlocmap import consistency
from jaxlocmap.cli.console import CONSOLE
from jaxlocmap.consistency import readable

Rows = list[tuple[str, str, str]]  # quantity, measured, what a consistent filter gives


def band(report: dict[str, Any], name: str, scale: float = 1) -> str:
    """An interval of the report, in brackets."""
    return _brackets(report[name], scale)


def _brackets(limits: tuple[float, float], scale: float = 1) -> str:
    return "[{:.4g}, {:.4g}]".format(*(scale * limit for limit in limits))


def pose_rows(report: dict[str, Any]) -> Rows:
    """NEES and coverage, each axis, errors, and diverged runs."""
    rows = [
        ("ANEES (3 degrees)", readable(report["anees"], 4), band(report, "anees_band_95")),
        *(
            (
                f"{level} % ellipsoid holds",
                f"{100 * report[name]:.1f} % {band(report, f'{name}_interval_95', 100)}",
                f"{level} %",
            )
            for level in (round(100 * p) for p in consistency.COVERAGE_LEVELS)
            for name in [f"coverage_{level}"]
        ),
    ]
    for field, words, expected, scale, unit in (
        ("axis_nees", "alone: error² over σ²", "1", 1, ""),
        ("within_two_sigma", "within ±2σ", "95.4 %", 100, " %"),
    ):
        for axis, value in report[field].items():
            limits = report[f"{field}_interval_95"][axis]
            rows.append((f"{axis} {words}", f"{readable(scale * value)}{unit} {_brackets(limits, scale)}", expected))
    return [
        *rows,
        ("position RMSE", f"{report['rmse_position_m']:.4g} m", ""),
        ("yaw RMSE", f"{report['rmse_yaw_rad']:.4g} rad", ""),
        ("diverged runs", str(report["diverged_runs"]), "0"),
    ]


def innovation_rows(report: dict[str, Any]) -> Rows:
    """NIS, whiteness and gate."""
    rows = [(f"NIS ({report.get('nis_degrees', 2)} degrees)", f"{report['nis_mean']:.3f}", band(report, "nis_band_95"))]
    gate = report.get("gate_nominal_rate")
    reach = report["innovation_lag_one_band_95"]
    for name, value in report["innovation_lag_one"].items():
        expected = "0" if gate is None else "not 0 behind a gate"
        rows.append((f"innovation lag one, {name}", f"{value:+.4f} ± {reach[name]:.4f}", expected))
    if "gate_accept_rate" in report:
        expected = f"{100 * (1 if gate is None else gate):g} %"
        rows.append(("gate lets in", f"{100 * report['gate_accept_rate']:.3f} %", expected))
    if "longest_rejection" in report:
        rows.append(("longest streak refused", f"{report['longest_rejection']} observations", ""))
    return rows


def match_rows(report: dict[str, Any]) -> Rows:
    """Matches, and the poses that they tell: relative to a submap's anchor, and between anchors."""
    refused = ", ".join(f"{report[f'match_refused_{why}']:,}" for why in ("points", "share", "nis", "convergence"))
    rows = [
        ("matches let in", f"{100 * report['match_accept_rate']:.2f} % of {report['matches']:,}", ""),
        ("refused: few points, off the map, gate, not converged", refused, ""),
        ("NIS of a match", f"{report['match_nis_mean']:.3f}", "up to 3"),
        ("submaps begun anew", str(report["submaps_begun_anew"]), "0"),
    ]
    for name, words in (("relative", "relative to the anchor"), ("edge", "between anchors")):
        error, sigma = (1000 * report[f"{name}_{what}_position_m"] for what in ("rmse", "sigma"))
        yaw, yaw_sigma = (1000 * report[f"{name}_{what}_yaw_rad"] for what in ("rmse", "sigma"))
        rows += [
            (f"ANEES {words}", readable(report[f"{name}_anees"], 4), band(report, f"{name}_anees_band_95")),
            (f"position RMSE {words}", f"{error:.3g} mm", f"σ {sigma:.3g} mm"),
            (f"yaw RMSE {words}", f"{yaw:.3g} mrad", f"σ {yaw_sigma:.3g} mrad"),
        ]
    return rows


def print_verdicts(report: dict[str, Any]) -> None:
    """What the report says of the covariance, and of the gate if it knows of one."""
    CONSOLE.print(report["verdict"], style="bold")
    if "gate_verdict" in report:
        CONSOLE.print(report["gate_verdict"])
