"""Commands."""

from hmt_slam_ros.process_settings import settle

settle()
