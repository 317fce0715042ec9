"""The mission controller: drives a robot to rooms by the belief over places and, behind a door, by the metric filter.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.3 and 3.4:

1. Along a hallway the robot keeps to its middle. At a node it turns by the most likely state policy (policy.py).
2. Before the goal's door a confident robot switches to the metric filter. If no door is there, it goes on.
3. Out of a room it drives to the door's node, and the belief goes on from there.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.exploration.laser_views import LaserViews, ObstacleView
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards, turn_in_place
from hmt_slam_ros.exploration.path_follower import PathFollower
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, RoomFilter
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.edge_existence import EdgeMonitor
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.observation_graph import QUARTER_TURN, QUARTERS
from hmt_slam_ros.places.place_graph import state_of
from hmt_slam_ros.places.policy import MetricInitialPose, metric_initial_pose, next_turn, turn_towards
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.local_mapping import LocalMapping

_LOOKAHEAD = 2.0
"""Distance of the local goal ahead along a hallway, m."""

_MIN_OPEN_DISTANCE = 3.0
"""Free distance from which on a hallway goes on, m."""

_DOOR_MARGIN = 0.6
"""Distance from a door, on both sides, of the points on the path through it, m."""

_PLACE_TOLERANCE = 0.15
"""Distance at which a place is reached, m."""

_DOOR_TIMEOUT = 15 * NANOSECONDS
"""Time in which the robot looks for the goal's door, ns."""

_STUCK_TIMEOUT = 10 * NANOSECONDS
"""Time without progress after which the robot is stuck, ns."""

_MIN_PROGRESS = 0.3
"""Distance that counts as progress, m."""

_MAX_DISTANCE_TO_MIDDLE = 0.2
"""Distance from the point before a door at which the robot stands before it, m."""

_MAX_MISALIGNMENT = math.radians(10.0)
"""Largest angle to the door's axis of a robot that faces it, rad."""

_OBSERVATION_DISTANCE, _OBSERVATION_PERIOD = 0.5, 5 * NANOSECONDS
"""Distance, m, and time, ns, after which edges are observed again."""

_NODE_MARGIN = 0.2
"""Distance before its last node at which a robot that turned back is at this node, m."""

_INITIAL_DISPLACEMENT = np.array((_MIN_PROGRESS, 0.0, 0.0))
_STAND = MotionCommand(0.0, 0.0, arrived=False)


class Phase(Enum):
    """Phase of a mission."""

    HALLWAY = "goes along a hallway"
    TURN = "turns at a node"
    DOOR = "looks for the door of its goal"
    ROOM = "is on its way in a room"
    LEAVING = "leaves a room"
    THERE = "is at its goal"
    LOST = "knows no way"


class MissionController:
    """Drives a robot on missions.

    :ivar estimator: of the robot's place.
    :ivar phase: of the mission.
    :ivar edge_monitor: existence of edges.
    :ivar room: metric filter in a room; None outside.
    :ivar initial_pose: with which that filter started last.
    """

    def __init__(
        self,
        known: KnownBuilding,
        configuration: Configuration,
        limits: MotionLimits,
        belief: PositionBelief | None = None,
        edge_monitor: EdgeMonitor | None = None,
    ) -> None:
        """:param belief: of a robot that begins at a node.

        :param edge_monitor: existence of edges; None for certain existence.
        """
        self._building, self._configuration, self._limits = known, configuration, limits
        self._model = observation_model(configuration.places, configuration.features)
        self._mapping = LocalMapping(configuration)
        self.estimator = PlaceEstimator(known.graph, configuration, belief)
        self.edge_monitor = edge_monitor or EdgeMonitor(known.graph, configuration.features)
        self.phase, self._before_door = Phase.THERE, False
        self.room: RoomFilter | None = None
        self.initial_pose: MetricInitialPose | None = None
        self._goal: Destination | None = None
        self._entered_destination: Destination | None = None
        self._target_axis, self._hallway_axis, self._last_event = 0, 0, (-1, False)
        self._progress_stamp, self._progress = 0, -math.inf
        self._observation_stamp, self._observation_displacement, self._has_turned_back = 0, _INITIAL_DISPLACEMENT, False
        self._path_follower = PathFollower(limits, _PLACE_TOLERANCE)
        self._velocity, self._views = (0.0, 0.0), LaserViews()
        self._behaviors = {
            Phase.HALLWAY: self._follow_hallway,
            Phase.TURN: self._turn_at_node,
            Phase.DOOR: self._approach_door,
            Phase.ROOM: self._drive_into_room,
            Phase.LEAVING: self._drive_out_of_room,
        }

    def start_mission(self, goal: Destination | None) -> None:
        """Start a mission.

        :param goal: None for localization along hallways.
        """
        self._goal, self._has_turned_back = goal, False
        self._path_follower = PathFollower(self._limits, _PLACE_TOLERANCE)
        self._set_turn(0)
        self.phase = Phase.HALLWAY
        if self.room is not None:
            self.phase = Phase.ROOM if goal is self._entered_destination else Phase.LEAVING

    def restart_in_hallway(self, belief: PositionBelief) -> None:
        """Leave the metric filter, and continue along the hallway with another belief: the door was a wrong one."""
        assert self.room is not None
        self.room.release()
        self.room = self._entered_destination = None
        self.estimator.belief = belief
        # The axis was that of the door, through which the free distance may be as long as in a hallway.
        self._target_axis, self.phase, self._progress = self._target_axis + 1, Phase.TURN, -math.inf

    def stop(self) -> None:
        """Stand until the next mission."""
        self.phase = Phase.THERE

    def predict(self, step: RelativeMotion) -> None:
        """Move the robot."""
        self.estimator.predict(step)
        self._views.move(step.increment)
        self._observation_displacement = se2.compose(self._observation_displacement, step.increment)
        if self.room is not None:
            self.room.predict(step)

    def steer(self, scan: Scan) -> MotionCommand:
        """The velocities until the next scan.

        It avoids what any laser sees. Landmarks are those of lasers that look ahead.
        """
        view = self._views.add(scan)
        if self.room is not None:
            self.room.observe(scan)
        elif self._views.is_ahead(scan):
            self.estimator.observe(scan, self._views.others)
            self._observe_edges(scan.stamp)
        behavior = self._behaviors.get(self.phase)
        command = _STAND if behavior is None else behavior(view)
        self._velocity = command.speed, command.turn_rate
        return command

    def _observe_edges(self, stamp: int) -> None:
        """Observe the edges around a confident robot."""
        estimator, state = self.estimator, self._confident_state
        moved = math.hypot(*self._observation_displacement[:2]) >= _OBSERVATION_DISTANCE
        due = moved or stamp - self._observation_stamp >= _OBSERVATION_PERIOD
        if state is None or not due or estimator.is_turning:
            return
        self._observation_stamp, self._observation_displacement = stamp, np.zeros(3)
        frame = estimator.frame
        clear = np.array([frame.free_distance(quarter) for quarter in range(QUARTERS)])
        self.edge_monitor.observe(state, frame.distance_past_node, frame.lateral_offset, clear)

    @property
    def _is_confident(self) -> bool:
        """Whether the belief over places is confident."""
        belief = self.estimator.belief
        return belief is not None and belief.is_confident

    @property
    def _confident_state(self) -> int | None:
        """The most likely state of a confident belief; None for another one, and in unknown ground."""
        belief = self.estimator.belief
        return belief.most_likely_state if belief is not None and belief.is_confident else None

    def _command_towards(self, view: ObstacleView, point: Float64) -> MotionCommand:
        return command_towards(view, point, self._velocity, self._limits)

    def _follow_hallway(self, view: ObstacleView) -> MotionCommand:
        """Keep to the middle of the hallway, and decide at nodes.

        A robot that an obstacle turned off its axis turns back, unless it arrived at a node.
        """
        event = self.estimator.arrivals, self.estimator.is_at_wall
        arrived = event[0] != self._last_event[0]
        if (self.estimator.frame.travel_axis - self._target_axis) % QUARTERS and not arrived:
            self.phase = Phase.TURN
            return self._turn_at_node(view)
        self._target_axis = self.estimator.frame.travel_axis
        returned = self._has_turned_back and self.estimator.frame.distance_past_node >= -_NODE_MARGIN
        if arrived or event[1] > self._last_event[1] or returned:
            self._decide(view)
        self._last_event = event
        if self.phase is not Phase.HALLWAY:
            return self._behaviors[self.phase](view)
        if self._is_stuck(view):
            self._escape()
        elif self._is_way_closed():
            self._turn_back()
        return self._command_towards(view, self.estimator.frame.center_point_ahead_in_base(_LOOKAHEAD))

    def _is_way_closed(self) -> bool:
        """Whether the robot's edge is closed, and another path leads to the goal."""
        goal, closed, state = self._goal, self.edge_monitor.closed_states, self._confident_state
        if goal is None or state not in closed or self.estimator.frame.distance_past_node < 0.0:
            return False
        return bool(turn_towards(self._building.graph, state, goal.node, closed))

    def _turn_back(self) -> None:
        """Turn between two nodes, and decide again at the last one."""
        self._set_turn(2)
        self.phase, self._has_turned_back = Phase.TURN, self.estimator.belief is not None

    def _escape(self) -> None:
        """Turn back if the hallway is blocked; a robot that is not confident turns to the longest free distance.

        That avoids the way back into a room, before the wall opposite its door.
        """
        if self._is_confident:
            self._turn_back()
        else:
            self._set_turn(self._freest_quarter(0))
            self.phase = Phase.TURN

    def _is_stuck(self, view: ObstacleView) -> bool:
        """Whether the robot made no progress along its axis within the timeout."""
        position = self.estimator.frame.coordinate_along(self._target_axis)
        progressed = position >= self._progress + _MIN_PROGRESS
        stuck = not progressed and view.stamp - self._progress_stamp > _STUCK_TIMEOUT
        if stuck or progressed:
            self._progress, self._progress_stamp = position, view.stamp
        return stuck

    def _decide(self, view: ObstacleView) -> None:
        """Follow the most likely state policy; without its answer go straight on, or back at a wall."""
        belief, facing, goal = self.estimator.belief, self.estimator.node_and_direction, self._goal
        node = None if goal is None else goal.node
        at_wall, self._has_turned_back = self.estimator.is_at_wall, False
        if at_wall and self._is_confident and not self.estimator.is_at_node:
            self._turn_back()
            return
        if goal is not None and self._is_confident and facing is not None and facing[0] == node:
            self._hallway_axis = self.estimator.frame.travel_axis
            self._start_door_approach(goal.opening.direction - facing[1], view)
            return
        closed = self.edge_monitor.closed_states
        quarters = None if belief is None else next_turn(belief, node, self._model, ahead=not at_wall, closed=closed)
        quarters = 2 if at_wall and not quarters else quarters
        if quarters and not self._is_confident and not self._is_open(quarters):
            quarters = self._freest_quarter(quarters)
        if quarters:
            self._set_turn(quarters)
            self.phase = Phase.TURN

    def _is_open(self, quarters: int) -> bool:
        """Whether the free distance some quarters to the right is that of a hallway, or unknown."""
        return not self.estimator.frame.free_distance(quarters) < _MIN_OPEN_DISTANCE

    def _freest_quarter(self, without: int) -> int:
        """The quarters to the right with the longest free distance, except for one direction."""
        others = [k for k in range(QUARTERS) if (k - without) % QUARTERS]
        return max(others, key=lambda k: np.nan_to_num(self.estimator.frame.free_distance(k)))

    def _set_turn(self, quarters: int) -> None:
        """Set the axis some quarters to the right as target."""
        self._target_axis, self._progress = self.estimator.frame.travel_axis - quarters, -math.inf

    def _start_door_approach(self, quarters: int, view: ObstacleView) -> None:
        """Begin to turn some quarters to the right, to the goal's door."""
        self._set_turn(quarters % QUARTERS)
        self.phase, self._progress_stamp, self._before_door = Phase.DOOR, view.stamp, False

    def _turn_at_node(self, view: ObstacleView) -> MotionCommand:
        """Turn at the last node into a hallway; if stuck, into another one."""
        frame = self.estimator.frame
        if frame.travel_axis % QUARTERS == self._target_axis % QUARTERS and not self.estimator.is_turning:
            self.phase, self._progress = Phase.HALLWAY, -math.inf
        elif self._is_stuck(view):
            self._set_turn(self._freest_quarter(frame.travel_axis - self._target_axis))
        return self._command_towards(view, frame.node_line_point_in_base(self._target_axis, _LOOKAHEAD))

    def _approach_door(self, view: ObstacleView) -> MotionCommand:
        """Turn to the goal's door, and start the metric filter there."""
        assert self._goal is not None
        frame = self.estimator.frame
        front, beyond = (frame.node_offset_point_in_base(self._target_axis, offset) for offset in (0.0, _DOOR_MARGIN))
        angle = math.atan2(*(beyond - front)[::-1])
        self._before_door |= math.hypot(*front) <= _MAX_DISTANCE_TO_MIDDLE
        aligned = abs(angle) <= _MAX_MISALIGNMENT
        start = metric_initial_pose(self.estimator, self._building.chart) if self._before_door and aligned else None
        if start is not None and start.node == self._goal.node:
            return self._enter_room(start, view)
        if view.stamp - self._progress_stamp > _DOOR_TIMEOUT:
            self._target_axis, self.phase, self._progress = self._hallway_axis, Phase.TURN, -math.inf
            return self._turn_at_node(view)
        if not self._before_door:
            return self._command_towards(view, front)
        return self._command_towards(view, beyond) if aligned else turn_in_place(angle, self._limits)

    def _enter_room(self, start: MetricInitialPose, view: ObstacleView) -> MotionCommand:
        """Switch to the metric filter."""
        self.room = RoomFilter(self._mapping, self._building, start)
        self._entered_destination, self.initial_pose, self.phase = self._goal, start, Phase.ROOM
        self._path_follower = PathFollower(self._limits, _PLACE_TOLERANCE)
        return self._drive_into_room(view)

    def _drive_into_room(self, view: ObstacleView) -> MotionCommand:
        """Drive to the destination in the room."""
        goal = self._entered_destination
        assert goal is not None
        door = goal.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[-_DOOR_MARGIN, 0.0], [_DOOR_MARGIN, 0.0]]))
        command = self._follow_path(view, np.concatenate((through, goal.position[None])))
        if self._path_follower.has_arrived:
            self.phase = Phase.THERE
        return command

    def _drive_out_of_room(self, view: ObstacleView) -> MotionCommand:
        """Drive back to the node before the door, and continue by the belief from there."""
        assert self._entered_destination is not None
        assert self.room is not None
        door = self._entered_destination.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[_DOOR_MARGIN, 0.0], [-_DOOR_MARGIN, 0.0]]))
        command = self._follow_path(view, np.concatenate((self._entered_destination.position[None], through)))
        if self._path_follower.has_arrived:
            self._resume_in_hallway(view)
        return command

    def _follow_path(self, view: ObstacleView, path: Float64) -> MotionCommand:
        assert self.room is not None
        return self._path_follower.steer(view, se2.transform(se2.inverse(self.room.pose), path), self._velocity)

    def _resume_in_hallway(self, view: ObstacleView) -> None:
        """Continue at the node before a room's door, with the direction of the metric filter.

        The goal is at another node, or behind another door of this one.
        """
        assert self.room is not None
        assert self._entered_destination is not None
        assert self._goal is not None
        opening = self._entered_destination.opening
        turned = round(float(se2.wrap(self.room.pose[2] - opening.landmark.pose.mean[2])) / QUARTER_TURN)
        node, direction = self._entered_destination.node, (opening.direction - turned) % QUARTERS
        state = state_of(node, direction)
        graph, places = self._building.graph, self._configuration.places
        self.room.release()
        self.room, self._entered_destination = None, None
        self.estimator = PlaceEstimator(graph, self._configuration, certain_belief(graph, places, state))
        self._last_event = 0, False
        if self._goal.node == node:
            self._hallway_axis = self.estimator.frame.travel_axis - (opening.direction - direction) + 1
            self._start_door_approach(self._goal.opening.direction - direction, view)
            return
        quarters = turn_towards(graph, state, self._goal.node, self.edge_monitor.closed_states)
        self._set_turn(quarters or 0)
        self.phase = Phase.LOST if quarters is None else Phase.TURN
