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
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import reachable, tells_nothing, unknown
from hmt_slam_ros.messages.map_changes import Arc, Place
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.topological_inference.branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topological_inference.global_localization import Told, Whereabouts
from hmt_slam_ros.topological_inference.global_scan_matching import Located, is_certain
from hmt_slam_ros.topological_inference.hypothesis_tree import Spot

Pose = NDArray[np.float64]

UNKNOWN = 0.5
"""Probability that a robot that was carried while it maps is where the map does not reach."""

# Probability that a place needs to have at two looks in a row, and at one look where somebody says so.
_TWICE, _ONCE = 0.8, 0.9
# Share of what a robot sees that was carried while it maps, which has to be known where it is found: half a building
# may be like the other half, which nobody has seen.
_KNOWN = 0.7
# Two looks found the same place where they have a keyframe within so much of each other, m and rad.
_NEAR, _TURN = 1.0, math.radians(15.0)
# So many keyframes that fit nowhere near where somebody says, in this probability, refute it.
_REFUTED, _NOWHERE = 5, 0.9
# Probability that is taken for none.
_LEAST = 1e-12
# Keyframes that are laid into the map at most, the newest.
_MOST = 40


def arrived(branching: Branching, parent: Parent, keyframe: Keyframe, pose: Pose) -> Branches:
    """The continuations of a hypothesis at a keyframe of which nothing or somebody tells where it is.

    :param pose: ``area_T_base`` of its scan.
    """
    if keyframe.carried:
        return _awoken(branching, _stayed_until(parent, keyframe, pose), keyframe.sequence, keyframe.place)
    if keyframe.place is not None and parent.notes.lost is not None:
        return _told_where(branching, parent, keyframe.place, pose)
    return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, parent.notes)])


def _stayed_until(parent: Parent, keyframe: Keyframe, pose: Pose) -> Parent:
    """The hypothesis, which knows where a robot is that takes itself for lost and is not; of one carried, nobody does.

    :param pose: ``area_T_base`` of the scan, as its odometry has it.
    """
    stay, notes = parent.notes.stay, parent.notes
    if stay is not None and notes.lost == keyframe.sequence and keyframe.place is None:
        stay = replace(stay, spot=Spot(parent.area, keyframe.sequence, pose))
    else:
        stay = None
    return replace(parent, notes=replace(notes, stay=stay))


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
    looked = looked_for(branching, replace(parent, notes=replace(parent.notes, told=told, stay=None)))
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
    where = branching.everywhere(parent, poses, parent.notes.lost, told)
    if parent.notes.claim is not None:
        where = where.with_unmapped(UNKNOWN)
    where = _or_stayed(parent, where, poses)
    noted = _credited(replace(parent, notes=parent.notes.checked((), tuple(poses))), where, poses)
    if len(keyframes) >= _REFUTED and float(where.probabilities.sum()) < 1.0 - _NOWHERE:
        noted = replace(noted, notes=replace(noted.notes, told=None))
    best = where.best
    if best is None or not _is_told(*best, mapping=parent.notes.claim is not None):
        unsighted = replace(noted.notes, sighted=None)
        return Branches([Child(parent.hypothesis, noted.log_weight, parent.area, unsighted)], True, where=where)
    located, probability = best
    sighted = replace(noted.notes, sighted=_spot(located, poses, max(poses)))
    still = Child(parent.hypothesis, noted.log_weight, parent.area, sighted)
    if not (told is not None and probability >= _ONCE) and not _seen_again(parent, located, poses):
        return Branches([still], True, where=where)
    arc = Arc(parent.area, located.area, PoseGaussian.exactly(reference).compose(located.mode.measured.inverse()), True)
    log_weight = noted.log_weight + math.log(probability)
    notes = replace(
        noted.notes, lost=None, stay=None, told=None, sighted=None, found=located.area, claim=None, credit=0.0
    )
    found = Child(parent.hypothesis, log_weight, parent.area, notes, arcs=(arc,), reload=True)
    # What speaks for the place from here on is the other's.
    still_lost = replace(sighted, credit=None)
    left = noted.log_weight + math.log(max(1.0 - probability, 1e-300))
    still = replace(still, log_weight=left, notes=still_lost)
    return Branches([still, found], True, where=where)


def _or_stayed(parent: Parent, where: Whereabouts, poses: Mapping[int, Pose]) -> Whereabouts:
    """Where a robot is that may have been right about its place before it took itself for lost.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    stay = parent.notes.stay
    if stay is None or stay.spot.keyframe not in poses:
        return where
    there = _at(parent.hybrid_map, where, stay.spot, poses)
    return where.or_stayed(there, stay.probability, len(parent.hybrid_map.area_ids()))


def surely_found(looked: Branches) -> Branches:
    """A look after which a robot that was recognized is lost no more.

    Where nothing is mapped, what the robot saw since would go on to explain itself better than a map of before that the
    world does not keep to; if it was taken for another place, the map contradicts it soon.
    """
    found = [child for child in looked.children if child.notes.lost is None]
    return looked._replace(children=found or looked.children)


def _credited(parent: Parent, where: Whereabouts, poses: Mapping[int, Pose]) -> Parent:
    """A hypothesis of a displaced robot, weighed by what it saw since, as far as that is not in its weight yet.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    claim = parent.notes.claim
    if claim is None or parent.notes.credit is None or claim.keyframe not in poses:
        return parent
    credit = credit_of(parent.hybrid_map, where, claim, poses)
    notes = replace(parent.notes, credit=credit)
    return replace(parent, log_weight=parent.log_weight + credit - parent.notes.credit, notes=notes)


def credit_of(hybrid_map: HybridMap, where: Whereabouts, claim: Spot, poses: Mapping[int, Pose]) -> float:
    """log p(what a robot saw | it was displaced) / p(that | it was not), by where that lies in the map before, nats.

    New ground is the measure of both.

    :param claim: where it is if it was not displaced: there it is not, if it was.
    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    there, shares = _at(hybrid_map, where, claim, poses), where.probabilities
    unmapped = max(1.0 - float(shares.sum()), _LEAST)
    elsewhere = unmapped + float(shares[~there].sum())
    areas = len(hybrid_map.area_ids())
    stayed = float(shares[there].sum()) / unmapped * UNKNOWN / (1.0 - UNKNOWN) * areas
    return math.log(elsewhere / unmapped * UNKNOWN) - math.log(max(1.0, stayed))


def is_rather(hybrid_map: HybridMap, where: Whereabouts, claim: Spot, poses: Mapping[int, Pose]) -> bool:
    """Whether a robot is rather where a claim has it than in any other place of the map, and most of it is known there.

    What contradicts there speaks for ground that the map does not hold, too; it is not asked again whether that is so.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    there, shares = _at(hybrid_map, where, claim, poses), where.probabilities
    known = max((located.found.share for located, one in zip(where.found, there, strict=True) if one), default=0.0)
    return known >= _KNOWN and bool(shares[there].sum() > shares[~there].sum())


def _at(hybrid_map: HybridMap, where: Whereabouts, claim: Spot, poses: Mapping[int, Pose]) -> NDArray[np.bool_]:
    """Which of the places where a robot may be are that of a claim, shape (len(where.found),)."""
    found = [_agree(hybrid_map, _spot(located, poses, claim.keyframe), claim) for located in where.found]
    return np.array(found, dtype=np.bool_)


def sighted_in(where: Whereabouts, poses: Mapping[int, Pose]) -> Spot | None:
    """Where a look found a robot that was carried while it maps, if it did.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    best = where.best
    if best is None or not _is_told(*best, mapping=True):
        return None
    return _spot(best[0], poses, max(poses))


def _is_told(located: Located, probability: float, *, mapping: bool) -> bool:
    """Whether a look tells where the robot is.

    :param mapping: whether it was carried while it maps.
    """
    known = _KNOWN if mapping else 0.0
    return probability >= _TWICE and located.found.share >= known and is_certain(located)


def _spot(located: Located, poses: Mapping[int, Pose], keyframe: int) -> Spot:
    return Spot(located.area, keyframe, se2.compose(located.mode.pose.mean, poses[keyframe]))


def _seen_again(parent: Parent, located: Located, poses: Mapping[int, Pose]) -> bool:
    """Whether the last look found the robot where this one has it.

    A place that looks alike is seldom taken for the right one twice, as other things are seen next.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    before = parent.notes.sighted
    if before is None or before.keyframe not in poses:
        return False
    return _agree(parent.hybrid_map, _spot(located, poses, before.keyframe), before)


def _agree(hybrid_map: HybridMap, one: Spot, other: Spot) -> bool:
    """Whether two sightings of a keyframe are of the same place."""
    frames = reachable(hybrid_map, one.area, until=(other.area,))
    if other.area not in frames:
        return False
    away = se2.between(one.pose, se2.compose(frames[other.area].mean, other.pose))
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
