"""Missions, relocations and charts of an institute."""

import math

import numpy as np
import pytest

from benchmark.institute import false_transitions, mission_requirements
from benchmark.institute_drives import Estimate, Mission, open_doors, path_length, recovery
from benchmark.institute_maps import InstituteMap, scenario_of, score_chart
from benchmark.report import VALIDATION, document_marks
from hmt_slam_ros.exploration.rooms import Destination
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.chart import CROSSING, DOOR, END, Chart, ChartNode
from hmt_slam_ros.places.floor import SideOpening
from hmt_slam_ros.places.observation_graph import empty_sequence
from hmt_slam_ros.places.place_graph import EAST, NORTH, Edge

EMPTY = empty_sequence()
FRAME = np.array([3.0, -4.0, 1.0])


def mission(rights, confident=True):
    estimates = [Estimate(k, float(k), 0.9, confident, right) for k, right in enumerate(rights)]
    return Mission(all(rights), all(rights), 30.0, 60.0, 0, estimates, (0.01, 0.0, 3.0))


def test_what_is_required_of_missions():
    good, bad = mission([True] * 10), mission([True] * 8 + [False] * 2)
    assert all(one.is_met for one in mission_requirements([good]))
    values = {one.name: one.value for one in mission_requirements([good, bad])}
    assert values["missions that succeed"] == 0.5
    assert values["false estimates"] == values["confident false estimates"] == pytest.approx(0.1)
    assert values["false state transitions"] == pytest.approx(2 / 18)
    assert false_transitions([bad]) == [False] * 7 + [True] * 2
    unsure = {one.name: one.value for one in mission_requirements([mission([False] * 4, confident=False)])}
    assert (unsure["confident false estimates"], unsure["unconfident estimates"]) == (0.0, 1.0)


def institute():
    """The true states of an institute as a chart, an edge from the first to the second and one on to the third."""
    scenario = scenario_of(0)
    states = scenario.building.states
    kinds = [CROSSING if crossing else DOOR for crossing in states.crossings]
    nodes = tuple(ChartNode(0, pose, kind, 1.0, ()) for pose, kind in zip(states.poses, kinds, strict=True))
    edges_one_way = [Edge(k, d, k + 1, d, (5.0, 0.01), (0.0, 0.01), EMPTY) for k, d in enumerate((NORTH, NORTH, EAST))]
    edges = tuple(edge for edge in edges_one_way for edge in (edge, edge.reverse))
    return InstituteMap(scenario, None, {}, {}, Chart(nodes, (), edges), {0: np.zeros(3)})


def test_missions_are_from_open_door_to_open_door():
    chart_map = institute()
    doors = [k for k, node in enumerate(chart_map.chart.nodes) if node.kind == DOOR]
    places = {k: behind_door(k, chart_map.nodes[k]) for k in doors}
    assert open_doors(chart_map, chart_map.scenario, places) == doors
    changed = scenario_of(0, visit=1, changed=0.5)
    assert set(open_doors(chart_map, changed, places)) < set(doors)
    opposite = {k: behind_door(k, chart_map.nodes[k] + (0.0, 0.0, np.pi)) for k in doors}
    assert open_doors(chart_map, chart_map.scenario, opposite) == []


def behind_door(node, pose):
    """A place behind a door that leads off where a node looks."""
    door = PoseGaussian(pose, np.eye(3))
    landmark = Landmark(OPENING, door, 0.9, 0.05, Existence(1.0))
    return Destination(node, SideOpening(0, 0, landmark, door, NORTH, False, pose[:2]), 0, pose[:2])


def test_the_shortest_way_between_two_nodes():
    chart_map = institute()
    assert path_length(chart_map, 0, 2) == pytest.approx(10.0)
    assert path_length(chart_map, 3, 0) == pytest.approx(15.0)
    assert float(se2.wrap(chart_map.nodes[0, 2] - chart_map.scenario.building.states.poses[0, 2])) == 0.0


def estimate(arrivals, right=True, confident=True):
    return Estimate(arrivals, 4.0 * arrivals, 0.9, confident, right)


def test_a_recovery_is_confident_and_right_and_right_at_the_three_nodes_behind():
    run = [estimate(0, confident=False), estimate(1), estimate(1), *(estimate(k, confident=False) for k in (2, 3, 4))]
    assert recovery(run) == estimate(1)
    assert recovery(run[:-1]) is None
    spoilt = [*run[:4], estimate(2, right=False), *run[4:]]
    assert recovery(spoilt) is None
    assert recovery([*run[:-1], estimate(4), estimate(4, right=False)]) is None


def chart_of_states(changed=()):
    """The states of an institute as the nodes of a chart, some of them changed: {number: (kind, away, m)}."""
    scenario = scenario_of(0)
    states = scenario.building.states
    nodes = []
    for k, pose in enumerate(states.poses):
        kind, away = dict(changed).get(k, (CROSSING if states.crossings[k] else DOOR, 0.1))
        place = se2.compose(pose, np.array((away, 0.0, 0.0)))
        nodes.append(ChartNode(0, se2.between(FRAME, place), kind, 1.0, ()))
    return InstituteMap(scenario, None, {}, {}, Chart(tuple(nodes), (), ()), {0: FRAME})


def test_a_chart_of_the_states_has_all_and_confuses_none():
    found = score_chart(chart_of_states())
    assert (found.states, found.detected, found.confused) == (13, 13, 0)
    np.testing.assert_allclose(found.offsets, 0.1)


@pytest.mark.parametrize(
    ("change", "detected", "confused"),
    [
        pytest.param((DOOR, 0.1), 13, 1, id="a door where there is a crossing"),
        pytest.param((CROSSING, 30.0), 12, 1, id="a crossing where there is nothing"),
        pytest.param((END, 30.0), 12, 0, id="the end of a hallway"),
    ],
)
def test_what_is_missing_and_what_is_confused(change, detected, confused):
    found = score_chart(chart_of_states({0: change}.items()))
    assert (found.detected, found.confused) == (detected, confused)
    assert math.isclose(max(found.offsets), 0.1)


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("institute"))
