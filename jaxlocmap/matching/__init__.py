"""Scans matched on a map made of the scans before: normals, the map of lines, one match, submaps in the filter.

With `Config.matcher` every scan, or every so many steps one, is matched on what those before it saw, with landmarks or
without; `Info.match` holds what came of it:

```python
import dataclasses
import jax
from jaxlocmap import Gaussian, Matcher, init, run, simulation
from jaxlocmap.matching.submaps import refusals, with_defaults

scenario = simulation.LOOP
matcher = Matcher(period=5, gap=0.8)  # the ends of the 61 beams lie far apart
config = dataclasses.replace(scenario.config(motion="euler", grid=False), matcher=matcher)
params = with_defaults(simulation.own_params(simulation.Noise(), scenario))  # adds what matching is tuned by
start = scenario.prior().mean
truth, inputs = simulation.simulate(jax.random.key(0), simulation.room(), simulation.Noise(), start, scenario=scenario)
state = init(Gaussian(start, jax.numpy.zeros((3, 3))), config=config)
beam_angles = scenario.beam_angles()
blind = inputs._replace(valid=jax.numpy.zeros_like(inputs.valid))  # of landmarks: the scans alone
world = simulation.room()
state, info = run(params, state, blind, landmarks=world.landmarks, beam_angles=beam_angles, config=config)
pose = info.belief.pose  # of every step; the rest of the state is the submaps'
print(truth.pose[-1], pose.mean[-1], pose.cov[-1], info.match.accepted.sum())
print(refusals(info.match, matcher).nis.sum(), info.match.edge.mean[info.match.finished][0])
```

`Matcher(submap_scans=None)` keeps one map for the whole drive, and with `known_std` it is one that is known
(`submaps.known`). `scan_match.match` is a match by itself, on bare arrays.

Taken for an absolute measurement, a match makes a filter over-confident whichever covariance it is given, because map
and pose share their errors; so it is taken relative to the anchor of the submap, which is part of the state.
"""
