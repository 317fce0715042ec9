"""``hmt_slam doctor``: what is wrong with a log or a running system, in sentences."""

from __future__ import annotations

import argparse
import json

from hmt_slam_ros.doctor.finding import SEVERITIES, Finding
from hmt_slam_ros.errors import HmtSlamError

_WRONG = 1


def run(options: argparse.Namespace) -> int:
    """Examine, and say what was found; 1 where something is wrong, else 0."""
    if options.live == (options.log is not None):
        raise HmtSlamError("doctor examines a log or the running system: give either LOG or --live")
    found = _examine_running_system(options) if options.live else _examine_log(options)
    print(_as_json(found) if options.json else _as_text(found))
    return _WRONG if any(finding.severity == "wrong" for finding in found) else 0


def _examine_log(options: argparse.Namespace) -> list[Finding]:
    # It loads compiled kernels, for which an error in the arguments need not wait.
    from hmt_slam_ros.doctor.examination import examine  # noqa: PLC0415

    return examine(options.log, start=options.start or 0.0, duration=options.duration or None)


def _examine_running_system(options: argparse.Namespace) -> list[Finding]:
    try:
        from hmt_slam_ros.ros.doctor_node import examine_running  # noqa: PLC0415  it needs ROS
    except ImportError as fault:
        raise HmtSlamError(f"doctor --live needs ROS ({fault}): source Jazzy or install its wheels") from fault
    return examine_running(options.seconds, options.ros_arguments)


def _as_json(found: list[Finding]) -> str:
    return json.dumps({"findings": [finding._asdict() for finding in found]}, indent=2)


def _as_text(found: list[Finding]) -> str:
    """A line for each, and one that counts them."""
    counts = ", ".join(f"{sum(one.severity == kind for one in found)} {kind}" for kind in SEVERITIES)
    return "\n".join([*(f"{one.severity:8s} {one.subject}: {one.text}" for one in found), counts])
