"""Overlap of sensed space: how much of what one scan saw another saw too, given where both were taken.

The overlap of scans i and j is the mean of two shares: of the points of i that have a point of j within a radius, and
of the points of j that have one of i (Blanco, Gonzalez, Fernandez-Madrigal, IROS 2006, symmetrised by averaging).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensing import Scan


def sensed_points(scan: Scan, max_range: float, count: int = 180) -> NDArray[np.float64]:
    """At most ``count`` end points of a scan, evenly over its returns no farther than ``max_range`` from the laser.

    :returns: shape (k, 2), m, robot base frame.
    """
    near = scan.points[np.hypot(*scan.beams.T) <= max_range]
    if len(near) <= count:
        return near
    return near[np.linspace(0.0, len(near) - 1.0, count).round().astype(np.int64)]


def overlaps(
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
    others: Sequence[NDArray[np.float64]],
    other_poses: NDArray[np.float64],
    radius: float,
) -> NDArray[np.float64]:
    """Overlap of one scan with each of several others.

    :param points: shape (k, 2), m, base frame of the one scan.
    :param pose: shape (3,), pose of its base in a common frame, m and rad.
    :param others: m arrays (k_j, 2), m, each in its own base frame.
    :param other_poses: shape (m, 3), poses of their bases in the common frame.
    :param radius: two points no farther apart than this are the same sensed space, m.
    :returns: shape (m,), values in [0, 1]; 0 where a scan has no points.
    """
    if not others:
        return np.zeros(0)
    ends = np.cumsum([len(other) for other in others])
    relative = se2.between(pose, other_poses)
    return _overlaps(np.ascontiguousarray(points), np.concatenate(others), ends, relative, radius)


@njit(cache=True)
def _overlaps(
    points: NDArray[np.float64],
    stacked: NDArray[np.float64],
    ends: NDArray[np.int64],
    relative: NDArray[np.float64],
    radius: float,
) -> NDArray[np.float64]:
    """:func:`overlaps` for points stacked over the others, each ending before ``ends[j]``, with ``one_T_other``."""
    result = np.zeros(ends.size)
    start = 0
    for j in range(ends.size):
        moved = _moved(stacked[start : ends[j]], relative[j])
        start = ends[j]
        if len(points) > 0 and len(moved) > 0:
            result[j] = _overlap(points, moved, radius)
    return result


@njit(cache=True)
def _moved(points: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    moved = np.empty_like(points)
    for i in range(len(points)):
        moved[i, 0] = pose[0] + cos * points[i, 0] - sin * points[i, 1]
        moved[i, 1] = pose[1] + sin * points[i, 0] + cos * points[i, 1]
    return moved


@njit(cache=True)
def _overlap(a: NDArray[np.float64], b: NDArray[np.float64], radius: float) -> float:
    """Overlap of two point sets in one frame; only points within the other's bounding box are compared."""
    low_x, high_x = b[:, 0].min() - radius, b[:, 0].max() + radius
    low_y, high_y = b[:, 1].min() - radius, b[:, 1].max() + radius
    seen_a, seen_b = 0, np.zeros(len(b), np.bool_)
    for i in range(len(a)):
        x, y = a[i, 0], a[i, 1]
        if not (low_x <= x <= high_x and low_y <= y <= high_y):
            continue
        met = False
        for k in range(len(b)):
            dx, dy = b[k, 0] - x, b[k, 1] - y
            if dx * dx + dy * dy <= radius * radius:
                met = True
                seen_b[k] = True
        seen_a += met
    return 0.5 * (seen_a / len(a) + seen_b.sum() / len(b))
