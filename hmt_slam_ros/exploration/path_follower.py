"""Ways through an HMT map, over keyframes, and driving along them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.robot import ExplorerParameters
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.sensors import Scan


@dataclass(frozen=True, eq=False)
class Route:
    """A way.

    :ivar keyframes: n of them.
    :ivar points: shape (n, 2), m, each in the frame of its keyframe's base.
    """

    keyframes: tuple[int, ...]
    points: Float64

    @classmethod
    def through_keyframes(cls, first: Float64, keyframes: list[int], last: Float64) -> Route:
        """Over places where keyframes were taken.

        :param first: shape (i, 2), a way to the first keyframe in its frame, m.
        :param last: shape (k, 2), a way from the last keyframe on in its frame, m.
        """
        names = (*[keyframes[0]] * len(first), *keyframes, *[keyframes[-1]] * len(last))
        return cls(names, np.concatenate((first, np.zeros((len(keyframes), 2)), last)))


class KeyframeLocator:
    """Where keyframes are as a robot sees them that is in one area of a map."""

    def __init__(self, hybrid_map: HybridMap, area: int) -> None:
        self.area = area
        self._areas = {other: belief.mean for other, belief in shortest_path_beliefs(hybrid_map, area).items()}
        self._poses = {
            keyframe: (other, pose) for other in self._areas for keyframe, pose in hybrid_map.keyframes(other).items()
        }

    def __contains__(self, keyframe: object) -> bool:
        """Whether a keyframe is in the map still."""
        return keyframe in self._poses

    def contains_route(self, route: Route) -> bool:
        """Whether all its keyframes are in the map still."""
        return all(keyframe in self._poses for keyframe in route.keyframes)

    def area_and_pose(self, keyframe: int) -> tuple[int, Float64]:
        """The area of a keyframe, and its pose in that (3,)."""
        return self._poses[keyframe]

    def keyframe_pose(self, keyframe: int) -> Float64:
        """``area_T_keyframe`` (3,)."""
        area, pose = self._poses[keyframe]
        return se2.compose(self._areas[area], pose)

    def route_in_base(self, route: Route, pose: Float64) -> Float64:
        """The places of a route (n, 2) in the frame of the base, m.

        :param pose: ``area_T_base`` (3,).
        """
        frames = {keyframe: self.keyframe_pose(keyframe) for keyframe in dict.fromkeys(route.keyframes)}
        placed = np.array([frames[keyframe] for keyframe in route.keyframes])
        return se2.transform(se2.inverse(pose), se2.transform(placed, route.points))


# How far ahead on the way the robot looks, and how far at least where something stands there, m.
_AHEAD, _LEAST = 2.0, 0.5
# Within so much of the way ahead it takes the nearest place for its own, in steps of so much, m.
_PROGRESS_WINDOW, _STEP = 3.0, 0.1
# Where something stands in the way, the robot waits for so long, ns, that it goes away, once in so much of the way, m.
_WAIT, _WAIT_SPACING = 4 * NANOSECONDS, 1.0
# Progress is this much less that is left, m.
_PROGRESS = 0.3


def motion_limits(robot: ExplorerParameters) -> MotionLimits:
    """Those of the robot that the parameters describe."""
    return MotionLimits(
        robot.speed,
        math.radians(robot.turn_rate),
        robot.acceleration,
        math.radians(robot.turn_acceleration),
        robot.radius,
        robot.margin,
    )


class PathFollower:
    """Keeps track of how far the robot has come on a way.

    :ivar remaining: of the way, m, inf before the first step.
    """

    def __init__(self, limits: MotionLimits, tolerance: float) -> None:
        """:param tolerance: distance from the end of the way at which the robot has arrived, m."""
        self._limits, self._tolerance = replace(limits, tolerance=tolerance), tolerance
        self._progress, self._least, self._since = 0.0, math.inf, 0
        self._last_wait_progress, self._until = -math.inf, 0
        self.remaining = math.inf

    def steer(self, scan: Scan, way: Float64, velocity: tuple[float, float]) -> MotionCommand:
        """The velocities until the next scan.

        :param way: shape (n, 2), where the same places are as the robot sees them now, m.
        :param velocity: of the robot now, m/s and rad/s.
        """
        steps = np.hypot(*np.diff(way, axis=0).T)
        along = np.concatenate(([0.0], np.cumsum(steps)))
        end = float(along[-1])
        ahead = np.append(np.arange(min(self._progress, end), min(self._progress + _PROGRESS_WINDOW, end), _STEP), end)
        ahead = ahead[ahead <= self._progress + _PROGRESS_WINDOW]
        places = _interpolate(way, along, ahead)
        away = np.hypot(*places.T)
        # The way may lead by on the other side of a wall.
        nearest = int(np.argmin(np.where(_is_in_sight(scan, places), away, away + _PROGRESS_WINDOW)))
        self._progress = float(ahead[nearest])
        self.remaining = float(away[nearest]) + end - self._progress
        if self.remaining < self._least - _PROGRESS:
            self._least, self._since = self.remaining, scan.stamp
        goal = self._visible_goal(scan, way, along)
        if goal is None and self._is_waiting(scan.stamp):
            return MotionCommand(0.0, 0.0, arrived=False)
        beyond = _interpolate(way, along, np.minimum(self._progress + np.array([_AHEAD]), end))[0]
        return command_towards(scan, beyond if goal is None else goal, velocity, self._limits)

    def _is_waiting(self, stamp: int) -> bool:
        """Whether to stand now that something is in the way: who walks about stops, too, before what moves."""
        if self._progress > self._last_wait_progress + _WAIT_SPACING:
            self._last_wait_progress, self._until = self._progress, stamp + _WAIT
        return stamp < self._until

    def _visible_goal(self, scan: Scan, way: Float64, along: Float64) -> Float64 | None:
        """The farthest place on the way, up to some distance ahead, in sight and beside which nothing stands."""
        ahead = np.minimum(self._progress + np.arange(_AHEAD, _LEAST, -_STEP), along[-1])
        places = _interpolate(way, along, ahead)
        away = np.hypot(*(places[:, None] - scan.points[None]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        good = _is_in_sight(scan, places) & (away > self._limits.radius + self._limits.margin + _STEP)
        return places[int(np.argmax(good))] if good.any() else None

    @property
    def has_arrived(self) -> bool:
        """Whether the robot is at the end of the way."""
        return self.remaining <= self._tolerance

    def is_stuck(self, stamp: int, timeout: int) -> bool:
        """Whether it has not come nearer for long.

        :param stamp: now, ns.
        :param timeout: ns.
        """
        return self._since > 0 and stamp - self._since > timeout


def _interpolate(way: Float64, along: Float64, places: Float64) -> Float64:
    """The points (k, 2) on a way (n, 2) that are so far along it, (k,), m."""
    return np.stack([np.interp(places, along, way[:, axis]) for axis in (0, 1)], axis=1)


def _is_in_sight(scan: Scan, places: Float64) -> Bool:
    """Which of some places (k, 2) no surface hides from the robot, shape (k,)."""
    away = np.maximum(np.hypot(*places.T), 1e-9)
    towards = places / away[:, None]
    along = towards @ scan.points.T
    beside = towards @ np.stack((-scan.points[:, 1], scan.points[:, 0]))
    hiding = (along > 0.0) & (along < away[:, None]) & (np.abs(beside) <= 0.5 * _STEP)
    return np.asarray(~hiding.any(axis=1))
