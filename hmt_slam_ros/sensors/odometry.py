"""Odometry readings, the poses between them, and the motion during the sweep of a scan.

The reference time of a scan is its stamp, that of the first beam. During the sweep the motion is taken for steady. The
remaining error is an eighth of the acceleration times the square of the sweep's duration: 1 mm and 0.1 degrees for a
sweep of 0.1 s, 1 m/s^2 and 90 degrees/s^2.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, takewhile

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.robot import RealTimeParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.scan import Scan

_MAX_READINGS = 10_000
"""Readings that wait for scans, above which every second one is left out; poses are absolute, so no motion is lost."""


@dataclass(frozen=True, eq=False, slots=True)
class Odometry:
    """A reading of the wheel odometry.

    :ivar stamp: integer nanoseconds, increasing within one source.
    :ivar pose: shape (3,), ``odom_T_base`` as (x, y, theta) in m and rad.
    """

    stamp: int
    pose: Float64


class OdometryBuffer:
    """The recent odometry readings, from which the pose at a scan is interpolated."""

    def __init__(self, readings: Iterable[Odometry] = ()) -> None:
        """:param readings: the first ones."""
        self._readings: deque[Odometry] = deque(readings)

    @property
    def readings(self) -> tuple[Odometry, ...]:
        """The readings that are still needed."""
        return tuple(self._readings)

    @property
    def is_empty(self) -> bool:
        """Whether there is no reading."""
        return not self._readings

    def add(self, reading: Odometry) -> None:
        """Append a reading; a reading whose stamp goes back starts a new sequence."""
        if self._readings and reading.stamp < self._readings[-1].stamp:
            self._readings.clear()
        if len(self._readings) == _MAX_READINGS:
            self._readings = deque(islice(self._readings, 0, None, 2))
        self._readings.append(reading)

    def poses_at(self, stamps: Iterable[int]) -> Iterator[Float64]:
        """``odom_T_base`` (3,) at increasing stamps (ns), up to the newest reading."""
        newest = self._readings[-1].stamp if self._readings else -1
        return map(self._extrapolated_pose, takewhile(lambda stamp: stamp <= newest, stamps))

    def remove_between(self, start: int, end: int) -> None:
        """Remove the readings between two stamps (ns), without those at the stamps."""
        self._readings = deque(reading for reading in self._readings if not start < reading.stamp < end)

    def covers(self, stamp: int) -> bool:
        """Whether there is a reading at or after ``stamp`` (ns)."""
        return bool(self._readings) and self._readings[-1].stamp >= stamp

    def pose_at(self, stamp: int) -> tuple[Float64, float] | None:
        """``odom_T_base`` (3,) at ``stamp`` (ns), interpolated, or None where no two readings enclose it.

        The second value is half the product of the times to both readings, s^2. Times a constant acceleration, it is
        the error of the interpolated pose. Readings that are no longer needed are removed.
        """
        while len(self._readings) > 2 and self._readings[2].stamp <= stamp:
            self._readings.popleft()
        if not self._readings or not self._readings[0].stamp <= stamp <= self._readings[-1].stamp:
            return None
        first, second = self._enclosing_readings(stamp)
        return self._extrapolated_pose(stamp), 0.5e-18 * (stamp - first.stamp) * (second.stamp - stamp)

    def twist_between(self, start: int, end: int) -> Float64:
        """The motion of the base from ``start`` to ``end`` (ns) as a twist (3,); zeros where it is unknown.

        The speed between the last two readings continues after the newest, for the time between the two.

        :param start: not before the last argument of :meth:`pose_at`.
        """
        if len(self._readings) < 2:
            return np.zeros(3)
        limit = 2 * self._readings[-1].stamp - self._readings[-2].stamp
        return se2.log(
            se2.between(self._extrapolated_pose(min(start, limit)), self._extrapolated_pose(min(end, limit)))
        )

    def _extrapolated_pose(self, stamp: int) -> Float64:
        """``odom_T_base`` (3,): constant before the first reading, interpolated, extrapolated after the last."""
        first, second = self._enclosing_readings(stamp)
        if stamp == second.stamp:
            return second.pose
        if stamp <= first.stamp:
            return first.pose
        fraction = (stamp - first.stamp) / (second.stamp - first.stamp)
        return se2.interpolate(first.pose, second.pose, fraction)

    def _enclosing_readings(self, stamp: int) -> tuple[Odometry, Odometry]:
        """The readings at or before ``stamp`` and after it; else the two first or the two last."""
        first = second = self._readings[0]
        for reading in self._readings:
            first, second = second, reading
            if stamp < reading.stamp:
                break
        return first, second


def deskew_scan(scan: Scan, odometry: OdometryBuffer, limits: RealTimeParameters) -> Scan:
    """The scan with the motion of its sweep by odometry.

    :param limits: odometry that moves faster was reset, and is not used.
    """
    if scan.end_stamp == scan.stamp:
        return scan
    motion = odometry.twist_between(scan.stamp, scan.end_stamp)
    seconds = (scan.end_stamp - scan.stamp) * 1e-9
    reset = (
        math.hypot(motion[0], motion[1]) > limits.max_speed * seconds
        or abs(motion[2]) > math.radians(limits.max_turn_rate) * seconds
    )
    return scan if reset else replace(scan, motion=motion)
