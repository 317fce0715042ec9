"""Conversions between the values of this package and ROS messages.

Bulk arrays go through ``array.array`` and the buffer protocol: lists and numpy arrays cost ten to a thousand times as
much. A LaserScan holds float32; all else survives a round trip bit for bit.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Sequence

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
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.mounting import heading_from_quaternion
from hmt_slam_ros.logs.planar_covariance import planar_covariance, spatial_covariance
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import ScanPoses
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan
from hmt_slam_ros.sensors.mark import check_mark
from hmt_slam_ros.sensors.plausibility import (
    MAX_COORDINATE,
    MAX_STAMP,
    check_odometry,
    check_planar_pose,
    check_quaternion,
)
from hmt_slam_ros.untrusted_input import shorten

_NUDGES = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (2, 0), (-2, 0), (0, 2), (0, -2))
"""Corrections of (z, w) of a quaternion that are tried, units in the last place, the smallest first."""
_SCAN_POSES_FRAME = re.compile(r"hypothesis_(\d{1,18})/scan_(\d{1,18})(?:/system_(.{1,100}))?")
_COST_LABEL = re.compile(r"(\w{1,100})(?:/system_(.{1,100}))?")
_AREA_FRAME = re.compile(r"area_(\d{1,18})")
_KEYFRAME_FRAME = re.compile(r"keyframe_(-?\d{1,18})(?:/reset_(\d{1,19}))?(?:/system_(.{1,100}))?")


def time_message(stamp: int) -> Time:
    """ROS time of a stamp in ns."""
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanoseconds)


def stamp_from_time(time: Time) -> int:
    """Stamp in ns of a ROS time."""
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def header_message(stamp: int, frame: str) -> Header:
    """Header of a stamp in ns and the name of a frame."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def quaternion_message(theta: float) -> Quaternion:
    """Rotation about z by ``theta`` in [-pi, pi) rad, from which a receiver gets ``theta`` bit for bit.

    Rounded sine and cosine may change the last bit of the angle, and a run of the nodes would differ from the lock-step
    run. So the last bits of the quaternion are chosen to restore any angle of 1e-300 rad or more.
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
    """(x, y, theta) of a ROS pose.

    :raises HmtSlamError: where a number is not finite or far beyond any map, or the quaternion is no rotation.
    """
    q = pose.orientation
    quaternion = (q.x, q.y, q.z, q.w)
    check_quaternion(quaternion)
    x_y_theta = np.array([pose.position.x, pose.position.y, heading_from_quaternion(quaternion)])
    check_planar_pose(x_y_theta, "pose", MAX_COORDINATE)
    return x_y_theta


def transform_message(stamp: int, parent: str, child: str, parent_T_child: NDArray[np.float64]) -> TransformStamped:
    """ROS transform of the pose ``parent_T_child`` (3,)."""
    x, y, theta = parent_T_child.tolist()
    transform = TransformMessage(translation=Vector3(x=x, y=y), rotation=quaternion_message(theta))
    return TransformStamped(header=header_message(stamp, parent), child_frame_id=child, transform=transform)


def scan_message(scan: Scan, frame: str) -> LaserScan:
    """ROS scan in the laser's ``frame``; the pose of the laser is not part of it."""
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
    """Ranges (n,), m, read-only."""
    return np.frombuffer(message.ranges, dtype=np.float32) if len(message.ranges) else np.zeros(0, dtype=np.float32)


def scan_from_message(message: LaserScan, laser_pose: NDArray[np.float64], angle_sign: float = 1.0) -> Scan:
    """Scan of a ROS scan.

    :param laser_pose: ``base_T_laser`` (3,).
    :param angle_sign: -1.0 for a laser that is mounted upside down, else 1.0.
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
    """Odometry reading of ROS odometry.

    :raises HmtSlamError: where it is none; names the field, its value and the remedy.
    """
    return check_odometry(Odometry(stamp_from_time(message.header.stamp), pose_from_message(message.pose.pose)))


def pose_with_covariance_message(stamp: int, frame: str, belief: PoseGaussian) -> PoseWithCovarianceStamped:
    """ROS pose with covariance, with x and y along the axes of ``frame``.

    The covariance of a ``PoseGaussian`` is in the right tangent frame, along the robot's axes.
    """
    axes = _rotation(belief.mean[2])
    covariance = spatial_covariance(axes @ belief.covariance @ axes.T)
    return PoseWithCovarianceStamped(
        header=header_message(stamp, frame),
        pose=PoseWithCovariance(pose=pose_message(belief.mean), covariance=covariance),
    )


def gaussian_from_message(message: PoseWithCovariance) -> PoseGaussian:
    """The inverse of :func:`pose_with_covariance_message`.

    :raises HmtSlamError: where the pose is none; the covariance is not checked.
    """
    mean = pose_from_message(message.pose)
    axes = _rotation(mean[2])
    return PoseGaussian(mean, axes.T @ planar_covariance(message.covariance) @ axes)


def mark_from_message(message: PoseWithCovarianceStamped) -> MarkObservation:
    """Observation of the mark after which the frame of a ROS pose is named.

    :raises HmtSlamError: where it cannot be used; names the field, its value and the remedy.
    """
    stamp, name = stamp_from_time(message.header.stamp), message.header.frame_id.removeprefix("/")
    return check_mark(MarkObservation(stamp, name, gaussian_from_message(message.pose)))


def _rotation(theta: float) -> NDArray[np.float64]:
    """Rotation by ``theta`` rad of (x, y, theta), shape (3, 3)."""
    sin, cos = math.sin(theta), math.cos(theta)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def area_frame(area: int) -> str:
    """Name of an area's frame."""
    return f"area_{area}"


def area_from_frame(frame: str) -> int:
    """The area of an area's frame.

    :raises HmtSlamError: for any other frame.
    """
    return int(_match_frame(_AREA_FRAME, frame)[1])


def keyframe_frame(keyframe: int, reset_number: int = 0, system: str = "") -> str:
    """Name of a keyframe's frame.

    :param reset_number: number of the last reset, 0 before the first.
    :param system: name of the sender's system, empty where it has none.
    """
    reset = f"/reset_{reset_number}" if reset_number else ""
    return f"keyframe_{keyframe}{reset}{_system_suffix(system)}"


def keyframe_from_frame(frame: str) -> tuple[int, int, str]:
    """The keyframe, the reset number and the name of the sender's system of a keyframe's frame.

    :raises HmtSlamError: for any other frame.
    """
    match = _match_frame(_KEYFRAME_FRAME, frame)
    return int(match[1]), int(match[2] or 0), match[3] or ""


def _system_suffix(system: str) -> str:
    return f"/system_{system}" if system else ""


def path_message(scan_poses: ScanPoses, system: str = "") -> Path:
    """Scan poses as a path, every pose in the frame of its keyframe.

    :param system: name of the sender's system, empty where it has none.
    """
    rows = zip(scan_poses.stamps.tolist(), scan_poses.keyframes.tolist(), scan_poses.poses, strict=True)
    poses = [
        PoseStamped(header=header_message(stamp, keyframe_frame(keyframe)), pose=pose_message(pose))
        for stamp, keyframe, pose in rows
    ]
    stamp = int(scan_poses.stamps[0]) if scan_poses.stamps.size else 0
    frame = f"hypothesis_{scan_poses.hypothesis}/scan_{scan_poses.first_scan}{_system_suffix(system)}"
    return Path(header=header_message(stamp, frame), poses=poses)


def scan_poses_from_message(message: Path, admit: Callable[[str], None] = lambda _: None) -> ScanPoses:
    """The inverse of :func:`path_message`.

    :param admit: called with the name of the sender's system; raises an error to refuse the message.
    :raises HmtSlamError: for other names of frames.
    """
    match = _match_frame(_SCAN_POSES_FRAME, message.header.frame_id)
    admit(match[3] or "")
    return ScanPoses(
        int(match[1]),
        int(match[2]),
        np.array([stamp_from_time(pose.header.stamp) for pose in message.poses], dtype=np.int64),
        np.array([keyframe_from_frame(pose.header.frame_id)[0] for pose in message.poses], dtype=np.int64),
        np.array([pose_from_message(pose.pose) for pose in message.poses], dtype=np.float64).reshape(-1, 3),
    )


def _match_frame(pattern: re.Pattern[str], frame: str) -> re.Match[str]:
    match = pattern.fullmatch(frame)
    if match is None:
        raise HmtSlamError(
            f"frame '{shorten(frame)}' is not of the form {pattern.pattern}: run the same version everywhere"
        )
    return match


def cost_message(name: str, system: str, costs: Sequence[tuple[int, float]]) -> Float64MultiArray:
    """Rows of (stamp in s, its rest in ns, seconds of computing); one float64 cannot hold a stamp exactly.

    :param name: of the node.
    :param system: name of its system, empty where it has none.
    :param costs: (stamp of a scan, ns, seconds of computing).
    """
    rows = [(*divmod(stamp, NANOSECONDS), seconds) for stamp, seconds in costs]
    return table_message(f"{name}{_system_suffix(system)}", ("stamp_sec", "stamp_nanosec", "seconds"), rows)


def costs_from_message(
    message: Float64MultiArray, admit: Callable[[str], None] = lambda _: None
) -> tuple[str, NDArray[np.float64]]:
    """The name of the node, and its rows, shape (n, 3): the inverse of :func:`cost_message`.

    :param admit: called with the name of the sender's system; raises an error to refuse the message.
    :raises HmtSlamError: for another table, or numbers that are no costs.
    """
    match = _match_frame(_COST_LABEL, message.layout.dim[0].label if message.layout.dim else "")
    admit(match[2] or "")
    data = np.array(message.data, dtype=np.float64)
    if data.size % 3 or not ((data >= 0.0) & (data < MAX_STAMP / NANOSECONDS)).all():
        raise HmtSlamError(f"a table of {data.size} numbers holds no costs: run the same version everywhere")
    return match[1], data.reshape(-1, 3)


def table_message(label: str, columns: Sequence[str], rows: Sequence[Sequence[float]]) -> Float64MultiArray:
    """Table of numbers; the labels of its two dimensions are ``label`` and the names of the columns."""
    width = len(columns)
    layout = [
        MultiArrayDimension(label=label, size=len(rows), stride=width * len(rows)),
        MultiArrayDimension(label=",".join(columns), size=width, stride=width),
    ]
    data = array("d", [value for row in rows for value in row])
    return Float64MultiArray(layout=MultiArrayLayout(dim=layout), data=data)
