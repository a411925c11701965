"""Figures for people: units on the axes, bands and legends in them. NumPy in, a file out. Nowhere else: matplotlib.

Raises:
    ModuleNotFoundError: matplotlib is not installed, which the extra `plot` brings.
"""

import importlib.util

if importlib.util.find_spec("matplotlib") is None:
    raise ModuleNotFoundError("matplotlib is not installed: expected pip install 'jaxlocmap[plot]'", name="matplotlib")

from jaxlocmap.plotting.graphs import graph_figure, slam_figure
from jaxlocmap.plotting.maps import map_figure, trajectory_figure
from jaxlocmap.plotting.studies import (
    judge_figure,
    matching_figure,
    precision_figure,
    study_figure,
    sweep_figure,
)
from jaxlocmap.plotting.tuning import (
    calibration_figure,
    descent_figure,
    log_before_after_figure,
    study_before_after_figure,
)

__all__ = [
    "calibration_figure",
    "descent_figure",
    "graph_figure",
    "judge_figure",
    "log_before_after_figure",
    "map_figure",
    "matching_figure",
    "precision_figure",
    "slam_figure",
    "study_before_after_figure",
    "study_figure",
    "sweep_figure",
    "trajectory_figure",
]
