"""Scan to scan: point-to-line registration of scans as surfaces, many pairs in one compiled call.

The error of a point p of one scan that meets the wall point q of another, with normal n, is n^T (T p - q) with T the
pose of the one scan seen from the other; Cauchy's weight takes what does not fit out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry.se2 import rotate_back, transform_point
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import FlatnessLimits, fit_surface, running_sums

# A wall piece is fitted to the points within this reach of a point, or within three beams at one degree where that is
# more, on at most so many beams to each side.
_REACH, _REACH_PER_METRE, _BEAMS = 0.25, 0.045, 8
_FLATNESS = FlatnessLimits(0.04, 0.5)
_EMPTY = -1


class ScanSurfaces(NamedTuple):
    """The end points of n scans, one scan after the other in the order of their beams.

    :ivar starts: shape (n + 1,), scan i has the points ``starts[i]`` to before ``starts[i + 1]``.
    :ivar points: shape (k, 2), m, base frame of their scan.
    :ivar normals: shape (k, 2), unit vectors towards the laser.
    :ivar is_flat: shape (k,), whether the point lies on a piece of wall, so that its normal means something.
    :ivar lasers: shape (n, 2), m, where the lasers stood in the base frames.
    :ivar bins: shape (b,), the point seen in each bin of bearing, -1 for none; of several the nearest.
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
    """Normals (n, 2) of the wall pieces around the points, and whether there is one (n,)."""
    normals, flat, normal = np.zeros_like(points), np.zeros(len(points), np.bool_), np.empty(2)
    beams = points - laser
    ranges = np.hypot(beams[:, 0], beams[:, 1])
    sums = running_sums(beams, ranges)
    for i in range(len(points)):
        reach = max(_REACH, _REACH_PER_METRE * ranges[i])
        low, high = _last_in_reach(points, i, -1, reach), _last_in_reach(points, i, 1, reach)
        if high - low < 2 or not fit_surface(beams, sums, low, i, high, _FLATNESS, normal):
            continue
        towards = -1.0 if normal[0] * beams[i, 0] + normal[1] * beams[i, 1] > 0.0 else 1.0
        normals[i, 0], normals[i, 1] = towards * normal[0], towards * normal[1]
        flat[i] = True
    return normals, flat


@njit(cache=True)
def _last_in_reach(points: Float64, i: int, step: int, reach: float) -> int:
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
def _bin_points(points: Float64, starts: Int64, lasers: Float64, bin_starts: Int64) -> Int32:
    """The nearest point of each scan in each of its bins of bearing."""
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


# Bins of bearing searched to each side at most, and the cosine of the angle between walls that are the same at least.
_MAX_BINS = 20
_SAME_WALL = 0.7


class Weighting(NamedTuple):
    """How the points count.

    :ivar sigma: deviation of a point from its wall, m.
    :ivar robust_scale: scale of Cauchy's weight, m.
    :ivar temper: exponent on the likelihood, since neighbouring beams and overlapping pairs are correlated.
    """

    sigma: float
    robust_scale: float
    temper: float


def weighting_from_options(options: RefinementParameters) -> Weighting:
    """How points count, as configured."""
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
    """Linearise the registration of pairs of scans at given relative poses.

    :param source_indices: shape (m,), the scan of ``sources`` whose points are registered in each pair.
    :param target_indices: shape (m,), the scan of ``targets`` with whose walls.
    :param relative: shape (m, 3), ``other_T_one``, m and rad.
    :param gate: points farther apart than this do not meet, m.
    :param stride: 1 for all points, k for one out of k, which counts for as many.
    :returns: information (m, 3, 3) and gradient (m, 3) of half the squared error in the right tangent of
        ``other_T_one``, and the share (m,) of the points that meet a wall.
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
    ones: ScanSurfaces,
    one: int,
    others: ScanSurfaces,
    other: int,
    pose: Float64,
    gate: float,
    weights: Weighting,
    every: int,
    information: Float64,
    gradient: Float64,
) -> float:
    """Enter the points of scan ``one`` that meet walls of scan ``other``, ``pose`` being ``other_T_one``.

    :param information: shape (3, 3), ``gradient`` (3,): written to.
    :returns: the share of the points that meet a wall.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    most, sharpness = every * weights.temper / weights.sigma**2, 1.0 / weights.robust_scale
    # Sums in variables of their own stay in registers.
    xx = xy = xt = yy = yt = tt = gx = gy = gt = 0.0
    seen = met = 0
    # Taken from their tuples once: each time counts references to them.
    own, own_normals, own_flat = ones.points, ones.normals, ones.is_flat
    points, normals, flat, bins = others.points, others.normals, others.is_flat, others.bins
    laser_x, laser_y = others.lasers[other, 0], others.lasers[other, 1]
    begin, end = others.bin_starts[other], others.bin_starts[other + 1]
    for k in range(ones.starts[one], ones.starts[one + 1], every):
        seen += 1
        px, py = own[k, 0], own[k, 1]
        x, y = transform_point(pose[0], pose[1], cos, sin, px, py)
        q = _nearest_point(points, bins, begin, end - begin, x, y, x - laser_x, y - laser_y, gate)
        if q < 0 or not flat[q]:
            continue
        nx, ny = normals[q, 0], normals[q, 1]
        jx, jy = rotate_back(cos, sin, nx, ny)
        if own_flat[k] and jx * own_normals[k, 0] + jy * own_normals[k, 1] < _SAME_WALL:
            continue
        met += 1
        jt = jy * px - jx * py
        error = nx * (x - points[q, 0]) + ny * (y - points[q, 1])
        weight = most / (1.0 + (error * sharpness) ** 2)
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
    information[0, 0], information[1, 1], information[2, 2] = xx, yy, tt
    information[0, 1] = information[1, 0] = xy
    information[0, 2] = information[2, 0] = xt
    information[1, 2] = information[2, 1] = yt
    gradient[0], gradient[1], gradient[2] = gx, gy, gt
    return met / max(1, seen)


@njit(cache=True, inline="always")
def _nearest_point(
    points: Float64, bins: Int32, first: int, count: int, x: float, y: float, dx: float, dy: float, gate: float
) -> int:
    """The point of a scan nearest to (x, y) in its base frame, among those seen in that direction; -1 for none.

    :param bins: see :class:`ScanSurfaces`; those of the scan are ``count`` from ``first`` on.
    :param dx: from the laser to (x, y), ``dy``.
    """
    middle = bin_index(dx, dy, count)
    # What is seen so many bins away is at least so far off: the chord grows by about this with each bin.
    squared_width = (2.0 * np.pi / count) ** 2 * (dx * dx + dy * dy)
    nearest, best = -1, gate * gate
    # This comparison stands twice: as a function of its own it takes twice the time.
    k = bins[first + middle]
    if k >= 0:
        ex, ey = points[k, 0] - x, points[k, 1] - y
        squared = ex * ex + ey * ey
        if squared < best:
            best, nearest = squared, k
    # To one side and then to the other, as far as that may bring something nearer.
    for step in (-1, 1):
        place = middle
        for passed in range(min(_MAX_BINS, count // 2)):
            if passed * passed * squared_width >= best:
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
