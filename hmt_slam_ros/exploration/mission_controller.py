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
from hmt_slam_ros.exploration.local_motion import Command, Limits, command_towards
from hmt_slam_ros.exploration.path_follower import Pilot
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, RoomFilter
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.heading import QUARTER
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.edge_existence import WatchedWays
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import state_of
from hmt_slam_ros.places.policy import MetricStart, metric_start, next_turn, turn_towards
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Step
from hmt_slam_ros.submap.local_mapping import LocalMapping

# How far ahead the robot looks along a hallway, m; where it sees so far, m, a hallway leads on.
_AHEAD, _OPEN = 2.0, 3.0
# Behind a door the way into a room begins so far from it, m; a place is reached so near to it, m.
_BEHIND, _AT_PLACE = 0.6, 0.15
# So long a robot before a door looks for it, and waits where something is in its way, ns. It gets on by so much, m.
_LOOKS, _PATIENCE, _PROGRESS = 15 * NANOSECONDS, 10 * NANOSECONDS, 0.3
# It stands before a door so near to the middle of the hallway, m, and looks along an axis within this angle, rad.
_MIDDLE, _STRAIGHT = 0.2, math.radians(10.0)
# It looks along the ways around it where it is so far from where it did last, m, or stands for so long, ns; one that
# turned back is at its last node again so far before that, m.
_LOOK, _LOOK_AGAIN, _BACK = 0.5, 5 * NANOSECONDS, 0.2
# Displacement of a robot that got on.
_ELSEWHERE = np.array((_PROGRESS, 0.0, 0.0))
_STAND = Command(0.0, 0.0, arrived=False)


class Phase(Enum):
    """What the robot does."""

    HALLWAY = "goes along a hallway"
    TURN = "turns at a node"
    DOOR = "looks for the door of its goal"
    ROOM = "is on its way in a room"
    LEAVING = "leaves a room"
    THERE = "is at its goal"
    LOST = "knows no way"


class MissionPilot:
    """Drives a robot.

    :ivar estimator: of its place.
    :ivar phase: what it does.
    :ivar ways: which of them are closed.
    :ivar room: the metric filter, where it is in a room.
    :ivar started: what that filter started with last.
    """

    def __init__(
        self,
        known: KnownBuilding,
        configuration: Configuration,
        limits: Limits,
        belief: PositionBelief | None = None,
        ways: WatchedWays | None = None,
    ) -> None:
        """:param belief: of a robot that begins at a node.

        :param ways: what is known of whether ways are open; nothing unless given.
        """
        self._known, self._configuration, self._limits = known, configuration, limits
        self._model = observation_model(configuration.places, configuration.features)
        self._mapping = LocalMapping(configuration)
        self.estimator = PlaceEstimator(known.graph, configuration, belief)
        self.ways = ways or WatchedWays(known.graph, configuration.features)
        self.phase, self._before_door = Phase.THERE, False
        self.room: RoomFilter | None = None
        self.started: MetricStart | None = None
        self._goal: Destination | None = None
        self._room_of: Destination | None = None
        self._axis, self._along_hallway, self._here = 0, 0, (-1, False)
        self._since, self._came = 0, -math.inf
        self._looked, self._looked_from, self._turned_back = 0, _ELSEWHERE, False
        self._way = Pilot(limits, _AT_PLACE)
        self._velocity = (0.0, 0.0)
        self._drives = {
            Phase.HALLWAY: self._along,
            Phase.TURN: self._around,
            Phase.DOOR: self._to_door,
            Phase.ROOM: self._inside,
            Phase.LEAVING: self._outside,
        }

    def go(self, goal: Destination | None) -> None:
        """Take on a mission.

        :param goal: None to go on along hallways, to find out where the robot is.
        """
        self._goal, self._turned_back = goal, False
        self._way = Pilot(self._limits, _AT_PLACE)
        self._turn(0)
        self.phase = Phase.HALLWAY
        if self.room is not None:
            self.phase = Phase.ROOM if goal is self._room_of else Phase.LEAVING

    def begin_anew(self, belief: PositionBelief) -> None:
        """The robot is not before the door where its belief had it: it goes on along the hallway by another one."""
        assert self.room is not None
        self.room.release()
        self.room = self._room_of = None
        self.estimator.belief = belief
        # Its axis was the door's, along which one may see as far as along a hallway.
        self._axis, self.phase, self._came = self._axis + 1, Phase.TURN, -math.inf

    def stop(self) -> None:
        """Stand until the next mission."""
        self.phase = Phase.THERE

    def moved(self, step: Step) -> None:
        """The robot moved."""
        self.estimator.moved(step)
        self._looked_from = se2.compose(self._looked_from, step.increment)
        if self.room is not None:
            self.room.moved(step)

    def steer(self, scan: Scan) -> Command:
        """The velocities until the next scan."""
        if self.room is None:
            self.estimator.observe(scan)
            self._look(scan.stamp)
        else:
            self.room.observe(scan)
        drive = self._drives.get(self.phase)
        command = _STAND if drive is None else drive(scan)
        self._velocity = command.speed, command.turn_rate
        return command

    def _look(self, stamp: int) -> None:
        """See which ways are open around a robot that knows where it is."""
        estimator = self.estimator
        belief = estimator.belief
        state = belief.most_likely if belief is not None and belief.confident else None
        due = math.hypot(*self._looked_from[:2]) >= _LOOK or stamp - self._looked >= _LOOK_AGAIN
        if state is None or not due or estimator.turning:
            return
        self._looked, self._looked_from = stamp, np.zeros(3)
        frame = estimator.frame
        clear = np.array([frame.free(quarter) for quarter in range(QUARTERS)])
        self.ways.look(state, frame.away, frame.aside, clear)

    def _towards(self, scan: Scan, place: Float64) -> Command:
        return command_towards(scan, place, self._velocity, self._limits)

    def _along(self, scan: Scan) -> Command:
        """Keep to the middle of the hallway; at a node do what is best there.

        A robot that was turned off its way by what stood in it turns back, unless it came to a node thereby.
        """
        here = self.estimator.arrivals, self.estimator.at_wall
        arrived = here[0] != self._here[0]
        if (self.estimator.frame.axis - self._axis) % QUARTERS and not arrived:
            self.phase = Phase.TURN
            return self._around(scan)
        self._axis = self.estimator.frame.axis
        if arrived or here[1] > self._here[1] or (self._turned_back and self.estimator.frame.away >= -_BACK):
            self._decide(scan)
        self._here = here
        if self.phase is not Phase.HALLWAY:
            return self._drives[self.phase](scan)
        if self._held_up(scan):
            self._get_away()
        elif self._goes_wrong():
            self._turn_back()
        return self._towards(scan, self.estimator.frame.ahead(_AHEAD))

    def _goes_wrong(self) -> bool:
        """Whether its way was seen to be closed, and there is another one."""
        belief, goal, closed = self.estimator.belief, self._goal, self.ways.closed
        state = belief.most_likely if belief is not None and belief.confident else None
        if goal is None or state not in closed or self.estimator.frame.away < 0.0:
            return False
        return bool(turn_towards(self._known.graph, state, goal.node, closed))

    def _turn_back(self) -> None:
        """Turn between two nodes; at the last one it is decided anew."""
        self._turn(2)
        self.phase, self._turned_back = Phase.TURN, self.estimator.belief is not None

    def _get_away(self) -> None:
        """Turn back where the way does not lead on; a robot that does not know its place turns to where it sees far.

        Before the wall opposite a door the way back is the room, out of which it came.
        """
        belief = self.estimator.belief
        if belief is not None and belief.confident:
            self._turn_back()
        else:
            self._turn(self._freest(0))
            self.phase = Phase.TURN

    def _held_up(self, scan: Scan) -> bool:
        """Whether the robot has not come farther along its axis for long, wherever it drove meanwhile."""
        came = self.estimator.frame.along(self._axis)
        held_up = came < self._came + _PROGRESS and scan.stamp - self._since > _PATIENCE
        if held_up or came >= self._came + _PROGRESS:
            self._came, self._since = came, scan.stamp
        return held_up

    def _decide(self, scan: Scan) -> None:
        """What the most likely state policy says; straight on where it says nothing, and back at a wall."""
        belief, facing, goal = self.estimator.belief, self.estimator.facing, self._goal
        node = None if goal is None else goal.node
        at_wall, self._turned_back = self.estimator.at_wall, False
        if at_wall and belief is not None and belief.confident and not self.estimator.at_node:
            self._turn_back()
            return
        if goal is not None and belief is not None and belief.confident and facing is not None and facing[0] == node:
            self._along_hallway = self.estimator.frame.axis
            self._turn_to_door(goal.opening.direction - facing[1], scan)
            return
        closed = self.ways.closed
        quarters = None if belief is None else next_turn(belief, node, self._model, ahead=not at_wall, closed=closed)
        quarters = 2 if at_wall and not quarters else quarters
        if quarters and not (belief is not None and belief.confident) and not self._leads_on(quarters):
            quarters = self._freest(quarters)
        if quarters:
            self._turn(quarters)
            self.phase = Phase.TURN

    def _leads_on(self, quarters: int) -> bool:
        """Whether the robot sees that it goes on so many quarters to the right."""
        return not self.estimator.frame.free(quarters) < _OPEN

    def _freest(self, without: int) -> int:
        """In how many quarters to the right one sees farthest, but for some."""
        others = [k for k in range(QUARTERS) if (k - without) % QUARTERS]
        return max(others, key=lambda k: np.nan_to_num(self.estimator.frame.free(k)))

    def _turn(self, quarters: int) -> None:
        """Turn so many quarters to the right."""
        self._axis, self._came = self.estimator.frame.axis - quarters, -math.inf

    def _turn_to_door(self, quarters: int, scan: Scan) -> None:
        """Turn so many quarters to the right, to where the goal's door is."""
        self._turn(quarters % QUARTERS)
        self.phase, self._since, self._before_door = Phase.DOOR, scan.stamp, False

    def _around(self, scan: Scan) -> Command:
        """Turn at the last node into a hallway; where that does not get anywhere, into another one."""
        if self.estimator.frame.axis % QUARTERS == self._axis % QUARTERS and not self.estimator.turning:
            self.phase, self._came = Phase.HALLWAY, -math.inf
        elif self._held_up(scan):
            self._turn(self._freest(self.estimator.frame.axis - self._axis))
        return self._towards(scan, self.estimator.frame.on_line(self._axis, _AHEAD))

    def _to_door(self, scan: Scan) -> Command:
        """Turn to the goal's door, and begin with the metric filter there."""
        assert self._goal is not None
        front, beyond = (self.estimator.frame.beside_node(self._axis, far) for far in (0.0, _BEHIND))
        off = math.atan2(*(beyond - front)[::-1])
        self._before_door |= math.hypot(*front) <= _MIDDLE
        start = metric_start(self.estimator, self._known.chart) if self._before_door and abs(off) <= _STRAIGHT else None
        if start is not None and start.node == self._goal.node:
            return self._enter(start, scan)
        if scan.stamp - self._since > _LOOKS:
            self._axis, self.phase, self._came = self._along_hallway, Phase.TURN, -math.inf
            return self._around(scan)
        if not self._before_door:
            return self._towards(scan, front)
        return self._turned(off) if abs(off) > _STRAIGHT else self._towards(scan, beyond)

    def _enter(self, start: MetricStart, scan: Scan) -> Command:
        """Go over to the metric filter."""
        self.room = RoomFilter(self._mapping, self._known, start)
        self._room_of, self.started, self.phase = self._goal, start, Phase.ROOM
        self._way = Pilot(self._limits, _AT_PLACE)
        return self._inside(scan)

    def _turned(self, angle: float) -> Command:
        """Turn on the spot."""
        limits = self._limits
        rate = min(limits.turn_rate, math.sqrt(2.0 * limits.turn_acceleration * abs(angle)), abs(angle) / limits.period)
        return Command(0.0, math.copysign(rate, angle), arrived=False)

    def _inside(self, scan: Scan) -> Command:
        """Drive to the place in the room."""
        goal = self._room_of
        assert goal is not None
        door = goal.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[-_BEHIND, 0.0], [_BEHIND, 0.0]]))
        command = self._keep_to(scan, np.concatenate((through, goal.place[None])))
        if self._way.arrived:
            self.phase = Phase.THERE
        return command

    def _outside(self, scan: Scan) -> Command:
        """Drive back to the node before the door, and let the belief go on from there."""
        assert self._room_of is not None
        assert self.room is not None
        door = self._room_of.opening.landmark.pose.mean
        through = se2.transform(door, np.array([[_BEHIND, 0.0], [-_BEHIND, 0.0]]))
        command = self._keep_to(scan, np.concatenate((self._room_of.place[None], through)))
        if self._way.arrived:
            self._resume(scan)
        return command

    def _keep_to(self, scan: Scan, way: Float64) -> Command:
        assert self.room is not None
        return self._way.steer(scan, se2.transform(se2.inverse(self.room.pose), way), self._velocity)

    def _resume(self, scan: Scan) -> None:
        """Out of a room the robot is at the node before its door; where it looks, the metric filter knows.

        From there the goal is another node's, or it is the room behind another door of this one. The robot has got on,
        though it may be where it went in.
        """
        assert self.room is not None
        assert self._room_of is not None
        assert self._goal is not None
        opening = self._room_of.opening
        turned = round(float(se2.wrap(self.room.pose[2] - opening.landmark.pose.mean[2])) / QUARTER)
        node, looks = self._room_of.node, (opening.direction - turned) % QUARTERS
        state = state_of(node, looks)
        graph, places = self._known.graph, self._configuration.places
        self.room.release()
        self.room, self._room_of = None, None
        self.estimator = PlaceEstimator(graph, self._configuration, certain_belief(graph, places, state))
        self._here = 0, False
        if self._goal.node == node:
            self._along_hallway = self.estimator.frame.axis - (opening.direction - looks) + 1
            self._turn_to_door(self._goal.opening.direction - looks, scan)
            return
        quarters = turn_towards(graph, state, self._goal.node, self.ways.closed)
        self._turn(quarters or 0)
        self.phase = Phase.LOST if quarters is None else Phase.TURN
