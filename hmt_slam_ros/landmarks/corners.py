"""Corners: where two walls that a scan shows meet at a right angle.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1: a corner has a position, an orientation and a confidence that
follows from its size. It is where two lines intersect, both of which were seen up to there; its heading is the
bisector of the free space before it. The corner of a room opens towards the robot, that of a pillar away from it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.landmarks.line_extraction import Lines

_X, _Y, _HEADING, _CONVEX, _SUPPORT, _COVARIANCE, _SIZE = 0, 1, 2, 3, 4, 5, 14


class Corners(NamedTuple):
    """Corners in the frame of the lines.

    :ivar poses: shape (n, 3), x, y, m, and the heading of the bisector of the free space, rad.
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    :ivar convex: shape (n,), whether the wall protrudes into the free space, as a pillar does.
    :ivar confidences: shape (n,), in (0, 1).
    """

    poses: Float64
    covariances: Float64
    convex: Bool
    confidences: Float64


NO_CORNERS = Corners(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.bool_), np.empty(0))
"""What is followed where openings alone are asked for."""


def extract_corners(lines: Lines, features: FeatureParameters) -> Corners:
    """The corners that lines make."""
    tolerance = math.sin(math.radians(features.corner_angle))
    parameters = np.ascontiguousarray(lines.parameters)
    found = _find_corners(parameters, lines.covariances, lines.segments, lines.owners, tolerance, features.corner_gap)
    covariances, confidences = found[:, _COVARIANCE:].reshape(-1, 3, 3), size_confidence(found[:, _SUPPORT], features)
    return Corners(found[:, :3], covariances, found[:, _CONVEX] > 0.0, confidences)


def size_confidence(lengths: Float64, features: FeatureParameters) -> Float64:
    """Confidence in landmarks by how much, m, was seen of both their walls together, shape (n,)."""
    return 1.0 - np.exp(-0.5 * lengths / features.landmark_size)


@njit(cache=True)
def _find_corners(
    lines: Float64, covariances: Float64, pieces: Float64, owners: Int64, tolerance: float, gap: float
) -> Float64:
    """Every pair of stretches that meet at a right angle, (n, 14)."""
    found, count = np.empty((len(pieces) * len(pieces), _SIZE)), 0
    for i in range(len(pieces)):
        for k in range(i):
            a, b = lines[owners[i]], lines[owners[k]]
            if abs(math.cos(b[0] - a[0])) > tolerance:
                continue
            x, y = _intersection(a, b)
            one, other = _signed_arm_length(a, pieces[i], x, y, gap), _signed_arm_length(b, pieces[k], x, y, gap)
            if one == 0.0 or other == 0.0:
                continue
            if _write_corner(a, b, x, y, one, other, found[count]):
                _write_covariance(a, b, covariances[owners[i]], covariances[owners[k]], found[count])
                count += 1
    return found[:count]


@njit(cache=True)
def _intersection(a: Float64, b: Float64) -> tuple[float, float]:
    determinant = math.sin(b[0] - a[0])
    x = (a[1] * math.sin(b[0]) - b[1] * math.sin(a[0])) / determinant
    y = (b[1] * math.cos(a[0]) - a[1] * math.cos(b[0])) / determinant
    return x, y


@njit(cache=True)
def _signed_arm_length(line: Float64, piece: Float64, x: float, y: float, gap: float) -> float:
    """Length of a stretch that begins at a point, below 0 where it goes against the line's direction; 0 for none."""
    at = y * math.cos(line[0]) - x * math.sin(line[0])
    ahead, back = piece[1] - at, at - piece[0]
    if abs(piece[0] - at) <= gap and ahead > back:
        return ahead
    if abs(piece[1] - at) <= gap and back > ahead:
        return -back
    return 0.0


@njit(cache=True)
def _write_corner(a: Float64, b: Float64, x: float, y: float, one: float, other: float, found: Float64) -> bool:
    """Write place, kind and support of the corner of two arms; False where their free sides contradict each other."""
    ax, ay, bx, by = math.cos(a[0]), math.sin(a[0]), math.cos(b[0]), math.sin(b[0])
    # Unit vectors along the arms. The free side of a line is that of the origin, against its normal.
    ux, uy = math.copysign(1.0, one) * -ay, math.copysign(1.0, one) * ax
    vx, vy = math.copysign(1.0, other) * -by, math.copysign(1.0, other) * bx
    inside, beside = -(ax * vx + ay * vy), -(bx * ux + by * uy)
    if inside * beside <= 0.0:
        return False
    sign = 1.0 if inside > 0.0 else -1.0
    found[_X], found[_Y] = x, y
    found[_HEADING] = math.atan2(sign * (uy + vy), sign * (ux + vx))
    found[_CONVEX], found[_SUPPORT] = -sign, abs(one) + abs(other)
    return True


@njit(cache=True)
def _write_covariance(a: Float64, b: Float64, of_a: Float64, of_b: Float64, found: Float64) -> None:
    """Write the covariance of the corner that follows from those of its lines: n(alpha) p = r of both."""
    ax, ay, bx, by = math.cos(a[0]), math.sin(a[0]), math.cos(b[0]), math.sin(b[0])
    x, y, determinant = found[_X], found[_Y], ax * by - ay * bx
    along_a, along_b = ax * y - ay * x, bx * y - by * x
    jacobian = np.zeros((3, 4))
    for row, by_a, by_b in ((0, by, -ay), (1, -bx, ax)):
        jacobian[row, 0], jacobian[row, 1] = -by_a * along_a / determinant, by_a / determinant
        jacobian[row, 2], jacobian[row, 3] = -by_b * along_b / determinant, by_b / determinant
    jacobian[2, 0] = jacobian[2, 2] = 0.5
    cos, sin = math.cos(found[_HEADING]), math.sin(found[_HEADING])
    turned = jacobian.copy()
    turned[0], turned[1] = cos * jacobian[0] + sin * jacobian[1], cos * jacobian[1] - sin * jacobian[0]
    of_lines = np.zeros((4, 4))
    of_lines[:2, :2], of_lines[2:, 2:] = of_a, of_b
    found[_COVARIANCE:] = (turned @ of_lines @ turned.T).ravel()
