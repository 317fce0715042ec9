"""What a scan says of any place in its view: there is a surface, it is free, or nothing.

One question serves furniture, doors and people alike: was the surface that one scan saw seen through by another?
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int8
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.se2 import rotate_back, wrap_by_modulus
from hmt_slam_ros.sensors.scan import Scan

UNKNOWN, SURFACE, FREE = np.int8(0), np.int8(1), np.int8(2)

# A return this near (m) is of the same surface; a beam that goes on for this much behind a place has passed it.
_SURFACE_DISTANCE, _PASS_DISTANCE = 0.15, 0.2
# All beams within this distance to both sides are asked, m and as a share of the range: one that grazes an edge passes
# it on one side only, and so does one whose pose is off by a degree.
_HALF_WIDTH, _HALF_WIDTH_SHARE = 0.1, 0.01
# What came to stand somewhere is not seen from behind; it is taken to be as deep as furniture, m.
_DEPTH = 1.0
# The end of a beam, m, which shows from which side a surface was seen.
_END_MARGIN = 0.05
# Farther away than this, m, nothing is said.
_MAX_RANGE = 12.0


class PolarScan(NamedTuple):
    """The nearest return in every direction of a laser.

    :ivar laser_pose: shape (3,), ``base_T_laser``, m and rad.
    :ivar first_angle: the first direction in the laser's frame, rad.
    :ivar angle_increment: from one direction to the next, rad; may be negative.
    :ivar ranges: shape (n,), m, NaN where nothing came back.
    :ivar starts: shape (n,), m; nearer than this nothing is said.
    """

    laser_pose: Float64
    first_angle: float
    angle_increment: float
    ranges: Float64
    starts: Float64


def to_polar_scan(scan: Scan) -> PolarScan:
    """The view of a scan from where its laser was at the first beam."""
    starts = np.zeros(scan.ranges.size) if scan.starts is None else scan.starts.astype(np.float64)
    if not scan.motion.any():
        ranges = np.where(scan.valid, scan.ranges, np.nan).astype(np.float64)
    else:
        seen = se2.transform(se2.inverse(scan.laser_pose), scan.points)
        ranges, starts = _bin_ranges(seen, starts[scan.valid], scan.angle_min, scan.angle_increment, scan.ranges.size)
    return PolarScan(scan.laser_pose, scan.angle_min, scan.angle_increment, ranges, starts)


def classify_points(scan: PolarScan, points: Float64) -> Int8:
    """What a scan says of places.

    :param points: shape (n, 2), base frame of the scan, m.
    :returns: shape (n,), ``SURFACE``, ``FREE`` or ``UNKNOWN``.
    """
    return _classify_points(
        np.ascontiguousarray(points), scan.laser_pose, scan.first_angle, scan.angle_increment, scan.ranges, scan.starts
    )


def occlusion_starts(scan: PolarScan, points: Float64) -> Float64:
    """From where on the beams of a scan are behind the things whose faces are at some places that they pass.

    :param points: as in :func:`classify_points`.
    :returns: shape (number of beams,), m from the laser; 0 for beams that pass none.
    """
    return _occlusion_starts(
        np.ascontiguousarray(points), scan.laser_pose, scan.first_angle, scan.angle_increment, scan.ranges
    )


@njit(cache=True)
def _bin_ranges(points: Float64, starts: Float64, first: float, step: float, count: int) -> tuple[Float64, Float64]:
    """The nearest of points (n, 2), laser frame, in every direction, and the start of its beam."""
    ranges, begins = np.full(count, np.nan), np.zeros(count)
    for n in range(points.shape[0]):
        k = _direction_index(points[n, 0], points[n, 1], first, step, count)
        distance = math.hypot(points[n, 0], points[n, 1])
        if 0 <= k < count and not ranges[k] <= distance:
            ranges[k], begins[k] = distance, starts[n]
    return ranges, begins


@njit(cache=True)
def _direction_index(x: float, y: float, first: float, step: float, count: int) -> int:
    """The number of the direction that is nearest to a point's, outside of 0 to count - 1 where there is none."""
    middle = first + 0.5 * step * (count - 1)
    return round(wrap_by_modulus(math.atan2(y, x) - middle) / step + 0.5 * (count - 1))


@njit(cache=True)
def _direction_window(point: Float64, laser: Float64, first: float, step: float, count: int) -> tuple[float, int, int]:
    """Distance of a point from the laser, and the first and the last direction that are asked; 0, -1 for none."""
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
    found = np.zeros(points.shape[0], np.int8)
    for n in range(points.shape[0]):
        distance, begin, last = _direction_window(points[n], laser, first, step, ranges.size)
        told, near, behind = 0, 0, 0
        for k in range(begin, last + 1):
            if not np.isnan(ranges[k]):
                off = ranges[k] * (k - begin - 0.5 * (last - begin)) * step
                near += (ranges[k] - distance) ** 2 + off**2 <= _SURFACE_DISTANCE**2
                told += starts[k] <= distance
                behind += starts[k] <= distance < ranges[k] - _PASS_DISTANCE
        if near:
            found[n] = SURFACE
        elif told > 1 and behind == told:
            found[n] = FREE
    return found


@njit(cache=True)
def _occlusion_starts(points: Float64, laser: Float64, first: float, step: float, ranges: Float64) -> Float64:
    starts = np.zeros(ranges.size)
    for n in range(points.shape[0]):
        distance, begin, last = _direction_window(points[n], laser, first, step, ranges.size)
        for k in range(begin, last + 1):
            if ranges[k] > distance + _PASS_DISTANCE:
                starts[k] = max(starts[k], min(distance + _DEPTH, ranges[k] - _END_MARGIN))
    return starts
