"""Which beams of a scan lie on one line: the best of all partitions of the beams in their order.

A beam costs the square of its residual in range, in deviations; a line costs a penalty, and a beam on no line another.
The cheapest partition follows by dynamic programming over the beams (optimal partitioning, Jackson et al. 2005), in
which starts that cannot become better any more are left out (PELT, Killick et al. 2012). So where a wall ends is
decided by all beams on both sides of its end, not by one threshold on one of them. Across a gap in which no beam
returned nothing is sorted into one line: that it goes on there, only its two pieces can tell.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32

_NONE = -1


@njit(cache=True)
def segments(
    rays: Float64, begins: Int32, deviations: Float64, line_penalty: float, stray_penalty: float, labels: Int32
) -> int:
    """Number the lines of a scan.

    :param rays: shape (n, 2), m, from the laser to the end points, in the order of the beams; none of length 0.
    :param begins: shape (n,), the first beam behind the last gap before each.
    :param deviations: shape (n,), of the ranges, m.
    :param line_penalty: what a line costs, in squared deviations.
    :param stray_penalty: what a beam on no line costs, likewise.
    :param labels: shape (n,), written to: the number of each beam's line, from 0, or -1.
    :returns: number of lines.
    """
    starts = _cheapest(rays, begins, deviations, line_penalty, stray_penalty)
    end, count = len(rays), 0
    while end > 0:
        start = starts[end - 1]
        if start == _NONE:
            labels[end - 1] = _NONE
            end -= 1
        else:
            labels[start:end] = count
            count += 1
            end = start
    return count


@njit(cache=True)
def _cheapest(rays: Float64, begins: Int32, deviations: Float64, line_penalty: float, stray_penalty: float) -> Int32:
    """Where the line begins that ends with each beam in the cheapest partition up to it; -1 where it is on none."""
    count = len(rays)
    costs, starts = np.zeros(count + 1), np.empty(count, np.int32)
    for last in range(count):
        best, start = costs[last] + stray_penalty, _NONE
        # Sums over the beams from `first` to `last` of r^4 d d', r^3 d and r^2 by the variance of r, d being the
        # direction: on a line the inverse of the range is linear in d, and its deviation is that of the range by r^2.
        xx = xy = yy = x = y = square = 0.0
        for first in range(last, begins[last] - 1, -1):
            px, py = rays[first, 0], rays[first, 1]
            squared = (px * px + py * py) / (deviations[first] * deviations[first])
            xx, xy, yy = xx + squared * px * px, xy + squared * px * py, yy + squared * py * py
            x, y, square = x + squared * px, y + squared * py, square + squared
            determinant = xx * yy - xy * xy
            misfit = 0.0
            if last - first > 1 and determinant > 0.0:
                misfit = square - (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
            cost = costs[first] + max(0.0, misfit)
            # No line that begins before this one can cost less than it does without its penalty.
            if cost >= best:
                break
            if cost + line_penalty < best:
                best, start = cost + line_penalty, first
        costs[last + 1], starts[last] = best, start
    return starts
