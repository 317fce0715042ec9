"""ROS 2 nodes of the processes and the robot: they convert, call the process once, and publish."""

import sys

from hmt_slam_ros.process_settings import apply_process_settings, exit_on_signals

apply_process_settings()
# The name of a program that is run by `python -m` while its package is loaded.
if sys.argv[0] == "-m":
    exit_on_signals()
