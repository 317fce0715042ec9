"""The other robots of a team in an exploration: what they have mapped, and which frontiers are left to them.

Frontiers are assigned greedily, the cheapest pair of a robot and a frontier first (Burgard, Moors, Stachniss and
Schneider 2005, without utilities). Robots that are joined have the same map, up to what is under way.
"""

from __future__ import annotations

from collections.abc import Mapping

from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround

Cost = tuple[bool, float]
"""Of a frontier for a robot: whether it is in no hallway, then the path to it, m."""

_LAG = 2.5
"""Added to the path of another robot, m: it is shown where it was up to five keyframes ago.

Without it two robots may stand, each for the other.
"""

_TIMEOUT = 60 * NANOSECONDS
"""Time without new ground after which nothing is left to a robot: it may have stopped, ns."""


class Teammates:
    """The robots whose ground is part of the map.

    :ivar new_keyframes: keyframes of theirs that the roadmap does not have yet, in the order in which they came.
    """

    def __init__(self) -> None:
        self.new_keyframes: list[int] = []
        self._newest: dict[str, int] = {}
        self._arrived: dict[str, int] = {}
        self._stamp = 0

    def add(self, ground: ForeignGround) -> None:
        """Note new ground of a robot."""
        if ground.keyframes:
            self.new_keyframes += [each.keyframe for each in ground.keyframes]
            self._newest[ground.robot] = ground.keyframes[-1].keyframe
            self._arrived[ground.robot] = self._stamp

    def update(self, stamp: int) -> None:
        """Note the time, ns."""
        self._stamp = stamp

    def positions(self) -> dict[str, int]:
        """{robot: its newest keyframe} of those that explore."""
        return {name: k for name, k in self._newest.items() if self._stamp - self._arrived[name] <= _TIMEOUT}


def choose_frontier(own: Mapping[int, Cost], others: Mapping[str, Mapping[int, Cost]]) -> int | None:
    """The frontier that is this robot's, None where all are left to others.

    :param own: {frontier: its cost for this robot}.
    :param others: {other robot: the same, from its newest keyframe on}.
    """
    costs: dict[str, Mapping[int, Cost]] = {"": own}
    for name, each in others.items():
        costs[name] = {frontier: (is_last, path + _LAG) for frontier, (is_last, path) in each.items()}
    pairs = sorted((cost, name, frontier) for name, each in costs.items() for frontier, cost in each.items())
    assigned: dict[str, int] = {}
    for _, name, frontier in pairs:
        if name not in assigned and frontier not in assigned.values():
            assigned[name] = frontier
    return assigned.get("")
