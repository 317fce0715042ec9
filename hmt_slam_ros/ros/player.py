"""Player of a log: when each measurement is due, by rate, pause, loop and flow control."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from hmt_slam_ros.configuration.robot import RobotParameters
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Measurement, Odometry, Scan

_LOOP_GAP = 100_000_000
"""Time between the last record of one pass and the first of the next, ns."""
_MAX_LAG = 0.1
"""Delay above which the player does not catch up by a burst, but plays on from where it is, s."""


class Player:
    """Gives the measurements of a log when they are due; the caller has the clock.

    :ivar settings: rate and flow control; may be replaced while playing.
    :ivar is_paused: whether nothing is due.
    :ivar scans_sent: number of scans so far.
    :ivar readings_sent: number of odometry readings so far.
    :ivar stamp: of the last measurement, ns.
    :ivar has_ended: whether the last measurement was given.
    """

    def __init__(self, log: Log, settings: RobotParameters, patience: float = 0.0) -> None:
        """Start with the first measurement.

        :param patience: time for which slam may wait for later odometry before it answers a scan, s.
        """
        self.settings = settings
        self._patience = round(patience * NANOSECONDS)
        self.is_paused = False
        self.scans_sent, self.readings_sent, self.stamp = 0, 0, 0
        self._records = _measurements(log, settings)
        self._next_measurement: Measurement | None = next(self._records, None)
        self._last_due_time: float | None = None
        self._unacknowledged: deque[int] = deque()
        self.has_ended = self._next_measurement is None

    @property
    def scans_acknowledged(self) -> int:
        """Number of acknowledged scans."""
        return self.scans_sent - len(self._unacknowledged)

    def acknowledge(self, stamp: int) -> None:
        """Acknowledge the scan of ``stamp`` (ns) and all earlier ones."""
        while self._unacknowledged and self._unacknowledged[0] <= stamp:
            self._unacknowledged.popleft()

    @property
    def is_held_up(self) -> bool:
        """Whether the next measurement waits for an acknowledgement.

        The scans under way may be more than ``max_unacknowledged_scans`` where they span less than slam's patience.
        """
        return (
            self.settings.flow_control
            and isinstance(self._next_measurement, Scan)
            and len(self._unacknowledged) >= self.settings.max_unacknowledged_scans
            and self._next_measurement.stamp > self._unacknowledged[0] + self._patience
        )

    def seconds_until_due(self, now: float) -> float | None:
        """Time until the next measurement is due, s, 0 where it is due now, None where that is unknown.

        :param now: time of a monotonic clock, s.
        """
        if self._next_measurement is None or self.is_paused or self.is_held_up:
            return None
        return max(0.0, self._due_time(now) - now)

    def take_next(self, now: float) -> Measurement:
        """The next measurement."""
        assert self._next_measurement is not None
        measurement, due = self._next_measurement, self._due_time(now)
        self._last_due_time = due if now - due < _MAX_LAG else now
        self.stamp = measurement.stamp
        if isinstance(measurement, Scan):
            self.scans_sent += 1
            self._unacknowledged.append(measurement.stamp)
        elif isinstance(measurement, Odometry):
            self.readings_sent += 1
        self._next_measurement = next(self._records, None)
        self.has_ended = self._next_measurement is None
        return measurement

    def _due_time(self, now: float) -> float:
        assert self._next_measurement is not None
        if self._last_due_time is None or self.settings.rate == 0.0:
            return now
        return self._last_due_time + (self._next_measurement.stamp - self.stamp) / NANOSECONDS / self.settings.rate


def _measurements(log: Log, settings: RobotParameters) -> Iterator[Measurement]:
    """Measurements of the log, repeated where it loops, with increasing stamps."""
    shift = last = 0
    while True:
        first = None
        for record in log.records():
            stamp = record.measurement.stamp
            if first is None:
                first = stamp
                shift = last + _LOOP_GAP - first if last else 0
            last = stamp + shift
            yield replace(record.measurement, stamp=last) if shift else record.measurement
        if first is None or not settings.loop:
            return
