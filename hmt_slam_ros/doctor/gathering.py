"""One pass over scans and odometry."""

from __future__ import annotations

from array import array

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float32, Float64, Int64
from hmt_slam_ros.doctor.scan_motion import ScanMotionFinder
from hmt_slam_ros.doctor.statistics import (
    BeamCounts,
    BeamStatistics,
    MessageStatistics,
    OdometryStatistics,
    ScanStatistics,
    Statistics,
)
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.scan import SweepCheck


class Gatherer:
    """Takes records one after the other."""

    def __init__(self) -> None:
        self._scan_stamps, self._odometry_stamps = array("q"), array("q")
        self._scan_rows, self._odometry_rows = array("d"), array("d")
        self._counts, self._non_finite_count = array("q"), 0
        self._beam_statistics = BeamStatistics(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        self._sweep_check, self._sweep_fault_count, self._first_sweep_fault = SweepCheck(), 0, ""
        self._motions = ScanMotionFinder()

    def add(self, record: LogRecord) -> None:
        """Take in a scan or an odometry reading."""
        if isinstance(record.measurement, Scan):
            self._add_scan(record.source_stamp, record.measurement)
        else:
            self._add_odometry(record.source_stamp, record.measurement)

    def _add_odometry(self, source_stamp: int, reading: Odometry) -> None:
        if not np.isfinite(reading.pose).all():
            self._non_finite_count += 1
            return
        self._odometry_stamps.extend((source_stamp, reading.stamp))
        self._odometry_rows.extend(reading.pose)

    def _add_scan(self, source_stamp: int, scan: Scan) -> None:
        if not self._scan_stamps:
            size = scan.ranges.size
            self._beam_statistics = BeamStatistics(np.zeros(size, np.int64), np.full(size, np.inf), np.zeros(size))
        self._scan_stamps.extend((source_stamp, scan.stamp))
        self._scan_rows.extend((scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max))
        self._scan_rows.extend((scan.time_increment, *scan.laser_pose))
        self._counts.extend(
            _count_beams(scan.ranges, max(scan.range_min, 1e-3), scan.range_max, *self._beam_statistics)
        )
        scan, fault = self._sweep_check.check(scan)
        self._sweep_fault_count += fault is not None
        self._first_sweep_fault = self._first_sweep_fault or fault or ""
        self._motions.add(scan)

    def finish(self, name: str, messages: MessageStatistics | None = None) -> Statistics:
        """All that was gathered."""
        stamps = np.array(self._scan_stamps, np.int64).reshape(-1, 2)
        rows = np.array(self._scan_rows, np.float64).reshape(-1, 8)
        counts = BeamCounts(*np.array(self._counts, np.int64).reshape(-1, 6).T)
        scans = ScanStatistics(
            stamps[:, 0],
            stamps[:, 1],
            rows[:, :5],
            rows[:, 5:],
            counts,
            self._beam_statistics,
            self._sweep_fault_count,
            self._first_sweep_fault,
        )
        stamps = np.array(self._odometry_stamps, np.int64).reshape(-1, 2)
        poses = np.array(self._odometry_rows, np.float64).reshape(-1, 3)
        odometry = OdometryStatistics(stamps[:, 0], stamps[:, 1], poses, self._non_finite_count)
        return Statistics(name, scans, odometry, self._motions.finish(), messages)


def gather(log: Log, messages: MessageStatistics | None = None) -> Statistics:
    """One pass over a log.

    :param messages: what its messages tell, where it has some.
    """
    gatherer = Gatherer()
    for record in log.records():
        gatherer.add(record)
    return gatherer.finish(log.name, messages)


@njit(cache=True)
def _count_beams(
    ranges: Float32, nearest: float, farthest: float, returns: Int64, least: Float64, most: Float64
) -> tuple[int, int, int, int, int, int]:
    """The row of `BeamCounts` of a scan; where it has as many beams as the others, each beam is noted, too.

    :param ranges: shape (n,), m.
    :param returns: shape (b,), ``least`` and ``most`` (b,), m: those of `BeamStatistics`, written to.
    """
    valid = nan = infinite = near = far = 0
    same = ranges.size == returns.size
    for k in range(ranges.size):
        value = np.float64(ranges[k])
        if np.isnan(value):
            nan += 1
        elif np.isinf(value):
            infinite += 1
        elif value < nearest:
            near += 1
        elif value >= farthest:
            far += 1
        else:
            valid += 1
            if same:
                returns[k] += 1
                least[k] = min(least[k], value)
                most[k] = max(most[k], value)
    return ranges.size, valid, nan, infinite, near, far
