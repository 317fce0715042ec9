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
from hmt_slam_ros.hybrid_map.shortest_path import reached, telling_arc
from hmt_slam_ros.messages.messages import Notice
from hmt_slam_ros.places.area_views import AreaView, AreaViews
from hmt_slam_ros.places.chart import Chart, chart_of
from hmt_slam_ros.places.loop_detector import TRANSITIONS, Loop, loops_along, ways
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.place_graph import Edge, PlaceGraph

# Of the robot's way so many transitions are enough.
_ENOUGH = 3 * TRANSITIONS
# Deviations of a node's place against its twin's, m, and of its axes, rad. Of 12 twins in institutes of training seeds
# the largest errors are 0.13 m and 0.2 degrees, the mean ones 0.03 m and 0.1 degrees.
_PLACED, _TURNED = 0.1, math.radians(0.5)


class MapLoop(NamedTuple):
    """Two areas that a loop joins.

    :ivar area: one that the robot went through last.
    :ivar other: one of before.
    :ivar pose: the belief over ``area_T_other``.
    :ivar begin: the area, of those that the robot went through last, in which the loop begins.
    """

    area: int
    other: int
    pose: PoseGaussian
    begin: int


class _Charted(NamedTuple):
    """A chart, and what it was made of."""

    views: tuple[AreaView, ...]
    arcs: tuple[tuple[int, int, bytes, bytes], ...]
    chart: Chart

    def is_of(self, views: Iterable[AreaView], arcs: tuple[tuple[int, int, bytes, bytes], ...]) -> bool:
        """Whether it is made of these."""
        return arcs == self.arcs and all(own is other for own, other in zip(self.views, views, strict=True))


class MapLoops:
    """Looks for loops in maps; keeps the charts that were asked for last."""

    def __init__(self, configuration: Configuration, views: AreaViews) -> None:
        """:param views: what areas show."""
        self._features, self._places, self._views = configuration.features, configuration.places, views
        self._model = observation_model(configuration.places, configuration.features)
        self._charts: dict[tuple[int, ...], _Charted] = {}

    def newest(self, hybrid_map: HybridMap) -> MapLoop | None:
        """The newest place of the robot's way that the map holds another time, as the belief says; None for none."""
        kept, self._charts = self._charts, {}
        for last, before in _divisions(hybrid_map):
            own = self._chart(last, kept)
            found = ways(last, own)
            if max(map(len, found), default=0) >= TRANSITIONS:
                both = _beside(own, self._chart(before, kept))
                graph = both.graph(self._places)
                loops = [pair for way in found if (pair := self._smoothed(way, graph, len(own.nodes))) is not None]
                if loops:
                    return _joining(both, *loops[-1], len(own.nodes))
            if sum(map(len, found)) >= _ENOUGH:
                break
        return None

    def _smoothed(self, way: Sequence[Edge], graph: PlaceGraph, own: int) -> tuple[Loop, Loop] | None:
        """The newest loop on a way between one of the first nodes and one of the others, and where that begins."""
        there = list(self._between(way, graph, own))
        if not there:
            return None
        steps, newest = there[-1]
        back = list(self._between([edge.back for edge in reversed(way[:steps])], graph, own))
        return (newest, back[-1][1]) if back else None

    def _between(self, way: Sequence[Edge], graph: PlaceGraph, own: int) -> Iterator[tuple[int, Loop]]:
        """Loops between one of the first nodes and one of the others, each with the steps of the way up to there."""
        for steps, loop in enumerate(loops_along(way, graph, self._model, self._places), 1):
            if loop is not None and (loop.node < own) != (loop.other < own):
                yield steps, loop

    def _chart(self, hybrid_map: HybridMap, kept: Mapping[tuple[int, ...], _Charted]) -> Chart:
        """The chart of a map, which may be one of those that were kept."""
        views = self._views.of_map(hybrid_map)
        every = ((a, b, arc.pose) for a, b, arc in hybrid_map.all_arcs())
        arcs = tuple((a, b, pose.mean.tobytes(), pose.covariance.tobytes()) for a, b, pose in every)
        found = kept.get(tuple(views))
        if found is None or not found.is_of(views.values(), arcs):
            found = _Charted(tuple(views.values()), arcs, chart_of(hybrid_map, views, self._features))
        self._charts[tuple(views)] = found
        return found.chart


def _divisions(hybrid_map: HybridMap) -> Iterator[tuple[HybridMap, HybridMap]]:
    """The map of the areas in which the robot was last, from the fewest on, and that of all in which it was before."""
    keyframes = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    areas = sorted((area for area, own in keyframes.items() if own), key=lambda area: max(keyframes[area]))
    for k in range(len(areas) - 1, 0, -1):
        if max(keyframes[areas[k - 1]]) < min(min(keyframes[area]) for area in areas[k:]):
            yield hybrid_map.part(areas[k:]), hybrid_map.part(areas[:k])


def _beside(one: Chart, other: Chart) -> Chart:
    """Two charts as one, in which no edge leads from the one to the other."""
    count = len(one.nodes)
    edges = (edge._replace(start=edge.start + count, end=edge.end + count) for edge in other.edges)
    return Chart(one.nodes + other.nodes, one.seen + other.seen, (*one.edges, *edges))


def _joining(chart: Chart, loop: Loop, begin: Loop, own: int) -> MapLoop:
    """A loop between a node of the first ones and another one, as it joins their areas.

    :param begin: the same loop where it begins.
    """
    quarters = loop.quarters if loop.node < own else -loop.quarters
    node, other = (chart.nodes[k] for k in sorted((loop.node, loop.other)))
    turned = PoseGaussian(np.array((0.0, 0.0, 0.5 * math.pi * quarters)), np.diag([_PLACED, _PLACED, _TURNED]) ** 2)
    back = PoseGaussian.exactly(other.pose).inverse()
    pose = PoseGaussian.exactly(node.pose).compose(turned).compose(back)
    return MapLoop(node.area, other.area, pose, chart.nodes[min(begin.node, begin.other)].area)


# Keyframes that are looked at ahead, at a time.
_AHEAD = 32

_TEXT = (
    "landmarks on the way from area {} to area {} are those up to area {}: a loop is looked for there, and nothing is "
    "to do"
)


class LoopProposals:
    """Supposes arcs."""

    def __init__(self, configuration: Configuration, views: AreaViews) -> None:
        """:param views: what areas show."""
        self._loops, self._views = MapLoops(configuration, views), views
        # Areas whose position is known this well, m, are told from others by the arcs, or looked for all the same.
        self._told_by_arcs = min(configuration.places.spacing, configuration.tsbi.prior_limit)
        self._untold: list[MapLoop] = []
        self._told: set[tuple[int, int]] = set()

    def proposed(self, hybrid_map: HybridMap) -> MapLoop | None:
        """The newest loop that landmarks propose and no arc closes; None for none."""
        loop = self._loops.newest(hybrid_map)
        return None if loop is None or telling_arc(hybrid_map, loop.area, loop.other) is not None else loop

    def supposed(self, hybrid_map: HybridMap, area: int) -> HybridMap:
        """The map with an arc where one is proposed; the map itself where none is, and where the arcs know all.

        :param area: the robot's.
        """
        loop = self.proposed(hybrid_map) if self._is_asked(hybrid_map, area) else None
        if loop is None:
            return hybrid_map
        self._untold.append(loop)
        supposed = hybrid_map.branch()
        supposed.set_arc(loop.area, loop.other, loop.pose, closure=False)
        return supposed

    def look_ahead(self, hybrid_map: HybridMap, area: int) -> None:
        """Between cuts, look up a part of what areas show, which the next cut would ask for.

        :param area: the robot's.
        """
        if self._is_asked(hybrid_map, area):
            areas = ((known, hybrid_map.keyframes(known)) for known in hybrid_map.area_ids())
            self._views.look_ahead(areas, _AHEAD)

    def _is_asked(self, hybrid_map: HybridMap, area: int) -> bool:
        """Whether the arcs leave open where an area is, seen from that of the robot."""
        return len(reached(hybrid_map, area, self._told_by_arcs**2).areas) < len(hybrid_map.area_ids())

    def notices(self) -> list[Notice]:
        """What was proposed since this was asked last, each pair of areas once."""
        new = {(loop.area, loop.other): loop for loop in self._untold if (loop.area, loop.other) not in self._told}
        self._untold.clear()
        self._told.update(new)
        return [Notice("tsbi", _TEXT.format(loop.begin, loop.area, loop.other)) for loop in new.values()]
