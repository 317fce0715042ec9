"""A world of walls for tests: scans by ray casting, and the rooms and corridors that several tests drive through."""

from itertools import pairwise

import numpy as np

from hmt_slam_ros.sensing import Scan

BEAMS = 180


def box(x0, y0, x1, y1):
    """Four walls, shape (4, 2, 2)."""
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=np.float64)
    return np.stack((corners, np.roll(corners, -1, axis=0)), axis=1)


def two_rooms():
    """Rooms of 6 m x 6 m on both sides of a wall at x = 6 m with a door of 1 m, each with a box in a corner."""
    outer = box(0.0, 0.0, 12.0, 6.0)
    doorway = np.array([[[6.0, 0.0], [6.0, 2.5]], [[6.0, 3.5], [6.0, 6.0]]])
    return np.concatenate((outer, doorway, box(0.5, 4.5, 1.5, 5.5), box(10.0, 0.5, 11.5, 1.5)))


def ranges(walls, pose, angles):
    """Distance from ``pose`` to the nearest wall along each angle, shape (n,), m."""
    heading = np.stack((np.cos(pose[2] + angles), np.sin(pose[2] + angles)), axis=1)[:, None]
    start, edge = walls[None, :, 0] - pose[:2], walls[None, :, 1] - walls[None, :, 0]
    cross = heading[..., 0] * edge[..., 1] - heading[..., 1] * edge[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (start[..., 0] * edge[..., 1] - start[..., 1] * edge[..., 0]) / cross
        share = (start[..., 0] * heading[..., 1] - start[..., 1] * heading[..., 0]) / cross
    hit = (along > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hit, along, np.inf).min(axis=1)


def scan_at(walls, pose, noise=0.0, rng=None, beams=BEAMS):
    """The scan of a laser that sees all round, taken at ``pose``, shape (3,)."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    measured = ranges(walls, np.asarray(pose, dtype=np.float64), angles)
    if rng is not None:
        measured = measured + rng.normal(size=measured.size) * noise
    return Scan(0, measured.astype(np.float32), -np.pi, 2.0 * np.pi / beams, 0.05, 30.0)


def drive(*corners, step=0.5):
    """Poses every ``step`` m along the straight lines between the corners, looking ahead, shape (n, 3)."""
    poses = []
    for start, end in pairwise(corners):
        leg = np.subtract(end, start)
        length = np.hypot(*leg)
        heading = np.arctan2(leg[1], leg[0])
        poses += [[*(start + leg * s / length), heading] for s in np.arange(0.0, length - 1e-9, step)]
    return np.array(poses)
