"""ROS messages of bags, by the rosbags library, without a ROS installation."""

from __future__ import annotations

from functools import cache
from typing import Any, TypeAlias

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.untrusted_input import shorten

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

GROUND_TRUTH_TOPIC = "/ground_truth"
"""Topic of the robot's true poses in simulated bags."""

MARKS_TOPIC = "/marks"
"""Topic of the observations of marks in simulated bags."""

RosMessage: TypeAlias = Any
"""A message of the rosbags library, which makes its classes at run time, so that type checkers know no fields."""


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def deserialize(content: bytes, message_type: str) -> RosMessage:
    """The message of its bytes in CDR.

    :raises HmtSlamError: where they are none of the type.
    """
    try:
        return typestore().deserialize_cdr(content, message_type)
    except Exception as fault:  # whatever the library meets in a damaged message
        raise HmtSlamError(
            f"a message of type {message_type} is damaged ({shorten(fault)}): record it anew, or leave it out."
        ) from fault
