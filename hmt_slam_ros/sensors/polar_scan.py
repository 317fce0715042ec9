"""Classification of points by a scan: on a surface, in free space, or unknown.

Change detection compares two scans by it: does one scan see through a surface of the other?
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int8
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.se2 import rotate_back, wrap_by_modulus
from hmt_slam_ros.sensors.scan import Scan

UNKNOWN, SURFACE, FREE = np.int8(0), np.int8(1), np.int8(2)

_SURFACE_DISTANCE, _PASS_DISTANCE = 0.15, 0.2
"""Distance of a return on the same surface at most, and length of a beam behind a point from which it passed it, m.

These and the next ones: docs/decisions/0029-change-detection.md.
"""

_HALF_WIDTH, _HALF_WIDTH_SHARE = 0.1, 0.01
"""Distance to both sides within which all beams have to agree, m and as a share of the range.

A beam that grazes an edge passes it on one side only, and so does a beam whose pose is off by a degree.
"""

_DEPTH = 1.0
"""Depth of an object that the laser sees from its front only, m: that of furniture."""

_END_MARGIN = 0.05
"""Last part of a beam that is always kept, m: it shows from which side a surface was seen."""

_MAX_RANGE = 12.0
"""Range beyond which a point is unknown, m."""


class PolarScan(NamedTuple):
    """The nearest return in every direction of a laser.

    :ivar laser_pose: shape (3,), ``base_T_laser``, m and rad.
    :ivar first_angle: the first direction in the laser's frame, rad.
    :ivar angle_increment: from one direction to the next, rad; may be negative.
    :ivar ranges: shape (n,), m, NaN without a return.
    :ivar starts: shape (n,), range below which a beam shows nothing, m.
    """

    laser_pose: Float64
    first_angle: float
    angle_increment: float
    ranges: Float64
    starts: Float64


def to_polar_scan(scan: Scan) -> PolarScan:
    """The polar scan of a scan, from the pose of its laser at the first beam."""
    starts = np.zeros(scan.ranges.size) if scan.starts is None else scan.starts.astype(np.float64)
    if not scan.motion.any():
        ranges = np.where(scan.valid, scan.ranges, np.nan).astype(np.float64)
    else:
        points = se2.transform(se2.inverse(scan.laser_pose), scan.points)
        ranges, starts = _bin_ranges(points, starts[scan.valid], scan.angle_min, scan.angle_increment, scan.ranges.size)
    return PolarScan(scan.laser_pose, scan.angle_min, scan.angle_increment, ranges, starts)


def classify_points(scan: PolarScan, points: Float64) -> Int8:
    """The classes of points by a scan.

    :param points: shape (n, 2), base frame of the scan, m.
    :returns: shape (n,), ``SURFACE``, ``FREE`` or ``UNKNOWN``.
    """
    return _classify_points(
        np.ascontiguousarray(points), scan.laser_pose, scan.first_angle, scan.angle_increment, scan.ranges, scan.starts
    )


def is_in_view(scan: PolarScan, points: Float64) -> Bool:
    """Which points are in a direction of the laser, at any range, shape (n,).

    :param points: shape (n, 2), base frame of the scan, m.
    """
    x, y = se2.transform(se2.inverse(scan.laser_pose), points).T
    half = 0.5 * scan.angle_increment * (scan.ranges.size - 1)
    off = se2.wrap(np.arctan2(y, x) - scan.first_angle - half)
    in_view: Bool = np.abs(off) <= abs(half) + 0.5 * abs(scan.angle_increment)
    return in_view


def occlusion_starts(scan: PolarScan, points: Float64) -> Float64:
    """The range from which each beam is behind the objects whose front it passes.

    :param points: on the fronts of objects, as in :func:`classify_points`.
    :returns: shape (number of beams,), m from the laser; 0 for beams that pass none.
    """
    return _occlusion_starts(
        np.ascontiguousarray(points), scan.laser_pose, scan.first_angle, scan.angle_increment, scan.ranges
    )


@njit(cache=True)
def _bin_ranges(points: Float64, starts: Float64, first: float, step: float, count: int) -> tuple[Float64, Float64]:
    """Range of the nearest of points (n, 2), laser frame, in every direction, and the start of its beam, m."""
    ranges, begins = np.full(count, np.nan), np.zeros(count)
    for n in range(points.shape[0]):
        k = _direction_index(points[n, 0], points[n, 1], first, step, count)
        distance = math.hypot(points[n, 0], points[n, 1])
        if 0 <= k < count and not ranges[k] <= distance:
            ranges[k], begins[k] = distance, starts[n]
    return ranges, begins


@njit(cache=True)
def _direction_index(x: float, y: float, first: float, step: float, count: int) -> int:
    """The number of the direction nearest to a point's; outside 0 to count - 1 where there is none."""
    middle = first + 0.5 * step * (count - 1)
    return round(wrap_by_modulus(math.atan2(y, x) - middle) / step + 0.5 * (count - 1))


@njit(cache=True)
def _direction_window(point: Float64, laser: Float64, first: float, step: float, count: int) -> tuple[float, int, int]:
    """Distance of a point from the laser, and its first and last direction; 0, -1 for none."""
    cos, sin = math.cos(laser[2]), math.sin(laser[2])
    x, y = rotate_back(cos, sin, point[0] - laser[0], point[1] - laser[1])
    distance = math.hypot(x, y)
    if distance <= _HALF_WIDTH or distance > _MAX_RANGE:
        return distance, 0, -1
    half = max(1, math.ceil(math.atan2(_HALF_WIDTH + _HALF_WIDTH_SHARE * distance, distance) / abs(step)))
    k = _direction_index(x, y, first, step, count)
    if k - half < 0 or k + half >= count:
        return distance, 0, -1
    return distance, k - half, k + half


@njit(cache=True)
def _classify_points(
    points: Float64, laser: Float64, first: float, step: float, ranges: Float64, starts: Float64
) -> Int8:
    classes = np.zeros(points.shape[0], np.int8)
    for n in range(points.shape[0]):
        distance, begin, last = _direction_window(points[n], laser, first, step, ranges.size)
        informative, near, behind = 0, 0, 0
        for k in range(begin, last + 1):
            if not np.isnan(ranges[k]):
                off = ranges[k] * (k - begin - 0.5 * (last - begin)) * step
                near += (ranges[k] - distance) ** 2 + off**2 <= _SURFACE_DISTANCE**2
                informative += starts[k] <= distance
                behind += starts[k] <= distance < ranges[k] - _PASS_DISTANCE
        if near:
            classes[n] = SURFACE
        elif informative > 1 and behind == informative:
            classes[n] = FREE
    return classes


@njit(cache=True)
def _occlusion_starts(points: Float64, laser: Float64, first: float, step: float, ranges: Float64) -> Float64:
    starts = np.zeros(ranges.size)
    for n in range(points.shape[0]):
        distance, begin, last = _direction_window(points[n], laser, first, step, ranges.size)
        for k in range(begin, last + 1):
            if ranges[k] > distance + _PASS_DISTANCE:
                starts[k] = max(starts[k], min(distance + _DEPTH, ranges[k] - _END_MARGIN))
    return starts
