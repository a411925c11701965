"""Gradients against other ways to tune, and losses against each other.

1. One objective, the likelihood of innovations on simulated drives, by this library's descent, by SciPy with and
   without our gradient, and by Nelder-Mead: evaluations and seconds to the same loss, and how consistent the results.
2. One problem, five losses, from a start three times too sure of itself: who is accurate, who is honest.
3. What a gradient costs: its time over that of the value, and memory a run for short and for long drives with a map.
4. A linear robot, on which OKF (Greenberg, Yannay & Mannor 2023; the extra `okf`) can be run too: tuned for squared
   error by either, and for the density of the true pose.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from evidence import replace_table
from jax.flatten_util import ravel_pytree

from jaxlocmap import Config, Gaussian, Inputs, Params, consistency, simulation, tuning
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, write_report
from jaxlocmap.cli.tune_sources import GATE_TEMPERATURE, TUNING_GATE
from jaxlocmap.consistency import readable
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.monte_carlo import hosts, monte_carlo
from jaxlocmap.parameters import Q, R

_CLOSE = 1e-4  # nats: two losses this close are the same, a tenth of what 512 runs leave uncertain
_LOSSES = ("mse", "pose_nll", "innovation_nll", "nees", "nis")
_TWO = ("range", "bearing")  # what `nees` and `nis` are tuned by, which tell no more than two
_SURE = 1 / 3  # of the robot's own standard deviations: where the second comparison starts
_STEADY = simulation.LOOP  # whose prior is honest: an exact start would let a filter win that does not look


@dataclasses.dataclass(frozen=True)
class CompareConfig:
    """What to compare on."""

    runs: int = 512
    """Simulated runs to tune on."""
    judge_runs: int = 2000
    """Fresh runs to judge by."""
    write: bool = False
    """Put the tables into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/tune_compare")
    """Folder for report.json."""
    quick: bool = False
    """A run of a few seconds: few runs, few steps."""


class Descent(NamedTuple):
    """What an optimiser did: the loss after so many evaluations and seconds."""

    losses: list[float]
    evaluations: list[int]
    seconds: list[float]
    params: Params


def main(config: CompareConfig) -> dict[str, Any]:
    """Compare, print the tables and write the report."""
    out = output_folder(config.out)
    for name in ("runs", "judge_runs"):
        hosts.check_count(name, getattr(config, name), least=10)  # a fifth of them is judged for some tables
    hosts.use_all_cores()
    jax.config.update("jax_disable_most_optimizations", config.quick)  # a quick run does little but compile
    runs, judge_runs = (16, 50) if config.quick else (config.runs, config.judge_runs)
    with jax.enable_x64(True):
        report = {
            "optimisers": _optimisers(
                runs, _judge_on_fresh_runs(simulation.CAPSTONE, 0.99, judge_runs, config), config
            ),
            "losses": _losses(max(runs // 5, 8), _judge_on_fresh_runs(_STEADY, None, judge_runs // 5, config), config),
            "cost": _cost(runs, config.quick),
            "linear": _linear(config),
        }
    tables = {
        "optimisers": _table_of_optimisers(report["optimisers"]),
        "losses": _table_of_losses(report["losses"]),
        "gradients": _table_of_costs(report["cost"]),
        "okf": _table_of_linear(report["linear"]),
    }
    for name, table in tables.items():
        if config.write:
            replace_table(name, table)
        CONSOLE.print(f"\n{table}", soft_wrap=True)
    write_report(out, report)
    saved(out, "report.json")
    return report


def _judge_on_fresh_runs(
    scenario: simulation.Scenario, gate: float | None, runs: int, config: CompareConfig
) -> Callable[[Params], dict[str, Any]]:
    settings = scenario.config(motion="euler", gate_probability=gate, grid=False)
    key = jax.random.fold_in(jax.random.key(config.seed), 9)

    def judge(params: Params) -> dict[str, Any]:
        args = params, simulation.room(), simulation.Noise(), scenario.prior()
        args = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), args)
        totals = monte_carlo(Study(scenario, settings), key, runs, *args)
        return summarise(totals.value, settings)

    return judge


def _drives(scenario: simulation.Scenario, runs: int, seed: int) -> tuning.Batch:
    return tuning.simulated(jax.random.key(seed), runs, simulation.room(), simulation.Noise(), scenario=scenario)


def _optimisers(runs: int, judge: Callable[[Params], dict[str, Any]], config: CompareConfig) -> list[dict[str, Any]]:
    settings = simulation.CAPSTONE.config(motion="euler", gate_probability=TUNING_GATE, grid=False)
    settings = dataclasses.replace(settings, gate_temperature=GATE_TEMPERATURE)
    objective = tuning.Objective(settings, (("innovation_nll", 1.0),))
    start, batch = simulation.course_params(), _drives(simulation.CAPSTONE, runs, config.seed)
    ways = {
        "this library: L-BFGS, forward gradient": lambda: _ours(objective, start, batch, config.quick),
        "SciPy L-BFGS-B, our gradient": lambda: _scipy("L-BFGS-B", True, objective, start, batch, config.quick),
        "SciPy L-BFGS-B, finite differences": lambda: _scipy("L-BFGS-B", False, objective, start, batch, config.quick),
        "SciPy Nelder-Mead": lambda: _scipy("Nelder-Mead", False, objective, start, batch, config.quick),
    }
    if config.quick:
        ways = dict(list(ways.items())[-2:])
    done = {}
    with progress_bar("optimisers", len(ways)) as progress:
        for i, (name, way) in enumerate(ways.items()):
            done[name] = way()
            progress(i + 1)
    best = min(min(descent.losses) for descent in done.values())
    rows = []
    for name, descent in done.items():
        there = np.flatnonzero(np.array(descent.losses) <= best + _CLOSE)
        at = int(there[0]) if len(there) else None
        study = judge(descent.params)
        rows.append(
            {
                "optimiser": name,
                "loss": min(descent.losses),
                "evaluations_to_best": None if at is None else descent.evaluations[at],
                "seconds_to_best": None if at is None else descent.seconds[at],
                "evaluations": descent.evaluations[-1],
                "seconds": descent.seconds[-1],
                "params": {name: float(x) for name, x in tuning.natural(descent.params).items()},
                **{key: study[key] for key in ("anees", "nis_mean", "coverage_95", "gate_accept_rate")},
            }
        )
    return rows


def _ours(objective: tuning.Objective, start: Params, batch: tuning.Batch, quick: bool) -> Descent:
    marks: list[tuple[float, int, float]] = []

    def progress(fit: tuning.Fit) -> None:
        marks.append((float(fit.losses[-1]), int(fit.trace.evaluations.sum()), fit.run_s))

    fit = tuning.fit(objective, start, batch, epochs=2 if quick else 20, steps=1, patience=3, progress=progress)
    losses, evaluations, seconds = zip(*marks, strict=True)
    return Descent(list(losses), list(evaluations), list(seconds), fit.params)


def _scipy(
    method: str, slopes: bool, objective: tuning.Objective, start: Params, batch: tuning.Batch, quick: bool
) -> Descent:
    """SciPy on the same function of the same coordinates, compiled beforehand; each value counts as one evaluation."""
    f = tuning.coordinates_objective(objective, start, tuning.NOISE)
    whole = tuning.unconstrain(start)
    x0, unravel = ravel_pytree({name: whole[name].astype(float) for name in tuning.NOISE})

    def value(x: jax.Array, batch: tuning.Batch) -> jax.Array:
        return f(unravel(x), batch)[0]

    program = jax.jit(jax.value_and_grad(value) if slopes else value).lower(x0, batch).compile()
    marks: list[tuple[float, int, float]] = []
    began = time.perf_counter()

    def call(x: np.ndarray) -> Any:
        result = jax.tree.map(np.asarray, program(jnp.asarray(x), batch))
        loss = float(result[0] if slopes else result)
        low = min(loss, marks[-1][0]) if marks else loss
        marks.append((low, len(marks) + 1, time.perf_counter() - began))
        return (loss, np.asarray(result[1])) if slopes else loss

    options = {"maxiter": 2} if quick else {}
    found = scipy.optimize.minimize(call, np.asarray(x0), jac=slopes or None, method=method, options=options)
    losses, evaluations, seconds = zip(*marks, strict=True)
    params = tuning.constrain(whole | unravel(jnp.asarray(found.x)))
    return Descent(list(losses), list(evaluations), list(seconds), params)


def _losses(runs: int, judge: Callable[[Params], dict[str, Any]], config: CompareConfig) -> list[dict[str, Any]]:
    settings = _STEADY.config(motion="euler", gate_probability=None, grid=False)
    batch = _drives(_STEADY, runs, config.seed)
    own = simulation.own_params(simulation.Noise(), simulation.CAPSTONE)
    start = own._replace(Q=own.block(Q) * _SURE**2, R=own.block(R) * _SURE**2)
    rows = [_loss_row("the start", start, judge), _loss_row("the robot's own noise", own, judge)]
    losses = _LOSSES[:1] if config.quick else _LOSSES
    with progress_bar("losses", len(losses)) as progress:
        for i, name in enumerate(losses):
            objective = tuning.Objective(settings, ((name, 1.0),))
            tuned = _TWO if name in ("nees", "nis") else tuning.NOISE
            fit = tuning.fit(objective, start, batch, tuned=tuned, epochs=1 if config.quick else 20)
            words = f"tuned for `{name}`" + (f", {' and '.join(tuned)} alone" if tuned == _TWO else "")
            rows.append(_loss_row(words, fit.params, judge))
            progress(i + 1)
    return rows


def _loss_row(name: str, params: Params, judge: Callable[[Params], dict[str, Any]]) -> dict[str, Any]:
    study = judge(params)
    keys = ("rmse_position_m", "rmse_yaw_rad", "anees", "nis_mean", "coverage_95")
    natural = {key: float(value) for key, value in tuning.natural(params).items()}
    return {"filter": name, "params": natural, **{key: study[key] for key in keys}}


def _cost(runs: int, quick: bool) -> dict[str, float]:
    filter_only = tuning.Objective(
        simulation.CAPSTONE.config(motion="euler", gate_probability=TUNING_GATE, grid=False), (("innovation_nll", 1.0),)
    )
    start, batch = simulation.course_params(), _drives(simulation.CAPSTONE, runs, 0)
    whole = tuning.unconstrain(start)
    f = tuning.coordinates_objective(filter_only, start, tuning.NOISE)
    at = {name: whole[name] for name in tuning.NOISE}
    programs = {
        name: jax.jit(function).lower(at, batch).compile()
        for name, function in (
            ("value", lambda at, batch: f(at, batch)[0]),
            ("gradient", jax.value_and_grad(lambda at, batch: f(at, batch)[0])),
        )
    }
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(2 if quick else 15):  # in turns, so that whatever else the machine does meets both
        for name, program in programs.items():
            began = time.perf_counter()
            jax.block_until_ready(program(at, batch))
            seconds[name].append(time.perf_counter() - began)
    cost = {f"{name}_s": float(np.median(times)) for name, times in seconds.items()}
    cost["gradient_over_value"] = float(np.median(np.array(seconds["gradient"]) / np.array(seconds["value"])))
    for steps in (240, 3840):
        cost[f"bytes_a_run_{steps}"] = _bytes_a_run(steps)
    cost["memory_ratio"] = cost["bytes_a_run_3840"] / cost["bytes_a_run_240"]
    return cost


def _bytes_a_run(steps: int, runs: int = 4) -> float:
    """Memory a run of the gradient of likelihood and map by all six parameters: data and everything in between."""
    scenario = dataclasses.replace(simulation.CAPSTONE, steps=steps)
    world, noise = simulation.room(), simulation.Noise()
    settings = scenario.config(motion="euler", gate_probability=TUNING_GATE)
    objective = tuning.Objective(settings, (("innovation_nll", 1.0), ("map", 1.0)))
    batch = jax.eval_shape(
        lambda key: tuning.simulated(key, runs, world, noise, scenario=scenario, scans=True), jax.random.key(0)
    )
    names = (*tuning.NOISE, *tuning.SENSOR_MODEL)
    f = tuning.coordinates_objective(objective, simulation.course_params(), names)
    whole = tuning.unconstrain(simulation.course_params())
    slope = jax.value_and_grad(lambda at, batch: f(at, batch)[0])
    program = jax.jit(slope).lower({name: whole[name] for name in names}, batch).compile()
    memory: Any = program.memory_analysis()
    return (memory.argument_size_in_bytes + memory.temp_size_in_bytes + memory.output_size_in_bytes) / runs


# The linear robot: it stands somewhere on the x axis, drifts along it and turns, and sees a landmark far ahead. Range
# and bearing are then all but linear in position and heading, as OKF wants them: z = (far - x, -theta).
_FAR, _DT = 1e3, 1.0  # m, s
_DRIFT, _SEEN = (0.05, 0.01), (0.2, 0.04)  # m, rad a step; m, rad


def _linear(config: CompareConfig) -> list[dict[str, Any]]:
    train_count, steps = (10, 10) if config.quick else (100, 60)
    rng = np.random.default_rng(config.seed)
    train, test = _linear_drives(rng, train_count, steps), _linear_drives(rng, 4 * train_count, steps)
    settings = Config(dt=_DT, motion="euler", gate_probability=None)
    start = Params.from_std(v=0.1, w=0.1, range=0.1, bearing=0.1)
    rows = [_linear_row("the start", start, 0.0, test, settings)]
    for loss in ("mse",) if config.quick else ("mse", "pose_nll", "innovation_nll"):
        objective = tuning.Objective(settings, ((loss, 1.0),))
        fit = tuning.fit(objective, start, train, tuned=tuning.FULL_NOISE, epochs=2 if config.quick else 20)
        rows.append(_linear_row(f"this library, `{loss}`", fit.params, fit.run_s, test, settings))
    if importlib.util.find_spec("okf") is None:
        CONSOLE.print("OKF is not installed (the extra `okf`): its row is left out")
    else:
        params, seconds = _okf(train, config)
        rows.append(_linear_row("OKF, squared error", params, seconds, test, settings))
    return rows


def _linear_drives(rng: np.random.Generator, count: int, steps: int) -> tuning.Batch:
    drift, turn = np.moveaxis(rng.normal(size=(count, steps, 2)) * _DRIFT, -1, 0)
    heading = np.cumsum(turn, axis=1)
    before = heading - turn  # a step goes where the robot looked before it
    x, y = np.cumsum(drift * np.cos(before), axis=1), np.cumsum(drift * np.sin(before), axis=1)
    truth = np.stack([x, y, heading], axis=-1)
    z = np.stack([np.hypot(_FAR - x, y), np.arctan2(-y, _FAR - x) - heading], axis=-1)
    z = z + rng.normal(size=z.shape) * _SEEN
    return tuning.join(*(_linear_sequence(truth[i], z[i]) for i in range(count)))


def _linear_sequence(truth: np.ndarray, z: np.ndarray) -> tuning.Batch:
    steps = len(truth)
    seen: Any = (np.zeros((steps, 1), np.int32), z[:, None], np.ones((steps, 1), bool))
    still: Any = (np.full(steps, _DT), np.zeros((steps, 2)))
    inputs = Inputs(*still, *seen)
    prior = Gaussian(jnp.zeros(3), jnp.diag(jnp.array([1e-2, 1e-4, 1e-4])))
    return tuning.sequence(inputs, prior, landmarks=np.array([[_FAR, 0.0]]), truth=truth)


def _linear_row(name: str, params: Params, seconds: float, test: tuning.Batch, config: Config) -> dict[str, Any]:
    @jax.jit
    def judged(params: Params, test: tuning.Batch) -> tuple[jax.Array, jax.Array]:
        belief = tuning.beliefs(params, test, config=config)

        def one(truth: jax.Array, mean: jax.Array, cov: jax.Array) -> tuple[jax.Array, jax.Array]:
            # Position and heading alone: what moves along y is hardly seen.
            error = consistency.pose_error(truth, mean)[jnp.array([0, 2])]
            P = cov[jnp.array([[0], [2]]), jnp.array([[0, 2]])]
            return error @ jnp.linalg.solve(P, error), error

        return jax.vmap(jax.vmap(one))(jnp.asarray(test.truth), belief.mean, belief.cov)

    nees, error = (np.asarray(x) for x in judged(params, test))
    rms = np.sqrt((error**2).mean((0, 1)))
    return {
        "filter": name,
        "seconds": seconds,
        "rmse_position_m": float(rms[0]),
        "rmse_yaw_rad": float(rms[1]),
        "anees_of_2": float(nees.mean()),
        "covered_95": float((nees < consistency.chi2_quantile(0.95, 2)).mean()),
        "params": {key: float(value) for key, value in tuning.natural(params).items()},
    }


def _okf(train: tuning.Batch, config: CompareConfig) -> tuple[Params, float]:
    okf, torch = (importlib.import_module(name) for name in ("okf", "torch"))
    z = np.stack([_FAR - np.asarray(train.inputs.z)[..., 0, 0], -np.asarray(train.inputs.z)[..., 0, 1]], axis=-1)
    x = np.asarray(train.truth)[..., [0, 2]]
    torch.manual_seed(config.seed)
    eye = torch.eye(2, dtype=torch.double)
    with tempfile.TemporaryDirectory() as folder:
        model = okf.OKF(
            dim_x=2,
            dim_z=2,
            F=eye,
            H=eye,
            P0=torch.diag(torch.tensor([1e-2, 1e-4], dtype=torch.double)),
            x0=torch.zeros(2, dtype=torch.double),
            loss_fun=lambda estimate, truth: torch.sum((estimate - truth) ** 2),
            model_files_path=f"{folder}/",
        )
        began = time.perf_counter()
        okf.train(
            model,
            list(z),
            list(x),
            n_epochs=1 if config.quick else 10,
            verbose=0,
            log_interval=85,  # sequences between two looks at its validation set
            noise_estimation_initialization=False,
            save_best=not config.quick,
        )
        seconds = time.perf_counter() - began
    # Its Q is of a step, ours of a control over a step of `_DT` seconds.
    Q, R = model.get_Q() / _DT**2, model.get_R()
    return Params(jnp.asarray(Q), jnp.asarray(R), jnp.array(0.85), jnp.array(-0.4)), seconds


def _table_of_optimisers(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| optimiser | evaluations, seconds to the best loss | in all | ANEES (3) | NIS (2) | gate lets in |",
        "|---" * 6 + "|",
    ]
    for row in rows:
        there = row["evaluations_to_best"]
        reached = "not reached" if there is None else f"{there}, {row['seconds_to_best']:.1f} s"
        lines.append(
            f"| {row['optimiser']} | {reached} | {row['evaluations']}, {row['seconds']:.1f} s | {row['anees']:.2f} | "
            f"{row['nis_mean']:.2f} | {100 * row['gate_accept_rate']:.2f} % |"
        )
    return "\n".join(lines)


def _table_of_losses(rows: list[dict[str, Any]]) -> str:
    lines = ["| filter | position RMSE | yaw RMSE | ANEES (3) | NIS (2) | 95 % ellipsoid holds |", "|---" * 6 + "|"]
    for row in rows:
        lines.append(
            f"| {row['filter']} | {1e3 * row['rmse_position_m']:.2f} mm | {1e3 * row['rmse_yaw_rad']:.2f} mrad | "
            f"{readable(row['anees'])} | {readable(row['nis_mean'])} | {100 * row['coverage_95']:.1f} % |"
        )
    return "\n".join(lines)


def _table_of_costs(cost: dict[str, float]) -> str:
    value, gradient = 1e3 * cost["value_s"], 1e3 * cost["gradient_s"]
    short, long = cost["bytes_a_run_240"] / 2**20, cost["bytes_a_run_3840"] / 2**20
    rows = (
        ("time over the value's, filter alone", f"{gradient:.0f} over {value:.0f} ms", cost["gradient_over_value"]),
        ("memory a run with the map, 3,840 over 240 steps", f"{long:.2f} over {short:.2f} MiB", cost["memory_ratio"]),
    )
    lines = [f"| {what} | {measured} | {ratio:.2f} |" for what, measured, ratio in rows]
    return "\n".join(["| gradient | measured | ratio |", "|---" * 3 + "|", *lines])


def _table_of_linear(rows: list[dict[str, Any]]) -> str:
    lines = ["| tuned by | seconds | position RMSE | yaw RMSE | ANEES (2) | 95 % ellipse holds |", "|---" * 6 + "|"]
    for row in rows:
        seconds = f"{row['seconds']:.1f}" if row["seconds"] else "–"
        lines.append(
            f"| {row['filter']} | {seconds} | {1e3 * row['rmse_position_m']:.2f} mm | "
            f"{1e3 * row['rmse_yaw_rad']:.2f} mrad | {readable(row['anees_of_2'])} | {100 * row['covered_95']:.1f} % |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    command_line(main)
