"""The commands on logs: ``convert``, ``simulate`` and ``doctor``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

from hmt_slam_ros.cli.terminal import report_left_out
from hmt_slam_ros.configuration.metric_slam import split_topics
from hmt_slam_ros.doctor.examination import examine
from hmt_slam_ros.doctor.finding import SEVERITIES, Finding
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_true_poses, write_tum
from hmt_slam_ros.logs.bag import DEFAULT_SCAN_TOPIC
from hmt_slam_ros.logs.records import SIMULATION_PREFIX
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log

SOMETHING_WRONG = 1
"""Exit status of ``doctor`` where a finding is wrong."""


def run_convert(options: argparse.Namespace) -> None:
    """Write any log as a rosbag2."""
    start, duration = options.start or 0.0, options.duration or None
    topics = {"scan_topics": options.scans, "marks_topic": options.marks}
    log = open_log(options.source, **topics, start=start, duration=duration)
    report_left_out(log, options.command)
    write_bag(log, options.destination, storage=options.storage)
    print(f"{options.destination}: {log.scan_count} scans, {log.duration:.1f} s")


def run_simulate(options: argparse.Namespace) -> None:
    """Write a drive through a simulated world as a rosbag2, with its ground truth beside the data."""
    seed = [] if options.seed is None else [f"seed={options.seed}"]
    name = SIMULATION_PREFIX + ",".join([options.world.removeprefix(SIMULATION_PREFIX), *options.settings, *seed])
    log = open_log(name, start=options.start or 0.0, duration=options.duration or None)
    write_bag(log, options.out, storage=options.storage)
    write_tum(options.out / "ground_truth.tum", read_true_poses(log))
    print(f"{options.out}: {log.scan_count} scans, {log.duration:.1f} s; the same as the log {name}")


def run_doctor(options: argparse.Namespace) -> int:
    """Print the findings on a log or on the running system.

    :returns: 1 where something is wrong, else 0.
    """
    if options.live == (options.log is not None):
        raise HmtSlamError("doctor examines a log or the running system: give either LOG or --live")
    if options.live:
        findings = _examine_running_system(options)
    else:
        start, duration = options.start or 0.0, options.duration or None
        findings = examine(options.log, scan_topics=options.scans, start=start, duration=duration)
    print(_as_json(findings) if options.json else _as_text(findings))
    return SOMETHING_WRONG if any(finding.severity == "wrong" for finding in findings) else 0


def _examine_running_system(options: argparse.Namespace) -> list[Finding]:
    try:
        from hmt_slam_ros.ros.doctor_node import examine_running  # noqa: PLC0415  it needs ROS
    except ImportError as fault:
        raise HmtSlamError(f"doctor --live needs ROS ({fault}): source Jazzy or install its wheels") from fault
    topics = () if options.scans == DEFAULT_SCAN_TOPIC else split_topics(options.scans)
    return examine_running(options.seconds, options.ros_arguments, topics)


def _as_json(findings: Sequence[Finding]) -> str:
    return json.dumps({"findings": [finding._asdict() for finding in findings]}, indent=2)


def _as_text(findings: Sequence[Finding]) -> str:
    """One line per finding, and a last line with their counts."""
    counts = ", ".join(f"{sum(finding.severity == kind for finding in findings)} {kind}" for kind in SEVERITIES)
    return "\n".join([*(f"{finding.severity:8s} {finding.subject}: {finding.text}" for finding in findings), counts])
