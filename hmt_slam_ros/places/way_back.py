"""The robot's way through stored areas, place by place on a chart, and the belief of who goes it again.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.5. Nothing is asked of the robot: at each node of its way the belief
is told what the map has there, and between nodes how long the map says that the way is. So the belief has a peak where
the way lies in the map, and a second one where the map holds the same places another time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.places import Places
from hmt_slam_ros.places.chart import Chart, ChartNode
from hmt_slam_ros.places.observation import ObservationModel, reach_of
from hmt_slam_ros.places.observation_graph import QUARTERS, Landmarks, chosen
from hmt_slam_ros.places.place_graph import Edge, PlaceGraph, state_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel
from hmt_slam_ros.places.twin_peaks import Loop, TwinPeaks, belief_of_twins
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable
from hmt_slam_ros.topology.surroundings import positions

# Keyframes that are so near to a node are at it, m.
_AT = 1.0
# Deviation of a node's place in the map, m.
_PLACED = 0.03


def ways(hybrid_map: HybridMap, chart: Chart) -> list[list[Edge]]:
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
    keyframes, places = _around(hybrid_map, node.area)
    order = np.argsort(keyframes)
    away = np.hypot(*(places[order] - node.pose[:2]).T)
    near = away <= _AT
    for row in np.split(np.arange(len(order)), np.flatnonzero(near[1:] != near[:-1]) + 1):
        if near[row[0]]:
            yield int(keyframes[order[row[np.argmin(away[row])]]]), number


def _around(hybrid_map: HybridMap, area: int) -> tuple[Float64, Float64]:
    """All keyframes (n,) and their places (n, 2) in the frame of an area."""
    known = reachable(hybrid_map, area)
    keyframes = [np.array(list(hybrid_map.keyframes(other))) for other in known]
    places = [positions(hybrid_map, other, pose.mean) for other, pose in known.items()]
    return np.concatenate(keyframes), np.concatenate(places)


def loops_along(
    way: Sequence[Edge], graph: PlaceGraph, model: ObservationModel, places: Places
) -> Iterator[Loop | None]:
    """At every node of a way, the loop that the belief proposes there; else None.

    :param way: edges of the graph, each from where the one before ends.
    """
    belief, twins, heading = belief_of_twins(graph, places), TwinPeaks(), None
    for edge in way:
        if edge.leaving != heading:
            quarters = 0 if heading is None else (edge.leaving - heading) % QUARTERS
            belief = _looked(belief.turned(quarters) if quarters else belief, edge.start, edge.leaving, 0.0, model)
        belief, heading = _gone(belief, edge, model), edge.arriving
        yield twins.after_transition(belief)


def _gone(belief: PositionBelief, edge: Edge, model: ObservationModel) -> PositionBelief:
    """Along an edge to its end. What is seen at one look is not seen again at the next."""
    for away in np.arange(2.0 * model.reach, edge.distance[0] - 2.0 * model.reach, 2.0 * model.reach).tolist():
        belief = _looked(belief, edge.start, edge.leaving, away, model)
    travel = Travel(edge.distance[0], edge.turn[0], (edge.distance[1], edge.turn[1]))
    return _looked(belief.arrived(travel), edge.end, edge.arriving, 0.0, model)


def _looked(belief: PositionBelief, node: int, heading: int, away: float, model: ObservationModel) -> PositionBelief:
    """After a look at what the map has so far beyond a node, m."""
    expected = belief.graph.expected
    state = state_of(node, heading)
    own = chosen(expected.landmarks, slice(*expected.starts[state : state + 2].tolist()))
    return belief.observed(_in_sight(own._replace(along=own.along - away), model), model, away, _PLACED**2)


def _in_sight(landmarks: Landmarks, model: ObservationModel) -> Landmarks:
    """Those of a list that are in sight from its begin."""
    pairs = zip(landmarks.tracks.tolist(), landmarks.forms.tolist(), strict=True)
    low, high = np.array([reach_of(track, form, model.reach) for track, form in pairs]).reshape(-1, 2).T
    return chosen(landmarks, (low <= landmarks.along) & (landmarks.along <= high))
