"""The transforms that are told, and whether they stay as they are."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.doctor.statistics import Joint
from hmt_slam_ros.logs.mounting import transform_from_quaternion
from hmt_slam_ros.logs.ros_types import RosMessage
from hmt_slam_ros.logs.transforms import frame_name


class JointCollector:
    """Collects transforms."""

    def __init__(self) -> None:
        self._first: dict[tuple[str, str, str], NDArray[np.float64]] = {}
        self._messages: Counter[tuple[str, str, str]] = Counter()
        self._moved: dict[tuple[str, str, str], float] = {}

    @property
    def joints(self) -> tuple[Joint, ...]:
        """All of them."""
        return tuple(
            Joint(*key[:2], key[2], first, self._messages[key], self._moved[key]) for key, first in self._first.items()
        )

    def add(self, topic: str, message: RosMessage) -> None:
        """Take in a tf2_msgs/TFMessage."""
        for joint in message.transforms:
            key = (frame_name(joint.header.frame_id), frame_name(joint.child_frame_id), topic)
            move, turn = joint.transform.translation, joint.transform.rotation
            transform = transform_from_quaternion((move.x, move.y, move.z), (turn.x, turn.y, turn.z, turn.w))
            first = self._first.setdefault(key, transform)
            self._messages[key] += 1
            self._moved[key] = max(self._moved.get(key, 0.0), float(np.abs(transform - first).max()))
