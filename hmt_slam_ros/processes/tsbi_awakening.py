"""A robot that woke up somewhere: it maps around itself, and is joined to the map where it is recognized.

It is not known how it came there, so that it begins a new area, to which an arc leads that tells nothing. From then on
all that it saw is looked for in the whole map, again and again, until one place has nearly all of the probability at
two looks in a row, or at one where somebody says that it is there; then a further continuation of the path closes the
loop between the two maps, and TLCA decides as it does about any other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.messages import Arc, Keyframe, Place
from hmt_slam_ros.processes.tsbi_branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topology.hypothesis_tree import Sighting
from hmt_slam_ros.topology.relocation import Located, is_certain
from hmt_slam_ros.topology.shortest_path import reachable
from hmt_slam_ros.topology.unknown import tells_nothing, unknown
from hmt_slam_ros.topology.whereabouts import Told

Pose = NDArray[np.float64]

# Probability that a place needs to have at two looks in a row, and at one look where somebody says so.
_TWICE, _ONCE = 0.8, 0.9
# Two looks found the same place where they have a keyframe within so much of each other, m and rad.
_NEAR, _TURN = 1.0, math.radians(15.0)
# So many keyframes that fit nowhere near where somebody says, in this probability, refute it.
_REFUTED, _NOWHERE = 5, 0.9
# Keyframes that are laid into the map at most, the newest.
_MOST = 40


def arrived(branching: Branching, parent: Parent, keyframe: Keyframe, pose: Pose) -> Branches:
    """The continuations of a hypothesis at a keyframe of which nothing or somebody tells where it is.

    :param pose: ``area_T_base`` of its scan.
    """
    if keyframe.carried:
        return _awoken(branching, parent, keyframe.sequence, keyframe.place)
    if keyframe.place is not None and parent.notes.lost is not None:
        return _told_where(branching, parent, keyframe.place, pose)
    return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, parent.notes)])


def _awoken(branching: Branching, parent: Parent, keyframe: int, place: Place | None) -> Branches:
    """The one continuation of a hypothesis where the robot may be anywhere: in a new area.

    :param place: where it is as somebody says: there the area is drawn, and there it is looked for first.
    """
    query = branching.query(parent, [keyframe])
    told = None
    if place is not None and parent.hybrid_map.has_area(place.area):
        told = Told(keyframe, place.area, place.pose)
    arc = unknown(query.belief.mean if told is None else _as_told(parent, parent.area, told))
    origin = PoseGaussian.exactly(np.zeros(3))
    child = branching.entered(parent, query, branching.new_area(parent, query), origin, arc, 0.0)
    return Branches([replace(child, notes=replace(child.notes, lost=keyframe, told=told))])


def _told_where(branching: Branching, parent: Parent, place: Place, pose: Pose) -> Branches:
    """A robot that may be anywhere, of which somebody says where it is: it is drawn there, and looked for at once.

    :param pose: ``area_T_base`` of the newest scan.
    """
    assert parent.notes.lost is not None
    seen = _seen_since(parent, parent.notes.lost)
    if not parent.hybrid_map.has_area(place.area) or not seen:
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, parent.notes)])
    newest = max(seen)
    told = Told(newest, place.area, place.pose.compose(PoseGaussian.exactly(se2.between(pose, seen[newest]))))
    looked = looked_for(branching, replace(parent, notes=replace(parent.notes, told=told)))
    arcs = _drawn_anew(parent, parent.notes.lost, told, seen[newest])
    return looked._replace(children=[replace(child, arcs=child.arcs or arcs) for child in looked.children])


def _as_told(parent: Parent, area: int, told: Told) -> Pose:
    """``area_T_base`` of what somebody said, shape (3,), in the frame of another area."""
    between = reachable(parent.hybrid_map, area, until=(told.area,)).get(told.area)
    return told.pose.mean if between is None else se2.compose(between.mean, told.pose.mean)


def _drawn_anew(parent: Parent, lost: int, told: Told, pose: Pose) -> tuple[Arc, ...]:
    """The arc that tells nothing, such that all since the robot arrived is drawn where somebody says.

    :param pose: ``area_T_base`` of the keyframe of which it is said, in the robot's area.
    """
    for known, new, arc in parent.hybrid_map.all_arcs():
        if tells_nothing(arc.pose) and min(parent.hybrid_map.keyframes(new), default=-1) >= lost:
            own = reachable(parent.hybrid_map, parent.area, until=(new,))[new].mean
            mean = se2.compose(_as_told(parent, known, told), se2.between(pose, own))
            return (Arc(known, new, unknown(mean)),)
    return ()


def looked_for(branching: Branching, parent: Parent) -> Branches:
    """To be lost still, or where the robot was recognized."""
    assert parent.notes.lost is not None
    keyframes = _seen_since(parent, parent.notes.lost)
    reference = next(iter(keyframes.values()))
    poses = {k: se2.between(reference, pose) for k, pose in keyframes.items()}
    told = _told_of(parent, keyframes)
    where = branching.search.everywhere(parent.hybrid_map, poses, parent.notes.lost, told)
    noted = replace(parent, notes=parent.notes.checked((), tuple(poses)))
    if len(keyframes) >= _REFUTED and float(where.probabilities.sum()) < 1.0 - _NOWHERE:
        noted = replace(noted, notes=replace(noted.notes, told=None))
    best = where.best
    if best is None or best[1] < _TWICE or not is_certain(best[0]):
        unsighted = replace(noted.notes, sighted=None)
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, unsighted)], True, where=where)
    located, probability = best
    sighted = replace(noted.notes, sighted=_sighting(located, poses))
    still = Child(parent.hypothesis, parent.log_weight, parent.area, sighted)
    if not (told is not None and probability >= _ONCE) and not _seen_again(parent, located, poses):
        return Branches([still], True, where=where)
    arc = Arc(parent.area, located.area, PoseGaussian.exactly(reference).compose(located.mode.measured.inverse()), True)
    log_weight = parent.log_weight + math.log(probability)
    notes = replace(noted.notes, lost=None, told=None, sighted=None)
    found = Child(parent.hypothesis, log_weight, parent.area, notes, arcs=(arc,), reload=True)
    still = replace(still, log_weight=parent.log_weight + math.log(max(1.0 - probability, 1e-300)))
    return Branches([still, found], True, where=where)


def _sighting(located: Located, poses: Mapping[int, Pose]) -> Sighting:
    newest = max(poses)
    return Sighting(located.area, newest, se2.compose(located.mode.pose.mean, poses[newest]))


def _seen_again(parent: Parent, located: Located, poses: Mapping[int, Pose]) -> bool:
    """Whether the last look found the robot where this one has it.

    A place that looks alike is seldom taken for the right one twice, as other things are seen next.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    before = parent.notes.sighted
    if before is None or before.keyframe not in poses:
        return False
    frames = reachable(parent.hybrid_map, located.area, until=(before.area,))
    if before.area not in frames:
        return False
    now = se2.compose(located.mode.pose.mean, poses[before.keyframe])
    away = se2.between(now, se2.compose(frames[before.area].mean, before.pose))
    return bool(math.hypot(away[0], away[1]) <= _NEAR and abs(away[2]) <= _TURN)


def _told_of(parent: Parent, keyframes: dict[int, Pose]) -> Told | None:
    """Where the first of keyframes, {keyframe: ``area_T_base``}, is, as somebody said of one of them."""
    told = parent.notes.told
    if told is None or told.keyframe not in keyframes:
        return None
    first = next(iter(keyframes))
    moved = PoseGaussian.exactly(se2.between(keyframes[told.keyframe], keyframes[first]))
    return Told(first, told.area, told.pose.compose(moved))


def _seen_since(parent: Parent, keyframe: int) -> dict[int, Pose]:
    """The newest keyframes of the local map since one of them, {keyframe: ``area_T_base``}, ascending."""
    seen = dict(parent.hybrid_map.keyframes(parent.area))
    for area, pose in parent.around().items():
        seen |= {k: se2.compose(pose, at) for k, at in parent.hybrid_map.keyframes(area).items()}
    return {k: seen[k] for k in sorted(seen)[-_MOST:] if k >= keyframe}
