"""What only ROS messages have: topics, headers, frames and transforms, and the checks on them."""

from __future__ import annotations

import math
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.doctor.finding import Finding
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.bag import (
    DEFAULT_ODOM_TOPIC,
    DEFAULT_SCAN_TOPIC,
    choose_odom_topic,
    choose_scan_topics,
    read_header,
)
from hmt_slam_ros.logs.bag_files import count_messages, read_messages, read_topics
from hmt_slam_ros.logs.mounting import frame_name, transform_from_message
from hmt_slam_ros.logs.ros_types import ODOMETRY, TRANSFORMS, RosMessage, deserialize

_MAX_TILT = math.radians(2.0)
"""Tilt from which a laser measures other ranges than those of the floor plan, rad. Beyond 10 degrees it is refused."""

_MAX_STATIC_CHANGE = 0.01
"""Change of a static transform, as the displacement of a point at 1 m, m."""


class FrameTransform(NamedTuple):
    """All messages of one transform.

    :ivar parent: parent frame.
    :ivar child: child frame.
    :ivar topic: topic of the messages.
    :ivar first_transform: shape (4, 4), ``parent_T_child`` of the first message, m.
    :ivar message_count: number of messages.
    :ivar max_change: largest change of an element against the first message, m, and at 1 m for a rotation.
    """

    parent: str
    child: str
    topic: str
    first_transform: NDArray[np.float64]
    message_count: int
    max_change: float


class ScanHeader(NamedTuple):
    """Fields of a LaserScan message, some of which `Scan` does not have.

    :ivar frame: frame of the laser.
    :ivar angle_min: angle of the first beam, rad.
    :ivar angle_max: angle of the last beam, rad.
    :ivar angle_increment: angle between beams, rad.
    :ivar beams: number of beams.
    """

    frame: str
    angle_min: float
    angle_max: float
    angle_increment: float
    beams: int


@dataclass(frozen=True, eq=False)
class MessageStatistics:
    """Statistics of ROS messages; logs of other formats have none.

    :ivar counts: {topic: number of messages}.
    :ivar types: {topic: message type}.
    :ivar scan_headers: {header: number of scans that have it}.
    :ivar odometry_frames: (frame, child frame) of the odometry; the transform's where there is no topic of it.
    :ivar transforms: all transforms.
    """

    counts: dict[str, int]
    types: dict[str, str]
    scan_headers: dict[ScanHeader, int]
    odometry_frames: tuple[str, str]
    transforms: tuple[FrameTransform, ...]


class TransformCollector:
    """Counts the messages of each transform and compares them with the first."""

    def __init__(self) -> None:
        self._first_transforms: dict[tuple[str, str, str], NDArray[np.float64]] = {}
        self._message_counts: Counter[tuple[str, str, str]] = Counter()
        self._max_changes: dict[tuple[str, str, str], float] = {}

    @property
    def transforms(self) -> tuple[FrameTransform, ...]:
        """The transforms, in the order of their first messages."""
        return tuple(
            FrameTransform(*key, first, self._message_counts[key], self._max_changes[key])
            for key, first in self._first_transforms.items()
        )

    def add(self, topic: str, message: RosMessage) -> None:
        """Add a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            key = (frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id), topic)
            try:
                transform = transform_from_message(stamped.transform)
            except HmtSlamError:  # opening the log refused or left it out
                continue
            first = self._first_transforms.setdefault(key, transform)
            self._message_counts[key] += 1
            self._max_changes[key] = max(self._max_changes.get(key, 0.0), float(np.abs(transform - first).max()))


def read_message_statistics(path: Path, scan_topics: str = DEFAULT_SCAN_TOPIC) -> MessageStatistics:
    """The statistics of the messages of a bag.

    :param scan_topics: topics of the scans, separated by commas.
    :raises HmtSlamError: where the bag is damaged.
    """
    types = read_topics(path)
    scans = set(choose_scan_topics(types, scan_topics, path.name))
    odom_topic = choose_odom_topic(types, DEFAULT_ODOM_TOPIC, path.name)
    headers = Counter(read_scan_header(message.content) for message in read_messages(path, scans))
    collector = TransformCollector()
    for topic in ("/tf_static", "/tf"):
        for message in read_messages(path, {topic}):
            if message.kind == TRANSFORMS:
                collector.add(topic, deserialize(message.content, TRANSFORMS))
    return MessageStatistics(
        count_messages(path),
        types,
        dict(headers),
        _odometry_frames(path, odom_topic, collector.transforms),
        collector.transforms,
    )


def _odometry_frames(path: Path, topic: str | None, transforms: tuple[FrameTransform, ...]) -> tuple[str, str]:
    if topic is not None:
        for message in read_messages(path, {topic}):
            reading = deserialize(message.content, ODOMETRY)
            return frame_name(reading.header.frame_id), frame_name(reading.child_frame_id)
    child = next((transform.child for transform in transforms if transform.parent == "odom"), "")
    return "odom", child


def read_scan_header(content: bytes) -> ScanHeader:
    """The header of a LaserScan message in CDR, without its ranges."""
    order = "<" if content[1] & 1 else ">"
    frame = read_header(content).frame
    (length,) = struct.unpack_from(order + "I", content, 12)
    # CDR aligns to four bytes, counted from the end of its own header of four bytes.
    offset = -(-(16 + length) // 4) * 4
    first, last, increment, *_, beams = struct.unpack_from(order + "7fI", content, offset)
    return ScanHeader(frame_name(frame), first, last, increment, beams)


def frame_findings(messages: MessageStatistics) -> Iterator[Finding]:
    """Findings on frames and transforms."""
    yield from _check_names(messages)
    yield from _check_parents(messages)
    yield from _check_static(messages)
    yield from _check_tilt(messages)
    yield from _check_map_to_odom(messages)
    yield from _check_odometry_transform(messages)
    odom, base = messages.odometry_frames
    frames = ", ".join(sorted({header.frame for header in messages.scan_headers}))
    yield Finding("fine", "frames", f"Odometry is {odom} -> {base}, scans are in {frames}.")


def _check_names(messages: MessageStatistics) -> Iterator[Finding]:
    odom, base = messages.odometry_frames
    if not base:
        text = "The odometry has no child_frame_id: set it to the robot's frame, such as base_link."
        yield Finding("doubtful", "odometry frames", text)
    if odom and odom in {base, "map"}:
        text = f"The odometry is given in the frame {odom!r}: its header's frame should be odom (REP 105)."
        yield Finding("doubtful", "odometry frames", text)
    if any(not header.frame for header in messages.scan_headers):
        text = "Scans have an empty frame_id: set the frame of the laser in its driver, such as laser."
        yield Finding("wrong", "scan frame", text)


def _check_parents(messages: MessageStatistics) -> Iterator[Finding]:
    parents: dict[str, set[str]] = defaultdict(set)
    for transform in messages.transforms:
        parents[transform.child].add(transform.parent)
    for child, names in parents.items():
        if len(names) > 1:
            text = (
                f"The frame {child!r} has the parents {' and '.join(sorted(names))}: a frame has one parent; stop one "
                "of the publishers (robot_state_publisher, static_transform_publisher, a driver, another SLAM)."
            )
            yield Finding("wrong", "two parents", text)


def _check_static(messages: MessageStatistics) -> Iterator[Finding]:
    for transform in messages.transforms:
        if transform.topic.endswith("tf_static") and transform.max_change > _MAX_STATIC_CHANGE:
            text = (
                f"The transform {transform.parent} -> {transform.child} on {transform.topic} changes by "
                f"{transform.max_change:.3f} m though it is static: the first one is believed; look for a second "
                "publisher."
            )
            yield Finding("doubtful", "static transform moves", text)


def _check_tilt(messages: MessageStatistics) -> Iterator[Finding]:
    scan_frames = {header.frame for header in messages.scan_headers}
    for transform in messages.transforms:
        tilt = math.acos(min(1.0, abs(float(transform.first_transform[2, 2]))))
        if transform.child in scan_frames and tilt > _MAX_TILT:
            text = (
                f"The transform {transform.parent} -> {transform.child} is tilted by {math.degrees(tilt):.1f} degrees: "
                "the laser should be level, so that it sees walls and not the floor."
            )
            yield Finding("doubtful", "tilted", text)


def _check_map_to_odom(messages: MessageStatistics) -> Iterator[Finding]:
    """A finding where another program publishes the transform that rtl publishes."""
    odom, _ = messages.odometry_frames
    transform = next((transform for transform in messages.transforms if transform.child == odom), None)
    if transform is not None:
        text = (
            f"There are transforms {transform.parent} -> {transform.child} of another SLAM or localization: stop it, "
            "or leave them away when the bag is played for the nodes, since rtl publishes the same."
        )
        yield Finding("doubtful", "map -> odom", text)


def _check_odometry_transform(messages: MessageStatistics) -> Iterator[Finding]:
    """A finding where the transforms lead from the robot's frame up to another one than that of the odometry."""
    odom, base = messages.odometry_frames
    above, new = {base}, {base}
    while new:
        new = {transform.parent for transform in messages.transforms if transform.child in new} - above
        above |= new
    if len(above) > 1 and odom not in {"", base, "map", *above}:
        text = (
            f"The odometry is that of {odom!r} -> {base!r}, and transforms lead from {base!r} up to "
            f"{' and '.join(sorted(above - {base}))}, so that map -> {odom} of rtl does not lead to the robot: give "
            "both one name."
        )
        yield Finding("wrong", "frames contradict", text)
