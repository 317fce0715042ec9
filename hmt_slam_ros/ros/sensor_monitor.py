"""Checks of the sensors of a node: backward jumps of time, different clocks, a silent laser."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.sensor_input import MIN_BACKWARD_JUMP
from hmt_slam_ros.sensors import Odometry, Scan

_SILENCE_TIMEOUT = 3.0
"""Time without scans, while odometry comes, after which a laser is silent, s; much longer than any sweep."""
_BUSY_TIME = 2.0
"""Time since the last check, once a second, above which the node itself was busy, s."""
_MAX_CLOCK_OFFSET = 5_000_000_000
"""Largest offset of the best of :data:`_COMPARED_SCANS` scans from the newest odometry, for one clock, ns.

Scans may take longer than odometry on their way, but not all of them.
"""
_COMPARED_SCANS = 50
"""Scans in a comparison of clocks."""


class SensorMonitor:
    """Checks stamps and rates of the sensors: backward jumps, different clocks, a silent laser."""

    def __init__(self, diagnostics: NodeDiagnostics, topics: Sequence[str]) -> None:
        """:param topics: those of the scans."""
        self._diagnostics = diagnostics
        self._newest_stamps: dict[type, int] = {}
        self._checked_at = time.monotonic()
        self._last_scan_at = dict.fromkeys(topics, self._checked_at)
        self._silent: set[str] = set()
        self._reading_count = 0
        self._clock_offset, self._compared_scans = math.inf, 0

    def reset(self) -> None:
        """Accept any stamps of the next measurements."""
        self._newest_stamps.clear()
        self._clock_offset, self._compared_scans = math.inf, 0

    def detect_backward_jump(self, measurement: Scan | Odometry) -> bool:
        """Check a measurement; return whether time went back, which is also reported."""
        kind, stamp = type(measurement), measurement.stamp
        newest = self._newest_stamps.get(kind, stamp)
        self._newest_stamps[kind] = max(stamp, newest)
        if kind is Scan:
            self._compare_clocks(stamp)
        if stamp > newest - MIN_BACKWARD_JUMP:
            return False
        self.reset()
        self._newest_stamps[kind] = stamp
        self._diagnostics.warn(
            f"time went back by {(newest - stamp) / 1e9:.1f} s, to {stamp} ns: assuming the robot was moved; starting "
            "global localization; if this is another drive through a place that is new, call slam/reset"
        )
        return True

    def _compare_clocks(self, stamp: int) -> None:
        reading = self._newest_stamps.get(Odometry)
        if reading is None:
            return
        self._clock_offset = min(self._clock_offset, stamp - reading, key=abs)
        self._compared_scans += 1
        if self._compared_scans == _COMPARED_SCANS:
            if abs(self._clock_offset) > _MAX_CLOCK_OFFSET:
                self._diagnostics.warn(
                    f"scans are stamped {abs(self._clock_offset) / 1e9:.1f} s "
                    f"{'after' if self._clock_offset > 0 else 'before'} the odometry that comes with them: let both "
                    "computers have one clock (NTP, PTP), or correct the stamps; until then odometry does not help"
                )
            self._clock_offset, self._compared_scans = math.inf, 0

    def start(self) -> None:
        """Expect scans from now on."""
        self._last_scan_at = dict.fromkeys(self._last_scan_at, time.monotonic())

    def note_scan(self, topic: str) -> None:
        """Take note that a scan has come."""
        now = time.monotonic()
        if topic in self._silent:
            self._silent.remove(topic)
            self._diagnostics.note(f"scans come again on {topic}, after {now - self._last_scan_at[topic]:.1f} s")
        self._last_scan_at[topic] = now

    def check_silence(self, reading_count: int) -> None:
        """Report a silent laser; to be called once a second.

        After a busy time of the node, as by compilation, the check is skipped: scans may wait in DDS.

        :param reading_count: number of odometry readings so far.
        """
        now = time.monotonic()
        has_odometry, self._reading_count = reading_count > self._reading_count, reading_count
        was_busy, self._checked_at = now - self._checked_at > _BUSY_TIME, now
        for topic in self._last_scan_at.keys() - self._silent:
            if was_busy:
                self._last_scan_at[topic] = now
            if has_odometry and now - self._last_scan_at[topic] > _SILENCE_TIMEOUT:
                self._silent.add(topic)
                self._warn_of_silence(topic)

    def _warn_of_silence(self, topic: str) -> None:
        others = len(self._silent) < len(self._last_scan_at)
        self._diagnostics.warn(
            f"no scan came for {_SILENCE_TIMEOUT:g} s, while odometry does: look at the laser, and at the name and the "
            f"type of the topic {topic}; meanwhile the pose goes on by {'the other scans' if others else 'odometry'}"
        )
