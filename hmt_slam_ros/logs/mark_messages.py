"""Observations of marks in bags: poses with covariance in frames that are named after the marks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian, rotate_covariance
from hmt_slam_ros.logs.mounting import frame_name, heading_from_quaternion
from hmt_slam_ros.logs.planar_covariance import planar_covariance, spatial_covariance
from hmt_slam_ros.logs.ros_types import RosMessage
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.sensors.mark import check_mark
from hmt_slam_ros.sensors.plausibility import check_quaternion


def mark_from_message(message: RosMessage) -> MarkObservation:
    """The observation of a geometry_msgs/PoseWithCovarianceStamped, with its own stamp.

    The covariance of a message is along the axes of the frame, that of a ``PoseGaussian`` along those of the robot.

    :raises HmtSlamError: where it cannot be used; names the field, its value and the remedy.
    """
    header, position, rotation = message.header, message.pose.pose.position, message.pose.pose.orientation
    quaternion = (rotation.x, rotation.y, rotation.z, rotation.w)
    check_quaternion(quaternion)
    mean = np.array([position.x, position.y, heading_from_quaternion(quaternion)])
    covariance = planar_covariance(message.pose.covariance)
    stamp = int(header.stamp.sec * NANOSECONDS + header.stamp.nanosec)
    belief = PoseGaussian(mean, rotate_covariance(covariance, -float(mean[2])))
    return check_mark(MarkObservation(stamp, frame_name(header.frame_id), belief))


def message_covariance(belief: PoseGaussian) -> NDArray[np.float64]:
    """The covariance of a belief in a message, shape (36,)."""
    return spatial_covariance(rotate_covariance(belief.covariance, float(belief.mean[2])))
