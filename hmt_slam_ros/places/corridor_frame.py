"""The robot between the walls: its heading, its hallway's middle and its last node, in a frame along the walls.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3, Eq. (2). Walls are parallel or square to each other, so each line
tells the heading up to quarters of a turn. An extended Kalman filter over the heading alone needs no map and does not
drift. The noise of lines averages out; the deviation of walls from square does not, and is kept apart. The position is
that of odometry, which is accurate enough since the last node.
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
from hmt_slam_ros.places.observation_graph import QUARTER_TURN
from hmt_slam_ros.sensors.relative_motion import RelativeMotion

_WALL_ANGLE_TOLERANCE = math.radians(20.0)
"""Largest angle of a wall to the hallway's axis, or to the square of it, rad."""

_MIN_VISIBLE_LENGTH = 0.8
"""Visible length of a wall, at least, m."""

_VISIBLE_RANGE_ACROSS = 0.8
"""The visible length of a wall across the hallway counts up to this distance to both sides of the robot, m."""

_VISIBLE_RANGE_BESIDE = 4.0
"""The same for a wall beside the hallway, m."""

_MAX_WALL_DISTANCE = 2.5
"""Largest distance of a wall beside the hallway, m."""

ALIGNMENT_TOLERANCE = math.radians(25.0)
"""Largest angle between a robot and the axis or opening that it faces, rad."""

_MIN_CHORD_SHARE = 0.5
"""Smallest share of the hallway's length that a chord along its axis has."""

_POSITION_DEVIATION = 0.02
"""Deviation of the position at which landmarks are observed, m."""


class BuildingHeading:
    """The heading in a frame along the walls; unknown before the first lines. Its x is the axis nearest to these.

    :ivar angle: rad, without wrapping; nan while unknown.
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
        """Variance of the angle, rad^2."""
        return self._line_variance + self._squareness_variance

    def predict(self, step: RelativeMotion) -> None:
        """Add the rotation of a motion."""
        self.angle += float(step.increment[2])
        self._line_variance += float(step.covariance[2, 2])

    def observe(self, lines: Lines) -> int:
        """Correct the heading by the lines that are parallel or square to the walls, and return their number."""
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
        """Correct the heading by the weighted mean of differences, rad, with their noise, rad^2."""
        weights = 1.0 / (noise + self._wall_variance)
        weights /= weights.sum()
        together = float(weights**2 @ noise)
        gain = self._line_variance / (self._line_variance + together)
        self.angle += gain * float(weights @ differences)
        self._line_variance *= 1.0 - gain
        self._squareness_variance = self._wall_variance * float(weights @ weights)


def _consensus_line(alphas: Float64, variances: Float64) -> int:
    """Number of the line that agrees best with the others, weighted by their accuracy."""
    apart = _wrap_to_quarter(alphas[:, None] - alphas[None, :])
    agreeing = np.exp(-0.5 * apart**2 / (variances[:, None] + variances[None, :])) / np.sqrt(variances)
    return int(agreeing.sum(axis=1).argmax())


def _wrap_to_quarter(angles: Float64) -> Float64:
    """Angles up to quarters of a turn, in [-pi/4, pi/4)."""
    return (angles + 0.5 * QUARTER_TURN) % QUARTER_TURN - 0.5 * QUARTER_TURN


def distance_to_wall_ahead(lines: Lines, bearing: float) -> float | None:
    """Distance to the nearest wall across a hallway, m; None for none.

    :param bearing: of the hallway, rad, the robot's frame.
    """
    visible = _visible_lengths(lines, _VISIBLE_RANGE_ACROSS) >= _MIN_VISIBLE_LENGTH
    walls = lines.parameters[_is_across(lines, bearing) & visible, 1]
    return float(walls.min()) if walls.size else None


def distance_to_wall_beside(lines: Lines, bearing: float) -> float | None:
    """Distance to the wall on a side of a hallway, m; None for none.

    It is the line with the longest visible part: people and closed doors are shorter.

    :param bearing: of the side, rad, the robot's frame.
    """
    beside = _is_across(lines, bearing) & (lines.parameters[:, 1] <= _MAX_WALL_DISTANCE)
    visible = np.where(beside, _visible_lengths(lines, _VISIBLE_RANGE_BESIDE), 0.0)
    if not visible.size or visible.max() < _MIN_VISIBLE_LENGTH:
        return None
    return float(lines.parameters[int(np.argmax(visible)), 1])


def _is_across(lines: Lines, bearing: float) -> Bool:
    """Whether lines are square to a bearing, shape (n,)."""
    return np.asarray(np.abs(se2.wrap(lines.parameters[:, 0] - bearing)) <= _WALL_ANGLE_TOLERANCE)


def _visible_lengths(lines: Lines, reach: float) -> Float64:
    """Visible lengths of lines up to a distance to both sides of the robot, m, shape (n,)."""
    lengths = np.zeros(len(lines))
    within = np.clip(lines.segments, -reach, reach)
    np.add.at(lengths, lines.owners, within[:, 1] - within[:, 0])
    return lengths


class DetectedNode(NamedTuple):
    """A node at or behind the robot.

    :ivar position: shape (2,), in the frame along the walls, m.
    :ivar variance: of its position along the hallway relative to the robot, m^2.
    """

    position: Float64
    variance: float


class CorridorFrame:
    """A robot, its hallway and its last node, in the frame along the walls.

    An axis is a number of quarters of a turn to the left of x, without wrapping.

    :ivar pose: shape (3,), ``walls_T_base``, m and rad.
    :ivar travel_axis: the axis of travel.
    :ivar hallway_center: shape (2,), a point in the middle of the hallway, m.
    :ivar last_node: None before the first one.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._features, self._heading = features, BuildingHeading(features)
        self._sector_distances = UNKNOWN_DISTANCES
        self.pose, self.travel_axis, self.hallway_center = np.zeros(3), 0, np.zeros(2)
        self.last_node: DetectedNode | None = None

    def predict(self, step: RelativeMotion) -> None:
        """Move the robot."""
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
        """Correct the heading by the lines of a scan, and update the free distances by its beams."""
        self._heading.observe(lines)
        if self.is_initialized:
            self.pose = np.array((*self.position, self._heading.angle))
            self._sector_distances = distances_around(rays)

    @property
    def is_initialized(self) -> bool:
        """Whether walls were observed."""
        return self._heading.is_known

    @property
    def position(self) -> Float64:
        """Position of the robot, m, shape (2,)."""
        return self.pose[:2]

    @property
    def pose_belief(self) -> PoseGaussian:
        """The belief over ``walls_T_base``."""
        return PoseGaussian(
            self.pose, np.diag([_POSITION_DEVIATION**2, _POSITION_DEVIATION**2, self._heading.variance])
        )

    @property
    def facing_axis(self) -> int:
        """The axis nearest to the robot's heading."""
        return round(self.pose[2] / QUARTER_TURN)

    @property
    def heading_error(self) -> float:
        """Angle from this axis to the robot's heading, rad."""
        return float(self.pose[2] - QUARTER_TURN * self.facing_axis)

    @property
    def is_aligned(self) -> bool:
        """Whether the robot faces along this axis."""
        return abs(self.heading_error) <= ALIGNMENT_TOLERANCE

    @property
    def is_facing_ahead(self) -> bool:
        """Whether the robot faces along the axis of travel, and does not turn."""
        return self.facing_axis == self.travel_axis and self.is_aligned

    @property
    def direction(self) -> Float64:
        """Unit vector in the direction of travel, shape (2,)."""
        return _unit_vector(self.travel_axis)

    @property
    def left_normal(self) -> Float64:
        """Unit vector to the left of it, shape (2,)."""
        return _unit_vector(self.travel_axis + 1)

    @property
    def distance_past_node(self) -> float:
        """Distance from the last node to the robot in the direction of travel, m."""
        assert self.last_node is not None
        return float((self.position - self.last_node.position) @ self.direction)

    @property
    def lateral_offset(self) -> float:
        """Distance from the hallway's middle to the robot, to the right, m."""
        return float((self.hallway_center - self.position) @ self.left_normal)

    @property
    def last_node_position(self) -> Float64:
        """Position of the last node, or of the robot before the first one, m, shape (2,)."""
        return self.position if self.last_node is None else self.last_node.position

    def is_near(self, point: Float64 | None, distance: float) -> bool:
        """Whether the robot is within a distance, m, of a point (2,); False for None."""
        return point is not None and math.dist(self.position, point) <= distance

    def coordinate_along(self, axis: int) -> float:
        """Coordinate of the robot along an axis, m."""
        return float(self.position @ _unit_vector(axis))

    def free_distance(self, quarters: int) -> float:
        """Free distance some quarters to the right of the direction of travel, m; nan without a beam there."""
        bearing = np.array(QUARTER_TURN * (self.travel_axis - quarters) - self.pose[2])
        return float(self._sector_distances[sector_indices(bearing)])

    def center_point_ahead(self, distance: float) -> Float64:
        """The point in the hallway's middle at a distance ahead of the robot, m, shape (2,)."""
        return np.asarray(self.position + distance * self.direction + self.lateral_offset * self.left_normal)

    def center_point_ahead_in_base(self, distance: float) -> Float64:
        """The same point in the frame of the base."""
        return self._to_base_frame(self.center_point_ahead(distance))

    def node_line_point_in_base(self, axis: int, distance: float) -> Float64:
        """The point ahead of the robot on the line along an axis through its last node, m, frame of the base."""
        node, along = self.last_node_position, _unit_vector(axis)
        return self._to_base_frame(node + (float((self.position - node) @ along) + distance) * along)

    def node_offset_point_in_base(self, axis: int, distance: float) -> Float64:
        """The point at a distance from the last node along an axis, m, frame of the base."""
        return self._to_base_frame(self.last_node_position + distance * _unit_vector(axis))

    def _to_base_frame(self, point: Float64) -> Float64:
        return np.asarray(se2.transform(se2.inverse(self.pose), point[None])[0])

    @property
    def has_hallway_in_view(self) -> bool:
        """Whether the free space around the robot is a hallway along the axis that it faces."""
        space, right = space_from_distances(self._sector_distances), self.travel_axis - self.facing_axis
        if space is None or hallway_log_odds(space, self._features) <= 0.0:
            return False
        return self.free_distance(right) + self.free_distance(right - 2) >= _MIN_CHORD_SHARE * space.length

    def update_hallway_center(self, lines: Lines) -> None:
        """Measure the middle of the hallway that the robot faces along, where both walls are visible."""
        left, right = (
            distance_to_wall_beside(lines, QUARTER_TURN * side - self.pose[2])
            for side in (self.facing_axis + 1, self.facing_axis - 1)
        )
        if left is not None and right is not None:
            self.hallway_center = self.position + 0.5 * (left - right) * _unit_vector(self.facing_axis + 1)


def _unit_vector(axis: int) -> Float64:
    """Unit vector along an axis."""
    return np.array((math.cos(QUARTER_TURN * axis), math.sin(QUARTER_TURN * axis)))
