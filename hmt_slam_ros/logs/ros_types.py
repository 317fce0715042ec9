"""The ROS messages of a bag, by the rosbags library: no ROS installation is needed."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeAlias

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseStamped"

GROUND_TRUTH_TOPIC = "/ground_truth"
"""Of the robot's true poses, where somebody knows them."""

RosMessage: TypeAlias = Any
"""A message of the rosbags library, whose classes are made at run time: type checkers do not know their fields."""


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def deserialize(content: bytes, message_type: str) -> RosMessage:
    """A message from its bytes in a bag (CDR)."""
    return typestore().deserialize_cdr(content, message_type)
