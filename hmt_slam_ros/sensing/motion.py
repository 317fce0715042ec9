"""Odometry increments between any two times, and how far they can be trusted."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Motion
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensing.odometry import Odometry


class OdometryBuffer:
    """The recent odometry readings, from which the pose at a scan is interpolated."""

    def __init__(self) -> None:
        self._readings: deque[Odometry] = deque()

    def add(self, reading: Odometry) -> None:
        """Append a reading; one whose stamp goes back starts a new sequence."""
        if self._readings and reading.stamp < self._readings[-1].stamp:
            self._readings.clear()
        self._readings.append(reading)

    def covers(self, stamp: int) -> bool:
        """Whether a reading at or after ``stamp`` (ns) has come."""
        return bool(self._readings) and self._readings[-1].stamp >= stamp

    def at(self, stamp: int) -> NDArray[np.float64] | None:
        """``odom_T_base`` (3,) at ``stamp`` (ns): interpolated, held at the ends, None without any reading.

        Readings before those that are needed are forgotten.
        """
        while len(self._readings) > 2 and self._readings[2].stamp <= stamp:
            self._readings.popleft()
        return self._pose(min(stamp, self._readings[-1].stamp)) if self._readings else None

    def motion(self, start: int, end: int) -> NDArray[np.float64]:
        """The motion of the base from ``start`` to ``end`` (ns) as a twist (3,); zeros where nothing is known of it.

        After the newest reading the speed between the last two goes on, for as long as they lie apart.

        :param start: not before the time for which :meth:`at` was asked last.
        """
        if len(self._readings) < 2:
            return np.zeros(3)
        limit = 2 * self._readings[-1].stamp - self._readings[-2].stamp
        return se2.log(se2.between(self._pose(min(start, limit)), self._pose(min(end, limit))))

    def _pose(self, stamp: int) -> NDArray[np.float64]:
        """``odom_T_base`` (3,): held before the first reading, interpolated, carried on after the last."""
        first = second = self._readings[0]
        for reading in self._readings:
            first, second = second, reading
            if stamp < reading.stamp:
                break
        if stamp == second.stamp:
            return second.pose
        if stamp <= first.stamp:
            return first.pose
        fraction = (stamp - first.stamp) / (second.stamp - first.stamp)
        return se2.interpolate(first.pose, second.pose, fraction)


def increment_covariance(increment: NDArray[np.float64], motion: Motion) -> NDArray[np.float64]:
    """Covariance (3, 3) of an odometry increment in the frame of its end, m and rad."""
    return path_covariance(math.hypot(increment[0], increment[1]), abs(float(se2.wrap(increment[2]))), motion)


def path_covariance(distance: float, angle: float, motion: Motion) -> NDArray[np.float64]:
    """Covariance (3, 3) of the odometry over a path, in the frame of its end, m and rad.

    Standard deviations grow linearly with the distance (m) and the angle (rad) travelled; the lateral deviation equals
    the longitudinal one.
    """
    translation = (
        motion.translation_floor
        + motion.translation_from_translation * distance
        + motion.translation_from_rotation * math.degrees(angle)
    )
    rotation = math.radians(motion.rotation_floor + motion.rotation_from_translation * distance)
    rotation += motion.rotation_from_rotation * angle
    return np.diag([translation**2, translation**2, rotation**2])
