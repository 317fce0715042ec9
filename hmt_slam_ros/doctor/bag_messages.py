"""What a rosbag2 tells beside its measurements: topics, frames, and what scans say of themselves."""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

from rosbags.rosbag2 import Reader

from hmt_slam_ros.doctor.joints import JointCollector
from hmt_slam_ros.doctor.statistics import Messages, ScanHead
from hmt_slam_ros.logs.bag_messages import (
    DEFAULT_ODOM_TOPIC,
    DEFAULT_SCAN_TOPIC,
    choose_odom_topic,
    choose_scan_topic,
    header_of,
    read_messages,
    read_topics,
)
from hmt_slam_ros.logs.ros_types import ODOMETRY, TRANSFORMS, deserialize
from hmt_slam_ros.logs.transforms import frame_name


def messages_of_bag(path: Path) -> Messages:
    """Read a bag that `open_log` took."""
    types = read_topics(path)
    scan_topic = choose_scan_topic(types, DEFAULT_SCAN_TOPIC, path.name)
    odom_topic = choose_odom_topic(types, DEFAULT_ODOM_TOPIC, path.name)
    heads = Counter(scan_head(message.content) for message in read_messages(path, {scan_topic}))
    joints = JointCollector()
    for topic in ("/tf_static", "/tf"):
        for message in read_messages(path, {topic}):
            if message.kind == TRANSFORMS:
                joints.add(topic, deserialize(message.content, TRANSFORMS))
    return Messages(_counts(path), types, dict(heads), _odometry_frames(path, odom_topic, joints), joints.joints)


def _counts(path: Path) -> dict[str, int]:
    with Reader(path) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


def _odometry_frames(path: Path, topic: str | None, joints: JointCollector) -> tuple[str, str]:
    if topic is not None:
        for message in read_messages(path, {topic}):
            reading = deserialize(message.content, ODOMETRY)
            return frame_name(reading.header.frame_id), frame_name(reading.child_frame_id)
    child = next((joint.child for joint in joints.joints if joint.parent == "odom"), "")
    return "odom", child


def scan_head(content: bytes) -> ScanHead:
    """What a LaserScan (CDR) says of itself, without reading its ranges."""
    order = "<" if content[1] & 1 else ">"
    frame = header_of(content).frame
    (length,) = struct.unpack_from(order + "I", content, 12)
    # CDR aligns to four bytes, counted from behind its own header of four.
    at = -(-(16 + length) // 4) * 4
    first, last, increment, *_, beams = struct.unpack_from(order + "7fI", content, at)
    return ScanHead(frame_name(frame), first, last, increment, beams)
