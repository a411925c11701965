"""The report of `benchmark.py` as tables: of text for Markdown, of boxes for the console."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import rich.table

_APART = 5  # standard errors: one comparison in a million is further off by chance


class Table(NamedTuple):
    """Cells of text."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def markdown(self) -> str:
        """One line a row."""
        lines = [self.header, tuple("---" for _ in self.header), *self.rows]
        return "".join(f"| {' | '.join(cell or '–' for cell in line)} |\n" for line in lines)

    def rich(self) -> rich.table.Table:
        """For the console."""
        table = rich.table.Table(*self.header)
        for row in self.rows:
            table.add_row(*row)
        return table


def overview(report: dict[str, Any]) -> Table:
    """What was compared, and how it came out."""
    rows = [*_studies(report), *_filters(report), *_devices(report), *_costs(report)]
    return Table(("what", "ours", "against", "ratio (range)"), rows)


def filters(report: dict[str, Any]) -> Table:
    """Every library's speed beside its consistency."""
    rows: list[tuple[str, ...]] = []
    for found in report.get("filter", {}).get("filters", []):
        name, bits = f"{found['name']} {found['version'] or ''}".strip(), found["precision"].removeprefix("float")
        if "steps_per_s" not in found:
            rows.append((name, bits, "not installed", "", "", "", ""))
            continue
        speed, lost = f"{found['steps_per_s'] / 1e6:.3g}", f"{100 * found['diverged_runs'] / found['runs']:.3g} %"
        rows.append((name, bits, speed, _ratio(found), _number(found["anees"]), _number(found["nis_mean"]), lost))
    return Table(("filter", "bits", "M steps/s", "ours over it", "ANEES (3)", "NIS (8)", "lost"), rows)


def notes(report: dict[str, Any]) -> list[str]:
    """Where it was measured, and whether the two studies did the same work."""
    machine = report["machine"]
    where = f"{machine['cores']} cores of {machine['cpu']}, Python {machine['python']}, JAX {machine['jax']}"
    lines = [f"{where}; pairs measured: {report['pairs']}"]
    compared = [
        report["study"][name].get("difference", {}) for name in ("without_map", "with_map") if "study" in report
    ]
    apart = [abs(value) for difference in compared for value in difference.values()]
    if apart:
        same = "agree" if max(apart) < _APART else "DO NOT AGREE: they do different work"
        lines.append(f"statistics of C++ and library {same}: at most {max(apart):.1f} standard errors apart")
    return lines


def _studies(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    if "study" not in report:
        return
    study = report["study"]
    for name, what in (("without_map", "study without maps"), ("with_map", "study with maps")):
        row = study[name]
        other = "no C++ compiler here" if study["cpp"] is None else f"C++ {row['other']:,.0f} runs/s"
        yield what, f"{row['ours']:,.0f} runs/s", other, _ratio(row)
    speed, python = f"{study['with_map']['ours']:,.0f} runs/s", f"Python {study['course']['seconds_a_run']:.2f} s a run"
    yield "the same, plain Python on one core", speed, python, f"{study['course']['ratio']:,.0f}"


def _filters(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for found in report.get("filter", {}).get("filters", []):
        if found["name"] == "dynamax" and "ratio" in found:
            ours, other = (f"{found[name] / 1e6:.3g} M steps/s" for name in ("ours", "other"))
            yield f"filter alone, {found['precision']}", ours, f"dynamax {other}", _ratio(found)


def _devices(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    found = report.get("devices")
    if found:
        other = f"{found['other']:,.0f} runs/s, {found['cores_busy']['other']:.2f} cores"
        yield f"{found['devices']} devices over 1", f"{found['ours']:,.0f} runs/s", other, _ratio(found)
    if found and found["one_core"]:
        ours, other = (f"{found['one_core'][name]:,.0f} runs/s" for name in ("ours", "other"))
        yield f"{found['devices']} devices over 1 core", ours, other, _ratio(found["one_core"])


def _costs(report: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    if "cost" not in report:
        return
    found = report["cost"]
    peaks = zip(found["memory"]["runs"], found["memory"]["peak_bytes"], strict=True)
    few, many = (f"{runs:,} runs: {peak / 2**20:.0f} MiB" for runs, peak in peaks)
    yield "peak memory", many, few, _ratio(found["memory"])
    yield "compile, default study", f"{found['compile_s']:.1f} s", "", ""
    ours, alone = (f"{name} {found['imports'][key]:.2f} s" for name, key in (("jaxlocmap", "ours"), ("jax", "other")))
    yield "import", ours, alone, f"+{found['import_over_jax_s']:.2f} s"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.2f}"


def _ratio(found: dict[str, Any]) -> str:
    if "ratio" not in found:
        return ""
    digits = 0 if found["ratio"] >= 20 else 2
    low, middle, high = (f"{found[name]:,.{digits}f}" for name in ("ratio_min", "ratio", "ratio_max"))
    return middle if low == high else f"{middle} ({low} to {high})"
