"""Checks on the geometry of the scans and the ranges of their beams."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from hmt_slam_ros.doctor.finding import Finding, grade
from hmt_slam_ros.doctor.frames import MessageStatistics
from hmt_slam_ros.doctor.statistics import ScanStatistics, Statistics

_NAN, _NEAR = (0.05, 0.3), (0.05, 0.3)
"""Shares of ranges that are NaN, and below range_min: doubtful, and wrong."""

_MIN_RETURNS = (0.25, 0.08)
"""Least share of beams with a return in the median scan: doubtful below the first, wrong below the second."""

_NARROW_FIELD, _MIN_BEAMS = math.radians(90.0), 60
"""Least field of view, rad, and least number of beams."""

_BODY_RANGE, _BODY_SPREAD, _BODY_SHARE, _BODY_BEAMS = 1.0, 0.15, 0.9, 2
"""Beams that see the robot: largest range and spread of ranges, m, least share of scans, least number of beams."""

_BODY_DISTANCE, _BODY_SCANS = 5.0, 50
"""Least path length, m, and number of scans from which beams that see the robot are searched."""

_FAR_LASER = 2.0
"""Largest distance of a laser from the robot's middle, m."""


def beam_findings(statistics: Statistics) -> Iterator[Finding]:
    """Findings on the geometry of the scans, the ranges of their beams."""
    scans = statistics.scans
    if not len(scans.stamps):
        return
    yield _summary(scans)
    yield from _check_angles(scans)
    yield from _check_range_limits(scans)
    yield from _check_ranges(scans)
    yield from _check_own_body(statistics)
    yield from _check_sweep(scans)
    if statistics.messages is not None:
        yield from _check_stated_angles(statistics.messages)


def _summary(scans: ScanStatistics) -> Finding:
    beams, increment = scans.counts.beams, scans.geometry[:, 1]
    counts = f"{beams.min()}" if beams.min() == beams.max() else f"{beams.min()} to {beams.max()}"
    field = np.median(np.abs(increment) * (beams - 1))
    returns = float(scans.counts.returns.sum() / max(1, beams.sum()))
    return Finding(
        "fine",
        "beams",
        f"{counts} beams over {math.degrees(field):.0f} degrees, {math.degrees(abs(np.median(increment))):.3f} degrees "
        f"apart, {100.0 * returns:.0f} % of them with a return.",
    )


def _check_angles(scans: ScanStatistics) -> Iterator[Finding]:
    first, increment = scans.geometry[:, 0], scans.geometry[:, 1]
    impossible = ~np.isfinite(first) | ~np.isfinite(increment) | (increment == 0.0)
    if impossible.any():
        k = int(np.argmax(impossible))
        text = (
            f"{impossible.sum()} scans have angle_min = {first[k]:g} and angle_increment = {increment[k]:g}: correct "
            "both in the laser's driver."
        )
        yield Finding("wrong", "beam angles", text)
        return
    field = np.abs(increment) * (scans.counts.beams - 1)
    if field.max() > 2.0 * math.pi + np.abs(increment).max():
        text = (
            f"The beams of a scan cover {math.degrees(field.max()):.0f} degrees, more than a full turn: correct "
            "angle_increment in the laser's driver."
        )
        yield Finding("wrong", "beam angles", text)
    if np.median(field) < _NARROW_FIELD:
        text = (
            f"The laser sees {math.degrees(np.median(field)):.0f} degrees: with less than "
            f"{math.degrees(_NARROW_FIELD):.0f}, scans that look back see nothing in common with those before; use a "
            "wider one, or expect fewer loop closures."
        )
        yield Finding("doubtful", "field of view", text)
    if np.median(scans.counts.beams) < _MIN_BEAMS:
        text = f"A scan has {np.median(scans.counts.beams):.0f} beams: fewer than {_MIN_BEAMS} show walls too sparsely."
        yield Finding("doubtful", "few beams", text)


def _check_range_limits(scans: ScanStatistics) -> Iterator[Finding]:
    least, largest = scans.geometry[:, 2], scans.geometry[:, 3]
    wrong = ~(largest > np.maximum(least, 0.0)) | ~np.isfinite(least)
    if not wrong.any():
        return
    k = int(np.argmax(wrong))
    text = (
        f"{wrong.sum()} scans have range_min = {least[k]:g} m and range_max = {largest[k]:g} m, between which no range "
        "can be: correct both in the laser's driver."
    )
    yield Finding("wrong", "range limits", text)


def _check_ranges(scans: ScanStatistics) -> Iterator[Finding]:
    counts = scans.counts
    total = max(1, int(counts.beams.sum()))
    nan, near = (float(part.sum()) / total for part in (counts.nan, counts.near))
    if (severity := grade(nan, *_NAN)) != "fine":
        text = (
            f"{100.0 * nan:.0f} % of the ranges are NaN: a beam without a return should read inf (REP 117), and NaN "
            "means a failed measurement; look at the laser's window, its supply and the filters behind it."
        )
        yield Finding(severity, "NaN ranges", text)
    if (severity := grade(near, *_NEAR)) != "fine":
        text = (
            f"{100.0 * near:.0f} % of the ranges are below range_min = {np.median(scans.geometry[:, 2]):g} m, zeros "
            "included: if zero stands for no return, let the driver say inf; else look for what is before the laser."
        )
        yield Finding(severity, "ranges below range_min", text)
    usual = float(np.median(counts.returns / np.maximum(1, counts.beams)))
    if usual < _MIN_RETURNS[0] and nan + near < 0.5:
        text = (
            f"In a usual scan {100.0 * usual:.0f} % of the beams return: walls are out of the reach of the laser, or "
            f"range_max = {np.median(scans.geometry[:, 3]):g} m is set too small."
        )
        yield Finding("wrong" if usual < _MIN_RETURNS[1] else "doubtful", "few returns", text)


def _check_own_body(statistics: Statistics) -> Iterator[Finding]:
    beams, scans = statistics.scans.beam_statistics, statistics.scans
    same = int((scans.counts.beams == beams.returns.size).sum())
    if statistics.odometry.distance < _BODY_DISTANCE or same < _BODY_SCANS:
        return
    own = (beams.returns > _BODY_SHARE * same) & (beams.farthest < _BODY_RANGE)
    own &= beams.farthest - beams.nearest < _BODY_SPREAD
    if own.sum() < _BODY_BEAMS:
        return
    numbers = np.flatnonzero(own)
    text = (
        f"{own.sum()} beams, from number {numbers[0]} to {numbers[-1]}, always end within "
        f"{beams.farthest[own].max():.2f} m though the robot drives: they see the robot itself; turn the laser, or "
        "take them out with laser_filters."
    )
    yield Finding("doubtful", "beams on the robot", text)


def _check_sweep(scans: ScanStatistics) -> Iterator[Finding]:
    if not scans.sweep_fault_count:
        return
    text = f"{scans.sweep_fault_count} scans have a time_increment that cannot be. {scans.first_sweep_fault}"
    yield Finding("wrong", "time_increment", text)


def _check_stated_angles(messages: MessageStatistics) -> Iterator[Finding]:
    """A finding where angle_max is not angle_min plus the increments."""
    off, example = 0, ""
    for header, count in messages.scan_headers.items():
        if not header.angle_increment:
            continue
        last = header.angle_min + (header.beams - 1) * header.angle_increment
        if abs(last - header.angle_max) > 0.5 * abs(header.angle_increment):
            off += count
            example = example or (
                f"angle_min + {header.beams - 1} x angle_increment is {math.degrees(last):.2f} degrees, and angle_max "
                f"{math.degrees(header.angle_max):.2f}"
            )
    if not off:
        return
    text = (
        f"In {off} scans {example}: the number of beams or the increment is wrong; angle_min and angle_increment are "
        "believed; correct the driver."
    )
    yield Finding("doubtful", "angle_max", text)


def mounting_findings(scans: ScanStatistics) -> Iterator[Finding]:
    """A finding where the laser is stated to be far from the robot."""
    if not len(scans.laser_poses):
        return
    distance = float(np.hypot(scans.laser_poses[:, 0], scans.laser_poses[:, 1]).max())
    if distance > _FAR_LASER:
        text = (
            f"The laser is stated to be {distance:.2f} m from the robot's middle: check the unit (m) and the direction "
            "of the transform base_link -> laser."
        )
        yield Finding("wrong", "laser far away", text)
