"""Point-to-line registration of scans with each other: the normal equations of many pairs in one compiled call.

The error of a point p of one scan that meets the wall point q of another, with normal n, is n^T (T p - q) with T the
pose of the one scan seen from the other; Cauchy's weight takes what does not fit out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.configuration.tree import Refinement
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
) -> tuple[Float64, Float64, Float64]:
    """Linearise the registration of pairs of scans at given relative poses.

    :param one_of: shape (m,), the scan of ``ones`` whose points are registered in each pair.
    :param other_of: shape (m,), the scan of ``others`` with whose walls.
    :param relative: shape (m, 3), ``other_T_one``, m and rad.
    :param gate: points farther apart than this do not meet, m.
    :returns: information (m, 3, 3) and gradient (m, 3) of half the squared error in the right tangent of
        ``other_T_one``, and the share (m,) of the points that meet a wall.
    """
    m = len(one_of)
    information, gradient, share = np.zeros((m, 3, 3)), np.zeros((m, 3)), np.zeros(m)
    for e in range(m):
        share[e] = _add_points(
            ones, one_of[e], others, other_of[e], relative[e], gate, weights, information[e], gradient[e]
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
    information: Float64,
    gradient: Float64,
) -> float:
    """Add the points of scan ``one`` that meet walls of scan ``other``, ``pose`` being ``other_T_one``.

    :returns: the share of the points that meet a wall.
    """
    points = ones.points
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    most, sharpness = weights.temper / weights.sigma**2, 1.0 / weights.robust
    row = np.empty(3)
    met = 0
    first, last = ones.starts[one], ones.starts[one + 1]
    for k in range(first, last):
        x = pose[0] + cos * points[k, 0] - sin * points[k, 1]
        y = pose[1] + sin * points[k, 0] + cos * points[k, 1]
        q = _nearest(others, other, x, y, gate)
        if q < 0 or not others.flat[q]:
            continue
        nx, ny = others.normals[q, 0], others.normals[q, 1]
        if ones.flat[k]:
            ox, oy = ones.normals[k, 0], ones.normals[k, 1]
            if (cos * ox - sin * oy) * nx + (sin * ox + cos * oy) * ny < _SAME_WALL:
                continue
        met += 1
        error = nx * (x - others.points[q, 0]) + ny * (y - others.points[q, 1])
        row[0], row[1] = cos * nx + sin * ny, -sin * nx + cos * ny
        row[2] = row[1] * points[k, 0] - row[0] * points[k, 1]
        weight = most / (1.0 + (error * sharpness) ** 2)
        for i in range(3):
            gradient[i] += weight * error * row[i]
            for j in range(3):
                information[i, j] += weight * row[i] * row[j]
    return met / max(1, last - first)


@njit(cache=True)
def _nearest(surfaces: Surfaces, scan: int, x: float, y: float, gate: float) -> int:
    """The point of a scan nearest to (x, y) in its base frame, among those seen in that direction; -1 for none."""
    dx, dy = x - surfaces.lasers[scan, 0], y - surfaces.lasers[scan, 1]
    first = surfaces.bin_starts[scan]
    count = surfaces.bin_starts[scan + 1] - first
    middle = bin_of(np.arctan2(dy, dx), count)
    # What is seen so many bins away is at least so far off: the chord grows by about this with each bin.
    squared_width = (2.0 * np.pi / count) ** 2 * (dx * dx + dy * dy)
    nearest, best = -1, gate * gate
    for offset in range(min(_WINDOW, count // 2) + 1):
        if offset > 1 and (offset - 1) ** 2 * squared_width >= best:
            break
        below, above = middle - offset, middle + offset
        for place in (below if below >= 0 else below + count, above if above < count else above - count):
            k = surfaces.bins[first + place]
            if k < 0:
                continue
            ex, ey = surfaces.points[k, 0] - x, surfaces.points[k, 1] - y
            squared = ex * ex + ey * ey
            if squared < best:
                best, nearest = squared, k
    return nearest
