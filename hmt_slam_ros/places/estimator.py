"""The belief over places of a robot that drives, from what its wheels and its laser say.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3. A transition is when the robot passes an opening to a side that
it believes in, or comes to the wall at the end of a hallway: then it is at a node, and the way from the last one is
known. From there on it is so far beyond the node as it was driven. A turn is one of the belief as soon as the robot is
in a hallway again. In rooms the belief pauses, for there the metric filter tells where the robot is, and goes on at the
door.

Every landmark counts about once: the observation function is asked where the robot arrives, and again when it has gone
on as far as twice its reach. By its place along the hallway the opening at which the robot arrives is known by way of
the distance alone, Eq. (1): the robot's place is set by it, so that in the look it is where every state expects one,
and tells its side and its width. An opening that is more probably none of the map is no transition, but a landmark.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import NO_CORNERS, OPENING, concatenate_landmarks, extract_corners
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.landmarks.openings import NO_OPENINGS, Openings, extract_openings
from hmt_slam_ros.landmarks.rays import Rays, rays_from_scan
from hmt_slam_ros.places.chart import END_NODE_TO_WALL
from hmt_slam_ros.places.corridor_frame import (
    ALIGNMENT_TOLERANCE,
    QUARTER_TURN,
    CorridorFrame,
    DetectedNode,
    distance_to_wall_ahead,
)
from hmt_slam_ros.places.observation import estimate_distance_past_node, observation_model
from hmt_slam_ros.places.observation_graph import QUARTERS, LandmarkSequence, observation_graph, select_wall_landmarks
from hmt_slam_ros.places.place_graph import PlaceGraph, heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, uniform_belief
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import RelativeMotion

# One believes in openings from this confidence and so many sightings on, more than they were missed. They are so far
# beside the robot at most, m, within this angle of square to its hallway, rad.
_LEAST, _SIGHTINGS, _ASIDE, _ASKEW = 0.5, 2, 2.5, math.radians(20.0)
# What is so far away is forgotten, m.
_FORGET = 8.0


class OpeningTracker:
    """Openings around a robot.

    :ivar last_openings: in the last scan, the frame of the base.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._features = features
        # Who walks by hides what is there.
        self._landmark_map = LandmarkMap(replace(features, landmark_least=0.0))
        self.last_openings = NO_OPENINGS

    def observe(self, frame: CorridorFrame, openings: Openings, rays: Rays) -> None:
        """Follow what a scan shows.

        :param frame: where it was taken.
        :param rays: its beams.
        """
        self.last_openings = openings
        self._landmark_map.observe(frame.pose_belief, concatenate_landmarks(NO_CORNERS, openings), rays)
        near = (one for one in self._landmark_map.landmarks if math.dist(one.pose.mean[:2], frame.position) < _FORGET)
        self._landmark_map.landmarks = list(near)

    def confirmed_beside_hallway(self, frame: CorridorFrame) -> Iterator[Landmark]:
        """The openings to the sides of a robot's hallway that one believes in, in the frame along the walls."""
        for one in self._landmark_map.landmarks:
            heading = float(one.pose.mean[2]) - QUARTER_TURN * frame.travel_axis
            beside = float((one.pose.mean[:2] - frame.position) @ frame.left_normal)
            side = math.copysign(1.0, beside) * math.sin(heading)
            existence = one.existence
            believed = existence.confidence >= _LEAST and existence.detections >= max(_SIGHTINGS, existence.misses)
            if one.kind == OPENING and believed and abs(beside) <= _ASIDE and side > math.cos(_ASKEW):
                yield one

    def door_ahead(self) -> PoseGaussian | None:
        """The belief over ``base_T_opening`` of the nearest opening that the robot looks through; None for none.

        None, too, for one that it sees less exactly along a wall than walls are square: who hides most of a wall may
        be a part of its line.
        """
        seen = self.last_openings
        ahead = (
            (seen.confidences >= _LEAST) & (seen.poses[:, 0] > 0.0) & (np.abs(seen.poses[:, 2]) <= ALIGNMENT_TOLERANCE)
        )
        ahead &= np.abs(seen.poses[:, 1]) <= 0.5 * seen.widths
        if not ahead.any():
            return None
        k = int(np.argmin(np.where(ahead, seen.poses[:, 0], np.inf)))
        if seen.covariances[k, 2, 2] > math.radians(self._features.square_deviation) ** 2:
            return None
        return PoseGaussian(seen.poses[k], seen.covariances[k])


# Openings are noticed when the robot is so far beyond them, m; a robot that begins to turn is at one that is so far
# ahead, m, as well.
_BEHIND, _AHEAD = 1.0, 1.0
# Openings so near to each other along a hallway are one node, m.
_SAME = 0.6
# The wall at the end of a hallway is so near before the robot turns, m.
_WALL = 1.35
# A robot turns at its last node up to so far from it, m; where it turns elsewhere it is at one that it did not notice,
# of which it knows the place so well, m.
_NODE_RADIUS, _UNNOTICED_DEVIATION = 1.5, 0.4
# A robot that was in a hallway so far ago, m, turns off it.
_HALLWAY_EXIT_DISTANCE = 1.0
# Deviation of a node's place in the map, m.
_PLACED = 0.03
# The robot follows one axis to the next node, in known ground and in unknown, so the turn tells nothing: with this
# variance, rad^2, none at all is as probable as any is where the map does not tell it, 1 / (2 pi).
_UNINFORMATIVE_TURN_VARIANCE = 2.0 * math.pi
# Where a robot stands that begins at a node, so exactly, m.
_BEGIN = 0.1


class PlaceEstimator:
    """Follows a robot through a map of places.

    :ivar frame: where it is along the walls, and its last node.
    :ivar openings: those around it.
    :ivar belief: None before the first node is noticed.
    :ivar arrivals: how many nodes were noticed.
    :ivar is_in_hallway: whether the robot is in one, along it.
    :ivar is_at_wall: whether it is at the wall at the end of one.
    """

    def __init__(self, graph: PlaceGraph, configuration: Configuration, belief: PositionBelief | None = None) -> None:
        """:param belief: of a robot that begins at a node; unless given, nothing is known before one is noticed."""
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._initial_belief, self._begins_there = (
            belief or uniform_belief(graph, configuration.places),
            belief is not None,
        )
        self._passed_positions: list[Float64] = []
        self._unmapped_positions: list[Float64] = []
        self._turn_position: Float64 | None = None
        # Where it looked last, where it looked or arrived last, and where it was in a hallway last.
        self._last_look_position: Float64 | None = None
        self._last_update_position = np.zeros(2)
        self._last_hallway_position: Float64 | None = None
        self.frame = CorridorFrame(configuration.features)
        self.openings = OpeningTracker(configuration.features)
        self.belief: PositionBelief | None = None
        self.arrivals = 0
        self.is_in_hallway, self.is_at_wall = False, False

    @property
    def is_turning(self) -> bool:
        """Whether the robot is on a turn that is not over yet."""
        return self._turn_position is not None

    @property
    def is_at_node(self) -> bool:
        """Whether the robot is beside its last node."""
        return self.frame.last_node is not None and self.frame.is_near(self.frame.last_node.position, _NODE_RADIUS)

    @property
    def node_and_direction(self) -> tuple[int, int] | None:
        """The most likely node and the direction in which the robot looks now, also while it turns or is in a room."""
        state = None if self.belief is None else self.belief.most_likely_state
        if state is None:
            return None
        return node_of(state), (heading_of(state) + self.frame.travel_axis - self.frame.facing_axis) % QUARTERS

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self.frame.predict(step)

    def observe(self, scan: Scan) -> PositionBelief | None:
        """The belief after a scan; None before the first node."""
        frame, features = self.frame, self._features
        lines, rays = extract_lines(scan, features), rays_from_scan(scan, features)
        frame.observe(lines, rays)
        if not frame.is_initialized:
            return None
        if self._begins_there and self.belief is None:
            frame.last_node, self.belief = DetectedNode(frame.position, _BEGIN**2), self._initial_belief
        corners, openings = extract_corners(lines, features), extract_openings(lines, rays, features)
        self.openings.observe(frame, openings, rays)
        if frame.is_facing_ahead:
            self._turn_position = None
            self.is_in_hallway = self._detect_hallway(lines)
        else:
            self._update_turn(lines)
        if self.is_in_hallway and frame.is_facing_ahead:
            self._notice_openings(0.0)
            self._notice_wall(lines)
            self._observe_landmarks(
                select_wall_landmarks(observation_graph(corners, openings, -frame.heading_error, self._places))
            )
        return self.belief

    def _detect_hallway(self, lines: Lines) -> bool:
        """Whether the robot is in a hallway along which it looks. Where both walls are in sight its middle is known."""
        if not self.frame.has_hallway_in_view:
            return False
        self._last_hallway_position = self.frame.position
        self.frame.update_hallway_center(lines)
        return True

    def _update_turn(self, lines: Lines) -> None:
        """The robot turns, and at last is along another axis."""
        frame = self.frame
        if self._turn_position is None:
            self._turn_position = frame.position
            if frame.is_near(self._last_hallway_position, _HALLWAY_EXIT_DISTANCE):
                self._notice_openings(_AHEAD)
        if not frame.is_aligned or frame.facing_axis == frame.travel_axis:
            return
        quarters = (frame.travel_axis - frame.facing_axis) % QUARTERS
        if quarters % 2:
            if self._is_turning_elsewhere and frame.is_near(self._last_hallway_position, _HALLWAY_EXIT_DISTANCE):
                self._process_detection(DetectedNode(self._turn_position, _UNNOTICED_DEVIATION**2))
            # A node is in the middle of the hallways that meet there.
            frame.hallway_center = frame.last_node_position
        if not self._detect_hallway(lines):
            self.is_in_hallway = False
            return
        if quarters % 2 and self._is_turning_elsewhere:
            # Where another hallway leads off there is a node, whatever was seen of it.
            self._arrive(DetectedNode(self._turn_position, _UNNOTICED_DEVIATION**2))
            frame.hallway_center = frame.last_node_position
        if self.belief is not None:
            self.belief = self.belief.predict_turn(quarters)
        self._last_look_position = None if quarters % 2 else self._last_look_position
        frame.travel_axis, self._turn_position, self.is_in_hallway = frame.facing_axis, None, True
        # What was passed is passed again.
        self._passed_positions, self._unmapped_positions = (
            [place for place in places if frame.is_near(place, _NODE_RADIUS)]
            for places in (self._passed_positions, self._unmapped_positions)
        )

    @property
    def _is_turning_elsewhere(self) -> bool:
        """Whether the robot turns elsewhere than at its last node."""
        node, turned_at = self.frame.last_node, self._turn_position
        assert turned_at is not None
        return (
            node is not None
            and min(math.dist(at, node.position) for at in (self.frame.position, turned_at)) > _NODE_RADIUS
        )

    def _notice_openings(self, ahead: float) -> None:
        """Arrive at the openings that are passed.

        :param ahead: so far ahead of the robot they count already, m.
        """
        frame = self.frame
        openings = self.openings.confirmed_beside_hallway(frame)
        found = [(float((one.pose.mean[:2] - frame.position) @ frame.direction), one) for one in openings]
        for away, landmark in sorted(found, key=lambda each: each[0]):
            if -_BEHIND <= away <= ahead:
                variance = float(landmark.pose.covariance[:2, :2].trace())
                self._process_detection(DetectedNode(frame.center_point_ahead(away), variance))

    def _notice_wall(self, lines: Lines) -> None:
        """Arrive at the end of a hallway."""
        away = distance_to_wall_ahead(lines, -self.frame.heading_error)
        self.is_at_wall = away is not None and away <= _WALL
        if away is not None and self.is_at_wall:
            self._process_detection(
                DetectedNode(self.frame.center_point_ahead(away - END_NODE_TO_WALL), _PLACED**2), end=True
            )

    def _process_detection(self, noticed: DetectedNode, *, end: bool = False) -> None:
        """Arrive at what was noticed, unless it was noticed before, or is none of the map.

        An opening at which the robot is again corrects its place. An end that is so near to an opening is no node. One
        that is none of the map may be another one that somebody half hides, and no end is taken for it.
        """
        frame = self.frame
        known = self._passed_positions if end else self._passed_positions + self._unmapped_positions
        away = [np.abs((place - noticed.position) @ frame.direction) for place in known]
        if away and min(away) < _SAME:
            return
        if (
            frame.last_node is not None
            and abs((noticed.position - frame.last_node.position) @ frame.direction) <= _NODE_RADIUS
        ):
            frame.last_node = frame.last_node if end else noticed
            self._passed_positions = [*self._passed_positions[-2:], noticed.position]
        elif self.belief is None or self.belief.is_mapped_opening(self._travel_to(noticed)):
            self._arrive(noticed)
        else:
            self._unmapped_positions = [*self._unmapped_positions[-2:], noticed.position]

    def _arrive(self, noticed: DetectedNode) -> None:
        self._passed_positions = [*self._passed_positions[-2:], noticed.position]
        self.belief = (
            self._initial_belief if self.belief is None else self.belief.predict_arrival(self._travel_to(noticed))
        )
        self.frame.last_node, self._last_look_position, self._last_update_position = noticed, None, self.frame.position
        self.arrivals += 1

    def _travel_to(self, noticed: DetectedNode) -> Travel:
        """From the last node."""
        last = self.frame.last_node
        assert last is not None
        distance = float((noticed.position - last.position) @ self.frame.direction)
        return Travel(max(0.0, distance), 0.0, (last.variance + noticed.variance, _UNINFORMATIVE_TURN_VARIANCE))

    def _observe_landmarks(self, seen: LandmarkSequence) -> None:
        """Ask the observation function, where as much of the hallway is new as the robot sees of it."""
        frame, last = self.frame, self.frame.last_node
        if self.belief is None or last is None or frame.is_near(self._last_look_position, 2.0 * self._places.reach):
            return
        if self.belief.room_probability >= 0.5:
            return
        variance = last.variance + _PLACED**2
        gone = math.dist(frame.position, self._last_update_position)
        self.belief = self.belief.predict_travel(gone).update(seen, self._model, frame.distance_past_node, variance)
        self._last_look_position = self._last_update_position = frame.position
        state = self.belief.most_likely_state
        if self.belief.is_confident and state is not None:
            ahead, variance = estimate_distance_past_node(
                seen, self.belief.graph.expected_landmarks, state, frame.distance_past_node, variance, self._model
            )
            frame.last_node = DetectedNode(
                last.position + (frame.distance_past_node - ahead) * frame.direction, variance
            )
