"""The place graph: states, transitions between them, and the landmarks expected in each.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, Fig. 2: nodes are openings and crossings, with an ordered list of
landmarks between them. A *state* is a node with a direction of travel: that of a robot whose last node it was. The next
opening that the robot notices is at the end of the state's edge, or behind it if that one is missed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.places.observation import ExpectedLandmarks, stack_expected_landmarks
from hmt_slam_ros.places.observation_graph import (
    QUARTERS,
    LandmarkSequence,
    empty_sequence,
    merge_sequences,
    reverse_direction,
    select_landmarks,
    shift_ahead,
)

NORTH, EAST, SOUTH, WEST = range(QUARTERS)
"""Directions of travel, each a quarter to the right of the one before."""

DIRECTION_NAMES = ("north", "east", "south", "west")
"""Names of the directions."""

_MAX_UNNOTICED = 3
"""Openings in a row that are passed unnoticed, at most."""


class Node(NamedTuple):
    """An opening or a crossing.

    :ivar existence: its p_lmap.
    :ivar north: landmarks of the node itself, as observed by a robot at the node that heads north.
    :ivar east: likewise for one that heads east.
    """

    existence: float
    north: LandmarkSequence
    east: LandmarkSequence


class Edge(NamedTuple):
    """A segment of hallway from one node to the next, in one direction.

    :ivar start: node.
    :ivar start_direction: of travel at the start.
    :ivar end: node.
    :ivar end_direction: of travel at the end.
    :ivar distance: mean and variance of the length, m and m^2.
    :ivar turn: mean and variance of the rotation along it, counterclockwise, rad and rad^2.
    :ivar landmarks: on the edge, as from the start; where the hallway bends, those before the bend.
    """

    start: int
    start_direction: int
    end: int
    end_direction: int
    distance: tuple[float, float]
    turn: tuple[float, float]
    landmarks: LandmarkSequence

    @property
    def reverse(self) -> Edge:
        """The same segment in the other direction; for one without a bend."""
        landmarks = shift_ahead(reverse_direction(self.landmarks), self.distance[0])
        turn = (-self.turn[0], self.turn[1])
        return Edge(
            self.end,
            opposite_direction(self.end_direction),
            self.start,
            opposite_direction(self.start_direction),
            self.distance,
            turn,
            landmarks,
        )


class StateTransitions(NamedTuple):
    """Transitions between states, straight on to the next noticed opening.

    :ivar sources: shape (k,), states.
    :ivar targets: shape (k,), states.
    :ivar probabilities: shape (k,); their sum over a source is 1 at most.
    :ivar means: shape (k, 2), of distance, m, and turn, rad.
    :ivar variances: shape (k, 2).
    """

    sources: Int64
    targets: Int64
    probabilities: Float64
    means: Float64
    variances: Float64


@dataclass(frozen=True, eq=False)
class PlaceGraph:
    """States, their transitions and expected landmarks.

    :ivar state_count: number of states, four of each node.
    :ivar successors: shape (states,), the state at the end of each state's edge, -1 for none.
    :ivar lengths: shape (states,), mean length of that edge, m, nan for none.
    :ivar has_hallway: shape (states,), whether the map has a hallway ahead or back.
    :ivar transitions: from state to state.
    :ivar expected_landmarks: of each state, over its edge and the reach.
    """

    state_count: int
    successors: Int64
    lengths: Float64
    has_hallway: Bool
    transitions: StateTransitions
    expected_landmarks: ExpectedLandmarks


def state_of(node: int, heading: int) -> int:
    """The number of a state."""
    return QUARTERS * node + heading


def node_of(state: int) -> int:
    """The node of a state."""
    return state // QUARTERS


def heading_of(state: int) -> int:
    """The direction of travel of a state."""
    return state % QUARTERS


def opposite_direction(heading: int) -> int:
    """The opposite direction of travel."""
    return (heading + 2) % QUARTERS


def state_after_turn(state: int, quarters: int) -> int:
    """The state after a turn by some quarters to the right at its node."""
    return state_of(node_of(state), (heading_of(state) + quarters) % QUARTERS)


def build_place_graph(nodes: Sequence[Node], edges: Sequence[Edge], places: PlaceParameters) -> PlaceGraph:
    """The place graph of nodes and edges, of which each has one direction.

    :raises ValueError: where two edges leave a node in the same direction.
    """
    edge_of = {state_of(edge.start, edge.start_direction): edge for edge in edges}
    if len(edge_of) != len(edges):
        raise ValueError("two edges leave a node in the same direction: give each its own, or join them")
    states = QUARTERS * len(nodes)
    successors, lengths = np.full(states, -1), np.full(states, np.nan)
    for state, edge in edge_of.items():
        successors[state], lengths[state] = state_of(edge.end, edge.end_direction), edge.distance[0]
    expected = stack_expected_landmarks(
        [_landmarks_around(state, nodes, edge_of, places.reach) for state in range(states)]
    )
    ahead = (successors >= 0).reshape(-1, QUARTERS)
    has_hallway = (ahead | np.roll(ahead, 2, axis=1)).ravel()
    return PlaceGraph(states, successors, lengths, has_hallway, _state_transitions(nodes, edge_of, places), expected)


def _state_transitions(nodes: Sequence[Node], edge_of: Mapping[int, Edge], places: PlaceParameters) -> StateTransitions:
    """The transitions of all states.

    :param edge_of: {state: its edge}.
    """
    rows = [row for state in sorted(edge_of) for row in _transitions_from(state, nodes, edge_of, places)]
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    ends = table[:, :2].astype(np.int64)
    return StateTransitions(ends[:, 0], ends[:, 1], table[:, 2], table[:, 3:5], table[:, 5:])


def _transitions_from(
    source: int, nodes: Sequence[Node], edge_of: Mapping[int, Edge], places: PlaceParameters
) -> Iterator[tuple[float, ...]]:
    """Rows of the transitions to the next opening, and to those behind unnoticed ones.

    The end of a hallway is always noticed.
    """
    state, passed = source, 1.0
    distance, turn = np.zeros(2), np.zeros(2)
    for _ in range(1 + _MAX_UNNOTICED):
        edge = edge_of.get(state)
        if edge is None:
            return
        distance, turn = distance + edge.distance, turn + edge.turn
        state = state_of(edge.end, edge.end_direction)
        noticed = nodes[edge.end].existence * places.noticed if state in edge_of else 1.0
        yield (source, state, passed * noticed, distance[0], turn[0], distance[1], turn[1])
        passed *= 1.0 - noticed


def _landmarks_around(state: int, nodes: Sequence[Node], edge_of: Mapping[int, Edge], reach: float) -> LandmarkSequence:
    """The landmarks of a straight hallway ahead of a state and behind it, where the robot is after turning back.

    On either side they reach beyond the last opening before which the robot may be without having noticed others.
    """
    opposite = state_after_turn(state, 2)
    ahead, back = (
        _landmarks_ahead(start, nodes, edge_of, _max_unnoticed_distance(start, edge_of) + reach)
        for start in (state, opposite)
    )
    return merge_sequences((_node_landmarks(state, nodes), ahead, reverse_direction(back)))


def _max_unnoticed_distance(state: int, edge_of: Mapping[int, Edge]) -> float:
    """Length of the edges that a robot passes without noticing their openings, m."""
    distance = 0.0
    for _ in range(1 + _MAX_UNNOTICED):
        if (edge := edge_of.get(state)) is not None:
            distance, state = distance + edge.distance[0], state_of(edge.end, edge.end_direction)
    return distance


def _landmarks_ahead(state: int, nodes: Sequence[Node], edge_of: Mapping[int, Edge], reach: float) -> LandmarkSequence:
    """The landmarks of edges and nodes straight ahead of a state, up to a distance, m."""
    sequences, distance = [empty_sequence()], 0.0
    while distance <= reach and (edge := edge_of.get(state)) is not None:
        sequences.append(shift_ahead(edge.landmarks, distance))
        if edge.end_direction != edge.start_direction:
            break
        distance, state = distance + edge.distance[0], state_of(edge.end, edge.end_direction)
        sequences.append(shift_ahead(_node_landmarks(state, nodes), distance))
    landmarks = merge_sequences(sequences)
    return select_landmarks(landmarks, landmarks.positions <= reach)


def _node_landmarks(state: int, nodes: Sequence[Node]) -> LandmarkSequence:
    """The landmarks of a node itself, as observed in a state."""
    node, heading = nodes[node_of(state)], heading_of(state)
    landmarks = node.north if heading in {NORTH, SOUTH} else node.east
    return reverse_direction(landmarks) if heading in {SOUTH, WEST} else landmarks
