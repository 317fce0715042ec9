"""Doors that the robot's path passes: openings around it are tracked, and keyframes divided by those it went through.

A portal of a finished map lies on an arc; a passage is for area abstraction. The openings around the robot are
landmarks of its way: what keyframes before a door show of it counts for one behind it too, from where a laser that
looks ahead sees nothing of the door. A passage begins a segment; passing the same opening again leads back. Openings
are seen by the landmarks of Tomatis, Nourbakhsh and Siegwart (2003), which come in by the protocols below.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.sensors import Scan

MAX_STEP = 1.5
"""Keyframes that are farther apart than this, m, are no step of a path."""

SAME_OPENING_DISTANCE = 0.6
"""Openings that are nearer to each other than this, m, are one."""

MIN_PROBABILITY = 0.5
"""An opening that is less probable is none that one passes."""


class OpeningView(Protocol):
    """What one keyframe shows of openings.

    :ivar pose: the belief over the pose of the keyframe, ``area_T_base``.
    """

    @property
    def pose(self) -> PoseGaussian:
        """``area_T_base``."""
        ...

    def openings(self, known: Sequence[Landmark], pose: PoseGaussian) -> tuple[Landmark, ...]:
        """The openings around the robot, after those that were known were observed again.

        :param known: openings in the frame of the area.
        :param pose: the belief over ``area_T_base`` by which they are observed.
        """
        ...


class OpeningDetector(Protocol):
    """What sees openings around the robot: the landmarks, where the partition asks for doors."""

    def sees_around(self, scan: Scan) -> bool:
        """Whether a scan shows what is all around by itself, so that no other keyframes are needed."""
        ...

    def view(self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64) -> OpeningView:
        """What one keyframe shows, in the map of it and of others around it.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        :param around: scans of the others.
        :param poses: shape (n, 3), theirs.
        """
        ...


# Keyframe events over which a passage shows at the latest, where its opening was not known when the path passed it.
_MAX_DELAY = 6


@dataclass(frozen=True, eq=False)
class DoorCrossing:
    """Where the path went through an opening.

    :ivar event: the first keyframe event behind it.
    :ivar pose: shape (3,), ``area_T_opening``, in the robot's area, with the heading in which the path went.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class PathPose:
    """Where the robot was.

    :ivar event: the keyframe event.
    :ivar pose: shape (3,), ``area_T_base``, in the robot's area.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class DoorTracker:
    """What is known of the openings that the path passes, in the frame of the robot's area; a value.

    :ivar openings: around the robot.
    :ivar path: the newest ones, in order.
    :ivar crossings: since the robot entered the area, in order.
    """

    openings: tuple[Landmark, ...] = ()
    path: tuple[PathPose, ...] = ()
    crossings: tuple[DoorCrossing, ...] = ()

    def update(self, event: int, pose: PoseGaussian, around: OpeningView) -> DoorTracker:
        """After a keyframe event.

        :param pose: the belief over ``area_T_base``.
        :param around: what the keyframe shows of openings.
        """
        openings = around.openings(self.openings, pose)
        steps = (*self.path, PathPose(event, pose.mean))[-_MAX_DELAY - 1 :]
        passages = list(self.crossings)
        for passage in _find_door_crossings(steps, openings):
            before = _last_crossing_at(passages, passage.pose)
            if before is None or not _is_same_direction(passages[before].pose, passage.pose):
                passages.append(passage)
        return DoorTracker(openings, steps, tuple(sorted(passages, key=lambda passage: passage.event)))

    def transform(self, frame: Float64) -> DoorTracker:
        """The same in another area's frame.

        :param frame: shape (3,), ``other_T_area``.
        """
        by = PoseGaussian.from_pose(frame)
        return DoorTracker(
            tuple(replace(one, pose=by.compose(one.pose)) for one in self.openings),
            tuple(replace(step, pose=se2.compose(frame, step.pose)) for step in self.path),
            tuple(replace(passage, pose=se2.compose(frame, passage.pose)) for passage in self.crossings),
        )

    def keep_crossings_after(self, event: int | None) -> DoorTracker:
        """The same with the passages behind an event alone, None for none of them."""
        return replace(self, crossings=tuple(one for one in self.crossings if event is not None and one.event > event))

    def break_path(self) -> DoorTracker:
        """The same where the robot, or what is around it, was moved: what comes next is no step from here."""
        return DoorTracker(crossings=self.crossings)

    def segment_labels(self, keyframes: Collection[int]) -> dict[int, int]:
        """{keyframe: number of its segment}, of keyframes since the robot entered its area, in segment 0."""
        numbers, begins = [0], [0]
        for k, passage in enumerate(self.crossings):
            back = _last_crossing_at(self.crossings[:k], passage.pose)
            numbers.append(max(numbers) + 1 if back is None else numbers[back])
            begins.append(passage.event)
        return {k: numbers[int(np.searchsorted(begins, k, side="right")) - 1] for k in keyframes}


def _find_door_crossings(steps: Sequence[PathPose], openings: Sequence[Landmark]) -> list[DoorCrossing]:
    """All passages of openings that are there, in the order of events."""
    path = np.array([step.pose[:2] for step in steps])
    found = []
    for opening in openings:
        if opening.existence.probability < MIN_PROBABILITY:
            continue
        for at, forwards in find_crossings(path, opening.pose.mean, opening.width):
            k = int(at)
            if np.hypot(*(path[k + 1] - path[k])) <= MAX_STEP:
                turned = se2.compose(opening.pose.mean, (0.0, 0.0, 0.0 if forwards else np.pi))
                found.append(DoorCrossing(steps[k + 1].event, turned))
    return sorted(found, key=lambda passage: passage.event)


def _last_crossing_at(passages: Sequence[DoorCrossing], pose: Float64) -> int | None:
    """Number of the last passage of the opening at a pose."""
    near = [k for k, one in enumerate(passages) if np.hypot(*(one.pose[:2] - pose[:2])) < SAME_OPENING_DISTANCE]
    return near[-1] if near else None


def _is_same_direction(one: Float64, other: Float64) -> bool:
    """Whether two headings are less than a right angle apart."""
    return bool(np.cos(one[2] - other[2]) > 0.0)


def find_crossings(path: Float64, opening: Float64, width: float) -> Iterator[tuple[float, bool]]:
    """Where a path (n, 2) passes an opening (3,), in steps from its begin; and whether it goes ahead there.

    :param width: of the opening, m.
    """
    local = se2.transform(se2.inverse(opening), path)
    for k in np.flatnonzero((local[:-1, 0] < 0.0) != (local[1:, 0] < 0.0)).tolist():
        share = local[k, 0] / (local[k, 0] - local[k + 1, 0])
        if abs(local[k, 1] + share * (local[k + 1, 1] - local[k, 1])) <= 0.5 * width:
            yield k + float(share), bool(local[k, 0] < 0.0)
