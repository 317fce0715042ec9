"""``hmt_slam export``: the topology of an output folder, or its grid, for other programs."""

from __future__ import annotations

import argparse

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.results.export import export_grid, export_topology


def run(options: argparse.Namespace) -> None:
    """Write the files and name them."""
    asked = options.resolution is not None or options.area is not None
    if options.to is None:
        if asked:
            raise HmtSlamError("--resolution and --area are of a grid: say with --grid into which folder")
        for path in export_topology(options.directory):
            print(path)
        return
    for path in export_grid(options.directory, options.to, options.resolution, options.area):
        print(path)
