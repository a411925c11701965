"""Scenarios like others, and short simulated drives to tune on."""

import dataclasses
import functools

import jax

from jaxlocmap import GridSpec, simulation, tuning


def with_robot(scenario, **changes):
    """The scenario with other settings of its robot."""
    return dataclasses.replace(scenario, robot=dataclasses.replace(scenario.robot, **changes))


def with_detector(scenario, **changes):
    """The scenario with another detector of landmarks."""
    return dataclasses.replace(scenario, detector=dataclasses.replace(scenario.detector, **changes))


# In sight of all four landmarks, which the detector looks for in every second step.
SHORT = with_detector(
    with_robot(
        dataclasses.replace(simulation.CAPSTONE, name="short", start=(6.0, 8.5, 0.5), steps=12, beams=9),
        grid=GridSpec(origin=(0.0, 0.0), resolution=0.6, shape=(20, 20)),
    ),
    period=2,
)
OWN = simulation.own_params(simulation.Noise(), SHORT)
CONFIG = SHORT.config(motion="euler", gate_probability=0.9999)
ONLY_POSES = SHORT.config(motion="euler", gate_probability=0.9999, grid=False)


@functools.cache
def _simulated(runs, seed):
    with jax.ensure_compile_time_eval():  # kept, so no part of whatever is traced when it is first asked for
        return tuning.simulated(
            jax.random.key(seed), runs, simulation.room(), simulation.Noise(), scenario=SHORT, scans=True
        )


def drives(runs=4, seed=0, scans=True):
    """A batch of simulated drives."""
    batch = _simulated(runs, seed)
    return batch if scans else batch._replace(inputs=batch.inputs._replace(ranges=None), beam_angles=None)
