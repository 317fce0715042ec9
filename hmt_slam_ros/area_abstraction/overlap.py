"""Overlap of sensed space: how much of what one scan saw another saw too, given where both were taken.

The overlap of scans i and j is the mean of two shares: of the points of i that have a point of j within a radius, and
of the points of j that have one of i (Blanco, Gonzalez, Fernandez-Madrigal, IROS 2006, symmetrized by averaging).

Scans in the middle of a hall, where the laser reaches nothing, saw free space only: that of two overlaps the less, the
farther apart they were taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.sensors import Scan

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


class SensedSpace(NamedTuple):
    """What is compared of a scan.

    :ivar points: of :func:`sensed_points`, shape (k, 2), m.
    :ivar max_range: up to which the scan would have had others, m.
    """

    points: NDArray[np.float64]
    max_range: float

    @classmethod
    def from_scan(cls, scan: Scan, max_range: float, count: int = 180) -> SensedSpace:
        """Of a scan, as :func:`sensed_points`."""
        return cls(sensed_points(scan, max_range, count), min(max_range, scan.range_max))


def sensed_overlaps(
    one: SensedSpace,
    pose: NDArray[np.float64],
    others: Sequence[SensedSpace],
    other_poses: NDArray[np.float64],
    radius: float,
) -> NDArray[np.float64]:
    """Overlap of one scan with each of several others as :func:`overlaps`, where neither has points that of free space.

    That falls from 1 to 0 as they are two reaches apart, linearly, as the common part of two discs does nearly.

    :param others: m scans.
    :returns: shape (m,), values in [0, 1].
    """
    found = overlaps(one.points, pose, [other.points for other in others], other_poses, radius)
    free = [j for j, other in enumerate(others) if not len(other.points)]
    if free and not len(one.points):
        apart = np.hypot(*(other_poses[free, :2] - pose[:2]).T)
        found[free] = np.maximum(0.0, 1.0 - apart / (one.max_range + np.array([others[j].max_range for j in free])))
    return found


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
    if not len(points):
        return result
    grid = _fill_grid(points, radius)
    # For each of the points the last other scan that met it, so that there is nothing to clear in between.
    met_by, start = np.full(len(points), -1), 0
    for j in range(ends.size):
        if ends[j] > start:
            moved = _transform_points(stacked[start : ends[j]], pose, other_poses[j])
            result[j] = _overlap(points, grid, moved, radius, met_by, j)
        start = ends[j]
    return result


@njit(cache=True)
def _transform_points(
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


class _PointGrid(NamedTuple):
    """Points in square cells.

    :ivar low_x: lower edges, m, and ``low_y``.
    :ivar edge: of a cell, m.
    :ivar last_point: shape (rows, columns), the newest point of each cell, -1 for none.
    :ivar previous_point: shape (n,), for each point the one before it in its cell, -1 for none.
    """

    low_x: float
    low_y: float
    edge: float
    last_point: NDArray[np.int32]
    previous_point: NDArray[np.int32]


@njit(cache=True)
def _fill_grid(points: NDArray[np.float64], radius: float) -> _PointGrid:
    low_x, low_y = points[:, 0].min(), points[:, 1].min()
    extent = max(points[:, 0].max() - low_x, points[:, 1].max() - low_y)
    edge = max(2.0 * radius, extent / _CELLS)
    size = int(extent / edge) + 1
    newest, before = np.full((size, size), -1, np.int32), np.empty(len(points), np.int32)
    for k in range(len(points)):
        column, row = int((points[k, 0] - low_x) / edge), int((points[k, 1] - low_y) / edge)
        before[k] = newest[row, column]
        newest[row, column] = k
    return _PointGrid(low_x, low_y, edge, newest, before)


@njit(cache=True)
def _overlap(
    points: NDArray[np.float64],
    grid: _PointGrid,
    others: NDArray[np.float64],
    radius: float,
    met_by: NDArray[np.int64],
    number: int,
) -> float:
    """Overlap of the points in the grid with others in the same frame.

    :param met_by: for each of the points the number of the last scan that met it, changed in place.
    :param number: of this one.
    """
    size = len(grid.last_point)
    # Rounding must not hide a point at just this distance.
    reach = radius * (1.0 + 1e-9)
    met = met_others = 0
    for i in range(len(others)):
        x, y = others[i, 0] - grid.low_x, others[i, 1] - grid.low_y
        left, right = int(np.floor((x - reach) / grid.edge)), int(np.floor((x + reach) / grid.edge))
        bottom, top = int(np.floor((y - reach) / grid.edge)), int(np.floor((y + reach) / grid.edge))
        near = False
        for r in range(max(0, bottom), min(size, top + 1)):
            for c in range(max(0, left), min(size, right + 1)):
                k = grid.last_point[r, c]
                while k >= 0:
                    dx, dy = points[k, 0] - others[i, 0], points[k, 1] - others[i, 1]
                    if dx * dx + dy * dy <= radius * radius:
                        near = True
                        if met_by[k] != number:
                            met_by[k] = number
                            met += 1
                    k = grid.previous_point[k]
        met_others += near
    return 0.5 * (met / len(points) + met_others / len(others))
