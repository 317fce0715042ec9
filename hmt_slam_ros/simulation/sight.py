"""Which places are the same, and what the robot sees of them: the truth about loop closures.

Walls decide; furniture and people do not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation.laser import Laser, WallIndex, has_line_of_sight

_SHORT_OF_WALL = 0.01  # m, where the view of a point on a wall ends
_SLACK = 1e-9  # rad, that the outermost beam is counted in


def same_place(
    walls: WallIndex, poses: NDArray[np.float64], others: NDArray[np.float64], radius: float
) -> NDArray[np.bool_]:
    """Whether two poses are within a radius of each other with no wall between them.

    :param poses: shape (n, 3), m and rad.
    :param others: shape (m, 3).
    :param radius: m.
    :returns: shape (n, m).
    """
    one, other = poses[:, :2], others[:, :2]
    near = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1)) <= radius
    rows, columns = np.nonzero(near)
    near[rows, columns] = has_line_of_sight(walls, one[rows], other[columns])
    return near


def shared_view(
    walls: WallIndex, laser: Laser, poses: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How much of what a laser sees of the walls from one pose it sees from another too.

    The mean of two shares: of the points seen from the one that are in the other's field of view, within its reach and
    not hidden, and the other way round; 0 where one of them sees nothing.

    :param poses: shape (n, 3), ``world_T_base``, m and rad.
    :param others: shape (m, 3).
    :returns: shape (n, m), from 0 to 1.
    """
    lasers, other_lasers = se2.compose(poses, laser.pose), se2.compose(others, laser.pose)
    points, other_points = (_visible_wall_points(walls, laser, p) for p in (poses, others))
    shares = np.zeros((len(poses), len(others)))
    near = np.hypot(*(lasers[:, None, :2] - other_lasers[None, :, :2]).transpose(2, 0, 1)) < 2.0 * laser.reach
    for i, k in zip(*np.nonzero(near), strict=True):
        if len(points[i]) and len(other_points[k]):
            there = _is_visible(walls, laser, other_lasers[k], points[i])
            here = _is_visible(walls, laser, lasers[i], other_points[k])
            shares[i, k] = 0.5 * (there.mean() + here.mean())
    return shares


def _visible_wall_points(walls: WallIndex, laser: Laser, poses: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Where the beams of each pose end on walls, (k, 2) each, m, in the world."""
    ends = []
    for pose in poses:
        distances = laser.distances(pose[None], walls, np.empty((0, 3)))
        met = np.isfinite(distances)
        angles, ranges = laser.angles[met], distances[met]
        local = np.stack((ranges * np.cos(angles), ranges * np.sin(angles)), axis=1)
        ends.append(se2.transform(se2.compose(pose, laser.pose), local))
    return ends


def _is_visible(
    walls: WallIndex, laser: Laser, eye: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Which points on walls (k, 2) a laser at ``world_T_laser`` (3,) sees, shape (k,)."""
    local = se2.transform(se2.inverse(eye), points)
    away = np.hypot(local[:, 0], local[:, 1])
    ahead = np.abs(np.arctan2(local[:, 1], local[:, 0])) <= laser.half_field + _SLACK
    short = points + (eye[:2] - points) * np.minimum(1.0, _SHORT_OF_WALL / np.maximum(away, 1e-9))[:, None]
    return ahead & (away < laser.reach) & has_line_of_sight(walls, np.tile(eye[:2], (len(points), 1)), short)
