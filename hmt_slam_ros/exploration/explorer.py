"""Where the robot is in its map, and what is known of that.

The explorer: drives the robot until the building is known, hallways first and then rooms, and to named places.

Tomatis, Nourbakhsh and Siegwart (2003): all hallways depth first, then the rooms by backtracking. What is depth first
in a building, whose crossings have few arms, is to go to the nearest end of known ground: behind a crossing that is the
hallway ahead, in a dead end the arm of the last crossing that was left out.
"""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.path_follower import KeyframeLocator, PathFollower, Route, motion_limits
from hmt_slam_ros.exploration.roadmap import EntryPoint, Frontier, Roadmap
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import GoalPose, Task, TaskResult, VelocityCommand
from hmt_slam_ros.sensors import Scan

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


# So near a frontier and a place are reached, m.
_AT_FRONTIER, _AT_PLACE = 0.5, 0.15
# So near a frontier nothing more is seen from it where the robot does not get nearer, m.
_BESIDE_FRONTIER = 1.0
# So near to a frontier in a hallway it is chosen anew, since it moves on, m.
_RESELECT_DISTANCE = 3.0
# Frontiers nearer to each other than this, m, are one.
_SAME = 0.7
# How often a way to a place is looked for anew where the robot is held up.
_TRIES = 3
_STAND = (0.0, 0.0)


class Explorer:
    """The explorer as a process. Consumes Task, Scan, RealTimePose and the chain; says what tasks.py has.

    :ivar exploration_map: what it knows.
    """

    def __init__(self, configuration: Configuration, known: Replica | None = None) -> None:
        """:param known: the map at first, None for none."""
        own = configuration.explorer
        self._limits = motion_limits(own)
        self._stuck_timeout = round(NANOSECONDS * own.stuck_timeout)
        self.exploration_map = ExplorationMap(configuration, known)
        self._task: Task | None = None
        self._tries = 0
        self._target: Frontier | None = None
        self._route: Route | None = None
        self._path_follower = PathFollower(self._limits, _AT_PLACE)
        self._velocity = _STAND
        # Frontiers where it was, and others that it did not reach: each a place in the frame of a keyframe.
        self._reached_frontiers: list[tuple[int, Float64]] = []
        self._abandoned_frontiers: list[tuple[int, Float64]] = []
        self._may_retry = True
        self._max_path_entropy = configuration.places.max_entropy if own.backtracks else math.inf
        self._is_backtracking = False

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; a scan is answered with velocities."""
        if isinstance(message, Task):
            self._task = None if message.kind == "stop" else message
            self._route, self._tries, self._may_retry = None, 0, True
        elif isinstance(message, Scan):
            return self._drive(message)
        else:
            self.exploration_map.on_message(message)
        return []

    def _drive(self, scan: Scan) -> list[Message]:
        said: list[Message] = []
        ready = self.exploration_map.is_localized(scan.stamp)
        if ready and self._task is not None:
            if self.exploration_map.has_changed and not self._keeps_route():
                self._route = None
            if self._route is None:
                said += self._choose_goal(self._task, scan.stamp)
        self._velocity = self._follow_route(scan, said) if ready and self._route is not None else _STAND
        return [*said, VelocityCommand(scan.stamp, *self._velocity)]

    def _keeps_route(self) -> bool:
        """Whether it goes on to where it went."""
        if self._route is None or not self.exploration_map.keyframe_locator.contains_route(self._route):
            return False
        if self._is_backtracking or self._is_ambiguous:
            return self._is_backtracking and self._is_ambiguous
        return not (
            self._is_exploring
            and self._target
            and self._target.is_in_hallway
            and self._path_follower.remaining < _RESELECT_DISTANCE
        )

    @property
    def _is_exploring(self) -> bool:
        return self._task is not None and self._task.kind == "explore"

    @property
    def _is_ambiguous(self) -> bool:
        """Whether it turns back until one topological path has nearly all of the probability, as the paper's robot."""
        return self._is_exploring and self.exploration_map.entropy >= self._max_path_entropy

    def _follow_route(self, scan: Scan, said: list[Message]) -> tuple[float, float]:
        """The velocities along the route; where that ends, what there is to say is added."""
        assert self._route is not None
        command = self._path_follower.steer(scan, self.exploration_map.route_in_base(self._route), self._velocity)
        if self._path_follower.has_arrived or self._path_follower.is_stuck(scan.stamp, self._stuck_timeout):
            # What is to be seen at a frontier is seen from beside it.
            near = self._is_exploring and self._path_follower.remaining <= _BESIDE_FRONTIER
            said += self._finish_route(reached=self._path_follower.has_arrived or near)
        return command.speed, command.turn_rate

    def _finish_route(self, *, reached: bool) -> list[Message]:
        """The route is at its end."""
        self._route = None
        if self._is_backtracking:
            return []
        if self._is_exploring:
            assert self._target is not None
            (self._reached_frontiers if reached else self._abandoned_frontiers).append(
                (self._target.keyframe, self._target.path[-1])
            )
            self._may_retry |= reached
            if reached and not self._target.is_in_hallway:
                self.exploration_map.name_current_room()
            return []
        self._tries += 1
        if reached:
            return self._finish_task("the robot is there", reached=True)
        if self._tries >= _TRIES:
            return self._finish_task("given up: something is in the way", reached=False)
        return []

    def _finish_task(self, text: str, *, reached: bool) -> list[Message]:
        assert self._task is not None
        outcome = TaskResult(self._task, reached, text)
        self._task = self._route = None
        return [outcome]

    def _choose_goal(self, task: Task, stamp: int) -> list[Message]:
        """Choose where to go."""
        here = self.exploration_map.update_roadmap()
        if here is None:
            return []
        self._is_backtracking = self._is_ambiguous
        choose = {"explore": self._plan_to_frontier, "go": self._plan_to_place, "backtrack": self._plan_backtracking}[
            task.kind
        ]
        said = self._plan_backtracking(here) if self._is_backtracking else choose(here)
        if self._route is not None:
            area, goal = self.exploration_map.goal_pose(self._route)
            said.append(GoalPose(stamp, area, goal))
        return said

    def _set_route(self, here: EntryPoint, keyframes: list[int], last: Float64, tolerance: float) -> None:
        self._route = Route.through_keyframes(here.path, keyframes, last)
        self._path_follower = PathFollower(self._limits, tolerance)

    def _plan_to_frontier(self, here: EntryPoint) -> list[Message]:
        """Choose the nearest frontier in a hallway, else the nearest one."""
        survey = self.exploration_map.roadmap
        distances = survey.distances(here.keyframe)
        choices = [
            (not one.is_in_hallway, distances[one.keyframe] + one.length, number)
            for number, one in enumerate(survey.frontiers)
            if one.keyframe in distances and not self._was_tried(one)
        ]
        if not choices:
            return self._retry_or_finish()
        target = self._target = survey.frontiers[min(choices)[2]]
        self._set_route(here, survey.shortest_path(here.keyframe, target.keyframe), target.path, _AT_FRONTIER)
        return []

    def _retry_or_finish(self) -> list[Message]:
        """Nothing is left; what was given up, maybe because of people, is tried anew until none of it is reached."""
        if self._abandoned_frontiers and self._may_retry:
            self._may_retry, self._abandoned_frontiers = False, []
            return []
        left = len(self._abandoned_frontiers)
        return self._finish_task(f"all is known that can be reached; {left} places were given up", reached=True)

    def _was_tried(self, one: Frontier) -> bool:
        frames = self.exploration_map.keyframe_locator
        place = se2.transform(frames.keyframe_pose(one.keyframe), one.path[-1])
        return any(
            math.dist(place, se2.transform(frames.keyframe_pose(keyframe), point)) < _SAME
            for keyframe, point in self._reached_frontiers + self._abandoned_frontiers
            if keyframe in frames
        )

    def _plan_to_place(self, here: EntryPoint) -> list[Message]:
        assert self._task is not None
        places, survey = self.exploration_map.named_places(), self.exploration_map.roadmap
        keyframe = places.get(self._task.place)
        if keyframe is None:
            return self._finish_task(f"there is no such place: choose from {', '.join(places)}", reached=False)
        if keyframe not in survey.distances(here.keyframe):
            return self._finish_task("no way is known that leads there", reached=False)
        self._set_route(here, survey.shortest_path(here.keyframe, keyframe), here.path[:0], _AT_PLACE)
        return []

    def _plan_backtracking(self, here: EntryPoint) -> list[Message]:
        """Back along the robot's own path."""
        self._set_route(here, self.exploration_map.roadmap.backtracking_path(here.keyframe), here.path[:0], _AT_PLACE)
        return []
