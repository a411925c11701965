"""The options of `tune`: which there are, what each applies to, and what is asked of its value."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Literal

from jaxlocmap import tuning
from jaxlocmap.cli.options import check_gate
from jaxlocmap.cli.tune_matching import MATCHING_NOISE
from jaxlocmap.cli.tune_sources import JUDGE_GATE, TUNING_GATE
from jaxlocmap.logs import MAX_GAP


@dataclasses.dataclass(frozen=True)
class TuneConfig:
    """Tune the noise a filter believes in, or its map's sensor model, on simulated drives or a log."""

    scenario: Literal["capstone", "loop"] | None = None
    """Simulated drives to tune on where there is no log, capstone by default."""
    match: bool = False
    """A filter that matches scans and observes no landmarks, on drives through rooms and buildings drawn anew."""
    log: Path | None = None
    """A log to tune on: a file for woods and carmen, a folder for mrclam."""
    format: Literal["woods", "mrclam", "carmen"] | None = None
    """How the log is written."""
    robots: tuple[int, ...] | None = None
    """Which robots of an mrclam log to tune on, by default 1 2 3."""
    judged: tuple[int, ...] | None = None
    """Which robots of an mrclam log to judge the result by, by default 4 5."""
    loss: tuple[str, ...] = ("innovation_nll",)
    """innovation_nll, pose_nll, mse, nees, nis, map; several with weights: pose_nll=1 nees=0.5."""
    tune: tuple[str, ...] | None = None
    """Which of v, w, v_w, range, bearing, range_bearing, l_occ, l_free, with --match also match_std, match_scale,
    map_length; by default what the losses depend on, with Q and R diagonal."""
    full: bool = False
    """Q and R with their correlations, where --tune does not say."""
    params: Path | None = None
    """JSON file to start from; by default the course's values, what the log states, or what fits the format."""
    motion: Literal["arc", "euler", "capstone"] | None = None
    """The filter's motion model, arc by default; a carmen log states the poses."""
    runs: int | None = None
    """Simulated runs to tune on, by default 512, with --quick 32; with --match 24 and 4."""
    judge_runs: int | None = None
    """Fresh simulated runs to judge by, by default 2,000, with --quick 100; with --match 100 and 4."""
    gate: float | None = TUNING_GATE
    """The gate while tuning, which weighs readings instead of deciding. It is for what is surely false: one that also
    refuses a good reading in a hundred pulls the result by some per cent."""
    judge_gate: float | None = JUDGE_GATE
    """The gate the result is judged with."""
    max_range: float | None = None
    """Of a log: observations at or beyond are left out, m; of a laser, where its beams end, 20 m by default."""
    max_gap: float | None = None
    """Of a woods or mrclam log: the longest interval over which a command holds and truth is interpolated, 1.5 s by
    default. In a longer gap of the odometry the robot is taken to stand."""
    resolution: float | None = None
    """Side of a cell of a carmen log's map, 0.1 m by default."""
    optimiser: Literal["lbfgs", "adam"] = "lbfgs"
    """L-BFGS on everything at every step, or Adam, which also goes with --minibatch."""
    minibatch: int | None = None
    """Sequences a step of Adam; all by default."""
    epochs: int | None = None
    """At most so many, by default 20, with --quick 2; after each the loss on sequences left aside is taken."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/tune")
    """Folder for params.json, report.json and the figures."""
    quick: bool = False
    """A run of a few seconds."""


_LOGS_OF_ROBOTS = ("woods", "mrclam")
_APPLIES = {  # to what is tuned on; options not named here apply to all
    "scenario": ("scenario",),
    "match": ("scenario",),
    "runs": ("scenario",),
    "judge_runs": ("scenario",),
    "robots": ("mrclam",),
    "judged": ("mrclam",),
    "motion": ("scenario", *_LOGS_OF_ROBOTS),
    "gate": ("scenario", *_LOGS_OF_ROBOTS),
    "judge_gate": ("scenario", *_LOGS_OF_ROBOTS),
    "max_range": (*_LOGS_OF_ROBOTS, "carmen"),
    "max_gap": _LOGS_OF_ROBOTS,
    "resolution": ("carmen",),
}
_DEFAULTS = {
    "scenario": "capstone",
    "motion": "arc",
    "robots": (1, 2, 3),
    "judged": (4, 5),
    "max_gap": MAX_GAP,
    "resolution": 0.1,
    "epochs": 20,
    "runs": 512,
    "judge_runs": 2000,
}
_QUICK = {"epochs": 2, "runs": 32, "judge_runs": 100}
_MATCHING, _QUICK_MATCHING = {"runs": 24, "judge_runs": 100}, {"runs": 4, "judge_runs": 4}
_LASER_RANGE = 20.0  # m
_RENAMED = {"innovation": "innovation_nll", "pose": "pose_nll", "state": "mse"}  # the losses' former names
_DEPENDS = {"map": tuning.SENSOR_MODEL}


def checked(config: TuneConfig) -> TuneConfig:
    """The options with their defaults filled in.

    Raises:
        ValueError: an option out of its range, or one that does not apply to what is tuned on.
    """
    if (config.log is None) != (config.format is None):
        raise ValueError(f"log, format: expected both or neither, got {config.log} and {config.format}")
    kind = config.format or "scenario"
    for name, kinds in _APPLIES.items():
        value = getattr(config, name)
        if value != getattr(TuneConfig, name) and kind not in kinds:
            here = "a scenario" if kind == "scenario" else f"a {kind} log"
            raise ValueError(
                f"{name}: applies to {' and '.join(kinds)}, not to {here}: expected it not to be given, got {value}"
            )
    _check_values(config)
    _check_combinations(config)
    defaults = _DEFAULTS | (_QUICK if config.quick else {})
    if config.match:
        defaults |= _QUICK_MATCHING if config.quick else _MATCHING
    if kind == "carmen":
        defaults["max_range"] = _LASER_RANGE
    absent = {name: value for name, value in defaults.items() if getattr(config, name) is None}
    return dataclasses.replace(config, **absent)


def _check_values(config: TuneConfig) -> None:
    for name, least in (("runs", 2), ("judge_runs", 2), ("epochs", 1), ("minibatch", 1)):
        value = getattr(config, name)
        if value is not None and not isinstance(value, int):
            raise ValueError(f"{name}: expected a whole number, got {value!r}")
        if value is not None and value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    for name, unit in (("max_range", "metres"), ("resolution", "metres"), ("max_gap", "seconds")):
        value = getattr(config, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"{name}: expected {unit} > 0, finite, got {value}")
    for name in ("gate", "judge_gate"):
        check_gate(getattr(config, name), name)
    for name in ("robots", "judged", "tune"):
        given = getattr(config, name) or ()
        if len(set(given)) < len(given):
            raise ValueError(f"{name}: expected each once, got {' '.join(map(str, given))}")


def _check_combinations(config: TuneConfig) -> None:
    losses = [name for name, _ in loss_weights(config)]
    if config.minibatch is not None and config.optimiser != "adam":
        raise ValueError(
            f"minibatch: L-BFGS wants everything at every step: expected --optimiser adam, got {config.optimiser}"
        )
    if config.full and (config.tune is not None or set(losses) == {"map"}):
        raise ValueError("full: applies where Q and R are tuned and --tune is not given: expected it not to be given")
    if config.format == "carmen" and losses != ["map"]:
        raise ValueError(f"loss: a carmen log has no landmarks: expected `map` alone, got {', '.join(losses)}")
    if config.match and config.scenario is not None:
        raise ValueError(f"scenario: with match each drive has its own world: expected none, got {config.scenario}")
    if config.match and (config.full or any(name in ("innovation_nll", "nis", "map") for name in losses)):
        got = ", ".join(losses) + (" and full" if config.full else "")
        raise ValueError(f"loss, full: with match nothing is observed: expected pose_nll, mse or nees alone, got {got}")
    noise = [name for name in config.tune or () if name not in tuning.SENSOR_MODEL]
    if config.format == "carmen" and noise:
        raise ValueError(
            f"tune: a carmen log's map depends on {', '.join(tuning.SENSOR_MODEL)} alone, got {', '.join(noise)}"
        )
    if config.format in _LOGS_OF_ROBOTS and "map" in losses:
        raise ValueError(f"loss: expected none of a map, for the format {config.format} has no scans, got `map`")


def loss_weights(config: TuneConfig) -> tuple[tuple[str, float], ...]:
    """The losses and what each weighs.

    Raises:
        ValueError: no loss, one that does not exist or is named twice, or a weight that is not positive.
    """
    weights = {}
    for loss in config.loss:
        name, given, weight = loss.partition("=")
        try:
            value = float(weight if given else 1)
        except ValueError:
            raise ValueError(f"loss: expected NAME or NAME=WEIGHT, got {loss!r}") from None
        name = _RENAMED.get(name, name)
        if name not in tuning.LOSSES:
            raise ValueError(f"loss: expected one of {', '.join(sorted(tuning.LOSSES))}, got {name!r}")
        if name in weights or not 0 < value < math.inf:
            raise ValueError(f"loss: expected each once, with a positive weight, got {' '.join(config.loss)}")
        weights[name] = value
    if not weights:
        raise ValueError("loss: expected at least one, got none")
    return tuple(weights.items())


def tuned_parameters(config: TuneConfig) -> tuple[str, ...]:
    """What `tune` names, or else what the losses depend on."""
    if config.tune is not None:
        return config.tune
    if config.match:
        return MATCHING_NOISE
    noise = tuning.FULL_NOISE if config.full else tuning.NOISE
    names = [name for loss, _ in loss_weights(config) for name in _DEPENDS.get(loss, noise)]
    return tuple(name for name in tuning.NAMES if name in names)
