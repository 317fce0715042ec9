"""Landmarks of a scan: its corners and openings, and the known ones that it should show.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1. A corner is the intersection of two lines at a right angle, both
of which are visible up to there. Its heading is the bisector of the free space before it, and its confidence follows
from its size. Corners of rooms are concave, those of pillars convex.

A known landmark should be visible where beams reach all parts of it: both walls of a corner, or the gap and both jambs
of an opening. Of a closed opening, whose gap no beam passes, one jamb is enough. A beam that ends before it, such as at
a person, counts for nothing. Beams that pass one wall of a corner show that it is gone, without its other wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.openings import Openings, extract_openings
from hmt_slam_ros.landmarks.rays import Rays

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
"""No corners, for trackers of openings alone."""


def extract_corners(lines: Lines, features: FeatureParameters) -> Corners:
    """The corners that lines make."""
    tolerance = math.sin(math.radians(features.corner_angle))
    parameters = np.ascontiguousarray(lines.parameters)
    found = _find_corners(parameters, lines.covariances, lines.segments, lines.owners, tolerance, features.corner_gap)
    covariances, confidences = found[:, _COVARIANCE:].reshape(-1, 3, 3), size_confidence(found[:, _SUPPORT], features)
    return Corners(found[:, :3], covariances, found[:, _CONVEX] > 0.0, confidences)


def size_confidence(lengths: Float64, features: FeatureParameters) -> Float64:
    """Confidence in landmarks by the visible length of both their walls, m, shape (n,)."""
    return 1.0 - np.exp(-0.5 * lengths / features.landmark_size)


@njit(cache=True)
def _find_corners(
    lines: Float64, covariances: Float64, pieces: Float64, owners: Int64, tolerance: float, gap: float
) -> Float64:
    """Corners of all pairs of segments that meet at a right angle, (n, 14)."""
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
    """Length of a segment that begins at a point, negative against the line's direction; 0 if it does not."""
    at = y * math.cos(line[0]) - x * math.sin(line[0])
    ahead, back = piece[1] - at, at - piece[0]
    if abs(piece[0] - at) <= gap and ahead > back:
        return ahead
    if abs(piece[1] - at) <= gap and back > ahead:
        return -back
    return 0.0


@njit(cache=True)
def _write_corner(a: Float64, b: Float64, x: float, y: float, one: float, other: float, found: Float64) -> bool:
    """Write position, kind and support of the corner of two arms; False where their free sides contradict."""
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


CONCAVE_CORNER, CONVEX_CORNER, OPENING = range(3)
"""Kinds of landmarks: the corner of a room, that of a pillar, or an opening."""

KIND_NAMES = ("corner", "convex corner", "opening")
"""Names of the kinds."""

_BEFORE, _BEHIND = 0.1, 0.15
"""Distance of sample points before a wall that has to be visible, and behind one that is passed, m."""

_SAMPLES = 4
"""Sample points along each wall of a corner, and over the width of an opening."""

_JAMB_DISTANCE = 0.15
"""Distance of the sample points on jambs from the opening, m."""

_MIN_VISIBLE_ANGLE = math.radians(3.0)
"""Smallest angle under which the walls of a corner are visible, rad."""

_MIN_FACING = 0.4
"""Smallest sine of the angle between a wall and a beam."""

_MIN_CLOSED_SHARE = 0.5
"""Smallest share of the gap of a closed opening that is visible."""

_MAX_BEAM_ANGLE = math.radians(1.5)
"""Largest angle between a point and the beam that decides on it, rad."""


class ScanLandmarks(NamedTuple):
    """Landmarks of any kind, in one frame.

    :ivar kinds: shape (n,), one of the constants above.
    :ivar poses: shape (n, 3), as of `Corners` and `Openings`, m and rad.
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    :ivar confidences: shape (n,), in (0, 1).
    :ivar widths: shape (n,), of openings, m; 0 of corners.
    :ivar width_deviations: shape (n,), of these, m; 0 of corners.
    """

    kinds: Int64
    poses: Float64
    covariances: Float64
    confidences: Float64
    widths: Float64
    width_deviations: Float64


def extract_landmarks(lines: Lines, rays: Rays, features: FeatureParameters) -> ScanLandmarks:
    """The corners and openings of a scan's lines and beams."""
    return concatenate_landmarks(extract_corners(lines, features), extract_openings(lines, rays, features))


def concatenate_landmarks(corners: Corners, openings: Openings) -> ScanLandmarks:
    """Corners and openings as landmarks, in this order."""
    none = np.zeros(len(corners.poses))
    return ScanLandmarks(
        np.concatenate(
            (np.where(corners.convex, CONVEX_CORNER, CONCAVE_CORNER), np.full(len(openings.poses), OPENING))
        ),
        np.concatenate((corners.poses, openings.poses)),
        np.concatenate((corners.covariances, openings.covariances)),
        np.concatenate((corners.confidences, openings.confidences)),
        np.concatenate((none, openings.widths)),
        np.concatenate((none, openings.width_deviations)),
    )


def should_be_visible(kinds: Int64, poses: Float64, widths: Float64, rays: Rays, features: FeatureParameters) -> Bool:
    """Whether landmarks should be visible to beams, shape (n,).

    :param poses: shape (n, 3), in the frame of the beams, m and rad.
    :param widths: shape (n,), of openings, m.
    """
    visible = np.hypot(*poses[:, :2].T) <= features.landmark_reach
    corner = kinds != OPENING
    visible[corner] &= _visible_corners(poses[corner], kinds[corner] == CONVEX_CORNER, rays, features.min_length)
    visible[~corner] &= _visible_openings(poses[~corner], widths[~corner], rays, features.opening_depth)
    return visible


def _visible_corners(poses: Float64, convex: Bool, rays: Rays, length: float) -> Bool:
    """Whether corners have both walls visible over a length, m, at a wide enough angle, or one that beams pass."""
    sign = np.where(convex, -1.0, 1.0)
    visible, passed = np.ones(len(poses), np.bool_), np.zeros(len(poses), np.bool_)
    for side in (1.0, -1.0):
        # In the frame of the corner: along one of its walls, and off it to the free side.
        along = math.sqrt(0.5) * np.stack((sign, side * np.ones(len(poses))), axis=1)
        before = math.sqrt(0.5) * np.stack((np.ones(len(poses)), -side * sign), axis=1)
        samples = np.linspace(_BEFORE, length, _SAMPLES)[:, None, None] * along
        points = se2.transform(poses, samples + _BEFORE * before)
        bearings = np.arctan2(points[..., 1], points[..., 0])
        wide = np.abs(se2.wrap(bearings[-1] - bearings[0])) >= _MIN_VISIBLE_ANGLE
        visible &= is_in_sight(points, rays).all(axis=0) & wide
        faced = _is_faced(poses, before)
        passed |= faced & is_in_sight(se2.transform(poses, samples - _BEHIND * before), rays).all(axis=0)
    return visible | passed


def _is_faced(poses: Float64, normals: Float64) -> Bool:
    """Whether the origin is well before a wall of corners (n, 3), with normals (n, 2) in their frames, shape (n,)."""
    origin = se2.inverse(poses)[:, :2]
    distances = np.maximum(np.hypot(*origin.T), 1e-9)
    return np.asarray((origin * normals).sum(axis=1) >= _MIN_FACING * distances)


def _visible_openings(poses: Float64, widths: Float64, rays: Rays, depth: float) -> Bool:
    """Whether openings have their gap and both jambs visible, or half of a closed gap and one jamb.

    :param depth: free distance behind an opening, m.
    """
    distances = np.hypot(*poses[:, :2].T)
    faced = np.cos(np.arctan2(poses[:, 1], poses[:, 0]) - poses[:, 2]) >= _MIN_FACING
    over = (np.arange(_SAMPLES) + 0.5)[:, None] / _SAMPLES - 0.5
    gap = np.stack(np.broadcast_arrays(-_BEFORE, over * widths), axis=-1)
    sides = np.array([[-1.0], [1.0]]) * (0.5 * widths + _JAMB_DISTANCE)
    jambs = np.stack(np.broadcast_arrays(-_BEFORE, sides), axis=-1)
    gap_visible, jambs_visible = (is_in_sight(se2.transform(poses, points), rays) for points in (gap, jambs))
    passed = is_in_sight(se2.transform(poses, gap + np.array([_BEFORE + depth, 0.0])), rays)
    whole = gap_visible.all(axis=0) & jambs_visible.all(axis=0)
    half = gap_visible.mean(axis=0) >= _MIN_CLOSED_SHARE
    closed = half & jambs_visible.any(axis=0) & ~passed.any(axis=0)
    return np.asarray(faced & (whole | closed) & (distances > _BEFORE))


def is_in_sight(points: Float64, rays: Rays) -> Bool:
    """Whether a beam reaches points (..., 2), shape (...); beams begin near each other."""
    if not len(rays.free_range):
        return np.zeros(points.shape[:-1], np.bool_)
    bearings = np.arctan2(rays.directions[:, 1], rays.directions[:, 0])
    order = np.argsort(bearings)
    offsets = points - rays.origins.mean(axis=0)
    directions = np.arctan2(offsets[..., 1], offsets[..., 0])
    after = np.searchsorted(bearings[order], directions)
    beams = [order[(after - back) % len(order)] for back in (0, 1)]
    angles = [np.abs(se2.wrap(bearings[beam] - directions)) for beam in beams]
    nearest = np.where(angles[0] < angles[1], *beams)
    reached = rays.free_range[nearest] >= np.hypot(offsets[..., 0], offsets[..., 1])
    return np.asarray(reached & (np.minimum(*angles) <= _MAX_BEAM_ANGLE))
