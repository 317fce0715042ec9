"""The interface of all logs, and logs in memory."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.stamps import NANOSECONDS, running_stamps
from hmt_slam_ros.sensors import Measurement, Odometry, Scan
from hmt_slam_ros.sensors.plausibility import check_odometry, check_scan

SIMULATION_PREFIX = "sim:"
"""Prefix of the names of simulated logs."""


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One measurement of a log, in file order.

    All records of a log in file order have stamps of one running clock: each is the later of the record's source stamp
    and the last stamp. Scans have increasing stamps, and so have odometry readings, 1 microsecond apart where the
    source does not advance. An odometry reading that belongs to a scan (the odometry fields of a CARMEN scan, the
    action before a rawlog's observation) has the stamp of the scan and comes directly before it. Records of a part of a
    log have the stamps that they have in the whole log. An observation of a mark comes when it is known, and may have a
    stamp before that of the record before it.

    :ivar source_stamp: the log's own stamp, ns, which may jump back; results are keyed by it.
    :ivar measurement: scan, odometry reading or observation of a mark, with its ``stamp`` from the running clock, ns.
    :ivar true_pose: shape (3,), the robot's true pose ``world_T_base``, m and rad; None where unknown.
    """

    source_stamp: int
    measurement: Measurement
    true_pose: NDArray[np.float64] | None = None


class Log(Protocol):
    """A source of scans, odometry and marks that can be read more than once."""

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


@dataclass
class LeftOut:
    """The measurements of a log that no process may see, since a number in them cannot be right.

    :ivar count: how many scans and odometry readings were left out.
    :ivar reason: what is wrong with the first of them.
    """

    count: int = 0
    reason: str = ""

    def admits(self, check: Callable[[], object]) -> bool:
        """Whether a measurement passes a check; one that does not is counted.

        :param check: raises `HmtSlamError` for a measurement that is to be left out.
        """
        try:
            check()
        except HmtSlamError as fault:
            self.count += 1
            self.reason = self.reason or str(fault).partition(":")[0]
            return False
        return True


@runtime_checkable
class PartialLog(Protocol):
    """A log of which measurements may have been left out."""

    @property
    def left_out(self) -> LeftOut:
        """Those of the whole log."""


def describe_left_out(log: Log) -> str | None:
    """A sentence on the measurements of a log that were left out, None where there are none."""
    left_out = log.left_out if isinstance(log, PartialLog) else LeftOut()
    if not left_out.count:
        return None
    return (
        f"{left_out.count} measurements of {log.name} are left out, in the first of them {left_out.reason}: "
        "correct the driver that sent them, or go on without them."
    )


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


_CHECKED_FIELDS = 6
"""Fields of a scan's entry before ``time_increment``."""


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


def require_scans(name: str, in_window: int, in_log: int, left_out: LeftOut | None = None) -> None:
    """Check that a log, and the selected part of it, has scans.

    :param left_out: measurements that no process may see, which are not counted.
    :raises HmtSlamError: where one has none; says which.
    """
    if not in_log and left_out is not None and left_out.count:
        raise HmtSlamError(
            f"{name} holds no laser scan that can be used, in the first of {left_out.count} measurements "
            f"{left_out.reason}: correct the driver and record anew."
        )
    if not in_log:
        raise HmtSlamError(f"{name} holds no laser scan: give a log in which scans were recorded.")
    if not in_window:
        raise HmtSlamError(f"the part of {name} chosen by start and duration holds no laser scan: widen it.")


@dataclass
class _Measurements:
    """Measurements in file order, in columns: a reading of the odometry as an object of its own takes 350 bytes.

    :ivar source_stamps: of all measurements, ns.
    :ivar is_scan: whether each is a scan, else odometry.
    :ivar scans: fields of each scan after ``stamp``.
    :ivar poses: ``odom_T_base`` (x, y, theta) of each odometry reading, m and rad, one after the other.
    """

    source_stamps: array[int] = field(default_factory=lambda: array("q"))
    is_scan: list[bool] = field(default_factory=list)
    scans: list[tuple[Any, ...]] = field(default_factory=list)
    poses: array[float] = field(default_factory=lambda: array("d"))

    def append(self, entry: LogEntry) -> None:
        """Append the measurement of an entry."""
        self.source_stamps.append(entry.source_stamp)
        self.is_scan.append(entry.kind is Scan)
        if entry.kind is Scan:
            self.scans.append(entry.fields)
        else:
            self.poses.extend(entry.fields[0].tolist())

    def part(self, selected: slice) -> _Measurements:
        """The measurements of a slice with a start and a stop."""
        is_scan = self.is_scan[selected]
        first = sum(self.is_scan[: selected.start])
        last, reading = first + sum(is_scan), selected.start - first
        poses = self.poses[3 * reading : 3 * (selected.stop - last)]
        return _Measurements(self.source_stamps[selected], is_scan, self.scans[first:last], poses)


class InMemoryLog:
    """A log with all measurements in memory; the attributes are those of `Log` and `PartialLog`.

    :param entries: all measurements; those that no process may see are left out.
    :param left_out: those that the reader of the format left out before, to which they are added.
    :raises HmtSlamError: where there is no scan.
    """

    def __init__(
        self, name: str, entries: Iterable[LogEntry], window: TimeWindow, left_out: LeftOut | None = None
    ) -> None:
        self.left_out = left_out or LeftOut()
        whole, precedes_its_scan = _plausible_measurements(entries, self.left_out)
        stamps = running_stamps(whole.source_stamps, whole.is_scan, precedes_its_scan)
        part = window.select(stamps)
        self._measurements = whole.part(part)
        self._stamps = array("q", stamps[part].tobytes())
        self.name = name
        self.scan_count = len(self._measurements.scans)
        require_scans(name, self.scan_count, len(whole.scans), self.left_out)
        self.duration = float(self._stamps[-1] - self._stamps[0]) / NANOSECONDS

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        kept = self._measurements
        scans, poses = iter(kept.scans), iter(np.frombuffer(kept.poses).reshape(-1, 3))
        for source, stamp, is_scan in zip(kept.source_stamps, self._stamps, kept.is_scan, strict=True):
            yield LogRecord(source, Scan(stamp, *next(scans)) if is_scan else Odometry(stamp, next(poses)))


def _plausible_measurements(entries: Iterable[LogEntry], left_out: LeftOut) -> tuple[_Measurements, list[bool]]:
    """The measurements that a process may see, and whether each is odometry that belongs to the scan directly after it.

    Odometry whose scan is left out belongs to none.
    """
    kept, precedes_its_scan = _Measurements(), []
    for entry in entries:
        if left_out.admits(partial(check_measurement, entry)):
            kept.append(entry)
            precedes_its_scan.append(entry.precedes_its_scan)
        elif entry.kind is Scan and precedes_its_scan:
            precedes_its_scan[-1] = False
    return kept, precedes_its_scan


def check_measurement(entry: LogEntry) -> None:
    """Check a measurement by its source stamp and fields.

    The time from beam to beam may be wrong, since `SweepCheck` takes such scans as if measured at one moment.

    :raises HmtSlamError: where no process may see it.
    """
    if entry.kind is Scan:
        check_scan(Scan(entry.source_stamp, *entry.fields[:_CHECKED_FIELDS]))
    else:
        check_odometry(Odometry(entry.source_stamp, *entry.fields))
