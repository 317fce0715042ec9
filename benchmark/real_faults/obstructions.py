"""Obstructions before the laser: carts on both sides of the robot, as narrow as a doorway, and crowds.

Beams are shortened where they meet an obstruction; the rest of a scan stays. Obstructions stand or move in the frame of
the odometry, which is right to centimeters over the seconds that each lasts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmark.real_faults.odometry_faults import DRIVING, TURNING
from benchmark.real_faults.stream import FaultPlace, FaultyStream, OdometryPath, draw_times, odometry_path, seconds_of
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.laser import WallIndex, cast_rays, shorten_at_discs, wall_index

_NOISE = 0.01
"""Deviation of a range to an obstruction, m."""

_REACH = 10.0
"""Distance up to which obstructions are seen, m."""

_DOORWAYS, _DOORWAY_SPACING = 4, 20.0
"""Doorways of a stretch, and least time from one to the next, s."""

_HALF_STAY = (1.0, 2.0)
"""Least and largest half of the time in which the carts stand there, s."""

_HALF_LENGTH, _DEPTH = 0.9, 0.6
"""Half of the length of a cart, and its depth, m."""

_HALF_GAP = (0.4, 0.5)
"""Least and largest half of the gap between two carts, m."""

_CROWDS, _CROWD_SECONDS, _PEOPLE = 3, 40.0, 8
"""Crowds of a stretch, time that each lasts, s, and people in it."""

_RADIUS, _NEAREST = 0.2, 0.5
"""Radius of a person, and least distance of a person's middle from the laser, m."""

_WALK = 6.0
"""Time after which a person comes from elsewhere, s."""

_AROUND = (1.0, 4.0)
"""Least and largest distance at which a person's walk begins, m."""

_PACE = (0.4, 1.4)
"""Slowest and fastest pace, m/s."""


def narrow_doorways(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """Four times the robot drives for 2 to 4 s between two carts, which leave it 0.8 to 1 m; then they are gone."""
    path = odometry_path(records)
    straight = (np.abs(path.turn_rates()) < TURNING) & (path.speeds() > DRIVING)
    changed, places = list(records), []
    for middle in draw_times(path.seconds, straight, _DOORWAYS, _DOORWAY_SPACING, random):
        half, gap = random.uniform(*_HALF_STAY), random.uniform(*_HALF_GAP)
        carts = wall_index(_carts(path.poses_at(np.array([middle]))[0], gap))
        place = FaultPlace(middle - half, 2.0 * half, 2.0 * gap)
        for row in _scans_at(records, place):
            changed[row] = _obstruct(changed[row], path, records, carts, np.empty((0, 3)), random)
        places.append(place)
    return FaultyStream(changed, tuple(places))


def _carts(pose: Float64, half_gap: float) -> Float64:
    """The sides of two carts on both sides of a pose (3,), shape (8, 4)."""
    sides = []
    for side in (-1.0, 1.0):
        near, far = side * half_gap, side * (half_gap + _DEPTH)
        corners = np.array([[-_HALF_LENGTH, near], [_HALF_LENGTH, near], [_HALF_LENGTH, far], [-_HALF_LENGTH, far]])
        placed = se2.transform(pose, corners)
        sides.append(np.concatenate((placed, np.roll(placed, -1, axis=0)), axis=1))
    return np.concatenate(sides)


def crowd(records: Sequence[LogRecord], random: np.random.Generator) -> FaultyStream:
    """Three times for 40 s eight people walk around the robot; every other one walks along with it."""
    path = odometry_path(records)
    changed, places = list(records), []
    nothing = wall_index(np.array([[1e6, 1e6, 1e6 + 1.0, 1e6]]))
    driving = path.speeds() > DRIVING
    for begin in draw_times(path.seconds, driving, _CROWDS, 1.5 * _CROWD_SECONDS, random):
        place = FaultPlace(begin, _CROWD_SECONDS, _PEOPLE)
        walks = _draw_walks(path, place, random)
        seconds = seconds_of(records)
        for row in _scans_at(records, place):
            changed[row] = _obstruct(changed[row], path, records, nothing, walks.discs_at(seconds[row]), random)
        places.append(place)
    return FaultyStream(changed, tuple(places))


class _Walks:
    """The walks of people, one after the other for each of them.

    :param begins: time at which the first walk begins, s.
    :param starts: shape (walks, people, 2), where each begins, m, in the frame of the odometry.
    :param velocities: shape (walks, people, 2), m/s.
    """

    def __init__(self, begin: float, starts: Float64, velocities: Float64) -> None:
        self._begin, self._starts, self._velocities = begin, starts, velocities

    def discs_at(self, seconds: float) -> Float64:
        """The people at a time, s: shape (people, 3), x, y and radius, m."""
        number = min(int((seconds - self._begin) / _WALK), len(self._starts) - 1)
        walked = seconds - self._begin - number * _WALK
        middles = self._starts[number] + walked * self._velocities[number]
        return np.concatenate((middles, np.full((len(middles), 1), _RADIUS)), axis=1)


def _draw_walks(path: OdometryPath, place: FaultPlace, random: np.random.Generator) -> _Walks:
    count = math.ceil(place.seconds / _WALK)
    starts, velocities = np.empty((count, _PEOPLE, 2)), np.empty((count, _PEOPLE, 2))
    for number in range(count):
        begin = place.begin + number * _WALK
        here, there = path.poses_at(np.array([begin, begin + _WALK]))
        for person in range(_PEOPLE):
            around, direction = random.uniform(*_AROUND), random.uniform(-math.pi, math.pi)
            starts[number, person] = here[:2] + around * np.array([math.cos(direction), math.sin(direction)])
            pace, heading = random.uniform(*_PACE), random.uniform(-math.pi, math.pi)
            along = (there - here)[:2] / _WALK
            alone = pace * np.array([math.cos(heading), math.sin(heading)])
            velocities[number, person] = along if person % 2 else alone
    return _Walks(place.begin, starts, velocities)


def _scans_at(records: Sequence[LogRecord], place: FaultPlace) -> list[int]:
    """Rows of the scans at a place."""
    seconds = seconds_of(records)
    rows = np.flatnonzero((seconds >= place.begin) & (seconds < place.begin + place.seconds)).tolist()
    return [row for row in rows if isinstance(records[row].measurement, Scan)]


def _obstruct(
    record: LogRecord,
    path: OdometryPath,
    records: Sequence[LogRecord],
    walls: WallIndex,
    discs: Float64,
    random: np.random.Generator,
) -> LogRecord:
    """The record of a scan with beams shortened by walls and discs (k, 3) in the frame of the odometry."""
    scan = record.measurement
    assert isinstance(scan, Scan)
    seconds = (scan.stamp - records[0].measurement.stamp) * 1e-9
    laser = se2.compose(path.poses_at(np.array([seconds]))[0], scan.laser_pose)
    angles = laser[2] + scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
    origins = np.tile(laser[:2], (angles.size, 1))
    distances = cast_rays(walls, origins, angles, _REACH)
    shorten_at_discs(_push_away(discs, laser), origins, angles, distances)
    seen = np.isfinite(distances) & ~(scan.ranges <= distances)
    noisy = np.maximum(distances + _NOISE * random.standard_normal(distances.size), scan.range_min)
    return replace(record, measurement=replace(scan, ranges=np.where(seen, noisy, scan.ranges).astype(np.float32)))


def _push_away(discs: Float64, laser: Float64) -> Float64:
    """People (k, 3) who keep their distance from the laser, (3,)."""
    offsets = discs[:, :2] - laser[:2]
    distances = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-6)
    pushed = discs.copy()
    pushed[:, :2] = laser[:2] + offsets * np.maximum(1.0, _NEAREST / distances)[:, None]
    return pushed
