"""Scans as surfaces: end points with the normals of the walls they lie on, found by the bearing they are seen at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.surfels import Wall, fit, running_sums

# A wall piece is fitted to the points within this reach of a point, or within three beams at one degree where that is
# more, on at most so many beams to each side.
_REACH, _REACH_PER_METRE, _BEAMS = 0.25, 0.045, 8
_WALL = Wall(0.04, 0.5)
_EMPTY = -1


class Surfaces(NamedTuple):
    """The end points of n scans, one scan after the other in the order of their beams.

    :ivar starts: shape (n + 1,), scan i has the points ``starts[i]`` to before ``starts[i + 1]``.
    :ivar points: shape (k, 2), m, base frame of their scan.
    :ivar normals: shape (k, 2), unit vectors towards the laser.
    :ivar flat: shape (k,), whether the point lies on a piece of wall, so that its normal means something.
    :ivar lasers: shape (n, 2), m, where the lasers stood in the base frames.
    :ivar bins: shape (b,), the point seen in each bin of bearing, -1 for none; of several the nearest.
    :ivar bin_starts: shape (n + 1,), scan i has the bins ``bin_starts[i]`` to before ``bin_starts[i + 1]``; they
        divide the full circle evenly from bearing 0 on.
    """

    starts: Int64
    points: Float64
    normals: Float64
    flat: Bool
    lasers: Float64
    bins: Int32
    bin_starts: Int64


def surfaces_of(scans: Sequence[Scan], max_range: float, max_points: int) -> Surfaces:
    """Find the surfaces of scans.

    :param max_range: returns from farther away are left out, m.
    :param max_points: of each scan at most so many points are kept, evenly thinned; normals are fitted to all.
    """
    points, normals, flat, resolution = [], [], [], []
    for scan in scans:
        seen = scan.points
        near = np.hypot(*(seen - scan.laser_pose[:2]).T) <= max_range
        seen = np.ascontiguousarray(seen[near])
        found, on_wall = _fit_normals(seen, scan.laser_pose[:2].copy())
        stride = max(1, -(-len(seen) // max_points))
        points.append(seen[::stride])
        normals.append(found[::stride])
        flat.append(on_wall[::stride])
        resolution.append(max(1, int(2.0 * np.pi / (abs(scan.angle_increment) * stride or 2.0 * np.pi))))
    starts = _running([len(part) for part in points])
    bin_starts = _running(resolution)
    stacked = np.concatenate([np.zeros((0, 2)), *points])
    lasers = np.array([scan.laser_pose[:2] for scan in scans]).reshape(-1, 2)
    return Surfaces(
        starts,
        stacked,
        np.concatenate([np.zeros((0, 2)), *normals]),
        np.concatenate([np.zeros(0, np.bool_), *flat]),
        lasers,
        _binned(stacked, starts, lasers, bin_starts),
        bin_starts,
    )


def _running(counts: Sequence[int]) -> Int64:
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64))).astype(np.int64)


@njit(cache=True)
def _fit_normals(points: Float64, laser: Float64) -> tuple[Float64, Bool]:
    """Normals (n, 2) of the wall pieces around the points, and whether there is one (n,)."""
    normals, flat, normal = np.zeros_like(points), np.zeros(len(points), np.bool_), np.empty(2)
    beams = points - laser
    ranges = np.hypot(beams[:, 0], beams[:, 1])
    sums = running_sums(beams, ranges)
    for i in range(len(points)):
        reach = max(_REACH, _REACH_PER_METRE * ranges[i])
        low, high = _piece(points, i, -1, reach), _piece(points, i, 1, reach)
        if high - low < 2 or not fit(beams, sums, low, i, high, _WALL, normal):
            continue
        towards = -1.0 if normal[0] * beams[i, 0] + normal[1] * beams[i, 1] > 0.0 else 1.0
        normals[i, 0], normals[i, 1] = towards * normal[0], towards * normal[1]
        flat[i] = True
    return normals, flat


@njit(cache=True)
def _piece(points: Float64, i: int, step: int, reach: float) -> int:
    """The last of the points that follow each other from i on, downwards or upwards, within reach of it."""
    last = i
    for k in range(i + step, i + step * (_BEAMS + 1), step):
        if k < 0 or k >= len(points):
            break
        dx, dy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
        if dx * dx + dy * dy > reach * reach:
            break
        last = k
    return last


@njit(cache=True)
def _binned(points: Float64, starts: Int64, lasers: Float64, bin_starts: Int64) -> Int32:
    """The nearest point of each scan in each of its bins of bearing."""
    bins = np.full(bin_starts[-1], _EMPTY, np.int32)
    for scan in range(len(lasers)):
        count = bin_starts[scan + 1] - bin_starts[scan]
        nearest = np.full(count, np.inf)
        for k in range(starts[scan], starts[scan + 1]):
            dx, dy = points[k, 0] - lasers[scan, 0], points[k, 1] - lasers[scan, 1]
            place = bin_of(dx, dy, count)
            distance = dx * dx + dy * dy
            if distance < nearest[place]:
                nearest[place] = distance
                bins[bin_starts[scan] + place] = k
    return bins


@njit(cache=True)
def bin_of(x: float, y: float, count: int) -> int:
    """The bin of the direction (x, y) where ``count`` bins divide the circle."""
    place = int(np.floor(_bearing(x, y) * (count / (2.0 * np.pi)) + 0.5))
    return place + count if place < 0 else min(place, count - 1)


@njit(cache=True)
def _bearing(x: float, y: float) -> float:
    """``arctan2(y, x)`` to 1e-5 rad, in a fourth of its time: a minimax polynomial on the eighth of the circle."""
    along, across = max(abs(x), abs(y)), min(abs(x), abs(y))
    ratio = across / along if along > 0.0 else 0.0
    s = ratio * ratio
    angle = 0.05265332 - 0.01172120 * s
    for coefficient in (-0.11643287, 0.19354346, -0.33262347, 0.99997726):
        angle = coefficient + s * angle
    angle *= ratio
    if abs(y) > abs(x):
        angle = 0.5 * np.pi - angle
    if x < 0.0:
        angle = np.pi - angle
    return -angle if y < 0.0 else angle
