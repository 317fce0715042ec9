"""When each record of a log is due: rate, pause, loop, and the pace at which scans are acknowledged."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

from hmt_slam_ros.configuration.robot import Robot
from hmt_slam_ros.logs import Log
from hmt_slam_ros.sensors import Odometry, Scan

_SECOND = 1_000_000_000
# Between the last record of one pass and the first of the next.
_LOOP_GAP = 100_000_000  # ns
# A player that is later than this does not catch up in a burst, but goes on from where it is.
_PATIENCE = 0.1  # s


class Player:
    """Hands out the measurements of a log when they are due; the time is told to it.

    :ivar settings: rate, pace and so on; may be exchanged while playing.
    :ivar paused: whether nothing is due.
    :ivar scans: scans handed out.
    :ivar odometry: odometry readings handed out.
    :ivar stamp: of the last measurement handed out, ns.
    :ivar ended: whether the last measurement has been handed out.
    """

    def __init__(self, log: Log, settings: Robot) -> None:
        self.settings = settings
        self.paused = False
        self.ended = False
        self.scans, self.odometry, self.stamp = 0, 0, 0
        self._records = _measurements(log, settings)
        self._next: Scan | Odometry | None = next(self._records, None)
        self._last_due: float | None = None
        self._open: deque[int] = deque()
        self.ended = self._next is None

    @property
    def acknowledged(self) -> int:
        """Scans of which nothing more is awaited."""
        return self.scans - len(self._open)

    def acknowledge(self, stamp: int) -> None:
        """The scan of ``stamp`` (ns), and with it every earlier one, has been worked off."""
        while self._open and self._open[0] <= stamp:
            self._open.popleft()

    @property
    def held(self) -> bool:
        """Whether the next measurement waits for an acknowledgement."""
        return self.settings.paced and isinstance(self._next, Scan) and len(self._open) >= self.settings.window

    def wait(self, now: float) -> float | None:
        """Seconds until the next measurement is due, 0 where it is due now, None where it is not known.

        :param now: seconds of a clock that runs evenly.
        """
        if self._next is None or self.paused or self.held:
            return None
        return max(0.0, self._due(now) - now)

    def take(self, now: float) -> Scan | Odometry:
        """The next measurement."""
        assert self._next is not None
        taken, due = self._next, self._due(now)
        self._last_due = due if now - due < _PATIENCE else now
        self.stamp = taken.stamp
        if isinstance(taken, Scan):
            self.scans += 1
            self._open.append(taken.stamp)
        else:
            self.odometry += 1
        self._next = next(self._records, None)
        self.ended = self._next is None
        return taken

    def _due(self, now: float) -> float:
        assert self._next is not None
        if self._last_due is None or self.settings.rate == 0.0:
            return now
        return self._last_due + (self._next.stamp - self.stamp) / _SECOND / self.settings.rate


def _measurements(log: Log, settings: Robot) -> Iterator[Scan | Odometry]:
    """Measurements of the log, over and over where it loops, with stamps that go on increasing."""
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
