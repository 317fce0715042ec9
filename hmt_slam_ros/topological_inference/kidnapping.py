"""The child of a hypothesis in which the robot was displaced unnoticed: it may be anywhere, as one that woke up.

Arcs can lie: wheels slip where the scans do not tell, readings are lost, robots are carried. That is rare, but then the
scans contradict what the hypothesis has the robot see, by as many nats as a place that looks alike would explain them
better; so the odds of it are known (``HypothesisState.kidnapping_test``). The keyframes since then begin a new area, to
which an arc leads that tells nothing, and what follows is as for any robot of which nobody knows how it came there
(``relocalization``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs, uninformative_belief
from hmt_slam_ros.topological_inference.branching import Branches, Branching, Child, Parent
from hmt_slam_ros.topological_inference.hypothesis_tree import FalseAlarm, Lost, PoseInArea
from hmt_slam_ros.topological_inference.relocalization import (
    KIDNAPPED_UNMAPPED_PRIOR,
    decisive_candidate,
    log_bayes_factor,
    prefers_tracked_pose,
)

# A displacement becomes a hypothesis for parents of at least such a probability, with at least so many keyframes.
_PROBABILITY, _KEYFRAMES = 0.05, 3


def spawn_kidnapped_hypothesis(branching: Branching, parent: Parent) -> Branches | None:
    """To go on, or to have been displaced; None where that is not probable enough to be asked."""
    log_odds, since = parent.state.kidnapping_test(branching.options.kidnapping_prior)
    late = _keyframes_since(parent, since)
    if (
        log_odds < math.log(branching.options.kidnapping_odds)
        or parent.probability < _PROBABILITY
        or len(late) < _KEYFRAMES
    ):
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
    log_odds, since = parent.state.kidnapping_test(branching.options.kidnapping_prior)
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
    tracked = PoseInArea(parent.area, first, seen[first])
    return prefers_tracked_pose(parent.hybrid_map, where, tracked, poses, branching.options)


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
    sighted = decisive_candidate(where, query.poses, branching.options)
    lost = Lost(keyframes[0], candidate=sighted, tracked_pose=claim, counted_evidence=credit)
    return replace(child, state=replace(child.state, kidnapping_evidence={}, localization=lost))
