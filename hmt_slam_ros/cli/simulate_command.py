"""``hmt_slam simulate``: a drive through a simulated world as a rosbag2 with its ground truth."""

from __future__ import annotations

import argparse

from hmt_slam_ros.evaluation import read_true_poses, write_tum
from hmt_slam_ros.logs.records import SIMULATION_PREFIX
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log


def run(options: argparse.Namespace) -> None:
    """Write the bag, and the truth beside its data, and say what is in it."""
    seed = [] if options.seed is None else [f"seed={options.seed}"]
    name = SIMULATION_PREFIX + ",".join([options.world, *options.settings, *seed])
    log = open_log(name, start=options.start or 0.0, duration=options.duration or None)
    write_bag(log, options.out, storage=options.storage)
    write_tum(options.out / "ground_truth.tum", read_true_poses(log))
    print(f"{options.out}: {log.scan_count} scans, {log.duration:.1f} s; the same as the log {name}")
