"""Scenarios like others, and short simulated drives to tune on."""

import dataclasses
import functools

import jax

from jaxlocmap import GridSpec, simulation, tuning


def like(scenario, *, detector=None, robot=None, **changes):
    """A scenario with some fields changed, of its detector and its robot too."""
    detector = dataclasses.replace(scenario.detector, **(detector or {}))
    robot = dataclasses.replace(scenario.robot, **(robot or {}))
    return dataclasses.replace(scenario, detector=detector, robot=robot, **changes)


# In sight of all four landmarks, which the detector reports in every second step.
SHORT = like(
    simulation.CAPSTONE,
    name="short",
    start=(6.0, 8.5, 0.5),
    steps=12,
    beams=9,
    detector=dict(period=2),
    robot=dict(grid=GridSpec(origin=(0.0, 0.0), resolution=0.6, shape=(20, 20))),
)
OWN = simulation.own_params(simulation.Noise(), SHORT)
CONFIG = SHORT.config(motion="euler", gate_probability=0.9999)
ONLY_POSES = SHORT.config(motion="euler", gate_probability=0.9999, grid=False)


@functools.cache
def _simulated(runs, seed, scans):
    with jax.ensure_compile_time_eval():  # kept, so no part of whatever is traced when it is first asked for
        return tuning.simulated(
            jax.random.key(seed), runs, simulation.room(), simulation.Noise(), scenario=SHORT, scans=scans
        )


def drives(runs=4, seed=0, scans=True):
    """A batch of simulated drives: the same with scans and, in half the time, without."""
    return _simulated(runs, seed, scans)
