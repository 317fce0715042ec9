"""The loop detector of Tomatis et al. (2003), section 3.5: two peaks that move in the same way.

A map that holds a place twice gives the belief two peaks of which neither loses the other. Where both moved in the same
way for three state transitions in a row, a loop is proposed: where the one is and where the other is, is one place. Nor
do two peaks tell anything of which one follows the other along the same hallway: there it is not certain how far the
robot is.

The two entries of one place never hold quite the same landmarks, and a belief that trusts its landmarks soon decides
for one of them. That the robot is at the one is no evidence against the other being the same place. So the second peak
is not weighed against the first one, but against all that is left without that: the other places of the map, and ground
that the map does not hold. That is most probable at first, since a place is seldom in the map twice; and nothing slips
from peak to peak, which would have every place begin anew at each transition.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5. Nothing is asked of the robot: at each node of its way the belief
is told what the map has there, and between nodes how long the map says that the way is. So the belief has a peak where
the way lies in the map, and a second one where the map holds the same places another time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import PlaceParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.places.area_views import AreaView, AreaViewCache
from hmt_slam_ros.places.chart import Chart, ChartNode, build_chart
from hmt_slam_ros.places.observation import ObservationModel, observation_model, visible_interval
from hmt_slam_ros.places.observation_graph import QUARTERS, LandmarkSequence, select_landmarks
from hmt_slam_ros.places.place_graph import Edge, PlaceGraph, heading_of, node_of, state_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, uniform_belief

TRANSITIONS = 3
"""In a row in which both peaks have to move in the same way."""

_SLIP = 1e-9


class LoopCandidate(NamedTuple):
    """Two places of the map that are one.

    :ivar node: of the higher peak.
    :ivar other_node: of the second one.
    :ivar quarters: how far the other's north is turned to the right against that of the first.
    """

    node: int
    other_node: int
    quarters: int


def initial_loop_belief(graph: PlaceGraph, places: PlaceParameters) -> PositionBelief:
    """The belief whose peaks are followed, before anything was seen.

    A place is in the map a second time with the probability of coming from unknown ground to known one.
    """
    return uniform_belief(graph, replace(places, slip=_SLIP, unmapped=1.0 - places.discovery))


class TwoPeakTracker:
    """Follows the two highest peaks of a belief from transition to transition."""

    def __init__(self) -> None:
        self._trails: tuple[list[int], list[int]] | None = None

    def update(self, belief: PositionBelief) -> LoopCandidate | None:
        """A loop that the belief after an arrival, and after what was seen there, proposes; else None."""
        peaks = _two_peaks(belief)
        if peaks is None:
            self._trails = None
            return None
        self._trails = self._extend_trails(peaks, belief.graph)
        first, second = self._trails
        if len(first) <= TRANSITIONS or set(map(node_of, first)) & set(map(node_of, second)):
            return None
        best = sorted((first[-1], second[-1]), key=lambda state: -belief.log_probabilities[state])
        return LoopCandidate(node_of(best[0]), node_of(best[1]), _relative_quarters(best[0], best[1]))

    def _extend_trails(self, peaks: tuple[int, int], graph: PlaceGraph) -> tuple[list[int], list[int]]:
        """The trails of both peaks, of which the older part is left out; new ones where they did not both move on."""
        if self._trails is not None:
            first, second = self._trails
            for one, other in (peaks, peaks[::-1]):
                moved = _has_transition(graph, first[-1], one) and _has_transition(graph, second[-1], other)
                if moved and _relative_quarters(first[-1], one) == _relative_quarters(second[-1], other):
                    return [*first[-TRANSITIONS:], one], [*second[-TRANSITIONS:], other]
        return [peaks[0]], [peaks[1]]


def _two_peaks(belief: PositionBelief) -> tuple[int, int] | None:
    """The highest peak of a belief, and the one that is all that is left without it; both of them in the map."""
    first, second = np.argsort(-belief.log_probabilities, kind="stable")[:2].tolist()
    left = float(np.delete(belief.probabilities, first).sum())
    twin = left > 0.0 and belief.probabilities[second] >= belief.places.twin_share * left
    return (first, second) if twin and belief.graph.state_count not in {first, second} else None


def _has_transition(graph: PlaceGraph, source: int, target: int) -> bool:
    """Whether an arc leads from the one state to the other."""
    arcs = graph.transitions
    return bool(np.any((arcs.sources == source) & (arcs.targets == target)))


def _relative_quarters(source: int, target: int) -> int:
    """Quarters to the right from the heading of one state to that of another."""
    return (heading_of(target) - heading_of(source)) % QUARTERS


# Keyframes that are so near to a node are at it, m.
_NODE_RADIUS = 1.0
# Deviation of a node's place in the map, m.
_PLACED = 0.03


def traversed_paths(hybrid_map: HybridMap, chart: Chart) -> list[list[Edge]]:
    """The robot's way from node to node, in pieces; a new one begins where the chart has no edge to the next node.

    :param hybrid_map: of which the chart is.
    """
    edges = {(edge.start, edge.end): edge for edge in chart.edges}
    found: list[list[Edge]] = [[]]
    last: int | None = None
    for _, node in sorted(each for k, one in enumerate(chart.nodes) for each in _visits(hybrid_map, one, k)):
        if last is not None and node != last:
            edge = edges.get((last, node))
            if edge is not None:
                found[-1].append(edge)
            elif found[-1]:
                found.append([])
        last = node
    return [way for way in found if way]


def _visits(hybrid_map: HybridMap, node: ChartNode, number: int) -> Iterator[tuple[int, int]]:
    """(keyframe, number) of every time that the robot was at a node: of keyframes in a row the nearest."""
    keyframes, places = _keyframes_around(hybrid_map, node.area)
    order = np.argsort(keyframes)
    away = np.hypot(*(places[order] - node.pose[:2]).T)
    near = away <= _NODE_RADIUS
    for row in np.split(np.arange(len(order)), np.flatnonzero(near[1:] != near[:-1]) + 1):
        if near[row[0]]:
            yield int(keyframes[order[row[np.argmin(away[row])]]]), number


def _keyframes_around(hybrid_map: HybridMap, area: int) -> tuple[Float64, Float64]:
    """All keyframes (n,) and their places (n, 2) in the frame of an area."""
    known = shortest_path_beliefs(hybrid_map, area)
    keyframes = [np.array(list(hybrid_map.keyframes(other))) for other in known]
    places = [keyframe_positions(hybrid_map, other, pose.mean) for other, pose in known.items()]
    return np.concatenate(keyframes), np.concatenate(places)


def detect_loops(
    way: Sequence[Edge], graph: PlaceGraph, model: ObservationModel, places: PlaceParameters
) -> Iterator[LoopCandidate | None]:
    """At every node of a way, the loop that the belief proposes there; else None.

    :param way: edges of the graph, each from where the one before ends.
    """
    belief, twins, heading = initial_loop_belief(graph, places), TwoPeakTracker(), None
    for edge in way:
        if edge.start_direction != heading:
            quarters = 0 if heading is None else (edge.start_direction - heading) % QUARTERS
            belief = _update_at_node(
                belief.predict_turn(quarters) if quarters else belief, edge.start, edge.start_direction, 0.0, model
            )
        belief, heading = _follow_edge(belief, edge, model), edge.end_direction
        yield twins.update(belief)


def _follow_edge(belief: PositionBelief, edge: Edge, model: ObservationModel) -> PositionBelief:
    """Along an edge to its end. What is seen at one look is not seen again at the next."""
    for away in np.arange(2.0 * model.reach, edge.distance[0] - 2.0 * model.reach, 2.0 * model.reach).tolist():
        belief = _update_at_node(belief, edge.start, edge.start_direction, away, model)
    travel = Travel(edge.distance[0], edge.turn[0], (edge.distance[1], edge.turn[1]))
    return _update_at_node(belief.predict_arrival(travel), edge.end, edge.end_direction, 0.0, model)


def _update_at_node(
    belief: PositionBelief, node: int, heading: int, away: float, model: ObservationModel
) -> PositionBelief:
    """After a look at what the map has so far beyond a node, m."""
    expected = belief.graph.expected_landmarks
    state = state_of(node, heading)
    own = select_landmarks(expected.landmarks, slice(*expected.starts[state : state + 2].tolist()))
    return belief.update(
        _visible_landmarks(own._replace(positions=own.positions - away), model), model, away, _PLACED**2
    )


def _visible_landmarks(landmarks: LandmarkSequence, model: ObservationModel) -> LandmarkSequence:
    """Those of a list that are in sight from its begin."""
    pairs = zip(landmarks.tracks.tolist(), landmarks.forms.tolist(), strict=True)
    low, high = np.array([visible_interval(track, form, model.reach) for track, form in pairs]).reshape(-1, 2).T
    return select_landmarks(landmarks, (low <= landmarks.positions) & (landmarks.positions <= high))


# Of the robot's way so many transitions are enough.
_MAX_TRANSITIONS = 3 * TRANSITIONS
# Deviations of a node's place against its twin's, m, and of its axes, rad. Of 12 twins in institutes of training seeds
# the largest errors are 0.13 m and 0.2 degrees, the mean ones 0.03 m and 0.1 degrees.
_TWIN_DEVIATION, _HEADING_DEVIATION = 0.1, math.radians(0.5)


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
        np.array((0.0, 0.0, 0.5 * math.pi * quarters)), np.diag([_TWIN_DEVIATION, _TWIN_DEVIATION, _HEADING_DEVIATION]) ** 2
    )
    back = PoseGaussian.from_pose(other.pose).inverse()
    pose = PoseGaussian.from_pose(node.pose).compose(turned).compose(back)
    return AreaLoop(node.area, other.area, pose, chart.nodes[min(begin.node, begin.other_node)].area)
