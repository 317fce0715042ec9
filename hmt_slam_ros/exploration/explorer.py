"""The explorer: drives the robot until the building is known, hallways first and then rooms, and to named places.

Tomatis, Nourbakhsh and Siegwart (2003): all hallways depth first, then the rooms by backtracking. What is depth first
in a building, whose crossings have few arms, is to go to the nearest end of known ground: behind a crossing that is the
hallway ahead, in a dead end the arm of the last crossing that was left out.
"""

from __future__ import annotations

import math

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.path_follower import PathFollower, Route, motion_limits
from hmt_slam_ros.exploration.roadmap import EntryPoint, Frontier
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import GoalPose, Task, TaskResult, VelocityCommand
from hmt_slam_ros.sensors import Scan

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
