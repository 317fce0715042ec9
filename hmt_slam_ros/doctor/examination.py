"""All checks on one log."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hmt_slam_ros.doctor import beams, frames, odometry, timing
from hmt_slam_ros.doctor.comparison import compare_odometry
from hmt_slam_ros.doctor.finding import SEVERITIES, Finding
from hmt_slam_ros.doctor.gathering import gather
from hmt_slam_ros.doctor.statistics import MessageStatistics, Statistics
from hmt_slam_ros.logs import Log
from hmt_slam_ros.open_log import is_bag, open_log


def examine(path: Path, *, start: float = 0.0, duration: float | None = None) -> list[Finding]:
    """Read a log and judge it.

    :param start: seconds of it to skip.
    :param duration: seconds of it to use, None for all that follows.
    :raises HmtSlamError: where it cannot be read.
    """
    log = open_log(path, start=start, duration=duration)
    return log_findings(log, _messages(path))


def log_findings(log: Log, messages: MessageStatistics | None = None) -> list[Finding]:
    """All findings on a log that is open, the most serious first."""
    return sorted_findings(findings(gather(log, messages)))


def findings(statistics: Statistics) -> list[Finding]:
    """All findings on what was gathered."""
    comparison = compare_odometry(statistics.odometry, statistics.motions)
    return [
        *timing.rate_findings(statistics),
        *timing.stamp_findings(statistics, comparison),
        *beams.findings(statistics),
        *odometry.findings(statistics, comparison),
        *frames.findings(statistics),
    ]


def sorted_findings(found: Sequence[Finding]) -> list[Finding]:
    """The most serious first."""
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def _messages(path: Path) -> MessageStatistics | None:
    if not is_bag(path):
        return None
    # Its library takes memory that the other formats need not pay for.
    from hmt_slam_ros.doctor.statistics import read_message_statistics  # noqa: PLC0415

    return read_message_statistics(path)
