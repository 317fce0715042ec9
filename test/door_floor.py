"""A hallway with two doors to its north, as a simulated world that robots map and drive in."""

import numpy as np

from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import FloorPlan
from hmt_slam_ros.simulation.scenario import START

ROOM = (4.0, 3.5)
"""Where the robot was in the room of the first door; the last keyframe is up to half a meter before."""


def write_world(folder):
    """Name of the world; its scripted drive begins at the end of the hallway and ends in the room."""
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 14.0, 1.0)
    for x in (4.0, 7.5):
        plan.cut_rectangle(x - 0.5, 1.0, x + 0.5, 1.3)
        plan.cut_rectangle(x - 1.6, 1.2, x + 1.6, 5.0)
    path = folder / "world.yaml"
    path.write_text(
        f"walls: {plan.walls().round(3).tolist()}\nroute: [[13, 0], [4, 0], {list(ROOM)}]\n"
        "settings: {field_of_view: 360.0, beams: 360, laps: 1, people: 0}\n"
    )
    return f"sim:{path}"


def scripted_drive(world):
    """Seconds from the beginning of its drive, shape (n,), and where the robot is then, (n, 3)."""
    log = open_simulated(world)
    seconds = np.arange(0.0, log.duration, 0.1)
    return seconds, log.true_poses(START + (NANOSECONDS * seconds).astype(np.int64))


def in_hallway(world, x):
    """Seconds from the beginning until the robot is so far along the hallway, m."""
    seconds, poses = scripted_drive(world)
    return float(seconds[poses[:, 0] >= x][-1])
