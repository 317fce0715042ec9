"""Missions on a small floor by a robot that knows of its place only what the belief and the metric filter tell it."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from small_floor import AREAS, CONFIGURATION, make_chart, make_map, seen_at
from worlds import blank_scan

from hmt_slam_ros.exploration import mission_controller
from hmt_slam_ros.exploration.local_motion import MotionLimits
from hmt_slam_ros.exploration.mission_controller import MissionController, Phase
from hmt_slam_ros.exploration.rooms import Destination, KnownBuilding, destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.place_graph import opposite_direction, state_of
from hmt_slam_ros.places.position_belief import certain_belief
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance

LIMITS = MotionLimits(0.6, math.radians(45.0), 0.5, math.radians(90.0), 0.25)
STEPS = 900
STANDING = RelativeMotion(np.zeros(3), increment_covariance(np.zeros(3), CONFIGURATION.motion))


@pytest.fixture(scope="module")
def known_building():
    chart = make_chart()[0]
    return KnownBuilding(chart, chart.graph(CONFIGURATION.places), *make_map())


def node_at(known_building, x):
    places = np.array([se2.compose(AREAS[node.area], node.pose) for node in known_building.chart.nodes])
    return int(np.hypot(places[:, 0] - x, places[:, 1]).argmin())


def eastwards(known_building):
    ends = node_at(known_building, 5.0), node_at(known_building, 10.0)
    return next(edge.start_direction for edge in known_building.chart.edges if (edge.start, edge.end) == ends)


def halves(scan):
    """What a laser that looks ahead and one that looks back see of a scan all around, in half a circle each."""
    size, quarter = scan.ranges.size, scan.ranges.size // 4
    for first, theta in ((quarter, 0.0), (3 * quarter, math.pi)):
        ranges = np.roll(scan.ranges, -first)[: size // 2]
        yield replace(scan, ranges=ranges, angle_min=-0.5 * math.pi, laser_pose=np.array([0.0, 0.0, theta]))


class Robot:
    """It does what the pilot says; its odometry has 1 % of noise."""

    def __init__(self, pilot, pose, split=lambda scan: [scan]):
        """:param split: makes the scans of its lasers of one all around."""
        self.pilot, self.pose, self.split = pilot, np.array(pose), split
        self.rng, self.stamp = np.random.default_rng(0), 0

    def go(self, goal, barred=None):
        """The phases on the way, the hallway being barred there, m along it, where it is."""
        self.pilot.start_mission(goal)
        for _ in range(STEPS):
            scan = seen_at(self.pose, self.rng, barred)
            self.stamp += 200_000_000
            first, *others = self.split(replace(scan, stamp=self.stamp))
            command = self.pilot.steer(first)
            for part in others:
                self.pilot.predict(STANDING)
                command = self.pilot.steer(part)
            yield self.pilot.phase
            if self.pilot.phase in {Phase.THERE, Phase.LOST}:
                return
            increment = se2.exp(0.2 * np.array([command.speed, 0.0, command.turn_rate]))
            self.pose = se2.compose(self.pose, increment)
            noisy = increment * (1.0 + self.rng.normal(0.0, 0.01, 3))
            self.pilot.predict(RelativeMotion(noisy, increment_covariance(noisy, CONFIGURATION.motion)))


def test_the_only_place_is_where_the_robot_was_in_the_room(known_building):
    (place,) = destinations(known_building).values()
    assert place.node == node_at(known_building, 5.0)
    np.testing.assert_allclose(se2.transform(AREAS[place.opening.area], place.position[None])[0], (5.0, 3.0), atol=0.1)


def test_a_door_to_which_no_way_leads_is_no_place_to_go_to(known_building):
    (place,) = destinations(known_building).values()
    chart = known_building.chart
    edges = tuple(edge for edge in chart.edges if place.node not in {edge.start, edge.end})
    assert edges
    assert not destinations(replace(known_building, chart=replace(chart, edges=edges)))


def test_a_robot_drives_into_a_room_and_from_there_to_another_door(known_building):
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    west = opposite_direction(eastwards(known_building))
    belief = certain_belief(known_building.graph, CONFIGURATION.places, state_of(node_at(known_building, 16.0), west))
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS, belief), (16.0, 0.0, math.pi))
    phases = list(dict.fromkeys(robot.go(goal)))
    assert phases == [Phase.HALLWAY, Phase.DOOR, Phase.ROOM, Phase.THERE]
    assert robot.pilot.initial_pose.node == goal.node
    assert math.dist(robot.pose[:2], (5.0, 3.0)) < 0.3
    node = node_at(known_building, 10.0)
    opening = next(one for one in known_building.chart.nodes[node].openings if one.direction == goal.opening.direction)
    behind = se2.transform(opening.landmark.pose.mean, np.array([[1.2, 0.0]]))[0]
    phases = list(dict.fromkeys(robot.go(Destination(node, opening, 0, behind))))
    assert phases == [Phase.LEAVING, Phase.TURN, Phase.HALLWAY, Phase.DOOR, Phase.ROOM, Phase.THERE]
    assert math.dist(robot.pose[:2], (10.1, 2.2)) < 0.3


def test_a_robot_goes_from_a_room_to_the_one_behind_the_opposite_door(known_building):
    node = node_at(known_building, 10.0)
    doors = sorted(
        known_building.chart.nodes[node].openings, key=lambda one: (one.direction - eastwards(known_building)) % 4
    )
    south, north = (
        Destination(node, one, 0, se2.transform(one.landmark.pose.mean, np.array([[1.2, 0.0]]))[0]) for one in doors
    )
    west = opposite_direction(eastwards(known_building))
    belief = certain_belief(known_building.graph, CONFIGURATION.places, state_of(node_at(known_building, 16.0), west))
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS, belief), (16.0, 0.0, math.pi))
    assert list(robot.go(south))[-1] is Phase.THERE
    for goal, place in ((north, (10.1, 2.2)), (south, (9.9, -2.2))):
        phases = list(dict.fromkeys(robot.go(goal)))
        assert phases == [Phase.LEAVING, Phase.DOOR, Phase.ROOM, Phase.THERE]
        assert robot.pilot.initial_pose.node == node
        assert math.dist(robot.pose[:2], place) < 0.3


@pytest.mark.parametrize("split", [lambda scan: [scan], halves], ids=["one laser", "two lasers"])
def test_a_lost_robot_turns_at_the_end_of_the_hallway_and_is_confident_before_it_enters(known_building, split):
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS), (12.0, 0.1, 0.0), split)
    phases = []
    for phase in robot.go(goal):
        phases.append(phase)
        belief = robot.pilot.estimator.belief
        assert phase is not Phase.ROOM or belief.is_confident
    assert phases[0] is Phase.HALLWAY
    assert phases[-1] is Phase.THERE
    assert math.dist(robot.pose[:2], (5.0, 3.0)) < 0.3


def test_a_robot_that_sees_nothing_goes_on_and_waits_for_walls(known_building):
    pilot = MissionController(known_building, CONFIGURATION, LIMITS)
    pilot.start_mission(None)
    for k in range(100):
        command = pilot.steer(replace(blank_scan(), stamp=200_000_000 * k))
        assert math.isfinite(command.speed)
        assert math.isfinite(command.turn_rate)
    assert pilot.estimator.belief is None


def test_where_the_belief_is_wrong_there_is_no_door_and_the_robot_goes_on(known_building):
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    # It is certain to be before the door, and is 2 m off.
    belief = certain_belief(known_building.graph, CONFIGURATION.places, state_of(goal.node, eastwards(known_building)))
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS, belief), (7.0, 0.0, 0.0))
    phases = list(robot.go(goal))
    order = list(dict.fromkeys(phases))
    assert order[:3] == [Phase.DOOR, Phase.TURN, Phase.HALLWAY]
    assert Phase.ROOM not in phases or math.dist(robot.pose[:2], (5.0, 3.0)) < 0.3


def test_a_robot_turns_back_where_its_way_is_closed_and_goes_there_when_it_is_open_again(known_building):
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    west = opposite_direction(eastwards(known_building))
    start = state_of(node_at(known_building, 16.0), west)
    pilot = MissionController(
        known_building, CONFIGURATION, LIMITS, certain_belief(known_building.graph, CONFIGURATION.places, start)
    )
    robot = Robot(pilot, (16.0, 0.0, math.pi))
    closed = {
        state_of(node_at(known_building, 10.0), west),
        state_of(node_at(known_building, 5.0), eastwards(known_building)),
    }
    barred = zip(range(300), robot.go(goal, barred=7.0), strict=False)
    assert Phase.TURN in [phase for _, phase in barred]
    assert robot.pilot.edge_monitor.closed_states == closed
    assert robot.pose[0] > 7.3
    assert list(robot.go(goal))[-1] is Phase.THERE
    assert robot.pilot.edge_monitor.closed_states == frozenset()


@pytest.mark.parametrize("sway", [0.0, 0.1])
def test_a_robot_that_gets_nowhere_turns_back_and_where_it_cannot_goes_on_however_it_trembles_or_sways(
    known_building, sway
):
    pilot = MissionController(known_building, CONFIGURATION, LIMITS)
    pilot.start_mission(None)
    rng, scan = np.random.default_rng(0), seen_at(np.array((3.0, 0.0, 0.0)), np.random.default_rng(1))
    phases = []
    for k in range(115):
        pilot.steer(replace(scan, stamp=200_000_000 * (k + 1)))
        phases.append(pilot.phase)
        aside = sway if k // 5 % 2 else -sway
        pilot.predict(RelativeMotion(np.array((rng.normal(0.0, 0.02), aside, 0.0)), np.diag((1e-4, 1e-4, 1e-6))))
    assert [phase for phase, _ in itertools.groupby(phases)] == [Phase.HALLWAY, Phase.TURN, Phase.HALLWAY]


def test_a_robot_that_left_a_room_looks_where_the_metric_filter_says(known_building):
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    belief = certain_belief(known_building.graph, CONFIGURATION.places, state_of(goal.node, eastwards(known_building)))
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS, belief), (5.0, 0.0, 0.0))
    assert list(robot.go(goal))[-1] is Phase.THERE
    # It turned at the end of its way out.
    out = iter(robot.go(goal._replace(node=node_at(known_building, 10.0))))
    while robot.pose[1] > 0.75:
        assert next(out) is Phase.LEAVING
    increment = np.array((0.0, 0.0, -robot.pose[2]))
    robot.pose = robot.pose + increment
    robot.pilot.predict(RelativeMotion(increment, increment_covariance(increment, CONFIGURATION.motion)))
    while robot.pilot.room is not None or robot.pilot.estimator.belief is None:
        next(out)
    looks = (eastwards(known_building) - round(float(robot.pose[2]) / (0.5 * math.pi))) % 4
    assert looks != opposite_direction(goal.opening.direction)
    assert robot.pilot.estimator.node_and_direction == (goal.node, looks)


def test_a_robot_that_is_out_of_a_room_where_it_went_in_has_got_on_and_turns_as_it_should(known_building, monkeypatch):
    # In the time and the way of a visit to the room it would not have got anywhere.
    monkeypatch.setattr(mission_controller, "_MIN_PROGRESS", 2.0)
    monkeypatch.setattr(mission_controller, "_INITIAL_DISPLACEMENT", np.array((2.0, 0.0, 0.0)))
    goal = destinations(known_building)[node_at(known_building, 5.0)]
    west = state_of(node_at(known_building, 10.0), opposite_direction(eastwards(known_building)))
    belief = certain_belief(known_building.graph, CONFIGURATION.places, west)
    robot = Robot(MissionController(known_building, CONFIGURATION, LIMITS, belief), (10.0, 0.0, math.pi))
    assert list(robot.go(goal))[-1] is Phase.THERE
    robot.stamp += 10_000_000_000
    phases, places = (
        robot.go(Destination(node_at(known_building, 10.0), goal.opening, goal.keyframe, goal.position)),
        [],
    )
    while next(phases) is not Phase.DOOR:
        places.append(robot.pose[0])
    assert min(places) > 4.0
