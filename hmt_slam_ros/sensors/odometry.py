"""Odometry readings, and the pose between them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2


@dataclass(frozen=True, eq=False, slots=True)
class Odometry:
    """A reading of the wheel odometry.

    :ivar stamp: integer nanoseconds, increasing within one source.
    :ivar pose: shape (3,), ``odom_T_base`` as (x, y, theta) in m and rad.
    """

    stamp: int
    pose: NDArray[np.float64]


class OdometryBuffer:
    """The recent odometry readings, from which the pose at a scan is interpolated."""

    def __init__(self, readings: Iterable[Odometry] = ()) -> None:
        """:param readings: the first ones."""
        self._readings: deque[Odometry] = deque(readings)

    @property
    def readings(self) -> tuple[Odometry, ...]:
        """Those that are not forgotten."""
        return tuple(self._readings)

    @property
    def is_empty(self) -> bool:
        """Whether no reading ever came."""
        return not self._readings

    def add(self, reading: Odometry) -> None:
        """Append a reading; one whose stamp goes back starts a new sequence."""
        if self._readings and reading.stamp < self._readings[-1].stamp:
            self._readings.clear()
        self._readings.append(reading)

    def covers(self, stamp: int) -> bool:
        """Whether a reading at or after ``stamp`` (ns) has come."""
        return bool(self._readings) and self._readings[-1].stamp >= stamp

    def pose_at(self, stamp: int) -> tuple[NDArray[np.float64], float] | None:
        """``odom_T_base`` (3,) at ``stamp`` (ns), interpolated, or None where no two readings enclose it.

        With it comes half the product of the times to both readings, s^2: the factor on a constant acceleration by
        which the pose differs from the interpolated one. Readings before those that are needed are forgotten.
        """
        while len(self._readings) > 2 and self._readings[2].stamp <= stamp:
            self._readings.popleft()
        if not self._readings or not self._readings[0].stamp <= stamp <= self._readings[-1].stamp:
            return None
        first, second = self._enclosing_readings(stamp)
        return self._extrapolated_pose(stamp), 0.5e-18 * (stamp - first.stamp) * (second.stamp - stamp)

    def twist_between(self, start: int, end: int) -> NDArray[np.float64]:
        """The motion of the base from ``start`` to ``end`` (ns) as a twist (3,); zeros where nothing is known of it.

        After the newest reading the speed between the last two goes on, for as long as they lie apart.

        :param start: not before the time for which :meth:`pose_at` was asked last.
        """
        if len(self._readings) < 2:
            return np.zeros(3)
        limit = 2 * self._readings[-1].stamp - self._readings[-2].stamp
        return se2.log(
            se2.between(self._extrapolated_pose(min(start, limit)), self._extrapolated_pose(min(end, limit)))
        )

    def _extrapolated_pose(self, stamp: int) -> NDArray[np.float64]:
        """``odom_T_base`` (3,): held before the first reading, interpolated, carried on after the last."""
        first, second = self._enclosing_readings(stamp)
        if stamp == second.stamp:
            return second.pose
        if stamp <= first.stamp:
            return first.pose
        fraction = (stamp - first.stamp) / (second.stamp - first.stamp)
        return se2.interpolate(first.pose, second.pose, fraction)

    def _enclosing_readings(self, stamp: int) -> tuple[Odometry, Odometry]:
        """The reading at or before ``stamp`` and the one after it; else the two first or the two last."""
        first = second = self._readings[0]
        for reading in self._readings:
            first, second = second, reading
            if stamp < reading.stamp:
                break
        return first, second
