"""Routes over keyframes of an HMT map, and path following."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.robot import ExplorerParameters
from hmt_slam_ros.exploration.laser_views import ObstacleView
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.logs.stamps import NANOSECONDS


@dataclass(frozen=True, eq=False)
class Route:
    """A route over points relative to keyframes.

    :ivar keyframes: of the n points.
    :ivar points: shape (n, 2), each in the frame of its keyframe's base, m.
    """

    keyframes: tuple[int, ...]
    points: Float64

    @classmethod
    def through_keyframes(cls, first: Float64, keyframes: list[int], last: Float64) -> Route:
        """The route over the poses of keyframes.

        :param first: shape (i, 2), path to the first keyframe, in its frame, m.
        :param last: shape (k, 2), path from the last keyframe on, in its frame, m.
        """
        names = (*[keyframes[0]] * len(first), *keyframes, *[keyframes[-1]] * len(last))
        return cls(names, np.concatenate((first, np.zeros((len(keyframes), 2)), last)))


class KeyframeLocator:
    """Poses of keyframes relative to one area of a map."""

    def __init__(self, hybrid_map: HybridMap, area: int) -> None:
        self.area = area
        self._areas = {other: belief.mean for other, belief in shortest_path_beliefs(hybrid_map, area).items()}
        self._poses = {
            keyframe: (other, pose) for other in self._areas for keyframe, pose in hybrid_map.keyframes(other).items()
        }

    def __contains__(self, keyframe: object) -> bool:
        """Whether a keyframe is in the map."""
        return keyframe in self._poses

    def contains_route(self, route: Route) -> bool:
        """Whether all keyframes of a route are in the map."""
        return all(keyframe in self._poses for keyframe in route.keyframes)

    def area_pose(self, area: int) -> Float64 | None:
        """The pose of an area in the frame of this one, (3,), None where no arc leads there."""
        return self._areas.get(area)

    def area_and_pose(self, keyframe: int) -> tuple[int, Float64]:
        """The area of a keyframe, and its pose in that area, (3,)."""
        return self._poses[keyframe]

    def keyframe_pose(self, keyframe: int) -> Float64:
        """``area_T_keyframe`` (3,)."""
        area, pose = self._poses[keyframe]
        return se2.compose(self._areas[area], pose)

    def route_in_base(self, route: Route, pose: Float64) -> Float64:
        """The points of a route (n, 2) in the frame of the base, m.

        :param pose: ``area_T_base`` (3,).
        """
        frames = {keyframe: self.keyframe_pose(keyframe) for keyframe in dict.fromkeys(route.keyframes)}
        placed = np.array([frames[keyframe] for keyframe in route.keyframes])
        return se2.transform(se2.inverse(pose), se2.transform(placed, route.points))


_MAX_LOOKAHEAD, _MIN_LOOKAHEAD = 2.0, 0.5
"""Largest and smallest distance of the local goal ahead on the path, m."""

_PROGRESS_WINDOW = 3.0
"""Part of the path ahead on which the nearest point is the robot's own, m."""

_STEP = 0.1
"""Distance between sample points on the path, m."""

_WAIT_TIME, _WAIT_SPACING = 4 * NANOSECONDS, 1.0
"""Time for which the robot waits before an obstacle, ns, and distance on the path between two waits, m."""

_MIN_PROGRESS = 0.3
"""Decrease of the remaining distance that counts as progress, m."""


def motion_limits(robot: ExplorerParameters) -> MotionLimits:
    """The motion limits of the parameters."""
    return MotionLimits(
        robot.speed,
        math.radians(robot.turn_rate),
        robot.acceleration,
        math.radians(robot.turn_acceleration),
        robot.radius,
        robot.margin,
    )


class PathFollower:
    """Follows a path, and measures the progress on it.

    :ivar remaining: distance to the end of the path, m, inf before the first step.
    """

    def __init__(self, limits: MotionLimits, tolerance: float) -> None:
        """:param tolerance: distance from the end of the path at which the robot has arrived, m."""
        self._limits, self._tolerance = replace(limits, tolerance=tolerance), tolerance
        self._progress, self._least_remaining, self._progress_stamp = 0.0, math.inf, 0
        self._last_wait_progress, self._wait_end = -math.inf, 0
        self.remaining = math.inf

    def steer(self, view: ObstacleView, path: Float64, velocity: tuple[float, float]) -> MotionCommand:
        """The velocities until the next scan.

        :param path: shape (n, 2), the same points at each call, in the frame of the base now, m.
        :param velocity: of the robot now, m/s and rad/s.
        """
        steps = np.hypot(*np.diff(path, axis=0).T)
        along = np.concatenate(([0.0], np.cumsum(steps)))
        end = float(along[-1])
        ahead = np.append(np.arange(min(self._progress, end), min(self._progress + _PROGRESS_WINDOW, end), _STEP), end)
        ahead = ahead[ahead <= self._progress + _PROGRESS_WINDOW]
        points = _interpolate(path, along, ahead)
        distances = np.hypot(*points.T)
        # The path may also pass on the other side of a wall.
        nearest = int(np.argmin(np.where(_is_in_sight(view, points), distances, distances + _PROGRESS_WINDOW)))
        self._progress = float(ahead[nearest])
        self.remaining = float(distances[nearest]) + end - self._progress
        if self.remaining < self._least_remaining - _MIN_PROGRESS:
            self._least_remaining, self._progress_stamp = self.remaining, view.stamp
        goal = self._visible_goal(view, path, along)
        if goal is None and self._is_waiting(view.stamp):
            return MotionCommand(0.0, 0.0, arrived=False)
        beyond = _interpolate(path, along, np.minimum(self._progress + np.array([_MAX_LOOKAHEAD]), end))[0]
        return command_towards(view, beyond if goal is None else goal, velocity, self._limits)

    def _is_waiting(self, stamp: int) -> bool:
        """Whether to wait before an obstacle: a person may stop, too, before a robot that moves."""
        if self._progress > self._last_wait_progress + _WAIT_SPACING:
            self._last_wait_progress, self._wait_end = self._progress, stamp + _WAIT_TIME
        return stamp < self._wait_end

    def _visible_goal(self, view: ObstacleView, path: Float64, along: Float64) -> Float64 | None:
        """The farthest visible point ahead on the path that is clear of surfaces; None for none."""
        ahead = np.minimum(self._progress + np.arange(_MAX_LOOKAHEAD, _MIN_LOOKAHEAD, -_STEP), along[-1])
        points = _interpolate(path, along, ahead)
        free = np.hypot(*(points[:, None] - view.points[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        suitable = _is_in_sight(view, points) & (free > self._limits.radius + self._limits.margin + _STEP)
        return points[int(np.argmax(suitable))] if suitable.any() else None

    @property
    def has_arrived(self) -> bool:
        """Whether the robot is at the end of the path."""
        return self.remaining <= self._tolerance

    def is_stuck(self, stamp: int, timeout: int) -> bool:
        """Whether the last progress is longer ago than a timeout.

        :param stamp: now, ns.
        :param timeout: ns.
        """
        return self._progress_stamp > 0 and stamp - self._progress_stamp > timeout


def _interpolate(path: Float64, along: Float64, distances: Float64) -> Float64:
    """The points (k, 2) of a path (n, 2) at distances (k,) along it, m."""
    return np.stack([np.interp(distances, along, path[:, axis]) for axis in (0, 1)], axis=1)


def _is_in_sight(view: ObstacleView, points: Float64) -> Bool:
    """Whether points (k, 2) are visible to the robot, shape (k,)."""
    distances = np.maximum(np.hypot(*points.T), 1e-9)
    directions = points / distances[:, None]
    along = directions @ view.points.T
    beside = directions @ np.stack((-view.points[:, 1], view.points[:, 0]))
    hiding = (along > 0.0) & (along < distances[:, None]) & (np.abs(beside) <= 0.5 * _STEP)
    return np.asarray(~hiding.any(axis=1))
