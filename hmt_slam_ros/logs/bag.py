"""rosbag2 recordings, mcap or sqlite3, read without a ROS installation."""

from __future__ import annotations

import itertools
import struct
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import split_topics
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.bag_files import BagMessage, check_bag, read_messages, read_topics
from hmt_slam_ros.logs.mark_messages import mark_from_message
from hmt_slam_ros.logs.mounting import FrameTree, Mounting, frame_name, heading_from_quaternion, planar_mounting
from hmt_slam_ros.logs.records import LeftOut, LogRecord, TimeWindow, require_scans
from hmt_slam_ros.logs.ros_types import (
    GROUND_TRUTH_TOPIC,
    LASER_SCAN,
    ODOMETRY,
    POSE,
    POSE_WITH_COVARIANCE,
    TRANSFORMS,
    RosMessage,
    deserialize,
)
from hmt_slam_ros.logs.stamps import NANOSECONDS, running_stamps
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan
from hmt_slam_ros.sensors.plausibility import (
    MAX_COORDINATE,
    check_odometry,
    check_planar_pose,
    check_quaternion,
    check_scan,
)

DEFAULT_SCAN_TOPIC, DEFAULT_ODOM_TOPIC = "/scan", "/odom"
"""Topics of scans and odometry where the user names none."""

_ODOM_FRAME, _BASE_FRAME = "odom", "base_link"
"""Frame of the odometry (REP 105), and the robot's frame where the odometry has no child frame."""


class Header(NamedTuple):
    """The header of a message: its stamp, ns, and its frame."""

    stamp: int
    frame: str


def read_header(content: bytes) -> Header:
    """The header at the beginning of a message, without deserializing the rest."""
    order = "<" if content[1] & 1 else ">"
    seconds, nanoseconds, length = struct.unpack_from(order + "iII", content, 4)
    return Header(seconds * NANOSECONDS + nanoseconds, content[16 : 15 + length].decode())


def choose_scan_topics(topics: Mapping[str, str], wanted: str, name: str) -> tuple[str, ...]:
    """The topics of the scans: the wanted ones, or the only one of its type where the default is missing.

    :param topics: {topic: message type}.
    :param wanted: topics that the user wants, separated by commas; without a slash they are in the root namespace.
    :param name: name of the bag, for error messages.
    :raises HmtSlamError: where there is none, or more than one to choose from.
    """
    names = dict.fromkeys(f"/{topic.lstrip('/')}" for topic in split_topics(wanted))
    found = [_choose_topic(topics, topic, DEFAULT_SCAN_TOPIC, LASER_SCAN, name) for topic in names]
    if None in found:
        raise HmtSlamError(f"{name} has no topic of type {LASER_SCAN}: record the laser's scans in it.")
    return tuple(topic for topic in found if topic is not None)


def choose_odom_topic(topics: Mapping[str, str], wanted: str, name: str) -> str | None:
    """The topic of the odometry, as in `choose_scan_topics`; None where only /tf has odometry.

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
    """A scan or odometry reading as a message.

    :ivar bag_time: bag time, ns.
    :ivar source_stamp: stamp of its header, ns.
    :ivar scan_frame: frame of a scan, None for odometry.
    :ivar content: message of a scan, or position and rotation of an odometry reading.
    """

    bag_time: int
    source_stamp: int
    scan_frame: str | None
    content: RosMessage


class _BagMark(NamedTuple):
    """An observation of a mark, with its bag time, ns."""

    bag_time: int
    observation: MarkObservation


def _append_mark(marks: list[_BagMark], bag_time: int, message: RosMessage) -> None:
    """Append the observation of a message.

    :raises HmtSlamError: where it cannot be used.
    """
    marks.append(_BagMark(bag_time, mark_from_message(message)))


def _mark_record(observation: MarkObservation, offset: int) -> LogRecord:
    """The record of an observation.

    :param offset: running clock less the clock of the headers, ns.
    """
    return LogRecord(observation.stamp, replace(observation, stamp=observation.stamp + offset))


_MAX_LASERS, _MAX_FRAMES = 32, 2000
"""Frames of the scans of one topic, and of all transforms."""

_AT_THE_BASE = Mounting(np.zeros(3), 1.0)


class BagLog:
    """A rosbag2 whose scans are read from disk when they are needed; the attributes are those of
    `Log` and `PartialLog`.

    Opening reads the whole bag, which reveals damage and the measurements that no process may see. The source stamp of
    a record is that of its header. Records have the order of their bag times; of equal bag times, odometry comes before
    the scan.

    :param path: a bag folder, or a .mcap or .db3 file.
    :param window: part of the log to read.
    :param scan_topics: topics of the scans, separated by commas; the only LaserScan topic where the default does not
        exist.
    :param odom_topic: topic of the odometry, chosen likewise; without any, the transform odom -> base on /tf.
    :param marks_topic: topic of the observations of marks, empty for none.
    :raises HmtSlamError: where the bag is truncated or damaged, or lacks scans, odometry, marks or a laser's transform.
    """

    def __init__(
        self, path: Path, window: TimeWindow, scan_topics: str, odom_topic: str, marks_topic: str = ""
    ) -> None:
        check_bag(path)
        self._path = path
        self.left_out = LeftOut()
        self.name = path.stem if path.is_file() else path.name
        topics = read_topics(path)
        self._scan_topics = choose_scan_topics(topics, scan_topics, path.name)
        self._odom_topic = choose_odom_topic(topics, odom_topic, path.name)
        self._base_frame = self._find_base_frame()
        self._kept: list[bool] = []
        headers = []
        for measurement in self._read_measurements():
            self._kept.append(self.left_out.admits(partial(self._check, measurement)))
            if self._kept[-1]:
                headers.append(measurement[:3])
        is_scan = [frame is not None for _, _, frame in headers]
        self._stamps = running_stamps([stamp for _, stamp, _ in headers], is_scan, _precedes_its_scan(headers))
        self._records_in_window = window.select(self._stamps)
        self.scan_count = sum(is_scan[self._records_in_window])
        require_scans(path.name, self.scan_count, sum(is_scan), self.left_out)
        part = self._stamps[self._records_in_window]
        self.duration = float(part[-1] - part[0]) / NANOSECONDS
        self._true_poses = self._read_true_poses(topics)
        self._marks = self._read_marks(topics, marks_topic) if marks_topic else []
        self._mountings = self._find_mountings(sorted({frame for _, _, frame in headers if frame is not None}))

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order."""
        marks = deque(self._marks)
        for k, measurement in enumerate(itertools.compress(self._read_measurements(), self._kept)):
            if k >= self._records_in_window.stop:
                return
            stamp = int(self._stamps[k])
            while marks and marks[0].bag_time <= measurement.bag_time:
                mark = marks.popleft()
                if k >= self._records_in_window.start:
                    yield _mark_record(mark.observation, stamp - measurement.source_stamp)
            if k >= self._records_in_window.start:
                yield self._make_record(measurement, stamp)

    def _read_marks(self, topics: Mapping[str, str], topic: str) -> list[_BagMark]:
        """The observations of marks that can be used.

        :raises HmtSlamError: where the bag has no such topic.
        """
        if topics.get(topic) != POSE_WITH_COVARIANCE:
            found = ", ".join(sorted(one for one, kind in topics.items() if kind == POSE_WITH_COVARIANCE))
            raise HmtSlamError(
                f"{self._path.name} has no topic {topic} of type {POSE_WITH_COVARIANCE}: set marks.topic to "
                f"{found or 'nothing'}."
            )
        marks: list[_BagMark] = []
        for message in read_messages(self._path, {topic}):
            content = self._deserialize(message, POSE_WITH_COVARIANCE)
            self.left_out.admits(partial(_append_mark, marks, message.bag_time, content))
        return marks

    def _read_true_poses(self, topics: Mapping[str, str]) -> dict[int, NDArray[np.float64]]:
        """{source stamp, ns: true pose, shape (3,)}, {} where the bag has no ground truth."""
        if topics.get(GROUND_TRUTH_TOPIC) != POSE:
            return {}
        poses = {}
        for message in read_messages(self._path, {GROUND_TRUTH_TOPIC}):
            truth = self._deserialize(message, POSE)
            pose = poses[_stamp(truth.header)] = _pose_from_parts(truth.pose.position, truth.pose.orientation)
            check_planar_pose(pose, f"a pose on {GROUND_TRUTH_TOPIC} of {self._path.name}", MAX_COORDINATE)
        return poses

    def _deserialize(self, message: BagMessage, kind: str) -> RosMessage:
        """A message of the bag.

        :raises HmtSlamError: where it is damaged.
        """
        if message.kind != kind:
            raise HmtSlamError(
                f"{self._path.name} has a message of type {message.kind} where {kind} belongs: record it anew."
            )
        try:
            return deserialize(message.content, kind)
        except HmtSlamError as fault:
            raise HmtSlamError(f"in {self._path.name}, at {message.bag_time} ns, {fault}") from fault

    def _make_record(self, measurement: _Measurement, stamp: int) -> LogRecord:
        truth, source = self._true_poses.get(measurement.source_stamp), measurement.source_stamp
        if measurement.scan_frame is not None:
            mounting = self._mountings[measurement.scan_frame]
            message = measurement.content
            return LogRecord(source, _scan_from_message(message, stamp, mounting, message.time_increment), truth)
        position, rotation = measurement.content
        return LogRecord(source, Odometry(stamp, _pose_from_parts(position, rotation)), truth)

    def _check(self, measurement: _Measurement) -> None:
        """Check a measurement; the laser's pose is that of no message.

        :raises HmtSlamError: where no process may see it.
        """
        stamp = measurement.source_stamp
        if measurement.scan_frame is not None:
            # The time from beam to beam may be wrong, as in `check_measurement`.
            check_scan(_scan_from_message(measurement.content, stamp, _AT_THE_BASE, time_increment=0.0))
            return
        position, rotation = measurement.content
        check_quaternion((rotation.x, rotation.y, rotation.z, rotation.w))
        check_odometry(Odometry(stamp, _pose_from_parts(position, rotation)))

    def _read_measurements(self) -> Iterator[_Measurement]:
        for message in read_messages(self._path, {*self._scan_topics, self._odom_topic or "/tf"}):
            if message.kind == TRANSFORMS:
                yield from self._odometry_transforms(message)
            elif message.kind == LASER_SCAN:
                scan = self._deserialize(message, LASER_SCAN)
                yield _Measurement(message.bag_time, _stamp(scan.header), frame_name(scan.header.frame_id), scan)
            else:
                reading = self._deserialize(message, ODOMETRY)
                pose = reading.pose.pose
                yield _Measurement(message.bag_time, _stamp(reading.header), None, (pose.position, pose.orientation))

    def _odometry_transforms(self, message: BagMessage) -> Iterator[_Measurement]:
        for stamped in self._deserialize(message, TRANSFORMS).transforms:
            frames = (frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id))
            if frames == (_ODOM_FRAME, self._base_frame):
                parts = (stamped.transform.translation, stamped.transform.rotation)
                yield _Measurement(message.bag_time, _stamp(stamped.header), None, parts)

    def _find_base_frame(self) -> str:
        """The robot's frame: the child frame of the odometry."""
        if self._odom_topic is not None:
            for message in read_messages(self._path, {self._odom_topic}):
                return frame_name(self._deserialize(message, ODOMETRY).child_frame_id) or _BASE_FRAME
            raise HmtSlamError(
                f"{self._path.name} has no message on {self._odom_topic}: record the wheel odometry in it."
            )
        for message in read_messages(self._path, {"/tf"}):
            for stamped in self._deserialize(message, TRANSFORMS).transforms:
                if frame_name(stamped.header.frame_id) == _ODOM_FRAME:
                    return frame_name(stamped.child_frame_id)
        raise HmtSlamError(
            f"{self._path.name} has neither a topic of type {ODOMETRY} nor a transform from {_ODOM_FRAME!r} on /tf: "
            "record the wheel odometry in it."
        )

    def _find_mountings(self, frames: list[str]) -> dict[str, Mounting]:
        """{scan frame: mounting}, from /tf_static, else from /tf."""
        if len(frames) > _MAX_LASERS:
            raise HmtSlamError(
                f"{self._path.name} has scans of {len(frames)} frames, more than {_MAX_LASERS}: record one laser."
            )
        mountings: dict[str, Mounting] = {}
        tree = FrameTree()
        for topic in ("/tf_static", "/tf"):
            for message in read_messages(self._path, {topic}):
                if len(mountings) == len(frames):
                    return mountings
                size = tree.size
                self._add_transforms(tree, message, topic)
                if topic == "/tf" and tree.size > size:
                    self._look_up(frames, tree, mountings)
            self._look_up(frames, tree, mountings)
        for frame in frames:
            if frame not in mountings:
                raise HmtSlamError(
                    f"{self._path.name} has no transform from {self._base_frame!r} to the scans' frame {frame!r}: "
                    "record /tf_static with it."
                )
        return mountings

    def _add_transforms(self, tree: FrameTree, message: BagMessage, topic: str) -> None:
        """Add a message to the tree; one of /tf that cannot be right is left out, since others follow it.

        :raises HmtSlamError: where one of /tf_static cannot be right.
        """
        transforms = self._deserialize(message, TRANSFORMS)
        try:
            tree.add(transforms)
        except HmtSlamError as fault:
            if topic == "/tf_static":
                raise HmtSlamError(f"{self._path.name} has a transform on {topic} whose {fault}") from fault
        if tree.size > _MAX_FRAMES:
            raise HmtSlamError(f"{self._path.name} has transforms of more than {_MAX_FRAMES} frames: record fewer.")

    def _look_up(self, frames: list[str], tree: FrameTree, mountings: dict[str, Mounting]) -> None:
        for frame in frames:
            base_T_laser = tree.lookup_transform(self._base_frame, frame)
            if frame not in mountings and base_T_laser is not None:
                mountings[frame] = planar_mounting(base_T_laser, f"the laser {frame!r} of {self._path.name}")


def _stamp(header: RosMessage) -> int:
    """The stamp of a header, ns."""
    return int(header.stamp.sec * NANOSECONDS + header.stamp.nanosec)


def _pose_from_parts(position: RosMessage, rotation: RosMessage) -> NDArray[np.float64]:
    heading = heading_from_quaternion((rotation.x, rotation.y, rotation.z, rotation.w))
    return np.array([position.x, position.y, heading])


def _precedes_its_scan(headers: list[tuple[int, int, str | None]]) -> list[bool]:
    """Whether each measurement is odometry directly before a scan with the same bag time and stamp."""
    pairs = [a[2] is None and b[2] is not None and a[:2] == b[:2] for a, b in pairwise(headers)]
    return [*pairs, False][: len(headers)]


def _scan_from_message(message: RosMessage, stamp: int, mounting: Mounting, time_increment: float) -> Scan:
    ranges: NDArray[np.float32] = message.ranges
    return Scan(
        stamp,
        ranges,
        mounting.angle_sign * message.angle_min,
        mounting.angle_sign * message.angle_increment,
        message.range_min,
        message.range_max,
        mounting.laser_pose,
        time_increment,
    )
