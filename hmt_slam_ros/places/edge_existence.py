"""Whether ways of the chart are still there: by keyframes of the map, and as a robot sees them that drives there.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: what is expected and not seen loses existence, Eqs. (4) and (5),
and is deleted below a minimum; so are ways between nodes here, as `landmark_map.Existence` has it for landmarks. A way
was driven along, so that it was there. A keyframe in its middle that sees along it sees each piece of it free, which is
a sight of that piece, or sees up to what stands in it, which is a miss of the piece where that stands, and tells
nothing of those behind. A way is there as surely as the piece of it that is doubted most.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: what is expected and not seen loses existence, Eqs. (4) and (5),
and where that is below a minimum it is deleted; so are ways here, see below. One that is seen free again, or passed, is
there again.
"""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.hybrid_map.landmark import Existence
from hmt_slam_ros.places.floor import DIRECTIONS, AlignedNeighborhood
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import PlaceGraph, opposite_direction, state_after_turn
from hmt_slam_ros.places.wall_landmarks import HallwaySegment

MAX_LATERAL_OFFSET = 0.5
"""So far from the middle of a way it is looked along at most, m."""

# Length of a piece, and how far a keyframe tells of a way, m. Sectors are 5 degrees wide, so that farther on the beams
# along the middle of a narrow hallway may meet its walls.
_PIECE, _REACH = 0.5, 5.0

_UNSEEN, _FREE, _BLOCKED = range(3)


def edge_existence_probability(floor: AlignedNeighborhood, way: HallwaySegment, features: FeatureParameters) -> float:
    """Probability that a way that was driven along is still there.

    :param floor: with the keyframes around, the way being in its frame.
    """
    length = way.end - way.begin
    order = np.argsort(floor.keyframes, kind="stable")
    away = floor.positions - way.origin
    along = away @ DIRECTIONS[way.direction] - way.begin
    beside = away @ DIRECTIONS[(way.direction + 1) % QUARTERS]
    within = order[np.abs(beside[order]) <= MAX_LATERAL_OFFSET]
    ahead, back = (
        floor.free_distances[within, direction] for direction in (way.direction, opposite_direction(way.direction))
    )
    seen = classify_pieces(along[within], ahead, back, length)
    doubted = np.flatnonzero(np.any(seen == _BLOCKED, axis=0))
    return min((_piece_existence(seen[:, k], features) for k in doubted), default=1.0)


def classify_pieces(along: Float64, ahead: Float64, back: Float64, length: float) -> Int8:
    """What looks from the middle of a way tell of each of its pieces, shape (n, pieces).

    :param along: shape (n,), where they were taken, m from the way's begin.
    :param ahead: shape (n,), how far one saw along it, m; ``back`` likewise.
    """
    pieces = max(1, round(length / _PIECE))
    return np.maximum(
        _classify_in_direction(along, ahead, length, pieces),
        _classify_in_direction(length - along, back, length, pieces)[:, ::-1],
    )


def update_existence(existence: Existence, seen: int, features: FeatureParameters) -> Existence:
    """That of a piece after a look that tells this of it; one that was deleted and is seen free is there anew."""
    if seen == _BLOCKED:
        return existence.update_on_miss(features)
    if seen == _UNSEEN:
        return existence
    return (
        existence.update_on_detection(1.0, features)
        if existence.probability >= features.landmark_least
        else Existence(1.0)
    )


def _classify_in_direction(along: Float64, clear: Float64, length: float, pieces: int) -> Int8:
    """What is seen of each piece by those who look along a way in its direction, shape (n, pieces)."""
    ends = along + np.minimum(clear, _REACH)
    edges: Float64 = np.linspace(0.0, length, pieces + 1)
    first, last = edges[None, :-1], edges[None, 1:]
    ahead = last > along[:, None]
    free = ahead & (last <= ends[:, None])
    blocked = ahead & (clear < _REACH)[:, None] & (first <= ends[:, None]) & (ends[:, None] < last)
    return np.where(blocked, _BLOCKED, np.where(free, _FREE, _UNSEEN)).astype(np.int8)


def _piece_existence(seen: Int8, features: FeatureParameters) -> float:
    """Probability that a piece is there by what keyframes saw of it, in their order, shape (n,)."""
    existence = Existence(1.0)
    for one in seen.tolist():
        existence = update_existence(existence, one, features)
    return existence.probability


class EdgeMonitor:
    """Ways of a graph of places."""

    def __init__(self, graph: PlaceGraph, features: FeatureParameters) -> None:
        self._graph, self._features = graph, features
        # {the lesser of the states in which its ends are left: its pieces, from there on}
        self._pieces: dict[int, list[Existence]] = {}

    def observe(self, state: int, distance_past_node: float, lateral_offset: float, clear: Float64) -> None:
        """Look along the ways that lead off a node.

        :param state: in which the robot is.
        :param distance_past_node: how far it is beyond the state's node, m.
        :param lateral_offset: how far to the right of the hallway's middle, m.
        :param clear: shape (4,), how far one sees ahead, to the right, back and to the left, m; nan where none tells.
        """
        place = np.array((distance_past_node, lateral_offset, -distance_past_node, -lateral_offset))
        for quarter in range(QUARTERS):
            way = state_after_turn(state, quarter)
            if self._graph.successors[way] >= 0 and abs(place[quarter - 1]) <= MAX_LATERAL_OFFSET:
                self._observe_edge(way, place[quarter], clear[quarter], clear[quarter - 2])

    def _observe_edge(self, way: int, along: float, ahead: float, back: float) -> None:
        look = np.array((along, ahead, back))[:, None]
        (seen,) = classify_pieces(look[0], look[1], look[2], float(self._graph.lengths[way])).tolist()
        other = self._reverse_state(way)
        pieces = self._pieces.setdefault(min(way, other), [Existence(1.0)] * len(seen))
        pairs = zip(pieces, seen if way < other else seen[::-1], strict=True)
        pieces[:] = [update_existence(existence, each, self._features) for existence, each in pairs]

    def _reverse_state(self, way: int) -> int:
        """The state in which the other end of a way is left to come back."""
        return state_after_turn(int(self._graph.successors[way]), 2)

    def existence(self, way: int) -> float:
        """Probability that a way is open, which is as sure as the piece of it that is doubted most.

        :param way: a state of which the graph has one.
        """
        pieces = self._pieces.get(min(way, self._reverse_state(way)), [])
        return min((piece.probability for piece in pieces), default=1.0)

    @property
    def closed_states(self) -> frozenset[int]:
        """The states whose ways are closed, in both directions."""
        ways = (each for way in self._pieces for each in (way, self._reverse_state(way)))
        return frozenset(way for way in ways if self.existence(way) < self._features.landmark_least)
