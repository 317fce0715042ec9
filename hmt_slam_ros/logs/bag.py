"""rosbag2 recordings, mcap or sqlite3, read without a ROS installation."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mounting import FrameTree, Mounting, frame_name, heading_from_quaternion, planar_mounting
from hmt_slam_ros.logs.records import LogRecord, TimeWindow, require_scans
from hmt_slam_ros.logs.ros_types import (
    GROUND_TRUTH_TOPIC,
    LASER_SCAN,
    ODOMETRY,
    POSE,
    TRANSFORMS,
    RosMessage,
    deserialize,
)
from hmt_slam_ros.logs.stamps import NANOSECONDS, running_stamps
from hmt_slam_ros.sensors import Odometry, Scan

DEFAULT_SCAN_TOPIC, DEFAULT_ODOM_TOPIC = "/scan", "/odom"
"""Topics of scans and odometry where the user names none."""

_ODOM_FRAME, _BASE_FRAME = "odom", "base_link"
"""Frame of the odometry (REP 105), and the robot's frame where the odometry has no child frame."""


class BagMessage(NamedTuple):
    """A serialized message: its bag time, ns, its type, and its bytes in CDR."""

    bag_time: int
    kind: str
    content: bytes


class Header(NamedTuple):
    """The header of a message: its stamp, ns, and its frame."""

    stamp: int
    frame: str


def read_header(content: bytes) -> Header:
    """The header at the beginning of a message, without deserializing the rest."""
    order = "<" if content[1] & 1 else ">"
    seconds, nanoseconds, length = struct.unpack_from(order + "iII", content, 4)
    return Header(seconds * NANOSECONDS + nanoseconds, content[16 : 15 + length].decode())


def read_topics(path: Path) -> dict[str, str]:
    """{topic: message type} of a bag.

    :raises HmtSlamError: where the bag cannot be opened.
    """
    with _damage_as_error(path), Reader(path) as reader:
        return {connection.topic: connection.msgtype for connection in reader.connections}


def read_messages(path: Path, topics: Collection[str]) -> Iterator[BagMessage]:
    """The messages of some topics in the order of their bag times; of equal bag times, scans come last.

    :raises HmtSlamError: where the bag is damaged.
    """
    with _damage_as_error(path), Reader(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return
        messages = (
            BagMessage(bag_time, connection.msgtype, bytes(content))
            for connection, bag_time, content in reader.messages(connections)
        )
        for _, simultaneous in groupby(messages, key=lambda message: message.bag_time):
            yield from sorted(simultaneous, key=lambda message: message.kind == LASER_SCAN)


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    """A context that turns any exception of the rosbags library into one sentence."""
    try:
        yield
    except HmtSlamError:
        raise
    except Exception as error:
        cause = str(error).strip().rstrip(".") or type(error).__name__
        raise HmtSlamError(
            f"{path} is no complete rosbag2, truncated or damaged ({cause}): copy or record it anew, "
            "or repair it with 'ros2 bag reindex'."
        ) from error


def choose_scan_topic(topics: Mapping[str, str], wanted: str, name: str) -> str:
    """The topic of the scans: the wanted one, or the only one of its type where the default is missing.

    :param topics: {topic: message type}.
    :param wanted: topic that the user wants.
    :param name: name of the bag, for error messages.
    :raises HmtSlamError: where there is none, or more than one to choose from.
    """
    found = _choose_topic(topics, wanted, DEFAULT_SCAN_TOPIC, LASER_SCAN, name)
    if found is None:
        raise HmtSlamError(f"{name} has no topic of type {LASER_SCAN}: record the laser's scans in it.")
    return found


def choose_odom_topic(topics: Mapping[str, str], wanted: str, name: str) -> str | None:
    """The topic of the odometry, as in `choose_scan_topic`; None where only /tf has odometry.

    :raises HmtSlamError: where there is neither, or more than one to choose from.
    """
    found = _choose_topic(topics, wanted, DEFAULT_ODOM_TOPIC, ODOMETRY, name)
    if found is None and topics.get("/tf") != TRANSFORMS:
        raise HmtSlamError(f"{name} has neither a topic of type {ODOMETRY} nor /tf: record the wheel odometry in it.")
    return found


def _choose_topic(topics: Mapping[str, str], wanted: str, default: str, kind: str, name: str) -> str | None:
    of_kind = sorted(topic for topic, topic_kind in topics.items() if topic_kind == kind)
    if wanted in of_kind:
        return wanted
    choice = f"choose one of {', '.join(of_kind)}." if of_kind else f"it has no topic of type {kind}."
    if wanted in topics:
        raise HmtSlamError(f"topic {wanted} of {name} is of type {topics[wanted]}, not {kind}: {choice}")
    if wanted != default or len(of_kind) > 1:
        raise HmtSlamError(f"{name} has no topic {wanted}: {choice}")
    return of_kind[0] if of_kind else None


class _Measurement(NamedTuple):
    """A serialized scan or odometry reading.

    :ivar bag_time: bag time, ns.
    :ivar source_stamp: stamp of its header, ns.
    :ivar scan_frame: frame of a scan, None for odometry.
    :ivar content: bytes of the message, or the transform that replaces an odometry reading.
    """

    bag_time: int
    source_stamp: int
    scan_frame: str | None
    content: RosMessage


class BagLog:
    """A rosbag2 whose scans are read from disk when they are needed; the attributes are those of `Log`.

    Opening reads the whole bag once, which reveals damage. The source stamp of a record is that of its header. Records
    have the order of their bag times; of equal bag times, odometry comes before the scan.

    :param path: a bag folder, or a .mcap or .db3 file.
    :param window: part of the log to read.
    :param scan_topic: topic of the scans; the only LaserScan topic where the default does not exist.
    :param odom_topic: topic of the odometry, chosen likewise; without any, the transform odom -> base on /tf.
    :raises HmtSlamError: where the bag is truncated or damaged, or lacks scans, odometry or the laser's transform.
    """

    def __init__(self, path: Path, window: TimeWindow, scan_topic: str, odom_topic: str) -> None:
        self._path = path
        self.name = path.stem if path.is_file() else path.name
        topics = read_topics(path)
        self._scan_topic = choose_scan_topic(topics, scan_topic, path.name)
        self._odom_topic = choose_odom_topic(topics, odom_topic, path.name)
        self._base_frame = self._find_base_frame()
        headers = [measurement[:3] for measurement in self._read_measurements()]
        is_scan = [frame is not None for _, _, frame in headers]
        self._stamps = running_stamps([stamp for _, stamp, _ in headers], is_scan, _precedes_its_scan(headers))
        self._records_in_window = window.select(self._stamps)
        self.scan_count = sum(is_scan[self._records_in_window])
        require_scans(path.name, self.scan_count, sum(is_scan))
        part = self._stamps[self._records_in_window]
        self.duration = float(part[-1] - part[0]) / NANOSECONDS
        self._true_poses = self._read_true_poses(topics)
        self._mountings = self._find_mountings(sorted({frame for _, _, frame in headers if frame is not None}))

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        for k, measurement in enumerate(self._read_measurements()):
            if k >= self._records_in_window.stop:
                return
            if k >= self._records_in_window.start:
                yield self._make_record(measurement, int(self._stamps[k]))

    def _read_true_poses(self, topics: Mapping[str, str]) -> dict[int, NDArray[np.float64]]:
        """{source stamp, ns: true pose, shape (3,)}, {} where the bag has no ground truth."""
        if topics.get(GROUND_TRUTH_TOPIC) != POSE:
            return {}
        messages = (deserialize(message.content, POSE) for message in read_messages(self._path, {GROUND_TRUTH_TOPIC}))
        return {_stamp(message.header): _pose_from_message(message.pose) for message in messages}

    def _make_record(self, measurement: _Measurement, stamp: int) -> LogRecord:
        truth = self._true_poses.get(measurement.source_stamp)
        if measurement.scan_frame is not None:
            message = deserialize(measurement.content, LASER_SCAN)
            scan = _scan_from_message(message, stamp, self._mountings[measurement.scan_frame])
            return LogRecord(measurement.source_stamp, scan, truth)
        if self._odom_topic is None:
            transform = measurement.content
            pose = _pose_from_parts(transform.translation, transform.rotation)
        else:
            pose = _pose_from_message(deserialize(measurement.content, ODOMETRY).pose.pose)
        return LogRecord(measurement.source_stamp, Odometry(stamp, pose), truth)

    def _read_measurements(self) -> Iterator[_Measurement]:
        for message in read_messages(self._path, {self._scan_topic, self._odom_topic or "/tf"}):
            if message.kind == TRANSFORMS:
                yield from self._odometry_transforms(message)
            else:
                stamp, frame = read_header(message.content)
                scan_frame = frame_name(frame) if message.kind == LASER_SCAN else None
                yield _Measurement(message.bag_time, stamp, scan_frame, message.content)

    def _odometry_transforms(self, message: BagMessage) -> Iterator[_Measurement]:
        for stamped in deserialize(message.content, TRANSFORMS).transforms:
            frames = (frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id))
            if frames == (_ODOM_FRAME, self._base_frame):
                yield _Measurement(message.bag_time, _stamp(stamped.header), None, stamped.transform)

    def _find_base_frame(self) -> str:
        """The robot's frame: the child frame of the odometry."""
        if self._odom_topic is not None:
            for message in read_messages(self._path, {self._odom_topic}):
                return frame_name(deserialize(message.content, ODOMETRY).child_frame_id) or _BASE_FRAME
            raise HmtSlamError(
                f"{self._path.name} has no message on {self._odom_topic}: record the wheel odometry in it."
            )
        for message in read_messages(self._path, {"/tf"}):
            for stamped in deserialize(message.content, TRANSFORMS).transforms:
                if frame_name(stamped.header.frame_id) == _ODOM_FRAME:
                    return frame_name(stamped.child_frame_id)
        raise HmtSlamError(
            f"{self._path.name} has neither a topic of type {ODOMETRY} nor a transform from {_ODOM_FRAME!r} on /tf: "
            "record the wheel odometry in it."
        )

    def _find_mountings(self, frames: list[str]) -> dict[str, Mounting]:
        """{scan frame: mounting}, from /tf_static, else from /tf."""
        mountings: dict[str, Mounting] = {}
        tree = FrameTree()
        for topic in ("/tf_static", "/tf"):
            for message in read_messages(self._path, {topic}):
                if len(mountings) == len(frames):
                    return mountings
                tree.add(deserialize(message.content, TRANSFORMS))
                if topic == "/tf":
                    self._look_up(frames, tree, mountings)
            self._look_up(frames, tree, mountings)
        for frame in frames:
            if frame not in mountings:
                raise HmtSlamError(
                    f"{self._path.name} has no transform from {self._base_frame!r} to the scans' frame {frame!r}: "
                    "record /tf_static with it."
                )
        return mountings

    def _look_up(self, frames: list[str], tree: FrameTree, mountings: dict[str, Mounting]) -> None:
        for frame in frames:
            base_T_laser = tree.lookup_transform(self._base_frame, frame)
            if frame not in mountings and base_T_laser is not None:
                mountings[frame] = planar_mounting(base_T_laser, f"the laser {frame!r} of {self._path.name}")


def _stamp(header: RosMessage) -> int:
    """The stamp of a header, ns."""
    return int(header.stamp.sec * NANOSECONDS + header.stamp.nanosec)


def _pose_from_message(pose: RosMessage) -> NDArray[np.float64]:
    """A geometry_msgs/Pose as (x, y, theta), shape (3,), m and rad."""
    return _pose_from_parts(pose.position, pose.orientation)


def _pose_from_parts(position: RosMessage, rotation: RosMessage) -> NDArray[np.float64]:
    heading = heading_from_quaternion((rotation.x, rotation.y, rotation.z, rotation.w))
    return np.array([position.x, position.y, heading])


def _precedes_its_scan(headers: list[tuple[int, int, str | None]]) -> list[bool]:
    """Whether each measurement is odometry directly before a scan with the same bag time and stamp."""
    pairs = [a[2] is None and b[2] is not None and a[:2] == b[:2] for a, b in pairwise(headers)]
    return [*pairs, False][: len(headers)]


def _scan_from_message(message: RosMessage, stamp: int, mounting: Mounting) -> Scan:
    ranges: NDArray[np.float32] = message.ranges
    return Scan(
        stamp,
        ranges,
        mounting.angle_sign * message.angle_min,
        mounting.angle_sign * message.angle_increment,
        message.range_min,
        message.range_max,
        mounting.laser_pose,
        message.time_increment,
    )
