"""The processes and the robot as ROS 2 nodes: thin shells that convert, call the process once, and publish."""

import sys

from hmt_slam_ros.process_settings import apply_process_settings, exit_on_signals

apply_process_settings()
# So Python calls a program of this package, `python -m hmt_slam_ros.ros.run_node slam`, while it loads the package.
if sys.argv[0] == "-m":
    exit_on_signals()
