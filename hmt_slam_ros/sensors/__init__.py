"""Measurements of the robot: laser scans with their own geometry, odometry, and the motion between two scans."""

from hmt_slam_ros.sensors.odometry import Odometry
from hmt_slam_ros.sensors.scan import Scan

__all__ = ["Odometry", "Scan"]
