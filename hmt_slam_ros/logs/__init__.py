"""Sources of scans and odometry: rosbag2, CARMEN, MRPT rawlog, and by name the simulation."""

from hmt_slam_ros.logs.open_log import is_simulated, open_log
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.logs.writer import convert, write_bag

__all__ = ["Log", "LogRecord", "convert", "is_simulated", "open_log", "write_bag"]
