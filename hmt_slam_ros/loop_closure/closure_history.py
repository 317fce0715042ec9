"""What depends on every accepted closure, and the map as it would be had one of them never been accepted.

Alignment and refinement move the keyframes of the areas that a closure joined, and let the arcs around them agree with
it, whether it is true or false. What was stored in these areas since was placed beside keyframes that had been moved,
and goes back with the nearest of them.

From a false closure on, the robot seems to be in areas that it is not in: what it stores there is a second layer over
them. Without the closure this layer is an area of its own, joined to the one from which the robot came, and the arcs
that begin in it begin there.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, AreaPair, HybridMap, area_pair
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.messages.map_changes import AreaMerge

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MapSnapshot:
    """Values before an acceptance.

    :ivar keyframes: {keyframe: its area, ``area_T_base``, shape (3,)}.
    :ivar arcs: {arc: its value}.
    """

    keyframes: Mapping[int, tuple[int, Pose]]
    arcs: Mapping[AreaPair, ArcValue]

    def without_arcs(self, arcs: Collection[AreaPair]) -> MapSnapshot:
        """The same, leaving alone some arcs."""
        return MapSnapshot(self.keyframes, {pair: value for pair, value in self.arcs.items() if pair not in arcs})

    def without_area(self, area: int) -> MapSnapshot:
        """The same, leaving alone what is around an area that became part of another.

        Its keyframes go back with the nearest of the other's.
        """
        return MapSnapshot(
            {keyframe: place for keyframe, place in self.keyframes.items() if place[0] != area},
            {pair: value for pair, value in self.arcs.items() if area not in pair},
        )

    def restore_arcs(self, hybrid_map: HybridMap) -> None:
        """Give the arcs that are still there their former values."""
        for pair, value in self.arcs.items():
            if hybrid_map.arc_value(*pair) is not None:
                hybrid_map.set_arc(*pair, value.pose, closure=value.closure)


class MapRollback:
    """The way back of what is stored in areas whose keyframes an acceptance moved."""

    def __init__(self, undo: MapSnapshot, hybrid_map: HybridMap) -> None:
        """:param hybrid_map: as it is, with what is to be undone."""
        self._snapshot = undo
        placed = {
            keyframe: (area, former, hybrid_map.keyframes(area)[keyframe])
            for keyframe, (area, former) in undo.keyframes.items()
            if keyframe in hybrid_map.keyframes(area)
        }
        self._area_poses: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        for area in {area for area, _, _ in placed.values()}:
            own = [(former, now) for where, former, now in placed.values() if where == area]
            former, now = (np.array(poses) for poses in zip(*own, strict=True))
            self._area_poses[area] = (former, now)

    def correction_at(self, area: int, pose: Pose) -> Pose:
        """``former_T_now`` of an area's frame for what is beside a pose in it, shape (3,)."""
        if area not in self._area_poses:
            return np.zeros(3)
        former, now = self._area_poses[area]
        nearest = int(np.argmin(np.hypot(*(now[:, :2] - pose[:2]).T)))
        return se2.compose(former[nearest], se2.inverse(now[nearest]))

    def former_pose(self, area: int, pose: Pose) -> Pose:
        """Where something at a pose in an area was before, shape (3,)."""
        return se2.compose(self.correction_at(area, pose), pose)

    def former_arc(self, source: int, target: int, belief: PoseGaussian) -> PoseGaussian:
        """The belief over ``source_T_target`` of an arc that was measured since."""
        one = self.correction_at(source, belief.mean)
        other = self.correction_at(target, belief.inverse().mean)
        return PoseGaussian(se2.compose(se2.compose(one, belief.mean), se2.inverse(other)), belief.covariance)

    def restore_keyframes(self, hybrid_map: HybridMap) -> None:
        """Put all keyframes of the areas where they were before, or would have been stored."""
        for area in self._area_poses:
            for keyframe, pose in list(hybrid_map.keyframes(area).items()):
                known = self._snapshot.keyframes.get(keyframe)
                there = known is not None and known[0] == area
                hybrid_map.set_keyframe(keyframe, area, known[1] if known and there else self.former_pose(area, pose))

    def restore_arcs(self, hybrid_map: HybridMap, since: Collection[AreaPair]) -> None:
        """Undo the arcs, and correct those that were measured since."""
        for a, b in since:
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
    :ivar joined_keyframes: the keyframes that came over with the robot.
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
    :ivar log_odds: of its being true, when it was accepted.
    :ivar snapshot: what was changed then; None where that is still to be done.
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
        """The same, to be withdrawn without undoing what happened to some arcs."""
        return self if self.snapshot is None else replace(self, snapshot=self.snapshot.without_arcs(arcs))


@dataclass(frozen=True, eq=False)
class AcceptedPath:
    """A definite path.

    :ivar history: the keyframe events at which the robot changed its area or arcs were new, in order.
    :ivar area: the robot's area.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar frame_change: ``area_T_former``, shape (3,), where something was withdrawn that changed the robot's area or
        pose.
    """

    hybrid_map: HybridMap
    history: tuple[PathStep, ...]
    closures: tuple[Closure, ...]
    area: int
    pose: Pose
    frame_change: Pose | None = None

    def with_robot_in(self, area: int, frame_change: Pose) -> AcceptedPath:
        """The robot elsewhere.

        :param frame_change: ``area_T_robot_area``.
        """
        if area == self.area and not frame_change.any():
            return self
        whole = frame_change if self.frame_change is None else se2.compose(frame_change, self.frame_change)
        return replace(self, area=area, pose=se2.compose(frame_change, self.pose), frame_change=whole)


@dataclass
class _ClosureDependents:
    """Follows the robot through what hangs on a closure.

    :ivar is_inside: whether the robot is in the layer.
    :ivar entered_at: the event at which it came into its area.
    :ivar visited_steps: of every step, whether the robot was in the layer before and after it.
    :ivar arcs: {arc that began in the layer: the known area from which it seemed to begin}.
    :ivar keyframes: {keyframe of the layer: the known area in which it seemed to be}.
    """

    hybrid_map: HybridMap
    closure: Closure
    is_inside: bool = False
    entered_at: int = 0
    visited_steps: list[tuple[PathStep, bool, bool]] = field(default_factory=list)
    arcs: dict[AreaPair, int] = field(default_factory=dict)
    keyframes: dict[int, int] = field(default_factory=dict)

    def add_step(self, step: PathStep) -> None:
        """Go on to the end of a step."""
        before = self.is_inside
        if before:
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
        self.visited_steps.append((step, before, self.is_inside))

    def add_keyframes(self, area: int, until: float) -> None:
        """Take in what the robot stored in an area until an event."""
        found = (keyframe for keyframe in self.hybrid_map.keyframes(area) if self.entered_at < keyframe <= until)
        self.keyframes |= dict.fromkeys(found, area)

    def _is_inside_after(self, step: PathStep) -> bool:
        """Whether the robot is in the layer after it changed its area."""
        pair = area_pair(step.area_before, step.area_after)
        if pair == self.closure.pair:
            return step.area_after == self.closure.far
        if pair in self.arcs:
            return step.area_after == self.arcs[pair]
        return self.is_inside


def withdraw_closure(path: AcceptedPath, closure_id: ClosureId, new_area: int) -> AcceptedPath:
    """The account as it would be had a closure not been accepted, whose refinement was taken back.

    :param new_area: what to call an area that it may need.
    """
    closure = next((found for found in path.closures if found.closure_id == closure_id), None)
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
    seen = shortest_path_beliefs(path.hybrid_map, closure.far)
    frames = {area: se2.compose(own_T_far, belief.mean) for area, belief in seen.items()}
    for keyframe, area in sorted(layer.keyframes.items()):
        pose = hybrid_map.keyframes(area)[keyframe]
        hybrid_map.remove_keyframe(keyframe, area)
        hybrid_map.set_keyframe(keyframe, own, se2.compose(frames[area], pose))
    hybrid_map.remove_arc(closure.near, closure.far)
    if own != closure.near:
        hybrid_map.set_arc(closure.near, own, closure.pose, closure=False)
    for pair, area in layer.arcs.items():
        _reattach_arc(hybrid_map, pair, area, own, frames[area])
    steps = tuple(_reassign_step(step, before, after, layer, own) for step, before, after in layer.visited_steps)
    closures = tuple(_remaining_closures(hybrid_map, path.closures, layer, own, frames))
    found = replace(path, hybrid_map=hybrid_map, history=earlier + steps, closures=closures)
    return found.with_robot_in(own, frames[path.area]) if layer.is_inside else found


def undo_refinements(path: AcceptedPath, first: ClosureId) -> AcceptedPath:
    """The account without what the acceptance of a closure and of all later ones changed in the map beside their arcs.

    These closures have nothing to undo any more.
    """
    place = [closure.closure_id for closure in path.closures].index(first)
    for k in range(len(path.closures) - 1, place - 1, -1):
        path = _undo_refinement(path, k)
    return path


def _undo_refinement(path: AcceptedPath, k: int) -> AcceptedPath:
    closure = path.closures[k]
    if closure.snapshot is None:
        return path
    _, steps = split_history(path.history, closure.closure_id[0])
    measured = {pair for step in steps for pair in step.new_arcs} - {closure.pair}
    back, hybrid_map = MapRollback(closure.snapshot, path.hybrid_map), path.hybrid_map.branch()
    back.restore_keyframes(hybrid_map)
    back.restore_arcs(hybrid_map, measured)
    later = (
        replace(other, pose=back.former_arc(other.near, other.far, other.pose)) for other in path.closures[k + 1 :]
    )
    closures = (*path.closures[:k], replace(closure, snapshot=None), *later)
    found = replace(path, hybrid_map=hybrid_map, closures=closures)
    return found.with_robot_in(path.area, back.correction_at(path.area, path.pose))


def map_as_measured(path: AcceptedPath) -> HybridMap:
    """The map with its arcs as they were measured.

    Refinement lets the arcs around a closure agree with it, whether it is true or false.
    """
    hybrid_map = path.hybrid_map.branch()
    for closure in reversed(path.closures):
        if closure.snapshot is not None:
            closure.snapshot.restore_arcs(hybrid_map)
    return hybrid_map


def split_history(history: tuple[PathStep, ...], event: int) -> tuple[tuple[PathStep, ...], tuple[PathStep, ...]]:
    """The steps before an event, and those from it on."""
    begin = bisect_left(history, event, key=lambda step: step.event)
    return history[:begin], history[begin:]


def _reattach_arc(hybrid_map: HybridMap, pair: AreaPair, area: int, own: int, own_T_area: Pose) -> None:
    """Let an arc begin in the layer's own area, where none joins the two already."""
    other = pair[0] if pair[1] == area else pair[1]
    value, arc = hybrid_map.arc_value(*pair), hybrid_map.arc(area, other)
    if value is None or arc is None:
        return
    hybrid_map.remove_arc(*pair)
    if other != own and hybrid_map.arc(own, other) is None:
        hybrid_map.set_arc(own, other, PoseGaussian.from_pose(own_T_area).compose(arc), closure=value.closure)


def _reassign_step(step: PathStep, before: bool, after: bool, layer: _ClosureDependents, own: int) -> PathStep:
    """A step by the names that areas have without the closure."""
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
        own if before else step.area_before,
        own if after else step.area_after,
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
    """The closures that are left, by the names that areas have now."""
    kept = []
    for closure in closures:
        moved = closure.pair in layer.arcs and closure.near == layer.arcs[closure.pair]
        pose = PoseGaussian.from_pose(frames[closure.near]).compose(closure.pose) if moved else closure.pose
        found = replace(closure, near=own, pose=pose) if moved else closure
        value = hybrid_map.arc_value(*found.pair)
        if value is not None and value.closure:
            kept.append(found)
    return kept


def apply_area_merge(path: AcceptedPath, areas: AreaMerge) -> tuple[tuple[PathStep, ...], tuple[Closure, ...]]:
    """History and closures of an account where an area becomes part of another.

    That is final. The closure of the two is no more, and one beside which another observation of its arc is fused now
    cannot be withdrawn.

    :param path: before that.
    """
    hybrid_map = path.hybrid_map
    beside = {*hybrid_map.neighbors(areas.area)} & {*hybrid_map.neighbors(areas.into)}
    fused = {area_pair(areas.into, other) for other in beside}
    history = tuple(_relabel_step(step, areas) for step in path.history)
    found = (_relabel_closure(closure, areas).without_arcs(fused) for closure in path.closures)
    return history, tuple(closure for closure in found if closure.near != closure.far and closure.pair not in fused)


def merge_arc_keyframes(
    witnesses: Mapping[AreaPair, frozenset[int]], areas: AreaMerge
) -> dict[AreaPair, frozenset[int]]:
    """{arc: the keyframes by which it was observed}; those of arcs that are fused have both told."""
    found: dict[AreaPair, frozenset[int]] = {}
    for arc, seen in witnesses.items():
        for pair in _relabel_arcs((arc,), areas):
            found[pair] = found.get(pair, frozenset()) | seen
    return found


def _relabel_closure(closure: Closure, areas: AreaMerge) -> Closure:
    near, far, pose = closure.near, closure.far, closure.pose
    if near == areas.area:
        near, pose = areas.into, areas.pose.compose(pose)
    if far == areas.area:
        far, pose = areas.into, pose.compose(areas.pose.inverse())
    return replace(
        closure, near=near, far=far, pose=pose, snapshot=closure.snapshot and closure.snapshot.without_area(areas.area)
    )


def _relabel_step(step: PathStep, areas: AreaMerge) -> PathStep:
    before, after = (_relabel_area(area, areas) for area in (step.area_before, step.area_after))
    return replace(step, area_before=before, area_after=after, new_arcs=_relabel_arcs(step.new_arcs, areas))


def _relabel_arcs(arcs: tuple[AreaPair, ...], areas: AreaMerge) -> tuple[AreaPair, ...]:
    """Those that are left."""
    ends = ((_relabel_area(a, areas), _relabel_area(b, areas)) for a, b in arcs)
    return tuple(area_pair(a, b) for a, b in ends if a != b)


def _relabel_area(area: int, areas: AreaMerge) -> int:
    return areas.into if area == areas.area else area
