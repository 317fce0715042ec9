"""Roadmap of keyframes over an HMT map, with the frontiers and rooms beside them.

The robot can return to the pose of any keyframe. The roadmap joins keyframes between which a straight line is free.
Roadmap and frontiers are updated around the robot alone. Hallways and rooms are distinguished as in Tomatis, Nourbakhsh
and Siegwart (2003), section 3.1.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import networkx as nx
import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.exploration.frontiers import KEYFRAME_RANGE, NavigationGrid
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around
from hmt_slam_ros.landmarks.area_classes import hallway_log_odds, measure_free_space
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.landmarks.openings import distance_to_doors, extract_openings, jamb_positions
from hmt_slam_ros.landmarks.rays import rays_from_scan
from hmt_slam_ros.sensors import Scan


class PlaceClassification(NamedTuple):
    """Class and doors of the place of a scan.

    :ivar is_hallway: whether the robot is in a hallway; False where too little is visible.
    :ivar doors: shape (n, 4), x and y of both jambs of each door, m, in the frame of the base.
    """

    is_hallway: bool
    doors: Float64


def classify_place(scan: Scan, features: FeatureParameters, max_door_width: float) -> PlaceClassification:
    """Class and doors of the place of a scan.

    :param max_door_width: largest width of a door; wider openings lead to hallways, m.
    """
    rays = rays_from_scan(scan, features)
    openings = extract_openings(extract_lines(scan, features), rays, features)
    narrow = openings.widths <= max_door_width
    doors = jamb_positions(openings.poses[narrow], openings.widths[narrow])
    within = np.minimum(rays.free_range, distance_to_doors(rays.origins, rays.directions, doors))
    space = measure_free_space(rays._replace(free_range=within))
    return PlaceClassification(space is not None and hallway_log_odds(space, features) > 0.0, doors)


def crosses_doors(ways: Float64, doors: Float64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether straight lines cross any of the doors.

    :param ways: shape (n, 4), x and y of both ends, m.
    :param doors: shape (m, 4), likewise, in the same frame.
    :returns: shape (n,).
    """
    a, b = ways[:, None, :2], ways[:, None, 2:]
    c, d = doors[None, :, :2], doors[None, :, 2:]
    apart = (_side(a, b, c) > 0.0) != (_side(a, b, d) > 0.0)
    through = (_side(c, d, a) > 0.0) != (_side(c, d, b) > 0.0)
    return np.asarray((apart & through).any(axis=1))


def _side(a: Float64, b: Float64, p: Float64) -> Float64:
    """Positive where p is to the left of the line from a to b."""
    along, offset = b - a, p - a
    return np.asarray(along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0])


_MAX_AREA_DEVIATION = 1.0
"""Largest deviation of the position of an area whose scans are used, m."""

_UPDATE_RADIUS = 8.0
"""Distance from the robot up to which roadmap and frontiers are updated, m."""

_SCAN_RADIUS = _UPDATE_RADIUS + KEYFRAME_RANGE
"""Distance from the robot up to which keyframes are used for that, m."""

_MAX_EDGE_LENGTH = 8.0
"""Longest edge of the roadmap, m."""

_MAX_DRIVEN_STEP = 1.5
"""Largest distance between consecutive keyframes that the robot drove between, m."""

_MAX_GOAL_SHIFT = 0.08
"""Largest distance of a goal from the middle of a free cell, m: half its diagonal."""

_BESIDE = 1.5
"""Largest distance of keyframes that may replace each other, m."""

_MIN_ROOM_KEYFRAMES = 3
"""Keyframes in an entered room, at least."""


SAME_FRONTIER_DISTANCE = 0.7
"""Frontiers nearer to each other than this are one, m."""


@dataclass(frozen=True, eq=False)
class Frontier:
    """The end of known ground, or an unvisited room.

    :ivar keyframe: the nearest on the path there.
    :ivar path: shape (n, 2), from there to the frontier or the room's middle, m, in the frame of the keyframe's base.
    :ivar is_in_hallway: whether it is expected in a hallway; else in a room.
    """

    keyframe: int
    path: Float64
    is_in_hallway: bool

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return float(np.hypot(*np.diff(self.path, axis=0).T).sum())

    @property
    def end(self) -> Float64:
        """The pose at the end of the path, shape (3,), in the frame of the keyframe's base, m and rad."""
        towards = self.path[-1] - self.path[-2:][0]
        return np.array([*self.path[-1], math.atan2(towards[1], towards[0])])


class EntryPoint(NamedTuple):
    """A path between the roadmap and a pose.

    :ivar keyframe: the nearest.
    :ivar path: shape (n, 2), from the robot to there, or from there to a goal, m, in the frame of the keyframe's base.
    """

    keyframe: int
    path: Float64


class Roadmap:
    """Roadmap and frontiers.

    :ivar graph: of keyframes; edges have a ``length``, m, and whether they cross a ``door``.
    :ivar frontiers: known ones.
    """

    def __init__(self, features: FeatureParameters, min_clearance: float, max_door_width: float) -> None:
        """:param min_clearance: smallest distance of the robot's middle from surfaces, m.

        :param max_door_width: largest width of a door, m.
        """
        self._features, self._min_clearance, self._max_door_width = features, min_clearance, max_door_width
        self._classifications: dict[int, PlaceClassification] = {}
        self.graph = nx.Graph()
        self.frontiers: list[Frontier] = []
        # {keyframe: its area and its pose in that} at the last update.
        self._keyframe_poses: dict[int, tuple[int, Float64]] = {}

    @classmethod
    def of_explorer(cls, configuration: Configuration) -> Roadmap:
        """An empty roadmap for the robot of the explorer's parameters."""
        parameters = configuration.explorer
        return cls(configuration.features, parameters.radius + parameters.margin, parameters.door)

    def update(self, hybrid_map: HybridMap, scans: Mapping[int, Scan], area: int, pose: Float64) -> EntryPoint | None:
        """Update roadmap and frontiers around the robot.

        :param area: the robot's.
        :param pose: ``area_T_base`` (3,), m and rad.
        :returns: the robot's path to the roadmap, None without keyframes around it.
        """
        poses = _keyframes_around(hybrid_map, area, pose)
        names = sorted(poses)
        if not names:
            return None
        placed = np.array([poses[keyframe] for keyframe in names])
        ground = NavigationGrid([scans[keyframe] for keyframe in names], placed, self._min_clearance)
        doors = self._doors_in_view(names, placed, scans)
        self._remove_outdated(hybrid_map, poses, pose)
        self._connect_keyframes(names, placed, ground, pose, doors)
        self._find_frontiers(names, placed, ground, pose, doors)
        return self._entry_point(names, placed, ground, pose)

    def path_to(self, hybrid_map: HybridMap, scans: Mapping[int, Scan], area: int, pose: Float64) -> EntryPoint | None:
        """The path from the nearest keyframe to a pose; None where the robot cannot stand there.

        :param area: in whose frame the pose is.
        :param pose: ``area_T_goal`` (3,), m and rad.
        """
        poses = _keyframes_around(hybrid_map, area, pose)
        names = sorted(poses)
        placed = np.array([poses[keyframe] for keyframe in names])
        ground = NavigationGrid([scans[keyframe] for keyframe in names], placed, self._min_clearance)
        path = ground.path_to(pose[:2])
        if path is None or math.dist(path.points[-1], pose[:2]) > _MAX_GOAL_SHIFT:
            return None
        points = np.concatenate((path.points[:-1], pose[None, :2]))
        return EntryPoint(names[path.keyframe_row], se2.transform(se2.inverse(placed[path.keyframe_row]), points))

    def update_everywhere(self, hybrid_map: HybridMap, scans: Mapping[int, Scan]) -> None:
        """Update roadmap and frontiers of a whole map."""
        for area in hybrid_map.area_ids():
            updated: list[Float64] = []
            for pose in hybrid_map.keyframes(area).values():
                if all(math.dist(pose[:2], other[:2]) > 0.5 * _UPDATE_RADIUS for other in updated):
                    updated.append(pose)
                    self.update(hybrid_map, scans, area, pose)

    def _entry_point(self, names: list[int], placed: Float64, ground: NavigationGrid, pose: Float64) -> EntryPoint:
        """The robot's path to the roadmap; straight to the nearest keyframe where the grid has none."""
        path = ground.path_to(pose[:2])
        if path is not None:
            row, points = path.keyframe_row, path.points[::-1]
        else:
            distances = np.hypot(*(placed[:, :2] - pose[:2]).T)
            row, points = int(np.argmin(distances)), placed[:0, :2]
        return EntryPoint(names[row], se2.transform(se2.inverse(placed[row]), points))

    def _remove_outdated(self, hybrid_map: HybridMap, poses: Mapping[int, Float64], pose: Float64) -> None:
        """Remove keyframes that are not in the map, and edges and frontiers near the robot, which are found again.

        :param poses: {keyframe: pose (3,)} around the robot.
        """
        known = {k: (area, own) for area in hybrid_map.area_ids() for k, own in hybrid_map.keyframes(area).items()}
        self.graph.remove_nodes_from([keyframe for keyframe in self.graph if keyframe not in known])
        near = {keyframe for keyframe, placed in poses.items() if _is_near(placed, pose)}
        self.graph.remove_edges_from([edge for edge in self.graph.edges if edge[0] in near and edge[1] in near])
        reattached = [self._reattach_frontier(frontier, known) for frontier in self.frontiers]
        self.frontiers = [
            frontier
            for frontier in reattached
            if frontier is not None
            and not (
                frontier.keyframe in poses
                and _is_near(se2.transform(poses[frontier.keyframe], frontier.path[-1]), pose)
            )
        ]
        self._keyframe_poses = known

    def _reattach_frontier(self, frontier: Frontier, known: Mapping[int, tuple[int, Float64]]) -> Frontier | None:
        """The frontier, if its keyframe was removed from another keyframe of the same area; None for none.

        :param known: {keyframe: its area and its pose in that}.
        """
        if frontier.keyframe in known:
            return frontier
        area, pose = self._keyframe_poses[frontier.keyframe]
        rest = {k: own for k, (other, own) in self._keyframe_poses.items() if other == area and k in known}
        if not rest:
            return None
        nearest = min(rest, key=lambda keyframe: math.dist(rest[keyframe][:2], pose[:2]))
        path = se2.transform(se2.between(rest[nearest], pose), frontier.path)
        return Frontier(nearest, path, frontier.is_in_hallway)

    def _doors_in_view(self, names: list[int], placed: Float64, scans: Mapping[int, Scan]) -> Float64:
        """The doors in the scans of keyframes, (n, 4), m, in the frame of their poses."""
        found = [np.empty((0, 4))]
        for keyframe, pose in zip(names, placed, strict=True):
            if keyframe not in self._classifications:
                self._classifications[keyframe] = classify_place(scans[keyframe], self._features, self._max_door_width)
            doors = self._classifications[keyframe].doors
            found.append(np.concatenate([se2.transform(pose, doors[:, end : end + 2]) for end in (0, 2)], axis=1))
        return np.concatenate(found)

    def _connect_keyframes(
        self, names: list[int], placed: Float64, ground: NavigationGrid, pose: Float64, doors: Float64
    ) -> None:
        """Add edges between keyframes with a free straight line between them."""
        near = np.array([_is_near(own, pose) for own in placed])
        self.graph.add_nodes_from(keyframe for keyframe, own in zip(names, near.tolist(), strict=True) if own)
        apart = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).transpose(2, 0, 1))
        firsts, seconds = np.nonzero(np.triu(apart <= _MAX_EDGE_LENGTH, 1))
        starts, ends = placed[firsts, :2], placed[seconds, :2]
        numbers = np.array(names)
        driven = (numbers[seconds] == numbers[firsts] + 1) & (apart[firsts, seconds] <= _MAX_DRIVEN_STEP)
        # Nothing is between two poses of the robot that are nearer to each other than its width.
        beside = apart[firsts, seconds] <= self._min_clearance
        joined = (near[firsts] & near[seconds]) & (driven | beside | ground.is_straight_path_free(starts, ends))
        passed = crosses_doors(np.concatenate((starts, ends), axis=1), doors)
        for i, k, door in zip(firsts[joined].tolist(), seconds[joined].tolist(), passed[joined].tolist(), strict=True):
            self.graph.add_edge(names[i], names[k], length=float(apart[i, k]), door=door)

    def _find_frontiers(
        self, names: list[int], placed: Float64, ground: NavigationGrid, pose: Float64, doors: Float64
    ) -> None:
        """Add the frontiers, and unvisited rooms, which may be visible completely from outside."""
        for frontier in ground.paths_to_frontiers():
            keyframe = names[frontier.keyframe_row]
            ways = np.concatenate((frontier.points[:-1], frontier.points[1:]), axis=1)
            # A door leads from a hallway to a room, or from a room to a hallway.
            hallway = self._classifications[keyframe].is_hallway != bool(crosses_doors(ways, doors).any())
            self._add_frontier(keyframe, placed[frontier.keyframe_row], frontier.points, pose, hallway=hallway)
        for room in ground.paths_to_unvisited_rooms(doors):
            self._add_frontier(names[room.keyframe_row], placed[room.keyframe_row], room.points, pose, hallway=False)

    def _add_frontier(self, keyframe: int, at: Float64, points: Float64, pose: Float64, *, hallway: bool) -> None:
        """Add a frontier, if it is near the robot.

        :param at: pose of the keyframe at the begin of the path (n, 2) there.
        """
        if _is_near(points[-1], pose):
            self.frontiers.append(Frontier(keyframe, se2.transform(se2.inverse(at), points), hallway))

    def distances(self, start: int) -> dict[int, float]:
        """{keyframe: length of the path from ``start``, m} of reachable keyframes."""
        return dict(nx.single_source_dijkstra_path_length(self.graph, start, weight="length"))

    def shortest_path(self, start: int, end: int) -> list[int]:
        """The keyframes of the shortest path, with both ends.

        :raises networkx.NetworkXNoPath: without a path.
        """
        return list(nx.dijkstra_path(self.graph, start, end, weight="length"))

    def backtracking_path(self, start: int) -> list[int]:
        """The path back over the robot's earlier keyframes, the newest first, with shortest paths between them."""
        path = [start]
        for keyframe in sorted((each for each in self.distances(start) if NO_KEYFRAME < each < start), reverse=True):
            path += self.shortest_path(path[-1], keyframe)[1:]
        return path

    def segments(self) -> list[set[int]]:
        """The keyframes of hallways and rooms, one segment each.

        Doors end a segment. A part that is beside rooms alone, such as behind a gap between furniture, is joined to the
        room with most keyframes beside it.
        """
        parts = sorted(nx.connected_components(self._graph_without_doors()), key=min)
        number = {keyframe: k for k, part in enumerate(parts) for keyframe in part}
        near = ((a, b) for a, b, length in self.graph.edges(data="length") if length <= _BESIDE)
        beside: list[Counter[int]] = [Counter() for _ in parts]
        for a, b in near:
            if number[a] != number[b]:
                beside[number[a]][number[b]] += 1
                beside[number[b]][number[a]] += 1
        rooms = {k for k, part in enumerate(parts) if self.is_room(part)}
        joined = nx.empty_graph(len(parts))
        within = (k for k in sorted(rooms) if beside[k] and rooms >= set(beside[k]))
        joined.add_edges_from((k, beside[k].most_common(1)[0][0]) for k in within)
        return [set().union(*(parts[k] for k in group)) for group in nx.connected_components(joined)]

    def room_around(self, keyframe: int) -> tuple[int, ...]:
        """The keyframes beside one, the nearest first, if its segment is a room; none in a hallway."""
        segment = next((own for own in self.segments() if keyframe in own), set())
        return self._keyframes_beside(keyframe) if self.is_room(segment) else ()

    def rooms(self) -> list[tuple[int, ...]]:
        """The keyframes around the middle of every entered room as of `room_around`, in the order of entering."""
        rooms = sorted(
            (own for own in self.segments() if len(own) >= _MIN_ROOM_KEYFRAMES and self.is_room(own)), key=min
        )
        return [self._keyframes_beside(nx.barycenter(self.graph.subgraph(room), weight="length")[0]) for room in rooms]

    def room_numbers(self) -> dict[int, int]:
        """{keyframe in an entered room: its number, from 1 on, in the order of :meth:`rooms`}."""
        middles = {room[0]: number for number, room in enumerate(self.rooms(), 1)}
        numbered = ((segment, middles.keys() & segment) for segment in self.segments())
        return {keyframe: middles[middle] for segment, found in numbered for middle in found for keyframe in segment}

    def is_room(self, segment: Collection[int]) -> bool:
        """Whether at least half of the keyframes of a segment are in a room; the end of a hallway looks like one."""
        hallways = sum(self._classifications[keyframe].is_hallway for keyframe in segment)
        return len(segment) > 0 and hallways <= 0.5 * len(segment)

    def _keyframes_beside(self, keyframe: int) -> tuple[int, ...]:
        beside = {
            other: edge["length"]
            for other, edge in self.graph[keyframe].items()
            if edge["length"] <= _BESIDE and not edge["door"]
        }
        return (keyframe, *sorted(beside, key=lambda other: (beside[other], other)))

    def _graph_without_doors(self) -> nx.Graph:
        """The roadmap without edges through doors."""
        within = nx.Graph()
        within.add_nodes_from(self.graph)
        within.add_edges_from((a, b) for a, b, door in self.graph.edges(data="door") if not door)
        return within


def _keyframes_around(hybrid_map: HybridMap, area: int, pose: Float64) -> dict[int, Float64]:
    """{keyframe: ``area_T_keyframe`` (3,)} of those near a pose in an area (3,)."""
    return {
        keyframe: placed
        for other, belief in areas_around(hybrid_map, area, Neighborhood(_MAX_AREA_DEVIATION, _SCAN_RADIUS)).items()
        for keyframe, own in hybrid_map.keyframes(other).items()
        if math.dist((placed := se2.compose(belief.mean, own))[:2], pose[:2]) <= _SCAN_RADIUS
    }


def _is_near(place: Float64, pose: Float64) -> bool:
    return math.dist(place[:2], pose[:2]) <= _UPDATE_RADIUS
