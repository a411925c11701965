"""Tuning by gradient: what for, on what, how far, and how sure.

losses.py      what a filter can be tuned for, and `Objective`, a weighted sum
batch.py       what it is tuned on: sequences, padding, windows
filtering.py   the filter over all of them
parameters.py  coordinates in which nothing invalid exists
forward.py     derivatives by few numbers through long loops
fit.py         the descent
certainty.py   standard errors, correlations, and what the data cannot tell
"""

from jaxlocmap.tuning.batch import Batch, blocks, join, no_observations, pick, sequence, simulated, windows
from jaxlocmap.tuning.filtering import beliefs
from jaxlocmap.tuning.fit import Fit, coordinates_objective, fit
from jaxlocmap.tuning.losses import LOSSES, Objective, foreseen
from jaxlocmap.tuning.parameters import FULL_NOISE, NAMES, NOISE, SENSOR_MODEL, UNITS, constrain, natural, unconstrain
from jaxlocmap.tuning.standard_errors import Certainty, certainty

__all__ = [
    "FULL_NOISE",
    "LOSSES",
    "NAMES",
    "NOISE",
    "SENSOR_MODEL",
    "UNITS",
    "Batch",
    "Certainty",
    "Fit",
    "Objective",
    "beliefs",
    "blocks",
    "certainty",
    "constrain",
    "coordinates_objective",
    "fit",
    "foreseen",
    "join",
    "natural",
    "no_observations",
    "pick",
    "sequence",
    "simulated",
    "unconstrain",
    "windows",
]
