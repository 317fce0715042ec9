"""Doors on the robot's path: openings around it are tracked, and keyframes divided by the openings it crossed.

The openings that keyframes before a door show count for those behind it too, from where a laser that looks ahead does
not see the door. A crossing begins a segment; crossing the same opening again leads back to the former one. Openings
are detected by the landmarks of Tomatis, Nourbakhsh and Siegwart (2003), which plug in by the protocols below.
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
"""Largest distance between two keyframes that are a step of a path, m."""

SAME_OPENING_DISTANCE = 0.6
"""Distance below which two openings are the same, m."""

MIN_PROBABILITY = 0.5
"""Smallest existence of an opening that can be crossed."""

_MAX_DELAY = 6
"""Keyframe events after a crossing within which its opening may be detected."""


class OpeningView(Protocol):
    """The openings that one keyframe shows.

    :ivar pose: the belief over the pose of the keyframe, ``area_T_base``.
    """

    @property
    def pose(self) -> PoseGaussian:
        """``area_T_base``."""
        ...

    def openings(self, known: Sequence[Landmark], pose: PoseGaussian) -> tuple[Landmark, ...]:
        """The openings around the robot, after another observation of the known ones.

        :param known: openings in the frame of the area.
        :param pose: the belief over ``area_T_base`` of the observation.
        """
        ...


class OpeningDetector(Protocol):
    """Detects openings around the robot, for a partition by doors."""

    def sees_around(self, scan: Scan) -> bool:
        """Whether a scan shows the whole surroundings, so that no other keyframes are needed."""
        ...

    def view(self, scan: Scan, pose: Float64, around: Iterable[Scan], poses: Float64) -> OpeningView:
        """The openings that one keyframe shows, in the map of it and of others around it.

        :param pose: its ``area_T_base``, shape (3,), m and rad.
        :param around: scans of the others.
        :param poses: shape (n, 3), theirs.
        """
        ...


@dataclass(frozen=True, eq=False)
class DoorCrossing:
    """A crossing of an opening.

    :ivar event: the first keyframe event behind it.
    :ivar pose: shape (3,), ``area_T_opening``, in the robot's area, with the heading of the path.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class PathPose:
    """A pose of the robot's path.

    :ivar event: the keyframe event.
    :ivar pose: shape (3,), ``area_T_base``, in the robot's area.
    """

    event: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class DoorTracker:
    """The openings on the robot's path, in the frame of its area; a value.

    :ivar openings: around the robot.
    :ivar path: its newest poses, in order.
    :ivar crossings: since the robot entered the area, in order.
    """

    openings: tuple[Landmark, ...] = ()
    path: tuple[PathPose, ...] = ()
    crossings: tuple[DoorCrossing, ...] = ()

    def update(self, event: int, pose: PoseGaussian, around: OpeningView) -> DoorTracker:
        """The tracker after a keyframe event.

        :param pose: the belief over ``area_T_base``.
        :param around: the openings that the keyframe shows.
        """
        openings = around.openings(self.openings, pose)
        path = (*self.path, PathPose(event, pose.mean))[-_MAX_DELAY - 1 :]
        crossings = list(self.crossings)
        for crossing in _find_door_crossings(path, openings):
            last = _last_crossing_at(crossings, crossing.pose)
            # The last one in the same direction is the same crossing.
            if last is None or np.cos(crossings[last].pose[2] - crossing.pose[2]) <= 0.0:
                crossings.append(crossing)
        return DoorTracker(openings, path, tuple(sorted(crossings, key=lambda crossing: crossing.event)))

    def transform(self, frame: Float64) -> DoorTracker:
        """The tracker in another area's frame.

        :param frame: shape (3,), ``other_T_area``.
        """
        belief = PoseGaussian.from_pose(frame)
        return DoorTracker(
            tuple(replace(opening, pose=belief.compose(opening.pose)) for opening in self.openings),
            tuple(replace(step, pose=se2.compose(frame, step.pose)) for step in self.path),
            tuple(replace(crossing, pose=se2.compose(frame, crossing.pose)) for crossing in self.crossings),
        )

    def keep_crossings_after(self, event: int | None) -> DoorTracker:
        """The tracker with the crossings after an event only; with none of them for None."""
        crossings = tuple(crossing for crossing in self.crossings if event is not None and crossing.event > event)
        return replace(self, crossings=crossings)

    def break_path(self) -> DoorTracker:
        """The tracker after the robot or its surroundings were moved, so that the next pose is no step of the path."""
        return DoorTracker(crossings=self.crossings)

    def segment_labels(self, keyframes: Collection[int]) -> dict[int, int]:
        """{keyframe: number of its segment} of keyframes since the robot entered its area, in segment 0."""
        labels, first_events = [0], [0]
        for k, crossing in enumerate(self.crossings):
            last = _last_crossing_at(self.crossings[:k], crossing.pose)
            labels.append(max(labels) + 1 if last is None else labels[last])
            first_events.append(crossing.event)
        return {k: labels[int(np.searchsorted(first_events, k, side="right")) - 1] for k in keyframes}


def _find_door_crossings(steps: Sequence[PathPose], openings: Sequence[Landmark]) -> list[DoorCrossing]:
    """All crossings of openings that exist, in the order of events."""
    path = np.array([step.pose[:2] for step in steps])
    crossings = []
    for opening in openings:
        if opening.existence.probability < MIN_PROBABILITY:
            continue
        for position, is_forward in find_crossings(path, opening.pose.mean, opening.width):
            k = int(position)
            if np.hypot(*(path[k + 1] - path[k])) <= MAX_STEP:
                pose = se2.compose(opening.pose.mean, (0.0, 0.0, 0.0 if is_forward else np.pi))
                crossings.append(DoorCrossing(steps[k + 1].event, pose))
    return sorted(crossings, key=lambda crossing: crossing.event)


def _last_crossing_at(crossings: Sequence[DoorCrossing], pose: Float64) -> int | None:
    """Index of the last crossing of the opening at a pose, or None."""
    near = [k for k, c in enumerate(crossings) if np.hypot(*(c.pose[:2] - pose[:2])) < SAME_OPENING_DISTANCE]
    return near[-1] if near else None


def find_crossings(path: Float64, opening: Float64, width: float) -> Iterator[tuple[float, bool]]:
    """Where a path (n, 2) crosses an opening (3,), in steps from its start, and whether along its heading.

    :param width: of the opening, m.
    """
    local = se2.transform(se2.inverse(opening), path)
    for k in np.flatnonzero((local[:-1, 0] < 0.0) != (local[1:, 0] < 0.0)).tolist():
        share = local[k, 0] / (local[k, 0] - local[k + 1, 0])
        if abs(local[k, 1] + share * (local[k + 1, 1] - local[k, 1])) <= 0.5 * width:
            yield k + float(share), bool(local[k, 0] < 0.0)
