"""The stream of records that a fault changes, and the places where it is planted.

A fault is a function of all records of a stretch of a log and of a random generator. It returns other records, whose
stamps increase on the running clock as those of every log do. Source stamps and true poses stay with their scans, so
that a scan is found again whatever was done to its time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Odometry, Scan

MARGIN = 10.0
"""Time after the first record and before the last in which no fault begins, s."""

_HALF_WINDOW = 0.5
"""Half of the time over which speeds are averaged, s."""


class FaultPlace(NamedTuple):
    """A place in a stretch where a fault is planted.

    :ivar begin: after the first record of the stretch without faults, s.
    :ivar seconds: that it lasts.
    :ivar amount: of the fault, in its own unit; 0 where it has none.
    """

    begin: float
    seconds: float = 0.0
    amount: float = 0.0


class FaultyStream(NamedTuple):
    """Records with a fault, and where it was planted."""

    records: list[LogRecord]
    places: tuple[FaultPlace, ...]


Fault = Callable[[Sequence[LogRecord], np.random.Generator], FaultyStream]


@dataclass(frozen=True)
class ListedLog:
    """A log of given records.

    :ivar name: of the log.
    :ivar listed: its records, in the order of their stamps.
    """

    name: str
    listed: Sequence[LogRecord]

    @property
    def scan_count(self) -> int:
        """Number of scans."""
        return sum(isinstance(record.measurement, Scan) for record in self.listed)

    @property
    def duration(self) -> float:
        """Seconds from the first record to the last."""
        return (self.listed[-1].measurement.stamp - self.listed[0].measurement.stamp) / NANOSECONDS

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        return iter(self.listed)


@dataclass(frozen=True, eq=False)
class OdometryPath:
    """The odometry of a stream with m readings.

    :ivar rows: shape (m,), indices of the readings among the records.
    :ivar seconds: shape (m,), after the first record.
    :ivar poses: shape (m, 3), ``odom_T_base``, m and rad.
    """

    rows: Int64
    seconds: Float64
    poses: Float64

    def poses_at(self, seconds: Float64) -> Float64:
        """Interpolated poses (k, 3) with unwrapped headings at times (k,), s."""
        x, y, heading = self.poses[:, 0], self.poses[:, 1], np.unwrap(self.poses[:, 2])
        return np.stack([np.interp(seconds, self.seconds, part) for part in (x, y, heading)], axis=1)

    def speeds(self) -> Float64:
        """Speed at each reading, shape (m,), m/s."""
        before, after = (self.poses_at(self.seconds + shift) for shift in (-_HALF_WINDOW, _HALF_WINDOW))
        return np.asarray(np.hypot(*(after - before)[:, :2].T) / (2.0 * _HALF_WINDOW))

    def turn_rates(self) -> Float64:
        """Turn rate at each reading, shape (m,), rad/s."""
        before, after = (self.poses_at(self.seconds + shift) for shift in (-_HALF_WINDOW, _HALF_WINDOW))
        return np.asarray((after - before)[:, 2] / (2.0 * _HALF_WINDOW))


def seconds_of(records: Sequence[LogRecord]) -> Float64:
    """Times of all records after the first, shape (n,), s."""
    stamps = np.array([record.measurement.stamp for record in records], dtype=np.int64)
    return np.asarray((stamps - stamps[0]) / NANOSECONDS)


def odometry_path(records: Sequence[LogRecord]) -> OdometryPath:
    """The odometry of a stream.

    :raises HmtSlamError: where there are fewer than two readings.
    """
    rows = np.array([k for k, record in enumerate(records) if isinstance(record.measurement, Odometry)], dtype=np.int64)
    if rows.size < 2:
        raise HmtSlamError("a log without odometry has no place for this fault: choose another log")
    poses = [reading.pose for k in rows if isinstance(reading := records[k].measurement, Odometry)]
    return OdometryPath(rows, seconds_of(records)[rows], np.array(poses))


def draw_times(
    seconds: Float64, suitable: Bool, count: int, spacing: float, random: np.random.Generator
) -> list[float]:
    """At most ``count`` suitable times, in their order, none within ``spacing`` s of another.

    :param seconds: shape (n,), times to choose from, s.
    :param suitable: shape (n,), whether each may be chosen.
    :raises HmtSlamError: where no time is suitable.
    """
    inside = suitable & (seconds >= seconds[0] + MARGIN) & (seconds <= seconds[-1] - MARGIN)
    left = seconds[inside]
    if not left.size:
        raise HmtSlamError("the stretch has no place for this fault: choose another one")
    chosen: list[float] = []
    while left.size and len(chosen) < count:
        chosen.append(float(random.choice(left)))
        left = left[np.abs(left - chosen[-1]) >= spacing]
    return sorted(chosen)


def change_measurement(record: LogRecord, **changes: Any) -> LogRecord:  # noqa: ANN401  fields of any type
    """The record with other fields of its measurement."""
    return replace(record, measurement=replace(record.measurement, **changes))


def replace_poses(records: Sequence[LogRecord], rows: Int64, poses: Float64) -> list[LogRecord]:
    """The records with other poses (m, 3) of the odometry readings at rows (m,)."""
    changed = list(records)
    for row, pose in zip(rows.tolist(), poses, strict=True):
        changed[row] = change_measurement(changed[row], pose=pose)
    return changed


def change_scans(records: Iterable[LogRecord], change: Callable[[int, Scan], Scan]) -> list[LogRecord]:
    """The records with each scan replaced, given its number, from 0, and the scan."""
    changed, number = [], 0
    for record in records:
        if isinstance(record.measurement, Scan):
            changed.append(replace(record, measurement=change(number, record.measurement)))
            number += 1
        else:
            changed.append(record)
    return changed


def in_order(records: Iterable[LogRecord]) -> list[LogRecord]:
    """The records in the order of their stamps, of equal ones the odometry first."""
    return sorted(records, key=lambda record: (record.measurement.stamp, isinstance(record.measurement, Scan)))


def chain_increments(first: Float64, increments: Float64) -> Float64:
    """Poses (n + 1, 3) that begin at ``first`` and follow the increments (n, 3)."""
    poses = [np.asarray(first, dtype=np.float64)]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment))
    return np.array(poses)
