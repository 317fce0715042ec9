"""An arc that TSBI set, as TLCA keeps it until it is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.closure_account import Closure, pair_of
from hmt_slam_ros.processes.map_parts import Arc
from hmt_slam_ros.processes.messages import Leaf
from hmt_slam_ros.processes.undo import Undo
from hmt_slam_ros.topology.common_map import Pair
from hmt_slam_ros.topology.hybrid_map import HybridMap


@dataclass(frozen=True, eq=False)
class Observation:
    """An arc that TSBI set and that is not definite yet.

    :ivar event: at which it was observed.
    :ivar near: the robot's area before that event.
    :ivar source: area a.
    :ivar target: area b, the one that the robot entered.
    :ivar pose: belief over ``a_T_b`` as observed.
    :ivar closure: whether it closed a loop.
    :ivar before: the definite arc ``a_T_b`` that it replaced, or None.
    :ivar joined: the keyframes that moved into area b.
    :ivar witnesses: the keyframes by which it was observed.
    """

    event: int
    near: int
    source: int
    target: int
    pose: PoseGaussian
    closure: bool
    before: Arc | None
    joined: tuple[int, ...]
    witnesses: frozenset[int]

    @property
    def pair(self) -> Pair:
        """The arc, whatever its direction."""
        return pair_of(self.source, self.target)

    def accepted(self, log_odds: float, undo: Undo) -> Closure:
        """The closure that it becomes."""
        far = self.target if self.near == self.source else self.source
        pose = self.pose if self.near == self.source else self.pose.inverse()
        return Closure((self.event, self.pair), self.near, far, pose, log_odds, undo)


def observed(arc: Arc, leaf: Leaf, event: int, near: int, hybrid_map: HybridMap) -> Observation:
    """What TLCA keeps of a leaf's arc.

    :param near: the robot's area before the event.
    :param hybrid_map: of the leaf's parent.
    """
    inwards = arc.target == leaf.area
    source, target, pose = (
        (arc.source, arc.target, arc.pose) if inwards else (arc.target, arc.source, arc.pose.inverse())
    )
    value, before = hybrid_map.arc_value(source, target), hybrid_map.arc(source, target)
    old = None if value is None or before is None else Arc(source, target, before, value.closure)
    joined = tuple(sorted(r.keyframe for r in leaf.relabelled if r.area == target))
    witnesses = frozenset(joined or [event])
    return Observation(event, near, source, target, pose, arc.closure, old, joined, witnesses)
