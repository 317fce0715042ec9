"""Point-to-line registration of scans with each other: the normal equations of many pairs in one compiled call.

The error of a point p of one scan that meets the wall point q of another, with normal n, is n^T (T p - q) with T the
pose of the one scan seen from the other; Cauchy's weight takes what does not fit out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.configuration.topological import Refinement
from hmt_slam_ros.refinement.surfaces import Surfaces, bin_of

# Bins of bearing searched to each side at most, and the cosine of the angle between walls that are the same at least.
_WINDOW = 20
_SAME_WALL = 0.7


class Weighting(NamedTuple):
    """How the points count.

    :ivar sigma: deviation of a point from its wall, m.
    :ivar robust: scale of Cauchy's weight, m.
    :ivar temper: exponent on the likelihood, since neighbouring beams and overlapping pairs are correlated.
    """

    sigma: float
    robust: float
    temper: float


def weighting(options: Refinement) -> Weighting:
    """How points count, as configured."""
    return Weighting(options.sigma, options.robust_scale, options.temper)


@njit(cache=True)
def normal_equations(
    ones: Surfaces,
    one_of: Int64,
    others: Surfaces,
    other_of: Int64,
    relative: Float64,
    gate: float,
    weights: Weighting,
    every: int,
) -> tuple[Float64, Float64, Float64]:
    """Linearise the registration of pairs of scans at given relative poses.

    :param one_of: shape (m,), the scan of ``ones`` whose points are registered in each pair.
    :param other_of: shape (m,), the scan of ``others`` with whose walls.
    :param relative: shape (m, 3), ``other_T_one``, m and rad.
    :param gate: points farther apart than this do not meet, m.
    :param every: 1 for all points, k for one out of k, which counts for as many.
    :returns: information (m, 3, 3) and gradient (m, 3) of half the squared error in the right tangent of
        ``other_T_one``, and the share (m,) of the points that meet a wall.
    """
    m = len(one_of)
    information, gradient, share = np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros(m)
    for e in range(m):
        share[e] = _add_points(
            ones, one_of[e], others, other_of[e], relative[e], gate, weights, every, information[e], gradient[e]
        )
    return information, gradient, share


@njit(cache=True)
def _add_points(
    ones: Surfaces,
    one: int,
    others: Surfaces,
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
    most, sharpness = every * weights.temper / weights.sigma**2, 1.0 / weights.robust
    # Sums in variables of their own stay in registers.
    xx = xy = xt = yy = yt = tt = gx = gy = gt = 0.0
    seen = met = 0
    # Taken from their tuples once: each time counts references to them.
    own, own_normals, own_flat = ones.points, ones.normals, ones.flat
    points, normals, flat, bins = others.points, others.normals, others.flat, others.bins
    laser_x, laser_y = others.lasers[other, 0], others.lasers[other, 1]
    begin, end = others.bin_starts[other], others.bin_starts[other + 1]
    for k in range(ones.starts[one], ones.starts[one + 1], every):
        seen += 1
        px, py = own[k, 0], own[k, 1]
        x = pose[0] + cos * px - sin * py
        y = pose[1] + sin * px + cos * py
        q = _nearest(points, bins, begin, end - begin, x, y, x - laser_x, y - laser_y, gate)
        if q < 0 or not flat[q]:
            continue
        nx, ny = normals[q, 0], normals[q, 1]
        jx, jy = cos * nx + sin * ny, -sin * nx + cos * ny
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
def _nearest(
    points: Float64, bins: Int32, first: int, count: int, x: float, y: float, dx: float, dy: float, gate: float
) -> int:
    """The point of a scan nearest to (x, y) in its base frame, among those seen in that direction; -1 for none.

    :param bins: see :class:`Surfaces`; those of the scan are ``count`` from ``first`` on.
    :param dx: from the laser to (x, y), ``dy``.
    """
    middle = bin_of(dx, dy, count)
    # What is seen so many bins away is at least so far off: the chord grows by about this with each bin.
    squared_width = (2.0 * np.pi / count) ** 2 * (dx * dx + dy * dy)
    nearest, best = -1, gate * gate
    k = bins[first + middle]
    if k >= 0:
        ex, ey = points[k, 0] - x, points[k, 1] - y
        squared = ex * ex + ey * ey
        if squared < best:
            best, nearest = squared, k
    # To one side and then to the other, as far as that may bring something nearer.
    for step in (-1, 1):
        place = middle
        for passed in range(min(_WINDOW, count // 2)):
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
