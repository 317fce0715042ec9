"""The frames of the messages and the transforms between them."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from hmt_slam_ros.doctor.finding import Finding
from hmt_slam_ros.doctor.statistics import FrameTransform, MessageStatistics, Statistics

# A laser tilted by more, rad, has ranges other than those on the floor plan; beyond 10 degrees it is refused.
_TILT = math.radians(2.0)
# A laser farther from the robot's middle is no part of it, m.
_FAR = 2.0
# A transform that should be fixed moves if a point at 1 m does so by this, m.
_MOVES = 0.01


def findings(statistics: Statistics) -> list[Finding]:
    """What frames and transforms tell; nothing where the log is of another format than messages."""
    found = _check_laser_distance(statistics)
    messages = statistics.messages
    if messages is None:
        return found
    found += [
        *_check_names(messages),
        *_check_parents(messages),
        *_check_static(messages),
        *_check_tilt(messages),
        *_check_map_to_odom(messages),
    ]
    odom, base = messages.odometry_frames
    frames = ", ".join(sorted({head.frame for head in messages.scan_headers}))
    return [*found, Finding("fine", "frames", f"Odometry is {odom} -> {base}, scans are in {frames}.")]


def _check_laser_distance(statistics: Statistics) -> list[Finding]:
    poses = statistics.scans.laser_poses
    if not len(poses):
        return []
    away = float(np.hypot(poses[:, 0], poses[:, 1]).max())
    if away <= _FAR:
        return []
    text = (
        f"The laser is said to be {away:.2f} m from the robot's middle: check the unit (m) and the direction of the "
        "transform base_link -> laser."
    )
    return [Finding("wrong", "laser far away", text)]


def _check_names(messages: MessageStatistics) -> list[Finding]:
    odom, base = messages.odometry_frames
    found = []
    if not base:
        text = "The odometry has no child_frame_id: set it to the robot's frame, such as base_link."
        found.append(Finding("doubtful", "odometry frames", text))
    if odom and odom in {base, "map"}:
        text = f"The odometry is given in the frame {odom!r}: its header's frame should be odom (REP 105)."
        found.append(Finding("doubtful", "odometry frames", text))
    if any(not head.frame for head in messages.scan_headers):
        text = "Scans have an empty frame_id: set the frame of the laser in its driver, such as laser."
        found.append(Finding("wrong", "scan frame", text))
    return found


def _check_parents(messages: MessageStatistics) -> list[Finding]:
    parents: dict[str, set[str]] = defaultdict(set)
    for joint in messages.transforms:
        parents[joint.child].add(joint.parent)
    return [
        Finding(
            "wrong",
            "two parents",
            f"The frame {child!r} is said to be in {' and in '.join(sorted(names))}: a frame has one parent; stop "
            "one of the publishers (robot_state_publisher, static_transform_publisher, a driver, another SLAM).",
        )
        for child, names in parents.items()
        if len(names) > 1
    ]


def _check_static(messages: MessageStatistics) -> list[Finding]:
    return [
        Finding(
            "doubtful",
            "static transform moves",
            f"The transform {joint.parent} -> {joint.child} on {joint.topic} changes by {joint.max_change:.3f} m "
            "though it is static: the first one is believed; look for a second publisher.",
        )
        for joint in messages.transforms
        if joint.topic.endswith("tf_static") and joint.max_change > _MOVES
    ]


def _check_tilt(messages: MessageStatistics) -> list[Finding]:
    return [
        Finding(
            "doubtful",
            "tilted",
            f"The transform {joint.parent} -> {joint.child} is tilted by {math.degrees(_tilt(joint)):.1f} degrees: the "
            "laser should be level, so that it sees walls and not the floor.",
        )
        for joint in messages.transforms
        if joint.child in {head.frame for head in messages.scan_headers} and _tilt(joint) > _TILT
    ]


def _tilt(joint: FrameTransform) -> float:
    """Of the child's z axis against the parent's, upright or upside down, rad."""
    return math.acos(min(1.0, abs(float(joint.first_transform[2, 2]))))


def _check_map_to_odom(messages: MessageStatistics) -> list[Finding]:
    """The transform that rtl will publish is there already."""
    odom, _ = messages.odometry_frames
    others = [joint for joint in messages.transforms if joint.child == odom]
    return [
        Finding(
            "doubtful",
            "map -> odom",
            f"There are transforms {joint.parent} -> {joint.child} of another SLAM or localization: stop it, or leave "
            "them away when the bag is played for the nodes, since rtl publishes the same.",
        )
        for joint in others[:1]
    ]
