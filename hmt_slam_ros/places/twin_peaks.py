"""The loop detector of Tomatis, Nourbakhsh and Siegwart (2003), section 3.5: two peaks that move in the same way.

A map that holds a place twice gives the belief two peaks of which neither loses the other. Where both moved in the same
way for three state transitions in a row, a loop is proposed: where the one is and where the other is, is one place. Nor
do two peaks tell anything of which one follows the other along the same hallway: there it is not certain how far the
robot is.

The two entries of one place never hold quite the same landmarks, and a belief that trusts its landmarks soon decides
for one of them. That the robot is at the one is no evidence against the other being the same place. So the second peak
is not weighed against the first one, but against all that is left without that: the other places of the map, and ground
that the map does not hold. That is most probable at first, since a place is seldom in the map twice; and nothing slips
from peak to peak, which would have every place begin anew at each transition.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration.places import Places
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import PlaceGraph, heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief, flat_belief

TRANSITIONS = 3
"""In a row in which both peaks have to move in the same way."""

_SLIP = 1e-9


class Loop(NamedTuple):
    """Two places of the map that are one.

    :ivar node: of the higher peak.
    :ivar other: of the second one.
    :ivar quarters: how far the other's north is turned to the right against that of the first.
    """

    node: int
    other: int
    quarters: int


def belief_of_twins(graph: PlaceGraph, places: Places) -> PositionBelief:
    """The belief whose peaks are followed, before anything was seen.

    A place is in the map a second time with the probability of coming from unknown ground to known one.
    """
    return flat_belief(graph, replace(places, slip=_SLIP, unmapped=1.0 - places.discovery))


class TwinPeaks:
    """Follows the two highest peaks of a belief from transition to transition."""

    def __init__(self) -> None:
        self._trails: tuple[list[int], list[int]] | None = None

    def after_transition(self, belief: PositionBelief) -> Loop | None:
        """A loop that the belief after an arrival, and after what was seen there, proposes; else None."""
        peaks = _peaks(belief)
        if peaks is None:
            self._trails = None
            return None
        self._trails = self._continued(peaks, belief.graph)
        first, second = self._trails
        if len(first) <= TRANSITIONS or set(map(node_of, first)) & set(map(node_of, second)):
            return None
        best = sorted((first[-1], second[-1]), key=lambda state: -belief.logs[state])
        return Loop(node_of(best[0]), node_of(best[1]), _quarters(best[0], best[1]))

    def _continued(self, peaks: tuple[int, int], graph: PlaceGraph) -> tuple[list[int], list[int]]:
        """The trails of both peaks, of which the older part is left out; new ones where they did not both move on."""
        if self._trails is not None:
            first, second = self._trails
            for one, other in (peaks, peaks[::-1]):
                moved = _moves(graph, first[-1], one) and _moves(graph, second[-1], other)
                if moved and _quarters(first[-1], one) == _quarters(second[-1], other):
                    return [*first[-TRANSITIONS:], one], [*second[-TRANSITIONS:], other]
        return [peaks[0]], [peaks[1]]


def _peaks(belief: PositionBelief) -> tuple[int, int] | None:
    """The highest peak of a belief, and the one that is all that is left without it; both of them in the map."""
    first, second = np.argsort(-belief.logs, kind="stable")[:2].tolist()
    left = float(np.delete(belief.probabilities, first).sum())
    twin = left > 0.0 and belief.probabilities[second] >= belief.places.twin_share * left
    return (first, second) if twin and belief.graph.states not in {first, second} else None


def _moves(graph: PlaceGraph, source: int, target: int) -> bool:
    """Whether an arc leads from the one state to the other."""
    arcs = graph.arcs
    return bool(np.any((arcs.sources == source) & (arcs.targets == target)))


def _quarters(source: int, target: int) -> int:
    """Quarters to the right from the heading of one state to that of another."""
    return (heading_of(target) - heading_of(source)) % QUARTERS
