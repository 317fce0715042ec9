"""What a robot's sensors do that they should not: fall silent, go back in time, have clocks of their own."""

from __future__ import annotations

import math
import time

from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.stamp_order import BACK
from hmt_slam_ros.sensing import Odometry, Scan

# A laser that sends nothing for so long, while odometry comes, is silent: much longer than any sweep takes.
_SILENCE = 3.0  # s
# Who looks once a second was kept from it where the last time is this long ago.
_BUSY = 2.0  # s
# One clock where at least one of so many scans is that close to the newest reading: scans may wait longer than readings
# on their way, but not all of them.
_TOGETHER = 5_000_000_000  # ns
_SCANS = 50


class SensorWatch:
    """Follows the stamps of what comes from the sensors, and tells."""

    def __init__(self, figures: Figures) -> None:
        """:param figures: through which it tells."""
        self._figures = figures
        self._newest: dict[type, int] = {}
        self._last_scan = self._looked = time.monotonic()
        self._readings = 0
        self._silent = False
        self._apart, self._scans = math.inf, 0

    def forget(self) -> None:
        """What comes next may be of any time."""
        self._newest.clear()
        self._apart, self._scans = math.inf, 0

    def is_back(self, measurement: Scan | Odometry) -> bool:
        """Take in a measurement; whether time went back with it, which is told."""
        kind, stamp = type(measurement), measurement.stamp
        newest = self._newest.get(kind, stamp)
        self._newest[kind] = max(stamp, newest)
        if kind is Scan:
            self._compare(stamp)
        if stamp > newest - BACK:
            return False
        self.forget()
        self._newest[kind] = stamp
        self._figures.warn(
            f"time went back by {(newest - stamp) / 1e9:.1f} s, to {stamp} ns: the robot is taken for carried, and may "
            "be anywhere in the map; if this is another drive through a place that is new, call slam/reset"
        )
        return True

    def _compare(self, stamp: int) -> None:
        reading = self._newest.get(Odometry)
        if reading is None:
            return
        self._apart = min(self._apart, stamp - reading, key=abs)
        self._scans += 1
        if self._scans == _SCANS:
            if abs(self._apart) > _TOGETHER:
                self._figures.warn(
                    f"scans are stamped {abs(self._apart) / 1e9:.1f} s {'after' if self._apart > 0 else 'before'} the "
                    "odometry that comes with them: let both computers have one clock (NTP, PTP), or correct the "
                    "stamps; until then odometry does not help"
                )
            self._apart, self._scans = math.inf, 0

    def begin(self) -> None:
        """Scans are listened to from now on."""
        self._last_scan = time.monotonic()

    def hear_scan(self) -> None:
        """A scan has come."""
        now = time.monotonic()
        if self._silent:
            self._silent = False
            self._figures.note(f"scans come again, after {now - self._last_scan:.1f} s")
        self._last_scan = now

    def look(self, readings: int) -> None:
        """Once a second: tell of a laser that is silent.

        A node that was busy for long itself, as by compiling, has not heard yet what came meanwhile.

        :param readings: odometry readings that came so far.
        """
        now = time.monotonic()
        moving, self._readings = readings > self._readings, readings
        if now - self._looked > _BUSY and not self._silent:
            self._last_scan = now
        self._looked = now
        if moving and not self._silent and now - self._last_scan > _SILENCE:
            self._silent = True
            self._figures.warn(
                f"no scan came for {_SILENCE:g} s, while odometry does: look at the laser, and at the name and the "
                "type of the topic scan; meanwhile the pose goes on by odometry"
            )
