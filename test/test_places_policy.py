"""Where a robot goes next, by the most likely state."""

import dataclasses
import math

import numpy as np
import pytest

from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.observation_graph import LandmarkSequence, empty_sequence, merge_sequences
from hmt_slam_ros.places.place_graph import EAST, NORTH, SOUTH, WEST, Edge, Node, build_place_graph, state_of
from hmt_slam_ros.places.policy import most_informative_turn, next_turn, turn_towards
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief

PLACES = PlaceParameters()
MODEL = observation_model(PLACES, FeatureParameters())
EMPTY = empty_sequence()


def graph_of(ways, nodes):
    edges = [Edge(a, heading, b, heading, (length, 0.1), (0.0, 0.01), seen) for a, heading, b, length, seen in ways]
    return build_place_graph(
        [Node(1.0, EMPTY, EMPTY)] * nodes, [e for edge in edges for e in (edge, edge.reverse)], PLACES
    )


@pytest.fixture
def square():
    """Four nodes around a block, of which one way from 0 to 3 is the shorter one, and one node that no way leads to."""
    lower, left = (0, EAST, 1, 10, EMPTY), (0, NORTH, 2, 4, EMPTY)
    return graph_of([lower, left, (2, EAST, 3, 10, EMPTY), (1, NORTH, 3, 9, EMPTY)], 5)


def test_the_way_to_the_goal_is_the_shortest_one(square):
    assert turn_towards(square, state_of(0, EAST), 3) == 3
    assert turn_towards(square, state_of(0, NORTH), 3) == 0
    assert turn_towards(square, state_of(0, SOUTH), 1) == 3
    assert turn_towards(square, state_of(3, EAST), 0) == 2
    assert turn_towards(square, state_of(3, EAST), 3) is None
    assert turn_towards(square, state_of(3, EAST), 4) is None


def test_a_way_that_is_closed_is_gone_only_where_no_other_leads_to_the_goal(square):
    closed = {state_of(0, NORTH), state_of(2, SOUTH)}
    assert turn_towards(square, state_of(0, EAST), 3, closed) == 0
    belief = certain_belief(square, PLACES, state_of(0, EAST))
    assert next_turn(belief, 3, MODEL, ahead=True, closed=closed) == 0
    assert turn_towards(square, state_of(0, EAST), 3, closed | {state_of(0, EAST), state_of(1, WEST)}) == 3


def test_a_robot_that_is_sure_heads_for_its_goal_and_one_in_unknown_ground_for_none(square):
    assert next_turn(certain_belief(square, PLACES, state_of(0, WEST)), 1, MODEL, ahead=True) == 2
    assert next_turn(certain_belief(square, PLACES, square.state_count), 1, MODEL, ahead=True) is None


def corners(along):
    count = len(along)
    headings = np.full(count, 0.25 * math.pi)
    return merge_sequences(
        (
            LandmarkSequence(
                np.zeros(count, np.int64), np.array(along), headings, np.full((count, 2), 1e-3), np.full(count, 0.9)
            ),
        )
    )


def test_a_robot_that_is_not_sure_goes_where_places_differ():
    # Two hallways: to the west of their middles they are the same, to the east only one of them has corners.
    one = [(0, EAST, 1, 8, EMPTY), (1, EAST, 2, 8, corners([6.0, 7.0]))]
    graph = graph_of([*one, (3, EAST, 4, 8, EMPTY), (4, EAST, 5, 8, EMPTY)], 6)
    for heading, expected in ((EAST, 0), (WEST, 2)):
        logs = np.full(graph.state_count + 1, -50.0)
        logs[[state_of(1, heading), state_of(4, heading)]] = math.log(0.5)
        belief = PositionBelief(graph, PLACES, logs)
        assert not belief.is_confident
        assert most_informative_turn(belief, MODEL) == expected
        assert next_turn(belief, 0, MODEL, ahead=False) == expected
        # It follows a hallway that leads on.
        assert next_turn(belief, 0, MODEL, ahead=True) == 0
        assert next_turn(belief, None, MODEL, ahead=False) == expected


def test_without_a_way_there_is_no_turn():
    graph = build_place_graph([Node(1.0, EMPTY, EMPTY)], [], PLACES)
    assert most_informative_turn(certain_belief(graph, PLACES, 0), MODEL) is None
    lost = dataclasses.replace(certain_belief(graph, PLACES, 0), log_probabilities=np.log([0.05] * 4 + [0.8]))
    assert most_informative_turn(lost, MODEL) is None
