"""The history of accepted closures, and the map without one of them.

Acceptance moves keyframes and arcs to agree with a closure, whether it is true or false. What was stored in these areas
since then moves back with the nearest of these keyframes.

After a false closure, the robot seems to be in known areas, and stores a second layer of keyframes over them. Without
the closure, this layer is a separate area, joined to the one from which the robot came, and arcs from the layer begin
there.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, AreaPair, HybridMap, area_pair
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.messages.map_changes import AreaMerge
from hmt_slam_ros.messages.statements import WeighedStatement

Pose = Float64


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """Keyframes and arcs before an acceptance that changed them.

    :ivar keyframes: {keyframe: its area, ``area_T_base``, shape (3,)}.
    :ivar arcs: {arc: its value}.
    """

    keyframes: Mapping[int, tuple[int, Pose]]
    arcs: Mapping[AreaPair, ArcValue]

    def without_arcs(self, arcs: Collection[AreaPair]) -> MapSnapshot:
        """The snapshot without some arcs."""
        return MapSnapshot(self.keyframes, {pair: value for pair, value in self.arcs.items() if pair not in arcs})

    def without_area(self, area: int) -> MapSnapshot:
        """The snapshot without an area that became part of another.

        Its keyframes move back with the nearest of the other's.
        """
        return MapSnapshot(
            {keyframe: placement for keyframe, placement in self.keyframes.items() if placement[0] != area},
            {pair: value for pair, value in self.arcs.items() if area not in pair},
        )

    def restore_arcs(self, hybrid_map: HybridMap) -> None:
        """Restore the arcs that still exist."""
        for pair, value in self.arcs.items():
            if hybrid_map.arc_value(*pair) is not None:
                hybrid_map.set_arc(*pair, value.pose, closure=value.closure)


class MapRollback:
    """Moves back what is stored in areas whose keyframes an acceptance moved."""

    def __init__(self, snapshot: MapSnapshot, hybrid_map: HybridMap) -> None:
        """:param snapshot: from before the acceptance.

        :param hybrid_map: the map after it.
        """
        self._snapshot = snapshot
        poses: dict[int, list[tuple[Pose, Pose]]] = {}
        for keyframe, (area, former) in snapshot.keyframes.items():
            if keyframe in hybrid_map.keyframes(area):
                poses.setdefault(area, []).append((former, hybrid_map.keyframes(area)[keyframe]))
        # {area: former and present poses of its keyframes, shapes (n, 3)}
        self._area_poses = {area: np.array(own).transpose(1, 0, 2) for area, own in poses.items()}

    def correction_at(self, area: int, pose: Pose) -> Pose:
        """``former_T_present`` of an area's frame near a pose in it, shape (3,)."""
        if area not in self._area_poses:
            return np.zeros(3)
        former, present = self._area_poses[area]
        nearest = int(np.argmin(np.hypot(*(present[:, :2] - pose[:2]).T)))
        return se2.compose(former[nearest], se2.inverse(present[nearest]))

    def former_pose(self, area: int, pose: Pose) -> Pose:
        """The former pose of what is at a pose in an area, shape (3,)."""
        return se2.compose(self.correction_at(area, pose), pose)

    def former_arc(self, source: int, target: int, belief: PoseGaussian) -> PoseGaussian:
        """The former belief over ``source_T_target`` of an arc that was measured since."""
        at_source = self.correction_at(source, belief.mean)
        at_target = self.correction_at(target, belief.inverse().mean)
        mean = se2.compose(se2.compose(at_source, belief.mean), se2.inverse(at_target))
        return PoseGaussian(mean, belief.covariance)

    def restore_keyframes(self, hybrid_map: HybridMap) -> None:
        """Move all keyframes of the areas to their former poses."""
        for area in self._area_poses:
            for keyframe, pose in list(hybrid_map.keyframes(area).items()):
                former_area, former_pose = self._snapshot.keyframes.get(keyframe, (None, pose))
                former = former_pose if former_area == area else self.former_pose(area, pose)
                hybrid_map.set_keyframe(keyframe, area, former)

    def restore_arcs(self, hybrid_map: HybridMap, measured_since: Collection[AreaPair]) -> None:
        """Restore the arcs of the snapshot, and correct those that were measured since."""
        for a, b in measured_since:
            value = hybrid_map.arc_value(a, b)
            if value is not None and (a, b) not in self._snapshot.arcs:
                hybrid_map.set_arc(a, b, self.former_arc(a, b, value.pose), closure=value.closure)
        self._snapshot.restore_arcs(hybrid_map)


ClosureId = tuple[int, AreaPair]


@dataclass(frozen=True, eq=False)
class PathStep:
    """A keyframe event at which the robot changed its area or arcs were new.

    :ivar event: the event.
    :ivar area_before: the robot's area before it.
    :ivar area_after: the robot's area after it.
    :ivar new_arcs: the arcs that were new.
    :ivar joined_keyframes: the keyframes that changed the area with the robot.
    """

    event: int
    area_before: int
    area_after: int
    new_arcs: tuple[AreaPair, ...]
    joined_keyframes: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Closure:
    """An arc that closed a loop.

    :ivar closure_id: the event at which TSBI found it and the arc that it was then; it never changes.
    :ivar near: the area in which the robot was.
    :ivar far: the known one.
    :ivar pose: belief over ``near_T_far`` as TSBI found it.
    :ivar log_odds: that it is true, when it was accepted.
    :ivar snapshot: what the acceptance changed; None if the closure is to be accepted again.
    """

    closure_id: ClosureId
    near: int
    far: int
    pose: PoseGaussian
    log_odds: float
    snapshot: MapSnapshot | None

    @property
    def pair(self) -> AreaPair:
        """The arc, whatever its direction."""
        return area_pair(self.near, self.far)

    def without_arcs(self, arcs: Collection[AreaPair]) -> Closure:
        """The closure with a snapshot without some arcs."""
        return self if self.snapshot is None else replace(self, snapshot=self.snapshot.without_arcs(arcs))


@dataclass(frozen=True, eq=False)
class AcceptedPath:
    """A definite path.

    :ivar history: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar area: the robot's area.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar frame_change: ``area_T_former``, shape (3,), if a withdrawal changed the robot's area or pose.
    :ivar statements: what people stated about places.
    """

    hybrid_map: HybridMap
    history: tuple[PathStep, ...]
    closures: tuple[Closure, ...]
    area: int
    pose: Pose
    frame_change: Pose | None = None
    statements: tuple[WeighedStatement, ...] = ()

    def with_robot_in(self, area: int, frame_change: Pose) -> AcceptedPath:
        """The path with the robot in another area or frame.

        :param frame_change: ``area_T_robot_area``.
        """
        if area == self.area and not frame_change.any():
            return self
        total = frame_change if self.frame_change is None else se2.compose(frame_change, self.frame_change)
        return replace(self, area=area, pose=se2.compose(frame_change, self.pose), frame_change=total)


@dataclass
class _ClosureDependents:
    """The layer of keyframes and arcs that depends on a closure, collected along the path.

    :ivar is_inside: whether the robot is in the layer.
    :ivar entered_at: the event at which it entered its area.
    :ivar visited_steps: of every step, whether the robot was in the layer before and after it.
    :ivar arcs: {arc from the layer: the known area from which it seems to begin}.
    :ivar keyframes: {keyframe of the layer: the known area in which it seems to be}.
    """

    hybrid_map: HybridMap
    closure: Closure
    is_inside: bool = False
    entered_at: int = 0
    visited_steps: list[tuple[PathStep, bool, bool]] = field(default_factory=list)
    arcs: dict[AreaPair, int] = field(default_factory=dict)
    keyframes: dict[int, int] = field(default_factory=dict)

    def add_step(self, step: PathStep) -> None:
        """Follow a step of the path."""
        was_inside = self.is_inside
        if was_inside:
            self.add_keyframes(step.area_before, step.event)
            self.arcs |= {
                pair: step.area_before
                for pair in step.new_arcs
                if step.area_before in pair and pair != self.closure.pair
            }
        if step.area_before != step.area_after:
            self.is_inside, self.entered_at = self._is_inside_after(step), step.event
        if self.is_inside:
            known = self.hybrid_map.keyframes(step.area_after)
            self.keyframes |= {keyframe: step.area_after for keyframe in step.joined_keyframes if keyframe in known}
        self.visited_steps.append((step, was_inside, self.is_inside))

    def add_keyframes(self, area: int, until: float) -> None:
        """Add the keyframes that the robot stored in an area until an event."""
        stored = (keyframe for keyframe in self.hybrid_map.keyframes(area) if self.entered_at < keyframe <= until)
        self.keyframes |= dict.fromkeys(stored, area)

    def _is_inside_after(self, step: PathStep) -> bool:
        """Whether the robot is in the layer after it changed its area."""
        pair = area_pair(step.area_before, step.area_after)
        if pair == self.closure.pair:
            return step.area_after == self.closure.far
        if pair in self.arcs:
            return step.area_after == self.arcs[pair]
        return self.is_inside


def withdraw_closure(path: AcceptedPath, closure_id: ClosureId, new_area: int) -> AcceptedPath:
    """The path without a closure whose refinement was undone.

    :param new_area: number of a new area, if one is needed.
    """
    closure = next((c for c in path.closures if c.closure_id == closure_id), None)
    if closure is None:
        return path
    earlier, steps = split_history(path.history, closure.closure_id[0])
    layer = _ClosureDependents(path.hybrid_map, closure)
    for step in steps:
        layer.add_step(step)
    if layer.is_inside:
        layer.add_keyframes(path.area, np.inf)
    hybrid_map = path.hybrid_map.branch()
    own = new_area if layer.keyframes else closure.near
    own_T_far = np.zeros(3) if layer.keyframes else closure.pose.mean
    beliefs = shortest_path_beliefs(path.hybrid_map, closure.far)
    frames = {area: se2.compose(own_T_far, belief.mean) for area, belief in beliefs.items()}
    for keyframe, area in sorted(layer.keyframes.items()):
        pose = hybrid_map.keyframes(area)[keyframe]
        hybrid_map.remove_keyframe(keyframe, area)
        hybrid_map.set_keyframe(keyframe, own, se2.compose(frames[area], pose))
    hybrid_map.remove_arc(closure.near, closure.far)
    if own != closure.near:
        hybrid_map.set_arc(closure.near, own, closure.pose, closure=False)
    for pair, area in layer.arcs.items():
        _reattach_arc(hybrid_map, pair, area, own, frames[area])
    steps = tuple(_reassign_step(*visited, layer, own) for visited in layer.visited_steps)
    closures = tuple(_remaining_closures(hybrid_map, path.closures, layer, own, frames))
    without = replace(path, hybrid_map=hybrid_map, history=earlier + steps, closures=closures)
    return without.with_robot_in(own, frames[path.area]) if layer.is_inside else without


def undo_refinements(path: AcceptedPath, first: ClosureId) -> AcceptedPath:
    """The path without the refinements of a closure and of all later ones, which then have no snapshots."""
    first_index = [closure.closure_id for closure in path.closures].index(first)
    for k in range(len(path.closures) - 1, first_index - 1, -1):
        path = _undo_refinement(path, k)
    return path


def _undo_refinement(path: AcceptedPath, k: int) -> AcceptedPath:
    closure = path.closures[k]
    if closure.snapshot is None:
        return path
    _, steps = split_history(path.history, closure.closure_id[0])
    measured = {pair for step in steps for pair in step.new_arcs} - {closure.pair}
    rollback, hybrid_map = MapRollback(closure.snapshot, path.hybrid_map), path.hybrid_map.branch()
    rollback.restore_keyframes(hybrid_map)
    rollback.restore_arcs(hybrid_map, measured)
    later = (replace(c, pose=rollback.former_arc(c.near, c.far, c.pose)) for c in path.closures[k + 1 :])
    closures = (*path.closures[:k], replace(closure, snapshot=None), *later)
    without = replace(path, hybrid_map=hybrid_map, closures=closures)
    return without.with_robot_in(path.area, rollback.correction_at(path.area, path.pose))


def map_as_measured(path: AcceptedPath) -> HybridMap:
    """The map with its arcs as they were measured, before refinements made them agree with closures."""
    hybrid_map = path.hybrid_map.branch()
    for closure in reversed(path.closures):
        if closure.snapshot is not None:
            closure.snapshot.restore_arcs(hybrid_map)
    return hybrid_map


def split_history(history: tuple[PathStep, ...], event: int) -> tuple[tuple[PathStep, ...], tuple[PathStep, ...]]:
    """The steps before an event, and those from it on."""
    k = bisect_left(history, event, key=lambda step: step.event)
    return history[:k], history[k:]


def _reattach_arc(hybrid_map: HybridMap, pair: AreaPair, area: int, own: int, own_T_area: Pose) -> None:
    """Move an arc to the layer's own area, unless an arc joins the two already."""
    other = pair[0] if pair[1] == area else pair[1]
    value, arc = hybrid_map.arc_value(*pair), hybrid_map.arc(area, other)
    if value is None or arc is None:
        return
    hybrid_map.remove_arc(*pair)
    if other != own and hybrid_map.arc(own, other) is None:
        hybrid_map.set_arc(own, other, PoseGaussian.from_pose(own_T_area).compose(arc), closure=value.closure)


def _reassign_step(step: PathStep, was_inside: bool, is_inside: bool, layer: _ClosureDependents, own: int) -> PathStep:
    """A step with the numbers of areas without the closure."""
    arcs = []
    for pair in step.new_arcs:
        if pair == layer.closure.pair:
            arcs += [] if own == layer.closure.near else [area_pair(layer.closure.near, own)]
        elif pair in layer.arcs:
            arcs.append(area_pair(own, pair[0] if pair[1] == layer.arcs[pair] else pair[1]))
        else:
            arcs.append(pair)
    return PathStep(
        step.event,
        own if was_inside else step.area_before,
        own if is_inside else step.area_after,
        tuple(arcs),
        step.joined_keyframes,
    )


def _remaining_closures(
    hybrid_map: HybridMap,
    closures: Collection[Closure],
    layer: _ClosureDependents,
    own: int,
    frames: Mapping[int, Pose],
) -> list[Closure]:
    """The remaining closures, with the numbers that areas have now."""
    remaining = []
    for closure in closures:
        is_moved = closure.pair in layer.arcs and closure.near == layer.arcs[closure.pair]
        pose = PoseGaussian.from_pose(frames[closure.near]).compose(closure.pose) if is_moved else closure.pose
        relabeled = replace(closure, near=own, pose=pose) if is_moved else closure
        value = hybrid_map.arc_value(*relabeled.pair)
        if value is not None and value.closure:
            remaining.append(relabeled)
    return remaining


def apply_area_merge(path: AcceptedPath, merge: AreaMerge) -> tuple[tuple[PathStep, ...], tuple[Closure, ...]]:
    """History and closures of a path in which an area becomes part of another.

    A merge is final. The closure between the two vanishes. A closure whose arc is fused with another one cannot be
    withdrawn any more.

    :param path: before the merge.
    """
    hybrid_map = path.hybrid_map
    common = {*hybrid_map.neighbors(merge.area)} & {*hybrid_map.neighbors(merge.into)}
    fused = {area_pair(merge.into, other) for other in common}
    history = tuple(_relabel_step(step, merge) for step in path.history)
    closures = (_relabel_closure(closure, merge).without_arcs(fused) for closure in path.closures)
    return history, tuple(c for c in closures if c.near != c.far and c.pair not in fused)


def merge_arc_keyframes(
    arc_keyframes: Mapping[AreaPair, frozenset[int]], merge: AreaMerge
) -> dict[AreaPair, frozenset[int]]:
    """{arc: the keyframes by which it was observed} after a merge; arcs that are fused have those of both."""
    merged: dict[AreaPair, frozenset[int]] = {}
    for arc, keyframes in arc_keyframes.items():
        for pair in _relabel_arcs((arc,), merge):
            merged[pair] = merged.get(pair, frozenset()) | keyframes
    return merged


def _relabel_closure(closure: Closure, merge: AreaMerge) -> Closure:
    near, far, pose = closure.near, closure.far, closure.pose
    if near == merge.area:
        near, pose = merge.into, merge.pose.compose(pose)
    if far == merge.area:
        far, pose = merge.into, pose.compose(merge.pose.inverse())
    snapshot = closure.snapshot and closure.snapshot.without_area(merge.area)
    return replace(closure, near=near, far=far, pose=pose, snapshot=snapshot)


def _relabel_step(step: PathStep, merge: AreaMerge) -> PathStep:
    before, after = (_relabel_area(area, merge) for area in (step.area_before, step.area_after))
    return replace(step, area_before=before, area_after=after, new_arcs=_relabel_arcs(step.new_arcs, merge))


def _relabel_arcs(arcs: tuple[AreaPair, ...], merge: AreaMerge) -> tuple[AreaPair, ...]:
    """The remaining arcs, without the one between the two areas."""
    ends = ((_relabel_area(a, merge), _relabel_area(b, merge)) for a, b in arcs)
    return tuple(area_pair(a, b) for a, b in ends if a != b)


def _relabel_area(area: int, merge: AreaMerge) -> int:
    return merge.into if area == merge.area else area
