"""What is gathered from a log or from running topics, as arrays, before anything is judged."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.logs.bag import (
    DEFAULT_ODOM_TOPIC,
    DEFAULT_SCAN_TOPIC,
    choose_odom_topic,
    choose_scan_topic,
    read_header,
    read_messages,
    read_topics,
)
from hmt_slam_ros.logs.mounting import frame_name, transform_from_quaternion
from hmt_slam_ros.logs.ros_types import ODOMETRY, TRANSFORMS, RosMessage, deserialize

_NANOSECOND = 1e-9


class BeamCounts(NamedTuple):
    """How many beams of a scan are what; shape (n,) each, over n scans.

    :ivar beams: all of them.
    :ivar returns: with a return.
    :ivar nan: not a number.
    :ivar infinite: inf of either sign.
    :ivar near: finite, and below the least range.
    :ivar far: finite, and at or beyond the largest range.
    """

    beams: Int64
    returns: Int64
    nan: Int64
    infinite: Int64
    near: Int64
    far: Int64


class BeamStatistics(NamedTuple):
    """What each of the b beams of a laser saw, over the scans that have as many beams as the first.

    :ivar returns: shape (b,), with how many returns.
    :ivar nearest: shape (b,), the nearest of them, m.
    :ivar farthest: shape (b,), the farthest of them, m.
    """

    returns: Int64
    nearest: Float64
    farthest: Float64


@dataclass(frozen=True, eq=False)
class ScanStatistics:
    """All scans.

    :ivar source_stamps: shape (n,), the source's own stamps, ns, in the order of arrival.
    :ivar stamps: shape (n,), on the running clock of `LogRecord`, ns.
    :ivar geometry: shape (n, 5): first angle, increment, rad; least and largest range, m; time from beam to beam, s.
    :ivar laser_poses: shape (n, 3), ``base_T_laser``, m and rad.
    :ivar counts: of beams.
    :ivar beam_statistics: of the laser.
    :ivar sweep_fault_count: scans whose time from beam to beam cannot be.
    :ivar first_sweep_fault: what is said of the first of them.
    """

    source_stamps: Int64
    stamps: Int64
    geometry: Float64
    laser_poses: Float64
    counts: BeamCounts
    beam_statistics: BeamStatistics
    sweep_fault_count: int
    first_sweep_fault: str


@dataclass(frozen=True, eq=False)
class OdometryStatistics:
    """All odometry readings.

    :ivar source_stamps: shape (m,), the source's own stamps, ns, in the order of arrival.
    :ivar stamps: shape (m,), on the running clock, ns.
    :ivar poses: shape (m, 3), ``odom_T_base``, m and rad, finite.
    :ivar non_finite_count: readings that were left out since they are not.
    """

    source_stamps: Int64
    stamps: Int64
    poses: Float64
    non_finite_count: int

    @property
    def distance(self) -> float:
        """Length of the path, m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum()) if len(self.poses) else 0.0

    def poses_at(self, stamps: Float64) -> Float64:
        """Poses (k, 3) at any stamps (k,), ns: between two readings in proportion, before and after all as those.

        Headings are unwrapped.
        """
        times = (self.stamps - self.stamps[0]).astype(np.float64)
        wanted = stamps - float(self.stamps[0])
        x, y, heading = self.poses[:, 0], self.poses[:, 1], np.unwrap(self.poses[:, 2])
        return np.stack([np.interp(wanted, times, part) for part in (x, y, heading)], axis=1)


@dataclass(frozen=True, eq=False)
class ScanMotions:
    """The robot's motion from scan to scan as the scans alone have it.

    :ivar starts: shape (p,), stamps, ns.
    :ivar ends: shape (p,), likewise.
    :ivar motions: shape (p, 3), ``start_T_end``, m and rad.
    :ivar information: shape (p, 3, 3), of the motion in the frame of its end; small where scans show nothing.
    :ivar matched: shape (p,), share of the points of one scan that meet a wall of the other.
    """

    starts: Int64
    ends: Int64
    motions: Float64
    information: Float64
    matched: Float64

    def select(self, chosen: Bool | Int64) -> ScanMotions:
        """Some of them."""
        return ScanMotions(
            self.starts[chosen], self.ends[chosen], self.motions[chosen], self.information[chosen], self.matched[chosen]
        )


class FrameTransform(NamedTuple):
    """A transform as it was heard.

    :ivar parent: frame.
    :ivar child: frame.
    :ivar topic: on which.
    :ivar first_transform: shape (4, 4), ``parent_T_child`` of the first message, m.
    :ivar message_count: how many.
    :ivar max_change: largest distance of any from the first, m, or m of a point at 1 m for a rotation.
    """

    parent: str
    child: str
    topic: str
    first_transform: NDArray[np.float64]
    message_count: int
    max_change: float


class ScanHeader(NamedTuple):
    """What a LaserScan message says of itself and `Scan` does not keep.

    :ivar frame: its frame.
    :ivar angle_min: rad.
    :ivar angle_max: rad.
    :ivar angle_increment: rad.
    :ivar beams: how many.
    """

    frame: str
    angle_min: float
    angle_max: float
    angle_increment: float
    beams: int


@dataclass(frozen=True, eq=False)
class MessageStatistics:
    """What only messages tell, as opposed to a log of another format.

    :ivar counts: messages by topic.
    :ivar types: of the topics.
    :ivar scan_headers: scans that differ in what they say of themselves, each once, with how many there are.
    :ivar odometry_frames: (frame, child frame) of the odometry; the transform's where there is no topic of it.
    :ivar transforms: all transforms.
    """

    counts: dict[str, int]
    types: dict[str, str]
    scan_headers: dict[ScanHeader, int]
    odometry_frames: tuple[str, str]
    transforms: tuple[FrameTransform, ...]


@dataclass(frozen=True, eq=False)
class Statistics:
    """All that was gathered.

    :ivar name: of the log.
    :ivar scans: all of them.
    :ivar odometry: all readings.
    :ivar motions: from scan to scan.
    :ivar messages: where there are some.
    """

    name: str
    scans: ScanStatistics
    odometry: OdometryStatistics
    motions: ScanMotions
    messages: MessageStatistics | None = field(default=None)

    @property
    def duration(self) -> float:
        """From the first to the last stamp on the running clock, s."""
        stamps = np.concatenate((self.scans.stamps, self.odometry.stamps))
        return float(stamps.max() - stamps.min()) * _NANOSECOND if stamps.size else 0.0


def seconds_between(stamps: Int64) -> Float64:
    """From each stamp to the next, s, shape (n - 1,)."""
    return np.diff(stamps) * _NANOSECOND


class TransformCollector:
    """Collects transforms."""

    def __init__(self) -> None:
        self._first_transforms: dict[tuple[str, str, str], NDArray[np.float64]] = {}
        self._message_counts: Counter[tuple[str, str, str]] = Counter()
        self._max_changes: dict[tuple[str, str, str], float] = {}

    @property
    def transforms(self) -> tuple[FrameTransform, ...]:
        """All of them."""
        return tuple(
            FrameTransform(*key[:2], key[2], first, self._message_counts[key], self._max_changes[key])
            for key, first in self._first_transforms.items()
        )

    def add(self, topic: str, message: RosMessage) -> None:
        """Take in a tf2_msgs/TFMessage."""
        for joint in message.transforms:
            key = (frame_name(joint.header.frame_id), frame_name(joint.child_frame_id), topic)
            move, turn = joint.transform.translation, joint.transform.rotation
            transform = transform_from_quaternion((move.x, move.y, move.z), (turn.x, turn.y, turn.z, turn.w))
            first = self._first_transforms.setdefault(key, transform)
            self._message_counts[key] += 1
            self._max_changes[key] = max(self._max_changes.get(key, 0.0), float(np.abs(transform - first).max()))


def read_message_statistics(path: Path) -> MessageStatistics:
    """Read a bag that `open_log` took."""
    types = read_topics(path)
    scan_topic = choose_scan_topic(types, DEFAULT_SCAN_TOPIC, path.name)
    odom_topic = choose_odom_topic(types, DEFAULT_ODOM_TOPIC, path.name)
    heads = Counter(read_scan_header(message.content) for message in read_messages(path, {scan_topic}))
    joints = TransformCollector()
    for topic in ("/tf_static", "/tf"):
        for message in read_messages(path, {topic}):
            if message.kind == TRANSFORMS:
                joints.add(topic, deserialize(message.content, TRANSFORMS))
    return MessageStatistics(
        _message_counts(path), types, dict(heads), _odometry_frames(path, odom_topic, joints), joints.transforms
    )


def _message_counts(path: Path) -> dict[str, int]:
    with Reader(path) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


def _odometry_frames(path: Path, topic: str | None, joints: TransformCollector) -> tuple[str, str]:
    if topic is not None:
        for message in read_messages(path, {topic}):
            reading = deserialize(message.content, ODOMETRY)
            return frame_name(reading.header.frame_id), frame_name(reading.child_frame_id)
    child = next((joint.child for joint in joints.transforms if joint.parent == "odom"), "")
    return "odom", child


def read_scan_header(content: bytes) -> ScanHeader:
    """What a LaserScan (CDR) says of itself, without reading its ranges."""
    order = "<" if content[1] & 1 else ">"
    frame = read_header(content).frame
    (length,) = struct.unpack_from(order + "I", content, 12)
    # CDR aligns to four bytes, counted from behind its own header of four.
    at = -(-(16 + length) // 4) * 4
    first, last, increment, *_, beams = struct.unpack_from(order + "7fI", content, at)
    return ScanHeader(frame_name(frame), first, last, increment, beams)
