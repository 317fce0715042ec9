"""Progress through the logs of a map, and the parameters of a run that continues a saved map."""

from __future__ import annotations

import itertools
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hmt_slam_ros.arrays import Int64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import as_flat
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS, seconds_from_stamp
from hmt_slam_ros.results.trajectories import RelativeTrajectory
from hmt_slam_ros.saved_map.folder import HMT_MAP
from hmt_slam_ros.sensors import Scan

_BETWEEN_LOGS = 60 * NANOSECONDS
"""Time on the map's clock from the last scan of a log to the first record of the next, ns."""


@dataclass(frozen=True, eq=False)
class LogProgress:
    """Progress through the logs of a map.

    :ivar records_read: number of scans and odometry readings read of the newest log.
    :ivar stamps: shape (n,), stamps of the scans of all logs on the map's clock, ns, increasing.
    :ivar source_stamps: shape (n,), the logs' own stamps of these scans, ns.
    :ivar first_scans: number of the first scan of each log.
    :ivar earlier_trajectory: refined trajectory of the scans of all logs before the newest, empty for one log.
    :ivar clock_offset: map's clock less the running clock of the newest log, ns.
    :ivar checksum: CRC-32 of the ranges of the first scan of the newest log.
    """

    records_read: int = 0
    stamps: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    source_stamps: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))
    first_scans: tuple[int, ...] = (0,)
    earlier_trajectory: RelativeTrajectory = field(default_factory=RelativeTrajectory.empty)
    clock_offset: int = 0
    checksum: int = 0


def is_newest_log(state: LogProgress, log: Log) -> bool:
    """Whether a log is the newest log of a map, that is, begins with the same scan."""
    first = state.first_scans[-1]
    if first == state.stamps.size:
        return True
    for record in log.records():
        if isinstance(record.measurement, Scan):
            return (record.source_stamp, _checksum(record.measurement)) == (state.source_stamps[first], state.checksum)
    return False


class LogReader:
    """Reads one log after the other onto the map's clock."""

    def __init__(self, state: LogProgress) -> None:
        """:param state: progress from which reading continues."""
        self._progress, self._records_read = state, state.records_read
        self._stamps, self._source_stamps = (array("q", part.tobytes()) for part in (state.stamps, state.source_stamps))

    @property
    def state(self) -> LogProgress:
        """The progress as a value."""
        stamps, source_stamps = np.array(self._stamps, np.int64), np.array(self._source_stamps, np.int64)
        return replace(self._progress, records_read=self._records_read, stamps=stamps, source_stamps=source_stamps)

    @property
    def scans_read(self) -> int:
        """Number of scans read of the newest log."""
        return len(self._stamps) - self._progress.first_scans[-1]

    @property
    def stamp_bytes(self) -> int:
        """Memory of the stamps, bytes."""
        return sum(len(stamps) * stamps.itemsize for stamps in (self._stamps, self._source_stamps))

    def begin_log(self, log: Log) -> None:
        """Begin a further log. The map's clock continues after the last scan."""
        first = next((record.measurement.stamp for record in log.records()), 0)
        self._progress = replace(
            self._progress,
            first_scans=(*self._progress.first_scans, len(self._stamps)),
            clock_offset=self._stamps[-1] + _BETWEEN_LOGS - first,
        )
        self._records_read = 0

    def unread_records(self, log: Log) -> Iterator[LogRecord]:
        """The unread records of the newest log, with stamps on the map's clock.

        :raises HmtSlamError: where the records that were read differ from those of the log.
        """
        first = self._progress.first_scans[-1]
        scans = zip(self._stamps[first:], self._source_stamps[first:], strict=True)
        records = map(self._to_map_clock, log.records())
        for record in itertools.islice(records, self._records_read):
            if isinstance(record.measurement, Scan) and next(scans, None) != _scan_stamps(record):
                raise HmtSlamError(
                    f"{log.name} begins as the log that the map was made of and is another: a scan of it, at "
                    f"{seconds_from_stamp(record.source_stamp)} s, is not in the map; give that log"
                )
        if next(scans, None) is not None:
            raise HmtSlamError(
                f"{log.name} ends before the last scan that the map was made of: give a larger --duration, or the log "
                "that the map was made of"
            )
        return records

    def mark_read(self, record: LogRecord) -> None:
        """Count a record as read."""
        self._records_read += 1
        if isinstance(record.measurement, Scan):
            if not self.scans_read:
                self._progress = replace(self._progress, checksum=_checksum(record.measurement))
            running, source = _scan_stamps(record)
            self._stamps.append(running)
            self._source_stamps.append(source)

    def _to_map_clock(self, record: LogRecord) -> LogRecord:
        offset, measurement = self._progress.clock_offset, record.measurement
        return replace(record, measurement=replace(measurement, stamp=measurement.stamp + offset)) if offset else record


def _scan_stamps(record: LogRecord) -> tuple[int, int]:
    """Stamps of a scan on the map's clock and on the log's own, ns."""
    return record.measurement.stamp, record.source_stamp


def _checksum(scan: Scan) -> int:
    return zlib.crc32(scan.ranges.tobytes())


_CHANGEABLE = ("robot.", "mode", "explorer.", "pilot.")
"""Prefixes of parameters that may change silently when a run continues: they do not concern the map."""

_START = "robot.start"
"""The parameter with the beginning of a log, which is fixed unless the log is a further one."""

FIXED_PARAMETERS = (
    "filter.particles",
    "local_map.kind",
    "local_map.cell",
    "local_map.extent",
    "local_map.field_radius",
)
"""Parameters that may not change within a saved map: the numbers in its state depend on them."""


def map_folder(path: Path) -> Path:
    """The folder of a map.

    :param path: that folder, or the output folder around it.
    """
    folder = path / HMT_MAP
    return folder if folder.is_dir() else path


def describe_log(read: LogProgress, name: str, *, further: bool) -> str:
    """A sentence that says whether a log is the newest log of a map, or a further one.

    :param read: progress through the logs of the map.
    :param name: name of the log.
    """
    if further:
        return (
            f"{name} does not begin with the scan with which the log began that the map was made of, so it is a "
            "further one: the robot may be anywhere, and maps on until it is recognized in the map"
        )
    scans = read.stamps.size - read.first_scans[-1]
    return f"{name} is the log that the map was made of, of which {scans} scans are in it: goes on with the next"


def describe_parameter_changes(saved: Configuration, requested: Configuration, *, further: bool = False) -> str | None:
    """A sentence about the parameters that change when a run continues, None where none changes.

    :param saved: configuration of the map.
    :param requested: configuration of the run.
    :param further: whether the log is a further one, so that ``robot.start`` may change.
    :raises HmtSlamError: where a fixed parameter changes.
    """
    before, now = as_flat(saved), as_flat(requested)
    changed = [name for name in before if before[name] != now[name]]
    fixed = [name for name in changed if name in FIXED_PARAMETERS or (name == _START and not further)]
    if fixed:
        raise HmtSlamError(
            f"the map was made with {_join_settings(fixed, before)}, not with {_join_settings(fixed, now)}, and cannot "
            "go on with another value: leave that away, or map the log anew"
        )
    free = [name for name in changed if not name.startswith(_CHANGEABLE)]
    return (
        f"goes on with {_join_settings(free, now)}; the map was made with {_join_settings(free, before)}"
        if free
        else None
    )


def _join_settings(names: list[str], values: dict[str, bool | int | float | str]) -> str:
    return " and ".join(f"{name} = {values[name]}" for name in names)
