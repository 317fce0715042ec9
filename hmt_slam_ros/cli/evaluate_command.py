"""``hmt_slam evaluate``: errors of an output folder against true relations."""

from __future__ import annotations

import argparse

from hmt_slam_ros.evaluation import evaluate_folder, format_table


def run(options: argparse.Namespace) -> None:
    """Print the table of errors."""
    print(format_table(evaluate_folder(options.directory, options.relations, options.odometry)))
