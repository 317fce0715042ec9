"""A robot that gets to named places by the belief over places and, behind a door, by the metric filter.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.3 and 3.4: along hallways the robot keeps to the middle between the
walls that it sees, and at a node turns as the most likely state policy has it (policy.py). Before the goal's door it
goes over to the metric filter, but only if it is confident; one that finds no door there goes on along the hallway. Out
of a room it drives to where the door's node is, and from there on the belief tells again where it is.
"""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards
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
from hmt_slam_ros.sensors.motion_model import RelativeMotion
from hmt_slam_ros.submap.local_mapping import LocalMapping

# How far ahead the robot looks along a hallway, m; where it sees so far, m, a hallway leads on.
_AHEAD, _OPEN = 2.0, 3.0
# Behind a door the way into a room begins so far from it, m; a place is reached so near to it, m.
_BEHIND, _AT_PLACE = 0.6, 0.15
# So long a robot before a door looks for it, and waits where something is in its way, ns. It gets on by so much, m.
_DOOR_TIMEOUT, _STUCK_TIMEOUT, _PROGRESS = 15 * NANOSECONDS, 10 * NANOSECONDS, 0.3
# It stands before a door so near to the middle of the hallway, m, and looks along an axis within this angle, rad.
_MIDDLE, _STRAIGHT = 0.2, math.radians(10.0)
# It looks along the ways around it where it is so far from where it did last, m, or stands for so long, ns; one that
# turned back is at its last node again so far before that, m.
_LOOK, _LOOK_AGAIN, _NODE_MARGIN = 0.5, 5 * NANOSECONDS, 0.2
# Displacement of a robot that got on.
_INITIAL_DISPLACEMENT = np.array((_PROGRESS, 0.0, 0.0))
_STAND = MotionCommand(0.0, 0.0, arrived=False)


class Phase(Enum):
    """What the robot does."""

    HALLWAY = "goes along a hallway"
    TURN = "turns at a node"
    DOOR = "looks for the door of its goal"
    ROOM = "is on its way in a room"
    LEAVING = "leaves a room"
    THERE = "is at its goal"
    LOST = "knows no way"


class MissionController:
    """Drives a robot.

    :ivar estimator: of its place.
    :ivar phase: what it does.
    :ivar edge_monitor: which of them are closed.
    :ivar room: the metric filter, where it is in a room.
    :ivar initial_pose: what that filter started with last.
    """

    def __init__(
        self,
        known: KnownBuilding,
        configuration: Configuration,
        limits: MotionLimits,
        belief: PositionBelief | None = None,
        ways: EdgeMonitor | None = None,
    ) -> None:
        """:param belief: of a robot that begins at a node.

        :param ways: what is known of whether ways are open; nothing unless given.
        """
        self._building, self._configuration, self._limits = known, configuration, limits
        self._model = observation_model(configuration.places, configuration.features)
        self._mapping = LocalMapping(configuration)
        self.estimator = PlaceEstimator(known.graph, configuration, belief)
        self.edge_monitor = ways or EdgeMonitor(known.graph, configuration.features)
        self.phase, self._before_door = Phase.THERE, False
        self.room: RoomFilter | None = None
        self.initial_pose: MetricInitialPose | None = None
        self._goal: Destination | None = None
        self._entered_destination: Destination | None = None
        self._target_axis, self._hallway_axis, self._last_event = 0, 0, (-1, False)
        self._progress_stamp, self._progress = 0, -math.inf
        self._observation_stamp, self._observation_displacement, self._has_turned_back = 0, _INITIAL_DISPLACEMENT, False
        self._path_follower = PathFollower(limits, _AT_PLACE)
        self._velocity = (0.0, 0.0)
        self._behaviors = {
            Phase.HALLWAY: self._follow_hallway,
            Phase.TURN: self._turn_at_node,
            Phase.DOOR: self._approach_door,
            Phase.ROOM: self._drive_into_room,
            Phase.LEAVING: self._drive_out_of_room,
        }

    def start_mission(self, goal: Destination | None) -> None:
        """Take on a mission.

        :param goal: None to go on along hallways, to find out where the robot is.
        """
        self._goal, self._has_turned_back = goal, False
        self._path_follower = PathFollower(self._limits, _AT_PLACE)
        self._set_turn(0)
        self.phase = Phase.HALLWAY
        if self.room is not None:
            self.phase = Phase.ROOM if goal is self._entered_destination else Phase.LEAVING

    def restart_in_hallway(self, belief: PositionBelief) -> None:
        """The robot is not before the door where its belief had it: it goes on along the hallway by another one."""
        assert self.room is not None
        self.room.release()
        self.room = self._entered_destination = None
        self.estimator.belief = belief
        # Its axis was the door's, along which one may see as far as along a hallway.
        self._target_axis, self.phase, self._progress = self._target_axis + 1, Phase.TURN, -math.inf

    def stop(self) -> None:
        """Stand until the next mission."""
        self.phase = Phase.THERE

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self.estimator.predict(step)
        self._observation_displacement = se2.compose(self._observation_displacement, step.increment)
        if self.room is not None:
            self.room.predict(step)

    def steer(self, scan: Scan) -> MotionCommand:
        """The velocities until the next scan."""
        if self.room is None:
            self.estimator.observe(scan)
            self._observe_edges(scan.stamp)
        else:
            self.room.observe(scan)
        drive = self._behaviors.get(self.phase)
        command = _STAND if drive is None else drive(scan)
        self._velocity = command.speed, command.turn_rate
        return command

    def _observe_edges(self, stamp: int) -> None:
        """See which ways are open around a robot that knows where it is."""
        estimator = self.estimator
        belief = estimator.belief
        state = belief.most_likely_state if belief is not None and belief.is_confident else None
        due = math.hypot(*self._observation_displacement[:2]) >= _LOOK or stamp - self._observation_stamp >= _LOOK_AGAIN
        if state is None or not due or estimator.is_turning:
            return
        self._observation_stamp, self._observation_displacement = stamp, np.zeros(3)
        frame = estimator.frame
        clear = np.array([frame.free_distance(quarter) for quarter in range(QUARTERS)])
        self.edge_monitor.observe(state, frame.distance_past_node, frame.lateral_offset, clear)

    def _command_towards(self, scan: Scan, place: Float64) -> MotionCommand:
        return command_towards(scan, place, self._velocity, self._limits)

    def _follow_hallway(self, scan: Scan) -> MotionCommand:
        """Keep to the middle of the hallway; at a node do what is best there.

        A robot that was turned off its way by what stood in it turns back, unless it came to a node thereby.
        """
        here = self.estimator.arrivals, self.estimator.is_at_wall
        arrived = here[0] != self._last_event[0]
        if (self.estimator.frame.travel_axis - self._target_axis) % QUARTERS and not arrived:
            self.phase = Phase.TURN
            return self._turn_at_node(scan)
        self._target_axis = self.estimator.frame.travel_axis
        if (
            arrived
            or here[1] > self._last_event[1]
            or (self._has_turned_back and self.estimator.frame.distance_past_node >= -_NODE_MARGIN)
        ):
            self._decide(scan)
        self._last_event = here
        if self.phase is not Phase.HALLWAY:
            return self._behaviors[self.phase](scan)
        if self._is_stuck(scan):
            self._escape()
        elif self._is_way_closed():
            self._turn_back()
        return self._command_towards(scan, self.estimator.frame.center_point_ahead_in_base(_AHEAD))

    def _is_way_closed(self) -> bool:
        """Whether its way was seen to be closed, and there is another one."""
        belief, goal, closed = self.estimator.belief, self._goal, self.edge_monitor.closed_states
        state = belief.most_likely_state if belief is not None and belief.is_confident else None
        if goal is None or state not in closed or self.estimator.frame.distance_past_node < 0.0:
            return False
        return bool(turn_towards(self._building.graph, state, goal.node, closed))

    def _turn_back(self) -> None:
        """Turn between two nodes; at the last one it is decided anew."""
        self._set_turn(2)
        self.phase, self._has_turned_back = Phase.TURN, self.estimator.belief is not None

    def _escape(self) -> None:
        """Turn back where the way does not lead on; a robot that does not know its place turns to where it sees far.

        Before the wall opposite a door the way back is the room, out of which it came.
        """
        belief = self.estimator.belief
        if belief is not None and belief.is_confident:
            self._turn_back()
        else:
            self._set_turn(self._freest_quarter(0))
            self.phase = Phase.TURN

    def _is_stuck(self, scan: Scan) -> bool:
        """Whether the robot has not come farther along its axis for long, wherever it drove meanwhile."""
        came = self.estimator.frame.coordinate_along(self._target_axis)
        held_up = came < self._progress + _PROGRESS and scan.stamp - self._progress_stamp > _STUCK_TIMEOUT
        if held_up or came >= self._progress + _PROGRESS:
            self._progress, self._progress_stamp = came, scan.stamp
        return held_up

    def _decide(self, scan: Scan) -> None:
        """What the most likely state policy says; straight on where it says nothing, and back at a wall."""
        belief, facing, goal = self.estimator.belief, self.estimator.node_and_direction, self._goal
        node = None if goal is None else goal.node
        at_wall, self._has_turned_back = self.estimator.is_at_wall, False
        if at_wall and belief is not None and belief.is_confident and not self.estimator.is_at_node:
            self._turn_back()
            return
        if goal is not None and belief is not None and belief.is_confident and facing is not None and facing[0] == node:
            self._hallway_axis = self.estimator.frame.travel_axis
            self._start_door_approach(goal.opening.direction - facing[1], scan)
            return
        closed = self.edge_monitor.closed_states
        quarters = None if belief is None else next_turn(belief, node, self._model, ahead=not at_wall, closed=closed)
        quarters = 2 if at_wall and not quarters else quarters
        if quarters and not (belief is not None and belief.is_confident) and not self._is_open(quarters):
            quarters = self._freest_quarter(quarters)
        if quarters:
            self._set_turn(quarters)
            self.phase = Phase.TURN

    def _is_open(self, quarters: int) -> bool:
        """Whether the robot sees that it goes on so many quarters to the right."""
        return not self.estimator.frame.free_distance(quarters) < _OPEN

    def _freest_quarter(self, without: int) -> int:
        """In how many quarters to the right one sees farthest, but for some."""
        others = [k for k in range(QUARTERS) if (k - without) % QUARTERS]
        return max(others, key=lambda k: np.nan_to_num(self.estimator.frame.free_distance(k)))

    def _set_turn(self, quarters: int) -> None:
        """Turn so many quarters to the right."""
        self._target_axis, self._progress = self.estimator.frame.travel_axis - quarters, -math.inf

    def _start_door_approach(self, quarters: int, scan: Scan) -> None:
        """Turn so many quarters to the right, to where the goal's door is."""
        self._set_turn(quarters % QUARTERS)
        self.phase, self._progress_stamp, self._before_door = Phase.DOOR, scan.stamp, False

    def _turn_at_node(self, scan: Scan) -> MotionCommand:
        """Turn at the last node into a hallway; where that does not get anywhere, into another one."""
        if (
            self.estimator.frame.travel_axis % QUARTERS == self._target_axis % QUARTERS
            and not self.estimator.is_turning
        ):
            self.phase, self._progress = Phase.HALLWAY, -math.inf
        elif self._is_stuck(scan):
            self._set_turn(self._freest_quarter(self.estimator.frame.travel_axis - self._target_axis))
        return self._command_towards(scan, self.estimator.frame.node_line_point_in_base(self._target_axis, _AHEAD))

    def _approach_door(self, scan: Scan) -> MotionCommand:
        """Turn to the goal's door, and begin with the metric filter there."""
        assert self._goal is not None
        front, beyond = (
            self.estimator.frame.node_offset_point_in_base(self._target_axis, far) for far in (0.0, _BEHIND)
        )
        off = math.atan2(*(beyond - front)[::-1])
        self._before_door |= math.hypot(*front) <= _MIDDLE
        start = (
            metric_initial_pose(self.estimator, self._building.chart)
            if self._before_door and abs(off) <= _STRAIGHT
            else None
        )
        if start is not None and start.node == self._goal.node:
            return self._enter_room(start, scan)
        if scan.stamp - self._progress_stamp > _DOOR_TIMEOUT:
            self._target_axis, self.phase, self._progress = self._hallway_axis, Phase.TURN, -math.inf
            return self._turn_at_node(scan)
        if not self._before_door:
            return self._command_towards(scan, front)
        return self._turn_in_place(off) if abs(off) > _STRAIGHT else self._command_towards(scan, beyond)

    def _enter_room(self, start: MetricInitialPose, scan: Scan) -> MotionCommand:
        """Go over to the metric filter."""
        self.room = RoomFilter(self._mapping, self._building, start)
        self._entered_destination, self.initial_pose, self.phase = self._goal, start, Phase.ROOM
        self._path_follower = PathFollower(self._limits, _AT_PLACE)
        return self._drive_into_room(scan)

    def _turn_in_place(self, angle: float) -> MotionCommand:
        """Turn on the spot."""
        limits = self._limits
        rate = min(limits.turn_rate, math.sqrt(2.0 * limits.turn_acceleration * abs(angle)), abs(angle) / limits.period)
        return MotionCommand(0.0, math.copysign(rate, angle), arrived=False)

    def _drive_into_room(self, scan: Scan) -> MotionCommand:
        """Drive to the place in the room."""
        goal = self._entered_destination
        assert goal is not None
        door = goal.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[-_BEHIND, 0.0], [_BEHIND, 0.0]]))
        command = self._follow_path(scan, np.concatenate((through, goal.position[None])))
        if self._path_follower.has_arrived:
            self.phase = Phase.THERE
        return command

    def _drive_out_of_room(self, scan: Scan) -> MotionCommand:
        """Drive back to the node before the door, and let the belief go on from there."""
        assert self._entered_destination is not None
        assert self.room is not None
        door = self._entered_destination.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[_BEHIND, 0.0], [-_BEHIND, 0.0]]))
        command = self._follow_path(scan, np.concatenate((self._entered_destination.position[None], through)))
        if self._path_follower.has_arrived:
            self._resume_in_hallway(scan)
        return command

    def _follow_path(self, scan: Scan, way: Float64) -> MotionCommand:
        assert self.room is not None
        return self._path_follower.steer(scan, se2.transform(se2.inverse(self.room.pose), way), self._velocity)

    def _resume_in_hallway(self, scan: Scan) -> None:
        """Out of a room the robot is at the node before its door; where it looks, the metric filter knows.

        From there the goal is another node's, or it is the room behind another door of this one. The robot has got on,
        though it may be where it went in.
        """
        assert self.room is not None
        assert self._entered_destination is not None
        assert self._goal is not None
        opening = self._entered_destination.opening
        turned = round(float(se2.wrap(self.room.pose[2] - opening.landmark.pose.mean[2])) / QUARTER_TURN)
        node, looks = self._entered_destination.node, (opening.direction - turned) % QUARTERS
        state = state_of(node, looks)
        graph, places = self._building.graph, self._configuration.places
        self.room.release()
        self.room, self._entered_destination = None, None
        self.estimator = PlaceEstimator(graph, self._configuration, certain_belief(graph, places, state))
        self._last_event = 0, False
        if self._goal.node == node:
            self._hallway_axis = self.estimator.frame.travel_axis - (opening.direction - looks) + 1
            self._start_door_approach(self._goal.opening.direction - looks, scan)
            return
        quarters = turn_towards(graph, state, self._goal.node, self.edge_monitor.closed_states)
        self._set_turn(quarters or 0)
        self.phase = Phase.LOST if quarters is None else Phase.TURN
