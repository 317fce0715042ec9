"""Overlap of sensed space: how much of what one scan saw another saw too, given where both were taken.

The overlap of scans i and j is the mean of two shares: of the points of i that have a point of j within a radius, and
of the points of j that have one of i (Blanco, Gonzalez, Fernandez-Madrigal, IROS 2006, symmetrised by averaging).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.sensing import Scan

# Along one edge of the grid, at most.
_CELLS = 64


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
    return _overlaps(np.ascontiguousarray(points), pose, np.concatenate(others), ends, other_poses, radius)


@njit(cache=True)
def _overlaps(
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
    stacked: NDArray[np.float64],
    ends: NDArray[np.int64],
    other_poses: NDArray[np.float64],
    radius: float,
) -> NDArray[np.float64]:
    """:func:`overlaps` for points stacked over the others, each ending before ``ends[j]``."""
    result = np.zeros(ends.size)
    start = 0
    for j in range(ends.size):
        moved = _moved(stacked[start : ends[j]], pose, other_poses[j])
        start = ends[j]
        if len(points) > 0 and len(moved) > 0:
            result[j] = _overlap(points, moved, radius)
    return result


@njit(cache=True)
def _moved(
    points: NDArray[np.float64], pose: NDArray[np.float64], other_pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points of the base at ``other_pose`` as seen from the base at ``pose``."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = other_pose[0] - pose[0], other_pose[1] - pose[1]
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    cos, sin = np.cos(other_pose[2] - pose[2]), np.sin(other_pose[2] - pose[2])
    moved = np.empty_like(points)
    for i in range(len(points)):
        moved[i, 0] = x + cos * points[i, 0] - sin * points[i, 1]
        moved[i, 1] = y + sin * points[i, 0] + cos * points[i, 1]
    return moved


@njit(cache=True)
def _overlap(a: NDArray[np.float64], b: NDArray[np.float64], radius: float) -> float:
    """Overlap of two point sets in one frame, the second of which is filed in square cells."""
    low_x, low_y = b[:, 0].min(), b[:, 1].min()
    extent = max(b[:, 0].max() - low_x, b[:, 1].max() - low_y)
    edge = max(2.0 * radius, extent / _CELLS)
    size = int(extent / edge) + 1
    # Rounding must not hide a point at just this distance.
    reach = radius * (1.0 + 1e-9)
    newest, before = _filed(b, low_x, low_y, edge, size)
    seen_a, seen_b = 0, np.zeros(len(b), np.bool_)
    for i in range(len(a)):
        x, y = a[i, 0] - low_x, a[i, 1] - low_y
        left, right = int(np.floor((x - reach) / edge)), int(np.floor((x + reach) / edge))
        bottom, top = int(np.floor((y - reach) / edge)), int(np.floor((y + reach) / edge))
        met = False
        for r in range(max(0, bottom), min(size, top + 1)):
            for c in range(max(0, left), min(size, right + 1)):
                k = newest[r, c]
                while k >= 0:
                    dx, dy = b[k, 0] - a[i, 0], b[k, 1] - a[i, 1]
                    if dx * dx + dy * dy <= radius * radius:
                        met = True
                        seen_b[k] = True
                    k = before[k]
        seen_a += met
    return 0.5 * (seen_a / len(a) + seen_b.sum() / len(b))


@njit(cache=True)
def _filed(
    points: NDArray[np.float64], low_x: float, low_y: float, edge: float, size: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """For each cell (row, column) its newest point, for each point the one before it in its cell; -1 for none."""
    newest, before = np.full((size, size), -1, np.int32), np.empty(len(points), np.int32)
    for k in range(len(points)):
        column, row = int((points[k, 0] - low_x) / edge), int((points[k, 1] - low_y) / edge)
        before[k] = newest[row, column]
        newest[row, column] = k
    return newest, before
