"""``hmt_slam evaluate``: errors of an output folder against true relations."""

from __future__ import annotations

import argparse

from hmt_slam_ros.evaluation import (
    evaluate_folder,
    evaluate_relations,
    format_table,
    read_true_poses,
    read_tum,
    true_relations,
)
from hmt_slam_ros.open_log import open_log


def run(options: argparse.Namespace) -> None:
    """Print the table of errors."""
    if options.truth is None:
        errors = evaluate_folder(options.directory, options.relations, options.odometry)
    else:
        relations = true_relations(read_true_poses(open_log(options.truth)))
        errors = evaluate_relations(read_tum(options.directory / "trajectory.tum"), relations)
    print(format_table(errors))
