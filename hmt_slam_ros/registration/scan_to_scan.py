"""Scan to scan: point-to-line registration of scans, many pairs in one compiled call.

A point p of one scan is paired with a wall point q of another, with normal n. Its error is n^T (T p - q), with T the
pose of the first scan in the other. Outliers have a small Cauchy weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry.gaussian import Symmetric, write_to_array
from hmt_slam_ros.geometry.se2 import rotate_back, transform_point
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import FlatnessLimits, fit_surface, running_sums

_REACH, _REACH_PER_METER, _BEAMS = 0.25, 0.045, 8
"""Distance to each side of a point within which a wall is fitted, m, and as a share of the range (three beams at one
degree) where that is more; and largest number of beams to each side."""

_FLATNESS = FlatnessLimits(0.04, 0.5)
"""Limits for walls."""

_MAX_BINS = 20
"""Bins of bearing that are searched to each side at most."""

_SAME_WALL = 0.7
"""Cosine of the angle between two normals from which they are of the same wall."""

_EMPTY = -1


class ScanSurfaces(NamedTuple):
    """The end points of n scans, concatenated in the order of their beams.

    :ivar starts: shape (n + 1,), scan i has the points ``starts[i]`` to before ``starts[i + 1]``.
    :ivar points: shape (k, 2), m, base frame of their scan.
    :ivar normals: shape (k, 2), unit vectors towards the laser.
    :ivar is_flat: shape (k,), whether the point is on a wall and has a normal.
    :ivar lasers: shape (n, 2), m, positions of the lasers in the base frames.
    :ivar bins: shape (b,), the nearest point in each bin of bearing, -1 for none.
    :ivar bin_starts: shape (n + 1,), scan i has the bins ``bin_starts[i]`` to before ``bin_starts[i + 1]``; they
        divide the full circle evenly from bearing 0 on.
    """

    starts: Int64
    points: Float64
    normals: Float64
    is_flat: Bool
    lasers: Float64
    bins: Int32
    bin_starts: Int64


def extract_surfaces(scans: Sequence[Scan], max_range: float, max_points: int) -> ScanSurfaces:
    """The surfaces of scans.

    :param max_range: largest range of points, m.
    :param max_points: largest number of points of a scan, evenly thinned; normals are fitted to all points.
    """
    points, normals, flat, resolution = [], [], [], []
    for scan in scans:
        near = np.hypot(*(scan.points - scan.laser_pose[:2]).T) <= max_range
        ends = np.ascontiguousarray(scan.points[near])
        fitted, is_flat = _fit_normals(ends, scan.laser_pose[:2].copy())
        stride = max(1, -(-len(ends) // max_points))
        points.append(ends[::stride])
        normals.append(fitted[::stride])
        flat.append(is_flat[::stride])
        resolution.append(max(1, int(2.0 * np.pi / (abs(scan.angle_increment) * stride or 2.0 * np.pi))))
    starts = _offsets([len(part) for part in points])
    bin_starts = _offsets(resolution)
    stacked = np.concatenate([np.zeros((0, 2)), *points])
    lasers = np.array([scan.laser_pose[:2] for scan in scans]).reshape(-1, 2)
    return ScanSurfaces(
        starts,
        stacked,
        np.concatenate([np.zeros((0, 2)), *normals]),
        np.concatenate([np.zeros(0, np.bool_), *flat]),
        lasers,
        _bin_points(stacked, starts, lasers, bin_starts),
        bin_starts,
    )


def _offsets(counts: Sequence[int]) -> Int64:
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64))).astype(np.int64)


@njit(cache=True)
def _fit_normals(points: Float64, laser: Float64) -> tuple[Float64, Bool]:
    """Normals (n, 2) of the walls around the points, and whether there is a wall (n,)."""
    normals, flat, normal = np.zeros_like(points), np.zeros(len(points), np.bool_), np.empty(2)
    beams = points - laser
    ranges = np.hypot(beams[:, 0], beams[:, 1])
    sums = running_sums(beams, ranges)
    for i in range(len(points)):
        reach = max(_REACH, _REACH_PER_METER * ranges[i])
        low, high = _last_in_reach(points, i, -1, reach), _last_in_reach(points, i, 1, reach)
        if high - low < 2 or not fit_surface(beams, sums, low, i, high, _FLATNESS, normal):
            continue
        towards = -1.0 if normal[0] * beams[i, 0] + normal[1] * beams[i, 1] > 0.0 else 1.0
        normals[i, 0], normals[i, 1] = towards * normal[0], towards * normal[1]
        flat[i] = True
    return normals, flat


@njit(cache=True)
def _last_in_reach(points: Float64, i: int, step: int, reach: float) -> int:
    """The last of the successive points from i on, downwards or upwards, within reach of point i."""
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
def _bin_points(points: Float64, starts: Int64, lasers: Float64, bin_starts: Int64) -> Int32:
    """The nearest point of each scan in each of its bins of bearing, -1 for none."""
    bins = np.full(bin_starts[-1], _EMPTY, np.int32)
    for scan in range(len(lasers)):
        count = bin_starts[scan + 1] - bin_starts[scan]
        nearest = np.full(count, np.inf)
        for k in range(starts[scan], starts[scan + 1]):
            dx, dy = points[k, 0] - lasers[scan, 0], points[k, 1] - lasers[scan, 1]
            place = bin_index(dx, dy, count)
            distance = dx * dx + dy * dy
            if distance < nearest[place]:
                nearest[place] = distance
                bins[bin_starts[scan] + place] = k
    return bins


@njit(cache=True)
def bin_index(x: float, y: float, count: int) -> int:
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


class Weighting(NamedTuple):
    """The weights of points.

    :ivar sigma: deviation of a point from its wall, m.
    :ivar robust_scale: scale of Cauchy's weight, m.
    :ivar temper: exponent on the likelihood, since neighboring beams and overlapping pairs are correlated.
    """

    sigma: float
    robust_scale: float
    temper: float


def weighting_from_options(options: RefinementParameters) -> Weighting:
    """The weights of points, as configured."""
    return Weighting(options.sigma, options.robust_scale, options.temper)


@njit(cache=True)
def normal_equations(
    sources: ScanSurfaces,
    source_indices: Int64,
    targets: ScanSurfaces,
    target_indices: Int64,
    relative: Float64,
    gate: float,
    weights: Weighting,
    stride: int,
) -> tuple[Float64, Float64, Float64]:
    """The normal equations of the registration of pairs of scans at given relative poses.

    :param source_indices: shape (m,), the scan of ``sources`` whose points are registered in each pair.
    :param target_indices: shape (m,), the scan of ``targets`` whose walls are used.
    :param relative: shape (m, 3), ``target_T_source``, m and rad.
    :param gate: largest distance of a point from its wall point, m.
    :param stride: 1 for all points, k for one out of k, with k times the weight.
    :returns: information (m, 3, 3) and gradient (m, 3) of half the squared error in the right tangent of
        ``target_T_source``, and the share (m,) of the points with a wall.
    """
    m = len(source_indices)
    information, gradient, share = np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros(m)
    for e in range(m):
        share[e] = _add_points(
            sources,
            source_indices[e],
            targets,
            target_indices[e],
            relative[e],
            gate,
            weights,
            stride,
            information[e],
            gradient[e],
        )
    return information, gradient, share


@njit(cache=True)
def _add_points(
    sources: ScanSurfaces,
    source: int,
    targets: ScanSurfaces,
    target: int,
    pose: Float64,
    gate: float,
    weights: Weighting,
    stride: int,
    information: Float64,
    gradient: Float64,
) -> float:
    """Write the normal equations of the points of scan ``source`` with walls of scan ``target``.

    :param pose: ``target_T_source``, shape (3,).
    :param information: shape (3, 3), ``gradient`` (3,): written to.
    :returns: the share of the points with a wall.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    largest, sharpness = stride * weights.temper / weights.sigma**2, 1.0 / weights.robust_scale
    # Sums in variables of their own stay in registers.
    xx = xy = xt = yy = yt = tt = gx = gy = gt = 0.0
    total = matched = 0
    # Taken from their tuples once, since each access counts references to them.
    own, own_normals, own_flat = sources.points, sources.normals, sources.is_flat
    points, normals, flat, bins = targets.points, targets.normals, targets.is_flat, targets.bins
    laser_x, laser_y = targets.lasers[target, 0], targets.lasers[target, 1]
    begin, end = targets.bin_starts[target], targets.bin_starts[target + 1]
    for k in range(sources.starts[source], sources.starts[source + 1], stride):
        total += 1
        px, py = own[k, 0], own[k, 1]
        x, y = transform_point(pose[0], pose[1], cos, sin, px, py)
        q = _nearest_point(points, bins, begin, end - begin, x, y, x - laser_x, y - laser_y, gate)
        if q < 0 or not flat[q]:
            continue
        nx, ny = normals[q, 0], normals[q, 1]
        jx, jy = rotate_back(cos, sin, nx, ny)
        if own_flat[k] and jx * own_normals[k, 0] + jy * own_normals[k, 1] < _SAME_WALL:
            continue
        matched += 1
        jt = jy * px - jx * py
        error = nx * (x - points[q, 0]) + ny * (y - points[q, 1])
        weight = largest / (1.0 + (error * sharpness) ** 2)
        wx, wy, wt = weight * jx, weight * jy, weight * jt
        xx += wx * jx
        xy += wx * jy
        xt += wx * jt
        yy += wy * jy
        yt += wy * jt
        tt += wt * jt
        gx += wx * error
        gy += wy * error
        gt += wt * error
    write_to_array(Symmetric(xx, xy, xt, yy, yt, tt), information)
    gradient[0], gradient[1], gradient[2] = gx, gy, gt
    return matched / max(1, total)


@njit(cache=True, inline="always")
def _nearest_point(
    points: Float64, bins: Int32, first: int, count: int, x: float, y: float, dx: float, dy: float, gate: float
) -> int:
    """The point of a scan nearest to (x, y) in its base frame, among those of similar bearing; -1 for none.

    :param bins: see :class:`ScanSurfaces`; those of the scan are ``count`` from ``first`` on.
    :param dx: from the laser to (x, y), ``dy``.
    """
    middle = bin_index(dx, dy, count)
    # Squared width of a bin: a lower bound of the distance to a point grows by about this with each bin.
    squared_width = (2.0 * np.pi / count) ** 2 * (dx * dx + dy * dy)
    nearest, best = -1, gate * gate
    # This comparison is repeated below, since a call takes twice the time.
    k = bins[first + middle]
    if k >= 0:
        ex, ey = points[k, 0] - x, points[k, 1] - y
        squared = ex * ex + ey * ey
        if squared < best:
            best, nearest = squared, k
    # To one side and then to the other, while a nearer point is possible.
    for step in (-1, 1):
        place = middle
        for distance in range(min(_MAX_BINS, count // 2)):
            if distance * distance * squared_width >= best:
                break
            place += step
            if place < 0:
                place += count
            elif place >= count:
                place -= count
            k = bins[first + place]
            if k >= 0:
                ex, ey = points[k, 0] - x, points[k, 1] - y
                squared = ex * ex + ey * ey
                if squared < best:
                    best, nearest = squared, k
    return nearest
