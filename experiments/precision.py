"""What float32 costs: the same drives filtered in float64 and in float32, and with the short covariance update that
Joseph's form replaces. Every difference is taken run by run, so it is known far better than either number.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from jaxlocmap import Config, Gaussian, Inputs, Params, State, consistency, init, plotting, run, sensors, simulation
from jaxlocmap._internal.batching import any_in_batch
from jaxlocmap._internal.linalg import Matrix, ldl, solve
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.compute import ComputeConfig, start
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.filters import ekf
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.parameters import R
from jaxlocmap.step import Observed, turn

BINS = 40  # of time, for the figure
_FILTERS = ("float64", "float32", "short_form")  # the last in float32 as well


@dataclasses.dataclass(frozen=True)
class PrecisionConfig:
    """Settings of the comparison."""

    steps: tuple[int, ...] = (240, 10_000, 100_000)
    """How long the drives are: 240 is the course's drive, any other length goes round the loop."""
    runs: tuple[int, ...] = (512, 64, 16)
    """How many drives of each length."""
    sharper: tuple[float, ...] = (10.0, 100.0, 1000.0)
    """How many times better than the robot's own the landmark detector becomes, over the first length of drive."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/precision")
    """Folder for report.json and precision.png."""
    quick: bool = False
    """A run of some seconds: 64 drives of the first length."""


class Score(NamedTuple):
    """Of one filter, summed over the steps of each time bin, (BINS,) each."""

    scored: jax.Array  # steps whose NEES is finite and not negative
    nees: jax.Array
    position_square: jax.Array  # m²
    yaw_square: jax.Array  # rad²
    flagged: jax.Array  # steps that the filter itself reports as broken down
    not_definite: jax.Array  # steps whose covariance is not positive definite: one pivot is enough


class Gap(NamedTuple):
    """The largest difference between a filter and the one in float64 in each time bin, (BINS,) each."""

    position: jax.Array  # m
    yaw: jax.Array  # rad
    cov: jax.Array  # of an entry P_ij, relative to σ_i σ_j


class Outcome(NamedTuple):
    """What one drive says."""

    double: Score
    single: Score
    short: Score  # float32 as well, with the short form
    single_gap: Gap
    short_gap: Gap


@dataclasses.dataclass(frozen=True)
class Precision:
    """One drive, simulated in float64 and filtered three times. Hashable, so `monte_carlo` compiles it once."""

    scenario: simulation.Scenario
    config: Config

    def __call__(
        self, key: jax.Array, params: Params, world: simulation.World, noise: simulation.Noise, prior: Gaussian
    ) -> Outcome:
        """Scores of the drive that `key` stands for; all arguments in float64."""
        start_key, key = jax.random.split(key)
        first = simulation.draw_start(start_key, prior, scenario=self.scenario)
        drive = simulation.simulate(key, world, noise, first, scenario=self.scenario, scan=False)
        # Bin by bin, so that no filter's beliefs are kept for the whole drive.
        drive = jax.tree.map(lambda x: x.reshape(BINS, -1, *x.shape[1:]), drive)

        def one_bin(states: Any, now: tuple[Any, Inputs]) -> tuple[Any, Outcome]:
            double, single, short = states
            truth, inputs = now
            scene = {"landmarks": world.landmarks, "config": self.config, "collect": _beliefs}
            double, (exact, exact_ok) = run(params, double, inputs, **scene)
            single, (rounded, rounded_ok) = run(params, single, in_single(inputs), **scene)
            short, (brief, brief_ok) = short_form_run(
                in_single(params), short, *in_single((inputs, world.landmarks)), config=self.config
            )
            return (double, single, short), Outcome(
                double=_score(truth.pose, exact, exact_ok),
                single=_score(truth.pose, rounded, rounded_ok),
                short=_score(truth.pose, brief, brief_ok),
                single_gap=_gap(exact, rounded),
                short_gap=_gap(exact, brief),
            )

        rounded = in_single(prior)
        states = (init(prior, config=self.config), *(init(rounded, config=self.config) for _ in range(2)))
        return jax.lax.scan(one_bin, states, drive)[1]


def in_single(tree: Any) -> Any:
    """Every float64 array of a tree rounded to float32."""
    return jax.tree.map(lambda x: x.astype(np.float32) if x.dtype == np.float64 else x, tree)


def short_form_run(
    params: Params, state: State, inputs: Inputs, landmarks: jax.Array, *, config: Config
) -> tuple[State, tuple[Gaussian, jax.Array]]:
    """`run` without gate and map, with P ← (I − K H) P in place of Joseph's form.

    The short form is exact for the optimal gain K, and only for that one: a rounded gain can cost P its definiteness.

    Returns:
        The last state, and the belief after every step with whether it is valid.
    """

    def slot(belief: Gaussian, now: tuple[jax.Array, ...]) -> tuple[Gaussian, None]:
        z, landmark, valid = now
        residual, H, _ = sensors.linearise(belief.mean, landmarks[landmark], z, offset=config.sensor_offset)
        update = ekf.update(*belief, residual, H, params.block(R), valid=valid)
        P, (L, D) = Matrix.symmetric(belief.cov), ldl(Matrix.symmetric(update.S))
        K = Matrix(solve(L, D, row) for row in (P @ H.T).rows)
        short = ((Matrix.identity(3) - K @ H) @ P).array(z.dtype)
        return Gaussian(update.mean, jnp.where(update.accepted, short, belief.cov)), None

    def body(state: State, now: Inputs) -> tuple[State, tuple[Gaussian, jax.Array]]:
        def observe(belief: Gaussian) -> Observed:
            slots = now.z, now.landmark, now.valid
            correct = lambda: jax.lax.scan(slot, belief, slots)[0]  # noqa: E731
            corrected = jax.lax.cond(any_in_batch(now.valid), correct, lambda: belief)
            return Observed(corrected, None, jnp.zeros((), belief.mean.dtype), jnp.array(True))

        turned = turn(params, state, now.control, now.dt, observe=observe, ranges=None, beam_angles=None, config=config)
        return turned.state, (turned.state.belief, turned.ok)

    return jax.lax.scan(body, state, inputs)


def _beliefs(state: Any, info: Any, aside: Any) -> tuple[Gaussian, jax.Array]:
    del state, aside
    return info.belief, info.ok


def _score(truth: jax.Array, beliefs: Gaussian, ok: jax.Array) -> Score:
    """Judged in float64 whatever the filter's own type, so that the filters alone differ."""
    mean, cov = (x.astype(truth.dtype) for x in beliefs)
    score = jax.vmap(consistency.score_pose)(truth, mean, cov)
    error = jax.vmap(consistency.pose_error)(truth, mean)
    definite = jax.vmap(lambda P: jnp.all(jnp.stack(ldl(Matrix.symmetric(P))[1]) > 0))(cov)
    return Score(
        scored=score.scored.sum(),
        nees=jnp.sum(score.nees),
        position_square=jnp.sum(error[:, :2] ** 2),
        yaw_square=jnp.sum(error[:, 2] ** 2),
        flagged=jnp.sum(~ok),
        not_definite=jnp.sum(~definite),
    )


def _gap(exact: Gaussian, other: Gaussian) -> Gap:
    mean, cov = (x.astype(exact.mean.dtype) for x in other)
    apart = jnp.abs(jax.vmap(consistency.pose_error)(exact.mean, mean))
    sigma = jnp.sqrt(jnp.diagonal(exact.cov, axis1=1, axis2=2))
    relative = jnp.abs(cov - exact.cov) / (sigma[:, :, None] * sigma[:, None, :])
    return Gap(position=jnp.hypot(apart[:, 0], apart[:, 1]).max(), yaw=apart[:, 2].max(), cov=relative.max())


def main(config: PrecisionConfig) -> dict[str, Any]:
    """Run all drives, write the report and the figure."""
    out = output_folder(config.out)
    _check(config)
    steps, runs, sharper = config.steps, config.runs, config.sharper
    if config.quick:
        steps, runs = steps[:1], (min(runs[0], 64),)
    studies = [(*each, 1.0) for each in zip(steps, runs, strict=True)]
    studies += [(steps[0], runs[0], factor) for factor in sharper]
    start(ComputeConfig())
    began = time.perf_counter()
    with jax.enable_x64(True), progress_bar("simulating", sum(count for _, count, _ in studies)) as progress:
        rows: list[dict[str, Any]] = []
        for study in studies:
            done = sum(row["runs"] for row in rows)
            rows.append(_row(config.seed, *study, lambda now, done=done: progress(done + now)))
    drives, sharp = rows[: len(steps)], rows[len(steps) :]
    report = {
        "drives": drives,
        "sharper_detectors": sharp,
        "verdict": [row["verdict"] for row in rows],
        "seed": config.seed,
        "wall_s": time.perf_counter() - began,
    }
    write_report(out, report)
    plotting.precision_figure(out / "precision.png", drives)
    _print("The robot's own noise", drives)
    if sharp:
        _print(f"The same over {steps[0]} steps with a sharper landmark detector", sharp)
    for row in rows:
        CONSOLE.print(row["verdict"])
    saved(out, "report.json", "precision.png")
    return report


def _check(config: PrecisionConfig) -> None:
    if not config.steps:
        raise ValueError("steps: expected at least one length of drive, got none")
    for n in config.steps:
        if n < BINS or n % BINS:
            raise ValueError(f"steps: expected a multiple of {BINS}, the number of time bins, got {n}")
    if len(config.runs) != len(config.steps):
        raise ValueError(f"runs: expected one number for each length, {len(config.steps)}, got {len(config.runs)}")
    for n in config.runs:
        if n < 2:
            raise ValueError(f"runs: expected at least 2, which a standard error needs, got {n}")
    for factor in config.sharper:
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(f"sharper: expected a positive, finite factor, got {factor}")


def _row(seed: int, steps: int, runs: int, sharper: float, progress: Any) -> dict[str, Any]:
    """One study: drives of one length with one detector."""
    course = simulation.CAPSTONE
    scenario = course if steps == course.steps else dataclasses.replace(simulation.LOOP, steps=steps)
    noise = simulation.Noise()
    noise = noise._replace(range=noise.range / sharper, bearing=noise.bearing / sharper)
    settings = scenario.config(motion="euler", gate_probability=None, grid=False)
    study = Precision(scenario, settings)
    arguments = (simulation.own_params(noise, scenario), simulation.room(), noise, scenario.prior())
    result = monte_carlo(study, jax.random.key(seed), runs, *arguments, keep_runs=True, progress=progress)
    return summarise(result.value, scenario, sharper)


def summarise(outcome: Outcome, scenario: simulation.Scenario, sharper: float) -> dict[str, Any]:
    """Statistics of each filter, and by how much it differs from the one in float64.

    Args:
        outcome: of NumPy arrays (runs, BINS). scenario: of the drives. sharper: as in the command line.
    """
    row: dict[str, Any] = {
        "scenario": scenario.name,
        "steps": scenario.steps,
        "runs": len(outcome.double.nees),
        "detector_sharper": sharper,
        "time_s": (scenario.dt * scenario.steps * np.arange(1, BINS + 1) / BINS).tolist(),
        "float64": _statistics(outcome.double, scenario.steps),
        "float32": _statistics(outcome.single, scenario.steps, outcome.double, outcome.single_gap),
        "short_form": _statistics(outcome.short, scenario.steps, outcome.double, outcome.short_gap),
    }
    return row | {"verdict": verdict(row)}


def _statistics(score: Score, steps: int, exact: Score | None = None, gap: Gap | None = None) -> dict[str, Any]:
    report: dict[str, Any] = {}
    for name, (value, influence) in _measures(score, steps).items():
        report |= {name: value, f"{name}_standard_error": _standard_error(influence)}
        if exact is not None:
            exact_value, exact_influence = _measures(exact, steps)[name]
            report[f"{name}_difference"] = value - exact_value
            report[f"{name}_difference_standard_error"] = _standard_error(influence - exact_influence)
    report["not_definite_steps"] = int(score.not_definite.sum())
    report["flagged_steps"] = int(score.flagged.sum())
    report["unscored_steps"] = int(score.scored.size // BINS * steps - score.scored.sum())
    report["nees_per_bin"] = score.nees.sum(0) / np.maximum(score.scored.sum(0), 1)
    if gap is not None:
        report["position_difference_per_bin_m"] = gap.position.max(0)
        report["largest_position_difference_m"] = gap.position.max()
        report["largest_yaw_difference_rad"] = gap.yaw.max()
        report["largest_covariance_difference"] = gap.cov.max()  # of an entry, in units of σ_i σ_j
    return report


def _measures(score: Score, steps: int) -> dict[str, tuple[float, np.ndarray]]:
    """Each statistic, and to first order what each run makes of it: the spread of that gives the standard error."""
    scored = score.scored.sum(1)
    nees = np.asarray(score.nees.sum(1) / np.where(scored > 0, scored, np.nan))
    measures = {"anees": (float(nees.mean()), nees)}
    for name, square in (("rmse_position_m", score.position_square), ("rmse_yaw_rad", score.yaw_square)):
        mean_square = np.asarray(square.sum(1) / steps)
        rmse = math.sqrt(mean_square.mean())
        measures[name] = rmse, mean_square / (2 * rmse)  # d√m = dm / 2√m
    return measures


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / math.sqrt(len(values)))


def verdict(row: dict[str, Any]) -> str:
    """What float32 costs, in words: broken covariances first, then a change of the ANEES that would matter, which is
    one larger than what the ANEES itself is known to. The change is known far better, and said with its own error.
    """
    double, single = row["float64"], row["float32"]
    where = f"{row['steps']:,} steps" if row["detector_sharper"] == 1 else f"{row['detector_sharper']:g} times sharper"
    change = f"ANEES {_with_error(single, 'anees_difference', '+.1e')}"
    if single["not_definite_steps"]:
        return (
            f"{where}: float32 breaks {single['not_definite_steps']:,} of {row['runs'] * row['steps']:,} covariances, "
            f"{row['short_form']['not_definite_steps']:,} with the short form; {change}"
        )
    if not abs(single["anees_difference"]) < double["anees_standard_error"]:
        return f"{where}: float32 costs consistency; {change}"
    said = f"{where}: no cost to be seen, {change} where the study knows it to {double['anees_standard_error']:.1g}"
    if row["detector_sharper"] != 1:
        return said
    first, second = np.split(single["position_difference_per_bin_m"], 2)
    return (
        f"{said}; the positions part by {single['largest_position_difference_m']:.1e} m at most, in the second half of "
        f"the drive {second.max() / first.max():.2f} times as far as in the first"
    )


def _print(title: str, rows: list[dict[str, Any]]) -> None:
    """A column for each study; what float32 changes stands below the value in float64."""
    columns = [f"{row['steps']:,} steps" for row in rows]
    if any(row["detector_sharper"] != 1 for row in rows):
        columns = [f"{row['detector_sharper']:g} times" for row in rows]
    table = Table(
        "",
        *columns,
        title=title,
        title_justify="left",
        caption="a / b / c: float64, float32, float32 with P ← (I − K H) P; a difference is from float64",
        caption_justify="left",
    )

    def line(what: str, cell: Callable[[dict[str, Any]], str]) -> None:
        table.add_row(what, *map(cell, rows))

    def of_each(name: str, form: str) -> Callable[[dict[str, Any]], str]:
        return lambda row: " / ".join(format(row[each][name], form) for each in _FILTERS if name in row[each])

    line("runs", lambda row: f"{row['runs']}")
    for name, what in (
        ("anees", "ANEES (3)"),
        ("rmse_position_m", "position RMSE, m"),
        ("rmse_yaw_rad", "yaw RMSE, rad"),
    ):
        line(f"{what}, float64", lambda row, name=name: _with_error(row["float64"], name, ".4g"))
        line("  float32", lambda row, name=name: _with_error(row["float32"], f"{name}_difference", "+.1e"))
        line("  short form", lambda row, name=name: _with_error(row["short_form"], f"{name}_difference", "+.1e"))
    line("not positive definite, steps", of_each("not_definite_steps", ","))
    line("flagged by the filter, steps", of_each("flagged_steps", ","))
    line("largest position difference, m", of_each("largest_position_difference_m", ".1e"))
    line("largest yaw difference, rad", of_each("largest_yaw_difference_rad", ".1e"))
    line("largest covariance difference, σσ", of_each("largest_covariance_difference", ".1e"))
    CONSOLE.print(table)


def _with_error(values: dict[str, Any], name: str, form: str) -> str:
    return f"{values[name]:{form}} ± {values[f'{name}_standard_error']:.1g}"


if __name__ == "__main__":
    command_line(main)
