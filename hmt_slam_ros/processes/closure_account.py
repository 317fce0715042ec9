"""What hangs on every accepted closure, and the map as it would be had one of them never been accepted.

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
from hmt_slam_ros.processes.undo import Return, Undo
from hmt_slam_ros.topology.common_map import Pair
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable

Pose = NDArray[np.float64]
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
