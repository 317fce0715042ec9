"""The graph of places, and the position estimator against enumeration and against robots of its own model."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from benchmark.belief_world import draw_clutter, draw_observation, random_corridors
from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.places.observation import log_observation_ratios, log_unknown_ground_ratio, observation_model
from hmt_slam_ros.places.observation_graph import LandmarkSequence, empty_sequence, merge_sequences
from hmt_slam_ros.places.place_graph import EAST, NORTH, SOUTH, WEST, Edge, Node, build_place_graph, state_of
from hmt_slam_ros.places.position_belief import Travel, certain_belief, uniform_belief

PLACES = PlaceParameters()
MODEL = observation_model(PLACES, FeatureParameters())
EMPTY = empty_sequence()
QUARTER = 0.5 * math.pi


def corner(along, track=0, heading=0.5):
    return LandmarkSequence(
        np.array([track]), np.array([along]), np.array([heading]), np.array([[0.01, 0.01]]), np.array([0.9])
    )


def straight(start, end, length, landmarks=EMPTY, heading=EAST):
    return Edge(start, heading, end, heading, (length, 0.04), (0.0, 0.01), landmarks)


def chain(lengths, existence=0.5, places=PLACES):
    """A hallway from west to east."""
    ways = [straight(k, k + 1, length, corner(1.0 + 0.1 * k)) for k, length in enumerate(lengths)]
    edges = [edge for way in ways for edge in (way, way.reverse)]
    return build_place_graph([Node(existence, EMPTY, EMPTY)] * (len(lengths) + 1), edges, places)


def random_graph(seed, rows=1, columns=1, density=0.1):
    corridors = random_corridors(np.random.default_rng(seed), rows, columns, density)
    return build_place_graph(corridors.nodes, corridors.edges, PLACES)


def test_the_next_opening_is_at_the_end_of_the_edge_or_behind_those_that_are_missed():
    graph = chain([3.0, 4.0, 5.0])
    own = graph.transitions.sources == state_of(0, EAST)
    expected_tracks = 0.5 * PLACES.noticed
    assert list(graph.transitions.targets[own]) == [state_of(k, EAST) for k in (1, 2, 3)]
    np.testing.assert_allclose(
        graph.transitions.probabilities[own],
        [expected_tracks, (1 - expected_tracks) * expected_tracks, (1 - expected_tracks) ** 2],
    )
    np.testing.assert_allclose(graph.transitions.means[own], [(3, 0), (7, 0), (12, 0)])
    np.testing.assert_allclose(graph.transitions.variances[own, 0], [0.04, 0.08, 0.12])
    assert graph.successors[state_of(3, WEST)] == state_of(2, WEST)
    assert graph.successors[state_of(3, EAST)] == -1


def test_a_state_sees_ahead_and_back_what_the_map_has_there():
    graph = chain([3.0, 4.0, 5.0], places=dataclasses.replace(PLACES, reach=6.0))

    def expected_tracks(state):
        own = slice(*graph.expected_landmarks.starts[state : state + 2])
        return graph.expected_landmarks.landmarks.tracks[own], graph.expected_landmarks.landmarks.positions[own]

    tracks, along = expected_tracks(state_of(1, EAST))
    np.testing.assert_allclose(along, [-2.0, 1.1, 5.2])
    assert not tracks.any()
    tracks, along = expected_tracks(state_of(1, WEST))
    np.testing.assert_allclose(along, [-5.2, -1.1, 2.0])
    assert (tracks == 1).all()
    assert not len(expected_tracks(state_of(1, NORTH))[0])


def test_behind_a_bend_nothing_is_in_sight():
    bend = Edge(0, EAST, 1, SOUTH, (3.0, 0.04), (-QUARTER, 0.01), corner(1.0))
    graph = build_place_graph([Node(1.0, EMPTY, EMPTY)] * 3, [bend, straight(1, 2, 2.0, corner(0.5), SOUTH)], PLACES)
    starts = graph.expected_landmarks.starts
    np.testing.assert_allclose(graph.expected_landmarks.landmarks.positions[starts[EAST] : starts[EAST + 1]], [1.0])
    np.testing.assert_allclose(
        graph.transitions.means[graph.transitions.sources == EAST], [(3, -QUARTER), (5, -QUARTER)]
    )


def test_two_ways_in_one_direction_are_refused():
    with pytest.raises(ValueError, match="same direction"):
        build_place_graph([Node(1.0, EMPTY, EMPTY)] * 3, [straight(0, 1, 2.0), straight(0, 2, 3.0)], PLACES)


def transition(graph, places, action):
    """T(s, a, s') times the density of what was traveled, by the book, shape (states + 1, states + 1)."""
    n = graph.state_count
    if not isinstance(action, Travel):
        quarters = action
        table = np.full((n + 1, n + 1), places.slip / n)
        for s in range(n + 1):
            target = n if s == n else s // 4 * 4 + (s % 4 + quarters) % 4
            table[s, s] = places.slip / n
            table[s, target] = 1.0 - places.slip
        return table
    usual = math.exp(-action.distance / places.spacing) / places.spacing / (2 * math.pi)
    table = np.full((n + 1, n + 1), places.slip / n * usual)
    table[n], table[n, n] = places.discovery / n * usual, (1 - places.discovery) * usual
    for s in range(n):
        table[s, s], rest = 0.0, 1.0
        for k in np.flatnonzero(graph.transitions.sources == s):
            variance = graph.transitions.variances[k] + action.variances
            off = np.array(action[:2]) - graph.transitions.means[k]
            off[1] = math.remainder(off[1], 2 * math.pi)
            density = np.exp(-0.5 * off**2 / variance) / np.sqrt(2 * math.pi * variance)
            table[s, graph.transitions.targets[k]] += (
                (1 - places.slip) * graph.transitions.probabilities[k] * density.prod()
            )
            rest -= graph.transitions.probabilities[k]
        table[s, n] += (1 - places.slip) * rest * usual
    return table


@pytest.mark.parametrize("seed", range(6))
def test_the_belief_is_that_of_an_enumeration_of_all_paths(seed):
    random = np.random.default_rng(seed)
    places = dataclasses.replace(PLACES, slip=0.1, discovery=0.2, unmapped=0.3)
    lengths = random.uniform(2.0, 4.0, 2)
    edges = [straight(0, 1, lengths[0], corner(1.0)), straight(1, 2, lengths[1], corner(0.7, 1))]
    edges += [edges[0].reverse] + ([edges[1].reverse] if seed % 2 else [])
    graph = build_place_graph([Node(0.7, EMPTY, corner(0.0, 5, 1.0))] * 3, edges, places)
    belief, factors = uniform_belief(graph, places), []
    for _ in range(3):
        action = random.choice(4)
        action = Travel(*random.normal((3.0, 0.0), (0.5, 0.1)), (0.01, 0.01)) if action in (0, 1) else int(action - 2)
        away, variance = random.uniform(0.0, 1.0), 0.02
        graph_seen = draw_clutter(random, 0.1, 0.1, MODEL)
        if isinstance(action, Travel):
            belief = belief.predict_arrival(action)
        elif action:
            belief = belief.predict_turn(action)
        else:
            belief = belief.predict_travel(places.spacing)
        belief = belief.update(graph_seen, MODEL, away, variance)
        reported = np.append(
            log_observation_ratios(graph_seen, graph.expected_landmarks, away, variance, MODEL),
            log_unknown_ground_ratio(graph_seen, MODEL),
        )
        factors.append(transition(graph, places, action) * np.exp(reported))
    start = np.exp(uniform_belief(graph, places).log_probabilities)
    ends = np.zeros(graph.state_count + 1)
    for path in itertools.product(range(graph.state_count + 1), repeat=3):
        steps = factors[1][path[0], path[1]] * factors[2][path[1], path[2]]
        ends[path[2]] += float(start @ factors[0][:, path[0]]) * steps
    np.testing.assert_allclose(belief.probabilities, ends / ends.sum(), rtol=1e-12, atol=1e-300)


def test_every_transition_is_a_probability():
    graph = random_graph(3)
    for action in (0, 1, 2):
        np.testing.assert_allclose(transition(graph, PLACES, action).sum(axis=1), 1.0, atol=1e-12)
    for source in (0, 5, graph.state_count):
        logs = np.full(graph.state_count + 1, -np.inf)
        logs[source] = 0.0
        belief = dataclasses.replace(uniform_belief(graph, PLACES), log_probabilities=logs)
        for after in (
            belief.predict_travel(2.0),
            belief.predict_turn(1),
            belief.predict_arrival(Travel(4.0, 0.0, (0.1, 0.1))),
        ):
            assert after.probabilities.sum() == pytest.approx(1.0, abs=1e-12)


def test_entropy_says_whether_the_belief_is_confident():
    graph = random_graph(1)
    certain = certain_belief(graph, PLACES, 7)
    assert certain.entropy == 0.0
    assert certain.is_confident
    assert certain.most_likely_state == 7
    states = int(graph.has_hallway.sum())
    flat = uniform_belief(graph, dataclasses.replace(PLACES, unmapped=1.0 / (states + 1)))
    assert flat.entropy == pytest.approx(math.log(states + 1))
    assert not flat.is_confident
    lost = dataclasses.replace(flat, log_probabilities=np.log(np.append(np.full(graph.state_count, 1e-9), 1.0)))
    assert lost.most_likely_state is None


def test_a_lost_robot_is_where_a_hallway_leads_on_or_back():
    flat = uniform_belief(chain([3.0, 4.0]), PLACES).probabilities[:-1].reshape(-1, 4)
    np.testing.assert_allclose(flat[:, [EAST, WEST]], (1.0 - PLACES.unmapped) / 6)
    assert not flat[:, [NORTH, SOUTH]].any()
    with pytest.raises(ValueError, match="no place"):
        uniform_belief(build_place_graph([Node(1.0, EMPTY, EMPTY)], [], PLACES), PLACES)


def test_to_look_often_on_the_way_leaks_no_more_than_to_look_once():
    start = certain_belief(chain([30.0]), PLACES, state_of(0, EAST))
    often = start
    for _ in range(50):
        often = often.predict_travel(0.1)
    once = start.predict_travel(5.0)
    assert once.probabilities[state_of(0, EAST)] == pytest.approx(1.0 - PLACES.slip)
    np.testing.assert_allclose(often.probabilities, once.probabilities, atol=1e-4)


def test_an_opening_far_from_where_the_map_has_one_is_none_of_it():
    graph, noise = chain([3.0, 4.0]), (0.01, 0.01)
    sure = certain_belief(graph, PLACES, state_of(0, EAST))
    assert [sure.is_mapped_opening(Travel(d, 0.0, noise)) for d in (1.5, 2.9, 4.5, 7.1)] == [False, True, False, True]
    # One that passed two closed doors knows the next one, and what is in between is none of the map.
    beyond = certain_belief(chain([3.0, 4.0, 5.0, 6.0], existence=1.0), PLACES, state_of(0, EAST))
    assert [beyond.is_mapped_opening(Travel(d, 0.0, noise)) for d in (9.5, 12.1)] == [False, True]
    # A robot that may be anywhere takes it for one of the map.
    assert uniform_belief(graph, PLACES).is_mapped_opening(Travel(3.5, 0.0, noise))
    assert certain_belief(graph, PLACES, graph.state_count).is_mapped_opening(Travel(1.5, 0.0, noise))


def test_where_the_map_ends_unknown_ground_begins():
    graph = chain([3.0, 4.0])
    there = certain_belief(graph, PLACES, state_of(2, EAST)).predict_arrival(Travel(4.0, 0.0, (0.01, 0.01)))
    assert there.most_likely_state is None
    assert there.probabilities[-1] > 0.98


def test_the_traveled_distance_separates_openings():
    graph = chain([3.0, 4.0])
    start = certain_belief(graph, PLACES, state_of(0, EAST))
    assert start.predict_arrival(Travel(3.1, 0.0, (0.01, 0.01))).most_likely_state == state_of(1, EAST)
    assert start.predict_arrival(Travel(6.9, 0.0, (0.01, 0.01))).most_likely_state == state_of(2, EAST)


def simulate_beliefs(seed, places, steps=6):
    """Beliefs and true states of a robot that moves and sees exactly as the model says."""
    random = np.random.default_rng(seed)
    graph = random_graph(seed % 7, density=0.02)
    belief = uniform_belief(graph, places)
    state = int(random.choice(graph.state_count + 1, p=belief.probabilities))
    for _ in range(steps):
        action = int(random.choice(4, p=(0.1, 0.1, 0.1, 0.7)))
        state, travel = drawn_transition(random, graph, places, state, action)
        belief = belief.predict_turn(action) if travel is None else belief.predict_arrival(travel)
        yield belief, state
        belief = belief.update(drawn_seen(random, graph, state), MODEL, 0.0, 0.01)
        yield belief, state


def drawn_transition(random, graph, places, state, action):
    n = graph.state_count
    others = [s for s in range(n + 1) if s != state]
    if action < 3:
        target = n if state == n else state // 4 * 4 + (state % 4 + action) % 4
        others = [s for s in range(n + 1) if s != target]
        return (int(random.choice(others)) if random.random() < places.slip else target), None
    usual = Travel(random.exponential(places.spacing), random.uniform(-math.pi, math.pi), (0.01, 0.001))
    if state == n:
        return (int(random.integers(n)) if random.random() < places.discovery else n), usual
    if random.random() < places.slip:
        return int(random.choice(others)), usual
    own = np.flatnonzero(graph.transitions.sources == state)
    shares = np.cumsum(graph.transitions.probabilities[own])
    k = int(np.searchsorted(shares, random.random()))
    if k == len(own):
        return n, usual
    way = random.normal(graph.transitions.means[own[k]], np.sqrt(graph.transitions.variances[own[k]] + usual.variances))
    return int(graph.transitions.targets[own[k]]), Travel(*way, usual.variances)


def drawn_seen(random, graph, state):
    if state == graph.state_count:
        return draw_clutter(random, MODEL.usual_density, MODEL.false_density, MODEL)
    own = slice(*graph.expected_landmarks.starts[state : state + 2])
    return draw_observation(
        random, LandmarkSequence(*(f[own] for f in graph.expected_landmarks.landmarks)), 0.0, 0.01, MODEL
    )


def test_beliefs_about_robots_of_the_model_are_calibrated():
    places = dataclasses.replace(PLACES, slip=0.05, discovery=0.2, unmapped=0.2)
    peaks, right = [], []
    for seed in range(250):
        for belief, state in simulate_beliefs(seed, places):
            peaks.append(belief.probabilities.max())
            right.append(int(np.argmax(belief.log_probabilities)) == state)
    peaks, right = np.array(peaks), np.array(right)
    bins = np.minimum(9, (10 * peaks).astype(int))
    error = np.abs(np.bincount(bins, peaks - right)).sum() / len(peaks)
    assert len(set(bins)) > 6
    assert error < 0.03


def test_a_hallway_may_be_joined_from_lists_of_both_directions():
    there = merge_sequences((corner(1.0), corner(2.0, 3)))
    way = straight(0, 1, 3.0, there)
    np.testing.assert_allclose(way.reverse.landmarks.positions, [2.0, 1.0])
    assert list(way.reverse.landmarks.tracks) == [1, 2]
    for one, other in zip(way.reverse.reverse.landmarks, there, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
