"""All checks on one log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hmt_slam_ros.doctor.beams import beam_findings, mounting_findings
from hmt_slam_ros.doctor.finding import Finding, sorted_findings
from hmt_slam_ros.doctor.frames import MessageStatistics, frame_findings, read_message_statistics
from hmt_slam_ros.doctor.odometry import compare_odometry, odometry_findings
from hmt_slam_ros.doctor.statistics import Statistics, gather
from hmt_slam_ros.doctor.timing import rate_findings, stamp_findings
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.records import describe_left_out
from hmt_slam_ros.open_log import is_bag, open_log


def examine(path: Path, *, start: float = 0.0, duration: float | None = None) -> list[Finding]:
    """The findings on a log, the most serious first.

    :param start: seconds of the log to skip.
    :param duration: seconds of the log to use, None for all that follows.
    :raises HmtSlamError: where the log cannot be read.
    """
    log = open_log(path, start=start, duration=duration)
    return log_findings(log, read_message_statistics(path) if is_bag(path) else None)


def log_findings(log: Log, messages: MessageStatistics | None = None) -> list[Finding]:
    """The findings on an open log, the most serious first."""
    return sorted_findings([*_left_out_findings(log), *statistics_findings(gather(log, messages))])


def _left_out_findings(log: Log) -> Iterator[Finding]:
    """A finding on the measurements that no process may see."""
    sentence = describe_left_out(log)
    if sentence is not None:
        yield Finding("wrong", "measurements", sentence)


def statistics_findings(statistics: Statistics) -> Iterator[Finding]:
    """The findings on statistics, in the order of the checks."""
    comparison = compare_odometry(statistics.odometry, statistics.motions)
    yield from rate_findings(statistics)
    yield from stamp_findings(statistics, comparison)
    yield from beam_findings(statistics)
    yield from odometry_findings(statistics, comparison)
    yield from mounting_findings(statistics.scans)
    if statistics.messages is not None:
        yield from frame_findings(statistics.messages)
