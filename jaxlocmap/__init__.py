"""Localisation and mapping whose covariance can be believed, or shown not to be: a pure-functional JAX library."""

from jaxlocmap import consistency, motion, sensors, simulation
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid
from jaxlocmap.motion import MotionModel
from jaxlocmap.pipeline import init, map_scans, run, step
from jaxlocmap.types import Config, Gaussian, GridSpec, Info, Inputs, Params, State, Truth

__all__ = [
    "Config",
    "Gaussian",
    "GridSpec",
    "Info",
    "Inputs",
    "MotionModel",
    "Params",
    "State",
    "Truth",
    "consistency",
    "ekf",
    "grid",
    "init",
    "map_scans",
    "motion",
    "run",
    "sensors",
    "simulation",
    "step",
]
