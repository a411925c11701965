"""Simulated robots: keys in, `Truth` and `Inputs` out.

A world is data (walls, landmarks), so is the noise of the robot; both may differ from run to run under `vmap`.
"""

from jaxlocmap.simulation.robot import (
    Draws,
    draw_drive,
    draw_pose,
    draw_scan,
    draw_sighting,
    drive,
    look_round,
    roll_out,
    sight,
    simulate,
)
from jaxlocmap.simulation.scenario import CAPSTONE, LOOP, SCENARIOS, Noise, Scenario, course_params, own_params
from jaxlocmap.simulation.world import World, occupancy, random_room, ray_cast, room

__all__ = [
    "CAPSTONE",
    "LOOP",
    "SCENARIOS",
    "Draws",
    "Noise",
    "Scenario",
    "World",
    "course_params",
    "draw_drive",
    "draw_pose",
    "draw_scan",
    "draw_sighting",
    "drive",
    "look_round",
    "occupancy",
    "own_params",
    "random_room",
    "ray_cast",
    "roll_out",
    "room",
    "sight",
    "simulate",
]
