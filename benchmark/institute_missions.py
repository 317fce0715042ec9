"""Missions from room to room of an institute that a robot drives by its belief over places, scored by true poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import networkx
import numpy as np

from benchmark.belief import Estimate
from benchmark.institute_maps import InstituteMap
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.local_motion import Limits
from hmt_slam_ros.exploration.mission_controller import MissionPilot, Phase
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.place_graph import heading_of, node_of, state_of
from hmt_slam_ros.places.policy import MetricStart
from hmt_slam_ros.places.position_belief import certain_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import Step, increment_covariance
from hmt_slam_ros.simulation.drive import ACCELERATION, TURN_ACCELERATION
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import Scenario

MISSIONS = 5
"""In a building."""

TIME = 300.0
"""Of a mission at most, s."""

LEAST = 20.0
"""Way of a mission, where there is a door so far away, m."""

AT_PLACE = 0.3
"""So near to a place the robot has reached it, m."""

_NEAR = 1.0  # m, from a state of the building to the node that is it
_RIGHT, _TURN = 1.0, 1.0  # m and rad, of the place that an estimate says from the true one
_WAY = 0.5 * math.pi


class Mission(NamedTuple):
    """A drive to a named place.

    :ivar success: whether the robot was confident before the door of its goal, and went over to the metric filter.
    :ivar reached: whether it is at the place in the room then, as it says.
    :ivar metres: driven.
    :ivar seconds: of the simulation.
    :ivar contacts: how often it came upon something.
    :ivar estimates: on the way.
    :ivar errors: of the metric start at the door, m, rad and NEES; None where there was none.
    """

    success: bool
    reached: bool
    metres: float
    seconds: float
    contacts: int
    estimates: list[Estimate]
    errors: tuple[float, float, float] | None


class Steered:
    """A driven robot that its belief steers.

    :ivar estimates: at every scan in a hallway, while the robot does not turn.
    """

    def __init__(
        self,
        institute: InstituteMap,
        scenario: Scenario,
        configuration: Configuration,
        start: Float64,
        state: int | None = None,
    ) -> None:
        """:param start: ``world_T_base`` (3,).

        :param state: that the robot knows to be in, None for one that is lost.
        """
        settings = scenario.settings
        limits = Limits(
            settings.speed,
            math.radians(settings.turn_rate),
            ACCELERATION,
            TURN_ACCELERATION,
            settings.radius,
            period=1.0 / settings.rate,
        )
        self._institute, self._configuration = institute, configuration
        self._known = known_of(institute, configuration)
        self.robot = DrivenRobot(scenario, start)
        belief = None if state is None else certain_belief(self._known.graph, configuration.places, state)
        self.pilot = MissionPilot(self._known, configuration, limits, belief)
        self.estimates: list[Estimate] = []
        self._wheels: Float64 | None = None

    def mission(self, goal: Destination) -> Mission:
        """Drive to a place."""
        robot, pilot = self.robot, self.pilot
        begin, metres, contacts = robot.stamp, robot.travelled, robot.contacts
        self.estimates, found = [], None
        pilot.go(goal)
        while robot.stamp < begin + TIME * NANOSECONDS and pilot.phase not in {Phase.THERE, Phase.LOST}:
            before, pose = pilot.started, robot.pose
            self.step()
            if pilot.started is not before and pilot.started is not None:
                found = pilot.started.node, self._errors(pilot.started, pose)
        place = se2.transform(self._institute.frames[goal.opening.area], goal.place[None])[0]
        reached = pilot.phase is Phase.THERE and math.dist(place, robot.pose[:2]) <= AT_PLACE
        success = found is not None and found[0] == goal.node
        return Mission(
            success,
            reached,
            robot.travelled - metres,
            (robot.stamp - begin) / NANOSECONDS,
            robot.contacts - contacts,
            self.estimates,
            None if found is None else found[1],
        )

    def step(self) -> None:
        """Measure, and drive on until there is more to measure."""
        odometry, scan = self.robot.measure()
        if scan is not None:
            self._steer(odometry, scan)
        self.robot.drive()

    def _steer(self, odometry: Odometry, scan: Scan) -> None:
        if self._wheels is not None:
            increment = se2.between(self._wheels, odometry.pose)
            self.pilot.moved(Step(increment, increment_covariance(increment, self._configuration.motion)))
        self._wheels = odometry.pose.copy()
        command = self.pilot.steer(scan)
        self.robot.command(command.speed, command.turn_rate)
        estimator = self.pilot.estimator
        belief = estimator.belief
        if self.pilot.room is None and belief is not None and estimator.in_hallway and not estimator.turning:
            right = is_right(self._institute, estimator, self.robot.pose)
            peak = float(belief.probabilities.max())
            self.estimates.append(Estimate(estimator.arrivals, self.robot.travelled, peak, belief.confident, right))

    def _errors(self, start: MetricStart, pose: Float64) -> tuple[float, float, float]:
        true = se2.between(self._institute.frames[start.area], pose)
        off = se2.log(se2.between(start.pose.mean, true))
        nees = float(off @ np.linalg.solve(start.pose.covariance, off))
        return math.hypot(off[0], off[1]), abs(float(off[2])), nees


def known_of(institute: InstituteMap, configuration: Configuration) -> KnownBuilding:
    """What the robot knows of an institute."""
    graph = institute.chart.graph(configuration.places)
    return KnownBuilding(institute.chart, graph, institute.hybrid_map, institute.scans)


def is_right(institute: InstituteMap, estimator: PlaceEstimator, pose: Float64) -> bool:
    """Whether the most likely place, which is a node and the way since then, is that of the robot.

    :param pose: ``world_T_base`` (3,).
    """
    belief = estimator.belief
    state = None if belief is None else belief.most_likely
    if state is None:
        return False
    off = se2.between(axis_of(institute, state), pose)
    near = math.hypot(off[0] - estimator.frame.away, off[1]) <= _RIGHT
    return near and abs(float(off[2])) <= _TURN


def axis_of(institute: InstituteMap, state: int) -> Float64:
    """True pose of a robot in a state, shape (3,)."""
    node = institute.nodes[node_of(state)]
    return np.array((*node[:2], float(se2.wrap(node[2] - _WAY * heading_of(state)))))


def missions_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[Mission]:
    """From room to room; where one fails, somebody carries the robot before the door of its goal."""
    random = np.random.default_rng([scenario.settings.seed, 1])
    places = destinations(known_of(institute, configuration))
    doors = open_doors(institute, scenario, places)
    start, steered, missions = int(random.choice(doors)), None, []
    for _ in range(MISSIONS):
        goal = _next_stop(random, institute, doors, start)
        if steered is None:
            state = _leaving(institute, start, goal)
            steered = Steered(institute, scenario, configuration, axis_of(institute, state), state)
        missions.append(steered.mission(places[goal]))
        if not missions[-1].reached:
            steered = None
        start = goal
    return missions


def open_doors(institute: InstituteMap, scenario: Scenario, places: Mapping[int, Destination]) -> list[int]:
    """The nodes of the chart with places behind doors that are open at a visit.

    :param places: {node: the place behind its door}.
    """
    states = scenario.building.states
    doors = states.poses[~states.crossings]
    return [node for node, place in places.items() if _is_open(doors, institute, place)]


def _is_open(doors: Float64, institute: InstituteMap, place: Destination) -> bool:
    """Whether the door of a place is one of some open ones (n, 3); one opposite it is another one."""
    opening = place.opening
    heading = se2.compose(institute.frames[opening.area], opening.landmark.pose.mean)[2]
    near = np.hypot(*(doors[:, :2] - institute.nodes[place.node, :2]).T) <= _NEAR
    return bool((near & (np.abs(se2.wrap(doors[:, 2] - heading)) <= _TURN)).any())


def _next_stop(random: np.random.Generator, institute: InstituteMap, doors: Sequence[int], stop: int) -> int:
    """One of the doors that are far away, or the farthest."""
    ways = {door: way_length(institute, stop, door) for door in doors if door != stop}
    far = [door for door, length in ways.items() if length >= LEAST]
    return int(random.choice(far or [max(ways, key=lambda door: ways[door])]))


def _leaving(institute: InstituteMap, start: int, goal: int) -> int:
    """The state of a robot that leaves a node on the shortest way to another one."""
    first = networkx.shortest_path(_ways(institute), start, goal, weight="length")[1]
    edges = institute.chart.edges
    direction = next(edge.leaving for edge in edges if (edge.start, edge.end) == (start, first))
    return state_of(start, direction)


def way_length(institute: InstituteMap, node: int, goal: int) -> float:
    """Of the shortest way from one node to another one, m."""
    return float(networkx.shortest_path_length(_ways(institute), node, goal, weight="length"))


def _ways(institute: InstituteMap) -> networkx.Graph:
    ways = networkx.Graph()
    for edge in institute.chart.edges:
        ways.add_edge(edge.start, edge.end, length=edge.distance[0])
    return ways
