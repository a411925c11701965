"""Can the covariance be believed? Statistics of normalised errors, what they say in words, and a report for any filter.

`judge` takes the poses and covariances of anybody's filter. The rest is what it, and the studies of simulated runs, are
made of. A study scores simulated runs and judges their totals:

```python
import jax
from jaxlocmap import simulation
from jaxlocmap.monte_carlo import monte_carlo
from jaxlocmap.consistency.study import Study, summarise

scenario, noise = simulation.LOOP, simulation.Noise(range=0.1)
config = scenario.config(motion="euler", gate_probability=None, grid=False)
scene = (simulation.own_params(noise, scenario), simulation.room(), noise, scenario.prior())
totals = monte_carlo(Study(scenario, config), jax.random.key(0), 100, *scene).value
report = summarise(totals, config)
print(report["anees"], report["anees_band_95"], report["verdict"])
```

Of many runs the bands come from the spread between them. Steps of one run are correlated: its band comes from the
correlation time of its NEES, the report says how many independent samples it is worth, and the verdict may be
"undecided".

How to read the NEES over time: it is the squared error of the pose, measured in the filter's own covariance. If that
covariance is honest, its mean over runs lies inside the band around 3 at 95 of 100 steps. Above it the filter is surer
than it may be, below it is too modest. The verdict says which way, by how much where x, y and yaw are off by the same
factor, and when. Some of what one sees is the study's and not the filter's:

- A start known exactly pulls the first steps down. `Scenario(exact_prior=False)` draws it from the prior.
- A gate of 0.99 removes one honest reading in a hundred, which leaves errors the covariance does not know of, and now
  and then a diverged run.
- So behind a gate or from an exact start the filter is judged beside a reference: the same study of a filter that is
  told the robot's own noise.
- The simulated robot moves in first-order steps, as the course's does, so `euler` is its exact model and `arc` is not;
  on a real robot it is the other way round.
- In the picture of a map, the arc of false wall 8 m ahead is the scanner's: noise is added after its readings are cut
  at 8 m.
"""

from jaxlocmap.consistency.innovations import Innovations
from jaxlocmap.consistency.judge import judge
from jaxlocmap.consistency.means import (
    Mean,
    binomial_interval,
    correlation_time,
    mean_lag_one,
    mean_over_runs,
    mean_over_time,
    ratio,
    student_t,
)
from jaxlocmap.consistency.report import AXES, PoseMeans, by_component, pose_fields, share_in_band
from jaxlocmap.consistency.statistics import (
    COVERAGE_LEVELS,
    WITHIN_TWO_SIGMA,
    PoseScore,
    chi2_band,
    chi2_quantile,
    nees,
    pose_error,
    score_pose,
    whiten,
)
from jaxlocmap.consistency.verdict import Basis, gate_verdict, readable, verdict

__all__ = [
    "AXES",
    "COVERAGE_LEVELS",
    "WITHIN_TWO_SIGMA",
    "Basis",
    "Innovations",
    "Mean",
    "PoseMeans",
    "PoseScore",
    "binomial_interval",
    "by_component",
    "chi2_band",
    "chi2_quantile",
    "correlation_time",
    "gate_verdict",
    "judge",
    "mean_lag_one",
    "mean_over_runs",
    "mean_over_time",
    "nees",
    "pose_error",
    "pose_fields",
    "ratio",
    "readable",
    "score_pose",
    "share_in_band",
    "student_t",
    "verdict",
    "whiten",
]
