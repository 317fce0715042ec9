"""``hmt_slam export``: the topology of an output folder for other programs."""

from __future__ import annotations

import argparse

from hmt_slam_ros.offline.topology_file import export_topology


def run(options: argparse.Namespace) -> None:
    """Write the file and name it."""
    print(export_topology(options.directory))
