"""Whether the ways of a chart are open, as a robot sees them that drives there, beyond what the map knows of them.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: what is expected and not seen loses existence, Eqs. (4) and (5),
and where that is below a minimum it is deleted; so are ways here, see way_existence.py. One that is seen free again, or
passed, is there again.
"""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.existence import Existence
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import PlaceGraph, turned
from hmt_slam_ros.places.way_existence import MIDDLE, after_look, seen_of_pieces


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
