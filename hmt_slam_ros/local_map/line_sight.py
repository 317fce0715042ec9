"""What the beams of a scan end on and what they pass, in a map of lines.

A map of lines does not know where space is free. What contradicts it is that a beam passes a wall where it was seen:
it ends behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.stochastic_map import LineMap

# A beam passes a wall if it does so at least so far from where the wall was seen to end, m.
_INSIDE = 0.2
# It ends at least so far behind it, m.
_BEHIND = 0.4
# Of walls, one sample every so many m counts.
_APART = 0.2
# A wall was passed where samples of it are so near to each other, m.
_TOGETHER = 0.6


class Met(NamedTuple):
    """What the beams of a scan say of walls.

    :ivar ending: beams that end on one.
    :ivar passing: beams that pass one.
    :ivar met: samples of walls that beams end on.
    :ivar passed: samples that beams pass.
    """

    ending: int
    passing: int
    met: int
    passed: int


def met_and_passed(ends: Float64, laser: Float64, room: LineMap, near: float) -> Met:
    """Lay beams into a map of lines.

    :param ends: of the beams in their order, shape (n, 2), m, frame of the map.
    :param laser: where they begin, shape (2,), likewise.
    :param near: distance, m, from a wall below which a beam ends on it.
    """
    stretches = [(*room.lines[line], *piece) for line, wall in enumerate(room.walls) for piece in wall.pieces]
    return Met(*_compared(ends, laser, _array(stretches), near))


def _array(stretches: Sequence[tuple[float, ...]]) -> Float64:
    return np.array(stretches, dtype=np.float64).reshape(-1, 4)


@njit(cache=True)
def _compared(ends: Float64, laser: Float64, stretches: Float64, near: float) -> tuple[int, int, int, int]:
    """:param stretches: alpha, r, begin and end of each, (m, 4)."""
    ending = passing = met = passed = 0
    met_at, passed_at = np.full(2, np.inf), np.full(2, np.inf)
    at = np.empty(2)
    for i in range(len(ends)):
        if _on(ends[i], stretches, near):
            ending += 1
            if math.hypot(ends[i, 0] - met_at[0], ends[i, 1] - met_at[1]) >= _APART:
                met += 1
                met_at[:] = ends[i, :2]
        elif _through(ends[i], laser, stretches, at):
            passing += 1
            between = math.hypot(at[0] - passed_at[0], at[1] - passed_at[1])
            if between >= _APART:
                passed += between <= _TOGETHER
                passed_at[:] = at
    return ending, passing, met, passed


@njit(cache=True)
def _on(end: Float64, stretches: Float64, near: float) -> bool:
    for k in range(len(stretches)):
        cos, sin = math.cos(stretches[k, 0]), math.sin(stretches[k, 0])
        along = cos * end[1] - sin * end[0]
        off = cos * end[0] + sin * end[1] - stretches[k, 1]
        if abs(off) < near and stretches[k, 2] - near < along < stretches[k, 3] + near:
            return True
    return False


@njit(cache=True)
def _through(end: Float64, laser: Float64, stretches: Float64, at: Float64) -> bool:
    """Whether a beam passes a wall from the side from which it was seen; where it does first is written to ``at``."""
    first = np.inf
    for k in range(len(stretches)):
        cos, sin = math.cos(stretches[k, 0]), math.sin(stretches[k, 0])
        before = stretches[k, 1] - cos * laser[0] - sin * laser[1]
        behind = cos * end[0] + sin * end[1] - stretches[k, 1]
        if before <= 0.0 or behind < _BEHIND:
            continue
        share = before / (before + behind)
        x, y = laser[0] + share * (end[0] - laser[0]), laser[1] + share * (end[1] - laser[1])
        along = cos * y - sin * x
        if share < first and stretches[k, 2] + _INSIDE < along < stretches[k, 3] - _INSIDE:
            first, at[0], at[1] = share, x, y
    return first < np.inf
