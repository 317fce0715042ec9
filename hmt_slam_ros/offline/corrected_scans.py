"""The scans of a log once more, corrected for the motion during their sweep as metric SLAM corrects them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.logs import Log
from hmt_slam_ros.sensing import Odometry, Scan
from hmt_slam_ros.sensing.deskew import SweepCheck, deskewed
from hmt_slam_ros.sensing.odometry import OdometryBuffer


def corrected_scans(log: Log, configuration: Configuration) -> Iterator[Scan]:
    """All scans in file order, each as soon as the odometry covers its sweep, if it has one.

    :raises HmtSlamError: where the log is faulty.
    """
    odometry, sweeps, waiting = OdometryBuffer(), SweepCheck(), deque[Scan]()
    for record in log.records():
        if isinstance(record.measurement, Odometry):
            odometry.add(record.measurement)
        else:
            waiting.append(sweeps.checked(record.measurement)[0])
        while waiting and (waiting[0].sweep == 0.0 or odometry.covers(waiting[0].end)):
            yield _corrected(waiting.popleft(), odometry, configuration)
    while waiting:
        yield _corrected(waiting.popleft(), odometry, configuration)


def _corrected(scan: Scan, odometry: OdometryBuffer, configuration: Configuration) -> Scan:
    odometry.at(scan.stamp)  # forgets what lies before
    return deskewed(scan, odometry, configuration.rtl)
