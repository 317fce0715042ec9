"""The robot's motion during the sweep of a scan, by which the scan is corrected.

The reference time is the stamp, that of the first beam: every scan keeps one stamp and gets its pose there, and the
log's odometry, trajectory and relations need no second time. In between the motion is taken for steady. What that
leaves is an eighth of the acceleration times the square of the sweep's duration: 1 mm and 0.1 degrees for a sweep of
0.1 s, 1 m/s^2 and 90 degrees/s^2.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from statistics import median

from hmt_slam_ros.configuration.robot import RealTimeParameters
from hmt_slam_ros.sensors.odometry import OdometryBuffer
from hmt_slam_ros.sensors.scan import Scan

_MAX_SWEEP = 1.0  # s; scanners turn ten times faster
_MIN_PERIODS, _PERIODS = 5, 9
# Stamps jitter; a sweep may seem to be this much longer than the time from one scan to the next.
_JITTER = 1.2
_NANOSECOND = 1e-9


@dataclass(frozen=True)
class SweepState:
    """What is known of the times between scans.

    :ivar periods: the last ones, s.
    :ivar last_stamp: of the last scan, ns, None before the first.
    """

    periods: tuple[float, ...] = ()
    last_stamp: int | None = None


class SweepCheck:
    """Judges whether the sweeps of one laser's scans can have taken as long as they say.

    The verdict depends on the sequence of the scans alone, so that it is the same however they mix with odometry.
    """

    def __init__(self, state: SweepState | None = None) -> None:
        """:param state: to go on from."""
        state = state or SweepState()
        self._periods = deque(state.periods, maxlen=_PERIODS)
        self._last_stamp = state.last_stamp

    @property
    def state(self) -> SweepState:
        """All that is known."""
        return SweepState(tuple(self._periods), self._last_stamp)

    def check(self, scan: Scan) -> tuple[Scan, str | None]:
        """The scan, and what is wrong with its ``time_increment``; where something is, the scan is without one."""
        if self._last_stamp is not None:
            self._periods.append((scan.stamp - self._last_stamp) * _NANOSECOND)
        self._last_stamp = scan.stamp
        fault = self._fault(scan)
        if fault is None:
            return scan, None
        return replace(scan, time_increment=0.0), (
            f"The scan at {scan.stamp * _NANOSECOND:.6f} s has time_increment = {scan.time_increment:g} s, {fault}; "
            "such scans are taken as if measured at one moment: correct it in the laser's driver, or set it to 0."
        )

    def _fault(self, scan: Scan) -> str | None:
        if not (math.isfinite(scan.time_increment) and scan.time_increment >= 0.0):
            return "which is no time from one beam to the next"
        if scan.sweep_duration > _MAX_SWEEP:
            return (
                f"so that its {scan.ranges.size} beams would take {scan.sweep_duration:.2f} s, more than "
                f"{_MAX_SWEEP:g} s"
            )
        if len(self._periods) < _MIN_PERIODS or scan.sweep_duration <= _JITTER * median(self._periods):
            return None
        return (
            f"so that its {scan.ranges.size} beams would take {scan.sweep_duration:.3f} s, longer than the "
            f"{median(self._periods):.3f} s from one scan to the next"
        )


def deskew_scan(scan: Scan, odometry: OdometryBuffer, limits: RealTimeParameters) -> Scan:
    """The scan with the motion that odometry has for its sweep.

    :param limits: odometry that moves faster was reset, and says nothing of the motion.
    """
    if scan.end_stamp == scan.stamp:
        return scan
    motion = odometry.twist_between(scan.stamp, scan.end_stamp)
    seconds = (scan.end_stamp - scan.stamp) * _NANOSECOND
    reset = (
        math.hypot(motion[0], motion[1]) > limits.max_speed * seconds
        or abs(motion[2]) > math.radians(limits.max_turn_rate) * seconds
    )
    return scan if reset else replace(scan, motion=motion)
