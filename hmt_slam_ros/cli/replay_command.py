"""``hmt_slam replay``: a log becomes an output folder by way of the robot node and the five process nodes."""

from __future__ import annotations

import argparse
import sys

from hmt_slam_ros.cli.arguments import chosen_configuration
from hmt_slam_ros.cli.terminal import Progress, summary
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import check_replaceable
from hmt_slam_ros.view.server import LOCAL, check_port


def run(options: argparse.Namespace) -> None:
    """Start the nodes, wait for the end of the log and say what came of it."""
    configuration = chosen_configuration(options)
    check_replaceable(options.out.absolute())
    log = open_log(options.log, start=configuration.robot.start, duration=configuration.robot.duration or None)
    try:
        from hmt_slam_ros.ros.replay import replay  # noqa: PLC0415  the only command that needs ROS
    except ImportError as fault:
        raise HmtSlamError(f"replay needs ROS ({fault}): source Jazzy or install its wheels, or use map") from fault
    if options.view is not None:
        check_port(options.view)
        print(f"the live page is at http://{LOCAL}:{options.view}/", file=sys.stderr)
    with Progress(log.scan_count, log.duration) as progress:
        replayed = replay(options.log, options.out, configuration, progress, view_port=options.view)
    print(summary(options.out, replayed.recording, log.duration, replayed.wall_seconds))
