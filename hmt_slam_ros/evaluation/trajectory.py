"""Poses with their time stamps, and the TUM file format ``t x y z qx qy qz qw``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.mounting import heading_from_quaternion
from hmt_slam_ros.logs.stamps import seconds_from_stamp, stamp_from_seconds
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, check_planar_pose, check_quaternion
from hmt_slam_ros.untrusted_input import MAX_TEXT_BYTES, read_text


@dataclass(frozen=True, eq=False)
class StampedPoses:
    """A trajectory in any order of time.

    :ivar stamps: shape (n,), int64, ns; they may jump back and repeat.
    :ivar poses: shape (n, 3), (x, y, theta) in m and rad, all in one frame.
    """

    stamps: NDArray[np.int64]
    poses: NDArray[np.float64]

    def nearest_indices(self, stamps: NDArray[np.int64]) -> NDArray[np.intp]:
        """Index of the pose nearest in time to each stamp.

        Of poses with the same stamp it is the first, and of two equally near ones the earlier.

        :param stamps: shape (m,), ns.
        :returns: shape (m,).
        """
        order = np.argsort(self.stamps, kind="stable")
        times = self.stamps[order]
        after = np.clip(np.searchsorted(times, stamps, side="left"), 0, times.size - 1)
        before = np.clip(np.searchsorted(times, times[np.maximum(after - 1, 0)], side="left"), 0, after)
        nearer_before = np.abs(stamps - times[before]) <= np.abs(times[after] - stamps)
        return order[np.where(nearer_before, before, after)]


def read_tum(path: Path) -> StampedPoses:
    """Poses of a TUM file, in file order; stamps are exact to the ns.

    :raises HmtSlamError: if the file cannot be read, is empty or has a malformed line.
    """
    lines = read_text(path, MAX_TEXT_BYTES).splitlines()
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in enumerate(lines, start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            x, y, _, qx, qy, qz, qw = map(float, fields[1:])
            check_quaternion((qx, qy, qz, qw))
            check_planar_pose(np.array([x, y, 0.0]), "the pose", MAX_COORDINATE)
            stamps.append(stamp_from_seconds(fields[0]))
        except (ValueError, HmtSlamError):
            raise HmtSlamError(f"line {number} of {path} is not 't x y z qx qy qz qw': mend that line.") from None
        poses.append((x, y, heading_from_quaternion((qx, qy, qz, qw))))
    if not stamps:
        raise HmtSlamError(f"{path} holds no pose: give a trajectory in the TUM format.")
    return StampedPoses(np.array(stamps, dtype=np.int64), np.array(poses))


def write_tum(path: Path, trajectory: StampedPoses) -> None:
    """Write a TUM file, one line a pose, in the order given; `read_tum` recovers every stamp exactly."""
    halves = 0.5 * trajectory.poses[:, 2]
    rows = zip(trajectory.stamps.tolist(), trajectory.poses.tolist(), np.sin(halves), np.cos(halves), strict=True)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for stamp, (x, y, _), sin, cos in rows:
            file.write(f"{seconds_from_stamp(stamp)} {x:.9f} {y:.9f} 0 0 0 {sin:.12f} {cos:.12f}\n")


def read_true_poses(log: Log) -> StampedPoses:
    """The true pose at every scan of a log, with its source stamp.

    :raises HmtSlamError: for a log without true poses.
    """
    scans = [record for record in log.records() if isinstance(record.measurement, Scan)]
    poses = [record.true_pose for record in scans if record.true_pose is not None]
    if len(poses) < len(scans):
        raise HmtSlamError(f"{log.name} has no true poses: give a simulated log, or a bag of one.")
    return StampedPoses(np.array([record.source_stamp for record in scans], dtype=np.int64), np.array(poses))


def read_odometry_poses(log: Log) -> StampedPoses:
    """All odometry readings of a log with their source stamps."""
    readings = [record for record in log.records() if isinstance(record.measurement, Odometry)]
    stamps = np.array([reading.source_stamp for reading in readings], dtype=np.int64)
    return StampedPoses(stamps, np.array([r.measurement.pose for r in readings if isinstance(r.measurement, Odometry)]))
