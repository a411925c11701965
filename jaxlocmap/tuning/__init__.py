"""Tuning by gradient: what for, on what, how far, and how sure.

losses.py           what a filter can be tuned for, and `Objective`, a weighted sum
batch.py            what it is tuned on: sequences, padding, windows
filtering.py        the filter over all of them
parameters.py       coordinates in which nothing invalid exists
forward.py          derivatives by few numbers through long loops
fit.py              the descent
standard_errors.py  standard errors, correlations, and what the data cannot tell
"""

from jaxlocmap.tuning.batch import Batch, blocks, join, no_observations, pick, sequence, simulated, windows
from jaxlocmap.tuning.filtering import beliefs
from jaxlocmap.tuning.fit import Fit, coordinates_objective, fit
from jaxlocmap.tuning.losses import LOSSES, Objective, predictive_score
from jaxlocmap.tuning.parameters import (
    FULL_NOISE,
    NAMES,
    NOISE,
    SENSOR_MODEL,
    UNITS,
    blocks_of,
    constrain,
    names_of,
    natural,
    unconstrain,
    units_of,
)
from jaxlocmap.tuning.standard_errors import StandardErrors, standard_errors

__all__ = [
    "FULL_NOISE",
    "LOSSES",
    "NAMES",
    "NOISE",
    "SENSOR_MODEL",
    "UNITS",
    "Batch",
    "Fit",
    "Objective",
    "StandardErrors",
    "beliefs",
    "blocks",
    "blocks_of",
    "constrain",
    "coordinates_objective",
    "fit",
    "join",
    "names_of",
    "natural",
    "no_observations",
    "pick",
    "predictive_score",
    "sequence",
    "simulated",
    "standard_errors",
    "unconstrain",
    "units_of",
    "windows",
]
