"""Measurements of the whole system on recorded and simulated logs."""

from hmt_slam_ros.process_settings import settle

settle()
