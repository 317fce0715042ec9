"""Between the project's values and ROS messages.

Bulk arrays go through ``array.array`` and the buffer protocol: a list, or the assignment of a numpy array, costs ten
to a thousand times as much. Floats of a LaserScan are float32 in ROS; everything else comes back as it was.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point as PointMessage
from geometry_msgs.msg import (
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    TransformStamped,
    Vector3,
)
from geometry_msgs.msg import Transform as TransformMessage
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.mounting import heading_from_quaternion
from hmt_slam_ros.messages.messages import ScanPoses
from hmt_slam_ros.sensors import Odometry, Scan

_SECOND = 1_000_000_000
# Rows and columns of (x, y, theta) in the 6 x 6 covariance of ROS, which is (x, y, z, roll, pitch, yaw).
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
# Units in the last place by which a quaternion may be off, the smallest first.
_NUDGES = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (2, 0), (-2, 0), (0, 2), (0, -2))
_SCAN_POSES_FRAME = re.compile(r"hypothesis_(\d+)/scan_(\d+)")
_AREA_FRAME = re.compile(r"area_(\d+)")
_KEYFRAME_FRAME = re.compile(r"keyframe_(\d+)(?:/reset_(\d+))?")


def time_message(stamp: int) -> Time:
    """ROS time of a stamp in ns."""
    seconds, nanoseconds = divmod(stamp, _SECOND)
    return Time(sec=seconds, nanosec=nanoseconds)


def stamp_from_time(time: Time) -> int:
    """Stamp in ns of a ROS time."""
    return int(time.sec) * _SECOND + int(time.nanosec)


def header_message(stamp: int, frame: str) -> Header:
    """Header from a stamp in ns and the name of a frame."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def quaternion_message(theta: float) -> Quaternion:
    """Rotation by ``theta`` rad, in [-pi, pi), about z, from which the receiver gets ``theta`` back bit for bit.

    Sine and cosine are rounded, so the angle may come back with another last bit, and a run of the nodes would drift
    away from the lock-step run. The last bits of the quaternion are chosen such that it does not, for any angle of
    1e-300 rad or more.
    """
    sin, cos = math.sin(0.5 * theta), math.cos(0.5 * theta)
    for steps_z, steps_w in _NUDGES:
        z, w = sin + steps_z * math.ulp(sin), cos + steps_w * math.ulp(cos)
        if heading_from_quaternion((0.0, 0.0, z, w)) == theta:
            return Quaternion(z=z, w=w)
    return Quaternion(z=sin, w=cos)


def pose_message(pose: NDArray[np.float64]) -> Pose:
    """ROS pose of (x, y, theta)."""
    x, y, theta = pose.tolist()
    return Pose(position=PointMessage(x=x, y=y), orientation=quaternion_message(theta))


def pose_from_message(pose: Pose) -> NDArray[np.float64]:
    """(x, y, theta) of a ROS pose."""
    turn = pose.orientation
    return np.array([pose.position.x, pose.position.y, heading_from_quaternion((turn.x, turn.y, turn.z, turn.w))])


def transform_message(stamp: int, parent: str, child: str, parent_T_child: NDArray[np.float64]) -> TransformStamped:
    """ROS transform of the pose ``parent_T_child`` (3,)."""
    x, y, theta = parent_T_child.tolist()
    transform = TransformMessage(translation=Vector3(x=x, y=y), rotation=quaternion_message(theta))
    return TransformStamped(header=header_message(stamp, parent), child_frame_id=child, transform=transform)


def scan_message(scan: Scan, frame: str) -> LaserScan:
    """ROS scan; the pose of the laser is left to the transform of ``frame``."""
    return LaserScan(
        header=header_message(scan.stamp, frame),
        angle_min=scan.angle_min,
        angle_max=scan.angle_min + (scan.ranges.size - 1) * scan.angle_increment,
        angle_increment=scan.angle_increment,
        time_increment=scan.time_increment,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=array("f", np.ascontiguousarray(scan.ranges, dtype=np.float32).tobytes()),
    )


def ranges_from_message(message: LaserScan) -> NDArray[np.float32]:
    """Ranges, shape (n,), m, not to be written to."""
    return np.frombuffer(message.ranges, dtype=np.float32) if len(message.ranges) else np.zeros(0, dtype=np.float32)


def scan_from_message(message: LaserScan, laser_pose: NDArray[np.float64], angle_sign: float = 1.0) -> Scan:
    """A scan.

    :param laser_pose: shape (3,), ``base_T_laser``.
    :param angle_sign: -1.0 for a laser that is mounted upside down, whose angles count the other way round.
    """
    return Scan(
        stamp_from_time(message.header.stamp),
        ranges_from_message(message),
        angle_sign * message.angle_min,
        angle_sign * message.angle_increment,
        message.range_min,
        message.range_max,
        laser_pose,
        message.time_increment,
    )


def odometry_message(reading: Odometry, odom_frame: str, base_frame: str) -> OdometryMessage:
    """ROS odometry without velocities."""
    return OdometryMessage(
        header=header_message(reading.stamp, odom_frame),
        child_frame_id=base_frame,
        pose=PoseWithCovariance(pose=pose_message(reading.pose)),
    )


def odometry_from_message(message: OdometryMessage) -> Odometry:
    """An odometry reading."""
    return Odometry(stamp_from_time(message.header.stamp), pose_from_message(message.pose.pose))


def pose_with_covariance_message(stamp: int, frame: str, belief: PoseGaussian) -> PoseWithCovarianceStamped:
    """ROS pose with covariance.

    Ours lives in the right tangent frame, that is, in the robot's axes; ROS gives x and y in the axes of ``frame``.
    """
    sin, cos = math.sin(belief.mean[2]), math.cos(belief.mean[2])
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.zeros((6, 6))
    covariance[_PLANAR] = axes @ belief.covariance @ axes.T
    return PoseWithCovarianceStamped(
        header=header_message(stamp, frame),
        pose=PoseWithCovariance(pose=pose_message(belief.mean), covariance=covariance.ravel()),
    )


def gaussian_from_message(message: PoseWithCovariance) -> PoseGaussian:
    """The inverse of :func:`pose_with_covariance_message`."""
    mean = pose_from_message(message.pose)
    sin, cos = math.sin(mean[2]), math.cos(mean[2])
    axes = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return PoseGaussian(mean, axes.T @ np.reshape(message.covariance, (6, 6))[_PLANAR] @ axes)


def area_frame(area: int) -> str:
    """Name of an area's frame."""
    return f"area_{area}"


def area_from_frame(frame: str) -> int:
    """The area that a frame is named after.

    :raises HmtSlamError: where it is named after something else.
    """
    return int(_match_frame(_AREA_FRAME, frame)[1])


def keyframe_frame(keyframe: int, reset_number: int = 0) -> str:
    """Name of a keyframe's frame.

    :param reset_number: number of the request after which slam began anew, 0 before the first.
    """
    return f"keyframe_{keyframe}/reset_{reset_number}" if reset_number else f"keyframe_{keyframe}"


def keyframe_from_frame(frame: str) -> tuple[int, int]:
    """The keyframe that a frame is named after, and the request after which slam had begun anew.

    :raises HmtSlamError: where it is named after something else.
    """
    found = _match_frame(_KEYFRAME_FRAME, frame)
    return int(found[1]), int(found[2] or 0)


def path_message(scan_poses: ScanPoses) -> Path:
    """Scan poses as a path: every pose in the frame of its own keyframe."""
    rows = zip(scan_poses.stamps.tolist(), scan_poses.keyframes.tolist(), scan_poses.poses, strict=True)
    poses = [
        PoseStamped(header=header_message(stamp, keyframe_frame(anchor)), pose=pose_message(pose))
        for stamp, anchor, pose in rows
    ]
    first = int(scan_poses.stamps[0]) if scan_poses.stamps.size else 0
    return Path(
        header=header_message(first, f"hypothesis_{scan_poses.hypothesis}/scan_{scan_poses.first_scan}"), poses=poses
    )


def scan_poses_from_message(message: Path) -> ScanPoses:
    """The inverse of :func:`path_message`.

    :raises HmtSlamError: where the frames have other names.
    """
    found = _match_frame(_SCAN_POSES_FRAME, message.header.frame_id)
    return ScanPoses(
        int(found[1]),
        int(found[2]),
        np.array([stamp_from_time(pose.header.stamp) for pose in message.poses], dtype=np.int64),
        np.array([keyframe_from_frame(pose.header.frame_id)[0] for pose in message.poses], dtype=np.int64),
        np.array([pose_from_message(pose.pose) for pose in message.poses], dtype=np.float64).reshape(-1, 3),
    )


def _match_frame(pattern: re.Pattern[str], frame: str) -> re.Match[str]:
    found = pattern.fullmatch(frame)
    if found is None:
        raise HmtSlamError(f"frame '{frame}' is not of the form {pattern.pattern}: run the same version everywhere")
    return found


def flatten_rows(rows: Iterable[Iterable[float]]) -> array[float]:
    """Rows of numbers one after the other, as a MultiArray holds them."""
    return array("d", [value for row in rows for value in row])
