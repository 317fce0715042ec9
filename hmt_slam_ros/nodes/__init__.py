"""The five processes and the robot as ROS 2 nodes: thin shells that convert, call the process once, and publish."""

from hmt_slam_ros.process_settings import settle

settle()
