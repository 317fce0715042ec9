"""Portals: openings through which the robot's path passed from one area into another.

What Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, have as nodes of a graph, is an annotation of arcs here. An
area ends where sensed space overlaps least (AAM), which may be a step or two beside the door; so the stretch of the
path around the change of areas counts, and of the openings that it passes the one that is nearest to the change.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hmt_slam_ros.area_abstraction.doors import MAX_STEP, MIN_PROBABILITY, SAME_OPENING_DISTANCE, find_crossings
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.hybrid_map.shortest_path import informative_arc
from hmt_slam_ros.landmarks.landmarks import OPENING

_HALF_TURN = PoseGaussian.from_pose(np.array([0.0, 0.0, np.pi]))


@dataclass(frozen=True, eq=False)
class Portal:
    """An opening between two areas a < b.

    :ivar areas: a and b.
    :ivar pose_in_a: the belief over ``a_T_portal``, the middle between the jambs, with the heading from a to b.
    :ivar pose_in_b: the belief over ``b_T_portal``, likewise.
    :ivar width: m.
    :ivar width_deviation: of this, m.
    :ivar existence: probability that it is there.
    :ivar crossing_count: how often the path changes areas there.
    """

    areas: tuple[int, int]
    pose_in_a: PoseGaussian
    pose_in_b: PoseGaussian
    width: float
    width_deviation: float
    existence: float
    crossing_count: int = 1


def find_portals(
    hybrid_map: HybridMap, landmarks: Mapping[int, Sequence[Landmark]], features: FeatureParameters
) -> tuple[Portal, ...]:
    """All portals of a map, ordered by their areas.

    :param landmarks: {area: its landmarks}, of all areas.
    """
    found: list[Portal] = []
    for portal in _portals_along_path(hybrid_map, landmarks, features):
        k = next((k for k, known in enumerate(found) if _is_same_portal(known, portal)), None)
        if k is None:
            found.append(portal)
        else:
            better = max(found[k], portal, key=lambda one: one.existence)
            found[k] = replace(better, crossing_count=found[k].crossing_count + 1)
    return tuple(sorted(found, key=lambda portal: portal.areas))


def _is_same_portal(one: Portal, other: Portal) -> bool:
    """Whether two portals are one, seen in both faces of a wall or at two passages."""
    away = one.pose_in_a.mean[:2] - other.pose_in_a.mean[:2]
    return one.areas == other.areas and float(np.hypot(*away)) < SAME_OPENING_DISTANCE


def _portals_along_path(
    hybrid_map: HybridMap, landmarks: Mapping[int, Sequence[Landmark]], features: FeatureParameters
) -> Iterator[Portal]:
    """The portal at every change of areas along the path that passes one."""
    poses = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    own = {area: sorted(within) for area, within in poses.items()}
    path = sorted((keyframe, area) for area, within in own.items() for keyframe in within)
    for (_, left), (keyframe, entered) in pairwise(path):
        arc = informative_arc(hybrid_map, left, entered) if left != entered else None
        if arc is None:
            continue
        back = (poses[left][k] for k in reversed(own[left][: bisect_left(own[left], keyframe)]))
        ahead = (se2.compose(arc.mean, poses[entered][k]) for k in own[entered][bisect_left(own[entered], keyframe) :])
        ways = [_nearby_path(way, features) for way in (back, ahead)]
        if np.hypot(*(ways[0][0] - ways[1][0])) <= MAX_STEP:
            around = np.concatenate((ways[0][::-1], ways[1]))
            yield from _nearest_portal(around, len(ways[0]) - 0.5, (left, entered), arc, landmarks)


def _nearby_path(way: Iterable[Float64], features: FeatureParameters) -> Float64:
    """The places (n, 2) of a way of poses that are near to its begin, up to the first step that is no step."""
    near: list[Float64] = []
    far = 0.0
    for pose in way:
        step = math.dist(pose[:2], near[-1]) if near else 0.0
        far += step
        if step > MAX_STEP or far > features.portal_reach:
            break
        near.append(pose[:2])
    return np.array(near)


def _nearest_portal(
    path: Float64, change: float, areas: tuple[int, int], arc: PoseGaussian, landmarks: Mapping[int, Sequence[Landmark]]
) -> list[Portal]:
    """The portal that a path (n, 2) in the frame of the area that it leaves passes nearest to the change; none or one.

    :param change: where the areas change, in steps from the path's begin.
    """
    passed: list[tuple[float, float, Portal]] = []
    for own, area in enumerate(areas):
        frame = arc.mean if own else np.zeros(3)
        for opening in landmarks[area]:
            if opening.kind != OPENING or opening.existence.probability < MIN_PROBABILITY:
                continue
            for at, forwards in find_crossings(path, se2.compose(frame, opening.pose.mean), opening.width):
                portal = _portal_from_opening(opening, forwards, areas, own, arc)
                passed.append((abs(at - change), -portal.existence, portal))
    return [min(passed, key=lambda each: each[:2])[2]] if passed else []


def _portal_from_opening(
    opening: Landmark, forwards: bool, areas: tuple[int, int], own: int, arc: PoseGaussian
) -> Portal:
    """An opening of one of two areas as the portal between them.

    :param forwards: whether the path goes through it in its own heading, from the first of the areas to the second.
    :param own: which of the two areas knows it.
    :param arc: the belief over the second area's pose in the first.
    """
    towards = forwards == (areas[0] < areas[1])
    pose = opening.pose if towards else opening.pose.compose(_HALF_TURN)
    poses = (pose, arc.inverse().compose(pose)) if own == 0 else (arc.compose(pose), pose)
    if areas[0] > areas[1]:
        areas, poses = (areas[1], areas[0]), (poses[1], poses[0])
    return Portal(areas, *poses, opening.width, opening.width_deviation, opening.existence.probability)
