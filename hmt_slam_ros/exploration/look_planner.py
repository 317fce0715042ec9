"""Plans the explorer's drives to looks that decide between hypotheses."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.path_follower import KeyframeLocator, Route
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.ambiguity import Ambiguity

_SAME_LOOK_DISTANCE = 1.0
"""Looks nearer to each other than this are one, m."""

_KEPT_RATE = 0.5
"""Share of the best look's information per meter from which on the robot keeps its goal: else it drives to and fro."""

_NOTHING_OPEN = Ambiguity(-1, 0.0, (), "")


class LookPlanner:
    """Chooses looks, each place once in a task."""

    def __init__(self) -> None:
        self._ambiguity = self._newest = _NOTHING_OPEN
        # Whether another ambiguity came since the target was chosen or kept.
        self._is_outdated = False
        self._target: tuple[int, Float64] | None = None
        # Each a point (2,) in the frame of a keyframe.
        self._tried: list[tuple[int, Float64]] = []

    def add(self, ambiguity: Ambiguity) -> None:
        """Add an ambiguity; between nodes it may come before the other messages of its event."""
        self._newest = ambiguity

    def update(self, event: int) -> None:
        """Go by the newest ambiguity, if the map is that of its event or of a later one.

        :param event: the last keyframe event of the map.
        """
        if self._newest is not self._ambiguity and self._newest.sequence <= event:
            self._ambiguity, self._is_outdated = self._newest, True

    @property
    def is_open(self) -> bool:
        """Whether several hypotheses are probable."""
        return self._ambiguity.is_open

    def forget_tries(self) -> None:
        """Begin another task, in which all looks are worth a drive."""
        self._tried = []

    def end_route(self) -> None:
        """Do not look there again in this task: the robot was there, or something is in the way."""
        if self._target is not None:
            self._tried.append(self._target)

    def has_look(self, locator: KeyframeLocator) -> bool:
        """Whether a look is worth a drive."""
        return self._best_look(locator) is not None

    def plan(self, locator: KeyframeLocator, keyframe: int, pose: Float64) -> Route | None:
        """The route to the best look, None where none is worth a drive.

        The way of a look may be known by another hypothesis alone. So it goes over the looks before, not the roadmap.

        :param keyframe: near the robot; points of the route are relative to it.
        :param pose: of the robot, ``area_T_base``, shape (3,).
        """
        self._is_outdated = False
        best = self._best_look(locator)
        if best is None:
            return None
        positions = np.array([_position(self._ambiguity, n, locator) for n in self._ambiguity.path(best)])
        ahead = positions[_next_on_path(positions, pose[:2]) :]
        anchor = se2.inverse(locator.keyframe_pose(keyframe))
        points = se2.transform(anchor, np.concatenate((pose[None, :2], ahead)))
        self._target = keyframe, points[-1]
        return Route((keyframe,) * len(points), points)

    def keeps_target(self, locator: KeyframeLocator, robot: Float64) -> bool:
        """Whether the look that the robot drives to still tells about as much as the best one.

        :param robot: position of the robot, frame of the locator's area, shape (2,), m.
        """
        if not self._is_outdated:
            return True
        if self._target is None or self._target[0] not in locator:
            return False
        target = se2.transform(locator.keyframe_pose(self._target[0]), self._target[1])
        self._is_outdated = math.dist(target, robot) >= _SAME_LOOK_DISTANCE and not self._tells(locator, target)
        return self.is_open and not self._is_outdated

    def _tells(self, locator: KeyframeLocator, place: Float64) -> bool:
        """Whether a look at a place tells about as much per meter as the best one."""
        best = self._best_look(locator)
        if best is None:
            return False
        rate = self._ambiguity.looks[best].rate
        positions = ((look, _position(self._ambiguity, n, locator)) for n, look in enumerate(self._ambiguity.looks))
        beside = [look.rate for look, at in positions if at is not None and math.dist(at, place) < _SAME_LOOK_DISTANCE]
        return max(beside, default=0.0) >= _KEPT_RATE * rate

    def _best_look(self, locator: KeyframeLocator) -> int | None:
        """The best look that was not tried, and whose path the map of the most probable hypothesis can place."""
        ambiguity = self._ambiguity
        tried = [se2.transform(locator.keyframe_pose(k), point) for k, point in self._tried if k in locator]
        excluded: list[int] = []
        while (best := ambiguity.best_look(excluded)) is not None:
            positions = [_position(ambiguity, n, locator) for n in ambiguity.path(best)]
            end = positions[-1]
            is_tried = end is not None and any(math.dist(end, place) < _SAME_LOOK_DISTANCE for place in tried)
            if not is_tried and all(position is not None for position in positions):
                return best
            excluded.append(best)
        return None


def _position(ambiguity: Ambiguity, look: int, locator: KeyframeLocator) -> Float64 | None:
    """Where a look is in the frame of the locator's area, (2,), m; None where no arc leads to its area."""
    area, pose = ambiguity.looks[look].area, ambiguity.looks[look].pose
    frame = locator.area_pose(area)
    return None if frame is None else se2.compose(frame, pose)[:2]


def _next_on_path(positions: Float64, robot: Float64) -> int:
    """The number of the position (n, 2) that is next for a robot at (2,): the nearest, or the one after that."""
    nearest = int(np.argmin(np.hypot(*(positions - robot).T)))
    if nearest + 1 == len(positions):
        return nearest
    following = positions[nearest + 1]
    return nearest + (math.dist(robot, following) < math.dist(positions[nearest], following))
