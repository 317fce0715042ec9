"""Faults of scans: gaps, a low rate, few or varying beams, a short reach, a narrow view and empty scans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmark.real_faults.stream import (
    MARGIN,
    FaultPlace,
    FaultyStream,
    OdometryPath,
    change_measurement,
    change_scans,
    draw_times,
    odometry_path,
    seconds_of,
)
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Odometry, Scan

_GAP = (1.0, 200.0)
"""Least and largest length of a gap, s; its logarithm is uniform."""

_GAP_SHARE = 0.4
"""Largest share of a stretch that a gap takes."""

_GAP_SPEED = 0.1
"""Least mean speed in a gap with motion, m/s."""

_STANDING = 0.05
"""Largest speed of a robot that stands, m/s."""

_TRIALS = 1000

_IDLE_PERIOD = 0.1
"""Time between readings of a robot that stands in a gap, s."""

_SLOW_PERIOD = 0.999
"""Least time between two scans at 1 Hz, s; stamps jitter."""

_ONE_DEGREE = math.radians(1.0)
_BEAMS = 180
"""Beams of every other scan; those between have one more."""

_REACH = 4.0
"""Reach of a short-range laser, m."""

_HALF_VIEW = math.radians(120.0)
"""Half of the view of a laser that sees 240 degrees, rad."""

_EMPTY_EVERY = 10
"""Scans of which one is empty."""


def drop_scans_in_motion(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """No scans for 1 to 200 s while the robot drives on; the odometry goes on."""
    path = odometry_path(records)
    place = _draw_gap(path, random)
    seconds = seconds_of(records)
    kept = [
        record
        for record, at in zip(records, seconds, strict=True)
        if isinstance(record.measurement, Odometry) or not place.begin < at < place.begin + place.seconds
    ]
    return FaultyStream(kept, (place,))


def _draw_gap(path: OdometryPath, random: np.random.Generator) -> FaultPlace:
    """A gap in which the robot drives; its amount is the distance, m."""
    traveled = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path.poses[:, :2], axis=0).T))))
    for _ in range(_TRIALS):
        gap = _draw_gap_seconds(path, random)
        begin = random.uniform(MARGIN, path.seconds[-1] - MARGIN - gap)
        distance = float(np.diff(np.interp([begin, begin + gap], path.seconds, traveled))[0])
        if distance > _GAP_SPEED * gap:
            return FaultPlace(begin, gap, distance)
    raise HmtSlamError("the robot hardly moves in the stretch: choose another one for a gap with motion")


def _draw_gap_seconds(path: OdometryPath, random: np.random.Generator) -> float:
    longest = min(_GAP[1], _GAP_SHARE * float(path.seconds[-1]))
    return float(np.exp(random.uniform(math.log(_GAP[0]), math.log(longest))))


def pause(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """The robot stands for 1 to 200 s without scans, and in one of two cases without odometry too."""
    path = odometry_path(records)
    speeds = path.speeds()
    standing = speeds <= max(_STANDING, float(np.percentile(speeds, 5)))
    (begin,) = draw_times(path.seconds, standing, 1, 0.0, random)
    gap, is_idle = _draw_gap_seconds(path, random), bool(random.random() < 0.5)
    row = int(path.rows[np.searchsorted(path.seconds, begin)])
    shift = round(gap * NANOSECONDS)
    # A scan of the same stamp follows its odometry.
    first = row + 1
    while first < len(records) and records[first].measurement.stamp == records[row].measurement.stamp:
        first += 1
    later = [change_measurement(record, stamp=record.measurement.stamp + shift) for record in records[first:]]
    between = _idle_readings(records[row], gap) if is_idle else []
    return FaultyStream([*records[:first], *between, *later], (FaultPlace(begin, gap),))


def _idle_readings(record: LogRecord, seconds: float) -> list[LogRecord]:
    """Readings of a robot that stands after a reading."""
    count = math.ceil(seconds / _IDLE_PERIOD) - 1
    steps = (round((1 + k) * _IDLE_PERIOD * NANOSECONDS) for k in range(count))
    return [change_measurement(record, stamp=record.measurement.stamp + step) for step in steps]


def scan_slowly(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """One scan a second."""
    kept: list[LogRecord] = []
    due = float(random.uniform(0.0, 1.0))
    for record, at in zip(records, seconds_of(records), strict=True):
        if isinstance(record.measurement, Odometry):
            kept.append(record)
        elif at >= due:
            kept.append(record)
            due = at + _SLOW_PERIOD
    return FaultyStream(kept, (FaultPlace(0.0),))


def thin_to_one_degree(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """One beam a degree, beginning with the first or a later one."""
    first = int(random.integers(2))
    return FaultyStream(change_scans(records, lambda _, scan: _thin(scan, first)), (FaultPlace(0.0),))


def _thin(scan: Scan, first: int) -> Scan:
    """The scan with beams a degree apart, from beam ``first`` on."""
    every = max(1, round(_ONE_DEGREE / abs(scan.angle_increment)))
    if every == 1:
        return scan
    return _select_beams(scan, first, scan.ranges.size, every)


def _select_beams(scan: Scan, first: int, end: int, every: int = 1) -> Scan:
    """The beams from ``first`` to before ``end``."""
    return replace(
        scan,
        ranges=scan.ranges[first:end:every].copy(),
        angle_min=scan.angle_min + first * scan.angle_increment,
        angle_increment=every * scan.angle_increment,
        time_increment=every * scan.time_increment,
    )


def vary_beam_count(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """180 and 181 beams in turn, a degree apart; the last of 181 has no return."""
    odd = int(random.integers(2))

    def change(number: int, scan: Scan) -> Scan:
        thin = _select_beams(thinned := _thin(scan, 0), 0, min(_BEAMS, thinned.ranges.size))
        if number % 2 == odd:
            return thin
        return replace(thin, ranges=np.append(thin.ranges, np.float32(np.inf)))

    return FaultyStream(change_scans(records, change), (FaultPlace(0.0),))


def shorten_reach(records: Sequence[LogRecord], _: np.random.Generator) -> FaultyStream:
    """The laser reaches 4 m."""

    def change(_: int, scan: Scan) -> Scan:
        ranges = np.where(scan.ranges < _REACH, scan.ranges, np.float32(np.inf))
        return replace(scan, ranges=ranges, range_max=min(scan.range_max, _REACH))

    return FaultyStream(change_scans(records, change), (FaultPlace(0.0),))


def narrow_view(records: Sequence[LogRecord], _: np.random.Generator) -> FaultyStream:
    """The laser sees 240 degrees of a full turn."""

    def change(_: int, scan: Scan) -> Scan:
        angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
        seen = np.flatnonzero(np.abs(angles) <= _HALF_VIEW)
        return _select_beams(scan, int(seen[0]), int(seen[-1]) + 1)

    return FaultyStream(change_scans(records, change), (FaultPlace(0.0),))


def empty_some_scans(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """In every tenth scan no beam returns."""
    first = int(random.integers(_EMPTY_EVERY))

    def change(number: int, scan: Scan) -> Scan:
        if number % _EMPTY_EVERY != first:
            return scan
        return replace(scan, ranges=np.full_like(scan.ranges, np.inf))

    return FaultyStream(change_scans(records, change), (FaultPlace(0.0),))
