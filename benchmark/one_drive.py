"""Several visits of a building, joined to one drive of a robot that stays there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.simulation import SimulatedLog

# ns between two visits.
_PAUSE = 2 * NANOSECONDS


class JoinedVisits:
    """A log of several visits, between which the robot stays and turns to the next start.

    :ivar name: of the first visit.
    :ivar scan_count: of all.
    :ivar duration: of all, s.
    """

    def __init__(self, visits: Sequence[SimulatedLog]) -> None:
        self._visits = visits
        self.name = visits[0].name
        self.scan_count = sum(log.scan_count for log in visits)
        self.duration = sum(log.duration for log in visits)

    def records(self) -> Iterator[LogRecord]:
        """The records of all visits on one clock, with continuous odometry."""
        stamp, odometry = 0, np.zeros(3)
        truth: NDArray[np.float64] | None = None
        for log in self._visits:
            records = list(log.records())
            shift = stamp + _PAUSE - records[0].measurement.stamp if stamp else 0
            assert records[0].true_pose is not None
            turn = np.zeros(3) if truth is None else se2.between(truth, records[0].true_pose)
            first = next(r.measurement for r in records if isinstance(r.measurement, Odometry)).pose
            begin = first if truth is None else se2.compose(odometry, turn)
            for record in records:
                measurement = replace(record.measurement, stamp=record.measurement.stamp + shift)
                if isinstance(measurement, Odometry):
                    odometry = se2.compose(begin, se2.between(first, measurement.pose))
                    measurement = replace(measurement, pose=odometry)
                yield LogRecord(record.source_stamp + shift, measurement, record.true_pose)
            stamp, truth = records[-1].measurement.stamp + shift, records[-1].true_pose
