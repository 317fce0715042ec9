"""A robot that is driven through an institute by true poses while a belief over its places runs along."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import networkx
import numpy as np

from benchmark.belief import Estimate
from benchmark.institute_maps import InstituteMap
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.motion import Limits, command_towards
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.place_graph import heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.motion import Step, increment_covariance
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.driver import ACCELERATION, TURN_ACCELERATION
from hmt_slam_ros.simulation.scenario import Scenario

_TIME = 180.0  # s, for a goal
_RIGHT, _TURN = 1.0, 1.0  # m and rad, of the place that an estimate says from the true one
_WAY = 0.5 * math.pi


class Guided:
    """A driven robot and its belief.

    :ivar estimates: at every scan in a hallway, while the robot does not turn.
    """

    def __init__(
        self, institute: InstituteMap, scenario: Scenario, start: Float64, configuration: Configuration,
        belief: PositionBelief | None = None,
    ) -> None:  # fmt: skip
        """:param start: ``world_T_base`` (3,).

        :param belief: at the first node.
        """
        settings = scenario.settings
        self._limits = Limits(
            settings.speed, math.radians(settings.turn_rate), ACCELERATION, TURN_ACCELERATION, settings.radius,
            period=1.0 / settings.rate,
        )  # fmt: skip
        self._institute, self._nodes, self._configuration = institute, institute.nodes, configuration
        self.graph = institute.chart.graph(configuration.places)
        self.robot = DrivenRobot(scenario, start)
        self.estimator = PlaceEstimator(self.graph, configuration, belief)
        self.estimates: list[Estimate] = []
        self._wheels: Float64 | None = None

    def drive_to(self, goal: Float64) -> Iterator[Scan]:
        """Drive to a place (2,), m; the scans on the way, after what they tell."""
        end = self.robot.stamp + round(_TIME * NANOSECONDS)
        while self.robot.stamp < end:
            odometry, scan = self.robot.measure()
            if scan is not None:
                self._observe(odometry.pose, scan)
                yield scan
                ahead = se2.transform(se2.inverse(self.robot.pose), goal[None])[0]
                command = command_towards(scan, ahead, self.robot.velocity, self._limits)
                if command.arrived:
                    return
                self.robot.command(command.speed, command.turn_rate)
            self.robot.drive()
        self.robot.carry(np.array((*goal, self.robot.pose[2])))

    def _observe(self, wheels: Float64, scan: Scan) -> None:
        if self._wheels is not None:
            increment = se2.between(self._wheels, wheels)
            self.estimator.moved(Step(increment, increment_covariance(increment, self._configuration.motion)))
        self._wheels = wheels.copy()
        belief = self.estimator.observe(scan)
        if belief is not None and self.estimator.in_hallway and not self.estimator.turning:
            peak = float(belief.probabilities.max())
            travelled = self.robot.travelled
            self.estimates.append(
                Estimate(self.estimator.arrivals, travelled, peak, belief.confident, self.is_right(belief))
            )

    def is_right(self, belief: PositionBelief) -> bool:
        """Whether the most likely place, which is a node and the way since then, is that of the robot."""
        state = belief.most_likely
        if state is None:
            return False
        node = self._nodes[node_of(state)]
        axis = np.array((*node[:2], node[2] - _WAY * heading_of(state)))
        off = se2.between(axis, self.robot.pose)
        near = math.hypot(off[0] - self.estimator.away, off[1]) <= _RIGHT
        return near and abs(float(off[2])) <= _TURN

    @staticmethod
    def way(institute: InstituteMap, node: int, goal: int) -> list[int]:
        """The nodes from one to another one on the shortest way."""
        return list(networkx.shortest_path(_ways(institute), node, goal, weight="length"))

    @staticmethod
    def length(institute: InstituteMap, node: int, goal: int) -> float:
        """Of that way, m."""
        return float(networkx.shortest_path_length(_ways(institute), node, goal, weight="length"))

    def corners(self, nodes: Sequence[int]) -> list[Float64]:
        """The places (2,) where a way turns, and its end."""
        places = [self._nodes[node, :2] for node in nodes]
        found = []
        for k in range(1, len(places)):
            if k + 1 == len(places):
                found.append(places[k])
                continue
            before, after = places[k] - places[k - 1], places[k + 1] - places[k]
            if abs(before @ after) < 0.7 * np.hypot(*before) * np.hypot(*after):
                found.append(places[k])
        return found


def _ways(institute: InstituteMap) -> networkx.Graph:
    ways = networkx.Graph()
    for edge in institute.chart.edges:
        ways.add_edge(edge.start, edge.end, length=edge.distance[0])
    return ways
