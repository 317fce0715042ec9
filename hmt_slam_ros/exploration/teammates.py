"""The other robots of a team in an exploration: what they have mapped, and which frontiers are left to them.

Explorers share their goals. Where the goal of another one is not known, frontiers are assigned greedily, the cheapest
pair of a robot and a frontier first (Burgard, Moors, Stachniss and Schneider 2005). Who goes to a frontier sees those
around it, which lose their utility for the rest. Robots that are joined have the same map, up to what is under way.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

from hmt_slam_ros.exploration.roadmap import SAME_FRONTIER_DISTANCE
from hmt_slam_ros.exploration.team_goals import LAG, SEEN_FROM_THERE, Cost, FrontierPlace, GoalsOfRobot
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround, Pose
from hmt_slam_ros.messages.team import MAX_ROBOTS, TeamGoal, TeamPlace
from hmt_slam_ros.sensors import Scan

_TIMEOUT = 60 * NANOSECONDS
"""Time without new ground after which nothing is left to a robot: it may have stopped, ns."""


class Teammates:
    """The robots whose ground is part of the map.

    :ivar robot: name of this robot in its team, empty without one.
    :ivar stamp: time of the last update, ns.
    :ivar new_keyframes: keyframes of others that the roadmap does not have yet, in the order in which they came.
    :ivar has_new_goals: whether others have sent goals since this was set to False.
    :ivar goals: {robot: goals} of those that have sent any, or of which there is ground.
    """

    def __init__(self, robot: str = "") -> None:
        self.robot, self.stamp = robot, 0
        self.new_keyframes: list[int] = []
        self.has_new_goals = False
        self.goals: dict[str, GoalsOfRobot] = {}
        self._keyframes: dict[str, list[int]] = {}
        self._owners: dict[int, str] = {}
        self._arrived: dict[str, int] = {}

    def add(self, ground: ForeignGround) -> None:
        """Note new ground of a robot."""
        if ground.keyframes:
            keyframes = [each.keyframe for each in ground.keyframes]
            self.new_keyframes += keyframes
            self._keyframes.setdefault(ground.robot, []).extend(keyframes)
            self._owners |= dict.fromkeys(keyframes, ground.robot)
            self._arrived[ground.robot] = self.stamp
            newest_stamp = max(each.scan.stamp for each in ground.keyframes)
            self.goals.setdefault(ground.robot, GoalsOfRobot()).add_ground(newest_stamp)

    def add_goal(self, goal: TeamGoal) -> None:
        """Note to where a robot drives; a team has one robot of a name."""
        has_room = goal.robot in self.goals or len(self.goals) < MAX_ROBOTS
        if self.robot and goal.robot != self.robot and has_room:
            self.goals.setdefault(goal.robot, GoalsOfRobot()).add(goal, self.stamp)
            self.has_new_goals = True

    def update(self, stamp: int) -> None:
        """Note the time, ns."""
        self.stamp = stamp

    def place_at(self, keyframe: int, pose: Pose, scans: Mapping[int, Scan]) -> TeamPlace:
        """A place beside a keyframe as all robots know it.

        :param pose: ``keyframe_T_place``, shape (3,), m and rad.
        :param scans: {keyframe: scan}.
        """
        return TeamPlace(self.owner_of(keyframe), scans[keyframe].stamp, pose)

    def owner_of(self, keyframe: int) -> str:
        """The robot that mapped a keyframe."""
        return self._owners.get(keyframe, self.robot)

    def keyframes_by_scan(self, scans: Mapping[int, Scan]) -> dict[tuple[str, int], int]:
        """{(robot that mapped it, stamp of its scan): keyframe}, as places name keyframes.

        :param scans: {keyframe: scan} of the map.
        """
        return {(self.owner_of(keyframe), scan.stamp): keyframe for keyframe, scan in scans.items()}

    def positions(self, roadmap: Container[int]) -> dict[str, int]:
        """{robot: its newest keyframe in a roadmap} of those that explore, and have one."""
        exploring = [name for name in self._keyframes if self.stamp - self._arrived[name] <= _TIMEOUT]
        newest = {name: next((k for k in self._keyframes[name][::-1] if k in roadmap), None) for name in exploring}
        return {name: keyframe for name, keyframe in newest.items() if keyframe is not None}


def group_frontiers(frontiers: Mapping[int, FrontierPlace]) -> dict[int, int]:
    """{frontier: one of its room, or of its end of a hallway}: who goes to one sees the others.

    :param frontiers: {frontier: its place}.
    """
    groups: dict[int, int] = {}
    for frontier, (is_in_hallway, position) in sorted(frontiers.items(), key=lambda item: item[1][0]):
        is_first = {n: groups[n] == n and frontiers[n][0] == is_in_hallway for n in groups}
        reach = {n: SEEN_FROM_THERE if is_first[n] else SAME_FRONTIER_DISTANCE for n in groups}
        near = (groups[n] for n in groups if math.dist(position, frontiers[n][1]) <= reach[n])
        groups[frontier] = min(near, default=frontier)
    return groups


def choose_frontier(
    own: Mapping[int, Cost], others: Mapping[str, Mapping[int, Cost]], groups: Mapping[int, int], robot: str
) -> int | None:
    """The frontier that is this robot's, None where all are left to others, whose goals are not known.

    Where two may be as near to a frontier, the first by name goes: the other one takes it to be nearer by twice the
    error of its path, and finds something else. So never both go. Where all is left to others like this, the first by
    name takes the others to be farther away by as much instead: so never both stand.

    :param own: {frontier: its cost for this robot}.
    :param others: {other robot: the same, from its newest keyframe on}.
    :param groups: {frontier: its group}, which one robot explores.
    :param robot: name of this robot.
    """
    cautious = {name: -2.0 * LAG if name < robot else 0.0 for name in others}
    chosen = _assign({robot: own} | _shift(others, cautious), groups).get(robot)
    if chosen is not None:
        return chosen
    bold = {name: 2.0 * LAG if robot < name else 0.0 for name in others}
    return _assign({robot: own} | _shift(others, bold), groups).get(robot)


def _shift(costs: Mapping[str, Mapping[int, Cost]], shifts: Mapping[str, float]) -> dict[str, dict[int, Cost]]:
    """The costs of robots with other lengths of their paths."""
    return {
        name: {frontier: (is_last, path + shifts[name]) for frontier, (is_last, path) in each.items()}
        for name, each in costs.items()
    }


def _assign(costs: Mapping[str, Mapping[int, Cost]], groups: Mapping[int, int]) -> dict[str, int]:
    """{robot: its frontier}: the cheapest pair first."""
    pairs = sorted((cost, name, frontier) for name, each in costs.items() for frontier, cost in each.items())
    assigned: dict[str, int] = {}
    for _, name, frontier in pairs:
        if name not in assigned and groups[frontier] not in {groups[each] for each in assigned.values()}:
            assigned[name] = frontier
    return assigned
