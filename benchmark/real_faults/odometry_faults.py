"""Faults of odometry: frozen, jumping, reset and late readings, wrong scales and clocks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmark.real_faults.stream import (
    FaultPlace,
    FaultyStream,
    OdometryPath,
    chain_increments,
    change_measurement,
    draw_times,
    in_order,
    odometry_path,
    replace_poses,
)
from hmt_slam_ros.arrays import Bool
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Odometry

TURNING, STRAIGHT, DRIVING = math.radians(15.0), math.radians(4.0), 0.2
"""Turn rates of a turn, at least, and of a straight drive, at most, rad/s; speed of a drive, at least, m/s."""

_FROZEN = (0.5, 3.0)
"""Least and largest time in which readings repeat, s."""

_FREEZES, _JUMPS, _RESETS, _LATE_PERIODS = 3, 3, 2, 2
"""Places of each fault in a stretch."""

_SPACING = 20.0
"""Least time from one place to the next, s."""

_JUMP, _JUMP_TURN = (0.3, 3.0), math.radians(90.0)
"""Least and largest distance of a jump, m, and largest turn to either side, rad."""

_SCALE = (0.05, 0.15)
"""Least and largest error of the scale of turns."""

_OFFSET = (0.05, 0.3)
"""Least and largest time by which the clock of the odometry is off, s."""

_LATE_SECONDS, _BATCH = 30.0, (0.3, 1.0)
"""Time in which readings come in batches, s, and least and largest time that a batch collects, s."""

_BURST = NANOSECONDS // 1000
"""Time between two readings of a batch as they arrive, ns."""


def freeze_in_turns(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """Readings repeat for 0.5 to 3 s in three turns, and then go on at the true place."""
    path = odometry_path(records)
    return _freeze(records, path, np.abs(path.turn_rates()) > TURNING, random)


def freeze_on_straights(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """Readings repeat for 0.5 to 3 s in three straight drives, and then go on at the true place."""
    path = odometry_path(records)
    return _freeze(records, path, (np.abs(path.turn_rates()) < STRAIGHT) & (path.speeds() > DRIVING), random)


def _freeze(
    records: Sequence[LogRecord], path: OdometryPath, suitable: Bool, random: np.random.Generator
) -> FaultyStream:
    poses, places = path.poses.copy(), []
    for begin in draw_times(path.seconds, suitable, _FREEZES, _SPACING, random):
        place = FaultPlace(begin, random.uniform(*_FROZEN))
        frozen = (path.seconds > begin) & (path.seconds < begin + place.seconds)
        poses[frozen] = path.poses[np.searchsorted(path.seconds, begin)]
        places.append(place)
    return FaultyStream(replace_poses(records, path.rows, poses), tuple(places))


def jump(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """The odometry jumps three times by 0.3 to 3 m and up to 90 degrees, and goes on from there."""
    path = odometry_path(records)
    increments, places = se2.between(path.poses[:-1], path.poses[1:]), []
    everywhere = np.ones(path.seconds.size, dtype=np.bool_)
    for begin in draw_times(path.seconds, everywhere, _JUMPS, _SPACING, random):
        distance, direction = random.uniform(*_JUMP), random.uniform(-math.pi, math.pi)
        turn = random.uniform(-_JUMP_TURN, _JUMP_TURN)
        step = np.array([distance * math.cos(direction), distance * math.sin(direction), turn])
        k = int(np.searchsorted(path.seconds, begin))
        increments[k] = se2.compose(increments[k], step)
        places.append(FaultPlace(begin, amount=distance))
    return FaultyStream(replace_poses(records, path.rows, chain_increments(path.poses[0], increments)), tuple(places))


def reset_to_zero(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """The odometry begins at zero again, twice."""
    path = odometry_path(records)
    poses = path.poses.copy()
    everywhere = np.ones(path.seconds.size, dtype=np.bool_)
    places = [FaultPlace(begin) for begin in draw_times(path.seconds, everywhere, _RESETS, _SPACING, random)]
    for place in places:
        k = int(np.searchsorted(path.seconds, place.begin))
        poses[k:] = se2.between(path.poses[k], path.poses[k:])
    return FaultyStream(replace_poses(records, path.rows, poses), tuple(places))


def scale_turns(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """All turns are 5 to 15 % too large or too small."""
    path = odometry_path(records)
    error = random.choice([-1.0, 1.0]) * random.uniform(*_SCALE)
    increments = se2.between(path.poses[:-1], path.poses[1:])
    increments[:, 2] *= 1.0 + error
    poses = chain_increments(path.poses[0], increments)
    return FaultyStream(replace_poses(records, path.rows, poses), (FaultPlace(0.0, float(path.seconds[-1]), error),))


def offset_clock(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """The stamps of the odometry are 0.05 to 0.3 s late or early against the scans'."""
    offset = random.choice([-1.0, 1.0]) * random.uniform(*_OFFSET)
    shift = round(offset * NANOSECONDS)
    # The first scans of a log have stamps of a few ns where its clock begins at zero.
    shifted = [
        change_measurement(record, stamp=max(0, record.measurement.stamp + shift))
        if isinstance(record.measurement, Odometry)
        else record
        for record in records
    ]
    return FaultyStream(in_order(shifted), (FaultPlace(0.0, amount=offset),))


def deliver_in_batches(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """In two periods of 30 s readings are held back for 0.3 to 1 s, and stamped as they arrive, all at once."""
    path = odometry_path(records)
    changed, places = list(records), []
    moving = path.speeds() > DRIVING
    for begin in draw_times(path.seconds, moving, _LATE_PERIODS, 2.0 * _LATE_SECONDS, random):
        held = random.uniform(*_BATCH)
        for start in np.arange(begin, begin + _LATE_SECONDS, held):
            batch = path.rows[(path.seconds >= start) & (path.seconds < start + held)].tolist()
            # The last one is stamped rightly, so that all stamps still increase.
            for back, row in enumerate(reversed(batch)):
                stamp = changed[batch[-1]].measurement.stamp - back * _BURST
                changed[row] = change_measurement(changed[row], stamp=max(stamp, changed[row].measurement.stamp))
        places.append(FaultPlace(begin, _LATE_SECONDS, held))
    return FaultyStream(in_order(changed), tuple(places))
