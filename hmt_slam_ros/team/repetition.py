"""Repetition: whether a building repeats itself, from a map that is searched in itself.

Where one robot's ground looks like another's all along, it is the same ground, or its twin in a building that repeats
itself: halls of a hospital, the sides of a ring, floors. No scan tells these apart before there is common ground. But
a building that repeats itself mostly does so within one map, too, where each placement but the identity is known to be
false. With R the repetition,

    log P(map | R) / P(map | not R) = log(q + (1 - q) mean over placements of P(windows | twin) / P(windows | chance))

and q the probability that the twin lies beyond the map. Parts that were not searched are no evidence: they count 1
(docs/decisions/0085-repetition.md). How many windows of a twin fit before it ends shows how far what is alike goes on
(docs/decisions/0098-twins-end.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions, stack_poses
from hmt_slam_ros.messages.team import MAX_LOG_REPETITION, NO_REPETITION, Repetition
from hmt_slam_ros.team.components import Component, ComponentPair, Shift, combine
from hmt_slam_ros.team.placement import BEYOND, Placement
from hmt_slam_ros.team.placement_evidence import AGREES
from hmt_slam_ros.team.placement_search import PlacementSearch
from hmt_slam_ros.team.windows import MAX_LENGTH, Window

_ENDS = -1.0
"""Log Bayes factor of a window below which what is alike has ended there, nats."""

_PERSISTENCE_WEIGHT = 2.0
"""Windows for which a twin goes on a priori: one that was not seen to end may be as large as the building."""

_DIGITS = 2
"""Decimal digits of a log Bayes factor and of a probability: others are nothing new."""


class RepetitionTest:
    """Searches a map in itself, while it grows: a bounded step at a time.

    :ivar repetition: what the map shows, as of the end of the last search.
    :ivar is_done: whether the search is at its end.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._search = PlacementSearch(configuration, _OverlappingAreas)
        self.repetition, self.is_done = NO_REPETITION, True

    def update(self, component: Component, shift: Shift | None = None) -> None:
        """Go on with a map that grew or changed.

        :param component: with an area or more.
        :param shift: added to the numbers of its copy; as little as possible if None.
        """
        self._search.update(combine(component, component, shift))
        self.is_done = False

    def step(self) -> int:
        """Take the next step, and return its work; at the end ``repetition`` is new."""
        work = self._search.step()
        if work is None:
            before = self._search.comparison_work
            self.repetition, self.is_done = _repetition(self._search), True
            work = self._search.comparison_work - before
        return work


def add_repetition(component: Component, configuration: Configuration) -> Component:
    """A component with what the search of its whole map in itself tells."""
    test = RepetitionTest(configuration)
    test.update(component)
    while not test.is_done:
        test.step()
    return replace(component, repetition=test.repetition)


class _OverlappingAreas:
    """The areas around a window of a map and its copy, where it fits since it lies there."""

    def __init__(self, pair: ComponentPair) -> None:
        """:param pair: of a map and itself."""
        self._shift, self._poses = pair.area_shift, connected_areas(pair.hybrid_map, pair.joint[0])
        positions = {area: keyframe_positions(pair.hybrid_map, area, own.mean) for area, own in self._poses.items()}
        self._positions = np.concatenate(list(positions.values()))
        self._areas = np.repeat(list(positions), [len(own) for own in positions.values()])

    def __call__(self, window: Window) -> frozenset[int]:
        """Those with a keyframe so near that the window would overlap its own copy."""
        pose = self._poses[window.area - self._shift].mean
        positions = se2.compose(se2.compose(pose, window.reference), stack_poses(window.poses))[:, :2]
        distances = np.hypot(*(self._positions[:, None] - positions).transpose(2, 0, 1)).min(axis=1)
        return frozenset(np.unique(self._areas[distances <= MAX_LENGTH]).tolist())


def _repetition(search: PlacementSearch) -> Repetition:
    placements = search.distribution().placements
    log_ratios = [min(sum(each.evidence), MAX_LOG_REPETITION) for each in placements]
    possible = len(search.pair.known) * max(1, len(search.windows))
    mean = (float(np.exp(log_ratios).sum()) + possible - search.searched_count) / possible
    log_ratio = math.log(BEYOND + (1.0 - BEYOND) * mean)
    return Repetition(round(min(log_ratio, MAX_LOG_REPETITION), _DIGITS), _persistence(placements, log_ratios))


def _persistence(placements: Sequence[Placement], log_ratios: Sequence[float]) -> float:
    """Probability that a twin goes on for one more window, from placements of a map in itself and their evidence."""
    goes_on, ends = _PERSISTENCE_WEIGHT, 0.0
    weights = scipy.special.softmax(log_ratios).tolist() if placements else []
    for placement, weight in zip(placements, weights, strict=True):
        windows = [own.log_ratio for own in placement.windows.values() if own.is_in_place]
        goes_on += weight * sum(own > AGREES for own in windows)
        ends += weight * sum(own < _ENDS for own in windows)
    return float(round(goes_on / (goes_on + ends), _DIGITS))
