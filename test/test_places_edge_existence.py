"""Which ways a robot sees that are closed."""

import math

import numpy as np
import pytest

from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.places.edge_existence import EdgeMonitor
from hmt_slam_ros.places.observation_graph import empty_sequence
from hmt_slam_ros.places.place_graph import EAST, NORTH, SOUTH, WEST, Edge, Node, build_place_graph, state_of

EMPTY, NOWHERE = empty_sequence(), math.nan
FROM_WEST, FROM_EAST, OFF = state_of(0, EAST), state_of(1, WEST), state_of(0, NORTH)


@pytest.fixture
def ways():
    """A way of 8 m to the east, and one of 4 m to the north, from the same node."""
    edges = [Edge(0, d, k, d, (long, 0.1), (0.0, 0.01), EMPTY) for d, k, long in ((EAST, 1, 8.0), (NORTH, 2, 4.0))]
    both = [each for edge in edges for each in (edge, edge.reverse)]
    return EdgeMonitor(build_place_graph([Node(1.0, EMPTY, EMPTY)] * 3, both, PlaceParameters()), FeatureParameters())


def looks(ways, *seen, state=FROM_WEST, aside=0.0):
    """From so far beyond the node, one sees so far ahead."""
    for away, ahead in seen:
        ways.observe(state, away, aside, np.array((ahead, NOWHERE, NOWHERE, NOWHERE)))


BARRED = [(0.5, 4.2), (1.0, 3.7), (1.5, 3.2)]


def test_a_way_that_is_closed_is_so_in_both_directions_from_the_third_look_on(ways):
    looks(ways, *BARRED[:2])
    assert ways.closed_states == frozenset()
    looks(ways, BARRED[2])
    assert ways.closed_states == {FROM_WEST, FROM_EAST}
    assert ways.existence(FROM_WEST) == ways.existence(FROM_EAST) < FeatureParameters().landmark_least


def test_what_stands_there_is_the_same_from_either_end(ways):
    # 4.7 m from the western end is 3.3 m from the eastern one.
    looks(ways, *BARRED[:2])
    looks(ways, (0.5, 2.8), state=FROM_EAST)
    assert ways.closed_states


def test_it_is_open_again_as_soon_as_it_is_seen_to_be_but_not_by_what_is_before_it(ways):
    looks(ways, *BARRED, *BARRED)
    looks(ways, (-2.0, 10.0))
    assert ways.closed_states
    looks(ways, (1.0, 10.0))
    assert not ways.closed_states
    assert ways.existence(FROM_WEST) > 0.99


def test_who_walks_there_closes_nothing(ways):
    ahead = [(away, 2.0) for away in np.arange(0.0, 8.0, 0.5)]
    towards = [(away, 8.0 - 2.0 * away) for away in np.arange(0.0, 4.0, 0.5)]
    for walk in (ahead, towards):
        looks(ways, *walk)
        assert not ways.closed_states


def test_at_a_node_one_sees_along_all_its_ways_and_beside_it_along_none(ways):
    for _ in range(3):
        # Looking south.
        ways.observe(state_of(0, SOUTH), 0.2, 0.0, np.array((9.0, 9.0, 2.2, 3.2)))
    assert ways.closed_states == {FROM_WEST, FROM_EAST, OFF, state_of(2, SOUTH)}
    for _ in range(2):
        ways.observe(FROM_WEST, 0.9, 0.9, np.full(4, 9.0))
    assert len(ways.closed_states) == 4
