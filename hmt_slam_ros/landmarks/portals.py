"""Portals: openings through which the robot's path passed, in a stored map and while it drives.

What Tomatis, Nourbakhsh and Siegwart (2003), section 2.1, have as nodes of a graph, is an annotation of arcs here. An
area ends where sensed space overlaps least (AAM), which may be a step or two beside the door; so the stretch of the
path around the change of areas counts, and of the openings that it passes the one that is nearest to the change.

What portals are on a map that is finished (`topology.portals`), a passage is for area abstraction. The openings around
the robot are landmarks of its way: what keyframes before a door show of it counts for one behind it too, from where a
laser that looks ahead sees nothing of the door. A passage begins a chamber; passing the same opening again leads back.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import telling_arc
from hmt_slam_ros.landmarks.beam_labels import Rays
from hmt_slam_ros.landmarks.landmark_map import Landmark, LandmarkMap
from hmt_slam_ros.landmarks.landmarks import OPENING, Landmarks

STEP = 1.5
"""Keyframes that are farther apart than this, m, are no step of a path."""

SAME = 0.6
"""Openings that are nearer to each other than this, m, are one."""

LEAST = 0.5
"""An opening that is less probable is none that one passes."""

_TURNED = PoseGaussian.exactly(np.array([0.0, 0.0, np.pi]))


@dataclass(frozen=True, eq=False)
class Portal:
    """An opening between two areas a < b.

    :ivar areas: a and b.
    :ivar pose_in_a: the belief over ``a_T_portal``, the middle between the jambs, with the heading from a to b.
    :ivar pose_in_b: the belief over ``b_T_portal``, likewise.
    :ivar width: m.
    :ivar width_deviation: of this, m.
    :ivar existence: probability that it is there.
    :ivar passages: how often the path changes areas there.
    """

    areas: tuple[int, int]
    pose_in_a: PoseGaussian
    pose_in_b: PoseGaussian
    width: float
    width_deviation: float
    existence: float
    passages: int = 1


def portals_of(
    hybrid_map: HybridMap, landmarks: Mapping[int, Sequence[Landmark]], features: Features
) -> tuple[Portal, ...]:
    """All portals of a map, ordered by their areas.

    :param landmarks: {area: its landmarks}, of all areas.
    """
    found: list[Portal] = []
    for portal in _openings_passed(hybrid_map, landmarks, features):
        k = next((k for k, known in enumerate(found) if _same(known, portal)), None)
        if k is None:
            found.append(portal)
        else:
            better = max(found[k], portal, key=lambda one: one.existence)
            found[k] = replace(better, passages=found[k].passages + 1)
    return tuple(sorted(found, key=lambda portal: portal.areas))


def _same(one: Portal, other: Portal) -> bool:
    """Whether two portals are one, seen in both faces of a wall or at two passages."""
    away = one.pose_in_a.mean[:2] - other.pose_in_a.mean[:2]
    return one.areas == other.areas and float(np.hypot(*away)) < SAME


def _openings_passed(
    hybrid_map: HybridMap, landmarks: Mapping[int, Sequence[Landmark]], features: Features
) -> Iterator[Portal]:
    """The portal at every change of areas along the path that passes one."""
    poses = {area: hybrid_map.keyframes(area) for area in hybrid_map.area_ids()}
    own = {area: sorted(within) for area, within in poses.items()}
    path = sorted((keyframe, area) for area, within in own.items() for keyframe in within)
    for (_, left), (keyframe, entered) in pairwise(path):
        arc = telling_arc(hybrid_map, left, entered) if left != entered else None
        if arc is None:
            continue
        back = (poses[left][k] for k in reversed(own[left][: bisect_left(own[left], keyframe)]))
        ahead = (se2.compose(arc.mean, poses[entered][k]) for k in own[entered][bisect_left(own[entered], keyframe) :])
        ways = [_near(way, features) for way in (back, ahead)]
        if np.hypot(*(ways[0][0] - ways[1][0])) <= STEP:
            around = np.concatenate((ways[0][::-1], ways[1]))
            yield from _nearest(around, len(ways[0]) - 0.5, (left, entered), arc, landmarks)


def _near(way: Iterable[Float64], features: Features) -> Float64:
    """The places (n, 2) of a way of poses that are near to its begin, up to the first step that is no step."""
    near: list[Float64] = []
    far = 0.0
    for pose in way:
        step = math.dist(pose[:2], near[-1]) if near else 0.0
        far += step
        if step > STEP or far > features.portal_reach:
            break
        near.append(pose[:2])
    return np.array(near)


def _nearest(
    path: Float64, change: float, areas: tuple[int, int], arc: PoseGaussian, landmarks: Mapping[int, Sequence[Landmark]]
) -> list[Portal]:
    """The portal that a path (n, 2) in the frame of the area that it leaves passes nearest to the change; none or one.

    :param change: where the areas change, in steps from the path's begin.
    """
    passed: list[tuple[float, float, Portal]] = []
    for own, area in enumerate(areas):
        frame = arc.mean if own else np.zeros(3)
        for opening in landmarks[area]:
            if opening.kind != OPENING or opening.existence.probability < LEAST:
                continue
            for at, forwards in crossings(path, se2.compose(frame, opening.pose.mean), opening.width):
                portal = _portal(opening, forwards, areas, own, arc)
                passed.append((abs(at - change), -portal.existence, portal))
    return [min(passed, key=lambda each: each[:2])[2]] if passed else []


def crossings(path: Float64, opening: Float64, width: float) -> Iterator[tuple[float, bool]]:
    """Where a path (n, 2) passes an opening (3,), in steps from its begin; and whether it goes ahead there.

    :param width: of the opening, m.
    """
    local = se2.transform(se2.inverse(opening), path)
    for k in np.flatnonzero((local[:-1, 0] < 0.0) != (local[1:, 0] < 0.0)).tolist():
        share = local[k, 0] / (local[k, 0] - local[k + 1, 0])
        if abs(local[k, 1] + share * (local[k + 1, 1] - local[k, 1])) <= 0.5 * width:
            yield k + float(share), bool(local[k, 0] < 0.0)


def _portal(opening: Landmark, forwards: bool, areas: tuple[int, int], own: int, arc: PoseGaussian) -> Portal:
    """An opening of one of two areas as the portal between them.

    :param forwards: whether the path goes through it in its own heading, from the first of the areas to the second.
    :param own: which of the two areas knows it.
    :param arc: the belief over the second area's pose in the first.
    """
    towards = forwards == (areas[0] < areas[1])
    pose = opening.pose if towards else opening.pose.compose(_TURNED)
    poses = (pose, arc.inverse().compose(pose)) if own == 0 else (arc.compose(pose), pose)
    if areas[0] > areas[1]:
        areas, poses = (areas[1], areas[0]), (poses[1], poses[0])
    return Portal(areas, *poses, opening.width, opening.width_deviation, opening.existence.probability)


# Keyframe events over which a passage shows at the latest, where its opening was not known when the path passed it.
_LATE = 6


@dataclass(frozen=True, eq=False)
class Passage:
    """Where the path went through an opening.

    :ivar event: the first keyframe event behind it.
    :ivar pose: shape (3,), ``area_T_opening``, in the robot's area, with the heading in which the path went.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class Step:
    """Where the robot was.

    :ivar event: the keyframe event.
    :ivar pose: shape (3,), ``area_T_base``, in the robot's area.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class Way:
    """What is known of the openings that the path passes, in the frame of the robot's area; a value.

    :ivar openings: around the robot.
    :ivar steps: the newest ones, in order.
    :ivar passages: since the robot entered the area, in order.
    """

    openings: tuple[Landmark, ...] = ()
    steps: tuple[Step, ...] = ()
    passages: tuple[Passage, ...] = ()

    def seen(self, event: int, pose: PoseGaussian, seen: Landmarks, rays: Rays, features: Features) -> Way:
        """After a keyframe event.

        :param pose: the belief over ``area_T_base``.
        :param seen: the landmarks around, in the frame of the base.
        :param rays: the beams around, likewise.
        """
        known = LandmarkMap(features)
        known.landmarks = list(self.openings)
        known.observe(pose, _openings(seen), rays)
        openings = tuple(
            one for one in known.landmarks if np.hypot(*(one.pose.mean[:2] - pose.mean[:2])) <= features.landmark_reach
        )
        steps = (*self.steps, Step(event, pose.mean))[-_LATE - 1 :]
        passages = list(self.passages)
        for passage in _passed(steps, openings):
            before = _last_at(passages, passage.pose)
            if before is None or not _alike(passages[before].pose, passage.pose):
                passages.append(passage)
        return Way(openings, steps, tuple(sorted(passages, key=lambda passage: passage.event)))

    def in_frame(self, frame: Float64) -> Way:
        """The same in another area's frame.

        :param frame: shape (3,), ``other_T_area``.
        """
        by = PoseGaussian.exactly(frame)
        return Way(
            tuple(replace(one, pose=by.compose(one.pose)) for one in self.openings),
            tuple(replace(step, pose=se2.compose(frame, step.pose)) for step in self.steps),
            tuple(replace(passage, pose=se2.compose(frame, passage.pose)) for passage in self.passages),
        )

    def since(self, event: int | None) -> Way:
        """The same with the passages behind an event alone, None for none of them."""
        return replace(self, passages=tuple(one for one in self.passages if event is not None and one.event > event))

    def interrupted(self) -> Way:
        """The same where the robot, or what is around it, was moved: what comes next is no step from here."""
        return Way(passages=self.passages)

    def chambers(self, keyframes: Collection[int]) -> dict[int, int]:
        """{keyframe: number of its chamber}, of keyframes since the robot entered its area, in chamber 0."""
        numbers, begins = [0], [0]
        for k, passage in enumerate(self.passages):
            back = _last_at(self.passages[:k], passage.pose)
            numbers.append(max(numbers) + 1 if back is None else numbers[back])
            begins.append(passage.event)
        return {k: numbers[int(np.searchsorted(begins, k, side="right")) - 1] for k in keyframes}


def _openings(seen: Landmarks) -> Landmarks:
    """The openings among landmarks."""
    chosen = seen.kinds == OPENING
    return Landmarks(*(column[chosen] for column in seen))


def _passed(steps: Sequence[Step], openings: Sequence[Landmark]) -> list[Passage]:
    """All passages of openings that are there, in the order of events."""
    path = np.array([step.pose[:2] for step in steps])
    found = []
    for opening in openings:
        if opening.existence.probability < LEAST:
            continue
        for at, forwards in crossings(path, opening.pose.mean, opening.width):
            k = int(at)
            if np.hypot(*(path[k + 1] - path[k])) <= STEP:
                turned = se2.compose(opening.pose.mean, (0.0, 0.0, 0.0 if forwards else np.pi))
                found.append(Passage(steps[k + 1].event, turned))
    return sorted(found, key=lambda passage: passage.event)


def _last_at(passages: Sequence[Passage], pose: Float64) -> int | None:
    """Number of the last passage of the opening at a pose."""
    near = [k for k, one in enumerate(passages) if np.hypot(*(one.pose[:2] - pose[:2])) < SAME]
    return near[-1] if near else None


def _alike(one: Float64, other: Float64) -> bool:
    """Whether two headings are less than a right angle apart."""
    return bool(np.cos(one[2] - other[2]) > 0.0)
