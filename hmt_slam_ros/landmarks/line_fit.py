"""Line fit with covariance (Arras and Siegwart 1997), and merging of segments of one line.

A line is n(alpha) p = r. A beam from o along the unit vector d meets it at the range (r - n o) / (n d). Ranges are
uncertain and directions exact. So an error of a range is n d times as large across the line, and the weight of a point
is 1 / (sigma n d)^2: least squares over the ranges, by Gauss-Newton. Other weights would lose most information of walls
at grazing angles, and rotate them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import wrap_by_turns

_STEPS = 6
"""Gauss-Newton steps."""

_PARALLEL = 1e-4
"""Beams with a smaller sine of the angle to the line are ignored."""

_SMALL = 1e-12
"""Relative determinant of the information below which there is no line."""


class Beams(NamedTuple):
    """The beams of a scan with a return, in their order.

    :ivar points: shape (n, 2), end points, m.
    :ivar directions: shape (n, 2), unit vectors along the beams.
    :ivar deviations: shape (n,), of the ranges, m.
    """

    points: Float64
    directions: Float64
    deviations: Float64


@njit(cache=True)
def fit_line(beams: Beams, labels: Int32, line: int, fitted: Float64) -> int:
    """Fit the line of the beams with a label.

    :param labels: shape (n,).
    :param line: the label.
    :param fitted: shape (5,), written to: alpha in [-pi, pi), r >= 0, and var(alpha), cov(alpha, r), var(r); rad, m.
    :returns: number of beams; below 2, or for beams of one point, nothing is written.
    """
    points, directions = beams.points, beams.directions
    count, alpha, r = _initial_line(points, labels, line)
    if count < 2:
        return 0
    aa = ar = rr = determinant = 0.0
    for _ in range(_STEPS):
        cos, sin = math.cos(alpha), math.sin(alpha)
        aa = ar = rr = ga = gr = 0.0
        for k in range(len(points)):
            facing = cos * directions[k, 0] + sin * directions[k, 1]
            if labels[k] != line or abs(facing) < _PARALLEL:
                continue
            # Residual of the range, and its derivatives by alpha and r.
            residual = (cos * points[k, 0] + sin * points[k, 1] - r) / facing
            x, y = points[k, 0] - residual * directions[k, 0], points[k, 1] - residual * directions[k, 1]
            weight = 1.0 / beams.deviations[k]
            residual *= weight
            by_alpha, by_r = weight * (sin * x - cos * y) / facing, weight / facing
            aa, ar, rr = aa + by_alpha * by_alpha, ar + by_alpha * by_r, rr + by_r * by_r
            ga, gr = ga + by_alpha * residual, gr + by_r * residual
        determinant = aa * rr - ar * ar
        if determinant <= _SMALL * aa * rr:
            return 0
        alpha += (rr * ga - ar * gr) / determinant
        r += (aa * gr - ar * ga) / determinant
    write_normalized(alpha, r, rr / determinant, -ar / determinant, aa / determinant, fitted)
    return count


@njit(cache=True)
def write_normalized(alpha: float, r: float, aa: float, ar: float, rr: float, line: Float64) -> None:
    """Write a line and its covariance (5,) with r >= 0 and alpha in [-pi, pi)."""
    if r < 0.0:
        alpha, r = alpha + math.pi, -r
        ar = -ar
    line[0] = wrap_by_turns(alpha)
    line[1], line[2], line[3], line[4] = r, aa, ar, rr


@njit(cache=True)
def variance_at(aa: float, ar: float, rr: float, along: float) -> float:
    """Variance of the distance between a line and a point on it, by var(alpha), cov(alpha, r) and var(r), m^2.

    :param along: position of the point on the line, m from the foot of the perpendicular.
    """
    return along * along * aa - 2.0 * along * ar + rr


@njit(cache=True)
def _initial_line(points: Float64, labels: Int32, line: int) -> tuple[int, float, float]:
    """Number of the points with a label, and the line through them by equal weights (Arras), r of either sign."""
    count, x, y, xx, xy, yy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(points)):
        if labels[k] == line:
            count, x, y = count + 1, x + points[k, 0], y + points[k, 1]
    if count < 2:
        return 0, 0.0, 0.0
    x, y = x / count, y / count
    for k in range(len(points)):
        if labels[k] == line:
            dx, dy = points[k, 0] - x, points[k, 1] - y
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    alpha = 0.5 * math.atan2(-2.0 * xy, yy - xx)
    return count, alpha, x * math.cos(alpha) + y * math.sin(alpha)


class MergeGate(NamedTuple):
    """Thresholds for merging two segments into one line.

    :ivar distance2: largest squared Mahalanobis distance.
    :ivar deviation: largest deviation of the distance of one's middle from the other, m.
    """

    distance2: float
    deviation: float


@njit(cache=True)
def relabel(labels: Int32, old: int, new: int) -> None:
    """Replace a label."""
    for k in range(len(labels)):
        if labels[k] == old:
            labels[k] = new


@njit(cache=True)
def merge_lines(beams: Beams, labels: Int32, lines: Float64, count: int, gate: MergeGate) -> int:
    """Merge the two most similar lines while the gate admits it, and return the number of lines."""
    middles = np.empty((count, 2))
    for line in range(count):
        _write_mean_point(beams.points, labels, line, middles[line])
    while True:
        least, one, other = gate.distance2, 0, 0
        for i in range(count):
            for k in range(i):
                away = line_distance2(lines[i], lines[k])
                if away < least and _mutual_variance(lines[i], middles[i], lines[k], middles[k]) <= gate.deviation**2:
                    least, one, other = away, k, i
        if one == other:
            return count
        relabel(labels, other, one)
        fit_line(beams, labels, one, lines[one])
        _write_mean_point(beams.points, labels, one, middles[one])
        count -= 1
        if other != count:
            lines[other], middles[other] = lines[count], middles[count]
            relabel(labels, count, other)


@njit(cache=True)
def _write_mean_point(points: Float64, labels: Int32, line: int, middle: Float64) -> None:
    """Write the mean of the points of a line, (2,)."""
    count, x, y = 0, 0.0, 0.0
    for k in range(len(labels)):
        if labels[k] == line:
            count, x, y = count + 1, x + points[k, 0], y + points[k, 1]
    middle[0], middle[1] = x / count, y / count


@njit(cache=True)
def _mutual_variance(a: Float64, middle_a: Float64, b: Float64, middle_b: Float64) -> float:
    """Variance of the distance of one line's middle from the other, m^2.

    If it is large, as for two short segments far apart, two lines may match by chance.
    """
    return min(
        _variance_at(a, middle_b) + _variance_at(b, middle_b), _variance_at(a, middle_a) + _variance_at(b, middle_a)
    )


@njit(cache=True)
def _variance_at(line: Float64, point: Float64) -> float:
    """Variance of the distance between a point (2,) and a line (5,), m^2."""
    along = math.cos(line[0]) * point[1] - math.sin(line[0]) * point[0]
    return variance_at(line[2], line[3], line[4], along)


@njit(cache=True)
def line_distance2(a: Float64, b: Float64) -> float:
    """Squared Mahalanobis distance of two independent lines (5,); chi-square with 2 degrees of freedom.

    The second is taken in the nearer one of its representations (alpha, r) and (alpha + pi, -r).
    """
    turn = wrap_by_turns(b[0] - a[0])
    away, sign = b[1] - a[1], 1.0
    if abs(turn) > 0.5 * math.pi:
        turn, away, sign = wrap_by_turns(turn - math.pi), -b[1] - a[1], -1.0
    aa, ar, rr = a[2] + b[2], a[3] + sign * b[3], a[4] + b[4]
    return (rr * turn * turn - 2.0 * ar * turn * away + aa * away * away) / (aa * rr - ar * ar)
