"""Localisation and mapping whose covariance can be believed, or shown not to be: a pure-functional JAX library."""

from jaxlocmap import consistency, motion, parameters, sensors, simulation
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid
from jaxlocmap.motion import MotionModel
from jaxlocmap.parameters import Block, Params
from jaxlocmap.pipeline import init, map_scans, run, step
from jaxlocmap.sensors import Sensor
from jaxlocmap.types import Config, Gaussian, GridSpec, Info, Inputs, Matcher, Scanner, State, Truth

__all__ = [
    "Block",
    "Config",
    "Gaussian",
    "GridSpec",
    "Info",
    "Inputs",
    "Matcher",
    "MotionModel",
    "Params",
    "Scanner",
    "Sensor",
    "State",
    "Truth",
    "consistency",
    "ekf",
    "grid",
    "init",
    "map_scans",
    "motion",
    "parameters",
    "run",
    "sensors",
    "simulation",
    "step",
]
