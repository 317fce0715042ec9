"""What a stochastic map remembers, as values."""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.features.marks import Marks


class Wall(NamedTuple):
    """What the map knows of a line beside its place in the state.

    :ivar name: a number that no other line of the map ever has.
    :ivar sightings: scans that showed it.
    :ivar pieces: where the stretches that were seen begin and end, (m, 2), m along its direction
        (-sin(alpha), cos(alpha)) from the foot of the perpendicular.
    """

    name: int
    sightings: int
    pieces: Float64


class LineMapState(NamedTuple):
    """A stochastic map as a value.

    :ivar mean: shape (3 + 2 n,), x and y in m, theta in rad, then alpha in rad and r in m of each line.
    :ivar covariance: shape (3 + 2 n, 3 + 2 n).
    :ivar walls: the n lines, in the order of the state.
    :ivar names: how many lines were given one.
    :ivar marks: poses where the robot was.
    """

    mean: Float64
    covariance: Float64
    walls: tuple[Wall, ...]
    names: int
    marks: Marks
