"""``hmt_slam convert``: any log as a rosbag2."""

from __future__ import annotations

import argparse

from hmt_slam_ros.logs.writer import convert


def run(options: argparse.Namespace) -> None:
    """Write the bag and say what is in it."""
    log = convert(
        options.source,
        options.destination,
        storage=options.storage,
        start=options.start or 0.0,
        duration=options.duration or None,
    )
    print(f"{options.destination}: {log.scan_count} scans, {log.duration:.1f} s")
