"""Lost hypotheses: how the robot becomes lost, and how it is relocalized.

A lost robot maps around itself. It begins a new area, to which an uninformative arc leads. Its keyframes are searched
in the whole map, again and again, a few regions at each event. A pose is accepted with enough probability in two
searches in a row, or in one that agrees with a pose hint. Then a child closes the loop between the two maps, and TLCA
decides on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import Arc, InitialPose
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.hypothesis_tree import Lost, PoseInArea, Tracking
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution
from hmt_slam_ros.topological_inference.pose_verification import (
    KIDNAPPED_UNMAPPED_PRIOR,
    candidates_at,
    is_decisive,
    is_same_place,
    log_bayes_factor,
    pose_in_area,
)
from hmt_slam_ros.topological_inference.relocalization_arcs import hinted_arcs, hinted_pose, refuted_arcs
from hmt_slam_ros.topological_inference.search_prior import PoseHint, SearchPrior

Pose = Float64

_REFUTING_KEYFRAMES = 5
"""Keyframes after which a pose hint can be refuted."""

_REFUTING_PROBABILITY = 0.9
"""Probability that no candidate is right, above which the pose hint is refuted."""

_MARKED_KEYFRAMES = 3
"""Keyframes after which a robot that visits a mark of the map is searched."""

_MAX_KEYFRAMES = 40
"""Most keyframes that are searched in the map, the newest."""


def begin_relocalization(branching: Branching, parent: Parent, keyframe: Keyframe, pose: Pose) -> Branches:
    """The children of a hypothesis at a keyframe with unknown motion or with an initial pose.

    :param pose: ``area_T_base`` of its scan.
    """
    if keyframe.motion_unknown:
        parent = _update_false_alarm(parent, keyframe, pose)
        return _enter_unknown_area(branching, parent, keyframe.sequence, keyframe.initial_pose)
    lost = parent.state.localization
    if keyframe.initial_pose is not None and isinstance(lost, Lost):
        return _relocalize_at_hint(branching, parent, lost, keyframe.initial_pose, pose)
    return Branches([parent.unchanged_child()])


def _update_false_alarm(parent: Parent, keyframe: Keyframe, pose: Pose) -> Parent:
    """The parent with its false alarm at the odometry pose, or without one if the robot was really moved.

    :param pose: ``area_T_base`` of the scan by the odometry.
    """
    lost = parent.state.localization
    if not isinstance(lost, Lost):
        return parent
    false_alarm = lost.false_alarm
    if false_alarm is not None and lost.since == keyframe.sequence and keyframe.initial_pose is None:
        false_alarm = replace(false_alarm, tracked_pose=PoseInArea(parent.area, keyframe.sequence, pose))
    else:
        false_alarm = None
    return _with_localization(parent, replace(lost, false_alarm=false_alarm))


def _with_localization(parent: Parent, localization: Tracking | Lost) -> Parent:
    return replace(parent, state=replace(parent.state, localization=localization))


def _enter_unknown_area(
    branching: Branching, parent: Parent, keyframe: int, initial_pose: InitialPose | None
) -> Branches:
    """The only child, in which the robot may be anywhere: in a new area, drawn at the initial pose if there is one."""
    query = branching.entry.query(parent, [keyframe])
    hint = None
    if initial_pose is not None and parent.hybrid_map.has_area(initial_pose.area):
        hint = PoseHint(keyframe, initial_pose.area, initial_pose.pose)
    drawn = None if hint is None else hinted_pose(parent, parent.area, hint)
    child = branching.entry.enter_unknown(parent, query, 0.0, drawn)
    before = child.state.localization
    before = before if isinstance(before, Lost) else Lost(keyframe)
    lost = replace(before, since=keyframe, pose_hint=hint, search=None)
    return Branches([replace(child, state=replace(child.state, localization=lost))])


def _relocalize_at_hint(
    branching: Branching, parent: Parent, lost: Lost, initial_pose: InitialPose, pose: Pose
) -> Branches:
    """The children of a lost hypothesis with an initial pose: drawn there, and searched at once.

    :param pose: ``area_T_base`` of the newest scan.
    """
    keyframes = _poses_since(parent, lost.since)
    if not parent.hybrid_map.has_area(initial_pose.area) or not keyframes:
        return Branches([parent.unchanged_child()])
    newest = max(keyframes)
    scan_T_newest = PoseGaussian.from_pose(se2.between(pose, keyframes[newest]))
    hint = PoseHint(newest, initial_pose.area, initial_pose.pose.compose(scan_T_newest))
    lost = replace(lost, pose_hint=hint, false_alarm=None, search=None, plausible_areas=frozenset(), unknown=-1)
    hinted = _with_localization(parent, lost)
    branches = update_relocalization(branching, hinted)
    arcs = hinted_arcs(parent, lost.since, hint, keyframes[newest])
    return branches._replace(children=[replace(child, arcs=child.arcs or arcs) for child in branches.children])


def is_search_due(branching: Branching, parent: Parent) -> bool:
    """Whether a lost hypothesis has enough keyframes since the last search for another one.

    Fewer suffice with a pose hint, or if they are at a mark of the map.
    """
    lost = parent.state.localization
    if not isinstance(lost, Lost) or lost.search is not None:
        return False
    newer = _poses_since(parent, max(lost.since, lost.searched + 1))
    if lost.pose_hint is not None:
        return bool(newer)
    enough = branching.options.recheck_keyframes
    return len(newer) >= enough or (len(newer) >= _MARKED_KEYFRAMES and branching.is_marked(newer, lost.since))


def is_searching(parent: Parent) -> bool:
    """Whether a search for a lost hypothesis goes on."""
    lost = parent.state.localization
    return isinstance(lost, Lost) and lost.search is not None


def update_relocalization(branching: Branching, parent: Parent) -> Branches:
    """The children of a lost hypothesis after the search of an event: still lost, or relocalized.

    Candidates whose walls the work of the event does not suffice for are checked at the next one. The search waits
    where another hypothesis took the work.

    :param parent: a lost hypothesis.
    """
    lost = parent.state.localization
    assert isinstance(lost, Lost)
    map_search, hybrid_map = branching.map_search, parent.hybrid_map
    if map_search.work.is_exhausted:
        return Branches([parent.unchanged_child()])
    poses = _poses_to_search(parent, lost) if lost.search is None else lost.search.poses
    prior = branching.find_search_prior(parent, lost, poses)
    search = lost.search or map_search.begin(hybrid_map, poses, lost.since, prior, lost.plausible_areas)
    if lost.search is None or not _is_conclusive(branching, parent, lost, search, prior):
        first = None if lost.candidate is None else lost.candidate.area
        search = map_search.continue_search(hybrid_map, search, first, prior)
    is_over = _is_conclusive(branching, parent, lost, search, prior)
    if is_over:
        search, is_over = map_search.check_candidates(hybrid_map, search, parent.clutter, prior)
    if not is_over:
        return Branches([_child_with_localization(parent, replace(lost, search=search))])
    after = replace(lost, search=None, searched=max(search.poses))
    branches = _conclude_search(branching, parent, after, search, prior)
    # Walls and the odds of a kidnapping may count against a candidate: the rest is searched first then.
    if search.unexamined and all(_is_without_candidate(child) for child in branches.children):
        search = replace(search, refuted=len(search.candidates))
        return Branches([_child_with_localization(parent, replace(lost, search=search))])
    return branches


def _poses_to_search(parent: Parent, lost: Lost) -> dict[int, Pose]:
    """{keyframe: ``reference_T_base``} of the newest but those on unmapped ground; the reference is the first."""
    keyframes = _poses_since(parent, max(lost.since, lost.unknown + 1))
    reference = next(iter(keyframes.values()))
    return {k: se2.between(reference, pose) for k, pose in keyframes.items()}


def _is_conclusive(branching: Branching, parent: Parent, lost: Lost, search: GlobalSearch, prior: SearchPrior) -> bool:
    """Whether the search is over; one that may confirm a candidate goes through all areas that are left to it."""
    if lost.candidate is not None and search.unexamined:
        return False
    return branching.map_search.is_conclusive(parent.hybrid_map, search, parent.clutter, prior)


def _is_without_candidate(child: Child) -> bool:
    localization = child.state.localization
    return isinstance(localization, Lost) and localization.candidate is None


def _conclude_search(
    branching: Branching, parent: Parent, lost: Lost, search: GlobalSearch, prior: SearchPrior
) -> Branches:
    """The children after a search: still lost, or relocalized.

    :param lost: the state after it.
    :param prior: of the search.
    """
    poses, keyframes = search.poses, _poses_since(parent, lost.since)
    common = keyframes.keys() & poses.keys()
    if not common:
        return Branches([_child_with_localization(parent, lost)])
    newest, is_kidnapped = max(common), lost.tracked_pose is not None
    distribution = _localize(branching, parent, lost, search, prior)
    # Marks have weighed against the hypotheses that are not lost already.
    unmarked = distribution
    if is_kidnapped and prior.marks.marks:
        unmarked = _localize(branching, parent, lost, search, prior.without_marks())
    parent, lost = _reweight_by_evidence(parent, lost, unmarked, poses)
    lost = _after_refutation(lost, distribution, poses)
    best = distribution.best
    if best is None or not is_decisive(*best, branching.options, is_kidnapped=is_kidnapped):
        plausible = branching.map_search.plausible_areas(parent.hybrid_map, distribution)
        children = [_child_with_localization(parent, replace(lost, candidate=None, plausible_areas=plausible))]
        return Branches(children, True, pose_distribution=distribution)
    candidate, probability = best
    with_candidate = replace(
        lost,
        candidate=pose_in_area(candidate, poses, max(poses)),
        plausible_areas=branching.map_search.plausible_areas(parent.hybrid_map, distribution),
    )
    if (prior.hint is not None and probability >= branching.options.hint_probability) or _confirms_candidate(
        parent.hybrid_map, lost, candidate, poses
    ):
        reference = se2.compose(keyframes[newest], se2.inverse(poses[newest]))
        still_lost, relocalized = _split_at_candidate(
            parent, with_candidate, reference, candidate, probability, branching.search.gating.gate
        )
        children = [still_lost, _count_kidnapping(parent.hybrid_map, relocalized, lost, candidate, poses)]
    else:
        children = [_child_with_localization(parent, with_candidate)]
    return Branches(children, True, pose_distribution=distribution)


def _localize(
    branching: Branching, parent: Parent, lost: Lost, search: GlobalSearch, prior: SearchPrior
) -> PoseDistribution:
    """The distribution of the pose of the keyframes that were searched."""
    distribution = branching.localize_globally(parent, search, prior)
    if lost.tracked_pose is not None:
        distribution = distribution.with_unmapped_prior(KIDNAPPED_UNMAPPED_PRIOR)
    return _with_false_alarm(parent.hybrid_map, lost, distribution, search.poses)


def _after_refutation(lost: Lost, distribution: PoseDistribution, poses: Mapping[int, Pose]) -> Lost:
    """The state without a pose hint that the search refuted, or without keyframes that are on unmapped ground.

    They would hide that later ones are on known ground. A false alarm needs them.
    """
    if len(poses) < _REFUTING_KEYFRAMES or float(distribution.probabilities.sum()) >= 1.0 - _REFUTING_PROBABILITY:
        return lost
    if lost.pose_hint is not None:
        return replace(lost, pose_hint=None)
    return lost if lost.false_alarm is not None else replace(lost, unknown=max(poses))


def _count_kidnapping(
    hybrid_map: HybridMap, relocalized: Child, lost: Lost, candidate: PoseCandidate, poses: Mapping[int, Pose]
) -> Child:
    """The child with one more kidnapping, if it is relocalized elsewhere than the robot was tracked.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    alarm = lost.false_alarm
    if alarm is None or alarm.tracked_pose.keyframe not in poses:
        return relocalized
    found = pose_in_area(candidate, poses, alarm.tracked_pose.keyframe)
    if is_same_place(hybrid_map, found, alarm.tracked_pose):
        return relocalized
    return replace(relocalized, state=relocalized.state.after_kidnapping(alarm.motion_condition))


def _split_at_candidate(
    parent: Parent, lost: Lost, reference: Pose, candidate: PoseCandidate, probability: float, gate: float
) -> list[Child]:
    """The two children where a pose is accepted: still lost, and relocalized there.

    :param lost: the state of the lost one.
    :param reference: ``area_T_reference`` of the keyframes that were searched, shape (3,).
    :param probability: of the candidate.
    :param gate: squared Mahalanobis distance up to which arcs admit a pose.
    """
    # From here on, evidence for the candidate counts for the relocalized child.
    still_lost = _child_with_localization(parent, replace(lost, counted_evidence=None))
    belief = PoseGaussian.from_pose(reference).compose(candidate.mode.measured.inverse())
    relocalized = replace(
        _child_with_localization(parent, Tracking(candidate.area)),
        log_weight=parent.log_weight + math.log(probability),
        arcs=(
            Arc(parent.area, candidate.area, belief, True),
            *refuted_arcs(parent, lost, candidate.area, belief, gate),
        ),
        reload_local_map=True,
    )
    log_weight = parent.log_weight + math.log(max(1.0 - probability, 1e-300))
    return [replace(still_lost, log_weight=log_weight), relocalized]


def _child_with_localization(parent: Parent, localization: Tracking | Lost) -> Child:
    return _with_localization(parent, localization).unchanged_child()


def _with_false_alarm(
    hybrid_map: HybridMap, lost: Lost, distribution: PoseDistribution, poses: Mapping[int, Pose]
) -> PoseDistribution:
    """The distribution that includes a false alarm, if the hypothesis has one.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    alarm = lost.false_alarm
    if alarm is None or alarm.tracked_pose.keyframe not in poses:
        return distribution
    at_tracked_pose = candidates_at(hybrid_map, distribution, alarm.tracked_pose, poses)
    return distribution.with_false_alarm(at_tracked_pose, alarm.probability, len(hybrid_map.area_ids()))


def accept_relocalization(branches: Branches) -> Branches:
    """The relocalized children only, if there are any.

    Without mapping, a lost child would keep explaining its own scans better than a map that the world has changed from.
    If the relocalization was wrong, the map contradicts it soon.
    """
    relocalized = [child for child in branches.children if not child.state.is_lost]
    return branches._replace(children=relocalized or branches.children)


def _reweight_by_evidence(
    parent: Parent, lost: Lost, distribution: PoseDistribution, poses: Mapping[int, Pose]
) -> tuple[Parent, Lost]:
    """A kidnapped hypothesis with the evidence since the kidnapping that its weight lacks.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    tracked_pose = lost.tracked_pose
    if tracked_pose is None or lost.counted_evidence is None or tracked_pose.keyframe not in poses:
        return parent, lost
    evidence = log_bayes_factor(parent.hybrid_map, distribution, tracked_pose, poses)
    reweighted = replace(parent, log_weight=parent.log_weight + evidence - lost.counted_evidence)
    return reweighted, replace(lost, counted_evidence=evidence)


def _confirms_candidate(hybrid_map: HybridMap, lost: Lost, candidate: PoseCandidate, poses: Mapping[int, Pose]) -> bool:
    """Whether the last search found the same pose.

    A similar place is seldom mistaken twice, as the robot sees other things by then.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    before = lost.candidate
    if before is None or before.keyframe not in poses:
        return False
    return is_same_place(hybrid_map, pose_in_area(candidate, poses, before.keyframe), before)


def _poses_since(parent: Parent, keyframe: int) -> dict[int, Pose]:
    """The newest keyframes of the submap since one of them, {keyframe: ``area_T_base``}, ascending."""
    poses = dict(parent.hybrid_map.keyframes(parent.area))
    for area, pose in parent.local_area_poses().items():
        poses |= {k: se2.compose(pose, in_area) for k, in_area in parent.hybrid_map.keyframes(area).items()}
    return {k: poses[k] for k in sorted(poses)[-_MAX_KEYFRAMES:] if k >= keyframe}
