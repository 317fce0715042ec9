"""What every log, whatever its format, is read as, and logs that are held in memory once parsed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.stamps import NANOSECONDS, running_stamps
from hmt_slam_ros.sensors import Odometry, Scan

SIMULATION_PREFIX = "sim:"
"""What the name of a log begins with that is made while it is read."""


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One measurement of a log, in file order.

    The stamps of the measurements come from one running clock over all records of the log in file order: each is
    the later of the record's source stamp and the last stamp given. A scan lies strictly after the scan before it
    and an odometry reading strictly after the odometry reading before it, 1 microsecond where the source does not
    advance. An odometry reading that belongs to a scan (the odometry fields of a CARMEN scan, the action before a
    rawlog's observation) has exactly the scan's stamp and comes just before it. A part of a log has the stamps that
    the same records have in the whole log.

    :ivar source_stamp: the log's own time stamp in ns, which may jump back; results are keyed by it.
    :ivar measurement: the scan or odometry reading, with its ``stamp`` from the running clock, ns.
    :ivar true_pose: shape (3,), the robot's true pose ``world_T_base`` at that time, m and rad; None where nobody knows
        it.
    """

    source_stamp: int
    measurement: Scan | Odometry
    true_pose: NDArray[np.float64] | None = None


class Log(Protocol):
    """A source of scans and odometry that can be read more than once."""

    @property
    def name(self) -> str:
        """Short name for reports, such as the file's stem."""

    @property
    def scan_count(self) -> int:
        """Number of scans that `records` yields."""

    @property
    def duration(self) -> float:
        """Seconds from the first to the last record, on the running clock."""

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order, from the start at every call.

        :raises HmtSlamError: where the file is damaged, when that place is reached; everything that can be noticed
            earlier is refused when the log is opened.
        """


class LogEntry(NamedTuple):
    """A measurement that still waits for its stamp.

    :ivar source_stamp: the log's own time stamp, ns.
    :ivar kind: `Scan` or `Odometry`.
    :ivar fields: the measurement's fields behind ``stamp``, in their order.
    :ivar precedes_its_scan: True for an odometry reading that belongs to the scan right behind it.
    """

    source_stamp: int
    kind: type[Scan] | type[Odometry]
    fields: tuple[Any, ...]
    precedes_its_scan: bool = False


@dataclass(frozen=True)
class TimeWindow:
    """The part of a log that is wanted.

    :ivar start: seconds from the log's first stamp.
    :ivar duration: seconds, None for all that follows.
    """

    start: float = 0.0
    duration: float | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.start) and self.start >= 0.0):
            raise HmtSlamError(f"start is {self.start} s, but it counts from the log's first stamp: give 0 or more.")
        if self.duration is not None and not self.duration > 0.0:
            raise HmtSlamError(f"duration is {self.duration} s: give more than 0, or leave it away for the whole log.")

    def select(self, stamps: NDArray[np.int64]) -> slice:
        """The records inside: ``start <= stamp - stamps[0] <= start + duration``.

        :param stamps: shape (n,), ns, not decreasing.
        """
        if not stamps.size:
            return slice(0, 0)
        first = int(stamps[0]) + round(self.start * NANOSECONDS)
        low = int(np.searchsorted(stamps, first, side="left"))
        if self.duration is None or not np.isfinite(self.duration):
            return slice(low, stamps.size)
        last = first + round(self.duration * NANOSECONDS)
        return slice(low, int(np.searchsorted(stamps, last, side="right")))


def require_scans(name: str, in_window: int, in_log: int) -> None:
    """Refuse a log, or a part of a log, without scans.

    :raises HmtSlamError: saying which of the two it is.
    """
    if not in_log:
        raise HmtSlamError(f"{name} holds no laser scan: give a log in which scans were recorded.")
    if not in_window:
        raise HmtSlamError(f"the part of {name} chosen by start and duration holds no laser scan: widen it.")


class InMemoryLog:
    """A log whose measurements are all in memory.

    :raises HmtSlamError: where there is no scan.
    """

    def __init__(self, name: str, entries: Sequence[LogEntry], window: TimeWindow) -> None:
        is_scan = [entry.kind is Scan for entry in entries]
        stamps = running_stamps(
            [entry.source_stamp for entry in entries], is_scan, [entry.precedes_its_scan for entry in entries]
        )
        part = window.select(stamps)
        self._name = name
        self._entries = entries[part]
        self._stamps = stamps[part]
        self._scan_count = sum(is_scan[part])
        require_scans(name, self._scan_count, sum(is_scan))

    @property
    def name(self) -> str:
        """Short name for reports."""
        return self._name

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return self._scan_count

    @property
    def duration(self) -> float:
        """Seconds from the first to the last record."""
        return float(self._stamps[-1] - self._stamps[0]) / NANOSECONDS

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        for entry, stamp in zip(self._entries, self._stamps.tolist(), strict=True):
            yield LogRecord(entry.source_stamp, entry.kind(stamp, *entry.fields))
