"""What the robot measures: laser scans with their own geometry, odometry, and the motion model between two poses."""

from hmt_slam_ros.sensing.odometry import Odometry
from hmt_slam_ros.sensing.scan import Scan

__all__ = ["Odometry", "Scan"]
