"""All checks on one log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hmt_slam_ros.doctor.beams import beam_findings, mounting_findings
from hmt_slam_ros.doctor.finding import Finding, sorted_findings
from hmt_slam_ros.doctor.frames import MessageStatistics, frame_findings, read_message_statistics
from hmt_slam_ros.doctor.lasers import laser_findings, laser_name
from hmt_slam_ros.doctor.odometry import compare_odometry, odometry_findings
from hmt_slam_ros.doctor.statistics import Gatherer, Statistics
from hmt_slam_ros.doctor.timing import rate_findings, stamp_findings
from hmt_slam_ros.logs import Log
from hmt_slam_ros.logs.bag import DEFAULT_SCAN_TOPIC
from hmt_slam_ros.logs.records import describe_left_out
from hmt_slam_ros.open_log import is_bag, open_log


def examine(
    path: Path, *, scan_topics: str = DEFAULT_SCAN_TOPIC, start: float = 0.0, duration: float | None = None
) -> list[Finding]:
    """The findings on a log, the most serious first.

    :param scan_topics: topics of the scans of a bag, separated by commas.
    :param start: seconds of the log to skip.
    :param duration: seconds of the log to use, None for all that follows.
    :raises HmtSlamError: where the log cannot be read.
    """
    log = open_log(path, scan_topics=scan_topics, start=start, duration=duration)
    return log_findings(log, read_message_statistics(path, scan_topics) if is_bag(path) else None)


def log_findings(log: Log, messages: MessageStatistics | None = None) -> list[Finding]:
    """The findings on an open log, the most serious first."""
    gatherer = Gatherer()
    for record in log.records():
        gatherer.add(record)
    return sorted_findings([*_left_out_findings(log), *gathered_findings(gatherer, log.name, messages)])


def gathered_findings(gatherer: Gatherer, name: str, messages: MessageStatistics | None = None) -> Iterator[Finding]:
    """The findings on what was gathered; of several lasers, what is found of one names it.

    :param name: name of the log.
    :param messages: statistics of its messages, None where it is no bag.
    """
    lasers = gatherer.finish(name, messages)
    found = [list(statistics_findings(statistics)) for statistics in lasers]
    yield from (finding for finding in found[0] if all(finding in own for own in found))
    for statistics, own in zip(lasers, found, strict=True):
        for finding in own:
            if not all(finding in others for others in found):
                text = f"Of {laser_name(statistics.scans.laser_poses[0])}: {finding.text}"
                yield finding._replace(text=text)
    yield from laser_findings(gatherer.laser_pairs.pairs)


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
