"""The chart of an HMT map: crossings of hallways and doors, the ways between them, and the landmarks beside these.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, Fig. 2. A node is where one or more openings lead off a hallway
that the robot drove along: the place before them in the hallway's middle. Openings of nearly the same place are of one
node. So a door is one node that several areas know; so are two openings opposite each other, and the mouth of a
hallway with what it leads to on both sides. A node with an opening to another hallway is a crossing, others are doors.
The end of a hallway is a node, too, where the robot has to turn; it is none of the paper's states.

An edge is a stretch of hallway between two nodes all of which was driven along and that nothing closed since; the
landmarks on it are those of the hallway's walls. Places are compared only within what is around one area, see floor.py.
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
"""What a node is."""

NODE_KIND_NAMES = ("door", "crossing", "end")
"""Their names."""

END_NODE_TO_WALL = 1.0
"""So far before the wall at the end of a hallway, m, is the node there, where a robot turns."""

# Places nearer to each other than this, m, are one node.
_SAME = 0.6
# A hallway was driven along without a gap longer than this, m, within so much of its middle, m; its end is so far
# behind the last keyframe, and the next node beyond what was driven along, m, at most.
_GAP, _MIDDLE, _END, _MAX_UNDRIVEN_DISTANCE = 3.0, 0.9, 4.0, 1.0
# An end that is nearer than this to the last node, m, is none of its own.
_APART = 1.5
# Deviation of a node's place in its area, m, and of the direction of a hallway, rad.
_PLACED, _STRAIGHT = 0.02, 0.01


class ChartNode(NamedTuple):
    """A node.

    :ivar area: in whose frame it is known.
    :ivar pose: shape (3,), ``area_T_node``, in the hallway's middle, with the heading north, m and rad.
    :ivar kind: one of the constants above.
    :ivar existence: probability that it is there.
    :ivar openings: that lead off there, the best known of every direction.
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
    :ivar graph_nodes: the same as nodes of the graph of places.
    :ivar edges: of that graph, in both directions.
    """

    nodes: tuple[ChartNode, ...]
    graph_nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def name(self, node: int) -> str:
        """Such as "door 3"; the numbers are those of the nodes, of whatever kind."""
        return f"{NODE_KIND_NAMES[self.nodes[node].kind]} {node}"

    def graph(self, places: PlaceParameters) -> PlaceGraph:
        """The graph of places."""
        return build_place_graph(self.graph_nodes, self.edges, places)


class _NodeDraft(NamedTuple):
    """A node, (2,), in the frame of its area's floor, with the landmarks (area, number) that it is made of."""

    area: int
    position: Float64
    kind: int
    existence: float
    openings: tuple[SideOpening, ...]
    members: frozenset[tuple[int, int]]

    @property
    def directions(self) -> frozenset[int]:
        """In which a hallway may lead on."""
        found = {turned % QUARTERS for one in self.openings for turned in (one.direction + 1, one.direction + 3)}
        return frozenset(found | {one.direction for one in self.openings if one.leads_to_hallway})


class _ChartEdge(NamedTuple):
    """From one node to the next: mean and variance of the distance."""

    start: int
    direction: int
    end: int
    distance: float
    variance: float

    @property
    def reverse(self) -> _ChartEdge:
        """The same way in the other direction."""
        return self._replace(start=self.end, direction=opposite_direction(self.direction), end=self.start)


def build_chart(hybrid_map: HybridMap, views: Mapping[int, AreaView], features: FeatureParameters) -> Chart:
    """The chart of a map.

    :param views: {area: what it shows}, of all areas.
    """
    return _ChartBuilder(aligned_neighborhoods(hybrid_map, views), views, features).build()


class _ChartBuilder:
    """Makes a chart of floors."""

    def __init__(
        self, own: Mapping[int, AlignedNeighborhood], views: Mapping[int, AreaView], features: FeatureParameters
    ) -> None:
        self._neighborhoods, self._views, self._features = own, views, features
        self._landmark_cache: dict[int, KnownLandmarks] = {}
        self._drafts = [_node_draft(group, self._junction_points(group)) for group in self._groups()]

    def build(self) -> Chart:
        ways = self._find_edges()
        members = frozenset(member for place in self._drafts for member in place.members)
        left = {(way.start, way.direction) for way in ways} | {
            (way.end, opposite_direction(way.direction)) for way in ways
        }
        edges = [self._edge(way, members) for way in ways]
        seen = tuple(self._node(k, left, members) for k in range(len(self._drafts)))
        nodes = tuple(self._chart_node(place) for place in self._drafts)
        return Chart(nodes, seen, tuple(each for edge in edges for each in (edge, edge.reverse)))

    def _chart_node(self, place: _NodeDraft) -> ChartNode:
        pose = se2.compose(self._neighborhoods[place.area].origin, np.array((*place.position, 0.5 * np.pi)))
        return ChartNode(place.area, pose, place.kind, place.existence, place.openings)

    def _groups(self) -> list[list[SideOpening]]:
        """The openings of each node."""
        every = [
            one
            for area, floor in self._neighborhoods.items()
            for one in find_side_openings(floor, self._views[area].landmarks)
        ]
        import networkx  # noqa: PLC0415  mapping does without it, and it takes a fifth of a second

        same = networkx.Graph()
        same.add_nodes_from(range(len(every)))
        for i, one in enumerate(every):
            for k, other in enumerate(every[:i]):
                there = self._transform_point(other.area, other.junction_point, one.area)
                if there is not None and np.hypot(*(there - one.junction_point)) < _SAME:
                    same.add_edge(i, k)
        return [[every[k] for k in sorted(group)] for group in networkx.connected_components(same)]

    def _junction_points(self, group: Sequence[SideOpening]) -> Float64:
        """Where the openings of a node lead off, of all that are known in the frame of their home, shape (n, 2)."""
        feet = (self._transform_point(one.area, one.junction_point, _home_area(group)) for one in group)
        return np.array([foot for foot in feet if foot is not None])

    def _transform_point(self, area: int, place: Float64, into: int) -> Float64 | None:
        """A place (2,) of one floor in another one; None where it is not known how it lies there."""
        pose = self._neighborhoods[into].areas.get(area)
        if pose is None:
            return None
        there = se2.compose(pose.mean, self._neighborhoods[area].origin)
        return np.asarray(se2.transform(there, place[None])[0])

    def _find_edges(self) -> list[_ChartEdge]:
        """To the north and the east, the shortest first where several claim the same; ends of hallways are added."""
        ports = [(k, direction) for k, place in enumerate(self._drafts) for direction in sorted(place.directions)]
        found = [way for port in ports for way in self._edge_to_next_node(*port)]
        taken: set[tuple[int, int]] = set()
        ways = []
        for way in sorted(found, key=lambda way: (way.distance, way.start, way.direction)):
            both = {(way.start, way.direction), (way.end, opposite_direction(way.direction))}
            if not both & taken:
                taken |= both
                ways.append(way)
        ways += [way for port in ports if port not in taken for way in self._edge_to_hallway_end(*port)]
        return [way if way.direction in {NORTH, EAST} else way.reverse for way in ways if self._is_still_there(way)]

    def _is_still_there(self, way: _ChartEdge) -> bool:
        place = self._drafts[way.start]
        existence = edge_existence_probability(
            self._neighborhoods[place.area], _hallway_segment(place, way), self._features
        )
        return existence >= self._features.landmark_least

    def _edge_to_next_node(self, k: int, direction: int) -> Iterator[_ChartEdge]:
        """The way from a node in a direction to the next node; none or one."""
        far, _ = self._driven_extent(k, direction)
        found = min(self._nodes_ahead(k, direction, far + _MAX_UNDRIVEN_DISTANCE), default=None)
        if found is not None:
            distance, other = found
            yield _ChartEdge(k, direction, other, distance, self._variance(k, other, direction))

    def _edge_to_hallway_end(self, k: int, direction: int) -> Iterator[_ChartEdge]:
        """The way from a node in a direction to the end of the hallway, which becomes a node; none or one."""
        place = self._drafts[k]
        far, last = self._driven_extent(k, direction)
        wall = math.nan if last is None else float(self._neighborhoods[place.area].free_distances[last, direction])
        distance = far + wall - END_NODE_TO_WALL
        if wall <= _END and distance > _APART:
            at = place.position + distance * DIRECTIONS[direction]
            self._drafts.append(_NodeDraft(place.area, at, END, 1.0, (), frozenset()))
            yield _ChartEdge(k, direction, len(self._drafts) - 1, distance, 2.0 * _PLACED**2)

    def _driven_extent(self, k: int, direction: int) -> tuple[float, int | None]:
        """How far the robot drove along a hallway ahead of a node, m, and the keyframe that is the farthest there."""
        place = self._drafts[k]
        floor = self._neighborhoods[place.area]
        ahead, beside = _ahead_and_beside(floor.positions, place.position, direction)
        own = np.flatnonzero(floor.in_hallway[:, direction % 2] & (np.abs(beside) <= _MIDDLE) & (ahead > 0.0))
        far, last = 0.0, None
        for keyframe in own[np.argsort(ahead[own], kind="stable")].tolist():
            if ahead[keyframe] - far > _GAP:
                break
            far, last = float(ahead[keyframe]), keyframe
        return far, last

    def _nodes_ahead(self, k: int, direction: int, far: float) -> Iterator[tuple[float, int]]:
        """Distances and numbers of the nodes along a hallway, up to so far."""
        place = self._drafts[k]
        for other, there in enumerate(self._drafts):
            at = self._transform_point(there.area, there.position, place.area)
            if other == k or at is None or direction not in there.directions:
                continue
            ahead, beside = _ahead_and_beside(at[None], place.position, direction)
            if _SAME < ahead[0] <= far and abs(beside[0]) <= _MIDDLE:
                yield float(ahead[0]), other

    def _variance(self, k: int, other: int, direction: int) -> float:
        """Of the distance between two nodes."""
        place, there = self._drafts[k], self._drafts[other]
        pose = self._neighborhoods[place.area].areas[there.area]
        at = se2.compose(self._neighborhoods[there.area].origin, np.array((*there.position, 0.0)))
        belief = pose.compose(PoseGaussian.from_pose(at))
        along = se2.transform(np.array((0.0, 0.0, -belief.mean[2])), DIRECTIONS[direction][None])[0]
        return float(along @ belief.covariance[:2, :2] @ along) + 2.0 * _PLACED**2

    def _landmarks_around(self, area: int) -> KnownLandmarks:
        if area not in self._landmark_cache:
            landmarks = {other: view.landmarks for other, view in self._views.items()}
            self._landmark_cache[area] = known_landmarks_around(self._neighborhoods[area].areas, landmarks)
        return self._landmark_cache[area]

    def _edge(self, way: _ChartEdge, members: frozenset[tuple[int, int]]) -> Edge:
        place = self._drafts[way.start]
        landmarks = segment_landmarks(
            self._landmarks_around(place.area), self._neighborhoods[place.area], _hallway_segment(place, way), members
        )
        distance = (way.distance, way.variance)
        return Edge(way.start, way.direction, way.end, way.direction, distance, (0.0, _STRAIGHT**2), landmarks)

    def _node(self, k: int, left: set[tuple[int, int]], members: frozenset[tuple[int, int]]) -> Node:
        """The landmarks of a node: its openings, and what is ahead and back where no edge holds it."""
        place = self._drafts[k]
        lists = []
        for direction in (NORTH, EAST):
            begin = 0.0 if (k, opposite_direction(direction)) in left else -np.inf
            end = 0.0 if (k, direction) in left else np.inf
            stretch = HallwaySegment(place.position, direction, begin, end)
            around, floor = self._landmarks_around(place.area), self._neighborhoods[place.area]
            found = segment_landmarks(around, floor, stretch, members, place.members)
            led = not math.isinf(begin) or not math.isinf(end)
            sides = [d for d in (direction - 1, direction + 1) if led and (k, d % QUARTERS) in left]
            lists.append(add_hallway_openings(found, floor, place.position, direction, sides))
        return Node(place.existence, *lists)


def _node_draft(group: Sequence[SideOpening], feet: Float64) -> _NodeDraft:
    """The node of some openings, in the frame of the area in which one of them was seen most often.

    :param feet: shape (n, 2), their places in the hallway's middle, in that frame.
    """
    best: dict[int, SideOpening] = {}
    for one in sorted(group, key=_sighting_rank, reverse=True):
        best.setdefault(one.direction, one)
    openings = tuple(best[direction] for direction in sorted(best))
    hallway = any(one.leads_to_hallway for one in openings)
    existence = max(one.landmark.existence.probability for one in openings)
    members = frozenset((one.area, one.number) for one in group)
    return _NodeDraft(_home_area(group), feet.mean(axis=0), CROSSING if hallway else DOOR, existence, openings, members)


def _home_area(group: Sequence[SideOpening]) -> int:
    """The area in which one of some openings was seen most often."""
    return max(group, key=_sighting_rank).area


def _sighting_rank(opening: SideOpening) -> tuple[int, float]:
    """What openings are ranked by: one that was seen once, from afar, is believed in, but its place is not known."""
    return opening.landmark.existence.detections, opening.landmark.existence.probability


def _hallway_segment(place: _NodeDraft, way: _ChartEdge) -> HallwaySegment:
    return HallwaySegment(place.position, way.direction, 0.0, way.distance)


def _ahead_and_beside(places: Float64, at: Float64, direction: int) -> tuple[Float64, Float64]:
    """How far places (n, 2) are ahead of and beside another one for a robot that looks in a direction, m."""
    away = places - at
    return away @ DIRECTIONS[direction], away @ DIRECTIONS[(direction + 1) % QUARTERS]
