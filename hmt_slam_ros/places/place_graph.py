"""The graph of places: openings times directions of travel, how one gets from one to the next, and what is seen there.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, Fig. 2: nodes are openings and crossings, and between two of them
lies the ordered list of landmarks. A *state* is a node with a direction of travel: the robot was at the node last, and
heads that way. From there the next opening that it notices is the one at the end of the edge, or, where that is missed,
one behind it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.places.observation import ExpectedLandmarks
from hmt_slam_ros.places.observation_graph import (
    QUARTERS,
    LandmarkSequence,
    concatenate_sequences,
    empty_sequence,
    merge_sequences,
    reverse_direction,
    select_landmarks,
    shift_ahead,
)

NORTH, EAST, SOUTH, WEST = range(QUARTERS)
"""Directions of travel. One more is a quarter to the right."""

DIRECTION_NAMES = ("north", "east", "south", "west")
"""Their names."""

# So many openings in a row are passed without notice, at most.
_MAX_UNNOTICED = 3


class Node(NamedTuple):
    """An opening or a crossing.

    :ivar existence: its p_lmap.
    :ivar north: landmarks of the node itself, of which it is one, as seen by a robot at the node that heads north.
    :ivar east: likewise for one that heads east.
    """

    existence: float
    north: LandmarkSequence
    east: LandmarkSequence


class Edge(NamedTuple):
    """A stretch of hallway from one node to the next, in one direction.

    :ivar start: node.
    :ivar start_direction: direction in which the node is left.
    :ivar end: node.
    :ivar end_direction: direction in which the node is reached.
    :ivar distance: mean and variance of the way, m and m^2.
    :ivar turn: mean and variance of how far the robot turns on the way, counterclockwise, rad and rad^2.
    :ivar landmarks: those on the way, as seen from the start; where the hallway bends those before the bend.
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
        """The same stretch in the other direction; for one without a bend."""
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
    """Transitions from state to state by the next opening that is noticed, straight on.

    :ivar sources: shape (k,), states.
    :ivar targets: shape (k,), states.
    :ivar probabilities: shape (k,); those of a source add up to 1 at most.
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
    """States, arcs, and what is to be seen.

    :ivar state_count: how many there are, four of every node.
    :ivar successors: shape (states,), the state at the end of each state's edge, -1 where the map has none.
    :ivar lengths: shape (states,), mean length of that edge, m, nan where there is none.
    :ivar has_hallway: shape (states,), whether the map has a hallway in the direction of a state, ahead or back.
    :ivar transitions: from state to state.
    :ivar expected_landmarks: what is to be seen from every state, over its edge and the reach.
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
    """The other way."""
    return (heading + 2) % QUARTERS


def state_after_turn(state: int, quarters: int) -> int:
    """The state after so many quarters of a turn to the right at its node."""
    return state_of(node_of(state), (heading_of(state) + quarters) % QUARTERS)


def build_place_graph(nodes: Sequence[Node], edges: Sequence[Edge], places: PlaceParameters) -> PlaceGraph:
    """The graph of nodes and edges, each in one direction.

    :raises ValueError: where two edges leave a node in the same direction.
    """
    leaving = {state_of(edge.start, edge.start_direction): edge for edge in edges}
    if len(leaving) != len(edges):
        raise ValueError("two edges leave a node in the same direction: give each its own, or join them")
    states = QUARTERS * len(nodes)
    following, lengths = np.full(states, -1), np.full(states, np.nan)
    for state, edge in leaving.items():
        following[state], lengths[state] = state_of(edge.end, edge.end_direction), edge.distance[0]
    lists = [_landmarks_around(state, nodes, leaving, places.reach) for state in range(states)]
    starts = np.concatenate(([0], np.cumsum([len(each.tracks) for each in lists])))
    expected = ExpectedLandmarks(starts, concatenate_sequences(lists))
    onwards = (following >= 0).reshape(-1, QUARTERS)
    travelled = (onwards | np.roll(onwards, 2, axis=1)).ravel()
    return PlaceGraph(states, following, lengths, travelled, _state_transitions(nodes, leaving, places), expected)


def _state_transitions(nodes: Sequence[Node], leaving: Mapping[int, Edge], places: PlaceParameters) -> StateTransitions:
    rows = [row for state in sorted(leaving) for row in _transitions_from(state, nodes, leaving, places)]
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    ends = table[:, :2].astype(np.int64)
    return StateTransitions(ends[:, 0], ends[:, 1], table[:, 2], table[:, 3:5], table[:, 5:])


def _transitions_from(
    source: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], places: PlaceParameters
) -> Iterator[tuple[float, ...]]:
    """Where the robot is when it notices an opening: at the first one, or behind those that it passed.

    The end of a hallway cannot be passed.
    """
    state, passed = source, 1.0
    distance, turn = np.zeros(2), np.zeros(2)
    for _ in range(1 + _MAX_UNNOTICED):
        edge = leaving.get(state)
        if edge is None:
            return
        distance, turn = distance + edge.distance, turn + edge.turn
        state = state_of(edge.end, edge.end_direction)
        noticed = nodes[edge.end].existence * places.noticed if state in leaving else 1.0
        yield (source, state, passed * noticed, distance[0], turn[0], distance[1], turn[1])
        passed *= 1.0 - noticed


def _landmarks_around(state: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], reach: float) -> LandmarkSequence:
    """The landmarks of a straight hallway from so far behind the end of a state's edge to so far behind that of the
    edge at its back, where a robot is that turned back on its way.

    Of the edges behind those, too, which end where the robot is when it passed openings without notice.
    """
    ahead, behind = (_max_unnoticed_distance(start, leaving) + reach for start in (state, state_after_turn(state, 2)))
    there = _landmarks_ahead(state, nodes, leaving, ahead)
    back = _landmarks_ahead(state_after_turn(state, 2), nodes, leaving, behind)
    return merge_sequences((_node_landmarks(state, nodes), there, reverse_direction(back)))


def _max_unnoticed_distance(state: int, leaving: Mapping[int, Edge]) -> float:
    """How far it is to where a robot is that passed openings without notice, m."""
    far = 0.0
    for _ in range(1 + _MAX_UNNOTICED):
        if (edge := leaving.get(state)) is not None:
            far, state = far + edge.distance[0], state_of(edge.end, edge.end_direction)
    return far


def _landmarks_ahead(state: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], far: float) -> LandmarkSequence:
    """The landmarks of edges and nodes straight ahead of a state, up to so far, as seen from there."""
    lists, at = [empty_sequence()], 0.0
    while at <= far and (edge := leaving.get(state)) is not None:
        lists.append(shift_ahead(edge.landmarks, at))
        if edge.end_direction != edge.start_direction:
            break
        at, state = at + edge.distance[0], state_of(edge.end, edge.end_direction)
        lists.append(shift_ahead(_node_landmarks(state, nodes), at))
    every = merge_sequences(lists)
    return select_landmarks(every, every.positions <= far)


def _node_landmarks(state: int, nodes: Sequence[Node]) -> LandmarkSequence:
    """The landmarks of a node itself, as seen in a state."""
    node, heading = nodes[node_of(state)], heading_of(state)
    landmarks = node.north if heading in {NORTH, SOUTH} else node.east
    return reverse_direction(landmarks) if heading in {SOUTH, WEST} else landmarks
