"""Checks on single odometry readings: those that are no number, jump, repeat or come in batches."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.doctor.finding import Finding, grade, times_text
from hmt_slam_ros.doctor.statistics import OdometryStatistics, ScanMotions, seconds_between
from hmt_slam_ros.geometry import se2

MIN_MATCHED = 0.45
"""Least share of the points of a scan that match, for a motion to count."""

MIN_TURN, MIN_DISTANCE = math.radians(1.5), 0.03
"""Least turn, rad, and least translation, m, of a motion that is no standstill."""

_MIN_OBSERVABILITY = 0.1
"""Least ratio of the information along two directions, for a translation to count."""

_MIN_PERIOD = 0.2
"""Least period for the test on jumps, s: stamps of arrival may lie close together."""

_USUAL, _JUMP_FACTOR = 99.0, 3.0
"""Percentile of the speeds that the robot reaches, and factor from which a step is a jump."""

_JUMP_SPEED, _JUMP_TURN_RATE = 1.0, math.radians(90.0)
"""Least speed, m/s, and least turn rate, rad/s, of a jump."""

_SAME = 1e-9
"""Largest difference of repeated readings, m and rad."""

_FREEZE_SECONDS, _FREEZE_PAUSE = 0.4, 1.0
"""Shortest time for which the odometry is frozen, and longest time in it without a motion by the scans, s."""

_FREEZE_TURN, _FREEZE_DISTANCE = math.radians(6.0), 0.15
"""Motion of the robot from which repeated readings are wrong: a turn, rad, or a distance, m."""

_FROZEN = (0.0, 0.1)
"""Shares of the moving time with frozen odometry: doubtful, and wrong."""

_BURST_PERIOD, _BATCH_SIZE = 0.2, 3
"""Longest time between two readings of a batch, in usual periods, and least number of readings."""

_BATCH_COUNT, _BATCHED = 3, (0.0, 0.1)
"""Least number of batches, and the share of the readings in batches: doubtful, and wrong."""


class Freeze(NamedTuple):
    """A time in which readings repeat although the robot moves by the scans.

    :ivar begin: after the first reading, s.
    :ivar seconds: that it lasts.
    :ivar distance: by the scans, m.
    :ivar turn: by the scans, rad.
    """

    begin: float
    seconds: float
    distance: float
    turn: float


def reading_findings(odometry: OdometryStatistics, motions: ScanMotions, clock_offset: float) -> Iterator[Finding]:
    """Findings on single readings.

    :param clock_offset: odometry time less scan stamp, s, 0 where unknown.
    """
    yield from _check_finite(odometry)
    if len(odometry.stamps) < 2:
        return
    motions = motions.select(motions.matched >= MIN_MATCHED)
    freezes = find_freezes(odometry, motions, clock_offset)
    yield from _check_jumps(odometry, freezes)
    yield from _check_frozen(freezes, motions)
    yield from _check_batches(odometry)


def is_moving(motions: Float64, times: float) -> Bool:
    """Whether motions (p, 3) are no standstill, by a multiple of the least motion; shape (p,)."""
    return (np.hypot(motions[:, 0], motions[:, 1]) > times * MIN_DISTANCE) | (np.abs(motions[:, 2]) > times * MIN_TURN)


def is_observable(motions: ScanMotions) -> Float64:
    """1 for each motion, of p, that the scans show in all directions, else 0."""
    spectra = np.linalg.eigvalsh(motions.information[:, :2, :2])
    return (spectra[:, 0] > _MIN_OBSERVABILITY * spectra[:, 1]).astype(np.float64)


def _observed_steps(motions: ScanMotions) -> Float64:
    """The motions (p, 3) without translations that the scans do not show."""
    steps = motions.motions.copy()
    steps[:, :2] *= is_observable(motions)[:, None]
    return steps


def find_freezes(odometry: OdometryStatistics, motions: ScanMotions, clock_offset: float) -> list[Freeze]:
    """The times in which the odometry is frozen, in their order.

    :param motions: by well matched scans.
    :param clock_offset: odometry time less scan stamp, s.
    """
    seconds, steps = (odometry.stamps - odometry.stamps[0]) * 1e-9, _observed_steps(motions)
    repeats = (np.abs(np.diff(odometry.poses, axis=0)) <= _SAME).all(axis=1)
    # The number of the sequence of equal readings to which each reading belongs.
    sequence = np.concatenate(([0], np.cumsum(~repeats)))
    begins, ends = ((own - odometry.stamps[0]) * 1e-9 + clock_offset for own in (motions.starts, motions.ends))
    first = np.searchsorted(seconds, begins, side="right") - 1
    last = np.searchsorted(seconds, ends, side="right") - 1
    # Without a reading in between the odometry has a gap.
    repeated = (first >= 0) & (last > first) & (sequence[first] == sequence[last])
    frozen = repeated & is_moving(steps, 1.0)
    rows = np.flatnonzero(frozen)
    parted = (begins[rows[1:]] - ends[rows[:-1]] > _FREEZE_PAUSE) | (np.diff(sequence[first[rows]]) != 0)
    freezes = [
        _freeze(begins[own[0]], ends[own[-1]], steps[own])
        for own in np.split(rows, np.flatnonzero(parted) + 1)
        if own.size
    ]
    return [
        freeze
        for freeze in freezes
        if freeze.seconds >= _FREEZE_SECONDS and (freeze.distance > _FREEZE_DISTANCE or abs(freeze.turn) > _FREEZE_TURN)
    ]


def _freeze(begin: float, end: float, steps: Float64) -> Freeze:
    """The freeze with the steps (k, 3) by the scans."""
    motion = np.zeros(3)
    for step in steps:
        motion = se2.compose(motion, step)
    return Freeze(begin, end - begin, math.hypot(motion[0], motion[1]), float(steps[:, 2].sum()))


def _check_finite(odometry: OdometryStatistics) -> Iterator[Finding]:
    if not odometry.non_finite_count:
        return
    text = (
        f"{odometry.non_finite_count} odometry readings are NaN or infinite and were left out: look for a division by "
        "zero in the odometry's driver, or a quaternion of zeros."
    )
    yield Finding("wrong", "odometry not finite", text)


def _check_jumps(odometry: OdometryStatistics, freezes: list[Freeze]) -> Iterator[Finding]:
    """A finding on steps that are much longer or turn much more than the robot's others."""
    periods = seconds_between(odometry.stamps)
    seconds = np.maximum(periods, _MIN_PERIOD)
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    jumps = _is_outlier(distance / seconds, _JUMP_SPEED) | _is_outlier(turn / seconds, _JUMP_TURN_RATE)
    at = (odometry.stamps[1:] - odometry.stamps[0]) * 1e-9
    for freeze in freezes:
        # After it the odometry catches up.
        end = freeze.begin + freeze.seconds
        jumps &= ~((at >= end) & (at - periods <= end + _FREEZE_SECONDS))
    if not jumps.any():
        return
    far = int(np.argmax(np.where(jumps, distance, -1.0)))
    text = (
        f"The odometry jumps {times_text(int(jumps.sum()))}, the farthest by {distance[far]:.2f} m and "
        f"{math.degrees(turn[far]):.0f} degrees, {at[far]:.1f} s after its first reading: it was reset, or two sources "
        "publish it; it must be one path without jumps (REP 105)."
    )
    yield Finding("wrong", "odometry jumps", text)


def _is_outlier(speeds: Float64, least: float) -> Bool:
    """Whether each speed (n,) is far above those that the robot reaches, and above a least one."""
    return np.asarray(speeds > max(least, _JUMP_FACTOR * float(np.percentile(speeds, _USUAL))))


def _check_frozen(freezes: list[Freeze], motions: ScanMotions) -> Iterator[Finding]:
    if not freezes:
        return
    moving = is_moving(_observed_steps(motions), 1.0)
    moved = float(((motions.ends - motions.starts)[moving] * 1e-9).sum())
    share = sum(freeze.seconds for freeze in freezes) / max(moved, 1e-9)
    longest = max(freezes, key=lambda freeze: freeze.seconds)
    text = (
        f"The odometry stands still {times_text(len(freezes))} while the scans move, in {100.0 * share:.1f} % of the "
        f"time in which they do: the longest time for {longest.seconds:.1f} s, {longest.begin:.1f} s after its first "
        f"reading, in which the robot went {longest.distance:.2f} m and turned by {math.degrees(longest.turn):.0f} "
        "degrees; its readings are repeated, or it is not published while the robot moves by other means; look at its "
        "driver."
    )
    yield Finding(grade(share, *_FROZEN), "odometry frozen", text)


def _check_batches(odometry: OdometryStatistics) -> Iterator[Finding]:
    """A finding where readings come after a pause, all at once, as many as belong into the pause."""
    periods = seconds_between(odometry.stamps)
    usual = float(np.median(periods[periods > 0.0])) if (periods > 0.0).any() else 0.0
    batches = find_batches(periods, max(usual, float(periods.mean())))
    if len(batches) < _BATCH_COUNT:
        return
    longest = max(batches, key=lambda batch: periods[batch[0]])
    share = sum(end - begin for begin, end in batches) / len(periods)
    at = (odometry.stamps[longest[0]] - odometry.stamps[0]) * 1e-9
    text = (
        f"The odometry comes in batches {times_text(len(batches))}, {100.0 * share:.0f} % of its readings: the longest "
        f"pause takes {periods[longest[0]]:.2f} s, {at:.1f} s after its first reading, and then "
        f"{longest[1] - longest[0]} readings come at once; the stamps are those of arrival, so let the driver stamp a "
        "reading when it is measured."
    )
    yield Finding(grade(share, *_BATCHED), "odometry batches", text)


def find_batches(periods: Float64, usual: float) -> list[tuple[int, int]]:
    """Batches of readings: the number of the pause before each, and of the first period after it.

    :param periods: shape (n,), between readings, s.
    :param usual: s.
    """
    burst = periods <= _BURST_PERIOD * usual
    batches, k = [], 0
    while k < len(periods) - 1:
        end = k + 1
        while end < len(periods) and burst[end]:
            end += 1
        # The pause belongs to the first reading of the batch, each short period to one more.
        size = end - k
        if size >= _BATCH_SIZE and periods[k] >= 0.5 * size * usual:
            batches.append((k, end))
        k = end
    return batches
