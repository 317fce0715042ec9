"""Checks on stamps, rates and gaps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.doctor.finding import Finding, grade, times_text
from hmt_slam_ros.doctor.odometry import OdometryComparison
from hmt_slam_ros.doctor.statistics import Statistics, seconds_between
from hmt_slam_ros.geometry import se2

_OFFSET = (0.05, 0.15)
"""Offset between the clocks of laser and odometry: doubtful, and wrong, s."""

_JITTER, _MAX_EARLY_SHARE = 0.5, 0.1
"""Deviation from the usual period, as a share of it, that shows a stamp of arrival; least share of such stamps."""

_GAP_PERIODS, _GAP = 5.0, 0.5
"""Least length of a gap between two messages, in usual periods and in s."""

_FAR, _TURNED, _FAR_SHARE = 0.7, np.radians(35.0), 0.1
"""Motion after which two scans have too little in common, m and rad; share of the scans that may be so far apart."""

_UNCOVERED = (0.0005, 0.01)
"""Shares of scans without odometry around them: doubtful, and wrong."""

_SPARSE = 1.0
"""Median period, s, from which the time between messages shows no gaps: the log has keyframes only."""


def stamp_findings(statistics: Statistics, comparison: OdometryComparison | None) -> list[Finding]:
    """Findings on the stamps."""
    found = [
        *_check_backward("scan", statistics.scans.source_stamps),
        *_check_backward("odometry", statistics.odometry.source_stamps),
        *_check_equal("scan", statistics.scans.source_stamps),
        *_check_even(statistics.scans.source_stamps),
    ]
    if comparison is not None and comparison.clock_offset is not None:
        found.append(_clock_offset_finding(comparison.clock_offset))
    return found or [Finding("fine", "stamps", "All stamps increase.")]


def _check_backward(what: str, stamps: Int64) -> Iterator[Finding]:
    steps = seconds_between(stamps)
    back = np.flatnonzero(steps < 0.0)
    if not back.size:
        return
    yield Finding(
        "doubtful",
        f"{what} stamps jump back",
        f"The {what} stamps jump back {times_text(back.size)}, by up to {-steps.min():.3f} s: the order of the "
        "messages is believed and not the stamps, but other tools that sort by time will break the path; mend the "
        "clock or the driver that stamps them.",
    )


def _check_equal(what: str, stamps: Int64) -> Iterator[Finding]:
    equal = int((np.diff(stamps) == 0).sum())
    if not equal:
        return
    yield Finding(
        "doubtful",
        f"{what} stamps equal",
        f"{equal} {what} messages have the stamp of the one before: look for a second publisher of the same topic, "
        "a recording of it twice, or a clock that is too coarse.",
    )


def _check_even(stamps: Int64) -> Iterator[Finding]:
    """A finding where stamps come in bursts, as those of arrival do."""
    periods = seconds_between(stamps)
    periods = periods[periods > 0.0]
    if len(periods) < 20:
        return
    usual = float(np.median(periods))
    early = float((periods < (1.0 - _JITTER) * usual).mean())
    if usual > 1.0 or early < _MAX_EARLY_SHARE:
        return
    yield Finding(
        "doubtful",
        "scan stamps uneven",
        f"{100.0 * early:.0f} % of the scans follow the one before in less than half of the usual {usual:.3f} s: "
        "the stamps seem to be those of arrival; let the driver stamp a scan when its first beam is measured.",
    )


def _clock_offset_finding(offset: float) -> Finding:
    severity = grade(abs(offset), *_OFFSET)
    if severity == "fine":
        return Finding("fine", "clock offset", "Scans and odometry are stamped by one clock, as far as turns show.")
    late = "late" if offset < 0.0 else "early"
    return Finding(
        severity,
        "clock offset",
        f"The scans' stamps are {abs(offset):.2f} s {late} against the odometry's, by the turns that both show: "
        "synchronize the clocks (chrony, PTP), or correct the stamp in the driver of the one that is off.",
    )


def rate_findings(statistics: Statistics) -> Iterator[Finding]:
    """Findings on the rates of the messages and the gaps between them."""
    scans, odometry = statistics.scans.stamps, statistics.odometry.stamps
    if len(scans) < 2:
        text = "There is not more than one scan: record for longer, or start the laser."
        yield Finding("wrong", "scan rate", text)
        return
    yield _contents_finding(statistics, scans)
    yield from _check_gaps("scan", "laser", scans)
    if len(odometry) < 2:
        text = "There is no odometry: start its driver, or record its topic; mapping needs it."
        yield Finding("wrong", "odometry rate", text)
        return
    yield from _check_scan_spacing(statistics)
    yield from _check_odometry_rate(scans, odometry)
    yield from _check_gaps("odometry", "odometry", odometry)
    yield from _check_coverage(scans, odometry)


def _contents_finding(statistics: Statistics, scans: Int64) -> Finding:
    return Finding(
        "fine",
        "contents",
        f"{len(scans)} scans at {_mean_rate(scans):.1f} Hz and {len(statistics.odometry.stamps)} odometry readings at "
        f"{_mean_rate(statistics.odometry.stamps):.1f} Hz in {statistics.duration:.1f} s, over "
        f"{statistics.odometry.distance:.1f} m by odometry.",
    )


def _mean_rate(stamps: Int64) -> float:
    span = float(np.ptp(stamps)) * 1e-9 if len(stamps) else 0.0
    return (len(stamps) - 1) / span if span > 0.0 else 0.0


def _gap_limit(periods: Float64) -> float:
    # Stamps of arrival come in bursts, which make the median too short.
    return max(_GAP, _GAP_PERIODS * float(max(np.median(periods), periods.mean())))


def _check_gaps(what: str, driver: str, stamps: Int64) -> Iterator[Finding]:
    periods = seconds_between(stamps)
    if np.median(periods) > _SPARSE:
        return
    gaps = np.flatnonzero(periods > _gap_limit(periods))
    if not gaps.size:
        return
    longest = gaps[np.argmax(periods[gaps])]
    at = (stamps[longest] - stamps[0]) * 1e-9
    yield Finding(
        "doubtful",
        f"{what} gaps",
        f"The {what} messages stop {times_text(gaps.size)} for more than {_gap_limit(periods):.1f} s, the longest "
        f"time for {periods[longest]:.1f} s, {at:.1f} s after the first: look whether the {driver} driver stalls "
        "or the recorder or network drops messages.",
    )


def _check_scan_spacing(statistics: Statistics) -> Iterator[Finding]:
    """A finding where the robot moves far between scans."""
    odometry = statistics.odometry
    stamps = statistics.scans.stamps.astype(np.float64)
    poses = odometry.poses_at(stamps[(stamps >= odometry.stamps[0]) & (stamps <= odometry.stamps[-1])])
    if len(poses) < 2:
        return
    steps = se2.between(poses[:-1], poses[1:])
    far = (np.hypot(steps[:, 0], steps[:, 1]) > _FAR) | (np.abs(steps[:, 2]) > _TURNED)
    if far.mean() < _FAR_SHARE:
        return
    yield Finding(
        "doubtful",
        "sparse scans",
        f"Between {100.0 * far.mean():.0f} % of the scans the robot goes more than {_FAR:g} m or turns by more "
        f"than {np.degrees(_TURNED):.0f} degrees (usually {np.median(np.hypot(*steps[:, :2].T)):.2f} m), as "
        "in a log of keyframes: give the whole recording, drive more slowly or raise the laser's rate.",
    )


def _check_odometry_rate(scans: Int64, odometry: Int64) -> Iterator[Finding]:
    if len(odometry) >= 0.8 * len(scans):
        return
    yield Finding(
        "doubtful",
        "odometry rate",
        f"There are {len(odometry)} odometry readings for {len(scans)} scans: raise the odometry's rate to at least "
        "that of the scans, since the motion between two readings is guessed.",
    )


def _check_coverage(scans: Int64, odometry: Int64) -> Iterator[Finding]:
    uncovered = ~_is_covered(scans, odometry)
    share = float(uncovered.mean())
    severity = grade(share, *_UNCOVERED)
    # A scan or two may lie before the first reading and after the last.
    if severity == "fine" or uncovered.sum() <= 2:
        return
    yield Finding(
        severity,
        "scans without odometry",
        f"{uncovered.sum()} of {len(scans)} scans ({100.0 * share:.1f} %) lie in gaps of the odometry or outside "
        "of it: find out why it is missing there; until then the robot's motion is taken from its inertia and the "
        "scans alone.",
    )


def _is_covered(scans: Int64, odometry: Int64) -> Bool:
    """Whether each scan, shape (n,), lies between two odometry readings without a gap."""
    after = np.searchsorted(odometry, scans, side="left")
    exact = odometry[np.minimum(after, len(odometry) - 1)] == scans
    inside = (after > 0) & (after < len(odometry))
    after = np.clip(after, 1, len(odometry) - 1)
    between = (odometry[after] - odometry[after - 1]) * 1e-9
    return exact | (inside & (between <= _gap_limit(seconds_between(odometry))))
