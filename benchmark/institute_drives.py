"""Missions and relocations of simulated robots in an institute, by the belief over places."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import networkx
import numpy as np

from benchmark.driving import motion_limits
from benchmark.institute_maps import InstituteMap
from benchmark.simulated.truth import nees
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.mission_controller import MissionController, Phase
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.place_graph import heading_of, node_of, state_of
from hmt_slam_ros.places.policy import MetricInitialPose
from hmt_slam_ros.places.position_belief import certain_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import Scenario

MISSIONS, RELOCATIONS = 5, 2
"""Number of each in a building."""

TIME = 300.0
"""Largest duration of a mission, s."""

LEAST = 20.0
"""Smallest distance of a mission, if there is a door so far away, m."""

AT_PLACE = 0.3
"""Largest distance of a robot that has reached its place, m."""

FAR, _LOST = 60.0, 300.0
"""Largest distance of a relocation, m, and its largest duration, s."""

_NEAR = 1.0  # largest distance from a state of the building to its node, m
_RIGHT, _TURN = 1.0, 1.0  # largest error of the place and the direction of a right estimate, m and rad
_QUARTER_TURN = 0.5 * math.pi
_AFTER = 3  # nodes without an error after which a recovery counts


class Estimate(NamedTuple):
    """An estimate of the place, compared with the truth.

    :ivar arrivals: nodes noticed so far.
    :ivar distance: traveled so far.
    :ivar probability: of the most likely state.
    :ivar confident: whether the belief is.
    :ivar right: whether the place is the true one.
    """

    arrivals: int
    distance: float
    probability: float
    confident: bool
    right: bool


class Mission(NamedTuple):
    """A drive to a named place.

    :ivar success: whether the robot switched to the metric filter at the door of its goal.
    :ivar reached: whether it reported that it reached the place, and did.
    :ivar distance: driven, m.
    :ivar seconds: simulated time, s.
    :ivar contacts: number of contacts.
    :ivar estimates: on the way.
    :ivar errors: of the metric start at the door, m, rad and NEES; None if there was none.
    """

    success: bool
    reached: bool
    distance: float
    seconds: float
    contacts: int
    estimates: list[Estimate]
    errors: tuple[float, float, float] | None


class BeliefDrivenRobot:
    """A simulated robot that is driven by its belief over places.

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

        :param state: the known initial state, None for a lost robot.
        """
        self._institute, self._configuration = institute, configuration
        self._known = known_building(institute, configuration)
        self.robot = DrivenRobot(scenario, start)
        belief = None if state is None else certain_belief(self._known.graph, configuration.places, state)
        self.pilot = MissionController(self._known, configuration, motion_limits(scenario.settings), belief)
        self.estimates: list[Estimate] = []
        self._wheels: Float64 | None = None

    def mission(self, goal: Destination) -> Mission:
        """Drive to a destination."""
        robot, pilot = self.robot, self.pilot
        begin, distance, contacts = robot.stamp, robot.distance_traveled, robot.contacts
        self.estimates, start = [], None
        pilot.start_mission(goal)
        while robot.stamp < begin + TIME * NANOSECONDS and pilot.phase not in {Phase.THERE, Phase.LOST}:
            before, pose = pilot.initial_pose, robot.pose
            self.step()
            if pilot.initial_pose is not before and pilot.initial_pose is not None:
                start = pilot.initial_pose.node, self._errors(pilot.initial_pose, pose)
        place = se2.transform(self._institute.frames[goal.opening.area], goal.position[None])[0]
        reached = pilot.phase is Phase.THERE and math.dist(place, robot.pose[:2]) <= AT_PLACE
        success = start is not None and start[0] == goal.node
        return Mission(
            success,
            reached,
            robot.distance_traveled - distance,
            (robot.stamp - begin) / NANOSECONDS,
            robot.contacts - contacts,
            self.estimates,
            None if start is None else start[1],
        )

    def step(self) -> None:
        """Process a measurement, and drive on until the next."""
        odometry, scan = self.robot.measure()
        if scan is not None:
            self._steer(odometry, scan)
        self.robot.advance()

    def _steer(self, odometry: Odometry, scan: Scan) -> None:
        if self._wheels is not None:
            increment = se2.between(self._wheels, odometry.pose)
            self.pilot.predict(RelativeMotion(increment, increment_covariance(increment, self._configuration.motion)))
        self._wheels = odometry.pose.copy()
        command = self.pilot.steer(scan)
        self.robot.set_velocity(command.speed, command.turn_rate)
        estimator = self.pilot.estimator
        belief = estimator.belief
        if self.pilot.room is None and belief is not None and estimator.is_in_hallway and not estimator.is_turning:
            right = is_right(self._institute, estimator, self.robot.pose)
            peak = float(belief.probabilities.max())
            self.estimates.append(
                Estimate(estimator.arrivals, self.robot.distance_traveled, peak, belief.is_confident, right)
            )

    def _errors(self, start: MetricInitialPose, pose: Float64) -> tuple[float, float, float]:
        true = se2.between(self._institute.frames[start.area], pose)
        error = se2.log(se2.between(start.pose.mean, true))
        return math.hypot(error[0], error[1]), abs(float(error[2])), nees(start.pose, true)


def known_building(institute: InstituteMap, configuration: Configuration) -> KnownBuilding:
    """The map of an institute for the robot."""
    graph = institute.chart.graph(configuration.places)
    return KnownBuilding(institute.chart, graph, institute.hybrid_map, institute.scans)


def is_right(institute: InstituteMap, estimator: PlaceEstimator, pose: Float64) -> bool:
    """Whether the most likely place, a node and the distance since then, is that of the robot.

    :param pose: ``world_T_base`` (3,).
    """
    belief = estimator.belief
    state = None if belief is None else belief.most_likely_state
    if state is None:
        return False
    error = se2.between(axis_of(institute, state), pose)
    near = math.hypot(error[0] - estimator.frame.distance_past_node, error[1]) <= _RIGHT
    return near and abs(float(error[2])) <= _TURN


def axis_of(institute: InstituteMap, state: int) -> Float64:
    """True pose of a robot in a state, shape (3,)."""
    node = institute.nodes[node_of(state)]
    return np.array((*node[:2], float(se2.wrap(node[2] - _QUARTER_TURN * heading_of(state)))))


def missions_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[Mission]:
    """Missions from room to room; after one that fails, the robot starts before the door of its goal."""
    random = np.random.default_rng([scenario.settings.seed, 1])
    places = destinations(known_building(institute, configuration))
    doors = open_doors(institute, scenario, places)
    start, robot, missions = int(random.choice(doors)), None, []
    for _ in range(MISSIONS):
        goal = _next_stop(random, institute, doors, start)
        if robot is None:
            state = _departure_state(institute, start, goal)
            robot = BeliefDrivenRobot(institute, scenario, configuration, axis_of(institute, state), state)
        missions.append(robot.mission(places[goal]))
        if not missions[-1].reached:
            robot = None
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
    """Whether the door of a place is one of some open ones (n, 3); the opposite door is another one."""
    opening = place.opening
    heading = se2.compose(institute.frames[opening.area], opening.landmark.pose.mean)[2]
    near = np.hypot(*(doors[:, :2] - institute.nodes[place.node, :2]).T) <= _NEAR
    return bool((near & (np.abs(se2.wrap(doors[:, 2] - heading)) <= _TURN)).any())


def _next_stop(random: np.random.Generator, institute: InstituteMap, doors: Sequence[int], stop: int) -> int:
    """A random one of the doors that are far away, or the farthest door."""
    distances = {door: path_length(institute, stop, door) for door in doors if door != stop}
    far = [door for door, length in distances.items() if length >= LEAST]
    return int(random.choice(far or [max(distances, key=lambda door: distances[door])]))


def _departure_state(institute: InstituteMap, start: int, goal: int) -> int:
    """The state of a robot that leaves a node on the shortest path to another one."""
    first = networkx.shortest_path(_place_graph(institute), start, goal, weight="length")[1]
    edges = institute.chart.edges
    direction = next(edge.start_direction for edge in edges if (edge.start, edge.end) == (start, first))
    return state_of(start, direction)


def path_length(institute: InstituteMap, node: int, goal: int) -> float:
    """Length of the shortest path from one node to another, m."""
    return float(networkx.shortest_path_length(_place_graph(institute), node, goal, weight="length"))


def _place_graph(institute: InstituteMap) -> networkx.Graph:
    graph = networkx.Graph()
    for edge in institute.chart.edges:
        graph.add_edge(edge.start, edge.end, length=edge.distance[0])
    return graph


def relocations_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[list[Estimate]]:
    """The estimates of robots that start lost."""
    random = np.random.default_rng([scenario.settings.seed, 2])
    return [_drive_relocation(institute, scenario, configuration, random) for _ in range(RELOCATIONS)]


def _drive_relocation(
    institute: InstituteMap, scenario: Scenario, configuration: Configuration, random: np.random.Generator
) -> list[Estimate]:
    edges = list({(edge.start, edge.start_direction): edge for edge in institute.chart.edges}.values())
    lengths = np.array([edge.distance[0] for edge in edges])
    edge = edges[int(random.choice(len(lengths), p=lengths / lengths.sum()))]
    ahead = np.array((random.uniform(0.2, 0.8) * edge.distance[0], 0.0, 0.0))
    start = se2.compose(axis_of(institute, state_of(edge.start, edge.start_direction)), ahead)
    robot = BeliefDrivenRobot(institute, scenario, configuration, start)
    robot.pilot.start_mission(None)
    end = robot.robot.stamp + _LOST * NANOSECONDS
    while robot.robot.distance_traveled < FAR and robot.robot.stamp < end and recovery(robot.estimates) is None:
        robot.step()
    return robot.estimates


def recovery(estimates: Sequence[Estimate]) -> Estimate | None:
    """The first confident and right estimate without a wrong one at the next nodes; None if there is none."""
    first: Estimate | None = None
    for k, estimate in enumerate(estimates):
        if not estimate.right:
            first = None
        elif first is None and estimate.confident:
            first = estimate
        last = k + 1 == len(estimates) or estimates[k + 1].arrivals > estimate.arrivals
        if first is not None and last and estimate.arrivals - first.arrivals >= _AFTER:
            return first
    return None
