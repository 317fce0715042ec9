"""Small worlds of wall segments, the scans that a laser would take in them, and drives through them.

Walls are arrays (n, 4): x, y of both ends, m.
"""

from itertools import pairwise

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.laser import cast_rays, wall_index

RANGE_MAX = 30.0

HALLWAY = np.array(
    [
        [-6, -1, 4, -1],
        [4, -1, 4, -6],
        [6, -6, 6, 1],
        [6, 1, 2.5, 1],
        [2.5, 1, 2.5, 1.2],
        [2.5, 1.2, 4, 1.2],
        [4, 1.2, 4, 5],
        [4, 5, -1, 5],
        [-1, 5, -1, 1.2],
        [-1, 1.2, 1.5, 1.2],
        [1.5, 1.2, 1.5, 1],
        [1.5, 1, -6, 1],
        [-6, 1, -6, -1],
    ],
    dtype=float,
)
"""A hallway of 2 m with a door of 1 m to a room on the left, and at its end another hallway to the right."""


def box(x0, y0, x1, y1):
    """The four walls of a room."""
    return np.array([[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]], dtype=float)


def two_rooms():
    """Rooms of 6 m x 6 m on both sides of a wall at x = 6 m with a door of 1 m, each with a box in a corner."""
    outer = box(0.0, 0.0, 12.0, 6.0)
    doorway = np.array([[6.0, 0.0, 6.0, 2.5], [6.0, 3.5, 6.0, 6.0]])
    return np.concatenate((outer, doorway, box(0.5, 4.5, 1.5, 5.5), box(10.0, 0.5, 11.5, 1.5)))


def distances(walls, sensor, angles):
    """Distance from ``world_T_laser`` to the nearest wall along each angle, shape (n,), m; inf where there is none.

    The laser has one pose (3,), or one for each angle (n, 3).
    """
    sensor = np.broadcast_to(sensor, (angles.size, 3))
    return cast_rays(wall_index(walls), sensor[:, :2].copy(), angles + sensor[:, 2], np.inf)


def scan_in(
    walls, pose, stamp=0, beams=181, field_of_view=np.pi, noise=0.0, seed=0, laser_pose=(0.0, 0.0, 0.0), sweep=0.0
):
    """The scan at ``world_T_base``, (3,), or (beams, 3) where the robot moves during the sweep of ``sweep`` s.

    Beams that meet no wall report RANGE_MAX. A negative field of view is that of a laser mounted upside down.
    """
    angles = np.linspace(-field_of_view / 2, field_of_view / 2, beams)
    ranges = distances(walls, se2.compose(pose, laser_pose), angles)
    ranges = np.minimum(ranges + noise * np.random.default_rng(seed).standard_normal(beams), RANGE_MAX)
    return Scan(
        stamp,
        ranges.astype(np.float32),
        angles[0],
        angles[1] - angles[0],
        0.0,
        RANGE_MAX,
        np.asarray(laser_pose, dtype=float),
        sweep / (beams - 1),
    )


def blank_scan():
    """A scan without a return."""
    return Scan(0, np.full(181, RANGE_MAX, dtype=np.float32), -np.pi / 2, np.pi / 180, 0.0, RANGE_MAX)


def scan_at(walls, pose, noise=0.0, rng=None, beams=180):
    """The scan of a laser that sees all round, no angle twice."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    ranges = distances(walls, np.asarray(pose, dtype=float), angles)
    if rng is not None:
        ranges = ranges + rng.normal(size=beams) * noise
    return Scan(0, ranges.astype(np.float32), -np.pi, 2.0 * np.pi / beams, 0.05, RANGE_MAX)


def drive(*corners, step=0.5):
    """Poses every ``step`` m along the straight lines between the corners, looking ahead, shape (n, 3)."""
    poses = []
    for start, end in pairwise(corners):
        leg = np.subtract(end, start)
        length = np.hypot(*leg)
        heading = np.arctan2(leg[1], leg[0])
        poses += [[*(start + leg * s / length), heading] for s in np.arange(0.0, length - 1e-9, step)]
    return np.array(poses)
