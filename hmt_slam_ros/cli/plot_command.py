"""``hmt_slam plot``: pictures of an output folder."""

from __future__ import annotations

import argparse

from hmt_slam_ros.results.plots import plot_all


def run(options: argparse.Namespace) -> None:
    """Draw all pictures and name them."""
    for picture in plot_all(options.directory):
        print(picture)
