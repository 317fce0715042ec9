"""The motion between two scans, and the noise of odometry over a path."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.metric_slam import FilterParameters, MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import (
    Symmetric,
    add_scaled,
    chi_square_gate,
    dot,
    matrix_inverse,
    multiply,
    propagate_covariance,
    solve,
    symmetric_from_array,
)

_DEGREES, _RADIANS = 180.0 / math.pi, math.pi / 180.0

_ANY_HEADING = math.pi / math.sqrt(3.0)
"""Deviation of a heading of which nothing is known, rad."""

_JUMP_GATE = chi_square_gate(0.999)
"""Squared Mahalanobis distance up to which odometry agrees with inertia; 3 degrees of freedom."""

_LEAST_VARIANCE = 1e-12
"""Variance of a motion at least, m^2 and rad^2, so that those without uncertainty compare."""

Length = TypeVar("Length", float, Float64)


class RelativeMotion(NamedTuple):
    """A motion between two scans.

    :ivar increment: shape (3,), ``start_T_end``.
    :ivar covariance: shape (3, 3), in the frame of its end.
    """

    increment: Float64
    covariance: Float64

    def compose(self, other: RelativeMotion) -> RelativeMotion:
        """Both motions, one after the other."""
        before = propagate_covariance(self.covariance, other.increment)
        return RelativeMotion(se2.compose(self.increment, other.increment), before + other.covariance)

    def fuse(self, other: RelativeMotion) -> RelativeMotion:
        """The same motion from two independent sources: the product of both Gaussians."""
        gain = self.covariance @ matrix_inverse(self.covariance + other.covariance)
        difference = se2.log(se2.between(self.increment, other.increment))
        increment = se2.compose(self.increment, se2.exp(gain @ difference))
        return RelativeMotion(increment, self.covariance - gain @ self.covariance)

    def bound_heading(self) -> RelativeMotion:
        """The same motion, with a heading no less certain than one of which nothing is known."""
        scale = np.array([1.0, 1.0, _ANY_HEADING / max(_ANY_HEADING, math.sqrt(self.covariance[2, 2]))])
        return self._replace(covariance=self.covariance * np.outer(scale, scale))


NO_MOTION = RelativeMotion(np.zeros(3), np.zeros((3, 3)))
"""No motion, without uncertainty."""


def squared_accelerations(motion: MotionParameters) -> Float64:
    """Squares of the robot's accelerations, on the diagonal (3, 3), m^2/s^4 and rad^2/s^4."""
    return np.diag([motion.acceleration**2, motion.acceleration**2, math.radians(motion.turn_acceleration) ** 2])


def increment_covariance(increment: Float64, motion: MotionParameters) -> Float64:
    """Covariance (3, 3) of an odometry increment in the frame of its end, m and rad."""
    return path_covariance(math.hypot(increment[0], increment[1]), abs(float(se2.wrap(increment[2]))), motion)


def path_covariance(distance: float, angle: float, motion: MotionParameters) -> Float64:
    """Covariance (3, 3) of the odometry over a path, in the frame of its end, m and rad.

    Standard deviations grow linearly with the distance (m) and the angle (rad) traveled; the lateral deviation equals
    the longitudinal one.
    """
    translation, rotation = path_standard_deviations(distance, angle, motion)
    return np.array(((translation**2, 0.0, 0.0), (0.0, translation**2, 0.0), (0.0, 0.0, rotation**2)))


def path_standard_deviations(distance: Length, angle: Length, motion: MotionParameters) -> tuple[Length, Length]:
    """The deviations of translation (m), in either direction, and rotation (rad) that `path_covariance` squares.

    :param distance: m, a number or an array.
    :param angle: rad, likewise.
    """
    translation = (
        motion.translation_floor
        + motion.translation_from_translation * distance
        + motion.translation_from_rotation * (angle * _DEGREES)
    )
    rotation = (motion.rotation_floor + motion.rotation_from_translation * distance) * _RADIANS
    return translation, rotation + motion.rotation_from_rotation * angle


@njit(cache=True)
def is_jump(odometry: RelativeMotion, inertia: RelativeMotion) -> bool:
    """Whether the robot can hardly have moved as odometry says: as :meth:`PoseGaussian.mahalanobis2`, compiled."""
    one, other = odometry.increment, inertia.increment
    dx, dy, turn = other[0] - one[0], other[1] - one[1], se2.wrap_angle(other[2] - one[2])
    x, y = se2.rotate_back(np.cos(one[2]), np.sin(one[2]), dx, dy)
    forward, aside = se2.log_shift(x, y, turn)
    x, y = se2.rotate_back(np.cos(other[2]), np.sin(other[2]), -dx, -dy)
    # The adjoint of odometry's pose as seen from that by inertia.
    rows = (np.cos(turn), np.sin(turn), y), (-np.sin(turn), np.cos(turn), -x), (0.0, 0.0, 1.0)
    covariance, least = symmetric_from_array(odometry.covariance), _LEAST_VARIANCE
    moved = multiply(covariance, rows[0]), multiply(covariance, rows[1]), multiply(covariance, rows[2])
    spread = Symmetric(
        dot(rows[0], moved[0]) + least,
        dot(rows[0], moved[1]),
        dot(rows[0], moved[2]),
        dot(rows[1], moved[1]) + least,
        dot(rows[1], moved[2]),
        dot(rows[2], moved[2]) + least,
    )
    difference = (forward, aside, turn)
    spread = add_scaled(spread, symmetric_from_array(inertia.covariance), 1.0)
    return bool(dot(difference, solve(spread, difference)) > _JUMP_GATE)


def is_wide(covariance: Float64, settings: FilterParameters) -> bool:
    """Whether a pose is less certain than keyframes are far from each other: in its heading, or in all directions.

    :param covariance: shape (3, 3), of the pose in its own frame, m and rad.
    """
    (xx, xy, _), (_, yy, _), _ = covariance.tolist()
    least = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
    return bool(least > settings.keyframe_distance**2) or has_wide_heading(covariance, settings)


def has_wide_heading(covariance: Float64, settings: FilterParameters) -> bool:
    """Whether a heading is less certain than those of keyframes at one place differ.

    :param covariance: shape (3, 3), of a pose, m and rad.
    """
    return bool(covariance[2, 2] > math.radians(settings.keyframe_angle) ** 2)
