"""The command ``view``: the live page of a recorded run."""

from __future__ import annotations

import argparse

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.open_log import find_bag


def run_view(options: argparse.Namespace) -> int:
    """Serve the page of a bag until the user stops it.

    :returns: exit status.
    :raises HmtSlamError: where the bag cannot be shown, or ROS is not installed.
    """
    bag = find_bag(options.bag)
    try:
        from hmt_slam_ros.ros.bag_view_node import PageSettings, view_bag  # noqa: PLC0415  it needs ROS
    except ImportError as fault:
        raise HmtSlamError(f"view needs ROS ({fault}): source Jazzy or install its wheels") from fault
    return view_bag(bag, options.namespace, PageSettings(options.rate, options.port))
