"""The measurement of charts."""

import math

import numpy as np
import pytest

from benchmark.documents import VALIDATION, marks
from benchmark.institute_maps import InstituteMap, scenario_of
from benchmark.places import judged
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.chart import CROSSING, DOOR, END, Chart, ChartNode

FRAME = np.array([3.0, -4.0, 1.0])


def charted(changed=()):
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
    found = judged(charted())
    assert (found.states, found.detected, found.confused) == (13, 13, 0)
    np.testing.assert_allclose(found.off, 0.1)


@pytest.mark.parametrize(
    ("change", "detected", "confused"),
    [
        pytest.param((DOOR, 0.1), 13, 1, id="a door where there is a crossing"),
        pytest.param((CROSSING, 30.0), 12, 1, id="a crossing where there is nothing"),
        pytest.param((END, 30.0), 12, 0, id="the end of a hallway"),
    ],
)
def test_what_is_missing_and_what_is_confused(change, detected, confused):
    found = judged(charted({0: change}.items()))
    assert (found.detected, found.confused) == (detected, confused)
    assert math.isclose(max(found.off), 0.1)


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in marks("places"))
