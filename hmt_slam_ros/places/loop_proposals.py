"""Loops of an HMT map that its landmarks propose, whatever the arcs say of where its areas lie.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5. The areas that the robot went through last make a chart of their
own, those of before another one; what is around an area is asked within its own chart only, so that no prior by the
arcs tells which of their nodes are one. The belief goes the robot's way again over both. Where its two peaks move in
the same way, an area of the one is joined to an area of the other, as the poses of the two nodes say.

The paper's robot then turns back, and where the belief falls to a single peak the loop begins. Over stored areas that
is the belief of who goes the way backwards; a loop that shows in one direction alone is none.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5, as a generator of candidates: the belief over places tells which
areas may be one, and how they lie to each other, without any prior by the arcs (below). What is proposed
is no evidence and stays no arc. It is where keyframes are laid into known areas, and whether they fit there decides
(topological_inference/closure_search.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import informative_arc, shortest_paths
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.places.area_views import AreaView, AreaViewCache
from hmt_slam_ros.places.chart import Chart, build_chart
from hmt_slam_ros.places.loop_detector import TRANSITIONS, LoopCandidate, detect_loops, traversed_paths
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.place_graph import Edge, PlaceGraph

# Of the robot's way so many transitions are enough.
_MAX_TRANSITIONS = 3 * TRANSITIONS
# Deviations of a node's place against its twin's, m, and of its axes, rad. Of 12 twins in institutes of training seeds
# the largest errors are 0.13 m and 0.2 degrees, the mean ones 0.03 m and 0.1 degrees.
_PLACED, _HEADING_DEVIATION = 0.1, math.radians(0.5)


class AreaLoop(NamedTuple):
    """Two areas that a loop joins.

    :ivar area: one that the robot went through last.
    :ivar other_area: one of before.
    :ivar pose: the belief over ``area_T_other``.
    :ivar first_area: the area, of those that the robot went through last, in which the loop begins.
    """

    area: int
    other_area: int
    pose: PoseGaussian
    first_area: int


class _CachedChart(NamedTuple):
    """A chart, and what it was made of."""

    views: tuple[AreaView, ...]
    arcs: tuple[tuple[int, int, bytes, bytes], ...]
    chart: Chart

    def is_current(self, views: Iterable[AreaView], arcs: tuple[tuple[int, int, bytes, bytes], ...]) -> bool:
        """Whether it is made of these."""
        return arcs == self.arcs and all(own is other for own, other in zip(self.views, views, strict=True))


class AreaLoopDetector:
    """Looks for loops in maps; keeps the charts that were asked for last."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        """:param views: what areas show."""
        self._features, self._places, self._views = configuration.features, configuration.places, views
        self._model = observation_model(configuration.places, configuration.features)
        self._charts: dict[tuple[int, ...], _CachedChart] = {}

    def newest_loop(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """The newest place of the robot's way that the map holds another time, as the belief says; None for none."""
        kept, self._charts = self._charts, {}
        for last, before in _temporal_splits(hybrid_map):
            own = self._chart(last, kept)
            found = traversed_paths(last, own)
            if max(map(len, found), default=0) >= TRANSITIONS:
                both = _disjoint_union(own, self._chart(before, kept))
                graph = both.graph(self._places)
                loops = [
                    pair for way in found if (pair := self._confirm_in_reverse(way, graph, len(own.nodes))) is not None
                ]
                if loops:
                    return _area_loop(both, *loops[-1], len(own.nodes))
            if sum(map(len, found)) >= _MAX_TRANSITIONS:
                break
        return None

    def _confirm_in_reverse(
        self, way: Sequence[Edge], graph: PlaceGraph, own: int
    ) -> tuple[LoopCandidate, LoopCandidate] | None:
        """The newest loop on a way between one of the first nodes and one of the others, and where that begins."""
        there = list(self._loops_between(way, graph, own))
        if not there:
            return None
        steps, newest = there[-1]
        back = list(self._loops_between([edge.reverse for edge in reversed(way[:steps])], graph, own))
        return (newest, back[-1][1]) if back else None

    def _loops_between(self, way: Sequence[Edge], graph: PlaceGraph, own: int) -> Iterator[tuple[int, LoopCandidate]]:
        """Loops between one of the first nodes and one of the others, each with the steps of the way up to there."""
        for steps, loop in enumerate(detect_loops(way, graph, self._model, self._places), 1):
            if loop is not None and (loop.node < own) != (loop.other_node < own):
                yield steps, loop

    def _chart(self, hybrid_map: HybridMap, kept: Mapping[tuple[int, ...], _CachedChart]) -> Chart:
        """The chart of a map, which may be one of those that were kept."""
        views = self._views.views_of_map(hybrid_map)
        every = ((a, b, arc.pose) for a, b, arc in hybrid_map.all_arcs())
        arcs = tuple((a, b, pose.mean.tobytes(), pose.covariance.tobytes()) for a, b, pose in every)
        found = kept.get(tuple(views))
        if found is None or not found.is_current(views.values(), arcs):
            found = _CachedChart(tuple(views.values()), arcs, build_chart(hybrid_map, views, self._features))
        self._charts[tuple(views)] = found
        return found.chart


def _temporal_splits(hybrid_map: HybridMap) -> Iterator[tuple[HybridMap, HybridMap]]:
    """The map of the areas in which the robot was last, from the fewest on, and that of all in which it was before."""
    keyframes = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    areas = sorted((area for area, own in keyframes.items() if own), key=lambda area: max(keyframes[area]))
    for k in range(len(areas) - 1, 0, -1):
        if max(keyframes[areas[k - 1]]) < min(min(keyframes[area]) for area in areas[k:]):
            yield hybrid_map.subgraph(areas[k:]), hybrid_map.subgraph(areas[:k])


def _disjoint_union(one: Chart, other: Chart) -> Chart:
    """Two charts as one, in which no edge leads from the one to the other."""
    count = len(one.nodes)
    edges = (edge._replace(start=edge.start + count, end=edge.end + count) for edge in other.edges)
    return Chart(one.nodes + other.nodes, one.graph_nodes + other.graph_nodes, (*one.edges, *edges))


def _area_loop(chart: Chart, loop: LoopCandidate, begin: LoopCandidate, own: int) -> AreaLoop:
    """A loop between a node of the first ones and another one, as it joins their areas.

    :param begin: the same loop where it begins.
    """
    quarters = loop.quarters if loop.node < own else -loop.quarters
    node, other = (chart.nodes[k] for k in sorted((loop.node, loop.other_node)))
    turned = PoseGaussian(
        np.array((0.0, 0.0, 0.5 * math.pi * quarters)), np.diag([_PLACED, _PLACED, _HEADING_DEVIATION]) ** 2
    )
    back = PoseGaussian.from_pose(other.pose).inverse()
    pose = PoseGaussian.from_pose(node.pose).compose(turned).compose(back)
    return AreaLoop(node.area, other.area, pose, chart.nodes[min(begin.node, begin.other_node)].area)


# Keyframes that are looked at ahead, at a time.
_AHEAD = 32

_TEXT = (
    "landmarks on the way from area {} to area {} are those up to area {}: a loop is looked for there, and nothing is "
    "to do"
)


class LoopProposer:
    """Supposes arcs."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        """:param views: what areas show."""
        self._loops, self._views = AreaLoopDetector(configuration, views), views
        # Areas whose position is known this well, m, are told from others by the arcs, or looked for all the same.
        self._max_arc_deviation = min(configuration.places.spacing, configuration.tsbi.prior_limit)
        self._unreported: list[AreaLoop] = []
        self._reported: set[tuple[int, int]] = set()

    def propose(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """The newest loop that landmarks propose and no arc closes; None for none."""
        loop = self._loops.newest_loop(hybrid_map)
        return None if loop is None or informative_arc(hybrid_map, loop.area, loop.other_area) is not None else loop

    def with_proposed_arc(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where one is proposed; the map itself where none is, and where the arcs know all.

        :param area: the robot's.
        """
        loop = self.propose(hybrid_map) if self._is_needed(hybrid_map, area) else None
        if loop is None:
            return hybrid_map
        self._unreported.append(loop)
        supposed = hybrid_map.branch()
        supposed.set_arc(loop.area, loop.other_area, loop.pose, closure=False)
        return supposed

    def prefetch(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, look up a part of what areas show, which the next cut would ask for.

        :param area: the robot's.
        """
        if self._is_needed(hybrid_map, area):
            areas = ((known, hybrid_map.keyframes(known)) for known in hybrid_map.area_ids())
            self._views.prefetch(areas, _AHEAD)

    def _is_needed(self, hybrid_map: HybridMap, area: int) -> bool:
        """Whether the arcs leave open where an area is, seen from that of the robot."""
        return len(shortest_paths(hybrid_map, area, self._max_arc_deviation**2).areas) < len(hybrid_map.area_ids())

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, each pair of areas once."""
        new = {
            (loop.area, loop.other_area): loop
            for loop in self._unreported
            if (loop.area, loop.other_area) not in self._reported
        }
        self._unreported.clear()
        self._reported.update(new)
        return [Notice("tsbi", _TEXT.format(loop.first_area, loop.area, loop.other_area)) for loop in new.values()]
