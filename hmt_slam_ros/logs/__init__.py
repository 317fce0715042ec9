"""Sources of scans and odometry: rosbag2, CARMEN, MRPT rawlog, and by name the simulation.

What reads and writes bags loads the rosbags library; only those who do either load it.
"""

from hmt_slam_ros.logs.records import Log, LogRecord

__all__ = ["Log", "LogRecord"]
