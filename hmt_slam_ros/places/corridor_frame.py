"""The robot's heading between the walls of a building, after Tomatis, Nourbakhsh and Siegwart (2003), section 3.3.

Walls are parallel or square to each other, so that every line tells the heading up to quarters of a turn, and odometry
tells which of the four: an extended Kalman filter over the heading alone, which needs no map and never drifts. Of what
it does not know, the noise of the lines averages out, and how far walls are from being square does not: that is the
same when they are seen again, and is kept apart.


Where a robot is between the walls: in a frame along these, with its last node and the middle of its hallway.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: its heading between the walls is estimated apart from its place,
Eq. (2). Odometry is its place for the few metres that count, which are those since its last node. What a driver goes by
is told in the frame of the base.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.landmarks.area_classes import (
    UNKNOWN_DISTANCES,
    distances_around,
    hallway_log_odds,
    sector_indices,
    space_from_distances,
)
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.rays import Rays
from hmt_slam_ros.sensors.motion_model import RelativeMotion

QUARTER_TURN = 0.5 * math.pi
"""Between two headings from which walls look the same, rad."""


class BuildingHeading:
    """The heading in a frame along whose axes the walls run; unknown until the first lines are seen.

    The axis that the robot is nearest to then is x.

    :ivar angle: rad, from 0 on without wrapping, nan while it is unknown.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._gate = chi_square_gate(features.pair_probability, 1)
        self._wall_variance = math.radians(features.square_deviation) ** 2
        self.angle = math.nan
        self._line_variance, self._squareness_variance = 0.0, 0.0

    @property
    def is_known(self) -> bool:
        """Whether lines were seen."""
        return not math.isnan(self.angle)

    @property
    def variance(self) -> float:
        """Of the angle, rad^2."""
        return self._line_variance + self._squareness_variance

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self.angle += float(step.increment[2])
        self._line_variance += float(step.covariance[2, 2])

    def observe(self, lines: Lines) -> int:
        """Correct the heading by the lines that are along or across the building.

        :returns: how many these are.
        """
        alphas, noise = lines.parameters[:, 0], lines.covariances[:, 0, 0]
        before = self.variance
        if not self.is_known:
            if not len(lines):
                return 0
            k = _consensus_line(alphas, noise + self._wall_variance)
            self.angle, before = float(_wrap_to_quarter(-alphas[k])), float(noise[k])
            self._line_variance = QUARTER_TURN**2
        differences = _wrap_to_quarter(-alphas - self.angle)
        # Eq. (2), n = 1.
        used = differences**2 <= self._gate * (noise + self._wall_variance + before)
        if used.any():
            self._correct(differences[used], noise[used])
        return int(used.sum())

    def _correct(self, differences: Float64, noise: Float64) -> None:
        """By the weighted mean of what lines tell of the heading, rad, which differ in their noise, rad^2."""
        weights = 1.0 / (noise + self._wall_variance)
        weights /= weights.sum()
        together = float(weights**2 @ noise)
        gain = self._line_variance / (self._line_variance + together)
        self.angle += gain * float(weights @ differences)
        self._line_variance *= 1.0 - gain
        self._squareness_variance = self._wall_variance * float(weights @ weights)


def _consensus_line(alphas: Float64, variances: Float64) -> int:
    """The line with which most others agree, the longest counting most."""
    apart = _wrap_to_quarter(alphas[:, None] - alphas[None, :])
    agreeing = np.exp(-0.5 * apart**2 / (variances[:, None] + variances[None, :])) / np.sqrt(variances)
    return int(agreeing.sum(axis=1).argmax())


def _wrap_to_quarter(angles: Float64) -> Float64:
    """Angles up to quarters of a turn, in [-pi/4, pi/4)."""
    return (angles + 0.5 * QUARTER_TURN) % QUARTER_TURN - 0.5 * QUARTER_TURN


# Walls are within this angle of the hallway's axis, or of square to it, rad.
_WALL_ANGLE_TOLERANCE = math.radians(20.0)
# So much of a wall is seen, m, up to so far to both sides of the robot: of a wall across, and of one beside it, m; that
# is so near, m.
_MIN_VISIBLE_LENGTH, _ACROSS, _BESIDE, _NEAR = 0.8, 0.8, 4.0, 2.5


def distance_to_wall_ahead(lines: Lines, bearing: float) -> float | None:
    """How far the nearest wall across a hallway is, m; None where there is none.

    :param bearing: of the hallway, rad, the robot's frame.
    """
    walls = lines.parameters[_is_across(lines, bearing) & (_visible_lengths(lines, _ACROSS) >= _MIN_VISIBLE_LENGTH), 1]
    return float(walls.min()) if walls.size else None


def distance_to_wall_beside(lines: Lines, bearing: float) -> float | None:
    """How far the wall on a side of a hallway is, m; None where none is seen.

    It is the line of which most is seen: people, and the leaves of closed doors, are shorter.

    :param bearing: of the side, rad, the robot's frame.
    """
    beside = _is_across(lines, bearing) & (lines.parameters[:, 1] <= _NEAR)
    seen = np.where(beside, _visible_lengths(lines, _BESIDE), 0.0)
    if not seen.size or seen.max() < _MIN_VISIBLE_LENGTH:
        return None
    return float(lines.parameters[int(np.argmax(seen)), 1])


def _is_across(lines: Lines, bearing: float) -> Bool:
    """Which lines are square to a bearing, shape (n,)."""
    return np.asarray(np.abs(se2.wrap(lines.parameters[:, 0] - bearing)) <= _WALL_ANGLE_TOLERANCE)


def _visible_lengths(lines: Lines, around: float) -> Float64:
    """How much is seen of lines up to so far to both sides of the robot, m, shape (n,)."""
    seen = np.zeros(len(lines))
    near = np.clip(lines.segments, -around, around)
    np.add.at(seen, lines.owners, near[:, 1] - near[:, 0])
    return seen


ALIGNMENT_TOLERANCE = math.radians(25.0)
"""A robot is along an axis, and looks through an opening, within this angle of it, rad."""

# A chord along a hallway is this share of the longest one.
_LONG = 0.5
# Deviation of what is seen of the robot's place, m.
_POSITION_DEVIATION = 0.02


class DetectedNode(NamedTuple):
    """A node that the robot is at, or that it passed.

    :ivar position: shape (2,), in the frame along the walls, m.
    :ivar variance: of its place along the hallway as seen from the robot now, m^2.
    """

    position: Float64
    variance: float


class CorridorFrame:
    """A robot, its hallway and its last node, in the frame along the walls.

    An axis is so many quarters of a turn to the left from x, without wrapping.

    :ivar pose: shape (3,), ``walls_T_base``, m and rad.
    :ivar travel_axis: along which the robot travels.
    :ivar hallway_center: shape (2,), a place in the middle of the hallway, m.
    :ivar last_node: the last one; None before the first one.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._features, self._heading = features, BuildingHeading(features)
        self._sector_distances = UNKNOWN_DISTANCES
        self.pose, self.travel_axis, self.hallway_center = np.zeros(3), 0, np.zeros(2)
        self.last_node: DetectedNode | None = None

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self._heading.predict(step)
        if not self.is_initialized:
            return
        forward = se2.transform(np.array((0.0, 0.0, self.pose[2])), step.increment[None, :2])[0]
        self.pose = np.array((*(self.position + forward), self._heading.angle))
        if self.last_node is not None:
            self.last_node = self.last_node._replace(
                variance=self.last_node.variance + float(step.covariance[:2, :2].max())
            )

    def observe(self, lines: Lines, rays: Rays) -> None:
        """Correct the heading by the lines of a scan, and keep how far its beams see."""
        self._heading.observe(lines)
        if self.is_initialized:
            self.pose = np.array((*self.position, self._heading.angle))
            self._sector_distances = distances_around(rays)

    @property
    def is_initialized(self) -> bool:
        """Whether walls were seen."""
        return self._heading.is_known

    @property
    def position(self) -> Float64:
        """Where the robot is, m, shape (2,)."""
        return self.pose[:2]

    @property
    def pose_belief(self) -> PoseGaussian:
        """The belief over ``walls_T_base``."""
        return PoseGaussian(
            self.pose, np.diag([_POSITION_DEVIATION**2, _POSITION_DEVIATION**2, self._heading.variance])
        )

    @property
    def facing_axis(self) -> int:
        """The axis along which the robot looks most nearly."""
        return round(self.pose[2] / QUARTER_TURN)

    @property
    def heading_error(self) -> float:
        """How far to the left of this axis it looks, rad."""
        return float(self.pose[2] - QUARTER_TURN * self.facing_axis)

    @property
    def is_aligned(self) -> bool:
        """Whether it is along this axis."""
        return abs(self.heading_error) <= ALIGNMENT_TOLERANCE

    @property
    def is_facing_ahead(self) -> bool:
        """Whether it is along the axis along which it travels, and not on a turn."""
        return self.facing_axis == self.travel_axis and self.is_aligned

    @property
    def direction(self) -> Float64:
        """Unit vector along the hallway, as the robot travels, shape (2,)."""
        return _unit_vector(self.travel_axis)

    @property
    def left_normal(self) -> Float64:
        """Unit vector across it, shape (2,)."""
        return _unit_vector(self.travel_axis + 1)

    @property
    def distance_past_node(self) -> float:
        """How far the robot is beyond its last node in its direction of travel, m."""
        assert self.last_node is not None
        return float((self.position - self.last_node.position) @ self.direction)

    @property
    def lateral_offset(self) -> float:
        """How far the robot is to the right of the hallway's middle, m."""
        return float((self.hallway_center - self.position) @ self.left_normal)

    @property
    def last_node_position(self) -> Float64:
        """The place of the last node, or where the robot is before the first one, m, shape (2,)."""
        return self.position if self.last_node is None else self.last_node.position

    def is_near(self, place: Float64 | None, distance: float) -> bool:
        """Whether the robot is so near to a place that it was at, m; wheels that stand and roll tell of ways, too."""
        return place is not None and math.dist(self.position, place) <= distance

    def coordinate_along(self, axis: int) -> float:
        """How far the robot came along an axis, from anywhere, m."""
        return float(self.position @ _unit_vector(axis))

    def free_distance(self, quarters: int) -> float:
        """How far one sees so many quarters to the right of the direction of travel, m; nan where no beam tells."""
        return float(
            self._sector_distances[
                sector_indices(np.array(QUARTER_TURN * (self.travel_axis - quarters) - self.pose[2]))
            ]
        )

    def center_point_ahead(self, distance: float) -> Float64:
        """The place in the hallway's middle so far ahead of the robot, m, shape (2,)."""
        return np.asarray(self.position + distance * self.direction + self.lateral_offset * self.left_normal)

    def center_point_ahead_in_base(self, distance: float) -> Float64:
        """The same place in the frame of the base."""
        return self._to_base_frame(self.center_point_ahead(distance))

    def node_line_point_in_base(self, axis: int, distance: float) -> Float64:
        """The place so far ahead of the robot, m, on the line along an axis through its last node; likewise."""
        node, along = self.last_node_position, _unit_vector(axis)
        return self._to_base_frame(node + (float((self.position - node) @ along) + distance) * along)

    def node_offset_point_in_base(self, axis: int, distance: float) -> Float64:
        """The place so far from the last node along an axis, m; likewise."""
        return self._to_base_frame(self.last_node_position + distance * _unit_vector(axis))

    def _to_base_frame(self, place: Float64) -> Float64:
        return np.asarray(se2.transform(se2.inverse(self.pose), place[None])[0])

    @property
    def has_hallway_in_view(self) -> bool:
        """Whether what is free around the robot is a hallway along the axis along which it looks."""
        space, right = space_from_distances(self._sector_distances), self.travel_axis - self.facing_axis
        chord = self.free_distance(right) + self.free_distance(right - 2)
        return space is not None and hallway_log_odds(space, self._features) > 0.0 and chord >= _LONG * space.length

    def update_hallway_center(self, lines: Lines) -> None:
        """The middle of the hallway along which the robot looks, where both walls are in sight."""
        left, right = (
            distance_to_wall_beside(lines, QUARTER_TURN * side - self.pose[2])
            for side in (self.facing_axis + 1, self.facing_axis - 1)
        )
        if left is not None and right is not None:
            self.hallway_center = self.position + 0.5 * (left - right) * _unit_vector(self.facing_axis + 1)


def _unit_vector(axis: int) -> Float64:
    """Unit vector along an axis."""
    return np.array((math.cos(QUARTER_TURN * axis), math.sin(QUARTER_TURN * axis)))
