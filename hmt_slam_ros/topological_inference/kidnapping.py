"""Kidnapped hypotheses: odometry can fail (slip, lost readings, a kidnapped robot), and scans contradict the submap.

A CUSUM test gives the log-odds (``HypothesisState.kidnapping_test``). If they suffice, a kidnapped child is spawned,
whose keyframes since the kidnapping begin a new area. It is lost from then on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.hypothesis_tree import FalseAlarm, Lost, PoseInArea
from hmt_slam_ros.topological_inference.pose_verification import (
    KIDNAPPED_UNMAPPED_PRIOR,
    decisive_candidate,
    log_bayes_factor,
    prefers_tracked_pose,
)
from hmt_slam_ros.topological_inference.surroundings_change import Surroundings

_MIN_KIDNAPPED_PROBABILITY = 0.05
"""Smallest probability of a hypothesis that spawns a kidnapped child."""

_MIN_KIDNAPPED_KEYFRAMES = 3
"""Fewest keyframes since the kidnapping of a kidnapped child (docs/decisions/0026-kidnapping-detection.md)."""


def spawn_kidnapped_hypothesis(branching: Branching, parent: Parent) -> Branches | None:
    """The children "not kidnapped" and "kidnapped", or None where a kidnapping is too improbable."""
    test = parent.state.kidnapping_test(branching.kidnapping_priors)
    if test is None:
        return None
    keyframes = _keyframes_since(parent, test.since)
    if (
        test.log_odds < math.log(branching.options.kidnapping_odds)
        or parent.probability < _MIN_KIDNAPPED_PROBABILITY
        or len(keyframes) < _MIN_KIDNAPPED_KEYFRAMES
    ):
        return None
    kidnapped = _kidnapped_child(branching, parent, keyframes, test.log_odds)
    counted = kidnapped.state.after_kidnapping(test.condition)
    stays = parent.unchanged_child(parent.state.without_kidnapping_evidence())
    return Branches([stays, replace(kidnapped, state=counted)], True)


def decide_without_mapping(branching: Branching, parent: Parent, event: int) -> Child:
    """The only child without mapping: lost if a kidnapping is more probable than not, else unchanged.

    No keyframe is stored that could tell which later. Moved furniture contradicts the map as a wrong pose does. But
    then the other surfaces match at the tracked pose, and in no other place of the map.

    :param event: the newest; metric SLAM resets its filters at the next one.
    """
    test, state = parent.state.kidnapping_test(branching.kidnapping_priors), parent.state
    if test is not None and test.log_odds > 0.0:
        if not _confirms_tracked_pose(branching, parent, test.since):
            probability = 1.0 / (1.0 + math.exp(test.log_odds))
            alarm = FalseAlarm(state.unstored_poses[event], probability, test.condition)
            state = replace(state, localization=Lost(event + 1, false_alarm=alarm))
        state = replace(state.without_kidnapping_evidence(), unstored_poses={})
    return parent.unchanged_child(state)


def _confirms_tracked_pose(branching: Branching, parent: Parent, since: int) -> bool:
    """Whether the scans since an event, which the map does not hold, match it at the tracked pose."""
    unstored = [pose for event, pose in sorted(parent.state.unstored_poses.items()) if event >= since]
    frames = shortest_path_beliefs(parent.hybrid_map, parent.area, targets={pose.area for pose in unstored})
    tracked = {p.keyframe: se2.compose(frames[p.area].mean, p.pose) for p in unstored if p.area in frames}
    if not tracked:
        return False
    first = min(tracked)
    poses = {keyframe: se2.between(tracked[first], pose) for keyframe, pose in tracked.items()}
    search = branching.map_search.begin(parent.hybrid_map, poses, first)
    search = branching.map_search.search_now(parent.hybrid_map, search, parent.area, parent.clutter)
    distribution = branching.localize_globally(parent, search)
    tracked_pose = PoseInArea(parent.area, first, tracked[first])
    return prefers_tracked_pose(parent.hybrid_map, distribution, tracked_pose, poses, branching.options)


def _keyframes_since(parent: Parent, event: int) -> list[int]:
    """The keyframes of the robot's area since an event, without the first if the area would be left empty."""
    keyframes = sorted(parent.hybrid_map.keyframes(parent.area))
    newer = [k for k in keyframes if k >= event]
    return newer if min(keyframes, default=0) < event else newer[1:]


def _kidnapped_child(branching: Branching, parent: Parent, keyframes: Sequence[int], log_odds: float) -> Child:
    """The child that was kidnapped before the first of some keyframes of its area, which begin a new area."""
    query = branching.entry.query(parent, keyframes)
    search = branching.map_search.begin(parent.hybrid_map, query.poses, keyframes[0])
    search = branching.map_search.search_now(parent.hybrid_map, search, parent.area, parent.clutter)
    distribution = branching.localize_globally(parent, search).with_unmapped_prior(KIDNAPPED_UNMAPPED_PRIOR)
    tracked_pose = PoseInArea(parent.area, keyframes[0], query.belief.mean)
    evidence = log_bayes_factor(parent.hybrid_map, distribution, tracked_pose, query.poses)
    child = branching.entry.enter_unknown(parent, query, log_odds + evidence)
    lost = Lost(keyframes[0], tracked_pose=tracked_pose, counted_evidence=evidence)
    if branching.map_search.is_conclusive(parent.hybrid_map, search, parent.clutter):
        candidate = decisive_candidate(distribution, query.poses, branching.options)
        plausible = branching.map_search.plausible_areas(parent.hybrid_map, distribution)
        lost = replace(lost, candidate=candidate, plausible_areas=plausible, searched=max(query.poses))
    else:
        lost = replace(lost, search=search)
    state = replace(child.state.without_kidnapping_evidence(), surroundings=Surroundings(), localization=lost)
    return replace(child, state=state)
