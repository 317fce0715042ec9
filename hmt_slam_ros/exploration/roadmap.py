"""What of a building is known, on top of its HMT map: a roadmap of keyframes, and what is open beside them.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.1: thin and long open spaces are hallways, others are rooms.

Where a keyframe was taken the robot has been, so it can get there again. The roadmap joins keyframes between which it
can go straight. Both are kept up to date around the robot's area alone; what is farther away stays as it was seen.
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
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.exploration.frontiers import REACH, Ground
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import Nearness, areas_around
from hmt_slam_ros.landmarks.area_classes import free_space, log_odds
from hmt_slam_ros.landmarks.beam_labels import rays_of
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.landmarks.openings import jambs_of, openings_of, up_to_doors
from hmt_slam_ros.sensors import Scan


class Outlook(NamedTuple):
    """What a scan shows.

    :ivar hallway: whether the robot is in a hallway; one that sees too little of what is around it is not.
    :ivar doors: shape (n, 4), x and y of both jambs of each door, m, in the frame of the base.
    """

    hallway: bool
    doors: Float64


def outlook_of(scan: Scan, features: Features, door: float) -> Outlook:
    """What a scan shows.

    :param door: an opening up to so wide is a door, a wider one a hallway, m.
    """
    rays = rays_of(scan, features)
    openings = openings_of(extract_lines(scan, features), rays, features)
    narrow = openings.widths <= door
    doors = jambs_of(openings.poses[narrow], openings.widths[narrow])
    within = np.minimum(rays.free, up_to_doors(rays.origins, rays.directions, doors))
    space = free_space(rays._replace(free=within))
    return Outlook(space is not None and log_odds(space, features) > 0.0, doors)


def crosses(ways: Float64, doors: Float64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of some straight ways pass any of the doors.

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
    """Above 0 where p is to the left of the line from a to b."""
    along, to = b - a, p - a
    return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])


# How certain the place of an area has to be for its scans to be laid over those of the robot's area, m.
_SIGMA = 1.0
# What is up to this distance from the robot is found anew, by all that keyframes up to that distance show, m.
_UP_TO_DATE = 8.0
_SEEN = _UP_TO_DATE + REACH
# Keyframes of the roadmap are joined up to this distance, m; from one to the next the robot drove up to this one.
_JOINED, _DROVE = 8.0, 1.5
# Keyframes that are so near to one, m, may stand for it.
_BESIDE = 1.5
# Where fewer keyframes are in a chamber, there is no room.
_FEW = 3


@dataclass(frozen=True, eq=False)
class Opened:
    """Where known ground ends, or a room that nobody entered.

    :ivar keyframe: from which the way there is shortest.
    :ivar way: shape (n, 2), from there to a place at the frontier or in the room's middle, m, in the frame of the
        keyframe's base.
    :ivar hallway: whether it is expected to be in a hallway; else it is in a room.
    """

    keyframe: int
    way: Float64
    hallway: bool

    @property
    def length(self) -> float:
        """Of the way, m."""
        return float(np.hypot(*np.diff(self.way, axis=0).T).sum())


class Here(NamedTuple):
    """How the robot gets to the roadmap.

    :ivar keyframe: the nearest.
    :ivar way: shape (n, 2), from beside the robot to there, m, in the frame of the keyframe's base.
    """

    keyframe: int
    way: Float64


class Survey:
    """Roadmap and frontiers.

    :ivar roadmap: its nodes are keyframes, its edges have a ``length``, m, and whether a ``door`` is passed.
    :ivar frontiers: all that are known.
    """

    def __init__(self, features: Features, keep: float, door: float) -> None:
        """:param keep: that the robot's middle keeps from surfaces, m.

        :param door: an opening up to so wide is a door, m.
        """
        self._features, self._keep, self._door = features, keep, door
        self._outlooks: dict[int, Outlook] = {}
        self.roadmap = nx.Graph()
        self.frontiers: list[Opened] = []
        # {keyframe: its area and its pose in that} as of the last look.
        self._placed: dict[int, tuple[int, Float64]] = {}

    def look(self, hybrid_map: HybridMap, scans: Mapping[int, Scan], area: int, pose: Float64) -> Here | None:
        """Bring all around the robot up to date.

        :param area: the robot's.
        :param pose: ``area_T_base`` (3,).
        :returns: how the robot gets to the roadmap, None where nothing is known around it.
        """
        poses = {
            keyframe: placed
            for other, belief in areas_around(hybrid_map, area, Nearness(_SIGMA, _SEEN)).items()
            for keyframe, own in hybrid_map.keyframes(other).items()
            if math.dist((placed := se2.compose(belief.mean, own))[:2], pose[:2]) <= _SEEN
        }
        names = sorted(poses)
        if not names:
            return None
        placed = np.array([poses[keyframe] for keyframe in names])
        ground = Ground([scans[keyframe] for keyframe in names], placed, self._keep)
        doors = self._doors(names, placed, scans)
        self._forget(hybrid_map, poses, pose)
        self._join(names, placed, ground, pose, doors)
        self._find(names, placed, ground, pose, doors)
        return self._here(names, placed, ground, pose)

    def look_everywhere(self, hybrid_map: HybridMap, scans: Mapping[int, Scan]) -> None:
        """Bring all of a map up to date."""
        for area in hybrid_map.area_ids():
            looked: list[Float64] = []
            for pose in hybrid_map.keyframes(area).values():
                if all(math.dist(pose[:2], other[:2]) > 0.5 * _UP_TO_DATE for other in looked):
                    looked.append(pose)
                    self.look(hybrid_map, scans, area, pose)

    def _here(self, names: list[int], placed: Float64, ground: Ground, pose: Float64) -> Here:
        """How the robot gets to the roadmap; straight to the nearest keyframe where no other way is seen."""
        way = ground.way_to(pose[:2])
        if way is not None:
            row, points = way.keyframe, way.points[::-1]
        else:
            away = np.hypot(*(placed[:, :2] - pose[:2]).T)
            row, points = int(np.argmin(away)), placed[:0, :2]
        return Here(names[row], se2.transform(se2.inverse(placed[row]), points))

    def _forget(self, hybrid_map: HybridMap, poses: Mapping[int, Float64], pose: Float64) -> None:
        """Forget what is no more, and what is near to the robot and will be found anew.

        :param poses: {keyframe: pose (3,)} around the robot.
        """
        known = {k: (area, own) for area in hybrid_map.area_ids() for k, own in hybrid_map.keyframes(area).items()}
        self.roadmap.remove_nodes_from([keyframe for keyframe in self.roadmap if keyframe not in known])
        near = {keyframe for keyframe, placed in poses.items() if _is_near(placed, pose)}
        self.roadmap.remove_edges_from([edge for edge in self.roadmap.edges if edge[0] in near and edge[1] in near])
        self.frontiers = [
            one
            for one in (self._kept(one, known) for one in self.frontiers)
            if one is not None
            and not (one.keyframe in poses and _is_near(se2.transform(poses[one.keyframe], one.way[-1]), pose))
        ]
        self._placed = known

    def _kept(self, one: Opened, known: Mapping[int, tuple[int, Float64]]) -> Opened | None:
        """What is open, as seen from another keyframe of the same area where its own is no more.

        :param known: {keyframe: its area and its pose in that}.
        """
        if one.keyframe in known:
            return one
        area, pose = self._placed[one.keyframe]
        left = {k: own for k, (other, own) in self._placed.items() if other == area and k in known}
        if not left:
            return None
        nearest = min(left, key=lambda keyframe: math.dist(left[keyframe][:2], pose[:2]))
        return Opened(nearest, se2.transform(se2.between(left[nearest], pose), one.way), one.hallway)

    def _doors(self, names: list[int], placed: Float64, scans: Mapping[int, Scan]) -> Float64:
        """All doors that keyframes show, (n, 4), in the frame of their poses."""
        found = [np.empty((0, 4))]
        for keyframe, pose in zip(names, placed, strict=True):
            if keyframe not in self._outlooks:
                self._outlooks[keyframe] = outlook_of(scans[keyframe], self._features, self._door)
            doors = self._outlooks[keyframe].doors
            found.append(np.concatenate([se2.transform(pose, doors[:, end : end + 2]) for end in (0, 2)], axis=1))
        return np.concatenate(found)

    def _join(self, names: list[int], placed: Float64, ground: Ground, pose: Float64, doors: Float64) -> None:
        """Join keyframes between which the robot can go straight."""
        near = np.array([_is_near(own, pose) for own in placed])
        self.roadmap.add_nodes_from(keyframe for keyframe, own in zip(names, near.tolist(), strict=True) if own)
        apart = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).transpose(2, 0, 1))
        firsts, seconds = np.nonzero(np.triu(apart <= _JOINED, 1))
        starts, ends = placed[firsts, :2], placed[seconds, :2]
        numbers = np.array(names)
        driven = (numbers[seconds] == numbers[firsts] + 1) & (apart[firsts, seconds] <= _DROVE)
        # Nothing stands between places where the robot was that are nearer to each other than it is wide.
        beside = apart[firsts, seconds] <= self._keep
        joined = (near[firsts] & near[seconds]) & (driven | beside | ground.clear(starts, ends))
        passed = crosses(np.concatenate((starts, ends), axis=1), doors)
        for i, k, door in zip(firsts[joined].tolist(), seconds[joined].tolist(), passed[joined].tolist(), strict=True):
            self.roadmap.add_edge(names[i], names[k], length=float(apart[i, k]), door=door)

    def _find(self, names: list[int], placed: Float64, ground: Ground, pose: Float64, doors: Float64) -> None:
        """Find the frontiers, and the rooms that nobody entered: these may be seen from outside as a whole."""
        for frontier in ground.frontiers():
            keyframe = names[frontier.keyframe]
            ways = np.concatenate((frontier.points[:-1], frontier.points[1:]), axis=1)
            # Who looks from one through a door looks into the other.
            hallway = self._outlooks[keyframe].hallway != bool(crosses(ways, doors).any())
            self._open(keyframe, placed[frontier.keyframe], frontier.points, pose, hallway=hallway)
        for room in ground.beyond(doors):
            self._open(names[room.keyframe], placed[room.keyframe], room.points, pose, hallway=False)

    def _open(self, keyframe: int, at: Float64, points: Float64, pose: Float64, *, hallway: bool) -> None:
        """Add what is open near the robot.

        :param at: pose of the keyframe from which the way (n, 2) leads there.
        """
        if _is_near(points[-1], pose):
            self.frontiers.append(Opened(keyframe, se2.transform(se2.inverse(at), points), hallway))

    def distances(self, start: int) -> dict[int, float]:
        """{keyframe: how far it is to there from ``start``, m}, of those that can be reached."""
        return dict(nx.single_source_dijkstra_path_length(self.roadmap, start, weight="length"))

    def path(self, start: int, end: int) -> list[int]:
        """The shortest way over keyframes, both ends included.

        :raises networkx.NetworkXNoPath: where there is none.
        """
        return list(nx.dijkstra_path(self.roadmap, start, end, weight="length"))

    def way_back(self, start: int) -> list[int]:
        """Over the keyframes before one, the newest first; where the robot came from elsewhere, the shortest way."""
        way = [start]
        for keyframe in sorted((one for one in self.distances(start) if one < start), reverse=True):
            way += self.path(way[-1], keyframe)[1:]
        return way

    def chambers(self) -> list[set[int]]:
        """The keyframes of hallways and of rooms, each one chamber.

        Doors end a chamber, but for those behind which there is no hallway: what one gets to from a room alone, such as
        by a gap between furniture, is part of that room.
        """
        parts = sorted(nx.connected_components(self._within_doors()), key=min)
        number = {keyframe: k for k, part in enumerate(parts) for keyframe in part}
        near = ((a, b) for a, b, length in self.roadmap.edges(data="length") if length <= _BESIDE)
        beside: list[Counter[int]] = [Counter() for _ in parts]
        for a, b in near:
            if number[a] != number[b]:
                beside[number[a]][number[b]] += 1
                beside[number[b]][number[a]] += 1
        rooms = {k for k, part in enumerate(parts) if self.is_room(part)}
        whole = nx.empty_graph(len(parts))
        within = (k for k in sorted(rooms) if beside[k] and rooms >= set(beside[k]))
        whole.add_edges_from((k, beside[k].most_common(1)[0][0]) for k in within)
        return [set().union(*(parts[k] for k in group)) for group in nx.connected_components(whole)]

    def room_of(self, keyframe: int) -> tuple[int, ...]:
        """The keyframes around one, the nearest first, if its chamber is a room; none where that is a hallway."""
        chamber = next((own for own in self.chambers() if keyframe in own), set())
        return self._around(keyframe) if self.is_room(chamber) else ()

    def rooms(self) -> list[tuple[int, ...]]:
        """Of every room that was entered, the first one first, the keyframes around its middle as in `room_of`."""
        rooms = sorted((own for own in self.chambers() if len(own) >= _FEW and self.is_room(own)), key=min)
        return [self._around(nx.barycenter(self.roadmap.subgraph(room), weight="length")[0]) for room in rooms]

    def is_room(self, chamber: Collection[int]) -> bool:
        """Whether half of a chamber looks like a room: the end of a hallway does, but not all of the hallway."""
        hallways = sum(self._outlooks[keyframe].hallway for keyframe in chamber)
        return len(chamber) > 0 and hallways <= 0.5 * len(chamber)

    def _around(self, keyframe: int) -> tuple[int, ...]:
        beside = {
            other: edge["length"]
            for other, edge in self.roadmap[keyframe].items()
            if edge["length"] <= _BESIDE and not edge["door"]
        }
        return (keyframe, *sorted(beside, key=lambda other: (beside[other], other)))

    def _within_doors(self) -> nx.Graph:
        """The roadmap without ways through doors."""
        within = nx.Graph()
        within.add_nodes_from(self.roadmap)
        within.add_edges_from((a, b) for a, b, door in self.roadmap.edges(data="door") if not door)
        return within


def _is_near(place: Float64, pose: Float64) -> bool:
    return math.dist(place[:2], pose[:2]) <= _UP_TO_DATE
