"""``hmt_slam parameters``: every parameter with its description, as a file that ``--config`` and ROS read."""

from __future__ import annotations

import argparse

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.configuration.documents import ros_yaml


def run(options: argparse.Namespace) -> None:
    """Print the configuration that the options lead to."""
    print(ros_yaml(chosen_configuration(options)), end="")
