"""Simulated robots: keys in, `Truth` and `Inputs` out.

A world is data (walls, landmarks), so is the noise of the robot; both may differ from run to run under `vmap`.
"""

from jaxlocmap.simulation.graphs import simulate_graph
from jaxlocmap.simulation.robot import (
    Draws,
    detect,
    draw_detection,
    draw_drive,
    draw_scan,
    draw_start,
    draw_state,
    drive,
    roll_out,
    simulate,
    simulate_scan,
    targets,
)
from jaxlocmap.simulation.scenario import (
    BUILDING,
    CAPSTONE,
    LOOP,
    RANDOM_BUILDING,
    SCENARIOS,
    Detector,
    Noise,
    Scenario,
    course_params,
    own_motion,
    own_params,
)
from jaxlocmap.simulation.world import World, building, occupancy, random_building, random_room, ray_cast, room

__all__ = [
    "BUILDING",
    "CAPSTONE",
    "LOOP",
    "RANDOM_BUILDING",
    "SCENARIOS",
    "Detector",
    "Draws",
    "Noise",
    "Scenario",
    "World",
    "building",
    "course_params",
    "detect",
    "draw_detection",
    "draw_drive",
    "draw_scan",
    "draw_start",
    "draw_state",
    "drive",
    "occupancy",
    "own_motion",
    "own_params",
    "random_building",
    "random_room",
    "ray_cast",
    "roll_out",
    "room",
    "simulate",
    "simulate_graph",
    "simulate_scan",
    "targets",
]
