"""The goal of an explorer as the others of its team know it: what is sent, and when."""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.roadmap import Frontier
from hmt_slam_ros.exploration.team_goals import GOAL_PERIOD, RobotTarget
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.team import TeamGoal


class Goal(NamedTuple):
    """What a robot is about.

    :ivar frontier: to which it drives; None for none.
    :ivar length: of the path there when it was chosen, m.
    :ivar has_finished: whether its exploration has ended.
    """

    frontier: Frontier | None
    length: float
    has_finished: bool


class GoalSender:
    """Sends the goal of a robot when it is another one, and from time to time.

    :ivar reached_last: whether the robot reached the goal that was sent last.
    """

    def __init__(self, exploration_map: ExplorationMap) -> None:
        self.reached_last = False
        self._map = exploration_map
        self._sent, self._sent_at = Goal(None, 0.0, has_finished=False), 0

    @property
    def sent_target(self) -> RobotTarget | None:
        """What the others know: None where that is no frontier, or no longer in the map."""
        frontier = self._sent.frontier
        if frontier is None or frontier.keyframe not in self._map.keyframe_locator:
            return None
        place = frontier.is_in_hallway, self._map.frontier_position(frontier)
        return RobotTarget(self._map.teammates.robot, place, self._sent.length)

    def send(self, goal: Goal, stamp: int, remaining: float | None) -> list[Message]:
        """The message, if one is due; none from a robot without a name, or without a map.

        :param stamp: now, ns.
        :param remaining: length of the path that is left to the goal that was sent last, m, None where it is not known.
        """
        team, scans, frontier = self._map.teammates, self._map.replica.scans, goal.frontier
        is_another = frontier is not self._sent.frontier
        is_due = frontier is not None and stamp - self._sent_at >= GOAL_PERIOD
        is_new = is_another or goal.has_finished != self._sent.has_finished
        is_lost = frontier is not None and frontier.keyframe not in scans
        if is_lost or not (team.robot and scans and (is_due or is_new)):
            return []
        # A new path has no remaining length before the robot follows it.
        length = goal.length if remaining is None or is_another else remaining
        self._sent, self._sent_at = goal._replace(length=length), stamp
        newest, reached_last, self.reached_last = scans[max(scans)].stamp, self.reached_last, False
        if frontier is None:
            return [TeamGoal(team.robot, newest, reached_last, goal.has_finished, None, False, 0.0)]
        place = team.place_at(frontier.keyframe, frontier.end, scans)
        return [TeamGoal(team.robot, newest, reached_last, goal.has_finished, place, frontier.is_in_hallway, length)]
