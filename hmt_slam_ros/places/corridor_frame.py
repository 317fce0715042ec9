"""Where a robot is between the walls: in a frame along these, with its last node and the middle of its hallway.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: its heading between the walls is estimated apart from its place,
Eq. (2). Odometry is its place for the few metres that count, which are those since its last node. What a driver goes by
is told in the frame of the base.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.landmarks.area_classes import NOTHING_AROUND, distances_around, log_odds, sector_of, space_within
from hmt_slam_ros.landmarks.beam_labels import Rays
from hmt_slam_ros.landmarks.heading import QUARTER, BuildingHeading
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.sensors.motion_model import Step

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


ALONG = math.radians(25.0)
"""A robot is along an axis, and looks through an opening, within this angle of it, rad."""

# A chord along a hallway is this share of the longest one.
_LONG = 0.5
# Deviation of what is seen of the robot's place, m.
_HERE = 0.02


class Noticed(NamedTuple):
    """A node that the robot is at, or that it passed.

    :ivar place: shape (2,), in the frame along the walls, m.
    :ivar variance: of its place along the hallway as seen from the robot now, m^2.
    """

    place: Float64
    variance: float


class WallFrame:
    """A robot, its hallway and its last node, in the frame along the walls.

    An axis is so many quarters of a turn to the left from x, without wrapping.

    :ivar pose: shape (3,), ``walls_T_base``, m and rad.
    :ivar axis: along which the robot travels.
    :ivar middle: shape (2,), a place in the middle of the hallway, m.
    :ivar node: the last one; None before the first one.
    """

    def __init__(self, features: Features) -> None:
        self._features, self._heading = features, BuildingHeading(features)
        self._distances = NOTHING_AROUND
        self.pose, self.axis, self.middle = np.zeros(3), 0, np.zeros(2)
        self.node: Noticed | None = None

    def moved(self, step: Step) -> None:
        """The robot moved."""
        self._heading.predict(step)
        if not self.known:
            return
        forward = se2.transform(np.array((0.0, 0.0, self.pose[2])), step.increment[None, :2])[0]
        self.pose = np.array((*(self.place + forward), self._heading.angle))
        if self.node is not None:
            self.node = self.node._replace(variance=self.node.variance + float(step.covariance[:2, :2].max()))

    def observe(self, lines: Lines, rays: Rays) -> None:
        """Correct the heading by the lines of a scan, and keep how far its beams see."""
        self._heading.observe(lines)
        if self.known:
            self.pose = np.array((*self.place, self._heading.angle))
            self._distances = distances_around(rays)

    @property
    def known(self) -> bool:
        """Whether walls were seen."""
        return self._heading.known

    @property
    def place(self) -> Float64:
        """Where the robot is, m, shape (2,)."""
        return self.pose[:2]

    @property
    def pose_belief(self) -> PoseGaussian:
        """The belief over ``walls_T_base``."""
        return PoseGaussian(self.pose, np.diag([_HERE**2, _HERE**2, self._heading.variance]))

    @property
    def looks(self) -> int:
        """The axis along which the robot looks most nearly."""
        return round(self.pose[2] / QUARTER)

    @property
    def askew(self) -> float:
        """How far to the left of this axis it looks, rad."""
        return float(self.pose[2] - QUARTER * self.looks)

    @property
    def aligned(self) -> bool:
        """Whether it is along this axis."""
        return abs(self.askew) <= ALONG

    @property
    def looks_ahead(self) -> bool:
        """Whether it is along the axis along which it travels, and not on a turn."""
        return self.looks == self.axis and self.aligned

    @property
    def direction(self) -> Float64:
        """Unit vector along the hallway, as the robot travels, shape (2,)."""
        return _unit(self.axis)

    @property
    def left(self) -> Float64:
        """Unit vector across it, shape (2,)."""
        return _unit(self.axis + 1)

    @property
    def away(self) -> float:
        """How far the robot is beyond its last node in its direction of travel, m."""
        assert self.node is not None
        return float((self.place - self.node.place) @ self.direction)

    @property
    def aside(self) -> float:
        """How far the robot is to the right of the hallway's middle, m."""
        return float((self.middle - self.place) @ self.left)

    @property
    def node_place(self) -> Float64:
        """The place of the last node, or where the robot is before the first one, m, shape (2,)."""
        return self.place if self.node is None else self.node.place

    def is_near(self, place: Float64 | None, distance: float) -> bool:
        """Whether the robot is so near to a place that it was at, m; wheels that stand and roll tell of ways, too."""
        return place is not None and math.dist(self.place, place) <= distance

    def along(self, axis: int) -> float:
        """How far the robot came along an axis, from anywhere, m."""
        return float(self.place @ _unit(axis))

    def free(self, quarters: int) -> float:
        """How far one sees so many quarters to the right of the direction of travel, m; nan where no beam tells."""
        return float(self._distances[sector_of(np.array(QUARTER * (self.axis - quarters) - self.pose[2]))])

    def beyond(self, distance: float) -> Float64:
        """The place in the hallway's middle so far ahead of the robot, m, shape (2,)."""
        return np.asarray(self.place + distance * self.direction + self.aside * self.left)

    def ahead(self, distance: float) -> Float64:
        """The same place in the frame of the base."""
        return self._seen_from_base(self.beyond(distance))

    def on_line(self, axis: int, distance: float) -> Float64:
        """The place so far ahead of the robot, m, on the line along an axis through its last node; likewise."""
        node, along = self.node_place, _unit(axis)
        return self._seen_from_base(node + (float((self.place - node) @ along) + distance) * along)

    def beside_node(self, axis: int, distance: float) -> Float64:
        """The place so far from the last node along an axis, m; likewise."""
        return self._seen_from_base(self.node_place + distance * _unit(axis))

    def _seen_from_base(self, place: Float64) -> Float64:
        return np.asarray(se2.transform(se2.inverse(self.pose), place[None])[0])

    @property
    def sees_hallway(self) -> bool:
        """Whether what is free around the robot is a hallway along the axis along which it looks."""
        space, right = space_within(self._distances), self.axis - self.looks
        chord = self.free(right) + self.free(right - 2)
        return space is not None and log_odds(space, self._features) > 0.0 and chord >= _LONG * space.length

    def find_middle(self, lines: Lines) -> None:
        """The middle of the hallway along which the robot looks, where both walls are in sight."""
        left, right = (wall_beside(lines, QUARTER * side - self.pose[2]) for side in (self.looks + 1, self.looks - 1))
        if left is not None and right is not None:
            self.middle = self.place + 0.5 * (left - right) * _unit(self.looks + 1)


def _unit(axis: int) -> Float64:
    """Unit vector along an axis."""
    return np.array((math.cos(QUARTER * axis), math.sin(QUARTER * axis)))
