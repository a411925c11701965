"""Localisation and mapping whose covariance can be believed, or shown not to be: a pure-functional JAX library.

`init`, `step` and `run` are the filter, `simulation` the robots it is tried on. `Study` with `monte_carlo` scores it
over thousands of runs and `summarise` says whether it is consistent; `judge` says the same of anybody's filter.
`tuning` finds its noise by gradient, `graph` closes loops, `logs` and `replay` take it to recorded drives.
`jaxlocmap.plotting` draws, and needs the extra `plot`; the command `jaxlocmap` does all of this from a shell, and needs
the extra `cli`.
"""

from jaxlocmap import consistency, graph, logs, monte_carlo, motion, parameters, replay, sensors, simulation, tuning
from jaxlocmap.consistency import judge
from jaxlocmap.consistency.study import Study, summarise
from jaxlocmap.filters import ekf
from jaxlocmap.mapping import grid
from jaxlocmap.motion import MotionModel
from jaxlocmap.parameters import Block, Params
from jaxlocmap.pipeline import init, map_scans, run, step
from jaxlocmap.sensors import Sensor
from jaxlocmap.smoothing import smooth
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
    "Study",
    "Truth",
    "consistency",
    "ekf",
    "graph",
    "grid",
    "init",
    "judge",
    "logs",
    "map_scans",
    "monte_carlo",
    "motion",
    "parameters",
    "replay",
    "run",
    "sensors",
    "simulation",
    "smooth",
    "step",
    "summarise",
    "tuning",
]
