"""Existence of edges: whether hallways of the chart are still free, by keyframes and by the scans of a driving robot.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: what is expected and not observed loses existence, Eqs. (4) and
(5), and is removed below a minimum. Here this holds for edges as it does for landmarks (`Existence`). An edge was
driven along, so it existed. Each of its pieces is observed from the hallway's middle: free, which counts as a
detection, or blocked, which counts as a miss. Pieces behind a blocked one are not observed. The existence of an edge is
that of its least probable piece. A removed piece that is observed free exists again.
"""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.hybrid_map.landmark import Existence
from hmt_slam_ros.places.floor import AlignedNeighborhood, ahead_and_beside
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import PlaceGraph, opposite_direction, state_after_turn
from hmt_slam_ros.places.wall_landmarks import HallwaySegment

MAX_LATERAL_OFFSET = 0.5
"""Largest distance from the middle of a hallway from which its pieces are observed, m."""

_PIECE_LENGTH = 0.5
"""Length of a piece of an edge, m."""

_REACH = 5.0
"""Distance up to which pieces are observed, m; farther on, sectors of 5 degrees may meet the walls of a hallway."""

_UNSEEN, _FREE, _BLOCKED = range(3)


def edge_existence_probability(
    floor: AlignedNeighborhood, segment: HallwaySegment, features: FeatureParameters
) -> float:
    """Probability that a segment of hallway that was driven along is still free.

    :param floor: the neighborhood in whose frame the segment is.
    """
    order = np.argsort(floor.keyframes, kind="stable")
    along, beside = ahead_and_beside(floor.positions - segment.origin, segment.direction)
    rows = order[np.abs(beside[order]) <= MAX_LATERAL_OFFSET]
    ahead = floor.free_distances[rows, segment.direction]
    back = floor.free_distances[rows, opposite_direction(segment.direction)]
    pieces = classify_pieces((along - segment.begin)[rows], ahead, back, segment.end - segment.begin)
    blocked = np.flatnonzero(np.any(pieces == _BLOCKED, axis=0))
    return min((_piece_existence(pieces[:, k], features) for k in blocked), default=1.0)


def classify_pieces(along: Float64, ahead: Float64, back: Float64, length: float) -> Int8:
    """What is observed of each piece of a hallway from positions in its middle, shape (n, pieces).

    :param along: shape (n,), the positions, m from the begin.
    :param ahead: shape (n,), free distances along it, m; ``back`` likewise.
    """
    pieces = max(1, round(length / _PIECE_LENGTH))
    return np.maximum(
        _classify_in_direction(along, ahead, length, pieces),
        _classify_in_direction(length - along, back, length, pieces)[:, ::-1],
    )


def update_existence(existence: Existence, observed: int, features: FeatureParameters) -> Existence:
    """Existence of a piece after an observation; a removed one that is free exists again."""
    if observed == _BLOCKED:
        return existence.update_on_miss(features)
    if observed == _UNSEEN:
        return existence
    return (
        existence.update_on_detection(1.0, features)
        if existence.probability >= features.landmark_least
        else Existence(1.0)
    )


def _classify_in_direction(along: Float64, free_distances: Float64, length: float, pieces: int) -> Int8:
    """What is observed of each piece ahead of positions along a hallway, shape (n, pieces)."""
    ends = along + np.minimum(free_distances, _REACH)
    edges: Float64 = np.linspace(0.0, length, pieces + 1)
    first, last = edges[None, :-1], edges[None, 1:]
    ahead = last > along[:, None]
    free = ahead & (last <= ends[:, None])
    blocked = ahead & (free_distances < _REACH)[:, None] & (first <= ends[:, None]) & (ends[:, None] < last)
    return np.where(blocked, _BLOCKED, np.where(free, _FREE, _UNSEEN)).astype(np.int8)


def _piece_existence(observations: Int8, features: FeatureParameters) -> float:
    """Probability of a piece after the observations of keyframes, (n,), in the order of time."""
    existence = Existence(1.0)
    for observed in observations.tolist():
        existence = update_existence(existence, observed, features)
    return existence.probability


class EdgeMonitor:
    """Existence of the edges of a place graph, by the scans of a driving robot."""

    def __init__(self, graph: PlaceGraph, features: FeatureParameters) -> None:
        self._graph, self._features = graph, features
        # {the smaller of the states that enter an edge at its two ends: its pieces from there on}
        self._pieces: dict[int, list[Existence]] = {}

    def observe(self, state: int, distance_past_node: float, lateral_offset: float, clear: Float64) -> None:
        """Observe the edges of a node.

        :param state: of the robot.
        :param distance_past_node: from the state's node to the robot, m.
        :param lateral_offset: from the hallway's middle to the robot, to the right, m.
        :param clear: shape (4,), free distances ahead, to the right, back and to the left, m; nan where unknown.
        """
        position = np.array((distance_past_node, lateral_offset, -distance_past_node, -lateral_offset))
        for quarter in range(QUARTERS):
            edge_state = state_after_turn(state, quarter)
            if self._graph.successors[edge_state] >= 0 and abs(position[quarter - 1]) <= MAX_LATERAL_OFFSET:
                self._observe_edge(edge_state, position[quarter], clear[quarter], clear[quarter - 2])

    def _observe_edge(self, state: int, along: float, ahead: float, back: float) -> None:
        """Observe the edge of a state from a position along it, with free distances, m."""
        values = np.array((along, ahead, back))[:, None]
        (observed,) = classify_pieces(values[0], values[1], values[2], float(self._graph.lengths[state])).tolist()
        other = self._reverse_state(state)
        pieces = self._pieces.setdefault(min(state, other), [Existence(1.0)] * len(observed))
        pairs = zip(pieces, observed if state < other else observed[::-1], strict=True)
        pieces[:] = [update_existence(existence, each, self._features) for existence, each in pairs]

    def _reverse_state(self, state: int) -> int:
        """The state that enters the edge of a state at its other end."""
        return state_after_turn(int(self._graph.successors[state]), 2)

    def existence(self, state: int) -> float:
        """Probability that the edge of a state is free."""
        pieces = self._pieces.get(min(state, self._reverse_state(state)), [])
        return min((piece.probability for piece in pieces), default=1.0)

    @property
    def closed_states(self) -> frozenset[int]:
        """The states whose edges are closed, in both directions."""
        states = (each for state in self._pieces for each in (state, self._reverse_state(state)))
        return frozenset(state for state in states if self.existence(state) < self._features.landmark_least)
