"""Whether the stamps can be believed: each clock by itself, and the laser's against the odometry's."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Int64
from hmt_slam_ros.doctor.comparison import Comparison
from hmt_slam_ros.doctor.finding import Finding, graded, times
from hmt_slam_ros.doctor.statistics import Statistics, seconds_between

# Seconds between the clocks of laser and odometry: doubtful from the first on, wrong from the second on.
_OFFSET = (0.05, 0.15)
# Stamps that deviate by this share of a period are those of arrival.
_JITTER = 0.5


def findings(statistics: Statistics, comparison: Comparison | None) -> list[Finding]:
    """What the stamps tell."""
    found = [
        *_backward("scan", statistics.scans.source_stamps),
        *_backward("odometry", statistics.odometry.source_stamps),
        *_equal("scan", statistics.scans.source_stamps),
        *_uneven(statistics.scans.source_stamps),
    ]
    if comparison is not None and comparison.offset is not None:
        found.append(_offset(comparison.offset))
    return found or [Finding("fine", "stamps", "All stamps increase.")]


def _backward(what: str, stamps: Int64) -> list[Finding]:
    steps = seconds_between(stamps)
    back = np.flatnonzero(steps < 0.0)
    if not back.size:
        return []
    return [
        Finding(
            "doubtful",
            f"{what} stamps jump back",
            f"The {what} stamps jump back {times(back.size)}, by up to {-steps.min():.3f} s: the order of the messages "
            "is believed and not the stamps, but other tools that sort by time will break the path; mend the clock or "
            "the driver that stamps them.",
        )
    ]


def _equal(what: str, stamps: Int64) -> list[Finding]:
    equal = int((np.diff(stamps) == 0).sum())
    if not equal:
        return []
    return [
        Finding(
            "doubtful",
            f"{what} stamps equal",
            f"{equal} {what} messages have the stamp of the one before: look for a second publisher of the same topic, "
            "a recording of it twice, or a clock that is too coarse.",
        )
    ]


def _uneven(stamps: Int64) -> list[Finding]:
    """Stamps of arrival, in bursts."""
    periods = seconds_between(stamps)
    periods = periods[periods > 0.0]
    if len(periods) < 20:
        return []
    usual = float(np.median(periods))
    early = float((periods < (1.0 - _JITTER) * usual).mean())
    if usual > 1.0 or early < 0.1:
        return []
    return [
        Finding(
            "doubtful",
            "scan stamps uneven",
            f"{100.0 * early:.0f} % of the scans follow the one before in less than half of the usual {usual:.3f} s: "
            "the stamps seem to be those of arrival; let the driver stamp a scan when its first beam is measured.",
        )
    ]


def _offset(offset: float) -> Finding:
    severity = graded(abs(offset), *_OFFSET)
    if severity == "fine":
        return Finding("fine", "clock offset", "Scans and odometry are stamped by one clock, as far as turns show.")
    late = "late" if offset < 0.0 else "early"
    return Finding(
        severity,
        "clock offset",
        f"The scans' stamps are {abs(offset):.2f} s {late} against the odometry's, by the turns that both show: "
        "synchronise the clocks (chrony, PTP), or correct the stamp in the driver of the one that is off.",
    )
