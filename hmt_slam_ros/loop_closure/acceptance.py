"""What acceptance makes of a path's pending arcs: definite arcs, and keyframes that lie where their scans fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.common_map import ArcValue, Pair
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap, floored, fused
from hmt_slam_ros.hybrid_map.shortest_path import tells_nothing
from hmt_slam_ros.loop_closure.area_alignment import AreaAlignment
from hmt_slam_ros.loop_closure.closure_history import Closure, Undo, pair_of
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.messages.map_changes import Arc, Relabelled
from hmt_slam_ros.messages.messages import Leaf
from hmt_slam_ros.sensors import Scan


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


Scans: TypeAlias = Mapping[int, Scan]
Witnesses: TypeAlias = dict[Pair, frozenset[int]]


@dataclass(frozen=True, eq=False)
class Definite:
    """What became definite.

    :ivar arcs: those observed, and those around the areas that closures joined.
    :ivar relabelled: the keyframes that moved.
    :ivar witnesses: {arc: the keyframes by which it was observed}, of all definite arcs.
    :ivar before: the arcs around the areas that closures joined as they were before these were refined.
    """

    arcs: dict[Pair, Arc]
    relabelled: list[Relabelled]
    witnesses: Witnesses
    before: dict[Pair, ArcValue]


class Acceptance:
    """Closures are finely aligned, arcs that were travelled before are fused with what was known of them, and the
    areas refined that closures joined.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._options = configuration.tlca
        self._alignment = AreaAlignment(configuration)
        self._refinement = ClosureRefinement(configuration)

    def of(
        self,
        hybrid_map: HybridMap,
        scans: Scans,
        observations: Iterable[Observation],
        witnesses: Witnesses,
        closed: Collection[int],
    ) -> Definite:
        """What becomes of a path that is accepted, changing its map.

        :param scans: of all keyframes.
        :param observations: that wait for it, in order.
        :param witnesses: {arc: the keyframes by which it was observed}, of the arcs that are definite already.
        :param closed: the areas that closures joined.
        """
        arcs: dict[Pair, Arc] = {}
        relabelled: list[Relabelled] = []
        before: dict[Pair, ArcValue] = {}
        witnesses = dict(witnesses)
        for seen in observations:
            aligned, moved = self._aligned(hybrid_map, scans, seen)
            relabelled += moved
            old = arcs.get(seen.pair, seen.before)
            arcs[seen.pair] = self._fused(aligned, old, witnesses.get(seen.pair, frozenset()))
            witnesses[seen.pair] = witnesses.get(seen.pair, frozenset()) | seen.witnesses
        if closed:
            relabelled, before = self._refined_around(hybrid_map, scans, closed, arcs, relabelled)
        return Definite(arcs, relabelled, witnesses, before)

    def _refined_around(
        self,
        hybrid_map: HybridMap,
        scans: Scans,
        closed: Collection[int],
        arcs: dict[Pair, Arc],
        relabelled: list[Relabelled],
    ) -> tuple[list[Relabelled], dict[Pair, ArcValue]]:
        """Refine the areas that closures joined; the arcs around them follow.

        Returns the keyframes that moved, and the arcs as they were before.
        """
        for arc in arcs.values():
            hybrid_map.set_arc(arc.source, arc.target, arc.pose, closure=arc.closure)
        found = self._refinement.refined(hybrid_map, scans, closed)
        before = {(a, b): value for a, b, value in hybrid_map.all_arcs() if (a, b) in found.arcs}
        for (a, b), value in before.items():
            arcs[a, b] = Arc(a, b, self._floored(found.arcs[a, b]), value.closure)
        moved = {
            keyframe: Relabelled(keyframe, area, area, pose)
            for area, keyframes in found.keyframes.items()
            for keyframe, pose in keyframes.items()
        }
        return list(({r.keyframe: r for r in relabelled} | moved).values()), before

    def _aligned(self, hybrid_map: HybridMap, scans: Scans, seen: Observation) -> tuple[Observation, list[Relabelled]]:
        """A closure that was found by matching areas, finely aligned."""
        if not seen.closure:
            return seen, []
        if seen.joined:
            return self._joined(hybrid_map, scans, seen)
        return self._linked(hybrid_map, scans, seen), []

    def _joined(self, hybrid_map: HybridMap, scans: Scans, seen: Observation) -> tuple[Observation, list[Relabelled]]:
        """The keyframes that joined a known area, moved to where their scans fit the area's own, and the arc likewise.

        Keyframes that the robot stored in the area since then are on neither side: they were matched against both.
        """
        placed = hybrid_map.keyframes(seen.target)
        joined = [keyframe for keyframe in seen.joined if keyframe in placed]
        known = [keyframe for keyframe in placed if keyframe < seen.joined[0]]
        motion = self._alignment.measured(
            [(scans[keyframe], placed[keyframe]) for keyframe in known],
            [(scans[keyframe], placed[keyframe]) for keyframe in joined],
            PoseGaussian(np.zeros(3), seen.pose.covariance),
        )
        if motion is None:
            return seen, []
        moved = [
            Relabelled(keyframe, seen.target, seen.target, se2.compose(motion.mean, placed[keyframe]))
            for keyframe in joined
        ]
        for r in moved:
            hybrid_map.place(r.keyframe, r.area, r.pose)
        return replace(seen, pose=PoseGaussian.exactly(seen.pose.mean).compose(motion.inverse())), moved

    def _linked(self, hybrid_map: HybridMap, scans: Scans, seen: Observation) -> Observation:
        """An arc between areas that keep their keyframes, as the scans of both measure it."""
        known, others = (
            [(scans[keyframe], pose) for keyframe, pose in hybrid_map.keyframes(area).items()]
            for area in (seen.source, seen.target)
        )
        found = self._alignment.measured(known, others, seen.pose)
        return seen if found is None else replace(seen, pose=found)

    def _fused(self, seen: Observation, old: Arc | None, witnesses: frozenset[int]) -> Arc:
        """The definite arc from an observation and what was known before, which tells whether it closed a loop."""
        belief, closure = seen.pose, seen.closure
        if old is not None and not tells_nothing(old.pose):
            shared = len(seen.witnesses & witnesses) / len(seen.witnesses)
            known = old.pose if old.source == seen.source else old.pose.inverse()
            belief, closure = fused(known, belief, shared), old.closure
        return Arc(seen.source, seen.target, self._floored(belief), closure)

    def _floored(self, belief: PoseGaussian) -> PoseGaussian:
        return floored(belief, self._options.arc_sigma_floor, math.radians(self._options.arc_angle_floor))
