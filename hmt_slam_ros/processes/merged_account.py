"""What TLCA remembers of a path, by the names that areas have where one became part of another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from hmt_slam_ros.processes.closure_account import Account, Closure, History, Step, history_of, pair_of, steps_of
from hmt_slam_ros.processes.map_parts import Merged
from hmt_slam_ros.topology.common_map import Pair


def merged(account: Account, areas: Merged) -> tuple[History, tuple[Closure, ...]]:
    """History and closures of an account where an area becomes part of another.

    That is final. The closure of the two is no more, and one beside which another observation of its arc is fused now
    cannot be withdrawn.

    :param account: before that.
    """
    hybrid_map = account.hybrid_map
    beside = {*hybrid_map.neighbours(areas.area)} & {*hybrid_map.neighbours(areas.into)}
    fused = {pair_of(areas.into, other) for other in beside}
    history = history_of(_renamed(step, areas) for step in steps_of(account.history))
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


def _renamed(step: Step, areas: Merged) -> Step:
    before, after = (_name(area, areas) for area in (step.before, step.after))
    return replace(step, before=before, after=after, arcs=_arcs(step.arcs, areas))


def _arcs(arcs: tuple[Pair, ...], areas: Merged) -> tuple[Pair, ...]:
    """Those that are left."""
    ends = ((_name(a, areas), _name(b, areas)) for a, b in arcs)
    return tuple(pair_of(a, b) for a, b in ends if a != b)


def _name(area: int, areas: Merged) -> int:
    return areas.into if area == areas.area else area
