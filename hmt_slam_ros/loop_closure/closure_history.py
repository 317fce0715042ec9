"""What depends on every accepted closure, and the map as it would be had one of them never been accepted.

Alignment and refinement move the keyframes of the areas that a closure joined, and let the arcs around them agree with
it, whether it is true or false. What was stored in these areas since was placed beside keyframes that had been moved,
and goes back with the nearest of them.

From a false closure on, the robot seems to be in areas that it is not in: what it stores there is a second layer over
them. Without the closure this layer is an area of its own, joined to the one from which the robot came, and the arcs
that begin in it begin there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.common_map import ArcValue, Pair
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import reachable
from hmt_slam_ros.messages.map_changes import Merged

Pose = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Undo:
    """Values before an acceptance.

    :ivar keyframes: {keyframe: its area, ``area_T_base``, shape (3,)}.
    :ivar arcs: {arc: its value}.
    """

    keyframes: Mapping[int, tuple[int, Pose]]
    arcs: Mapping[Pair, ArcValue]

    def but_for(self, arcs: Collection[Pair]) -> Undo:
        """The same, leaving alone some arcs."""
        return Undo(self.keyframes, {pair: value for pair, value in self.arcs.items() if pair not in arcs})

    def without(self, area: int) -> Undo:
        """The same, leaving alone what is around an area that became part of another.

        Its keyframes go back with the nearest of the other's.
        """
        return Undo(
            {keyframe: place for keyframe, place in self.keyframes.items() if place[0] != area},
            {pair: value for pair, value in self.arcs.items() if area not in pair},
        )

    def apply_to_arcs(self, hybrid_map: HybridMap) -> None:
        """Give the arcs that are still there their former values."""
        for pair, value in self.arcs.items():
            if hybrid_map.arc_value(*pair) is not None:
                hybrid_map.set_arc(*pair, value.pose, closure=value.closure)


class Return:
    """The way back of what is stored in areas whose keyframes an acceptance moved."""

    def __init__(self, undo: Undo, hybrid_map: HybridMap) -> None:
        """:param hybrid_map: as it is, with what is to be undone."""
        self._undo = undo
        placed = {
            keyframe: (area, former, hybrid_map.keyframes(area)[keyframe])
            for keyframe, (area, former) in undo.keyframes.items()
            if keyframe in hybrid_map.keyframes(area)
        }
        self._areas: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        for area in {area for area, _, _ in placed.values()}:
            own = [(former, now) for where, former, now in placed.values() if where == area]
            former, now = (np.array(poses) for poses in zip(*own, strict=True))
            self._areas[area] = (former, now)

    def at(self, area: int, pose: Pose) -> Pose:
        """``former_T_now`` of an area's frame for what is beside a pose in it, shape (3,)."""
        if area not in self._areas:
            return np.zeros(3)
        former, now = self._areas[area]
        nearest = int(np.argmin(np.hypot(*(now[:, :2] - pose[:2]).T)))
        return se2.compose(former[nearest], se2.inverse(now[nearest]))

    def placed(self, area: int, pose: Pose) -> Pose:
        """Where something at a pose in an area was before, shape (3,)."""
        return se2.compose(self.at(area, pose), pose)

    def arc(self, source: int, target: int, belief: PoseGaussian) -> PoseGaussian:
        """The belief over ``source_T_target`` of an arc that was measured since."""
        one = self.at(source, belief.mean)
        other = self.at(target, belief.inverse().mean)
        return PoseGaussian(se2.compose(se2.compose(one, belief.mean), se2.inverse(other)), belief.covariance)

    def keyframes(self, hybrid_map: HybridMap) -> None:
        """Put all keyframes of the areas where they were before, or would have been stored."""
        for area in self._areas:
            for keyframe, pose in list(hybrid_map.keyframes(area).items()):
                known = self._undo.keyframes.get(keyframe)
                there = known is not None and known[0] == area
                hybrid_map.place(keyframe, area, known[1] if known and there else self.placed(area, pose))

    def arcs(self, hybrid_map: HybridMap, since: Collection[Pair]) -> None:
        """Undo the arcs, and correct those that were measured since."""
        for a, b in since:
            value = hybrid_map.arc_value(a, b)
            if value is not None and (a, b) not in self._undo.arcs:
                hybrid_map.set_arc(a, b, self.arc(a, b, value.pose), closure=value.closure)
        self._undo.apply_to_arcs(hybrid_map)


Name = tuple[int, Pair]


def pair_of(a: int, b: int) -> Pair:
    """The arc between two areas, whatever its direction."""
    return min(a, b), max(a, b)


@dataclass(frozen=True, eq=False)
class Step:
    """A keyframe event at which the robot changed its area or arcs were new.

    :ivar event: the event.
    :ivar before: the robot's area before it.
    :ivar after: the robot's area after it.
    :ivar arcs: the arcs that were new.
    :ivar joined: the keyframes that came over with the robot.
    """

    event: int
    before: int
    after: int
    arcs: tuple[Pair, ...]
    joined: frozenset[int] = frozenset()


History = tuple["History", Step] | None
"""The steps of a path, the last one outside: children share what their parent went through."""


@dataclass(frozen=True, eq=False)
class Closure:
    """An arc that closed a loop.

    :ivar name: the event at which TSBI found it and the arc that it was then; it never changes.
    :ivar near: the area in which the robot was.
    :ivar far: the known one.
    :ivar pose: belief over ``near_T_far`` as TSBI found it.
    :ivar log_odds: of its being true, when it was accepted.
    :ivar undo: what was changed then; None where that is still to be done.
    """

    name: Name
    near: int
    far: int
    pose: PoseGaussian
    log_odds: float
    undo: Undo | None

    @property
    def pair(self) -> Pair:
        """The arc, whatever its direction."""
        return pair_of(self.near, self.far)

    def but_for(self, arcs: Collection[Pair]) -> Closure:
        """The same, to be withdrawn without undoing what happened to some arcs."""
        return self if self.undo is None else replace(self, undo=self.undo.but_for(arcs))


@dataclass(frozen=True, eq=False)
class Account:
    """A definite path.

    :ivar area: the robot's area.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar rebase: ``area_T_former``, shape (3,), where something was withdrawn that changed the robot's area or pose.
    """

    hybrid_map: HybridMap
    history: History
    closures: tuple[Closure, ...]
    area: int
    pose: Pose
    rebase: Pose | None = None

    def moved(self, area: int, rebase: Pose) -> Account:
        """The robot elsewhere.

        :param rebase: ``area_T_robot_area``.
        """
        if area == self.area and not rebase.any():
            return self
        whole = rebase if self.rebase is None else se2.compose(rebase, self.rebase)
        return replace(self, area=area, pose=se2.compose(rebase, self.pose), rebase=whole)


@dataclass
class _Layer:
    """Follows the robot through what hangs on a closure.

    :ivar on: whether the robot is in the layer.
    :ivar since: the event at which it came into its area.
    :ivar passed: of every step, whether the robot was in the layer before and after it.
    :ivar arcs: {arc that began in the layer: the known area from which it seemed to begin}.
    :ivar keyframes: {keyframe of the layer: the known area in which it seemed to be}.
    """

    hybrid_map: HybridMap
    closure: Closure
    on: bool = False
    since: int = 0
    passed: list[tuple[Step, bool, bool]] = field(default_factory=list)
    arcs: dict[Pair, int] = field(default_factory=dict)
    keyframes: dict[int, int] = field(default_factory=dict)

    def follow(self, step: Step) -> None:
        """Go on to the end of a step."""
        before = self.on
        if before:
            self.stay(step.before, step.event)
            self.arcs |= {pair: step.before for pair in step.arcs if step.before in pair and pair != self.closure.pair}
        if step.before != step.after:
            self.on, self.since = self._crossed(step), step.event
        if self.on:
            known = self.hybrid_map.keyframes(step.after)
            self.keyframes |= {keyframe: step.after for keyframe in step.joined if keyframe in known}
        self.passed.append((step, before, self.on))

    def stay(self, area: int, until: float) -> None:
        """Take in what the robot stored in an area until an event."""
        found = (keyframe for keyframe in self.hybrid_map.keyframes(area) if self.since < keyframe <= until)
        self.keyframes |= dict.fromkeys(found, area)

    def _crossed(self, step: Step) -> bool:
        """Whether the robot is in the layer after it changed its area."""
        pair = pair_of(step.before, step.after)
        if pair == self.closure.pair:
            return step.after == self.closure.far
        if pair in self.arcs:
            return step.after == self.arcs[pair]
        return self.on


def without(account: Account, name: Name, new_area: int) -> Account:
    """The account as it would be had a closure not been accepted, whose refinement was taken back.

    :param new_area: what to call an area that it may need.
    """
    closure = next((found for found in account.closures if found.name == name), None)
    if closure is None:
        return account
    earlier, steps = since(account.history, closure.name[0])
    layer = _Layer(account.hybrid_map, closure)
    for step in steps:
        layer.follow(step)
    if layer.on:
        layer.stay(account.area, np.inf)
    hybrid_map = account.hybrid_map.branch()
    own = new_area if layer.keyframes else closure.near
    own_T_far = np.zeros(3) if layer.keyframes else closure.pose.mean
    seen = reachable(account.hybrid_map, closure.far)
    frames = {area: se2.compose(own_T_far, belief.mean) for area, belief in seen.items()}
    for keyframe, area in sorted(layer.keyframes.items()):
        pose = hybrid_map.keyframes(area)[keyframe]
        hybrid_map.remove(keyframe, area)
        hybrid_map.place(keyframe, own, se2.compose(frames[area], pose))
    hybrid_map.remove_arc(closure.near, closure.far)
    if own != closure.near:
        hybrid_map.set_arc(closure.near, own, closure.pose, closure=False)
    for pair, area in layer.arcs.items():
        _moved(hybrid_map, pair, area, own, frames[area])
    history = earlier
    for step, before, after in layer.passed:
        history = history, _renamed(step, before, after, layer, own)
    closures = tuple(_kept(hybrid_map, account.closures, layer, own, frames))
    found = replace(account, hybrid_map=hybrid_map, history=history, closures=closures)
    return found.moved(own, frames[account.area]) if layer.on else found


def unrefined(account: Account, first: Name) -> Account:
    """The account without what the acceptance of a closure and of all later ones changed in the map beside their arcs.

    These closures have nothing to undo any more.
    """
    place = [closure.name for closure in account.closures].index(first)
    for k in range(len(account.closures) - 1, place - 1, -1):
        account = _taken_back(account, k)
    return account


def _taken_back(account: Account, k: int) -> Account:
    closure = account.closures[k]
    if closure.undo is None:
        return account
    _, steps = since(account.history, closure.name[0])
    measured = {pair for step in steps for pair in step.arcs} - {closure.pair}
    back, hybrid_map = Return(closure.undo, account.hybrid_map), account.hybrid_map.branch()
    back.keyframes(hybrid_map)
    back.arcs(hybrid_map, measured)
    later = (replace(other, pose=back.arc(other.near, other.far, other.pose)) for other in account.closures[k + 1 :])
    closures = (*account.closures[:k], replace(closure, undo=None), *later)
    found = replace(account, hybrid_map=hybrid_map, closures=closures)
    return found.moved(account.area, back.at(account.area, account.pose))


def as_measured(account: Account) -> HybridMap:
    """The map with its arcs as they were measured.

    Refinement lets the arcs around a closure agree with it, whether it is true or false.
    """
    hybrid_map = account.hybrid_map.branch()
    for closure in reversed(account.closures):
        if closure.undo is not None:
            closure.undo.apply_to_arcs(hybrid_map)
    return hybrid_map


def steps_of(history: History) -> tuple[Step, ...]:
    """The steps of a history, in their order."""
    return tuple(since(history, 0)[1])


def history_of(steps: Iterable[Step]) -> History:
    """The history of some steps, in their order."""
    history: History = None
    for step in steps:
        history = history, step
    return history


def since(history: History, event: int) -> tuple[History, list[Step]]:
    """The history before an event, and the steps from it on."""
    steps = []
    while history is not None and history[1].event >= event:
        history, step = history
        steps.append(step)
    return history, steps[::-1]


def _moved(hybrid_map: HybridMap, pair: Pair, area: int, own: int, own_T_area: Pose) -> None:
    """Let an arc begin in the layer's own area, where none joins the two already."""
    other = pair[0] if pair[1] == area else pair[1]
    value, arc = hybrid_map.arc_value(*pair), hybrid_map.arc(area, other)
    if value is None or arc is None:
        return
    hybrid_map.remove_arc(*pair)
    if other != own and hybrid_map.arc(own, other) is None:
        hybrid_map.set_arc(own, other, PoseGaussian.exactly(own_T_area).compose(arc), closure=value.closure)


def _renamed(step: Step, before: bool, after: bool, layer: _Layer, own: int) -> Step:
    """A step by the names that areas have without the closure."""
    arcs = []
    for pair in step.arcs:
        if pair == layer.closure.pair:
            arcs += [] if own == layer.closure.near else [pair_of(layer.closure.near, own)]
        elif pair in layer.arcs:
            arcs.append(pair_of(own, pair[0] if pair[1] == layer.arcs[pair] else pair[1]))
        else:
            arcs.append(pair)
    return Step(step.event, own if before else step.before, own if after else step.after, tuple(arcs), step.joined)


def _kept(
    hybrid_map: HybridMap, closures: Collection[Closure], layer: _Layer, own: int, frames: Mapping[int, Pose]
) -> list[Closure]:
    """The closures that are left, by the names that areas have now."""
    kept = []
    for closure in closures:
        moved = closure.pair in layer.arcs and closure.near == layer.arcs[closure.pair]
        pose = PoseGaussian.exactly(frames[closure.near]).compose(closure.pose) if moved else closure.pose
        found = replace(closure, near=own, pose=pose) if moved else closure
        value = hybrid_map.arc_value(*found.pair)
        if value is not None and value.closure:
            kept.append(found)
    return kept


def merged(account: Account, areas: Merged) -> tuple[History, tuple[Closure, ...]]:
    """History and closures of an account where an area becomes part of another.

    That is final. The closure of the two is no more, and one beside which another observation of its arc is fused now
    cannot be withdrawn.

    :param account: before that.
    """
    hybrid_map = account.hybrid_map
    beside = {*hybrid_map.neighbours(areas.area)} & {*hybrid_map.neighbours(areas.into)}
    fused = {pair_of(areas.into, other) for other in beside}
    history = history_of(_renamed_areas(step, areas) for step in steps_of(account.history))
    found = (_closure(closure, areas).but_for(fused) for closure in account.closures)
    return history, tuple(closure for closure in found if closure.near != closure.far and closure.pair not in fused)


def witnesses_of(witnesses: Mapping[Pair, frozenset[int]], areas: Merged) -> dict[Pair, frozenset[int]]:
    """{arc: the keyframes by which it was observed}; those of arcs that are fused have both told."""
    found: dict[Pair, frozenset[int]] = {}
    for arc, seen in witnesses.items():
        for pair in _arcs((arc,), areas):
            found[pair] = found.get(pair, frozenset()) | seen
    return found


def _closure(closure: Closure, areas: Merged) -> Closure:
    near, far, pose = closure.near, closure.far, closure.pose
    if near == areas.area:
        near, pose = areas.into, areas.pose.compose(pose)
    if far == areas.area:
        far, pose = areas.into, pose.compose(areas.pose.inverse())
    return replace(closure, near=near, far=far, pose=pose, undo=closure.undo and closure.undo.without(areas.area))


def _renamed_areas(step: Step, areas: Merged) -> Step:
    before, after = (_name(area, areas) for area in (step.before, step.after))
    return replace(step, before=before, after=after, arcs=_arcs(step.arcs, areas))


def _arcs(arcs: tuple[Pair, ...], areas: Merged) -> tuple[Pair, ...]:
    """Those that are left."""
    ends = ((_name(a, areas), _name(b, areas)) for a, b in arcs)
    return tuple(pair_of(a, b) for a, b in ends if a != b)


def _name(area: int, areas: Merged) -> int:
    return areas.into if area == areas.area else area
