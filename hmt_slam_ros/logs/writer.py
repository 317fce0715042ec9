"""Writes any log as a rosbag2."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mark_messages import message_covariance
from hmt_slam_ros.logs.mcap_file import write_checksums
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.logs.ros_types import (
    GROUND_TRUTH_TOPIC,
    LASER_SCAN,
    MARKS_TOPIC,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    TRANSFORMS,
    RosMessage,
    typestore,
)
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.own_files import ScratchFolder, replace_folder
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan

ODOM_FRAME, BASE_FRAME, LASER_FRAME, WORLD_FRAME = "odom", "base_link", "laser", "world"

_STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
"""{name of a storage: plug-in}."""

_NO_DEADLINE = QosTime(9223372036, 854775807)
"""The value of rosbag2 for "no deadline"."""


def write_bag(log: Log, destination: Path, *, storage: str = "mcap") -> None:
    """Write a log as a rosbag2 folder with /scan, /odom, /tf (odom -> base_link) and /tf_static (base_link -> laser).

    Where the log has true poses, /ground_truth has ``world_T_base`` at every scan and odometry reading. Where it
    has observations of marks, they are on /marks. The bag times
    are those of the running clock, so they never jump back. Each header has the source stamp, from which a reader gets
    the log's own stamps and the same running clock. Angles become float32, the type of the message. Each laser pose of
    a log has a frame: laser, laser_1 and so on.

    :raises HmtSlamError: where the folder exists or cannot be written; nothing is left behind.
    """
    if storage not in _STORAGES:
        raise HmtSlamError(f"storage {storage!r} is not known: choose one of {', '.join(_STORAGES)}.")
    target = destination.absolute()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = ScratchFolder(target, target.parent)
    except OSError as error:
        raise HmtSlamError(
            f"{target.parent} cannot be written to ({error.strerror}): make room, or choose another folder."
        ) from error
    try:
        # Only now, when what an earlier process left is gone.
        if destination.exists():
            raise HmtSlamError(f"{destination} exists already: choose another name or remove it first.")
        finished = scratch.path / target.name
        _write(log, finished, _STORAGES[storage])
        replace_folder(finished, target)
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error  # sqlite's faults have no strerror
        raise HmtSlamError(
            f"{destination} cannot be written ({reason}): make room, or choose another folder."
        ) from error
    finally:
        scratch.remove()


def _write(log: Log, folder: Path, storage: StoragePlugin) -> None:
    frames, further = _contents(log)
    writer = Writer(folder, version=9, storage_plugin=storage)
    if storage == StoragePlugin.MCAP:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    checksums: list[int] = []
    with writer:
        _collect_checksums(writer.storage, checksums)
        types = {"/scan": LASER_SCAN, "/odom": ODOMETRY, "/tf": TRANSFORMS, "/tf_static": TRANSFORMS, **further}
        connections = {
            topic: writer.add_connection(topic, kind, typestore=typestore(), offered_qos_profiles=[_qos(topic)])
            for topic, kind in types.items()
        }
        for topic, stamp, message in _messages(log.records(), frames):
            content = typestore().serialize_cdr(message, types[topic])
            writer.write(connections[topic], stamp, content)
    if storage == StoragePlugin.MCAP:
        write_checksums(folder / f"{folder.name}.mcap", checksums)


def _collect_checksums(storage: object, checksums: list[int]) -> None:
    """Append the CRC-32 of each chunk of an mcap file before it is compressed; the library writes none."""
    compress: Callable[[bytes], bytes] | None = getattr(storage, "compressor", None)
    if compress is None:  # sqlite3
        return

    def compress_checked(records: bytes) -> bytes:
        checksums.append(crc32(records))
        return compress(records)

    setattr(storage, "compressor", compress_checked)  # noqa: B010  it has no common type


def _qos(topic: str) -> Qos:
    static = topic == "/tf_static"
    durability = QosDurability.TRANSIENT_LOCAL if static else QosDurability.VOLATILE
    return Qos(
        QosHistory.KEEP_LAST,
        1 if static else 100,
        QosReliability.RELIABLE,
        durability,
        _NO_DEADLINE,
        _NO_DEADLINE,
        QosLiveliness.AUTOMATIC,
        _NO_DEADLINE,
        avoid_ros_namespace_conventions=False,
    )


def _contents(log: Log) -> tuple[dict[bytes, tuple[str, NDArray[np.float64]]], dict[str, str]]:
    """{bytes of a laser pose: (name of its frame, pose)}, in the order of first scans; {further topic: its type}."""
    frames: dict[bytes, tuple[str, NDArray[np.float64]]] = {}
    further: dict[str, str] = {}
    for record in log.records():
        if record.true_pose is not None:
            further[GROUND_TRUTH_TOPIC] = POSE
        if isinstance(record.measurement, Scan):
            pose = record.measurement.laser_pose
            frames.setdefault(pose.tobytes(), (f"{LASER_FRAME}_{len(frames)}" if frames else LASER_FRAME, pose))
        elif isinstance(record.measurement, MarkObservation):
            further[MARKS_TOPIC] = POSE_WITH_COVARIANCE
    return frames, further


def _messages(
    records: Iterable[LogRecord], frames: dict[bytes, tuple[str, NDArray[np.float64]]]
) -> Iterator[tuple[str, int, RosMessage]]:
    """Topic, bag time, ns, and message, in the order of the bag."""
    last_truth = None
    for k, record in enumerate(records):
        measurement, source = record.measurement, record.source_stamp
        if k == 0:
            transforms = [_transform(source, BASE_FRAME, frame, pose) for frame, pose in frames.values()]
            yield "/tf_static", measurement.stamp, _message(TRANSFORMS, transforms=transforms)
        if record.true_pose is not None and measurement.stamp != last_truth:
            last_truth = measurement.stamp
            pose = _pose(record.true_pose)
            yield GROUND_TRUTH_TOPIC, last_truth, _message(POSE, header=_header(source, WORLD_FRAME), pose=pose)
        if isinstance(measurement, Odometry):
            yield "/odom", measurement.stamp, _odometry(source, measurement)
            transforms = [_transform(source, ODOM_FRAME, BASE_FRAME, measurement.pose)]
            yield "/tf", measurement.stamp, _message(TRANSFORMS, transforms=transforms)
        elif isinstance(measurement, MarkObservation):
            yield MARKS_TOPIC, measurement.stamp, _mark(source, measurement)
        else:
            frame, _ = frames[measurement.laser_pose.tobytes()]
            yield "/scan", measurement.stamp, _laser_scan(source, measurement, frame)


def _message(kind: str, **fields: object) -> RosMessage:
    return typestore().types[kind](**fields)


def _header(stamp: int, frame: str) -> RosMessage:
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    time = _message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _vector(kind: str, x: float, y: float, z: float = 0.0) -> RosMessage:
    return _message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def _rotation(theta: float) -> RosMessage:
    sin, cos = float(np.sin(0.5 * theta)), float(np.cos(0.5 * theta))
    return _message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=sin, w=cos)


def _transform(stamp: int, parent: str, child: str, parent_T_child: NDArray[np.float64]) -> RosMessage:
    """A geometry_msgs/TransformStamped of the rosbags library for a planar pose (3,)."""
    x, y, theta = parent_T_child.tolist()
    transform = _message("geometry_msgs/msg/Transform", translation=_vector("Vector3", x, y), rotation=_rotation(theta))
    return _message(
        "geometry_msgs/msg/TransformStamped", header=_header(stamp, parent), child_frame_id=child, transform=transform
    )


def _odometry(stamp: int, reading: Odometry) -> RosMessage:
    still = _message(
        "geometry_msgs/msg/Twist", linear=_vector("Vector3", 0.0, 0.0), angular=_vector("Vector3", 0.0, 0.0)
    )
    return _message(
        ODOMETRY,
        header=_header(stamp, ODOM_FRAME),
        child_frame_id=BASE_FRAME,
        pose=_message("geometry_msgs/msg/PoseWithCovariance", pose=_pose(reading.pose), covariance=np.zeros(36)),
        twist=_message("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
    )


def _pose(pose: NDArray[np.float64]) -> RosMessage:
    """A geometry_msgs/Pose of a planar pose (3,)."""
    x, y, theta = pose.tolist()
    return _message("geometry_msgs/msg/Pose", position=_vector("Point", x, y), orientation=_rotation(theta))


def _mark(stamp: int, observation: MarkObservation) -> RosMessage:
    belief = _message(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=_pose(observation.pose.mean),
        covariance=message_covariance(observation.pose),
    )
    return _message(POSE_WITH_COVARIANCE, header=_header(stamp, observation.name), pose=belief)


def _laser_scan(stamp: int, scan: Scan, frame: str) -> RosMessage:
    count = scan.ranges.size
    return _message(
        LASER_SCAN,
        header=_header(stamp, frame),
        angle_min=scan.angle_min,
        angle_max=scan.angle_min + (count - 1) * scan.angle_increment,
        angle_increment=scan.angle_increment,
        time_increment=scan.time_increment,
        scan_time=0.0,
        range_min=scan.range_min,
        range_max=scan.range_max,
        ranges=scan.ranges,
        intensities=np.empty(0, dtype=np.float32),
    )
