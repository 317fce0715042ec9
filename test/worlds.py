"""Small worlds of wall segments, and the scans that a laser would take in them."""

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensing import Scan

RANGE_MAX = 30.0


def box(x0, y0, x1, y1):
    """The four walls of a room, shape (4, 4): x, y of both ends."""
    return np.array([[x0, y0, x1, y0], [x1, y0, x1, y1], [x1, y1, x0, y1], [x0, y1, x0, y0]], dtype=float)


def scan_in(walls, pose, stamp=0, beams=181, field_of_view=np.pi, noise=0.0, seed=0, laser_pose=(0.0, 0.0, 0.0)):
    """The scan at ``world_T_base`` among walls (n, 4); beams that meet no wall report RANGE_MAX."""
    sensor = se2.compose(pose, laser_pose)
    angles = np.linspace(-field_of_view / 2, field_of_view / 2, beams)
    directions = np.stack((np.cos(angles + sensor[2]), np.sin(angles + sensor[2])), axis=1)
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    offset = start - sensor[:2]
    cross = directions[:, None, 0] * along[None, :, 1] - directions[:, None, 1] * along[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[None, :, 0] * along[None, :, 1] - offset[None, :, 1] * along[None, :, 0]) / cross
        fraction = (
            offset[None, :, 0] * directions[:, None, 1] - offset[None, :, 1] * directions[:, None, 0]
        ) / cross
    distance = np.where((distance > 1e-6) & (fraction >= 0.0) & (fraction <= 1.0), distance, np.inf)
    ranges = distance.min(axis=1) + noise * np.random.default_rng(seed).standard_normal(beams)
    ranges = np.where(np.isfinite(ranges), np.minimum(ranges, RANGE_MAX), RANGE_MAX).astype(np.float32)
    return Scan(stamp, ranges, angles[0], angles[1] - angles[0], 0.0, RANGE_MAX, np.asarray(laser_pose, dtype=float))
