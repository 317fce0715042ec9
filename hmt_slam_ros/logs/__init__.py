"""Logs of scans and odometry: rosbag2, CARMEN and MRPT rawlog.

`bag` and `writer` load the rosbags library, so they are imported only where a bag is read or written.
"""

from hmt_slam_ros.logs.records import Log, LogRecord

__all__ = ["Log", "LogRecord"]
