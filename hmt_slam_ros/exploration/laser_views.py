"""What the lasers of a robot see around it: the newest scan of each, from where the robot is now."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Scan

_MAX_AGE = NANOSECONDS
"""Age of a scan beside the newest one from which it shows no obstacles any more, ns."""

_TURN = 2.0 * math.pi


class ObstacleView(NamedTuple):
    """Surfaces around the robot.

    :ivar stamp: of the newest scan, ns.
    :ivar points: shape (n, 2), end points of beams, m, the robot's frame at that time.
    :ivar field: largest bearing to both sides of the robot within the field of view, rad.
    """

    stamp: int
    points: Float64
    field: float


@dataclass(frozen=True, eq=False)
class _EarlierScan:
    """A scan, and the pose of the robot then in its frame now, ``base_T_then``, shape (3,)."""

    scan: Scan
    pose: Float64


class LaserViews:
    """The newest scan of each laser; lasers are distinguished by their mountings."""

    def __init__(self) -> None:
        self._newest: dict[bytes, _EarlierScan] = {}

    @property
    def newest_stamp(self) -> int | None:
        """Stamp of the last scan, ns; None before the first."""
        return next(reversed(self._newest.values())).scan.stamp if self._newest else None

    def move(self, increment: Float64) -> None:
        """Move the robot by its motion since the last call, shape (3,)."""
        back = se2.inverse(increment)
        self._newest = {
            key: _EarlierScan(placed.scan, se2.compose(back, placed.pose)) for key, placed in self._newest.items()
        }

    def add(self, scan: Scan) -> ObstacleView:
        """The view with a scan that was taken where the robot is now."""
        key = scan.laser_pose.tobytes()
        recent = {
            other: placed
            for other, placed in self._newest.items()
            if other != key and abs(scan.stamp - placed.scan.stamp) < _MAX_AGE
        }
        self._newest = {**recent, key: _EarlierScan(scan, np.zeros(3))}
        scans = [placed.scan for placed in self._newest.values()]
        points = [se2.transform(pose, other.points) for pose, other in self.others]
        joined = np.concatenate((*points, scan.points)) if points else scan.points
        return ObstacleView(scan.stamp, joined, field_of_view(scans))

    @property
    def others(self) -> list[tuple[Float64, Scan]]:
        """The scans of the other lasers than that of the last one, each with ``base_T_then`` (3,)."""
        return [(placed.pose, placed.scan) for placed in list(self._newest.values())[:-1]]

    def is_ahead(self, scan: Scan) -> bool:
        """Whether the laser of a scan looks ahead, or none of the others does."""
        lasers = [placed.scan for placed in self._newest.values()]
        return _looks_ahead(scan) or not any(_looks_ahead(other) for other in lasers)


def field_of_view(scans: Sequence[Scan]) -> float:
    """Largest bearing to both sides of the robot within the field of view of some lasers, rad."""
    gap = max(abs(scan.angle_increment) for scan in scans)
    sectors = [_sector(scan) for scan in scans]
    if any(last - first + 1.5 * gap >= _TURN for first, last in sectors):
        return math.pi
    left = _reach([(first + turn, last + turn) for first, last in sectors for turn in (-_TURN, 0.0, _TURN)], gap)
    right = _reach([(-last + turn, -first + turn) for first, last in sectors for turn in (-_TURN, 0.0, _TURN)], gap)
    return min(math.pi, min(left, right) + gap)


def _sector(scan: Scan) -> tuple[float, float]:
    """Smallest and largest bearing of the beams of a scan, rad."""
    first, last = scan.angle_min, scan.angle_min + scan.angle_increment * (scan.ranges.size - 1)
    turn = float(scan.laser_pose[2])
    return min(first, last) + turn, max(first, last) + turn


def _reach(sectors: Sequence[tuple[float, float]], gap: float) -> float:
    """Bearing up to which sectors follow each other from 0 on, rad; smaller gaps do not count."""
    reach = 0.0
    for first, last in sorted(sectors):
        if first - 1.5 * gap <= reach:
            reach = max(reach, last)
    return reach


def _looks_ahead(scan: Scan) -> bool:
    first, last = _sector(scan)
    return any(first + turn <= 0.0 <= last + turn for turn in (-_TURN, 0.0, _TURN))
