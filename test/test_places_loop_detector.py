"""Loops that two peaks of the belief propose."""

import math

import numpy as np
import pytest

from benchmark.belief_world import Corridors, draw_building, draw_of_present, random_corridors
from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.places.loop_detector import TwoPeakTracker, initial_loop_belief
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.observation_graph import LandmarkSequence, empty_sequence, select_landmarks
from hmt_slam_ros.places.place_graph import EAST, Edge, Node, build_place_graph, heading_of, state_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, certain_belief, uniform_belief

PLACES = PlaceParameters()
MODEL = observation_model(PLACES, FeatureParameters())
NOISE = (0.01, 0.001)
ROUND = 6  # nodes of the loop


def lap(random):
    """The edges of a straight hallway with many landmarks, all of which are extracted in every lap."""
    ways = [way for way in random_corridors(random, 1, 3, 0.2).edges_one_way if way.start_direction == EAST][:ROUND]
    return [way._replace(landmarks=sure(way.landmarks)) for way in ways]


def sure(landmarks):
    return landmarks._replace(probabilities=np.ones(len(landmarks.tracks)))


def mapped_twice(random, edges, turned=0, missed=0.0):
    """The chain that is made of a building by one who goes round twice, as if there were no loop.

    :param missed: share of the landmarks that only the first lap showed.
    """
    nodes = [Node(1.0, empty_sequence(), empty_sequence())] * (2 * ROUND + 1)
    twice = []
    for k in range(2 * ROUND):
        there = draw_building(random, Corridors([], [edges[k % ROUND]])).edges_one_way[0]
        known = edges[k % ROUND].landmarks
        listed = there.landmarks._replace(
            variances=np.full((len(there.landmarks.tracks), 2), known.variances[0] if len(known.tracks) else 0.0),
            probabilities=np.full(len(there.landmarks.tracks), 0.9),
        )
        if k >= ROUND:
            listed = select_landmarks(listed, random.random(len(listed.tracks)) >= missed)
        heading = EAST if k < ROUND else EAST + turned
        length = edges[k % ROUND].distance[0]
        twice.append(Edge(k, heading, k + 1, heading, (length, (0.03 * length) ** 2), (0.0, 1e-4), listed))
    if turned:
        last = twice[ROUND - 1]
        twice[ROUND - 1] = last._replace(end_direction=EAST + turned, turn=(-0.5 * math.pi * turned, 1e-4))
    return build_place_graph(nodes, twice, PLACES)


def drive_round(random, belief, detector, edges, start, count):
    """Proposals of a robot that goes round in the loop."""
    for k in range(start, start + count):
        own = edges[k % ROUND]
        length = random.normal(own.distance[0], 0.05)
        belief = belief.predict_arrival(Travel(length, random.normal(0.0, 0.02), NOISE))
        ahead = edges[(k + 1) % ROUND].landmarks
        seen = draw_of_present(random, ahead, np.ones(len(ahead.tracks), bool), 0.0, MODEL)
        belief = belief.update(ahead_only(seen), MODEL, 0.0, 0.01)
        yield detector.update(belief), belief


def ahead_only(seen):
    return LandmarkSequence(*(field[seen.positions > 0.0] for field in seen))


@pytest.mark.parametrize(("turned", "missed"), [(0, 0.0), (1, 0.0), (0, 0.2)])
def test_a_loop_that_was_mapped_twice_is_proposed_with_the_places_that_are_one(turned, missed):
    found = 0
    for seed in range(12):
        random = np.random.default_rng(seed)
        edges = lap(random)
        graph = mapped_twice(random, edges, turned, missed)
        belief = initial_loop_belief(graph, PLACES)
        for loop, _ in drive_round(random, belief, TwoPeakTracker(), edges, 0, ROUND - 1):
            if loop is not None:
                found += 1
                assert abs(loop.node - loop.other_node) == ROUND
                assert loop.quarters in ((0,) if not turned else (1, 3))
                break
    assert found >= 11


@pytest.mark.long
def test_no_loop_is_proposed_where_there_is_none():
    for seed in range(40):
        random = np.random.default_rng(seed)
        corridors = random_corridors(random, 1, 2, 0.1)
        graph = build_place_graph(corridors.nodes, corridors.edges, PLACES)
        building = draw_building(random, corridors)
        truth = build_place_graph(building.nodes, building.edges, PLACES)
        state = int(random.choice(np.flatnonzero(graph.successors >= 0)))
        belief, detector = initial_loop_belief(graph, PLACES), TwoPeakTracker()
        while graph.successors[state] >= 0:
            travel = Travel(random.normal(truth.lengths[state], 0.05), random.normal(0.0, 0.02), NOISE)
            state = int(graph.successors[state])
            own = slice(*truth.expected_landmarks.starts[state : state + 2])
            there = LandmarkSequence(*(field[own] for field in truth.expected_landmarks.landmarks))
            seen = draw_of_present(random, there, np.ones(len(there.tracks), bool), 0.0, MODEL)
            belief = belief.predict_arrival(travel).update(seen, MODEL, 0.0, 0.01)
            assert detector.update(belief) is None


def two_peaks(graph, first, second, shares=(0.6, 0.4)):
    logs = np.full(graph.state_count + 1, -60.0)
    logs[[first, second]] = np.log(shares)
    return PositionBelief(graph, PLACES, logs)


@pytest.fixture
def hallway():
    edges = [Edge(k, EAST, k + 1, EAST, (4.0, 0.1), (0.0, 0.01), empty_sequence()) for k in range(11)]
    back = [edge.reverse for edge in edges]
    return build_place_graph([Node(1.0, empty_sequence(), empty_sequence())] * 12, edges + back, PLACES)


def proposals(graph, places):
    detector = TwoPeakTracker()
    return [detector.update(two_peaks(graph, *states)) for states in places]


def test_three_transitions_in_the_same_way_make_a_loop_whichever_peak_is_higher(hallway):
    def pair(k):
        return state_of(k, EAST), state_of(k + 6, EAST)

    found = proposals(hallway, [pair(0), pair(1), pair(2)[::-1], pair(3)])
    assert found[:3] == [None, None, None]
    assert found[3] is not None
    assert (found[3].node, found[3].other_node, found[3].quarters) == (3, 9, 0)


def test_peaks_may_head_for_different_sides_but_have_to_move_alike_and_apart(hallway):
    opposite_ways = [(state_of(k, EAST), state_of(11 - k, heading_of(3))) for k in range(4)]
    assert proposals(hallway, opposite_ways)[3].quarters == 2
    chase = [(state_of(k, EAST), state_of(k + 1, EAST)) for k in range(5)]
    assert proposals(hallway, chase) == [None] * 5
    stuck = [(state_of(k, EAST), state_of(8, EAST)) for k in range(5)]
    assert proposals(hallway, stuck) == [None] * 5


def test_a_belief_that_is_certain_and_one_of_many_peaks_restart(hallway):
    pairs = [(state_of(k, EAST), state_of(k + 6, EAST)) for k in range(5)]
    detector = TwoPeakTracker()
    for k, pair in enumerate(pairs):
        belief = two_peaks(hallway, *pair)
        if k == 2:
            belief = certain_belief(hallway, PLACES, pair[0])
        assert detector.update(belief) is None
    detector = TwoPeakTracker()
    for k, pair in enumerate(pairs):
        belief = uniform_belief(hallway, PLACES) if k == 2 else two_peaks(hallway, *pair)
        assert detector.update(belief) is None
