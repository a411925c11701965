"""Is SLAM consistent to the end? Simulated drives without landmarks: scans matched on submaps, loops found by the
program itself, the pose graph optimised, and every pose scored against its covariance.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from evidence import replace_table

from jaxlocmap import Config, Gaussian, Matcher, Params, consistency, init, plotting, run, simulation
from jaxlocmap.cli.command import command_line
from jaxlocmap.cli.console import CONSOLE, output_folder, progress_bar, saved, show, write_report
from jaxlocmap.consistency import readable
from jaxlocmap.graph import Graph, dead_reckoning, solve, stack, tune_scales
from jaxlocmap.graph.closure import Closed, Closure, close_loops, scan_poses
from jaxlocmap.graph.kernels import Kernel
from jaxlocmap.graph.trail import Trail, trail_of
from jaxlocmap.matching.submaps import BLOCKS, with_defaults
from jaxlocmap.monte_carlo.hosts import merge_kernels
from jaxlocmap.poses import between, wrapped
from jaxlocmap.replay.loops import is_false, surfaces
from jaxlocmap.se2 import POSE
from jaxlocmap.simulation import MATCH_GAP, scenario_of, with_known_start, world_of

_CHUNK = 5  # runs that are simulated at once


@dataclasses.dataclass(frozen=True)
class SlamStudyConfig:
    """What is simulated, and how loops are closed."""

    scenario: Literal["loop", "building"] = "building"
    """The world and the drive."""
    runs: int = 100
    """Drives, each with its own noise."""
    steps: int | None = None
    """Of a drive; all of the scenario by default."""
    match_every: int = 5
    """Steps between two scans that are matched."""
    scan_noise: float = 0.03
    """Standard deviation of a range, m."""
    odometry_noise: float = 1.0
    """Times the usual errors of the wheels; the filter is told."""
    kernel: Literal["gnc", "quadratic", "huber", "cauchy", "geman_mcclure", "dcs"] = "gnc"
    """How loops count that do not fit the others."""
    edge_scale: float = 1.0
    """Standard deviations of edges between submaps and of scans in them, times this."""
    loop_scale: float = 1.0
    """Standard deviations of loops, times this."""
    tune: bool = False
    """Find by gradient the two scales at which the true anchors are most likely; judge them on the other world."""
    write: bool = False
    """Put the table into experiments/README.md."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/slam_study")
    """Folder for report.json and slam.png."""
    quick: bool = False
    """Two runs of at most 1,500 steps."""


@dataclasses.dataclass
class Scores:
    """What the runs say, a list with one entry a run."""

    before: list[np.ndarray] = dataclasses.field(default_factory=list)  # (S, 4) of `_scored`
    after: list[np.ndarray] = dataclasses.field(default_factory=list)
    edges: list[np.ndarray] = dataclasses.field(default_factory=list)  # NEES of the filter's edges between submaps
    loops: list[np.ndarray] = dataclasses.field(default_factory=list)  # NEES of the loops accepted
    tried: int = 0
    kept: int = 0
    false_accepted: int = 0
    false_kept: int = 0
    false_refused: int = 0
    not_converged: int = 0
    graphs: list[tuple[Graph, np.ndarray]] = dataclasses.field(default_factory=list)  # each with its true anchors


def main(config: SlamStudyConfig) -> dict[str, Any]:
    """Simulate, close loops, score; write the report and the figure."""
    out = output_folder(config.out)
    if config.runs < 1:
        raise ValueError(f"runs: expected at least 1, got {config.runs}")
    for name in ("scan_noise", "odometry_noise", "edge_scale", "loop_scale"):
        if not 0 < getattr(config, name) < np.inf:
            raise ValueError(f"{name}: expected a finite number > 0, got {getattr(config, name)}")
    if not config.tune:  # the compiler can abort on derivatives of such kernels
        merge_kernels()
    began = time.perf_counter()
    study = SlamDrives(config)
    runs = min(config.runs, 2) if config.quick else config.runs
    CONSOLE.print(f"{runs} runs of {config.scenario}, {study.scenario.steps} steps each; compiling takes some seconds")
    scores = Scores()
    keys = jax.random.split(jax.random.key(config.seed), -(-runs // _CHUNK) * _CHUNK)
    with progress_bar("runs", runs) as progress:
        for k in range(0, runs, _CHUNK):
            drives = jax.tree.map(np.asarray, study.drives(keys[k : k + _CHUNK]))
            for i in range(min(_CHUNK, runs - k)):
                study.score(scores, *jax.tree.map(lambda x, i=i: x[i], drives))
                progress(k + i + 1)
    report = {"scenario": config.scenario, "runs": runs, "seed": config.seed, **_summary(scores)}
    if config.tune:
        write_report(out, report)  # what the runs say is not lost if no scales are found
        report["tuned"] = _tuned(scores.graphs)
    report["wall_s"] = time.perf_counter() - began
    write_report(out, report)
    seconds = study.scenario.dt * config.match_every
    plotting.slam_figure(out / "slam.png", np.stack(scores.before), np.stack(scores.after), seconds, config.scenario)
    _show(report)
    if config.write:
        replace_table(f"slam-{config.scenario}", _table(report))
    saved(out, "report.json", "slam.png")
    return report


class SlamDrives:
    """The simulation and the filter, compiled once, and the scoring of a drive."""

    def __init__(self, config: SlamStudyConfig) -> None:
        self._config = config
        scenario = with_known_start(scenario_of(config.scenario))
        steps = config.steps or scenario.steps
        self.scenario = dataclasses.replace(scenario, steps=min(steps, 1500) if config.quick else steps)
        usual, times = simulation.Noise(), config.odometry_noise
        self._noise = usual._replace(
            v=usual.v * times, w=usual.w * times, heading=usual.heading * times, scan=config.scan_noise
        )
        world = world_of(scenario)
        self.world = world._replace(landmarks=world.landmarks[:0])
        self._matcher = Matcher(period=config.match_every, gap=MATCH_GAP)
        settings = self.scenario.config(motion="euler", gate_probability=0.99, grid=False)
        self._settings: Config = dataclasses.replace(settings, matcher=self._matcher)
        own = simulation.own_params(self._noise, self.scenario)
        self.params: Params = with_defaults(own, std=config.scan_noise)
        self.drives = jax.jit(jax.vmap(self._drive))

    def _drive(self, key: jax.Array) -> Any:
        """One drive at the steps at which a scan is due: true poses, scans, reports."""
        start_key, key = jax.random.split(key)
        prior: Gaussian = self.scenario.prior()
        start = simulation.draw_start(start_key, prior, scenario=self.scenario)
        truth, inputs = simulation.simulate(key, self.world, self._noise, start, scenario=self.scenario)
        _, report = run(
            self.params,
            init(prior, config=self._settings),
            inputs,
            landmarks=self.world.landmarks,
            beam_angles=self.scenario.beam_angles(),
            config=self._settings,
            collect=lambda state, info, aside: info.match,
        )
        due = slice(0, None, self._matcher.period)
        return jax.tree.map(lambda x: x[due], (truth.pose, inputs.ranges, report))

    def closed(self, truth: np.ndarray, ranges: np.ndarray, report: Any) -> tuple[Trail, Closed]:
        """The trail of one drive, and its loops closed, the first anchor given. In float64."""
        trail = trail_of(report).scaled(self._config.edge_scale)
        std, scale, _ = (jnp.asarray(self.params.block(block), jnp.float32) for block in BLOCKS)
        points = surfaces(ranges, self.scenario.beam_angles(), self._settings)
        with jax.enable_x64(True):
            return trail, close_loops(
                trail,
                points,
                std,
                scale,
                spec=self._matcher.spec,
                closure=Closure(scale=self._config.loop_scale),
                first=truth[trail.begun[0]].astype(np.float64),
                kernel=Kernel(self._config.kernel),
            )

    def score(self, scores: Scores, truth: np.ndarray, ranges: np.ndarray, report: Any) -> None:
        """Close the loops of one drive and add its scores."""
        trail, closed = self.closed(truth, ranges, report)
        truth = truth.astype(np.float64)
        with jax.enable_x64(True):
            alone = without_loops(closed)
            for into, one in ((scores.before, alone), (scores.after, closed)):
                into.append(_scored(trail, one, truth))
        anchors = truth[trail.begun]
        scores.graphs.append((closed.graph, anchors))
        scores.edges.append(_nees(between(anchors[:-1], anchors[1:]) - trail.edge, trail.edge_cov))
        self._score_loops(scores, trail, closed, truth)
        scores.not_converged += not bool(closed.solution.converged)

    def _score_loops(self, scores: Scores, trail: Trail, closed: Closed, truth: np.ndarray) -> None:
        attempts, (i, j) = closed.attempts, closed.attempts.pair.T
        moved, cov = (np.asarray(x, np.float64) for x in (attempts.found.moved, attempts.found.cov))
        anchors, accepted = truth[trail.begun], attempts.accepted
        scores.loops.append(_nees(between(anchors[i], anchors[j]) - moved, cov)[accepted])
        # Judged where they were matched, at the submaps' middles: an anchor lies metres from there.
        a, b = trail.middle[i], trail.middle[j]
        false = is_false(trail, truth, a, b, moved)
        kept = np.zeros_like(accepted)
        kept[np.flatnonzero(accepted)] = np.asarray(closed.solution.weights)[: accepted.sum()] > 0.5
        scores.tried += len(accepted)
        scores.kept += int(kept.sum())
        scores.false_accepted += int(np.sum(false & accepted))
        scores.false_kept += int(np.sum(false & kept))
        scores.false_refused += int(np.sum(false & ~accepted))


def without_loops(closed: Closed) -> Closed:
    """The same trail with its loops left open."""
    graph = closed.graph._replace(loop_information=0 * closed.graph.loop_information)
    return closed._replace(graph=graph, solution=solve(graph, dead_reckoning(graph, closed.solution.poses[0])))


def _tuned(runs: list[tuple[Graph, np.ndarray]]) -> dict[str, float]:
    """The scales at which the true anchors are most likely, times those that the graphs were made with."""
    most = max(len(anchors) for _, anchors in runs)
    known = np.array([np.arange(most) < len(anchors) for _, anchors in runs])
    truth = np.zeros((len(runs), most, POSE))
    for into, (_, anchors) in zip(truth, runs, strict=True):
        into[: len(anchors)] = anchors
    with jax.enable_x64(True):
        graphs = stack([graph for graph, _ in runs])
        scales, before, after = tune_scales(graphs, jnp.asarray(truth), jnp.asarray(known))
    return {"edges": float(scales.odometry), "loops": float(scales.loop), "nll_before": before, "nll_after": after}


def _scored(trail: Trail, closed: Closed, truth: np.ndarray) -> np.ndarray:
    """(S, 4) of every scan: squared error of position m² and of heading rad², NEES, and the variance of position m²."""
    poses, cov = scan_poses(trail, closed)
    error = truth - poses
    error[:, 2] = wrapped(error[:, 2])
    known = cov[:, 0, 0] > 0  # the first anchor is given
    nees = np.full(len(error), np.nan)
    nees[known] = _nees(error[known], cov[known])
    return np.stack([(error[:, :2] ** 2).sum(1), error[:, 2] ** 2, nees, cov[:, 0, 0] + cov[:, 1, 1]], axis=-1)


def _nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    error = error.copy()
    error[:, 2] = wrapped(error[:, 2])
    return np.einsum("ki,kij,kj->k", error, np.linalg.inv(cov), error)


def _summary(scores: Scores) -> dict[str, Any]:
    runs = len(scores.after)
    loops = [x for x in scores.loops if len(x)]
    accepted = sum(map(len, scores.loops))
    fields: dict[str, Any] = {}
    for name, of_runs in (
        ("before", [x[:, 2] for x in scores.before]),
        ("after", [x[:, 2] for x in scores.after]),
        ("last_pose", [x[-1:, 2] for x in scores.after]),
        ("edges", scores.edges),
        ("loops", loops),
    ):
        means = np.array([np.nanmean(x) for x in of_runs if len(x)])
        mean = consistency.mean_over_runs(float(means.sum()), float((means**2).sum()), len(means), POSE)
        fields |= {f"{name}_anees": mean.value, f"{name}_anees_band_95": mean.band_95}
    for name, of_runs in (("before", scores.before), ("after", scores.after)):
        every = np.stack(of_runs)
        fields |= {
            f"{name}_rmse_position_m": float(np.sqrt(every[..., 0].mean())),
            f"{name}_rmse_yaw_rad": float(np.sqrt(every[..., 1].mean())),
            f"{name}_sigma_position_m": float(np.sqrt(np.nanmean(every[..., 3]))),
        }
    return fields | {
        "loops_tried": scores.tried / runs,
        "loops_accepted": accepted / runs,
        "loops_kept": scores.kept / runs,
        "false_loops_accepted": scores.false_accepted,
        "false_loops_kept": scores.false_kept,
        "false_loops_refused": scores.false_refused,
        "not_converged": scores.not_converged,
    }


def _table(report: dict[str, Any]) -> str:
    rows = ["| loops | position RMSE | 1 sigma | heading RMSE | ANEES of all poses (3) |", "|---|---|---|---|---|"]
    for name, what in (("before", "open"), ("after", "closed")):
        rows.append(
            f"| {what} | {report[f'{name}_rmse_position_m']:.3f} m | {report[f'{name}_sigma_position_m']:.3f} m "
            f"| {report[f'{name}_rmse_yaw_rad']:.4f} rad | {readable(report[f'{name}_anees'])} |"
        )
    return "\n".join(rows)


def _show(report: dict[str, Any]) -> None:
    def anees(name: str) -> tuple[str, str]:
        low, high = report[f"{name}_anees_band_95"]
        return readable(report[f"{name}_anees"]), f"[{low:.3g}, {high:.3g}]"

    rows = [
        ("position RMSE before, after", _pair(report, "rmse_position_m", "m"), ""),
        ("  1 sigma of the covariance", _pair(report, "sigma_position_m", "m"), ""),
        ("heading RMSE before, after", _pair(report, "rmse_yaw_rad", "rad"), ""),
        ("average NEES before", *anees("before")),
        ("average NEES after", *anees("after")),
        ("  of the last pose", *anees("last_pose")),
        ("  of edges between submaps", *anees("edges")),
        ("  of accepted loops", *anees("loops")),
        (
            "loops a run: tried, accepted, kept",
            ", ".join(f"{report[f'loops_{name}']:.1f}" for name in ("tried", "accepted", "kept")),
            "",
        ),
        ("false loops: refused, accepted, kept", _counts(report), "any, 0, 0"),
        ("graphs not converged", str(report["not_converged"]), "0"),
    ]
    if "tuned" in report:
        tuned = report["tuned"]
        rows += [
            ("scales at which the true anchors are most likely", f"{tuned['edges']:.3f}, {tuned['loops']:.3f}", "1, 1"),
            ("  nats an anchor, before and after", f"{tuned['nll_before']:.3f}, {tuned['nll_after']:.3f}", ""),
        ]
    show(f"{report['scenario']}, {report['runs']} runs, in {report['wall_s']:.0f} s", rows)


def _pair(report: dict[str, Any], name: str, unit: str) -> str:
    return f"{report[f'before_{name}']:.3g}, {report[f'after_{name}']:.3g} {unit}"


def _counts(report: dict[str, Any]) -> str:
    return ", ".join(str(report[f"false_loops_{name}"]) for name in ("refused", "accepted", "kept"))


if __name__ == "__main__":
    command_line(main)
