"""Tuning by gradient: what for, on what, how far, and how sure.

```python
import jax
from jaxlocmap import simulation, tuning

scenario, start = simulation.CAPSTONE, simulation.course_params()
batch = tuning.simulated(jax.random.key(0), 32, simulation.room(), simulation.Noise(), scenario=scenario)
objective = tuning.Objective(
    scenario.config(motion="euler", gate_probability=None, grid=False), (("innovation_nll", 1.0),)
)
found = tuning.fit(objective, start, batch, tuned=("range", "bearing"), epochs=4)
sure = tuning.standard_errors(objective, found.params, batch, ("range", "bearing"))
print(sure.estimate, sure.standard_error, sure.words)
```

`coordinates_objective` is the same as a function of free numbers for any other optimiser, with SciPy's in its
docstring.

| loss | asks for | needs |
|---|---|---|
| `innovation_nll` | likely innovations: -log of their density, a false reading allowed for | observations |
| `pose_nll` | the true pose likely under the belief: accuracy and honesty at once | truth |
| `mse` | small squared error, and nothing else | truth |
| `nees`, `nis` | errors (innovations) distributed as χ; alone they tell two parameters | truth (observations) |
| `map` | the next scan likely under the map before it: tunes `l_occ` and `l_free` | scans |

Q and R are tuned as logarithms of a Cholesky factor and the log-odds as logarithms, so no step can lead to an invalid
filter.

- The gate. A refused observation still pays, in `innovation_nll` what an outlier costs and in `nis` for its distance by
  its logarithm, so that refusing is no way to win and one outlier does not decide. With `Config.gate_temperature` the
  gate weighs instead of deciding: behind a hard one, what a step of a parameter lets in or shuts out changes the loss
  and stands in no derivative.
- Derivatives are taken forward. A filter has a handful of parameters and thousands of steps: the derivative is carried
  along with the state, and a gradient takes a few more states' memory, with a map in the loop two more maps, however
  long the drive.
- How sure. Standard errors come from the spread between sequences (the sandwich of the Hessian and the sequences'
  gradients), so they hold where the filter's model does not. Directions without curvature are named.
- The map. `map` asks what the next scan will see, of which the tuned model gives better calibrated answers. Where the
  walls of a simulated room are is another question: judged by them, the final map can be worse calibrated than before.

losses.py           what a filter can be tuned for, and `Objective`, a weighted sum
batch.py            what it is tuned on: sequences, padding, windows
filtering.py        the filter over all of them
parameters.py       coordinates in which nothing invalid exists
forward.py          derivatives by few numbers through long loops
slopes.py           the objective and its gradient, and what every sequence has in them
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
