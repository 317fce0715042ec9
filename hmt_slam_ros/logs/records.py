"""The interface of all logs, and logs in memory."""

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
"""Prefix of the names of simulated logs."""


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One measurement of a log, in file order.

    All records of a log in file order have stamps of one running clock: each is the later of the record's source stamp
    and the last stamp. Scans have increasing stamps, and so have odometry readings, 1 microsecond apart where the
    source does not advance. An odometry reading that belongs to a scan (the odometry fields of a CARMEN scan, the
    action before a rawlog's observation) has the stamp of the scan and comes directly before it. Records of a part of a
    log have the stamps that they have in the whole log.

    :ivar source_stamp: the log's own stamp, ns, which may jump back; results are keyed by it.
    :ivar measurement: the scan or odometry reading, with its ``stamp`` from the running clock, ns.
    :ivar true_pose: shape (3,), the robot's true pose ``world_T_base``, m and rad; None where unknown.
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
        """Number of scans in `records`."""

    @property
    def duration(self) -> float:
        """Seconds from the first to the last record, on the running clock."""

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order, from the start at every call.

        :raises HmtSlamError: at a damaged record, where opening the log could not find the damage.
        """


class LogEntry(NamedTuple):
    """A measurement without a stamp of the running clock.

    :ivar source_stamp: the log's own stamp, ns.
    :ivar kind: `Scan` or `Odometry`.
    :ivar fields: fields of the measurement after ``stamp``, in order.
    :ivar precedes_its_scan: whether this is odometry that belongs to the scan directly after it.
    """

    source_stamp: int
    kind: type[Scan] | type[Odometry]
    fields: tuple[Any, ...]
    precedes_its_scan: bool = False


@dataclass(frozen=True)
class TimeWindow:
    """A part of a log.

    :ivar start: start after the log's first stamp, s.
    :ivar duration: duration, s, None for the rest of the log.
    """

    start: float = 0.0
    duration: float | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.start) and self.start >= 0.0):
            raise HmtSlamError(f"start is {self.start} s, but it counts from the log's first stamp: give 0 or more.")
        if self.duration is not None and not self.duration > 0.0:
            raise HmtSlamError(f"duration is {self.duration} s: give more than 0, or leave it away for the whole log.")

    def select(self, stamps: NDArray[np.int64]) -> slice:
        """The records with ``start <= stamp - stamps[0] <= start + duration``.

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
    """Check that a log, and the selected part of it, has scans.

    :raises HmtSlamError: where one has none; says which.
    """
    if not in_log:
        raise HmtSlamError(f"{name} holds no laser scan: give a log in which scans were recorded.")
    if not in_window:
        raise HmtSlamError(f"the part of {name} chosen by start and duration holds no laser scan: widen it.")


class InMemoryLog:
    """A log with all measurements in memory; the attributes are those of `Log`.

    :raises HmtSlamError: where there is no scan.
    """

    def __init__(self, name: str, entries: Sequence[LogEntry], window: TimeWindow) -> None:
        is_scan = [entry.kind is Scan for entry in entries]
        stamps = running_stamps(
            [entry.source_stamp for entry in entries], is_scan, [entry.precedes_its_scan for entry in entries]
        )
        part = window.select(stamps)
        self.name = name
        self.scan_count = sum(is_scan[part])
        require_scans(name, self.scan_count, sum(is_scan))
        self._entries = entries[part]
        self._stamps = stamps[part]
        self.duration = float(self._stamps[-1] - self._stamps[0]) / NANOSECONDS

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        for entry, stamp in zip(self._entries, self._stamps.tolist(), strict=True):
            yield LogRecord(entry.source_stamp, entry.kind(stamp, *entry.fields))
