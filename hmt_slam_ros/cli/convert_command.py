"""``hmt_slam convert``: any log as a rosbag2."""

from __future__ import annotations

import argparse
from pathlib import Path

from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log


def run(options: argparse.Namespace) -> None:
    """Write the bag and say what is in it."""
    log = convert_log(
        options.source,
        options.destination,
        storage=options.storage,
        start=options.start or 0.0,
        duration=options.duration or None,
    )
    print(f"{options.destination}: {log.scan_count} scans, {log.duration:.1f} s")


def convert_log(
    source: Path,
    destination: Path,
    *,
    storage: str = "mcap",
    scan_topic: str = "/scan",
    odom_topic: str = "/odom",
    start: float = 0.0,
    duration: float | None = None,
) -> Log:
    """Write a log of any format, or a part of it, as a rosbag2 folder.

    :param source: the log, as `open_log` takes it, with ``scan_topic`` ... ``duration``.
    :param destination: folder to be made; it must not exist.
    :param storage: ``mcap`` or ``sqlite3``.
    :returns: the log that was read.
    :raises HmtSlamError: where the log cannot be read or the folder not be made; nothing is left behind.
    """
    log = open_log(source, scan_topic=scan_topic, odom_topic=odom_topic, start=start, duration=duration)
    write_bag(log, destination, storage=storage)
    return log
