"""Measurements of the robot: laser scans, odometry, observations of marks, and the motion between two scans."""

from typing import TypeAlias

from hmt_slam_ros.sensors.mark import MarkObservation
from hmt_slam_ros.sensors.odometry import Odometry
from hmt_slam_ros.sensors.scan import Scan

Measurement: TypeAlias = Scan | Odometry | MarkObservation
"""What a log holds, and what metric SLAM processes."""

__all__ = ["MarkObservation", "Measurement", "Odometry", "Scan"]
