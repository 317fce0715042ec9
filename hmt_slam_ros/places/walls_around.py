"""The walls of the hallway around a robot, by the lines of a scan: to both sides, and across at its end."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.features.extraction import Lines
from hmt_slam_ros.geometry import se2

# Walls are within this angle of the hallway's axis, or of square to it, rad.
_ASKEW = math.radians(20.0)
# So much of a wall is seen, m, up to so far to both sides of the robot: of a wall across, and of one beside it, m; that
# is so near, m.
_SEEN, _ACROSS, _BESIDE, _NEAR = 0.8, 0.8, 4.0, 2.5


def wall_ahead(lines: Lines, bearing: float) -> float | None:
    """How far the nearest wall across a hallway is, m; None where there is none.

    :param bearing: of the hallway, rad, the robot's frame.
    """
    walls = lines.parameters[_across(lines, bearing) & (_seen(lines, _ACROSS) >= _SEEN), 1]
    return float(walls.min()) if walls.size else None


def wall_beside(lines: Lines, bearing: float) -> float | None:
    """How far the wall on a side of a hallway is, m; None where none is seen.

    It is the line of which most is seen: people, and the leaves of closed doors, are shorter.

    :param bearing: of the side, rad, the robot's frame.
    """
    beside = _across(lines, bearing) & (lines.parameters[:, 1] <= _NEAR)
    seen = np.where(beside, _seen(lines, _BESIDE), 0.0)
    if not seen.size or seen.max() < _SEEN:
        return None
    return float(lines.parameters[int(np.argmax(seen)), 1])


def _across(lines: Lines, bearing: float) -> Bool:
    """Which lines are square to a bearing, shape (n,)."""
    return np.asarray(np.abs(se2.wrap(lines.parameters[:, 0] - bearing)) <= _ASKEW)


def _seen(lines: Lines, around: float) -> Float64:
    """How much is seen of lines up to so far to both sides of the robot, m, shape (n,)."""
    seen = np.zeros(len(lines))
    near = np.clip(lines.pieces, -around, around)
    np.add.at(seen, lines.owners, near[:, 1] - near[:, 0])
    return seen
