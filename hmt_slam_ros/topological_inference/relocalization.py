"""A robot that woke up somewhere: it maps around itself, and is joined to the map where it is recognized.

It is not known how it came there, so that it begins a new area, to which an arc leads that tells nothing. From then on
all that it saw is looked for in the whole map, again and again, until one place has nearly all of the probability at
two looks in a row, or at one where somebody says that it is there; then a further continuation of the path closes the
loop between the two maps, and TLCA decides as it does about any other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, shortest_path_beliefs, uninformative_belief
from hmt_slam_ros.messages.map_changes import Arc, InitialPose
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.topological_inference.branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topological_inference.global_localization import PoseDistribution, PoseHint
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate, is_certain
from hmt_slam_ros.topological_inference.hypothesis_tree import FalseAlarm, Lost, PoseInArea, Tracking

Pose = NDArray[np.float64]

KIDNAPPED_UNMAPPED_PRIOR = 0.5
"""Probability that a robot that was carried while it maps is where the map does not reach."""

# Probability that a place needs to have at two looks in a row, and at one look where somebody says so.
_ACCEPTANCE, _ACCEPTANCE_WITH_HINT = 0.8, 0.9
# Share of what a robot sees that was carried while it maps, which has to be known where it is found: half a building
# may be like the other half, which nobody has seen.
_MIN_KNOWN_SHARE = 0.7
# Two looks found the same place where they have a keyframe within so much of each other, m and rad.
_SAME_DISTANCE, _SAME_ANGLE = 1.0, math.radians(15.0)
# So many keyframes that fit nowhere near where somebody says, in this probability, refute it.
_REFUTING_KEYFRAMES, _REFUTING_PROBABILITY = 5, 0.9
# Probability that is taken for none.
_PROBABILITY_FLOOR = 1e-12
# Keyframes that are laid into the map at most, the newest.
_MAX_KEYFRAMES = 40


def begin_relocalization(branching: Branching, parent: Parent, keyframe: Keyframe, pose: Pose) -> Branches:
    """The continuations of a hypothesis at a keyframe of which nothing or somebody tells where it is.

    :param pose: ``area_T_base`` of its scan.
    """
    if keyframe.motion_unknown:
        return _enter_unknown_area(
            branching, _update_false_alarm(parent, keyframe, pose), keyframe.sequence, keyframe.initial_pose
        )
    lost = parent.state.localization
    if keyframe.initial_pose is not None and isinstance(lost, Lost):
        return _relocalize_at_hint(branching, parent, lost, keyframe.initial_pose, pose)
    return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, parent.state)])


def _update_false_alarm(parent: Parent, keyframe: Keyframe, pose: Pose) -> Parent:
    """The hypothesis, which knows where a robot is that takes itself for lost and is not; of one carried, nobody does.

    :param pose: ``area_T_base`` of the scan, as its odometry has it.
    """
    lost = parent.state.localization
    if not isinstance(lost, Lost):
        return parent
    stay = lost.false_alarm
    if stay is not None and lost.since == keyframe.sequence and keyframe.initial_pose is None:
        stay = replace(stay, tracked_pose=PoseInArea(parent.area, keyframe.sequence, pose))
    else:
        stay = None
    return _with_localization(parent, replace(lost, false_alarm=stay))


def _with_localization(parent: Parent, localization: Tracking | Lost) -> Parent:
    return replace(parent, state=replace(parent.state, localization=localization))


def _enter_unknown_area(branching: Branching, parent: Parent, keyframe: int, place: InitialPose | None) -> Branches:
    """The one continuation of a hypothesis where the robot may be anywhere: in a new area.

    :param place: where it is as somebody says: there the area is drawn, and there it is looked for first.
    """
    query = branching.query(parent, [keyframe])
    told = None
    if place is not None and parent.hybrid_map.has_area(place.area):
        told = PoseHint(keyframe, place.area, place.pose)
    arc = uninformative_belief(query.belief.mean if told is None else _hinted_pose(parent, parent.area, told))
    origin = PoseGaussian.from_pose(np.zeros(3))
    child = branching.enter_area(parent, query, branching.new_area(parent, query), origin, arc, 0.0)
    before = child.state.localization
    lost = replace(before if isinstance(before, Lost) else Lost(keyframe), since=keyframe, pose_hint=told)
    return Branches([replace(child, state=replace(child.state, localization=lost))])


def _relocalize_at_hint(branching: Branching, parent: Parent, lost: Lost, place: InitialPose, pose: Pose) -> Branches:
    """A robot that may be anywhere, of which somebody says where it is: it is drawn there, and looked for at once.

    :param pose: ``area_T_base`` of the newest scan.
    """
    seen = _poses_since(parent, lost.since)
    if not parent.hybrid_map.has_area(place.area) or not seen:
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, parent.state)])
    newest = max(seen)
    told = PoseHint(newest, place.area, place.pose.compose(PoseGaussian.from_pose(se2.between(pose, seen[newest]))))
    hinted = _with_localization(parent, replace(lost, pose_hint=told, false_alarm=None))
    looked = update_relocalization(branching, hinted)
    arcs = _hinted_arcs(parent, lost.since, told, seen[newest])
    return looked._replace(children=[replace(child, arcs=child.arcs or arcs) for child in looked.children])


def _hinted_pose(parent: Parent, area: int, pose_hint: PoseHint) -> Pose:
    """``area_T_base`` of what somebody said, shape (3,), in the frame of another area."""
    between = shortest_path_beliefs(parent.hybrid_map, area, targets=(pose_hint.area,)).get(pose_hint.area)
    return pose_hint.pose.mean if between is None else se2.compose(between.mean, pose_hint.pose.mean)


def _hinted_arcs(parent: Parent, lost: int, pose_hint: PoseHint, pose: Pose) -> tuple[Arc, ...]:
    """The arc that tells nothing, such that all since the robot arrived is drawn where somebody says.

    :param pose: ``area_T_base`` of the keyframe of which it is said, in the robot's area.
    """
    for known, new, arc in parent.hybrid_map.all_arcs():
        if is_uninformative(arc.pose) and min(parent.hybrid_map.keyframes(new), default=-1) >= lost:
            own = shortest_path_beliefs(parent.hybrid_map, parent.area, targets=(new,))[new].mean
            mean = se2.compose(_hinted_pose(parent, known, pose_hint), se2.between(pose, own))
            return (Arc(known, new, uninformative_belief(mean)),)
    return ()


def update_relocalization(branching: Branching, parent: Parent) -> Branches:
    """To be lost still, or where the robot was recognized.

    :param parent: a hypothesis in which the robot is lost.
    """
    lost = parent.state.localization
    assert isinstance(lost, Lost)
    keyframes = _poses_since(parent, lost.since)
    reference = next(iter(keyframes.values()))
    poses = {k: se2.between(reference, pose) for k, pose in keyframes.items()}
    told = _hint_of_first(lost, keyframes)
    where = branching.localize_globally(parent, poses, lost.since, told)
    if lost.tracked_pose is not None:
        where = where.with_unmapped_prior(KIDNAPPED_UNMAPPED_PRIOR)
    where = _with_false_alarm(parent.hybrid_map, lost, where, poses)
    matched = replace(parent, state=parent.state.after_matching((), tuple(poses)))
    noted, lost = _reweight_by_evidence(matched, lost, where, poses)
    if len(keyframes) >= _REFUTING_KEYFRAMES and float(where.probabilities.sum()) < 1.0 - _REFUTING_PROBABILITY:
        lost = replace(lost, pose_hint=None)
    best = where.best
    if best is None or not _is_decisive(*best, mapping=lost.tracked_pose is not None):
        return Branches([_unmoved_child(noted, replace(lost, candidate=None))], True, pose_distribution=where)
    located, probability = best
    sighted = replace(lost, candidate=_pose_in_area(located, poses, max(poses)))
    by_hint = told is not None and probability >= _ACCEPTANCE_WITH_HINT
    if not by_hint and not _confirms_candidate(parent.hybrid_map, lost, located, poses):
        return Branches([_unmoved_child(noted, sighted)], True, pose_distribution=where)
    return Branches(_split_at_candidate(noted, sighted, reference, *best), True, pose_distribution=where)


def _split_at_candidate(
    parent: Parent, lost: Lost, reference: Pose, candidate: PoseCandidate, probability: float
) -> list[Child]:
    """The two continuations of a hypothesis where a place was found: lost still, and recognized there.

    :param lost: what is remembered while the robot is lost.
    :param reference: ``area_T_reference`` of the keyframes that were located, shape (3,).
    :param probability: of the place.
    """
    # What speaks for the place from here on is the other's.
    still = _unmoved_child(parent, replace(lost, counted_evidence=None))
    left = parent.log_weight + math.log(max(1.0 - probability, 1e-300))
    belief = PoseGaussian.from_pose(reference).compose(candidate.mode.measured.inverse())
    found = replace(
        _unmoved_child(parent, Tracking(candidate.area)),
        log_weight=parent.log_weight + math.log(probability),
        arcs=(Arc(parent.area, candidate.area, belief, True),),
        reload_local_map=True,
    )
    return [replace(still, log_weight=left), found]


def _unmoved_child(parent: Parent, localization: Tracking | Lost) -> Child:
    """The hypothesis with the robot in its area, of whose place this is known now."""
    state = replace(parent.state, localization=localization)
    return Child(parent.hypothesis, parent.log_weight, parent.area, state)


def _with_false_alarm(
    hybrid_map: HybridMap, lost: Lost, distribution: PoseDistribution, poses: Mapping[int, Pose]
) -> PoseDistribution:
    """Where a robot is that may have been right about its place before it took itself for lost.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    stay = lost.false_alarm
    if stay is None or stay.tracked_pose.keyframe not in poses:
        return distribution
    there = _candidates_at(hybrid_map, distribution, stay.tracked_pose, poses)
    return distribution.with_false_alarm(there, stay.probability, len(hybrid_map.area_ids()))


def accept_relocalization(branches: Branches) -> Branches:
    """A look after which a robot that was recognized is lost no more.

    Where nothing is mapped, what the robot saw since would go on to explain itself better than a map of before that the
    world does not keep to; if it was taken for another place, the map contradicts it soon.
    """
    found = [child for child in branches.children if not child.state.is_lost]
    return branches._replace(children=found or branches.children)


def _reweight_by_evidence(
    parent: Parent, lost: Lost, distribution: PoseDistribution, poses: Mapping[int, Pose]
) -> tuple[Parent, Lost]:
    """A hypothesis of a displaced robot, weighed by what it saw since, as far as that is not in its weight yet.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    claim = lost.tracked_pose
    if claim is None or lost.counted_evidence is None or claim.keyframe not in poses:
        return parent, lost
    credit = log_bayes_factor(parent.hybrid_map, distribution, claim, poses)
    weighed = replace(parent, log_weight=parent.log_weight + credit - lost.counted_evidence)
    return weighed, replace(lost, counted_evidence=credit)


def log_bayes_factor(
    hybrid_map: HybridMap, distribution: PoseDistribution, tracked_pose: PoseInArea, poses: Mapping[int, Pose]
) -> float:
    """log p(what a robot saw | it was displaced) / p(that | it was not), by where that lies in the map before, nats.

    New ground is the measure of both.

    :param tracked_pose: where it is if it was not displaced: there it is not, if it was.
    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    there, shares = _candidates_at(hybrid_map, distribution, tracked_pose, poses), distribution.probabilities
    unmapped = max(1.0 - float(shares.sum()), _PROBABILITY_FLOOR)
    elsewhere = unmapped + float(shares[~there].sum())
    areas = len(hybrid_map.area_ids())
    stayed = float(shares[there].sum()) / unmapped * KIDNAPPED_UNMAPPED_PRIOR / (1.0 - KIDNAPPED_UNMAPPED_PRIOR) * areas
    return math.log(elsewhere / unmapped * KIDNAPPED_UNMAPPED_PRIOR) - math.log(max(1.0, stayed))


def prefers_tracked_pose(
    hybrid_map: HybridMap, distribution: PoseDistribution, tracked_pose: PoseInArea, poses: Mapping[int, Pose]
) -> bool:
    """Whether a robot is rather where a claim has it than in any other place of the map, and most of it is known there.

    What contradicts there speaks for ground that the map does not hold, too; it is not asked again whether that is so.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    there, shares = _candidates_at(hybrid_map, distribution, tracked_pose, poses), distribution.probabilities
    known = max(
        (located.agreement.matched_share for located, one in zip(distribution.candidates, there, strict=True) if one),
        default=0.0,
    )
    return known >= _MIN_KNOWN_SHARE and bool(shares[there].sum() > shares[~there].sum())


def _candidates_at(
    hybrid_map: HybridMap, distribution: PoseDistribution, pose: PoseInArea, poses: Mapping[int, Pose]
) -> NDArray[np.bool_]:
    """Which of the places where a robot may be are that of a claim, shape (len(where.found),)."""
    found = [
        _is_same_place(hybrid_map, _pose_in_area(located, poses, pose.keyframe), pose)
        for located in distribution.candidates
    ]
    return np.array(found, dtype=np.bool_)


def decisive_candidate(distribution: PoseDistribution, poses: Mapping[int, Pose]) -> PoseInArea | None:
    """Where a look found a robot that was carried while it maps, if it did.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    best = distribution.best
    if best is None or not _is_decisive(*best, mapping=True):
        return None
    return _pose_in_area(best[0], poses, max(poses))


def _is_decisive(candidate: PoseCandidate, probability: float, *, mapping: bool) -> bool:
    """Whether a look tells where the robot is.

    :param mapping: whether it was carried while it maps.
    """
    known = _MIN_KNOWN_SHARE if mapping else 0.0
    return probability >= _ACCEPTANCE and candidate.agreement.matched_share >= known and is_certain(candidate)


def _pose_in_area(candidate: PoseCandidate, poses: Mapping[int, Pose], keyframe: int) -> PoseInArea:
    return PoseInArea(candidate.area, keyframe, se2.compose(candidate.mode.pose.mean, poses[keyframe]))


def _confirms_candidate(hybrid_map: HybridMap, lost: Lost, candidate: PoseCandidate, poses: Mapping[int, Pose]) -> bool:
    """Whether the last look found the robot where this one has it.

    A place that looks alike is seldom taken for the right one twice, as other things are seen next.

    :param poses: {keyframe: ``reference_T_base``} of those that were located.
    """
    before = lost.candidate
    if before is None or before.keyframe not in poses:
        return False
    return _is_same_place(hybrid_map, _pose_in_area(candidate, poses, before.keyframe), before)


def _is_same_place(hybrid_map: HybridMap, one: PoseInArea, other: PoseInArea) -> bool:
    """Whether two sightings of a keyframe are of the same place."""
    frames = shortest_path_beliefs(hybrid_map, one.area, targets=(other.area,))
    if other.area not in frames:
        return False
    away = se2.between(one.pose, se2.compose(frames[other.area].mean, other.pose))
    return bool(math.hypot(away[0], away[1]) <= _SAME_DISTANCE and abs(away[2]) <= _SAME_ANGLE)


def _hint_of_first(lost: Lost, keyframes: dict[int, Pose]) -> PoseHint | None:
    """Where the first of keyframes, {keyframe: ``area_T_base``}, is, as somebody said of one of them."""
    told = lost.pose_hint
    if told is None or told.keyframe not in keyframes:
        return None
    first = next(iter(keyframes))
    moved = PoseGaussian.from_pose(se2.between(keyframes[told.keyframe], keyframes[first]))
    return PoseHint(first, told.area, told.pose.compose(moved))


def _poses_since(parent: Parent, keyframe: int) -> dict[int, Pose]:
    """The newest keyframes of the local map since one of them, {keyframe: ``area_T_base``}, ascending."""
    seen = dict(parent.hybrid_map.keyframes(parent.area))
    for area, pose in parent.local_area_poses().items():
        seen |= {k: se2.compose(pose, at) for k, at in parent.hybrid_map.keyframes(area).items()}
    return {k: seen[k] for k in sorted(seen)[-_MAX_KEYFRAMES:] if k >= keyframe}


# Log-odds of a displacement from which on it is a hypothesis, of hypotheses of at least such a probability, with at
# least so many keyframes.
_LOG_ODDS, _PROBABILITY, _KEYFRAMES = math.log(3e-5), 0.05, 3


def spawn_kidnapped_hypothesis(branching: Branching, parent: Parent) -> Branches | None:
    """To go on, or to have been displaced; None where that is not probable enough to be asked."""
    log_odds, since = parent.state.kidnapping_test
    late = _keyframes_since(parent, since)
    if log_odds < _LOG_ODDS or parent.probability < _PROBABILITY or len(late) < _KEYFRAMES:
        return None
    child = _kidnapped_child(branching, parent, late, log_odds)
    noted = replace(parent.state, kidnapping_evidence={})
    return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, noted), child], True)


def decide_without_mapping(branching: Branching, parent: Parent, event: int) -> Child:
    """To go on, or, where that is less probable, to be lost: no keyframe is stored that could tell which.

    Furniture that was moved contradicts as a wrong place does; but then what is seen beside it is where the robot has
    it, and in no other place of the map.

    :param event: the newest; metric SLAM arrives at the next one then.
    """
    log_odds, since = parent.state.kidnapping_test
    notes = parent.state
    if log_odds > 0.0:
        if _confirms_tracked_pose(branching, parent, since):
            notes = replace(notes, kidnapping_evidence={}, unstored_poses={})
        else:
            stay = FalseAlarm(notes.unstored_poses[event], 1.0 / (1.0 + math.exp(log_odds)))
            lost = Lost(event + 1, false_alarm=stay)
            notes = replace(notes, kidnapping_evidence={}, unstored_poses={}, localization=lost)
    return Child(parent.hypothesis, parent.log_weight, parent.area, notes)


def _confirms_tracked_pose(branching: Branching, parent: Parent, since: int) -> bool:
    """Whether the scans since an event, which the map does not hold, lie in it where the robot has them."""
    spots = [spot for event, spot in sorted(parent.state.unstored_poses.items()) if event >= since]
    frames = shortest_path_beliefs(parent.hybrid_map, parent.area, targets={spot.area for spot in spots})
    seen = {spot.keyframe: se2.compose(frames[spot.area].mean, spot.pose) for spot in spots if spot.area in frames}
    if not seen:
        return False
    first = min(seen)
    poses = {keyframe: se2.between(seen[first], pose) for keyframe, pose in seen.items()}
    where = branching.localize_globally(parent, poses, first)
    return prefers_tracked_pose(parent.hybrid_map, where, PoseInArea(parent.area, first, seen[first]), poses)


def _keyframes_since(parent: Parent, event: int) -> list[int]:
    """The keyframes of the robot's area since an event; an area is not left without any."""
    return sorted(k for k in parent.hybrid_map.keyframes(parent.area) if k >= event)[
        0 if min(parent.hybrid_map.keyframes(parent.area), default=0) < event else 1 :
    ]


def _kidnapped_child(branching: Branching, parent: Parent, keyframes: Sequence[int], log_odds: float) -> Child:
    """The robot was displaced before the first of some keyframes of its area, which are a new one."""
    query = branching.query(parent, keyframes)
    where = branching.localize_globally(parent, query.poses, keyframes[0])
    where = where.with_unmapped_prior(KIDNAPPED_UNMAPPED_PRIOR)
    claim = PoseInArea(parent.area, keyframes[0], query.belief.mean)
    credit = log_bayes_factor(parent.hybrid_map, where, claim, query.poses)
    origin = PoseGaussian.from_pose(np.zeros(3))
    area = branching.new_area(parent, query)
    child = branching.enter_area(
        parent, query, area, origin, uninformative_belief(query.belief.mean), log_odds + credit
    )
    sighted = decisive_candidate(where, query.poses)
    lost = Lost(keyframes[0], candidate=sighted, tracked_pose=claim, counted_evidence=credit)
    return replace(child, state=replace(child.state, kidnapping_evidence={}, localization=lost))
