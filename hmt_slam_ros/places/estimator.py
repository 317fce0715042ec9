"""The place estimator: the belief over places of a driving robot, by odometry and scans.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3:

1. A transition is the arrival at a node: a confirmed opening beside the hallway, or the wall at its end. The distance
   from the last node is then known. An opening that is more probably none of the map is a landmark and no transition.
2. A turn is applied to the belief as soon as the robot is in a hallway again.
3. The observation function is evaluated at each arrival, and again after twice its reach. So each landmark counts about
   once. The opening of an arrival is at the node in every state: its distance counts in Eq. (1) already.
4. In rooms the belief pauses, as the metric filter knows the pose, and goes on at the door.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
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
from hmt_slam_ros.landmarks.rays import Rays, join_rays, rays_from_scan
from hmt_slam_ros.places.chart import END_NODE_TO_WALL
from hmt_slam_ros.places.corridor_frame import (
    ALIGNMENT_TOLERANCE,
    CorridorFrame,
    DetectedNode,
    distance_to_wall_ahead,
)
from hmt_slam_ros.places.observation import estimate_distance_past_node, observation_model
from hmt_slam_ros.places.observation_graph import (
    QUARTER_TURN,
    QUARTERS,
    LandmarkSequence,
    observation_graph,
    select_wall_landmarks,
)
from hmt_slam_ros.places.place_graph import PlaceGraph, heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, uniform_belief
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import RelativeMotion

_MIN_CONFIDENCE = 0.5
"""Smallest confidence of an opening."""

_MIN_DETECTIONS = 2
"""Smallest number of detections of a confirmed opening, which are not fewer than its misses."""

_MAX_LATERAL_DISTANCE = 2.5
"""Largest distance of an opening beside the hallway from the robot, m."""

_MAX_MISALIGNMENT = math.radians(20.0)
"""Largest angle between such an opening and the square to the hallway, rad."""

_TRACKING_RADIUS = 8.0
"""Distance from the robot beyond which openings are dropped, m."""

_NOTICE_DISTANCE_BEHIND = 1.0
"""Openings up to this far behind the robot are noticed, m."""

_NOTICE_DISTANCE_AHEAD = 1.0
"""Openings up to this far ahead are noticed when the robot begins to turn, m."""

_SAME_NODE_DISTANCE = 0.6
"""Openings nearer to each other than this along a hallway are one node, m."""

_MAX_DISTANCE_TO_WALL = 1.35
"""Distance to the wall at the end of a hallway at which the robot is at its node, m."""

_NODE_RADIUS = 1.5
"""Distance from the last node up to which a turn is one at this node, m."""

_UNNOTICED_NODE_DEVIATION = 0.4
"""Deviation of the position of a node at which the robot turns without having noticed it, m."""

_HALLWAY_EXIT_DISTANCE = 1.0
"""Distance from the last position in a hallway up to which a turn leaves that hallway, m."""

_NODE_DEVIATION = 0.03
"""Deviation of a node's position in the map, m."""

_INITIAL_DEVIATION = 0.1
"""Deviation of the position of a robot that begins at a node, m."""

_UNINFORMATIVE_TURN_VARIANCE = 2.0 * math.pi
"""Variance of the turn between two nodes, rad^2: a robot that follows one axis measures none. With this variance the
density of no turn is that of any turn on unmapped edges, 1 / (2 pi)."""


class OpeningTracker:
    """Tracks the openings around a robot.

    :ivar last_openings: of the last scan, in the frame of the base.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._features = features
        # People hide openings, so none is removed for its existence.
        self._landmark_map = LandmarkMap(replace(features, landmark_least=0.0))
        self.last_openings = NO_OPENINGS

    def observe(self, frame: CorridorFrame, openings: Openings, rays: Rays) -> None:
        """Observe the openings of a scan.

        :param frame: of the robot.
        :param rays: beams of the scan.
        """
        self.last_openings = openings
        self._landmark_map.observe(frame.pose_belief, concatenate_landmarks(NO_CORNERS, openings), rays)
        self._landmark_map.landmarks = [
            landmark
            for landmark in self._landmark_map.landmarks
            if math.dist(landmark.pose.mean[:2], frame.position) < _TRACKING_RADIUS
        ]

    def confirmed_beside_hallway(self, frame: CorridorFrame) -> Iterator[Landmark]:
        """The confirmed openings in the side walls of the robot's hallway, in the frame along the walls."""
        for landmark in self._landmark_map.landmarks:
            heading = float(landmark.pose.mean[2]) - QUARTER_TURN * frame.travel_axis
            lateral = float((landmark.pose.mean[:2] - frame.position) @ frame.left_normal)
            outwards = math.copysign(1.0, lateral) * math.sin(heading) > math.cos(_MAX_MISALIGNMENT)
            existence = landmark.existence
            confirmed = existence.confidence >= _MIN_CONFIDENCE
            confirmed &= existence.detections >= max(_MIN_DETECTIONS, existence.misses)
            if landmark.kind == OPENING and confirmed and abs(lateral) <= _MAX_LATERAL_DISTANCE and outwards:
                yield landmark

    def door_ahead(self) -> PoseGaussian | None:
        """The belief over ``base_T_opening`` of the nearest opening that the robot faces; None for none.

        None, too, for one whose angle is less certain than walls are square: people may be part of its line.
        """
        openings = self.last_openings
        x, y, heading = openings.poses.T
        ahead = (openings.confidences >= _MIN_CONFIDENCE) & (x > 0.0) & (np.abs(heading) <= ALIGNMENT_TOLERANCE)
        ahead &= np.abs(y) <= 0.5 * openings.widths
        if not ahead.any():
            return None
        k = int(np.argmin(np.where(ahead, x, np.inf)))
        if openings.covariances[k, 2, 2] > math.radians(self._features.square_deviation) ** 2:
            return None
        return PoseGaussian(openings.poses[k], openings.covariances[k])


class PlaceEstimator:
    """Estimates the place of a robot in a place graph.

    :ivar frame: the robot between the walls, with its last node.
    :ivar openings: around it.
    :ivar belief: None before the first node.
    :ivar arrivals: number of nodes that the robot arrived at.
    :ivar is_in_hallway: whether the robot is in a hallway, along it.
    :ivar is_at_wall: whether it is at the wall at the end of one.
    """

    def __init__(self, graph: PlaceGraph, configuration: Configuration, belief: PositionBelief | None = None) -> None:
        """:param belief: of a robot that begins at a node; None for a uniform one from the first node on."""
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._initial_belief = belief or uniform_belief(graph, configuration.places)
        self._begins_at_node = belief is not None
        self._passed_positions: list[Float64] = []
        self._unmapped_positions: list[Float64] = []
        self._turn_position: Float64 | None = None
        # Positions of the last observation of landmarks, of that or the last arrival, and of the last hallway.
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
        """Whether the robot is turning."""
        return self._turn_position is not None

    @property
    def is_at_node(self) -> bool:
        """Whether the robot is near its last node."""
        return self.frame.last_node is not None and self.frame.is_near(self.frame.last_node.position, _NODE_RADIUS)

    @property
    def node_and_direction(self) -> tuple[int, int] | None:
        """The most likely node, and the robot's present direction, also on a turn and in a room."""
        state = None if self.belief is None else self.belief.most_likely_state
        if state is None:
            return None
        return node_of(state), (heading_of(state) + self.frame.travel_axis - self.frame.facing_axis) % QUARTERS

    def predict(self, step: RelativeMotion) -> None:
        """Move the robot."""
        self.frame.predict(step)

    def observe(self, scan: Scan, others: Sequence[tuple[Float64, Scan]] = ()) -> PositionBelief | None:
        """The belief after a scan; None before the first node.

        :param others: scans of other lasers, each with ``base_T_then`` (3,); they show how much space is around.
        """
        frame, features = self.frame, self._features
        lines, rays = extract_lines(scan, features), rays_from_scan(scan, features)
        frame.observe(lines, join_rays([rays, *(rays_from_scan(other, features).move(pose) for pose, other in others)]))
        if not frame.is_initialized:
            return None
        if self._begins_at_node and self.belief is None:
            frame.last_node, self.belief = DetectedNode(frame.position, _INITIAL_DEVIATION**2), self._initial_belief
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
        """Whether the robot is in a hallway and faces along it; updates the hallway's middle."""
        if not self.frame.has_hallway_in_view:
            return False
        self._last_hallway_position = self.frame.position
        self.frame.update_hallway_center(lines)
        return True

    def _update_turn(self, lines: Lines) -> None:
        """Follow a turn, and apply it to the belief at its end: in a hallway along another axis."""
        frame = self.frame
        if self._turn_position is None:
            self._turn_position = frame.position
            if frame.is_near(self._last_hallway_position, _HALLWAY_EXIT_DISTANCE):
                self._notice_openings(_NOTICE_DISTANCE_AHEAD)
        if not frame.is_aligned or frame.facing_axis == frame.travel_axis:
            return
        quarters = (frame.travel_axis - frame.facing_axis) % QUARTERS
        if quarters % 2:
            if self._is_turning_elsewhere and frame.is_near(self._last_hallway_position, _HALLWAY_EXIT_DISTANCE):
                self._process_detection(DetectedNode(self._turn_position, _UNNOTICED_NODE_DEVIATION**2))
            # A node is in the middle of both hallways.
            frame.hallway_center = frame.last_node_position
        if not self._detect_hallway(lines):
            self.is_in_hallway = False
            return
        if quarters % 2 and self._is_turning_elsewhere:
            # Where another hallway begins there is a node, noticed or not.
            self._arrive(DetectedNode(self._turn_position, _UNNOTICED_NODE_DEVIATION**2))
            frame.hallway_center = frame.last_node_position
        if self.belief is not None:
            self.belief = self.belief.predict_turn(quarters)
        self._last_look_position = None if quarters % 2 else self._last_look_position
        frame.travel_axis, self._turn_position, self.is_in_hallway = frame.facing_axis, None, True
        # Openings that were passed may be passed again.
        self._passed_positions, self._unmapped_positions = (
            [position for position in positions if frame.is_near(position, _NODE_RADIUS)]
            for positions in (self._passed_positions, self._unmapped_positions)
        )

    @property
    def _is_turning_elsewhere(self) -> bool:
        """Whether the turn is not at the last node."""
        node, turned_at = self.frame.last_node, self._turn_position
        assert turned_at is not None
        if node is None:
            return False
        return min(math.dist(point, node.position) for point in (self.frame.position, turned_at)) > _NODE_RADIUS

    def _notice_openings(self, reach: float) -> None:
        """Process the openings beside the robot, up to a reach ahead of it, m."""
        frame = self.frame
        openings = self.openings.confirmed_beside_hallway(frame)
        found = [(float((each.pose.mean[:2] - frame.position) @ frame.direction), each) for each in openings]
        for ahead, landmark in sorted(found, key=lambda each: each[0]):
            if -_NOTICE_DISTANCE_BEHIND <= ahead <= reach:
                variance = float(landmark.pose.covariance[:2, :2].trace())
                self._process_detection(DetectedNode(frame.center_point_ahead(ahead), variance))

    def _notice_wall(self, lines: Lines) -> None:
        """Process the wall at the end of a hallway."""
        distance = distance_to_wall_ahead(lines, -self.frame.heading_error)
        self.is_at_wall = distance is not None and distance <= _MAX_DISTANCE_TO_WALL
        if distance is not None and self.is_at_wall:
            position = self.frame.center_point_ahead(distance - END_NODE_TO_WALL)
            self._process_detection(DetectedNode(position, _NODE_DEVIATION**2), end=True)

    def _process_detection(self, detection: DetectedNode, *, end: bool = False) -> None:
        """Arrive at a detected node, unless it was detected before or is none of the map.

        An opening at the last node corrects the robot's position; an end there is no node of its own. An end is not
        taken for an unmapped opening, which may be another one that is partly hidden.
        """
        frame = self.frame
        known = self._passed_positions if end else self._passed_positions + self._unmapped_positions
        distances = [np.abs((position - detection.position) @ frame.direction) for position in known]
        if distances and min(distances) < _SAME_NODE_DISTANCE:
            return
        last = frame.last_node
        if last is not None and abs((detection.position - last.position) @ frame.direction) <= _NODE_RADIUS:
            frame.last_node = last if end else detection
            self._passed_positions = [*self._passed_positions[-2:], detection.position]
        elif self.belief is None or self.belief.is_mapped_opening(self._travel_to(detection)):
            self._arrive(detection)
        else:
            self._unmapped_positions = [*self._unmapped_positions[-2:], detection.position]

    def _arrive(self, node: DetectedNode) -> None:
        """Apply the transition to a node."""
        self._passed_positions = [*self._passed_positions[-2:], node.position]
        belief = self.belief
        self.belief = self._initial_belief if belief is None else belief.predict_arrival(self._travel_to(node))
        self.frame.last_node, self._last_look_position, self._last_update_position = node, None, self.frame.position
        self.arrivals += 1

    def _travel_to(self, node: DetectedNode) -> Travel:
        """Odometry from the last node to another one."""
        last = self.frame.last_node
        assert last is not None
        distance = float((node.position - last.position) @ self.frame.direction)
        return Travel(max(0.0, distance), 0.0, (last.variance + node.variance, _UNINFORMATIVE_TURN_VARIANCE))

    def _observe_landmarks(self, observed: LandmarkSequence) -> None:
        """Update the belief by an observation graph, after an arrival and after each twice the reach."""
        frame, last = self.frame, self.frame.last_node
        if self.belief is None or last is None or frame.is_near(self._last_look_position, 2.0 * self._places.reach):
            return
        if self.belief.room_probability >= 0.5:
            return
        variance = last.variance + _NODE_DEVIATION**2
        predicted = self.belief.predict_travel(math.dist(frame.position, self._last_update_position))
        self.belief = predicted.update(observed, self._model, frame.distance_past_node, variance)
        self._last_look_position = self._last_update_position = frame.position
        state = self.belief.most_likely_state
        if self.belief.is_confident and state is not None:
            before = frame.distance_past_node
            after, variance = estimate_distance_past_node(
                observed, self.belief.graph.expected_landmarks, state, before, variance, self._model
            )
            frame.last_node = DetectedNode(last.position + (before - after) * frame.direction, variance)
