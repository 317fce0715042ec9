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
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.hybrid_map.landmark import Existence
from hmt_slam_ros.places.floor import DIRECTIONS, Floor
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import PlaceGraph, opposite, turned
from hmt_slam_ros.places.wall_landmarks import Stretch

MIDDLE = 0.5
"""So far from the middle of a way it is looked along at most, m."""

# Length of a piece, and how far a keyframe tells of a way, m. Sectors are 5 degrees wide, so that farther on the beams
# along the middle of a narrow hallway may meet its walls.
_PIECE, _REACH = 0.5, 5.0

_UNSEEN, _FREE, _BLOCKED = range(3)


def existence_of(floor: Floor, way: Stretch, features: Features) -> float:
    """Probability that a way that was driven along is still there.

    :param floor: with the keyframes around, the way being in its frame.
    """
    length = way.end - way.begin
    order = np.argsort(floor.keyframes, kind="stable")
    away = floor.places - way.at
    along = away @ DIRECTIONS[way.direction] - way.begin
    beside = away @ DIRECTIONS[(way.direction + 1) % QUARTERS]
    within = order[np.abs(beside[order]) <= MIDDLE]
    ahead, back = (floor.clear[within, direction] for direction in (way.direction, opposite(way.direction)))
    seen = seen_of_pieces(along[within], ahead, back, length)
    doubted = np.flatnonzero(np.any(seen == _BLOCKED, axis=0))
    return min((_of_piece(seen[:, k], features) for k in doubted), default=1.0)


def seen_of_pieces(along: Float64, ahead: Float64, back: Float64, length: float) -> Int8:
    """What looks from the middle of a way tell of each of its pieces, shape (n, pieces).

    :param along: shape (n,), where they were taken, m from the way's begin.
    :param ahead: shape (n,), how far one saw along it, m; ``back`` likewise.
    """
    pieces = max(1, round(length / _PIECE))
    return np.maximum(_seen(along, ahead, length, pieces), _seen(length - along, back, length, pieces)[:, ::-1])


def after_look(existence: Existence, seen: int, features: Features) -> Existence:
    """That of a piece after a look that tells this of it; one that was deleted and is seen free is there anew."""
    if seen == _BLOCKED:
        return existence.after_miss(features)
    if seen == _UNSEEN:
        return existence
    return existence.after_sight(1.0, features) if existence.probability >= features.landmark_least else Existence(1.0)


def _seen(along: Float64, clear: Float64, length: float, pieces: int) -> Int8:
    """What is seen of each piece by those who look along a way in its direction, shape (n, pieces)."""
    ends = along + np.minimum(clear, _REACH)
    edges: Float64 = np.linspace(0.0, length, pieces + 1)
    first, last = edges[None, :-1], edges[None, 1:]
    ahead = last > along[:, None]
    free = ahead & (last <= ends[:, None])
    blocked = ahead & (clear < _REACH)[:, None] & (first <= ends[:, None]) & (ends[:, None] < last)
    return np.where(blocked, _BLOCKED, np.where(free, _FREE, _UNSEEN)).astype(np.int8)


def _of_piece(seen: Int8, features: Features) -> float:
    """Probability that a piece is there by what keyframes saw of it, in their order, shape (n,)."""
    existence = Existence(1.0)
    for one in seen.tolist():
        existence = after_look(existence, one, features)
    return existence.probability


class WatchedWays:
    """Ways of a graph of places."""

    def __init__(self, graph: PlaceGraph, features: Features) -> None:
        self._graph, self._features = graph, features
        # {the lesser of the states in which its ends are left: its pieces, from there on}
        self._pieces: dict[int, list[Existence]] = {}

    def look(self, state: int, away: float, aside: float, clear: Float64) -> None:
        """Look along the ways that lead off a node.

        :param state: in which the robot is.
        :param away: how far it is beyond the state's node, m.
        :param aside: how far to the right of the hallway's middle, m.
        :param clear: shape (4,), how far one sees ahead, to the right, back and to the left, m; nan where none tells.
        """
        place = np.array((away, aside, -away, -aside))
        for quarter in range(QUARTERS):
            way = turned(state, quarter)
            if self._graph.following[way] >= 0 and abs(place[quarter - 1]) <= MIDDLE:
                self._see(way, place[quarter], clear[quarter], clear[quarter - 2])

    def _see(self, way: int, along: float, ahead: float, back: float) -> None:
        look = np.array((along, ahead, back))[:, None]
        (seen,) = seen_of_pieces(look[0], look[1], look[2], float(self._graph.lengths[way])).tolist()
        other = self._back(way)
        pieces = self._pieces.setdefault(min(way, other), [Existence(1.0)] * len(seen))
        pairs = zip(pieces, seen if way < other else seen[::-1], strict=True)
        pieces[:] = [after_look(existence, each, self._features) for existence, each in pairs]

    def _back(self, way: int) -> int:
        """The state in which the other end of a way is left to come back."""
        return turned(int(self._graph.following[way]), 2)

    def existence(self, way: int) -> float:
        """Probability that a way is open, which is as sure as the piece of it that is doubted most.

        :param way: a state of which the graph has one.
        """
        pieces = self._pieces.get(min(way, self._back(way)), [])
        return min((piece.probability for piece in pieces), default=1.0)

    @property
    def closed(self) -> frozenset[int]:
        """The states whose ways are closed, in both directions."""
        ways = (each for way in self._pieces for each in (way, self._back(way)))
        return frozenset(way for way in ways if self.existence(way) < self._features.landmark_least)
