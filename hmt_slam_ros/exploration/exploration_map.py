"""Where the robot is in its map, and what is known of that."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.path_follower import KeyframeLocator, Route
from hmt_slam_ros.exploration.roadmap import EntryPoint, Roadmap
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import Replica

# A pose is good for so long, ns; real-time localization falls silent where the robot may be anywhere.
_MAX_POSE_AGE = NANOSECONDS


class ExplorationMap:
    """Follows the map of the most probable hypothesis, and the robot in it.

    :ivar roadmap: what of the building is known.
    :ivar replica: maps and scans.
    """

    def __init__(self, configuration: Configuration, replica: Replica | None = None) -> None:
        """:param replica: what is known at first."""
        own = configuration.explorer
        self.roadmap = Roadmap(configuration.features, own.radius + own.margin, own.door)
        self.replica = replica or Replica()
        self._pose: RealTimePose | None = None
        self._keyframe_locator: KeyframeLocator | None = None
        # Of each room that was entered the keyframes around the place where it was, the nearest first.
        self._rooms: list[tuple[int, ...]] = []
        self.roadmap.update_everywhere(self.hybrid_map, self.replica.scans)
        for room in self.roadmap.rooms():
            self._add_room(room)

    def on_message(self, message: Message) -> None:
        """Take in a message of the chain, or a pose; between nodes scans may come after any of them."""
        if isinstance(message, Keyframe | Hypotheses | ClosureDecision):
            self.replica.apply_message(message)
            self._keyframe_locator = None
        elif isinstance(message, RealTimePose):
            self._pose = message

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the most probable hypothesis."""
        return self.replica.maps[self.replica.best_hypothesis]

    @property
    def entropy(self) -> float:
        """Of the probabilities of topological paths, nats."""
        return -sum(each * math.log(each) for each in self.replica.probabilities.values() if each > 0.0)

    def is_localized(self, stamp: int) -> bool:
        """Whether it is known where in the map the robot is at a time, ns."""
        pose = self._pose
        return pose is not None and abs(stamp - pose.stamp) <= _MAX_POSE_AGE and self.hybrid_map.has_area(pose.area)

    @property
    def has_changed(self) -> bool:
        """Whether map or area changed since the last question of where something is."""
        return self._keyframe_locator is None or self._pose is None or self._keyframe_locator.area != self._pose.area

    @property
    def pose(self) -> RealTimePose:
        """Where the robot is, once the atlas is ready."""
        assert self._pose is not None
        return self._pose

    @property
    def keyframe_locator(self) -> KeyframeLocator:
        """Where keyframes are, seen from the robot's area."""
        if self._keyframe_locator is None or self.has_changed:
            self._keyframe_locator = KeyframeLocator(self.hybrid_map, self.pose.area)
        return self._keyframe_locator

    def update_roadmap(self) -> EntryPoint | None:
        """Bring all around the robot up to date; how it gets to the roadmap, None where it does not."""
        pose = self.pose
        return self.roadmap.update(self.hybrid_map, self.replica.scans, pose.area, pose.pose_in_area.mean)

    def route_in_base(self, route: Route) -> Float64:
        """The places of a route (n, 2) as the robot sees them now, m."""
        return self.keyframe_locator.route_in_base(route, self.pose.pose_in_area.mean)

    def goal_pose(self, route: Route) -> tuple[int, Float64]:
        """The end of a route as an HMT pose: its area, and ``area_T_goal`` (3,) with the heading of the way there."""
        last = route.points[-2:]
        towards = last[-1] - last[0]
        area, pose = self.keyframe_locator.area_and_pose(route.keyframes[-1])
        return area, se2.compose(pose, np.array([*last[-1], np.arctan2(towards[1], towards[0])]))

    def name_current_room(self) -> None:
        """Give the room a name in which the robot is, if it is in one that has none."""
        here = self.update_roadmap()
        if here is not None:
            self._add_room(self.roadmap.room_around(here.keyframe))

    def _add_room(self, room: tuple[int, ...]) -> None:
        if room and len(self._named_rooms([*self._rooms, room])) > len(self._named_rooms(self._rooms)):
            self._rooms.append(room)

    def _named_rooms(self, rooms: list[tuple[int, ...]]) -> dict[str, int]:
        """{name: keyframe} of rooms; keyframes of crowded ground are forgotten, and others stand for them.

        A room that was found twice, before the map told that it is one, has its first name; what turned out to be part
        of a hallway has none.
        """
        rooms_now = filter(self.roadmap.is_room, self.roadmap.segments())
        chamber = {keyframe: number for number, own in enumerate(rooms_now) for keyframe in own}
        found: dict[int, tuple[str, int]] = {}
        for number, room in enumerate(rooms, 1):
            keyframe = next((keyframe for keyframe in room if keyframe in chamber), None)
            if keyframe is not None:
                found.setdefault(chamber[keyframe], (f"room {number}", keyframe))
        return dict(found.values())

    def named_places(self) -> dict[str, int]:
        """{name: keyframe that stands for it} of all places that have a name: rooms that were entered, and areas."""
        named = self._named_rooms(self._rooms)
        hybrid_map = self.hybrid_map
        for area in hybrid_map.area_ids():
            own = {k: pose for k, pose in hybrid_map.keyframes(area).items() if k in self.roadmap.graph}
            if own:
                places = np.array(list(own.values()))[:, :2]
                away = np.hypot(*(places - places.mean(axis=0)).T)
                named[f"area {area}"] = list(own)[int(np.argmin(away))]
        return named
