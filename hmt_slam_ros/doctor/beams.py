"""The geometry of the scans and what their beams measure."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.doctor.finding import Finding, grade
from hmt_slam_ros.doctor.statistics import MessageStatistics, ScanStatistics, Statistics

# Shares of all beams from which on something is doubtful, and wrong.
_NAN, _NEAR = (0.05, 0.3), (0.05, 0.3)
# Of a usual scan so many beams should return; fewer are doubtful, and still fewer wrong.
_RETURNS = (0.25, 0.08)
_NARROW, _FEW = math.radians(90.0), 60
# A beam sees the robot itself if in almost all scans it ends at the same short distance, m, of a robot that drove, m.
_OWN_RANGE, _OWN_SPREAD, _OWN_SHARE, _DRIVEN = 1.0, 0.15, 0.9, 5.0
_FEWEST_OWN = 2


def findings(statistics: Statistics) -> list[Finding]:
    """What the beams tell."""
    scans = statistics.scans
    if not len(scans.stamps):
        return []
    found = [
        *_check_angles(scans),
        *_check_range_limits(scans),
        *_check_ranges(scans),
        *_check_own_body(statistics),
        *_check_sweep(scans),
    ]
    if statistics.messages is not None:
        found += _check_stated_angles(statistics.messages)
    return [_summary(scans), *found]


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


def _check_angles(scans: ScanStatistics) -> list[Finding]:
    first, increment = scans.geometry[:, 0], scans.geometry[:, 1]
    impossible = ~np.isfinite(first) | ~np.isfinite(increment) | (increment == 0.0)
    if impossible.any():
        k = int(np.argmax(impossible))
        text = (
            f"{impossible.sum()} scans have angle_min = {first[k]:g} and angle_increment = {increment[k]:g}: correct "
            "both in the laser's driver."
        )
        return [Finding("wrong", "beam angles", text)]
    field = np.abs(increment) * (scans.counts.beams - 1)
    found = []
    if field.max() > 2.0 * math.pi + np.abs(increment).max():
        text = (
            f"The beams of a scan cover {math.degrees(field.max()):.0f} degrees, more than a full turn: correct "
            "angle_increment in the laser's driver."
        )
        found.append(Finding("wrong", "beam angles", text))
    if np.median(field) < _NARROW:
        text = (
            f"The laser sees {math.degrees(np.median(field)):.0f} degrees: with less than "
            f"{math.degrees(_NARROW):.0f}, scans that look back see nothing in common with those before; use a wider "
            "one, or expect fewer loop closures."
        )
        found.append(Finding("doubtful", "field of view", text))
    if np.median(scans.counts.beams) < _FEW:
        text = f"A scan has {np.median(scans.counts.beams):.0f} beams: fewer than {_FEW} show walls too sparsely."
        found.append(Finding("doubtful", "few beams", text))
    return found


def _check_range_limits(scans: ScanStatistics) -> list[Finding]:
    least, largest = scans.geometry[:, 2], scans.geometry[:, 3]
    wrong = ~(largest > np.maximum(least, 0.0)) | ~np.isfinite(least)
    if not wrong.any():
        return []
    k = int(np.argmax(wrong))
    text = (
        f"{wrong.sum()} scans have range_min = {least[k]:g} m and range_max = {largest[k]:g} m, between which no range "
        "can be: correct both in the laser's driver."
    )
    return [Finding("wrong", "range limits", text)]


def _check_ranges(scans: ScanStatistics) -> list[Finding]:
    counts = scans.counts
    total = max(1, int(counts.beams.sum()))
    nan, near = (float(part.sum()) / total for part in (counts.nan, counts.near))
    found = []
    if (severity := grade(nan, *_NAN)) != "fine":
        text = (
            f"{100.0 * nan:.0f} % of the ranges are NaN: a beam without a return should read inf (REP 117), and NaN "
            "means a failed measurement; look at the laser's window, its supply and the filters behind it."
        )
        found.append(Finding(severity, "NaN ranges", text))
    if (severity := grade(near, *_NEAR)) != "fine":
        text = (
            f"{100.0 * near:.0f} % of the ranges are below range_min = {np.median(scans.geometry[:, 2]):g} m, zeros "
            "included: if zero stands for no return, let the driver say inf; else look for what is before the laser."
        )
        found.append(Finding(severity, "ranges below range_min", text))
    usual = float(np.median(counts.returns / np.maximum(1, counts.beams)))
    if usual < _RETURNS[0] and nan + near < 0.5:
        text = (
            f"In a usual scan {100.0 * usual:.0f} % of the beams return: walls are out of the reach of the laser, or "
            f"range_max = {np.median(scans.geometry[:, 3]):g} m is set too small."
        )
        found.append(Finding("wrong" if usual < _RETURNS[1] else "doubtful", "few returns", text))
    return found


def _check_own_body(statistics: Statistics) -> list[Finding]:
    each, scans = statistics.scans.beam_statistics, statistics.scans
    same = int((scans.counts.beams == each.returns.size).sum())
    if statistics.odometry.distance < _DRIVEN or same < 50:
        return []
    own = (each.returns > _OWN_SHARE * same) & (each.farthest < _OWN_RANGE)
    own &= each.farthest - each.nearest < _OWN_SPREAD
    if own.sum() < _FEWEST_OWN:
        return []
    numbers = np.flatnonzero(own)
    text = (
        f"{own.sum()} beams, from number {numbers[0]} to {numbers[-1]}, always end within "
        f"{each.farthest[own].max():.2f} m though the robot drives: they see the robot itself; turn the laser, or take "
        "them out with laser_filters."
    )
    return [Finding("doubtful", "beams on the robot", text)]


def _check_sweep(scans: ScanStatistics) -> list[Finding]:
    if not scans.sweep_fault_count:
        return []
    text = f"{scans.sweep_fault_count} scans have a time_increment that cannot be. {scans.first_sweep_fault}"
    return [Finding("wrong", "time_increment", text)]


def _check_stated_angles(messages: MessageStatistics) -> list[Finding]:
    """Messages whose last angle is not where the increment leads."""
    off, example = 0, ""
    for head, count in messages.scan_headers.items():
        if not head.angle_increment:
            continue
        last = head.angle_min + (head.beams - 1) * head.angle_increment
        if abs(last - head.angle_max) > 0.5 * abs(head.angle_increment):
            off += count
            example = example or (
                f"angle_min + {head.beams - 1} x angle_increment is {math.degrees(last):.2f} degrees, and angle_max "
                f"{math.degrees(head.angle_max):.2f}"
            )
    if not off:
        return []
    text = (
        f"In {off} scans {example}: the number of beams or the increment is wrong; angle_min and angle_increment are "
        "believed; correct the driver."
    )
    return [Finding("doubtful", "angle_max", text)]
