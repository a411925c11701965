"""Scan matching against other ways, on the same simulated drives without landmarks: how accurate, and how honest."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from baselines import scan_filters
from baselines.scan_filters import ON_LINES, ON_OCCUPANCY
from common import (
    CONSOLE,
    command_line,
    output_folder,
    progress_bar,
    replace_table,
    saved,
    scenario_world,
    write_report,
)

from jaxlocmap import Gaussian, Params, consistency, plotting, simulation
from jaxlocmap.consistency import readable
from jaxlocmap.matching.submaps import with_defaults
from jaxlocmap.monte_carlo import hosts, monte_carlo
from jaxlocmap.types import Config, Matcher

_EXACT = (1e-3, 1e-3, 1e-3)  # m, m, rad: how well the start is known
_MATCHER = Matcher(period=5, gap=0.8)  # the ends of 61 beams lie far apart
_STEPS = {"loop": 2400, "building": 7200}
_CHUNK = 5  # runs at once: their maps are large


@dataclasses.dataclass(frozen=True)
class MatchingConfig:
    """What to compare on."""

    runs: int = 50
    """Simulated runs of either world."""
    write: bool = False
    """Put the table into the README."""
    seed: int = 0
    """Of all randomness."""
    out: Path = Path("out/matching_compare")
    """Folder for report.json and matching_compare.png."""
    quick: bool = False
    """A run of a few seconds: four runs of 20 s."""


class Way(NamedTuple):
    """One filter."""

    name: str
    filter: str  # of `scan_filters`
    law: int | None = None  # which covariance


def _ways() -> tuple[Way, ...]:
    occupancy = {
        "inverse_hessian": "occupancy grid, absolute, σ² H⁻¹",
        "hessian": "the same, H itself (Hector SLAM)",
        "with_prior": "the same, optimiser's with its prior (Cartographer 0.1)",
        "sandwich": "the same, sandwich",
        "sandwich_times_30": "the same, sandwich × 30",
    }
    lines = {
        "inverse_hessian": "map of lines, absolute, σ² H⁻¹",
        "sandwich": "the same, sandwich",
        "sandwich_times_30": "the same, sandwich × 30",
        "response_moments": "the same, moments of the response (Olson; Karto)",
        "unscaled": "the same, (JᵀJ)⁻¹ without σ²",
    }
    return (
        Way("odometry alone", "odometry"),
        *(Way(occupancy[law.__name__], "on_occupancy", i) for i, law in enumerate(ON_OCCUPANCY)),
        *(Way(lines[law.__name__], "on_lines", i) for i, law in enumerate(ON_LINES)),
        Way("point-to-line ICP on keyframes, cloned", "on_keyframes"),
        Way("this library: submaps, anchor and bias", "on_submaps"),
    )


class Scores(NamedTuple):
    """Of one run, after each match. T matches."""

    nees: jax.Array  # (T,)
    error: jax.Array  # (T, 3) m, m, rad


@dataclasses.dataclass(frozen=True)
class Drive:
    """One simulated run, filtered in one way and scored. Hashable, so that `monte_carlo` compiles it once."""

    scenario: simulation.Scenario
    config: Config
    filter: str  # of `scan_filters`

    def __call__(
        self,
        key: jax.Array,
        params: Params,
        world: simulation.World,
        noise: simulation.Noise,
        prior: Gaussian,
        law: jax.Array | None,
    ) -> Scores:
        """Scores of the run that `key` stands for, the same run whatever the filter."""
        start, key = jax.random.split(key)
        state = simulation.draw_start(start, prior, scenario=self.scenario)
        truth, inputs = simulation.simulate(key, world, noise, state, scenario=self.scenario)
        belief = getattr(scan_filters, self.filter)(
            params,
            prior,
            inputs,
            scanner=self.config.scanner(self.scenario.beam_angles()),
            config=self.config,
            **({} if law is None else {"law": law}),
        )
        error = jax.vmap(consistency.pose_error)(truth.pose[:: _MATCHER.period], belief.mean)
        return Scores(jax.vmap(consistency.nees)(error, belief.cov), error)
