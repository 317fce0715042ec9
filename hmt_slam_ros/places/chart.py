"""The chart of an HMT map: doors and crossings along hallways, the edges between them, and the landmarks on these.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, Fig. 2. A node is the point in the middle of a driven hallway
before one or more openings. Openings of nearly the same point belong to one node: those of one door in several areas,
and those opposite each other. A node with an opening to another hallway is a crossing, others are doors. The end of a
hallway, where the robot has to turn, is a node that the paper does not have.

An edge is a segment of hallway between two nodes that was driven along completely and is still free. Its landmarks are
those of the hallway's walls. Positions are compared only within the neighborhood of one area, see floor.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters, PlaceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.places.area_views import AreaView
from hmt_slam_ros.places.edge_existence import edge_existence_probability
from hmt_slam_ros.places.floor import (
    DIRECTIONS,
    AlignedNeighborhood,
    SideOpening,
    ahead_and_beside,
    aligned_neighborhoods,
    find_side_openings,
)
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import EAST, NORTH, Edge, Node, PlaceGraph, build_place_graph, opposite_direction
from hmt_slam_ros.places.wall_landmarks import (
    HallwaySegment,
    KnownLandmarks,
    add_hallway_openings,
    known_landmarks_around,
    segment_landmarks,
)

DOOR, CROSSING, END = range(3)
"""Kinds of nodes."""

NODE_KIND_NAMES = ("door", "crossing", "end")
"""Names of the kinds."""

END_NODE_TO_WALL = 1.0
"""Distance from the node at the end of a hallway to the wall there, m."""

_SAME_NODE_DISTANCE = 0.6
"""Openings whose junction points are nearer than this, m, belong to one node."""

_MAX_GAP = 3.0
"""Longest gap between keyframes along a hallway that counts as driven, m."""

_MAX_LATERAL_OFFSET = 0.9
"""Largest distance of keyframes and nodes of a hallway from its middle, m."""

_MAX_DISTANCE_TO_END = 4.0
"""Largest distance from the last keyframe to the wall at the end of a hallway, m."""

_MAX_UNDRIVEN_DISTANCE = 1.0
"""Largest distance from the last keyframe to the next node, m."""

_MIN_EDGE_TO_END = 1.5
"""The end of a hallway nearer than this to its last node, m, is no node."""

_NODE_DEVIATION = 0.02
"""Deviation of a node's position in its area, m."""

_HALLWAY_DIRECTION_DEVIATION = 0.01
"""Deviation of the direction of a hallway, rad."""


class ChartNode(NamedTuple):
    """A node of the chart.

    :ivar area: in whose frame it is known.
    :ivar pose: shape (3,), ``area_T_node``, in the hallway's middle, with the heading north, m and rad.
    :ivar kind: one of the constants above.
    :ivar existence: probability that it exists.
    :ivar openings: the best known of every direction.
    """

    area: int
    pose: Float64
    kind: int
    existence: float
    openings: tuple[SideOpening, ...]


@dataclass(frozen=True, eq=False)
class Chart:
    """The places of an HMT map.

    :ivar nodes: crossings, doors, and ends of hallways.
    :ivar graph_nodes: the same as nodes of the place graph.
    :ivar edges: of the place graph, in both directions.
    """

    nodes: tuple[ChartNode, ...]
    graph_nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def name(self, node: int) -> str:
        """Name of a node by kind and number, such as "door 3"."""
        return f"{NODE_KIND_NAMES[self.nodes[node].kind]} {node}"

    def graph(self, places: PlaceParameters) -> PlaceGraph:
        """The place graph."""
        return build_place_graph(self.graph_nodes, self.edges, places)


class _NodeDraft(NamedTuple):
    """A node at a position (2,) in its area's neighborhood, with the landmarks (area, number) of its openings."""

    area: int
    position: Float64
    kind: int
    existence: float
    openings: tuple[SideOpening, ...]
    members: frozenset[tuple[int, int]]

    @property
    def directions(self) -> frozenset[int]:
        """Directions in which a hallway may go on: square to openings, and through those to a hallway."""
        ahead = {opening.direction for opening in self.openings if opening.leads_to_hallway}
        square = {(opening.direction + turn) % QUARTERS for opening in self.openings for turn in (1, 3)}
        return frozenset(square | ahead)


class _ChartEdge(NamedTuple):
    """An edge from one node to the next: mean and variance of its length, m and m^2."""

    start: int
    direction: int
    end: int
    distance: float
    variance: float

    @property
    def reverse(self) -> _ChartEdge:
        """The same edge in the other direction."""
        return self._replace(start=self.end, direction=opposite_direction(self.direction), end=self.start)


def build_chart(hybrid_map: HybridMap, views: Mapping[int, AreaView], features: FeatureParameters) -> Chart:
    """The chart of a map.

    :param views: {area: view} of all areas.
    """
    return _ChartBuilder(aligned_neighborhoods(hybrid_map, views), views, features).build()


class _ChartBuilder:
    """Builds a chart from the neighborhoods of areas."""

    def __init__(
        self,
        neighborhoods: Mapping[int, AlignedNeighborhood],
        views: Mapping[int, AreaView],
        features: FeatureParameters,
    ) -> None:
        self._neighborhoods, self._views, self._features = neighborhoods, views, features
        self._landmark_cache: dict[int, KnownLandmarks] = {}
        self._drafts = [_node_draft(group, self._junction_points(group)) for group in self._groups()]

    def build(self) -> Chart:
        """The chart."""
        chart_edges = self._find_edges()
        members = frozenset(member for draft in self._drafts for member in draft.members)
        ports = {port for edge in chart_edges for port in _ports(edge)}
        edges = [self._edge(edge, members) for edge in chart_edges]
        graph_nodes = tuple(self._node(k, ports, members) for k in range(len(self._drafts)))
        nodes = tuple(self._chart_node(draft) for draft in self._drafts)
        return Chart(nodes, graph_nodes, tuple(each for edge in edges for each in (edge, edge.reverse)))

    def _chart_node(self, draft: _NodeDraft) -> ChartNode:
        pose = se2.compose(self._neighborhoods[draft.area].origin, np.array((*draft.position, 0.5 * np.pi)))
        return ChartNode(draft.area, pose, draft.kind, draft.existence, draft.openings)

    def _groups(self) -> list[list[SideOpening]]:
        """The openings of each node."""
        openings = [
            opening
            for area, neighborhood in self._neighborhoods.items()
            for opening in find_side_openings(neighborhood, self._views[area].landmarks)
        ]
        import networkx  # noqa: PLC0415  mapping does without it, and it takes a fifth of a second

        same = networkx.Graph()
        same.add_nodes_from(range(len(openings)))
        for i, opening in enumerate(openings):
            for k, other in enumerate(openings[:i]):
                point = self._transform_point(other.area, other.junction_point, opening.area)
                if point is not None and np.hypot(*(point - opening.junction_point)) < _SAME_NODE_DISTANCE:
                    same.add_edge(i, k)
        return [[openings[k] for k in sorted(group)] for group in networkx.connected_components(same)]

    def _junction_points(self, group: Sequence[SideOpening]) -> Float64:
        """Junction points of a node's openings in the neighborhood of its home area, as far as known, shape (n, 2)."""
        points = (self._transform_point(each.area, each.junction_point, _home_area(group)) for each in group)
        return np.array([point for point in points if point is not None])

    def _transform_point(self, area: int, point: Float64, target: int) -> Float64 | None:
        """A point (2,) of the neighborhood of one area in that of another; None if its pose is unknown."""
        pose = self._neighborhoods[target].areas.get(area)
        if pose is None:
            return None
        target_T_area = se2.compose(pose.mean, self._neighborhoods[area].origin)
        return np.asarray(se2.transform(target_T_area, point[None])[0])

    def _find_edges(self) -> list[_ChartEdge]:
        """Edges to the north and the east, of conflicting ones the shortest; nodes are added at ends of hallways."""
        ports = [(k, direction) for k, draft in enumerate(self._drafts) for direction in sorted(draft.directions)]
        candidates = [edge for port in ports for edge in self._edge_to_next_node(*port)]
        taken: set[tuple[int, int]] = set()
        edges = []
        for edge in sorted(candidates, key=lambda edge: (edge.distance, edge.start, edge.direction)):
            if taken.isdisjoint(_ports(edge)):
                taken.update(_ports(edge))
                edges.append(edge)
        edges += [edge for port in ports if port not in taken for edge in self._edge_to_hallway_end(*port)]
        return [edge if edge.direction in {NORTH, EAST} else edge.reverse for edge in edges if self._exists(edge)]

    def _exists(self, edge: _ChartEdge) -> bool:
        """Whether the hallway of an edge is still free."""
        draft = self._drafts[edge.start]
        existence = edge_existence_probability(
            self._neighborhoods[draft.area], _hallway_segment(draft, edge), self._features
        )
        return existence >= self._features.landmark_least

    def _edge_to_next_node(self, k: int, direction: int) -> Iterator[_ChartEdge]:
        """The edge from a node in a direction to the next node; none or one."""
        far, _ = self._driven_extent(k, direction)
        found = min(self._nodes_ahead(k, direction, far + _MAX_UNDRIVEN_DISTANCE), default=None)
        if found is not None:
            distance, other = found
            yield _ChartEdge(k, direction, other, distance, self._variance(k, other, direction))

    def _edge_to_hallway_end(self, k: int, direction: int) -> Iterator[_ChartEdge]:
        """The edge from a node in a direction to the end of the hallway, which becomes a node; none or one."""
        draft = self._drafts[k]
        far, last = self._driven_extent(k, direction)
        wall = math.nan if last is None else float(self._neighborhoods[draft.area].free_distances[last, direction])
        distance = far + wall - END_NODE_TO_WALL
        if wall <= _MAX_DISTANCE_TO_END and distance > _MIN_EDGE_TO_END:
            end = draft.position + distance * DIRECTIONS[direction]
            self._drafts.append(_NodeDraft(draft.area, end, END, 1.0, (), frozenset()))
            yield _ChartEdge(k, direction, len(self._drafts) - 1, distance, 2.0 * _NODE_DEVIATION**2)

    def _driven_extent(self, k: int, direction: int) -> tuple[float, int | None]:
        """Length of the driven hallway ahead of a node, m, and the row of its last keyframe."""
        draft = self._drafts[k]
        neighborhood = self._neighborhoods[draft.area]
        ahead, beside = ahead_and_beside(neighborhood.positions - draft.position, direction)
        within = neighborhood.in_hallway[:, direction % 2] & (np.abs(beside) <= _MAX_LATERAL_OFFSET) & (ahead > 0.0)
        rows = np.flatnonzero(within)
        far, last = 0.0, None
        for row in rows[np.argsort(ahead[rows], kind="stable")].tolist():
            if ahead[row] - far > _MAX_GAP:
                break
            far, last = float(ahead[row]), row
        return far, last

    def _nodes_ahead(self, k: int, direction: int, far: float) -> Iterator[tuple[float, int]]:
        """Distances and numbers of the nodes along a hallway, up to a distance, m."""
        draft = self._drafts[k]
        for number, other in enumerate(self._drafts):
            point = self._transform_point(other.area, other.position, draft.area)
            if number == k or point is None or direction not in other.directions:
                continue
            ahead, beside = ahead_and_beside(point - draft.position, direction)
            if _SAME_NODE_DISTANCE < ahead <= far and abs(beside) <= _MAX_LATERAL_OFFSET:
                yield float(ahead), number

    def _variance(self, k: int, number: int, direction: int) -> float:
        """Variance of the distance between two nodes, m^2."""
        draft, other = self._drafts[k], self._drafts[number]
        pose = self._neighborhoods[draft.area].areas[other.area]
        point = se2.compose(self._neighborhoods[other.area].origin, np.array((*other.position, 0.0)))
        belief = pose.compose(PoseGaussian.from_pose(point))
        along = se2.transform(np.array((0.0, 0.0, -belief.mean[2])), DIRECTIONS[direction][None])[0]
        return float(along @ belief.covariance[:2, :2] @ along) + 2.0 * _NODE_DEVIATION**2

    def _landmarks_around(self, area: int) -> KnownLandmarks:
        if area not in self._landmark_cache:
            landmarks = {other: view.landmarks for other, view in self._views.items()}
            self._landmark_cache[area] = known_landmarks_around(self._neighborhoods[area].areas, landmarks)
        return self._landmark_cache[area]

    def _edge(self, edge: _ChartEdge, members: frozenset[tuple[int, int]]) -> Edge:
        """An edge of the place graph."""
        draft = self._drafts[edge.start]
        landmarks = segment_landmarks(
            self._landmarks_around(draft.area), self._neighborhoods[draft.area], _hallway_segment(draft, edge), members
        )
        distance, turn = (edge.distance, edge.variance), (0.0, _HALLWAY_DIRECTION_DEVIATION**2)
        return Edge(edge.start, edge.direction, edge.end, edge.direction, distance, turn, landmarks)

    def _node(self, k: int, ports: set[tuple[int, int]], members: frozenset[tuple[int, int]]) -> Node:
        """A node of the place graph: its openings, and the landmarks ahead and back where it has no edge.

        :param ports: (node, direction) of both ends of all edges.
        """
        draft = self._drafts[k]
        sequences = []
        for direction in (NORTH, EAST):
            begin = 0.0 if (k, opposite_direction(direction)) in ports else -np.inf
            end = 0.0 if (k, direction) in ports else np.inf
            segment = HallwaySegment(draft.position, direction, begin, end)
            around, neighborhood = self._landmarks_around(draft.area), self._neighborhoods[draft.area]
            landmarks = segment_landmarks(around, neighborhood, segment, members, draft.members)
            has_edge = not math.isinf(begin) or not math.isinf(end)
            sides = [d for d in (direction - 1, direction + 1) if has_edge and (k, d % QUARTERS) in ports]
            sequences.append(add_hallway_openings(landmarks, neighborhood, draft.position, direction, sides))
        return Node(draft.existence, *sequences)


def _ports(edge: _ChartEdge) -> tuple[tuple[int, int], tuple[int, int]]:
    """(node, direction) in which an edge is entered at either end."""
    return (edge.start, edge.direction), (edge.end, opposite_direction(edge.direction))


def _node_draft(group: Sequence[SideOpening], points: Float64) -> _NodeDraft:
    """The node of a group of openings, in the neighborhood of its home area.

    :param points: shape (n, 2), junction points in that neighborhood, m.
    """
    best: dict[int, SideOpening] = {}
    for opening in sorted(group, key=_detection_rank, reverse=True):
        best.setdefault(opening.direction, opening)
    openings = tuple(best[direction] for direction in sorted(best))
    kind = CROSSING if any(opening.leads_to_hallway for opening in openings) else DOOR
    existence = max(opening.landmark.existence.probability for opening in openings)
    members = frozenset((opening.area, opening.number) for opening in group)
    return _NodeDraft(_home_area(group), points.mean(axis=0), kind, existence, openings, members)


def _home_area(group: Sequence[SideOpening]) -> int:
    """The area of the opening that was detected most often."""
    return max(group, key=_detection_rank).area


def _detection_rank(opening: SideOpening) -> tuple[int, float]:
    """Detections first: an opening that was detected once, from afar, may exist for certain and yet be misplaced."""
    return opening.landmark.existence.detections, opening.landmark.existence.probability


def _hallway_segment(draft: _NodeDraft, edge: _ChartEdge) -> HallwaySegment:
    return HallwaySegment(draft.position, edge.direction, 0.0, edge.distance)
