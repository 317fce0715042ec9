"""The frontiers of an exploration: which one a robot drives to, and which are left to the others of its team.

Hallways come before rooms, and the nearest frontier first. A robot of a team sends its goal, and leaves alone what is
the goal of another one (:mod:`hmt_slam_ros.exploration.team_goals`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.goal_sender import Goal, GoalSender
from hmt_slam_ros.exploration.roadmap import SAME_FRONTIER_DISTANCE, Frontier
from hmt_slam_ros.exploration.team_goals import Cost, FrontierPlace, RobotTarget, are_seen_together, free_frontiers
from hmt_slam_ros.exploration.teammates import choose_frontier, group_frontiers
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace


class Choice(NamedTuple):
    """What is left to explore.

    :ivar frontier: the one to drive to; None where none is left.
    :ivar is_new: whether it is another one than before.
    :ivar left_to: other robots.
    :ivar is_over: whether there is nothing to wait for: no frontier, or only rooms, which are left to others.
    """

    frontier: Frontier | None = None
    is_new: bool = False
    left_to: tuple[str, ...] = ()
    is_over: bool = False


class FrontierChoice:
    """Chooses the frontiers of a robot.

    :ivar target: the one that was chosen last; None without one.
    """

    def __init__(self, exploration_map: ExplorationMap) -> None:
        self.target: Frontier | None = None
        self._map = exploration_map
        # Each a point in the frame of a keyframe.
        self._reached: list[tuple[int, Float64]] = []
        self._abandoned: list[tuple[int, Float64]] = []
        self._may_retry = True
        self._path_length, self._has_finished = 0.0, False
        self._sender = GoalSender(exploration_map)
        # {(robot, stamp of a scan): keyframe} of the map, and robots whose explorations have ended.
        self._keyframes: dict[tuple[str, int], int] = {}
        self._finished = set[str]()

    @property
    def abandoned_count(self) -> int:
        """Number of frontiers that were given up."""
        return len(self._abandoned)

    def forget_target(self) -> None:
        """Begin again without a target: a task begins or ends."""
        self.target, self._may_retry, self._has_finished = None, True, False

    def finish(self) -> None:
        """Note that the exploration has ended."""
        self.target, self._has_finished = None, True

    def end_target(self, *, reached: bool) -> None:
        """Note that the target was reached, or given up."""
        assert self.target is not None
        (self._reached if reached else self._abandoned).append((self.target.keyframe, self.target.path[-1]))
        self._may_retry |= reached
        self._sender.reached_last = reached

    def retry(self) -> bool:
        """Whether frontiers that were given up, maybe because of people, are tried again: if any was reached since."""
        if not (self._abandoned and self._may_retry):
            return False
        self._may_retry, self._abandoned = False, []
        return True

    def choose(self, here: int, *, is_on_way: bool) -> Choice:
        """Choose the next target.

        :param here: keyframe at the robot.
        :param is_on_way: whether it drives to the target of before.
        """
        team, roadmap = self._map.teammates, self._map.roadmap
        team.has_new_goals = False
        self._keyframes = team.keyframes_by_scan(self._map.replica.scans) if team.goals else {}
        self._take_over_reached()
        self._finished = {name for name, goals in team.goals.items() if goals.has_finished}
        left = [n for n, each in enumerate(roadmap.frontiers) if not (self._was_tried(each) or self._is_finished(each))]
        costs = self._costs(here, left)
        if not costs:
            self.target = None
            return Choice(is_over=True)
        places = {
            n: (not is_in_room, self._map.frontier_position(roadmap.frontiers[n]))
            for n, (is_in_room, _) in costs.items()
        }
        groups = group_frontiers(places)
        targets, others = self._others()
        free = free_frontiers(costs, places, targets, self._sender.sent_target)
        costs_of_others = {name: self._costs(keyframe, free) for name, keyframe in others.items()}
        number = choose_frontier(free, costs_of_others, groups, team.robot)
        if number is None:
            self.target = None
            rooms = {groups[n] for n, (is_in_room, _) in costs.items() if is_in_room}
            return Choice(
                left_to=tuple(sorted({*others, *(target.robot for target in targets)})),
                is_over=rooms.issuperset(groups.values()),
            )
        if is_on_way and self._is_target(places[number][1]):
            return Choice(self.target)
        self.target, self._path_length = roadmap.frontiers[number], costs[number][1]
        return Choice(self.target, is_new=True)

    def _take_over_reached(self) -> None:
        """What other robots reached is reached for this one, too, as soon as its map has the keyframe beside it."""
        for goals in self._map.teammates.goals.values():
            for place in [goals.reached.popleft() for _ in range(len(goals.reached))]:
                keyframe = self._keyframes.get((place.owner, place.stamp))
                if keyframe is None:
                    goals.reached.append(place)
                else:
                    self._reached.append((keyframe, place.pose[:2]))

    def share(self, stamp: int, remaining: float | None) -> list[Message]:
        """What to send to the explorers of the other robots: the target when it is another one, and from time to time.

        :param stamp: now, ns.
        :param remaining: length of the path to the target, m, None where it is not known.
        """
        return self._sender.send(Goal(self.target, self._path_length, self._has_finished), stamp, remaining)

    def _costs(self, start: int, numbers: Iterable[int]) -> dict[int, Cost]:
        """{number: cost from a keyframe on} of those frontiers that can be reached."""
        roadmap = self._map.roadmap
        distances = roadmap.distances(start)
        frontiers = {number: roadmap.frontiers[number] for number in numbers}
        return {
            number: (not frontier.is_in_hallway, distances[frontier.keyframe] + frontier.length)
            for number, frontier in frontiers.items()
            if frontier.keyframe in distances
        }

    def _others(self) -> tuple[list[RobotTarget], dict[str, int]]:
        """The targets of others, and {robot: its newest keyframe} of those whose targets are not known."""
        team = self._map.teammates
        targets, others = list[RobotTarget](), team.positions(self._map.roadmap.graph)
        for name, goals in team.goals.items():
            earlier = goals.earlier(team.stamp)
            targets += self._targets_of(replace(goal, remaining=0.0) for goal, was_reached in earlier if was_reached)
            last = goals.last(team.stamp)
            if last is None:
                continue
            # A goal in ground that is still to come is where the robot drove to before, or behind that.
            known = self._targets_of([last, *(replace(goal, remaining=last.remaining) for goal, _ in earlier[::-1])])
            targets += known[:1] if last.place is not None else []
            if last.place is None or known:
                others.pop(name, None)
        return targets, others

    def _targets_of(self, goals: Iterable[TeamGoal]) -> list[RobotTarget]:
        """The frontiers of goals, without those that are nowhere, or beside a keyframe that is not in the map."""
        points = [(goal, None if goal.place is None else self._point_of(goal.place)) for goal in goals]
        return [
            RobotTarget(goal.robot, (goal.is_in_hallway, point), goal.remaining)
            for goal, point in points
            if point is not None
        ]

    def _point_of(self, place: TeamPlace) -> Float64 | None:
        """A place in the frame of the robot's area, shape (2,); None where its keyframe is not in the map."""
        locator = self._map.keyframe_locator
        keyframe = self._keyframes.get((place.owner, place.stamp))
        if keyframe is None or keyframe not in locator:
            return None
        return se2.transform(locator.keyframe_pose(keyframe), place.pose[:2])

    def _is_target(self, position: Float64) -> bool:
        """Whether the target is at a position."""
        assert self.target is not None
        return math.dist(position, self._map.frontier_position(self.target)) < SAME_FRONTIER_DISTANCE

    def _was_tried(self, frontier: Frontier) -> bool:
        """Whether a frontier was reached or given up."""
        locator, position = self._map.keyframe_locator, self._map.frontier_position(frontier)
        return any(
            math.dist(position, se2.transform(locator.keyframe_pose(keyframe), point)) < SAME_FRONTIER_DISTANCE
            for keyframe, point in self._reached + self._abandoned
            if keyframe in locator
        )

    def _is_finished(self, frontier: Frontier) -> bool:
        """Whether a frontier is beside a keyframe of a robot whose exploration has ended, and not this robot's goal.

        That robot's own map shows more of what is there. What it left to this one is near this one's goal.
        """
        owner = self._map.teammates.owner_of(frontier.keyframe)
        if owner not in self._finished:
            return False
        target = self._sender.sent_target
        return target is None or not are_seen_together(target.place, self._place(frontier))

    def _place(self, frontier: Frontier) -> FrontierPlace:
        return frontier.is_in_hallway, self._map.frontier_position(frontier)
