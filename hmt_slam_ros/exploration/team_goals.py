"""The goals of explorers of a team: frontiers to which others drive, or drove where their ground has yet to arrive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.roadmap import SAME_FRONTIER_DISTANCE
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace

Cost = tuple[bool, float]
"""Of a frontier for a robot: whether it is in no hallway, then the path to it, m."""

FrontierPlace = tuple[bool, Float64]
"""Of a frontier: whether it is in a hallway, and where it is, shape (2,), m."""

LAG = 2.5
"""By how much the path of another robot may be wrong, m: it is shown where it was up to five keyframes ago."""

SEEN_FROM_THERE = 5.0
"""Distance of two frontiers in rooms, or of two in hallways, up to which one robot explores both, m."""

GOAL_PERIOD, _GOAL_TIMEOUT = 10 * NANOSECONDS, 30 * NANOSECONDS
"""Time after which a goal is sent again, and time after which one that is not sent again counts no more, ns."""

_MAX_LEFT, _LEFT_TIMEOUT = 8, 60 * NANOSECONDS
"""Most goals that a robot left which are kept, and the longest time for which they count, ns."""

_MAX_REACHED = 64
"""Most goals that a robot reached and that wait for its ground."""


class _EarlierGoal(NamedTuple):
    """A goal that a robot reached, or left for another one.

    :ivar goal: as it was sent.
    :ivar was_reached: whether the robot reached it.
    :ivar newest_stamp: of the newest keyframe of the robot when it left it, on its clock, ns.
    :ivar arrived: when that was known, on the own clock, ns.
    """

    goal: TeamGoal
    was_reached: bool
    newest_stamp: int
    arrived: int


class GoalsOfRobot:
    """The goals of another robot: the last one, and earlier ones until the map has its ground from there.

    :ivar reached: places of goals that it reached, which the explorer takes over once they are in its map.
    """

    def __init__(self) -> None:
        self.reached: deque[TeamPlace] = deque(maxlen=_MAX_REACHED)
        self._last: TeamGoal | None = None
        self._arrived, self._ground_stamp = 0, -1
        self._earlier: deque[_EarlierGoal] = deque(maxlen=_MAX_LEFT)

    def add(self, goal: TeamGoal, now: int) -> None:
        """Note the next goal.

        :param now: ns.
        """
        last = self._last
        if last is not None and last.place is not None and not _are_same(last.place, goal.place):
            self._earlier.append(_EarlierGoal(last, goal.reached_last, goal.newest_stamp, now))
            self.reached += [last.place] if goal.reached_last else []
        self._last, self._arrived = goal, now

    def add_ground(self, newest_stamp: int) -> None:
        """Note that the map has the robot's ground up to a keyframe of that stamp, on the robot's clock, ns."""
        self._ground_stamp = max(self._ground_stamp, newest_stamp)

    @property
    def has_finished(self) -> bool:
        """Whether the robot's exploration has ended."""
        return self._last is not None and self._last.has_finished

    def last(self, now: int) -> TeamGoal | None:
        """The last goal, None where the robot no longer sends it; that it drives nowhere it sends once."""
        is_sent = self._last is not None and (self._last.place is None or now - self._arrived <= _GOAL_TIMEOUT)
        return self._last if is_sent else None

    def earlier(self, now: int) -> list[tuple[TeamGoal, bool]]:
        """The goals that it left, and whether it reached each, where the map does not show yet what is there."""
        return [
            (each.goal, each.was_reached)
            for each in self._earlier
            if each.newest_stamp > self._ground_stamp and now - each.arrived <= _LEFT_TIMEOUT
        ]


def _are_same(one: TeamPlace, other: TeamPlace | None) -> bool:
    is_beside_it = other is not None and (one.owner, one.stamp) == (other.owner, other.stamp)
    return is_beside_it and other is not None and np.array_equal(one.pose, other.pose)


class RobotTarget(NamedTuple):
    """A frontier that is a robot's.

    :ivar robot: name of the robot.
    :ivar place: of the frontier.
    :ivar remaining: length of the path when it was sent last, m; 0 where the robot was there.
    """

    robot: str
    place: FrontierPlace
    remaining: float


def free_frontiers(
    own: Mapping[int, Cost],
    places: Mapping[int, FrontierPlace],
    targets: Iterable[RobotTarget],
    own_target: RobotTarget | None = None,
) -> dict[int, Cost]:
    """{frontier: its cost for this robot} of those that no other robot sees from where it drives to.

    A robot that is nearer to the goal of another one by twice the error of its path may go there, and the other one
    then turns to something else. Of two with one goal the nearer one goes on, by what both have sent.

    :param own: {frontier: cost} of all.
    :param places: {frontier: its place}.
    :param targets: of other robots.
    :param own_target: as this robot has sent it.
    """
    taken = set[int]()
    for target in targets:
        near = {number for number in own if are_seen_together(places[number], target.place)}
        if own_target is not None and are_seen_together(own_target.place, target.place):
            is_own = (own_target.remaining, own_target.robot) < (target.remaining, target.robot)
        else:
            is_own = any(own[number][1] + 2.0 * LAG < target.remaining for number in near)
        taken |= set() if is_own else near
    return {frontier: cost for frontier, cost in own.items() if frontier not in taken}


def are_seen_together(one: FrontierPlace, other: FrontierPlace) -> bool:
    """Whether who goes to one of two frontiers sees the other."""
    reach = SEEN_FROM_THERE if one[0] == other[0] else SAME_FRONTIER_DISTANCE
    return math.dist(one[1], other[1]) <= reach
