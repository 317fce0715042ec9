"""The commands on output folders: ``evaluate``, ``plot`` and ``export``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import (
    evaluate_folder,
    evaluate_relations,
    format_table,
    read_true_poses,
    read_tum,
    true_relations,
)
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.export import export_grid, export_topology


def run_evaluate(options: argparse.Namespace) -> None:
    """Print the errors against true relations as a table."""
    if options.truth is None:
        errors = evaluate_folder(options.directory, options.relations, options.odometry)
    else:
        relations = true_relations(read_true_poses(open_log(options.truth)))
        errors = evaluate_relations(read_tum(options.directory / "trajectory.tum"), relations)
    print(format_table(errors))


def run_plot(options: argparse.Namespace) -> None:
    """Draw all pictures and print their paths."""
    from hmt_slam_ros.results.plots import plot_all  # noqa: PLC0415  matplotlib is for this command alone

    print(*plot_all(options.directory), sep="\n")


def run_export(options: argparse.Namespace) -> None:
    """Write the topology, or the grid, for other programs, and print the paths of the files."""
    if options.grid is not None:
        paths: tuple[Path, ...] = export_grid(options.directory, options.grid, options.resolution, options.area)
    elif options.resolution is not None or options.area is not None:
        raise HmtSlamError("--resolution and --area are of a grid: say with --grid into which folder")
    else:
        paths = export_topology(options.directory)
    print(*paths, sep="\n")
