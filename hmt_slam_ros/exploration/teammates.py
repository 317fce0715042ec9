"""The other robots of a team in an exploration: what they have mapped, and which frontiers are left to them.

Frontiers are assigned greedily, the cheapest pair of a robot and a frontier first (Burgard, Moors, Stachniss and
Schneider 2005). Who goes to a frontier sees those around it, which lose their utility for the rest. Robots
that are joined have the same map, up to what is under way.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.roadmap import SAME_FRONTIER_DISTANCE
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround

Cost = tuple[bool, float]
"""Of a frontier for a robot: whether it is in no hallway, then the path to it, m."""

_LAG = 2.5
"""By how much the path of another robot may be wrong, m: it is shown where it was up to five keyframes ago."""

_SEEN_FROM_THERE = 5.0
"""Distance of two frontiers in rooms, or of two in hallways, up to which one robot explores both, m."""

_TIMEOUT = 60 * NANOSECONDS
"""Time without new ground after which nothing is left to a robot: it may have stopped, ns."""


class Teammates:
    """The robots whose ground is part of the map.

    :ivar new_keyframes: keyframes of theirs that the roadmap does not have yet, in the order in which they came.
    """

    def __init__(self) -> None:
        self.new_keyframes: list[int] = []
        self._keyframes: dict[str, list[int]] = {}
        self._arrived: dict[str, int] = {}
        self._stamp = 0

    def add(self, ground: ForeignGround) -> None:
        """Note new ground of a robot."""
        if ground.keyframes:
            keyframes = [each.keyframe for each in ground.keyframes]
            self.new_keyframes += keyframes
            self._keyframes.setdefault(ground.robot, []).extend(keyframes)
            self._arrived[ground.robot] = self._stamp

    def update(self, stamp: int) -> None:
        """Note the time, ns."""
        self._stamp = stamp

    def positions(self, roadmap: Container[int]) -> dict[str, int]:
        """{robot: its newest keyframe in a roadmap} of those that explore, and have one."""
        exploring = [name for name in self._keyframes if self._stamp - self._arrived[name] <= _TIMEOUT]
        newest = {name: next((k for k in self._keyframes[name][::-1] if k in roadmap), None) for name in exploring}
        return {name: keyframe for name, keyframe in newest.items() if keyframe is not None}


def group_frontiers(frontiers: Mapping[int, tuple[bool, Float64]]) -> dict[int, int]:
    """{frontier: one of its room, or of its end of a hallway}: who goes to one sees the others.

    :param frontiers: {frontier: whether it is in a hallway, and where it is, shape (2,), m}.
    """
    groups: dict[int, int] = {}
    for frontier, (is_in_hallway, position) in sorted(frontiers.items(), key=lambda item: item[1][0]):
        is_first = {n: groups[n] == n and frontiers[n][0] == is_in_hallway for n in groups}
        reach = {n: _SEEN_FROM_THERE if is_first[n] else SAME_FRONTIER_DISTANCE for n in groups}
        near = (groups[n] for n in groups if math.dist(position, frontiers[n][1]) <= reach[n])
        groups[frontier] = min(near, default=frontier)
    return groups


def choose_frontier(
    own: Mapping[int, Cost], others: Mapping[str, Mapping[int, Cost]], groups: Mapping[int, int], robot: str
) -> int | None:
    """The frontier that is this robot's, None where all are left to others.

    Where two may be as near to a frontier, the first by name goes: the other one takes it to be nearer by twice the
    error of its path, and finds something else. So never both go. Where all is left to others like this, the first by
    name takes the others to be farther away by as much instead: so never both stand.

    :param own: {frontier: its cost for this robot}.
    :param others: {other robot: the same, from its newest keyframe on}.
    :param groups: {frontier: its group}, which one robot explores.
    :param robot: name of this robot.
    """
    cautious = {name: -2.0 * _LAG if name < robot else 0.0 for name in others}
    chosen = _assign({robot: own} | _shift(others, cautious), groups).get(robot)
    if chosen is not None:
        return chosen
    bold = {name: 2.0 * _LAG if robot < name else 0.0 for name in others}
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
