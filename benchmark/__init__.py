"""Measurements of the whole system on recorded and simulated logs."""

from hmt_slam_ros.process_settings import apply_process_settings

apply_process_settings()
