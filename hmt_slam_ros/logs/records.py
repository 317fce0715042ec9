"""What every log, whatever its format, is read as."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from hmt_slam_ros.sensing import Odometry, Scan


@dataclass(frozen=True, slots=True)
class LogRecord:
    """One measurement of a log, in file order.

    :ivar source_stamp: the log's own time stamp in ns, which may jump back; results are keyed by it.
    :ivar measurement: the scan or odometry reading; its ``stamp`` is in ns and strictly increasing within its kind
        over the log: ``source_stamp`` wherever that moves forward, and just after its predecessor where it does not.
    """

    source_stamp: int
    measurement: Scan | Odometry


class Log(Protocol):
    """A source of scans and odometry that can be read more than once."""

    @property
    def name(self) -> str:
        """Short name for reports, such as the file's stem."""

    @property
    def scan_count(self) -> int:
        """Number of scans in the whole log."""

    @property
    def duration(self) -> float:
        """Seconds from the first to the last record."""

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order, from the start at every call.

        :raises HmtSlamError: where the file is truncated or malformed, when that place is reached.
        """
