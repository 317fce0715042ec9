"""The explorer: drives a robot until a building is known, hallways before rooms, and to named places and poses.

Tomatis, Nourbakhsh and Siegwart (2003): all hallways depth first, then the rooms by backtracking. In a building, whose
crossings have few arms, depth first is to go to the nearest frontier: behind a crossing the hallway ahead, in a dead
end the last arm that was left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.frontier_choice import FrontierChoice
from hmt_slam_ros.exploration.laser_views import LaserViews, ObstacleView
from hmt_slam_ros.exploration.local_motion import turn_in_place
from hmt_slam_ros.exploration.look_planner import LookPlanner
from hmt_slam_ros.exploration.path_follower import PathFollower, Route, motion_limits
from hmt_slam_ros.exploration.pose_goals import anchor_elsewhere
from hmt_slam_ros.exploration.roadmap import EntryPoint
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.messages import Hypotheses, Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import (
    AnchoredPose,
    GoalPose,
    Task,
    TaskError,
    TaskProgress,
    TaskResult,
    VelocityCommand,
)
from hmt_slam_ros.sensors import Scan

_FRONTIER_TOLERANCE, _PLACE_TOLERANCE = 0.5, 0.15
"""Distance at which a frontier and a place are reached, m."""

_BESIDE_FRONTIER = 1.0
"""Distance of a stuck robot from a frontier up to which this counts as reached, m."""

_HEADING_TOLERANCE = math.radians(5.0)
"""Deviation of the heading at which a pose is reached, rad."""

_TURN_GAIN = 0.5
"""Share of that deviation which one command turns: the pose is a scan late."""

_RESELECT_DISTANCE = 3.0
"""Remaining distance to a frontier in a hallway at which a new one is chosen, as it moves on, m."""

_TRIES = 3
"""Routes to a place before a task is given up."""

_CHOICE_PERIOD, _NEVER = NANOSECONDS, -NANOSECONDS
"""Least time between two choices of a robot that found no goal in a map that stays as it is; before the first, ns."""

_STAND = (0.0, 0.0)


class Explorer:
    """The explorer as a process. Consumes Task, Scan, RealTimePose, Ambiguity, TeamGoal and the chain.

    It produces tasks' messages, and in a team TeamGoal.

    :ivar exploration_map: the known map.
    :ivar task: what it does; None without a task.
    """

    def __init__(self, configuration: Configuration, known: Replica | None = None, robot: str = "") -> None:
        """:param known: the initial map; None for an empty one.

        :param robot: its name in its team.
        """
        parameters = configuration.explorer
        self._limits = motion_limits(parameters)
        self._stuck_timeout = round(NANOSECONDS * parameters.stuck_timeout)
        self.exploration_map = ExplorationMap(configuration, known, robot)
        self._frontiers = FrontierChoice(self.exploration_map)
        self.task: Task | None = None
        self._goal: AnchoredPose | None = None
        self._tries, self._chosen_at = 0, _NEVER
        self._route: Route | None = None
        self._path_follower = PathFollower(self._limits, _PLACE_TOLERANCE)
        self._velocity, self._views = _STAND, LaserViews()
        self._max_path_entropy = configuration.places.max_entropy if parameters.backtracks else math.inf
        self._is_backtracking = False
        self._disambiguates = parameters.disambiguates
        self._look_planner, self._is_looking = LookPlanner(), False

    def handle(self, message: Message) -> list[Message]:
        """Process one message; a scan is answered with velocities."""
        if isinstance(message, Task):
            self.task = None if message.kind == "stop" else message
            self._goal = message.goal
            self._route, self._tries, self._chosen_at = None, 0, _NEVER
            self._frontiers.forget_target()
            self._look_planner.forget_tries()
        elif isinstance(message, Scan):
            return self._drive(message)
        elif isinstance(message, Ambiguity):
            self._look_planner.add(message)
        else:
            if isinstance(message, Hypotheses) and self._goal is not None:
                pruned = {each.keyframe for each in message.pruned_keyframes}
                self._goal = anchor_elsewhere(self._goal, self.exploration_map.hybrid_map, pruned)
            self.exploration_map.on_message(message)
        return []

    def named_rooms(self) -> dict[str, int]:
        """{name: keyframe in its middle} of entered rooms."""
        return self.exploration_map.named_rooms()

    @property
    def progress(self) -> TaskProgress:
        """How far the task is."""
        remaining = self._path_follower.remaining
        is_known = self._route is not None and math.isfinite(remaining)
        return TaskProgress(remaining if is_known else None, self._tries)

    def _drive(self, scan: Scan) -> list[Message]:
        """Choose a goal if there is none, and follow the route."""
        outputs: list[Message] = []
        self._move_views(scan.stamp)
        view = self._views.add(scan)
        ready = self.exploration_map.is_localized(scan.stamp)
        self.exploration_map.teammates.update(scan.stamp)
        self._look_planner.update(self.exploration_map.event)
        if ready and self.task is not None:
            if self.exploration_map.has_changed and not self._keeps_route():
                self._route, self._chosen_at = None, _NEVER
            is_due = not 0 <= scan.stamp - self._chosen_at < _CHOICE_PERIOD
            if self._has_news_of_others or (self._route is None and is_due):
                self._chosen_at = scan.stamp
                outputs += self._choose_goal(self.task, scan.stamp)
        self._velocity = self._follow_route(view, outputs) if ready and self._route is not None else _STAND
        outputs += self._frontiers.share(scan.stamp, self.progress.remaining)
        return [*outputs, VelocityCommand(scan.stamp, *self._velocity)]

    def _move_views(self, stamp: int) -> None:
        """Move the robot by its last command until a time, ns."""
        last = self._views.newest_stamp
        if last is not None and last < stamp <= last + NANOSECONDS:
            speed, turn_rate = self._velocity
            self._views.move(se2.exp((stamp - last) / NANOSECONDS * np.array([speed, 0.0, turn_rate])))

    def _keeps_route(self) -> bool:
        """Whether the route is still valid after a change of the map."""
        if self._route is None or not self.exploration_map.keyframe_locator.contains_route(self._route):
            return False
        if self._is_looking or self._looks_first:
            robot = self.exploration_map.pose.pose_in_area.mean[:2]
            return self._is_looking and self._look_planner.keeps_target(self.exploration_map.keyframe_locator, robot)
        if self._is_backtracking or self._is_ambiguous:
            return self._is_backtracking and self._is_ambiguous
        target = self._frontiers.target
        in_hallway = self._is_exploring and target is not None and target.is_in_hallway
        return not (in_hallway and self._path_follower.remaining < _RESELECT_DISTANCE)

    @property
    def _is_exploring(self) -> bool:
        return self.task is not None and self.task.kind == "explore"

    @property
    def _has_news_of_others(self) -> bool:
        """Whether new ground or the goal of another robot may change which frontier is this robot's."""
        teammates = self.exploration_map.teammates
        is_open = self._is_exploring and not (self._is_looking or self._is_backtracking)
        return is_open and (bool(teammates.new_keyframes) or teammates.has_new_goals)

    @property
    def _is_ambiguous(self) -> bool:
        """Whether the entropy of topological paths requires backtracking, as in the paper."""
        return self._is_exploring and self.exploration_map.entropy >= self._max_path_entropy

    @property
    def _looks_first(self) -> bool:
        """Whether an exploration is interrupted for a look."""
        may_look = self._is_exploring and self._disambiguates and self._look_planner.is_open
        return may_look and self._look_planner.has_look(self.exploration_map.keyframe_locator)

    def _follow_route(self, view: ObstacleView, outputs: list[Message]) -> tuple[float, float]:
        """The velocities along the route; messages at its end are added to ``outputs``."""
        assert self._route is not None
        command = self._path_follower.steer(view, self.exploration_map.route_in_base(self._route), self._velocity)
        if self._goal is not None and self._path_follower.has_arrived:
            return self._turn_to_goal(self._goal, outputs)
        if self._path_follower.has_arrived or self._path_follower.is_stuck(view.stamp, self._stuck_timeout):
            # A frontier is visible from beside it.
            near = self._is_exploring and self._path_follower.remaining <= _BESIDE_FRONTIER
            outputs += self._finish_route(reached=self._path_follower.has_arrived or near)
        return command.speed, command.turn_rate

    def _turn_to_goal(self, goal: AnchoredPose, outputs: list[Message]) -> tuple[float, float]:
        """The velocities at the position of a goal pose, until the robot has its heading."""
        own = self.exploration_map.pose.pose_in_area.mean
        pose = se2.compose(self.exploration_map.keyframe_locator.keyframe_pose(goal.keyframe), goal.pose)
        angle = float(se2.between(own, pose)[2])
        if abs(angle) <= _HEADING_TOLERANCE:
            outputs += self._finish_task("the robot is there", reached=True)
            return _STAND
        return turn_in_place(_TURN_GAIN * angle, self._limits)[:2]

    def _finish_route(self, *, reached: bool) -> list[Message]:
        """End the route, and with it the task to go to a place."""
        self._route = None
        if self._is_looking:
            self._look_planner.end_route()
        if self._is_looking or self._is_backtracking:
            return []
        if self._is_exploring:
            self._frontiers.end_target(reached=reached)
            target = self._frontiers.target
            if reached and target is not None and not target.is_in_hallway:
                self.exploration_map.name_current_room()
            return []
        self._tries += 1
        if reached:
            return self._finish_task("the robot is there", reached=True)
        if self._tries >= _TRIES:
            return self._fail_task("given up: something is in the way", TaskError.FAILED_TO_MAKE_PROGRESS)
        return []

    def _finish_task(self, text: str, *, reached: bool, error: TaskError = TaskError.UNKNOWN) -> list[Message]:
        assert self.task is not None
        result = TaskResult(self.task, reached, text, error)
        self._frontiers.forget_target()
        self.task = self._route = self._goal = None
        return [result]

    def _fail_task(self, text: str, error: TaskError) -> list[Message]:
        return self._finish_task(text, reached=False, error=error)

    def _choose_goal(self, task: Task, stamp: int) -> list[Message]:
        """Plan a route for a task."""
        here, before = self.exploration_map.update_roadmap(), self._route
        if here is None:
            return []
        self._is_looking = task.kind == "disambiguate" or self._looks_first
        self._is_backtracking = not self._is_looking and self._is_ambiguous
        planners = {
            "explore": self._plan_to_frontier,
            "go": self._plan_to_place,
            "navigate": self._plan_to_pose,
            "backtrack": self._plan_backtracking,
        }
        plan = self._plan_look if self._is_looking else planners[task.kind]
        outputs = self._plan_backtracking(here) if self._is_backtracking else plan(here)
        if self._route is not None and self._route is not before:
            area, goal = self.exploration_map.goal_pose(self._route, self._goal)
            outputs.append(GoalPose(stamp, area, goal))
        return outputs

    def _set_route(self, here: EntryPoint, keyframes: list[int], last: Float64, tolerance: float) -> None:
        self._route = Route.through_keyframes(here.path, keyframes, last)
        self._path_follower = PathFollower(self._limits, tolerance)

    def _plan_to_frontier(self, here: EntryPoint) -> list[Message]:
        """Plan to the nearest frontier in a hallway, else to the nearest one.

        Where all are left to others the robot stands, as hallways may branch; where only rooms are left, the task ends.
        """
        choice = self._frontiers.choose(here.keyframe, is_on_way=self._route is not None)
        if choice.frontier is None:
            self._route = None
            may_finish = choice.is_over and not self._frontiers.retry()
            return self._finish_exploration(choice.left_to) if may_finish else []
        if choice.is_new:
            path = self.exploration_map.roadmap.shortest_path(here.keyframe, choice.frontier.keyframe)
            self._set_route(here, path, choice.frontier.path, _FRONTIER_TOLERANCE)
        return []

    def _finish_exploration(self, left_to: Iterable[str]) -> list[Message]:
        """End the task.

        :param left_to: robots to which rooms are left.
        """
        others = f", or left to {' and '.join(left_to)}" if left_to else ""
        count = self._frontiers.abandoned_count
        text = f"all is known that can be reached{others}; {count} places were given up"
        outputs = self._finish_task(text, reached=True)
        self._frontiers.finish()
        return outputs

    def _plan_to_place(self, here: EntryPoint) -> list[Message]:
        """Plan to a named place."""
        assert self.task is not None
        places, roadmap = self.exploration_map.named_places(), self.exploration_map.roadmap
        keyframe = places.get(self.task.place)
        if keyframe is None:
            return self._finish_task(f"there is no such place: choose from {', '.join(places)}", reached=False)
        if keyframe not in roadmap.distances(here.keyframe):
            return self._fail_task("no way is known that leads there", TaskError.NO_VALID_PATH)
        self._set_route(here, roadmap.shortest_path(here.keyframe, keyframe), here.path[:0], _PLACE_TOLERANCE)
        return []

    def _plan_to_pose(self, here: EntryPoint) -> list[Message]:
        """Plan to the goal pose."""
        assert self._goal is not None
        known, roadmap = self.exploration_map, self.exploration_map.roadmap
        if self._goal.keyframe not in known.keyframe_locator:
            return self._fail_task("its part of the map was discarded: give it again", TaskError.GOAL_OUTSIDE_MAP)
        area, keyframe_pose = known.keyframe_locator.area_and_pose(self._goal.keyframe)
        pose = se2.compose(keyframe_pose, self._goal.pose)
        end = roadmap.path_to(known.hybrid_map, known.replica.scans, area, pose)
        if end is None:
            return self._fail_task("the robot cannot stand there: give a pose on free ground", TaskError.GOAL_OCCUPIED)
        if end.keyframe not in roadmap.distances(here.keyframe):
            return self._fail_task("no way is known that leads there", TaskError.NO_VALID_PATH)
        self._set_route(here, roadmap.shortest_path(here.keyframe, end.keyframe), end.path, _PLACE_TOLERANCE)
        return []

    def _plan_backtracking(self, here: EntryPoint) -> list[Message]:
        """Plan back along the robot's path."""
        path = self.exploration_map.roadmap.backtracking_path(here.keyframe)
        self._set_route(here, path, here.path[:0], _PLACE_TOLERANCE)
        return []

    def _plan_look(self, here: EntryPoint) -> list[Message]:
        """Plan to the look with the most information per meter."""
        if not self._look_planner.is_open:
            return self._finish_task("the place is sure", reached=True)
        locator, pose = self.exploration_map.keyframe_locator, self.exploration_map.pose.pose_in_area.mean
        self._route = self._look_planner.plan(locator, here.keyframe, pose)
        if self._route is None:
            return self._finish_task("no look within reach would decide: drive on", reached=False)
        self._path_follower = PathFollower(self._limits, _FRONTIER_TOLERANCE)
        return []
