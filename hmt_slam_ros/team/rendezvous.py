"""Rendezvous: one robot observes another, or both were at one place; optional evidence of how their maps lie.

It is a window of the second map, the keyframe before it, with one candidate in the first. With a small probability the
robot that is observed is another one: then it tells nothing (docs/decisions/0079-rendezvous.md).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.team import TeamRendezvous
from hmt_slam_ros.team.components import ComponentPair
from hmt_slam_ros.team.placement import PlacementPrior, WindowCandidate
from hmt_slam_ros.team.windows import Window

_RELIABILITY = 0.95
"""Probability that the robot that is observed is the one that is named."""

_AREA_SIZE = 50.0
"""Floor of an area, m2: a robot that is not the one that is named is anywhere in the building, in any direction."""

_SINCE_KEYFRAME, _BETWEEN_KEYFRAMES = (
    np.diag([0.3, 0.3, math.radians(12.0)]) ** 2,
    np.diag([0.1, 0.1, math.radians(4.0)]) ** 2,
)
"""Covariance of what a robot drives after a keyframe until the next one; and where its poses at both are known.

Of x, y and theta, m and rad, squared.
"""

_MAX_OF_PAIR = 32
"""Rendezvous with a robot that are kept: they bound the memory and the work."""

_MIN_INTERVAL = 30 * NANOSECONDS
"""Time after a rendezvous in which others with the same robot are no evidence of their own, ns."""


class Rendezvous(NamedTuple):
    """A rendezvous of two robots, by the order of their components.

    :ivar first_stamp: time on the clock of the first robot, ns.
    :ivar second_stamp: on that of the second.
    :ivar pose: belief over ``first_T_second`` of the robots' bases then.
    """

    first_stamp: int
    second_stamp: int
    pose: PoseGaussian


class KnownRendezvous:
    """The rendezvous of a robot with others: a bounded number, and of those that follow one another soon, one."""

    def __init__(self, robot: str, state: Iterable[TeamRendezvous] = ()) -> None:
        """:param state: to go on from."""
        self._robot, self._all = robot, list(state)

    @property
    def state(self) -> tuple[TeamRendezvous, ...]:
        """All of them, as a value."""
        return tuple(self._all)

    def add(self, rendezvous: TeamRendezvous) -> str:
        """Keep a rendezvous; the name of the other robot, empty where it is no evidence of its own."""
        names = {rendezvous.robot, rendezvous.other}
        known = [each for each in self._all if names == {each.robot, each.other}]
        if self._robot not in names or len(known) == _MAX_OF_PAIR or any(_is_soon(rendezvous, each) for each in known):
            return ""
        self._all.append(rendezvous)
        (other,) = names - {self._robot}
        return other

    def with_robot(self, name: str) -> list[Rendezvous]:
        """Those with another robot, by the order of the components."""
        first = min(self._robot, name)
        return [
            Rendezvous(each.stamp, each.other_stamp, each.pose)
            if each.robot == first
            else Rendezvous(each.other_stamp, each.stamp, each.pose.inverse())
            for each in self._all
            if name in (each.robot, each.other)
        ]


def _is_soon(one: TeamRendezvous, other: TeamRendezvous) -> bool:
    """Whether a rendezvous of two robots is too soon after another one to be evidence of its own."""
    stamp = other.stamp if one.robot == other.robot else other.other_stamp
    return abs(one.stamp - stamp) < _MIN_INTERVAL


class RendezvousWindow(NamedTuple):
    """The window of a rendezvous, and its only candidate.

    :ivar window: of the second component.
    :ivar area: of the first.
    :ivar belief: over ``area_T_reference``.
    :ivar log_ratio: log Bayes factor, relative to ground that the first component does not have.
    """

    window: Window
    area: int
    belief: PoseGaussian
    log_ratio: float

    def candidate(self, number: int) -> WindowCandidate:
        """The candidate, where the window has a number."""
        return WindowCandidate(number, self.area, self.belief, self.log_ratio)


def rendezvous_window(pair: ComponentPair, rendezvous: Rendezvous) -> RendezvousWindow | None:
    """The window of a rendezvous; None while a map lacks the keyframes before and after, or when they were pruned."""
    first = _place_at(pair, pair.known, rendezvous.first_stamp)
    second = _place_at(pair, pair.other, rendezvous.second_stamp)
    if first is None or second is None:
        return None
    belief = first.belief.compose(rendezvous.pose).compose(PoseGaussian(np.zeros(3), second.belief.covariance))
    peak = 1.0 / math.sqrt((2.0 * math.pi) ** 3 * float(np.linalg.det(belief.covariance)))
    places = PlacementPrior.of_pair(len(pair.known), len(pair.other)).places
    odds = 1.0 - _RELIABILITY + _RELIABILITY * peak * 2.0 * math.pi * _AREA_SIZE * places
    window = Window(second.area, second.belief.mean, {second.keyframe: second.pose_of_keyframe})
    return RendezvousWindow(window, first.area, belief, math.log(odds))


class _RobotPlace(NamedTuple):
    """Where a robot was in its map.

    :ivar area: of the keyframe.
    :ivar keyframe: the last one until then.
    :ivar belief: over ``area_T_base``.
    :ivar pose_of_keyframe: shape (3,), ``base_T_keyframe``, m, rad.
    """

    area: int
    keyframe: int
    belief: PoseGaussian
    pose_of_keyframe: Float64


def _place_at(pair: ComponentPair, areas: Collection[int], stamp: int) -> _RobotPlace | None:
    """Where the robot of a component was at a time: between two successive keyframes, None without them."""
    area_of = {k: area for area in areas for k in pair.hybrid_map.keyframes(area)}
    keyframes = sorted(area_of)
    after = bisect_right([pair.scans[k].stamp for k in keyframes], stamp)
    if not 0 < after < len(keyframes) or keyframes[after] != keyframes[after - 1] + 1:
        return None
    before, next_one = keyframes[after - 1], keyframes[after]
    area = area_of[before]
    start, covariance = pair.hybrid_map.keyframes(area)[before], _SINCE_KEYFRAME
    pose = start
    if area_of[next_one] == area:
        begin, end = pair.scans[before].stamp, pair.scans[next_one].stamp
        pose = se2.interpolate(start, pair.hybrid_map.keyframes(area)[next_one], (stamp - begin) / (end - begin))
        covariance = _BETWEEN_KEYFRAMES
    return _RobotPlace(area, before, PoseGaussian(pose, covariance), se2.between(pose, start))
