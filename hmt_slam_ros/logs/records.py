"""What every log, whatever its format, is read as."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.sensing import Odometry, Scan

SIMULATED = "sim:"
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
    :ivar truth: shape (3,), the robot's true pose ``world_T_base`` at that time, m and rad; None where nobody knows it.
    """

    source_stamp: int
    measurement: Scan | Odometry
    truth: NDArray[np.float64] | None = None


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
