"""Portals: openings through which the robot's path passed from one area into another.

They are the graph nodes of Tomatis, Nourbakhsh and Siegwart (2003), section 2.1; here they annotate arcs. An area may
end a step or two beside its door. So of the openings on the path around the change of areas, the nearest one counts.
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
    :ivar pose_in_a: belief over ``a_T_portal``, the middle between the jambs, with the heading from a to b.
    :ivar pose_in_b: belief over ``b_T_portal``, likewise.
    :ivar width: m.
    :ivar width_deviation: of this, m.
    :ivar existence: its probability.
    :ivar crossing_count: changes of areas there.
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
            better = max(found[k], portal, key=lambda each: each.existence)
            found[k] = replace(better, crossing_count=found[k].crossing_count + 1)
    return tuple(sorted(found, key=lambda portal: portal.areas))


def _is_same_portal(first: Portal, second: Portal) -> bool:
    """Whether two portals are one, on both faces of a wall or at two crossings."""
    offset = first.pose_in_a.mean[:2] - second.pose_in_a.mean[:2]
    return first.areas == second.areas and float(np.hypot(*offset)) < SAME_OPENING_DISTANCE


def _portals_along_path(
    hybrid_map: HybridMap, landmarks: Mapping[int, Sequence[Landmark]], features: FeatureParameters
) -> Iterator[Portal]:
    """The portal of each change of areas on the path; none where no opening is passed."""
    poses = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    own = {area: sorted(within) for area, within in poses.items()}
    path = sorted((keyframe, area) for area, within in own.items() for keyframe in within)
    for (_, left), (keyframe, entered) in pairwise(path):
        arc = informative_arc(hybrid_map, left, entered) if left != entered else None
        if arc is None:
            continue
        back = (poses[left][k] for k in reversed(own[left][: bisect_left(own[left], keyframe)]))
        ahead = (se2.compose(arc.mean, poses[entered][k]) for k in own[entered][bisect_left(own[entered], keyframe) :])
        before, after = (_nearby_path(poses_on_path, features) for poses_on_path in (back, ahead))
        if np.hypot(*(before[0] - after[0])) <= MAX_STEP:
            around = np.concatenate((before[::-1], after))
            yield from _nearest_portal(around, len(before) - 0.5, (left, entered), arc, landmarks)


def _nearby_path(poses: Iterable[Float64], features: FeatureParameters) -> Float64:
    """The positions (n, 2) of poses within reach of the first along their path, up to a step that is too long."""
    near: list[Float64] = []
    length = 0.0
    for pose in poses:
        step = math.dist(pose[:2], near[-1]) if near else 0.0
        length += step
        if step > MAX_STEP or length > features.portal_reach:
            break
        near.append(pose[:2])
    return np.array(near)


def _nearest_portal(
    path: Float64, change: float, areas: tuple[int, int], arc: PoseGaussian, landmarks: Mapping[int, Sequence[Landmark]]
) -> list[Portal]:
    """The portal nearest to a change of areas on a path (n, 2) in the frame of the first area; none or one.

    :param change: position of the change, in steps from the path's begin.
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

    :param forwards: whether the path, from the first area to the second, passes it in its own heading.
    :param own: index of the area of the opening.
    :param arc: belief over the second area's pose in the first.
    """
    towards = forwards == (areas[0] < areas[1])
    pose = opening.pose if towards else opening.pose.compose(_HALF_TURN)
    poses = (pose, arc.inverse().compose(pose)) if own == 0 else (arc.compose(pose), pose)
    if areas[0] > areas[1]:
        areas, poses = (areas[1], areas[0]), (poses[1], poses[0])
    return Portal(areas, *poses, opening.width, opening.width_deviation, opening.existence.probability)
