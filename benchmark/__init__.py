"""Measurements of the whole system on logs: accuracy, robustness, speed."""

from hmt_slam_ros.process_settings import settle

settle()
