"""Which segments of a scan are one line."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.features.line_fit import Beams, fit, variance_at, wrapped


class Gate(NamedTuple):
    """When two segments are one line.

    :ivar distance2: squared Mahalanobis distance at most.
    :ivar deviation: of the distance of one's middle from the other at most, m.
    """

    distance2: float
    deviation: float


@njit(cache=True)
def relabel(labels: Int32, old: int, new: int) -> None:
    """Give the beams of one line to another."""
    for k in range(len(labels)):
        if labels[k] == old:
            labels[k] = new


@njit(cache=True)
def merge(beams: Beams, labels: Int32, lines: Float64, count: int, gate: Gate) -> int:
    """Join those two lines that differ least, as long as the gate allows; return how many are left."""
    middles = np.empty((count, 2))
    for line in range(count):
        _middle(beams.points, labels, line, middles[line])
    while True:
        least, one, other = gate.distance2, 0, 0
        for i in range(count):
            for k in range(i):
                away = distance2(lines[i], lines[k])
                if away < least and _tell(lines[i], middles[i], lines[k], middles[k]) <= gate.deviation**2:
                    least, one, other = away, k, i
        if one == other:
            return count
        relabel(labels, other, one)
        fit(beams, labels, one, lines[one])
        _middle(beams.points, labels, one, middles[one])
        count -= 1
        if other != count:
            lines[other], middles[other] = lines[count], middles[count]
            relabel(labels, count, other)


@njit(cache=True)
def _middle(points: Float64, labels: Int32, line: int, middle: Float64) -> None:
    """Write the mean of the points of a line, (2,)."""
    count, x, y = 0, 0.0, 0.0
    for k in range(len(labels)):
        if labels[k] == line:
            count, x, y = count + 1, x + points[k, 0], y + points[k, 1]
    middle[0], middle[1] = x / count, y / count


@njit(cache=True)
def _tell(a: Float64, middle_a: Float64, b: Float64, middle_b: Float64) -> float:
    """How well two lines tell that they are one: variance, m^2, of the distance of the one's middle from the other.

    Of two short pieces far from each other that lie side by side, either could point at the other; that the one is
    where the other points to says something only where it would not be so by chance.
    """
    return min(
        _variance_at(a, middle_b) + _variance_at(b, middle_b), _variance_at(a, middle_a) + _variance_at(b, middle_a)
    )


@njit(cache=True)
def _variance_at(line: Float64, point: Float64) -> float:
    """Variance, m^2, of the distance of a point (2,) near a line (5,) from it."""
    along = math.cos(line[0]) * point[1] - math.sin(line[0]) * point[0]
    return variance_at(line[2], line[3], line[4], along)


@njit(cache=True)
def distance2(a: Float64, b: Float64) -> float:
    """Squared Mahalanobis distance of two independent lines (5,); chi-square with 2 degrees of freedom.

    The second is taken in that of its two representations, (alpha, r) and (alpha + pi, -r), whose angle is nearer.
    """
    turn = wrapped(b[0] - a[0])
    away, sign = b[1] - a[1], 1.0
    if abs(turn) > 0.5 * math.pi:
        turn, away, sign = wrapped(turn - math.pi), -b[1] - a[1], -1.0
    aa, ar, rr = a[2] + b[2], a[3] + sign * b[3], a[4] + b[4]
    return (rr * turn * turn - 2.0 * ar * turn * away + aa * away * away) / (aa * rr - ar * ar)
