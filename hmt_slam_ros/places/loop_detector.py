"""Loop detection by the belief over places: two peaks that move in the same way.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5. Where a map holds a place twice, the belief over places keeps two
peaks. If both move in the same way for three transitions in a row, their places are proposed to be one. Two peaks of
one hallway, of which one follows the other, do not count.

The second peak is not weighed against the first one, but against all that remains without it: other places and unknown
ground. Otherwise a belief that trusts its landmarks would soon decide for one of the two entries of a place.

Here the belief follows the robot's path over the stored map:

1. The areas of the robot's newest path make one chart, all earlier areas another one. So no prior by the arcs relates
   their nodes.
2. At each node of the path the belief observes what the map has there, over both charts together.
3. Where the two peaks propose a loop, an area of the one chart is joined to an area of the other.
4. The loop has to show along the reversed path, too. The paper's robot turns back for that.

A proposal is no evidence. Keyframes are then matched in the known areas, and the matches decide
(topological_inference/closure_search.py).
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
from hmt_slam_ros.places.observation_graph import (
    QUARTER_TURN,
    QUARTERS,
    LandmarkSequence,
    select_landmarks,
    shift_ahead,
)
from hmt_slam_ros.places.place_graph import Edge, PlaceGraph, heading_of, node_of, state_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, uniform_belief

TRANSITIONS = 3
"""Transitions in a row in which both peaks have to move in the same way (section 3.5)."""

_SLIP = 1e-9
"""Slip of the belief: larger ones would restart the second peak at each transition."""

_NODE_RADIUS = 1.0
"""Largest distance of a keyframe from the node that the robot visits there, m."""

_NODE_DEVIATION = 0.03
"""Deviation of a node's position in the map, m."""

_MAX_TRANSITIONS = 3 * TRANSITIONS
"""Transitions of the robot's newest path that are searched."""

_TWIN_DEVIATION = 0.1
"""Deviation of a node's position from its twin, m; the largest error of 12 twins in training worlds is 0.13 m."""

_TWIN_HEADING_DEVIATION = math.radians(0.5)
"""Deviation of the axes of two twins, rad; the largest error of the same is 0.2 degrees."""


class LoopCandidate(NamedTuple):
    """Two nodes that may be one place.

    :ivar node: of the higher peak.
    :ivar other_node: of the second one.
    :ivar quarters: rotation of the other's north against that of the first, in quarters to the right.
    """

    node: int
    other_node: int
    quarters: int


def initial_loop_belief(graph: PlaceGraph, places: PlaceParameters) -> PositionBelief:
    """The belief whose peaks are tracked, before the first observation.

    A place is in the map twice with the probability of a transition from unknown to known ground.
    """
    return uniform_belief(graph, replace(places, slip=_SLIP, unmapped=1.0 - places.discovery))


class TwoPeakTracker:
    """Tracks the two highest peaks of a belief over transitions."""

    def __init__(self) -> None:
        self._trails: tuple[list[int], list[int]] | None = None

    def update(self, belief: PositionBelief) -> LoopCandidate | None:
        """The loop proposed by the belief after an arrival and its observation; None for none."""
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
        """The last states of both peaks; new trails where they did not both move in the same way."""
        if self._trails is not None:
            first, second = self._trails
            for a, b in (peaks, peaks[::-1]):
                moved = _has_transition(graph, first[-1], a) and _has_transition(graph, second[-1], b)
                if moved and _relative_quarters(first[-1], a) == _relative_quarters(second[-1], b):
                    return [*first[-TRANSITIONS:], a], [*second[-TRANSITIONS:], b]
        return [peaks[0]], [peaks[1]]


def _two_peaks(belief: PositionBelief) -> tuple[int, int] | None:
    """The highest peak, and the one with most of the remaining probability; None unless both are in the map."""
    first, second = np.argsort(-belief.log_probabilities, kind="stable")[:2].tolist()
    rest = float(np.delete(belief.probabilities, first).sum())
    twin = rest > 0.0 and belief.probabilities[second] >= belief.places.twin_share * rest
    return (first, second) if twin and belief.graph.state_count not in {first, second} else None


def _has_transition(graph: PlaceGraph, source: int, target: int) -> bool:
    """Whether the graph has a transition between two states."""
    arcs = graph.transitions
    return bool(np.any((arcs.sources == source) & (arcs.targets == target)))


def _relative_quarters(source: int, target: int) -> int:
    """Quarters to the right from the heading of one state to that of another."""
    return (heading_of(target) - heading_of(source)) % QUARTERS


def traversed_paths(hybrid_map: HybridMap, chart: Chart) -> list[list[Edge]]:
    """The robot's path over the edges of a chart, in parts; a new one begins where no edge leads to the next node.

    :param hybrid_map: of the chart.
    """
    edges = {(edge.start, edge.end): edge for edge in chart.edges}
    paths: list[list[Edge]] = [[]]
    last: int | None = None
    visits = sorted(visit for k, node in enumerate(chart.nodes) for visit in _visits(hybrid_map, node, k))
    for _, number in visits:
        if last is not None and number != last:
            edge = edges.get((last, number))
            if edge is not None:
                paths[-1].append(edge)
            elif paths[-1]:
                paths.append([])
        last = number
    return [path for path in paths if path]


def _visits(hybrid_map: HybridMap, node: ChartNode, number: int) -> Iterator[tuple[int, int]]:
    """(keyframe, number) of each visit of a node, with the nearest of the keyframes in a row."""
    keyframes, positions = _keyframes_around(hybrid_map, node.area)
    order = np.argsort(keyframes)
    distances = np.hypot(*(positions[order] - node.pose[:2]).T)
    near = distances <= _NODE_RADIUS
    for run in np.split(np.arange(len(order)), np.flatnonzero(near[1:] != near[:-1]) + 1):
        if near[run[0]]:
            yield int(keyframes[order[run[np.argmin(distances[run])]]]), number


def _keyframes_around(hybrid_map: HybridMap, area: int) -> tuple[Float64, Float64]:
    """All keyframes (n,) and their positions (n, 2) in the frame of an area, m."""
    areas = shortest_path_beliefs(hybrid_map, area)
    keyframes = [np.array(list(hybrid_map.keyframes(other))) for other in areas]
    positions = [keyframe_positions(hybrid_map, other, pose.mean) for other, pose in areas.items()]
    return np.concatenate(keyframes), np.concatenate(positions)


def detect_loops(
    path: Sequence[Edge], graph: PlaceGraph, model: ObservationModel, places: PlaceParameters
) -> Iterator[LoopCandidate | None]:
    """The loop that the belief proposes at each node of a path, or None.

    :param path: edges of the graph, each from the end of the one before.
    """
    belief, tracker, heading = initial_loop_belief(graph, places), TwoPeakTracker(), None
    for edge in path:
        if edge.start_direction != heading:
            quarters = 0 if heading is None else (edge.start_direction - heading) % QUARTERS
            belief = belief.predict_turn(quarters) if quarters else belief
            belief = _observe_map(belief, edge.start, edge.start_direction, 0.0, model)
        belief, heading = _follow_edge(belief, edge, model), edge.end_direction
        yield tracker.update(belief)


def _follow_edge(belief: PositionBelief, edge: Edge, model: ObservationModel) -> PositionBelief:
    """The belief at the end of an edge; each landmark is observed once."""
    for distance in np.arange(2.0 * model.reach, edge.distance[0] - 2.0 * model.reach, 2.0 * model.reach).tolist():
        belief = _observe_map(belief, edge.start, edge.start_direction, distance, model)
    travel = Travel(edge.distance[0], edge.turn[0], (edge.distance[1], edge.turn[1]))
    return _observe_map(belief.predict_arrival(travel), edge.end, edge.end_direction, 0.0, model)


def _observe_map(
    belief: PositionBelief, node: int, heading: int, distance: float, model: ObservationModel
) -> PositionBelief:
    """The belief after an observation of what the map has at a distance past a node, m."""
    expected = belief.graph.expected_landmarks.of_state(state_of(node, heading))
    observed = _visible_landmarks(shift_ahead(expected, -distance), model)
    return belief.update(observed, model, distance, _NODE_DEVIATION**2)


def _visible_landmarks(landmarks: LandmarkSequence, model: ObservationModel) -> LandmarkSequence:
    """The landmarks that are visible from the origin."""
    pairs = zip(landmarks.tracks.tolist(), landmarks.forms.tolist(), strict=True)
    low, high = np.array([visible_interval(track, form, model.reach) for track, form in pairs]).reshape(-1, 2).T
    return select_landmarks(landmarks, (low <= landmarks.positions) & (landmarks.positions <= high))


class AreaLoop(NamedTuple):
    """Two areas that a loop joins.

    :ivar area: of the robot's newest path.
    :ivar other_area: an earlier one.
    :ivar pose: belief over ``area_T_other``.
    :ivar first_area: the area of the newest path in which the loop begins.
    """

    area: int
    other_area: int
    pose: PoseGaussian
    first_area: int


class _CachedChart(NamedTuple):
    """A chart, with the views and arcs that it was made of."""

    views: tuple[AreaView, ...]
    arcs: tuple[tuple[int, int, bytes, bytes], ...]
    chart: Chart

    def is_current(self, views: Iterable[AreaView], arcs: tuple[tuple[int, int, bytes, bytes], ...]) -> bool:
        """Whether the chart is made of these."""
        return arcs == self.arcs and all(own is other for own, other in zip(self.views, views, strict=True))


class AreaLoopDetector:
    """Searches maps for loops; caches the charts of the last search."""

    def __init__(self, configuration: Configuration, views: AreaViewCache) -> None:
        self._features, self._places, self._views = configuration.features, configuration.places, views
        self._model = observation_model(configuration.places, configuration.features)
        self._charts: dict[tuple[int, ...], _CachedChart] = {}

    def newest_loop(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """The newest loop between the robot's newest path and earlier areas; None for none."""
        cache, self._charts = self._charts, {}
        for newest, earlier in _temporal_splits(hybrid_map):
            chart = self._chart(newest, cache)
            paths = traversed_paths(newest, chart)
            if max(map(len, paths), default=0) >= TRANSITIONS:
                union = _disjoint_union(chart, self._chart(earlier, cache))
                graph, count = union.graph(self._places), len(chart.nodes)
                loops = [pair for path in paths if (pair := self._confirm_in_reverse(path, graph, count)) is not None]
                if loops:
                    return _area_loop(union, *loops[-1], count)
            if sum(map(len, paths)) >= _MAX_TRANSITIONS:
                break
        return None

    def _confirm_in_reverse(
        self, path: Sequence[Edge], graph: PlaceGraph, count: int
    ) -> tuple[LoopCandidate, LoopCandidate] | None:
        """The newest loop on a path between the first ``count`` nodes and others, and the same at its begin."""
        forward = list(self._loops_between(path, graph, count))
        if not forward:
            return None
        steps, newest = forward[-1]
        backward = list(self._loops_between([edge.reverse for edge in reversed(path[:steps])], graph, count))
        return (newest, backward[-1][1]) if backward else None

    def _loops_between(
        self, path: Sequence[Edge], graph: PlaceGraph, count: int
    ) -> Iterator[tuple[int, LoopCandidate]]:
        """Loops on a path between the first ``count`` nodes and others, each with its number of edges up to there."""
        for steps, loop in enumerate(detect_loops(path, graph, self._model, self._places), 1):
            if loop is not None and (loop.node < count) != (loop.other_node < count):
                yield steps, loop

    def _chart(self, hybrid_map: HybridMap, cache: Mapping[tuple[int, ...], _CachedChart]) -> Chart:
        """The chart of a map, of the cache if it is current."""
        views = self._views.views_of_map(hybrid_map)
        poses = ((a, b, arc.pose) for a, b, arc in hybrid_map.all_arcs())
        arcs = tuple((a, b, pose.mean.tobytes(), pose.covariance.tobytes()) for a, b, pose in poses)
        cached = cache.get(tuple(views))
        if cached is None or not cached.is_current(views.values(), arcs):
            cached = _CachedChart(tuple(views.values()), arcs, build_chart(hybrid_map, views, self._features))
        self._charts[tuple(views)] = cached
        return cached.chart


def _temporal_splits(hybrid_map: HybridMap) -> Iterator[tuple[HybridMap, HybridMap]]:
    """Maps of the newest areas, from one on, each with the map of all areas that are earlier throughout."""
    keyframes = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    areas = sorted((area for area in keyframes if keyframes[area]), key=lambda area: max(keyframes[area]))
    for k in range(len(areas) - 1, 0, -1):
        if max(keyframes[areas[k - 1]]) < min(min(keyframes[area]) for area in areas[k:]):
            yield hybrid_map.subgraph(areas[k:]), hybrid_map.subgraph(areas[:k])


def _disjoint_union(first: Chart, second: Chart) -> Chart:
    """Two charts as one, without edges between them."""
    count = len(first.nodes)
    edges = (edge._replace(start=edge.start + count, end=edge.end + count) for edge in second.edges)
    return Chart(first.nodes + second.nodes, first.graph_nodes + second.graph_nodes, (*first.edges, *edges))


def _area_loop(chart: Chart, loop: LoopCandidate, begin: LoopCandidate, count: int) -> AreaLoop:
    """The areas that a loop joins, between one of the first ``count`` nodes and another one.

    :param begin: the same loop at its begin.
    """
    quarters = loop.quarters if loop.node < count else -loop.quarters
    node, other = (chart.nodes[k] for k in sorted((loop.node, loop.other_node)))
    deviations = np.array((_TWIN_DEVIATION, _TWIN_DEVIATION, _TWIN_HEADING_DEVIATION))
    turned = PoseGaussian(np.array((0.0, 0.0, QUARTER_TURN * quarters)), np.diag(deviations) ** 2)
    back = PoseGaussian.from_pose(other.pose).inverse()
    pose = PoseGaussian.from_pose(node.pose).compose(turned).compose(back)
    return AreaLoop(node.area, other.area, pose, chart.nodes[min(begin.node, begin.other_node)].area)
