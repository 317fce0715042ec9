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
from hmt_slam_ros.configuration.landmarks import Places
from hmt_slam_ros.places.observation import Expected
from hmt_slam_ros.places.observation_graph import (
    QUARTERS,
    Landmarks,
    chosen,
    joined,
    moved,
    no_landmarks,
    one_after_the_other,
    turned_back,
)

NORTH, EAST, SOUTH, WEST = range(QUARTERS)
"""Directions of travel. One more is a quarter to the right."""

DIRECTION_NAMES = ("north", "east", "south", "west")
"""Their names."""

# So many openings in a row are passed without notice, at most.
_PASSED = 3


class Node(NamedTuple):
    """An opening or a crossing.

    :ivar existence: its p_lmap.
    :ivar north: landmarks of the node itself, of which it is one, as seen by a robot at the node that heads north.
    :ivar east: likewise for one that heads east.
    """

    existence: float
    north: Landmarks
    east: Landmarks


class Edge(NamedTuple):
    """A stretch of hallway from one node to the next, in one direction.

    :ivar start: node.
    :ivar leaving: direction in which the node is left.
    :ivar end: node.
    :ivar arriving: direction in which the node is reached.
    :ivar distance: mean and variance of the way, m and m^2.
    :ivar turn: mean and variance of how far the robot turns on the way, counterclockwise, rad and rad^2.
    :ivar landmarks: those on the way, as seen from the start; where the hallway bends those before the bend.
    """

    start: int
    leaving: int
    end: int
    arriving: int
    distance: tuple[float, float]
    turn: tuple[float, float]
    landmarks: Landmarks

    @property
    def back(self) -> Edge:
        """The same stretch in the other direction; for one without a bend."""
        landmarks = moved(turned_back(self.landmarks), self.distance[0])
        turn = (-self.turn[0], self.turn[1])
        return Edge(
            self.end, opposite(self.arriving), self.start, opposite(self.leaving), self.distance, turn, landmarks
        )


class Arcs(NamedTuple):
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

    :ivar states: how many there are, four of every node.
    :ivar following: shape (states,), the state at the end of each state's edge, -1 where the map has none.
    :ivar lengths: shape (states,), mean length of that edge, m, nan where there is none.
    :ivar travelled: shape (states,), whether the map has a hallway in the direction of a state, ahead or back.
    :ivar arcs: from state to state.
    :ivar expected: what is to be seen from every state, over its edge and the reach.
    """

    states: int
    following: Int64
    lengths: Float64
    travelled: Bool
    arcs: Arcs
    expected: Expected


def state_of(node: int, heading: int) -> int:
    """The number of a state."""
    return QUARTERS * node + heading


def node_of(state: int) -> int:
    """The node of a state."""
    return state // QUARTERS


def heading_of(state: int) -> int:
    """The direction of travel of a state."""
    return state % QUARTERS


def opposite(heading: int) -> int:
    """The other way."""
    return (heading + 2) % QUARTERS


def turned(state: int, quarters: int) -> int:
    """The state after so many quarters of a turn to the right at its node."""
    return state_of(node_of(state), (heading_of(state) + quarters) % QUARTERS)


def place_graph(nodes: Sequence[Node], edges: Sequence[Edge], places: Places) -> PlaceGraph:
    """The graph of nodes and edges, each in one direction.

    :raises ValueError: where two edges leave a node in the same direction.
    """
    leaving = {state_of(edge.start, edge.leaving): edge for edge in edges}
    if len(leaving) != len(edges):
        raise ValueError("two edges leave a node in the same direction: give each its own, or join them")
    states = QUARTERS * len(nodes)
    following, lengths = np.full(states, -1), np.full(states, np.nan)
    for state, edge in leaving.items():
        following[state], lengths[state] = state_of(edge.end, edge.arriving), edge.distance[0]
    lists = [_seen_from(state, nodes, leaving, places.reach) for state in range(states)]
    starts = np.concatenate(([0], np.cumsum([len(each.tracks) for each in lists])))
    expected = Expected(starts, one_after_the_other(lists))
    onwards = (following >= 0).reshape(-1, QUARTERS)
    travelled = (onwards | np.roll(onwards, 2, axis=1)).ravel()
    return PlaceGraph(states, following, lengths, travelled, _arcs(nodes, leaving, places), expected)


def _arcs(nodes: Sequence[Node], leaving: Mapping[int, Edge], places: Places) -> Arcs:
    rows = [row for state in sorted(leaving) for row in _ways_on(state, nodes, leaving, places)]
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    ends = table[:, :2].astype(np.int64)
    return Arcs(ends[:, 0], ends[:, 1], table[:, 2], table[:, 3:5], table[:, 5:])


def _ways_on(
    source: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], places: Places
) -> Iterator[tuple[float, ...]]:
    """Where the robot is when it notices an opening: at the first one, or behind those that it passed.

    The end of a hallway cannot be passed.
    """
    state, passed = source, 1.0
    distance, turn = np.zeros(2), np.zeros(2)
    for _ in range(1 + _PASSED):
        edge = leaving.get(state)
        if edge is None:
            return
        distance, turn = distance + edge.distance, turn + edge.turn
        state = state_of(edge.end, edge.arriving)
        noticed = nodes[edge.end].existence * places.noticed if state in leaving else 1.0
        yield (source, state, passed * noticed, distance[0], turn[0], distance[1], turn[1])
        passed *= 1.0 - noticed


def _seen_from(state: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], reach: float) -> Landmarks:
    """The landmarks of a straight hallway from so far behind the end of a state's edge to so far behind that of the
    edge at its back, where a robot is that turned back on its way.

    Of the edges behind those, too, which end where the robot is when it passed openings without notice.
    """
    ahead, behind = (_ways_end(start, leaving) + reach for start in (state, turned(state, 2)))
    there = _along(state, nodes, leaving, ahead)
    back = _along(turned(state, 2), nodes, leaving, behind)
    return joined((_of_node(state, nodes), there, turned_back(back)))


def _ways_end(state: int, leaving: Mapping[int, Edge]) -> float:
    """How far it is to where a robot is that passed openings without notice, m."""
    far = 0.0
    for _ in range(1 + _PASSED):
        if (edge := leaving.get(state)) is not None:
            far, state = far + edge.distance[0], state_of(edge.end, edge.arriving)
    return far


def _along(state: int, nodes: Sequence[Node], leaving: Mapping[int, Edge], far: float) -> Landmarks:
    """The landmarks of edges and nodes straight ahead of a state, up to so far, as seen from there."""
    lists, at = [no_landmarks()], 0.0
    while at <= far and (edge := leaving.get(state)) is not None:
        lists.append(moved(edge.landmarks, at))
        if edge.arriving != edge.leaving:
            break
        at, state = at + edge.distance[0], state_of(edge.end, edge.arriving)
        lists.append(moved(_of_node(state, nodes), at))
    every = joined(lists)
    return chosen(every, every.along <= far)


def _of_node(state: int, nodes: Sequence[Node]) -> Landmarks:
    """The landmarks of a node itself, as seen in a state."""
    node, heading = nodes[node_of(state)], heading_of(state)
    landmarks = node.north if heading in {NORTH, SOUTH} else node.east
    return turned_back(landmarks) if heading in {SOUTH, WEST} else landmarks
