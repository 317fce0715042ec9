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
from hmt_slam_ros.configuration.landmarks import Features, Places
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.places.area_views import AreaView
from hmt_slam_ros.places.edge_existence import existence_of
from hmt_slam_ros.places.floor import DIRECTIONS, Floor, LeadingOff, floors, leading_off
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import EAST, NORTH, Edge, Node, PlaceGraph, opposite, place_graph
from hmt_slam_ros.places.wall_landmarks import Known, Stretch, known_around, of_stretch, with_hallways

DOOR, CROSSING, END = range(3)
"""What a node is."""

NAMES = ("door", "crossing", "end")
"""Their names."""

BEFORE = 1.0
"""So far before the wall at the end of a hallway, m, is the node there, where a robot turns."""

# Places nearer to each other than this, m, are one node.
_SAME = 0.6
# A hallway was driven along without a gap longer than this, m, within so much of its middle, m; its end is so far
# behind the last keyframe, and the next node beyond what was driven along, m, at most.
_GAP, _MIDDLE, _END, _ON = 3.0, 0.9, 4.0, 1.0
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
    openings: tuple[LeadingOff, ...]


@dataclass(frozen=True, eq=False)
class Chart:
    """The places of an HMT map.

    :ivar nodes: crossings, doors, and ends of hallways.
    :ivar seen: the same as nodes of the graph of places.
    :ivar edges: of that graph, in both directions.
    """

    nodes: tuple[ChartNode, ...]
    seen: tuple[Node, ...]
    edges: tuple[Edge, ...]

    def name(self, node: int) -> str:
        """Such as "door 3"; the numbers are those of the nodes, of whatever kind."""
        return f"{NAMES[self.nodes[node].kind]} {node}"

    def graph(self, places: Places) -> PlaceGraph:
        """The graph of places."""
        return place_graph(self.seen, self.edges, places)


class _Place(NamedTuple):
    """A node, (2,), in the frame of its area's floor, with the landmarks (area, number) that it is made of."""

    area: int
    at: Float64
    kind: int
    existence: float
    openings: tuple[LeadingOff, ...]
    members: frozenset[tuple[int, int]]

    @property
    def directions(self) -> frozenset[int]:
        """In which a hallway may lead on."""
        found = {turned % QUARTERS for one in self.openings for turned in (one.direction + 1, one.direction + 3)}
        return frozenset(found | {one.direction for one in self.openings if one.hallway})


class _Way(NamedTuple):
    """From one node to the next: mean and variance of the distance."""

    start: int
    direction: int
    end: int
    distance: float
    variance: float

    @property
    def back(self) -> _Way:
        """The same way in the other direction."""
        return self._replace(start=self.end, direction=opposite(self.direction), end=self.start)


def chart_of(hybrid_map: HybridMap, views: Mapping[int, AreaView], features: Features) -> Chart:
    """The chart of a map.

    :param views: {area: what it shows}, of all areas.
    """
    return _Charting(floors(hybrid_map, views), views, features).chart()


class _Charting:
    """Makes a chart of floors."""

    def __init__(self, own: Mapping[int, Floor], views: Mapping[int, AreaView], features: Features) -> None:
        self._floors, self._views, self._features = own, views, features
        self._known: dict[int, Known] = {}
        self._places = [_place_of(group, self._feet(group)) for group in self._groups()]

    def chart(self) -> Chart:
        ways = self._ways()
        members = frozenset(member for place in self._places for member in place.members)
        left = {(way.start, way.direction) for way in ways} | {(way.end, opposite(way.direction)) for way in ways}
        edges = [self._edge(way, members) for way in ways]
        seen = tuple(self._node(k, left, members) for k in range(len(self._places)))
        nodes = tuple(self._chart_node(place) for place in self._places)
        return Chart(nodes, seen, tuple(each for edge in edges for each in (edge, edge.back)))

    def _chart_node(self, place: _Place) -> ChartNode:
        pose = se2.compose(self._floors[place.area].origin, np.array((*place.at, 0.5 * np.pi)))
        return ChartNode(place.area, pose, place.kind, place.existence, place.openings)

    def _groups(self) -> list[list[LeadingOff]]:
        """The openings of each node."""
        every = [one for area, floor in self._floors.items() for one in leading_off(floor, self._views[area].landmarks)]
        import networkx  # noqa: PLC0415  mapping does without it, and it takes a fifth of a second

        same = networkx.Graph()
        same.add_nodes_from(range(len(every)))
        for i, one in enumerate(every):
            for k, other in enumerate(every[:i]):
                there = self._carried(other.area, other.foot, one.area)
                if there is not None and np.hypot(*(there - one.foot)) < _SAME:
                    same.add_edge(i, k)
        return [[every[k] for k in sorted(group)] for group in networkx.connected_components(same)]

    def _feet(self, group: Sequence[LeadingOff]) -> Float64:
        """Where the openings of a node lead off, of all that are known in the frame of their home, shape (n, 2)."""
        feet = (self._carried(one.area, one.foot, _home(group)) for one in group)
        return np.array([foot for foot in feet if foot is not None])

    def _carried(self, area: int, place: Float64, into: int) -> Float64 | None:
        """A place (2,) of one floor in another one; None where it is not known how it lies there."""
        pose = self._floors[into].areas.get(area)
        if pose is None:
            return None
        there = se2.compose(pose.mean, self._floors[area].origin)
        return np.asarray(se2.transform(there, place[None])[0])

    def _ways(self) -> list[_Way]:
        """To the north and the east, the shortest first where several claim the same; ends of hallways are added."""
        ports = [(k, direction) for k, place in enumerate(self._places) for direction in sorted(place.directions)]
        found = [way for port in ports for way in self._to_next(*port)]
        taken: set[tuple[int, int]] = set()
        ways = []
        for way in sorted(found, key=lambda way: (way.distance, way.start, way.direction)):
            both = {(way.start, way.direction), (way.end, opposite(way.direction))}
            if not both & taken:
                taken |= both
                ways.append(way)
        ways += [way for port in ports if port not in taken for way in self._to_end(*port)]
        return [way if way.direction in {NORTH, EAST} else way.back for way in ways if self._is_there(way)]

    def _is_there(self, way: _Way) -> bool:
        place = self._places[way.start]
        existence = existence_of(self._floors[place.area], _stretch(place, way), self._features)
        return existence >= self._features.landmark_least

    def _to_next(self, k: int, direction: int) -> Iterator[_Way]:
        """The way from a node in a direction to the next node; none or one."""
        far, _ = self._driven(k, direction)
        found = min(self._ahead(k, direction, far + _ON), default=None)
        if found is not None:
            distance, other = found
            yield _Way(k, direction, other, distance, self._variance(k, other, direction))

    def _to_end(self, k: int, direction: int) -> Iterator[_Way]:
        """The way from a node in a direction to the end of the hallway, which becomes a node; none or one."""
        place = self._places[k]
        far, last = self._driven(k, direction)
        wall = math.nan if last is None else float(self._floors[place.area].clear[last, direction])
        distance = far + wall - BEFORE
        if wall <= _END and distance > _APART:
            at = place.at + distance * DIRECTIONS[direction]
            self._places.append(_Place(place.area, at, END, 1.0, (), frozenset()))
            yield _Way(k, direction, len(self._places) - 1, distance, 2.0 * _PLACED**2)

    def _driven(self, k: int, direction: int) -> tuple[float, int | None]:
        """How far the robot drove along a hallway ahead of a node, m, and the keyframe that is the farthest there."""
        place = self._places[k]
        floor = self._floors[place.area]
        ahead, beside = _ahead_of(floor.places, place.at, direction)
        own = np.flatnonzero(floor.along[:, direction % 2] & (np.abs(beside) <= _MIDDLE) & (ahead > 0.0))
        far, last = 0.0, None
        for keyframe in own[np.argsort(ahead[own], kind="stable")].tolist():
            if ahead[keyframe] - far > _GAP:
                break
            far, last = float(ahead[keyframe]), keyframe
        return far, last

    def _ahead(self, k: int, direction: int, far: float) -> Iterator[tuple[float, int]]:
        """Distances and numbers of the nodes along a hallway, up to so far."""
        place = self._places[k]
        for other, there in enumerate(self._places):
            at = self._carried(there.area, there.at, place.area)
            if other == k or at is None or direction not in there.directions:
                continue
            ahead, beside = _ahead_of(at[None], place.at, direction)
            if _SAME < ahead[0] <= far and abs(beside[0]) <= _MIDDLE:
                yield float(ahead[0]), other

    def _variance(self, k: int, other: int, direction: int) -> float:
        """Of the distance between two nodes."""
        place, there = self._places[k], self._places[other]
        pose = self._floors[place.area].areas[there.area]
        at = se2.compose(self._floors[there.area].origin, np.array((*there.at, 0.0)))
        belief = pose.compose(PoseGaussian.exactly(at))
        along = se2.transform(np.array((0.0, 0.0, -belief.mean[2])), DIRECTIONS[direction][None])[0]
        return float(along @ belief.covariance[:2, :2] @ along) + 2.0 * _PLACED**2

    def _around(self, area: int) -> Known:
        if area not in self._known:
            landmarks = {other: view.landmarks for other, view in self._views.items()}
            self._known[area] = known_around(self._floors[area].areas, landmarks)
        return self._known[area]

    def _edge(self, way: _Way, members: frozenset[tuple[int, int]]) -> Edge:
        place = self._places[way.start]
        landmarks = of_stretch(self._around(place.area), self._floors[place.area], _stretch(place, way), members)
        distance = (way.distance, way.variance)
        return Edge(way.start, way.direction, way.end, way.direction, distance, (0.0, _STRAIGHT**2), landmarks)

    def _node(self, k: int, left: set[tuple[int, int]], members: frozenset[tuple[int, int]]) -> Node:
        """The landmarks of a node: its openings, and what is ahead and back where no edge holds it."""
        place = self._places[k]
        lists = []
        for direction in (NORTH, EAST):
            begin = 0.0 if (k, opposite(direction)) in left else -np.inf
            end = 0.0 if (k, direction) in left else np.inf
            stretch = Stretch(place.at, direction, begin, end)
            around, floor = self._around(place.area), self._floors[place.area]
            found = of_stretch(around, floor, stretch, members, place.members)
            led = not math.isinf(begin) or not math.isinf(end)
            sides = [d for d in (direction - 1, direction + 1) if led and (k, d % QUARTERS) in left]
            lists.append(with_hallways(found, floor, place.at, direction, sides))
        return Node(place.existence, *lists)


def _place_of(group: Sequence[LeadingOff], feet: Float64) -> _Place:
    """The node of some openings, in the frame of the area in which one of them was seen most often.

    :param feet: shape (n, 2), their places in the hallway's middle, in that frame.
    """
    best: dict[int, LeadingOff] = {}
    for one in sorted(group, key=_sightings, reverse=True):
        best.setdefault(one.direction, one)
    openings = tuple(best[direction] for direction in sorted(best))
    hallway = any(one.hallway for one in openings)
    existence = max(one.landmark.existence.probability for one in openings)
    members = frozenset((one.area, one.number) for one in group)
    return _Place(_home(group), feet.mean(axis=0), CROSSING if hallway else DOOR, existence, openings, members)


def _home(group: Sequence[LeadingOff]) -> int:
    """The area in which one of some openings was seen most often."""
    return max(group, key=_sightings).area


def _sightings(opening: LeadingOff) -> tuple[int, float]:
    """What openings are ranked by: one that was seen once, from afar, is believed in, but its place is not known."""
    return opening.landmark.existence.seen, opening.landmark.existence.probability


def _stretch(place: _Place, way: _Way) -> Stretch:
    return Stretch(place.at, way.direction, 0.0, way.distance)


def _ahead_of(places: Float64, at: Float64, direction: int) -> tuple[Float64, Float64]:
    """How far places (n, 2) are ahead of and beside another one for a robot that looks in a direction, m."""
    away = places - at
    return away @ DIRECTIONS[direction], away @ DIRECTIONS[(direction + 1) % QUARTERS]
