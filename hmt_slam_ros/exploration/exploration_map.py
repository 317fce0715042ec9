"""The explorer's map: the most probable hypothesis, with roadmap, named rooms and the robot in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.path_follower import KeyframeLocator, Route
from hmt_slam_ros.exploration.pose_goals import anchor_pose
from hmt_slam_ros.exploration.roadmap import EntryPoint, Frontier, Roadmap
from hmt_slam_ros.exploration.teammates import Teammates
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import (
    AnchoredPose,
)
from hmt_slam_ros.messages.team import TeamGoal

_MAX_POSE_AGE = NANOSECONDS
"""Age up to which a pose of RTL is used, ns; RTL sends none while the robot is lost."""

_TEAMMATE_STEP = 3.0
"""Distance of the keyframes of other robots at which the roadmap is updated, m."""


class ExplorationMap:
    """The map of the most probable hypothesis, with roadmap, named rooms and the robot in it.

    :ivar roadmap: of the building.
    :ivar replica: maps and scans.
    :ivar event: the last keyframe event, -1 before the first.
    :ivar version: grows with every change of the map and its rooms, from 0 of an empty one on.
    :ivar teammates: robots whose ground is part of the map.
    """

    def __init__(self, configuration: Configuration, replica: Replica | None = None, robot: str = "") -> None:
        """:param replica: the initial map; None for an empty one.

        :param robot: its name in its team.
        """
        self.roadmap = Roadmap.of_explorer(configuration)
        self.replica = replica or Replica()
        self.event = -1
        self.version = 0 if replica is None else 1
        self.teammates = Teammates(robot)
        self._updated_at = NO_KEYFRAME
        self._pose: RealTimePose | None = None
        self._keyframe_locator: KeyframeLocator | None = None
        # Of each entered room the keyframes around the robot's pose there, the nearest first.
        self._rooms: list[tuple[int, ...]] = []
        self.roadmap.update_everywhere(self.hybrid_map, self.replica.scans)
        for room in self.roadmap.rooms():
            self._add_room(room)

    def on_message(self, message: Message) -> None:
        """Process a message of the chain or a pose; between nodes, scans may arrive after any of them."""
        if isinstance(message, Keyframe | Hypotheses | ClosureDecision):
            self.replica.apply_message(message)
            self._keyframe_locator = None
            if isinstance(message, ClosureDecision):
                self.event = message.sequence
                self.version += 1
                if message.foreign_ground is not None:
                    self.teammates.add(message.foreign_ground)
        elif isinstance(message, RealTimePose):
            self._pose = message
        elif isinstance(message, TeamGoal):
            self.teammates.add_goal(message)

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the most probable hypothesis."""
        return self.replica.maps[self.replica.best_hypothesis]

    @property
    def entropy(self) -> float:
        """Entropy of the probabilities of topological paths, nats."""
        return -sum(each * math.log(each) for each in self.replica.probabilities.values() if each > 0.0)

    def is_localized(self, stamp: int) -> bool:
        """Whether a pose of the robot in the map is known at a time, ns."""
        pose = self._pose
        return pose is not None and abs(stamp - pose.stamp) <= _MAX_POSE_AGE and self.hybrid_map.has_area(pose.area)

    def anchor(self, area_poses: Mapping[int, PoseGaussian], pose: Float64) -> AnchoredPose:
        """A goal pose, held by the nearest keyframe.

        :param area_poses: {area: ``map_T_area``}.
        :param pose: ``map_T_goal`` (3,), m and rad.
        :raises GoalError: outside the map.
        """
        return anchor_pose(self.hybrid_map, area_poses, pose)

    def area_of(self, keyframe: int) -> int | None:
        """The area of a keyframe, None where it is not in the map."""
        hybrid_map = self.hybrid_map
        return next((area for area in hybrid_map.area_ids() if keyframe in hybrid_map.keyframes(area)), None)

    def positions_in_map(
        self, area_poses: Mapping[int, PoseGaussian], keyframes: Mapping[str, int]
    ) -> dict[str, Float64]:
        """{name: position in the map (2,), m} of named keyframes, without those whose area has no pose.

        :param area_poses: {area: ``map_T_area``}.
        :param keyframes: {name: keyframe}.
        """
        hybrid_map, wanted = self.hybrid_map, set(keyframes.values())
        known = {
            keyframe: se2.transform(area_poses[area].mean, pose[:2])
            for area in hybrid_map.area_ids()
            if area in area_poses
            for keyframe, pose in hybrid_map.keyframes(area).items()
            if keyframe in wanted
        }
        return {name: known[keyframe] for name, keyframe in keyframes.items() if keyframe in known}

    @property
    def has_changed(self) -> bool:
        """Whether map or area changed since the last `keyframe_locator`."""
        return self._keyframe_locator is None or self._pose is None or self._keyframe_locator.area != self._pose.area

    @property
    def pose(self) -> RealTimePose:
        """The last pose of the robot; valid if `is_localized`."""
        assert self._pose is not None
        return self._pose

    @property
    def keyframe_locator(self) -> KeyframeLocator:
        """Poses of keyframes relative to the robot's area."""
        if self._keyframe_locator is None or self.has_changed:
            self._keyframe_locator = KeyframeLocator(self.hybrid_map, self.pose.area)
        return self._keyframe_locator

    def update_roadmap(self) -> EntryPoint | None:
        """Update the roadmap around the robot, and return the path to it, None for none.

        Before that, it is updated at a keyframe of another robot, where there is a new one.
        """
        self._update_at_teammates()
        pose = self.pose
        return self.roadmap.update(self.hybrid_map, self.replica.scans, pose.area, pose.pose_in_area.mean)

    def _update_at_teammates(self) -> None:
        """Update the roadmap around the oldest keyframe of another robot that is not beside the one before."""
        waiting, locator = self.teammates.new_keyframes, self.keyframe_locator
        while waiting:
            keyframe = waiting.pop(0)
            if keyframe in locator and not self._is_beside_updated(keyframe):
                self._updated_at = keyframe
                self.roadmap.update(self.hybrid_map, self.replica.scans, *locator.area_and_pose(keyframe))
                return

    def _is_beside_updated(self, keyframe: int) -> bool:
        """Whether a keyframe is near the last one of another robot at which the roadmap was updated."""
        locator = self.keyframe_locator
        if self._updated_at not in locator:
            return False
        one, other = (locator.keyframe_pose(each) for each in (keyframe, self._updated_at))
        return math.dist(one[:2], other[:2]) <= _TEAMMATE_STEP

    def frontier_position(self, frontier: Frontier) -> Float64:
        """Where a frontier is, in the frame of the robot's area, shape (2,), m."""
        return se2.transform(self.keyframe_locator.keyframe_pose(frontier.keyframe), frontier.path[-1])

    def route_in_base(self, route: Route) -> Float64:
        """The points of a route (n, 2) in the frame of the base now, m."""
        return self.keyframe_locator.route_in_base(route, self.pose.pose_in_area.mean)

    def goal_pose(self, route: Route, goal: AnchoredPose | None) -> tuple[int, Float64]:
        """The area of a goal, and ``area_T_goal`` (3,); without one, of the end of a route with its heading there."""
        if goal is not None:
            area, pose = self.keyframe_locator.area_and_pose(goal.keyframe)
            return area, se2.compose(pose, goal.pose)
        last = route.points[-2:]
        towards = last[-1] - last[0]
        area, pose = self.keyframe_locator.area_and_pose(route.keyframes[-1])
        return area, se2.compose(pose, np.array([*last[-1], np.arctan2(towards[1], towards[0])]))

    def name_current_room(self) -> None:
        """Name the room that the robot is in, if it has no name."""
        here = self.update_roadmap()
        if here is not None:
            self._add_room(self.roadmap.room_around(here.keyframe))

    def _add_room(self, room: tuple[int, ...]) -> None:
        if room and len(self._named_rooms([*self._rooms, room])) > len(self._named_rooms(self._rooms)):
            self._rooms.append(room)
            self.version += 1

    def named_rooms(self) -> dict[str, int]:
        """{name: keyframe in its middle} of entered rooms."""
        return self._named_rooms(self._rooms)

    def _named_rooms(self, rooms: list[tuple[int, ...]]) -> dict[str, int]:
        """{name: keyframe} of rooms, with the nearest keyframe that is not pruned.

        A room that was entered twice, before a loop closure showed it, has its first name. A segment that is classified
        as hallway by now has none.
        """
        current = filter(self.roadmap.is_room, self.roadmap.segments())
        segment_of = {keyframe: number for number, segment in enumerate(current) for keyframe in segment}
        named: dict[int, tuple[str, int]] = {}
        for number, room in enumerate(rooms, 1):
            keyframe = next((keyframe for keyframe in room if keyframe in segment_of), None)
            if keyframe is not None:
                named.setdefault(segment_of[keyframe], (f"room {number}", keyframe))
        return dict(named.values())

    def named_places(self) -> dict[str, int]:
        """{name: keyframe in its middle} of entered rooms and of areas."""
        named = self.named_rooms()
        hybrid_map = self.hybrid_map
        for area in hybrid_map.area_ids():
            keyframes = {k: pose for k, pose in hybrid_map.keyframes(area).items() if k in self.roadmap.graph}
            if keyframes:
                positions = np.array(list(keyframes.values()))[:, :2]
                distances = np.hypot(*(positions - positions.mean(axis=0)).T)
                named[f"area {area}"] = list(keyframes)[int(np.argmin(distances))]
        return named
