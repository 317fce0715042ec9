"""The measurement of missions and relocations."""

import numpy as np
import pytest

from benchmark.belief import Estimate
from benchmark.documents import VALIDATION, marks
from benchmark.institute import _mission_requirements, _transitions
from benchmark.institute_maps import InstituteMap, scenario_of
from benchmark.institute_missions import Mission, open_doors, way_length
from hmt_slam_ros.exploration.rooms import Destination
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.chart import CROSSING, DOOR, Chart, ChartNode
from hmt_slam_ros.places.floor import LeadingOff
from hmt_slam_ros.places.observation_graph import no_landmarks
from hmt_slam_ros.places.place_graph import EAST, NORTH, Edge

EMPTY = no_landmarks()


def mission(rights, confident=True):
    estimates = [Estimate(k, float(k), 0.9, confident, right) for k, right in enumerate(rights)]
    return Mission(all(rights), all(rights), 30.0, 60.0, 0, estimates, (0.01, 0.0, 3.0))


def test_what_is_required_of_missions():
    good, bad = mission([True] * 10), mission([True] * 8 + [False] * 2)
    assert all(one.met for one in _mission_requirements([good]))
    values = {one.name: one.value for one in _mission_requirements([good, bad])}
    assert values["missions that succeed"] == 0.5
    assert values["false estimates"] == values["confident false estimates"] == pytest.approx(0.1)
    assert values["false state transitions"] == pytest.approx(2 / 18)
    assert _transitions([bad]) == [False] * 7 + [True] * 2
    unsure = {one.name: one.value for one in _mission_requirements([mission([False] * 4, confident=False)])}
    assert (unsure["confident false estimates"], unsure["unconfident estimates"]) == (0.0, 1.0)


def institute():
    """The true states of an institute as a chart, an edge from the first to the second and one on to the third."""
    scenario = scenario_of(0)
    states = scenario.building.states
    kinds = [CROSSING if crossing else DOOR for crossing in states.crossings]
    nodes = tuple(ChartNode(0, pose, kind, 1.0, ()) for pose, kind in zip(states.poses, kinds, strict=True))
    ways = [Edge(k, d, k + 1, d, (5.0, 0.01), (0.0, 0.01), EMPTY) for k, d in enumerate((NORTH, NORTH, EAST))]
    edges = tuple(edge for way in ways for edge in (way, way.back))
    return InstituteMap(scenario, None, {}, {}, Chart(nodes, (), edges), {0: np.zeros(3)})


def test_missions_are_from_open_door_to_open_door():
    charted = institute()
    doors = [k for k, node in enumerate(charted.chart.nodes) if node.kind == DOOR]
    places = {k: behind_door(k, charted.nodes[k]) for k in doors}
    assert open_doors(charted, charted.scenario, places) == doors
    changed = scenario_of(0, visit=1, changed=0.5)
    assert set(open_doors(charted, changed, places)) < set(doors)
    opposite = {k: behind_door(k, charted.nodes[k] + (0.0, 0.0, np.pi)) for k in doors}
    assert open_doors(charted, charted.scenario, opposite) == []


def behind_door(node, pose):
    """A place behind a door that leads off where a node looks."""
    door = PoseGaussian(pose, np.eye(3))
    landmark = Landmark(OPENING, door, 0.9, 0.05, Existence(1.0))
    return Destination(node, LeadingOff(0, 0, landmark, door, NORTH, False, pose[:2]), pose[:2])


def test_the_shortest_way_between_two_nodes():
    charted = institute()
    assert way_length(charted, 0, 2) == pytest.approx(10.0)
    assert way_length(charted, 3, 0) == pytest.approx(15.0)
    assert float(se2.wrap(charted.nodes[0, 2] - charted.scenario.building.states.poses[0, 2])) == 0.0


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in marks("institute"))
