"""Pose verification: what a distribution over pose candidates says of where a lost robot is.

The Bayes factor of a kidnapping (docs/decisions/0026-kidnapping-detection.md), whether a search determines the pose
(docs/decisions/0025-global-localization.md), and whether the tracked pose is right and the world has changed instead
(docs/decisions/0027-lost-or-changed-world.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.topology import InferenceParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate, is_certain
from hmt_slam_ros.topological_inference.hypothesis_tree import PoseInArea
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution

Pose = Float64

KIDNAPPED_UNMAPPED_PRIOR = 0.5
"""Prior probability that a robot kidnapped during mapping is on unmapped ground.

From docs/decisions/0026-kidnapping-detection.md.
"""

_SAME_DISTANCE = 1.0
"""Largest distance between two poses of a keyframe that count as the same, m."""

_SAME_ANGLE = math.radians(15.0)
"""Largest difference of their headings, rad."""

_PROBABILITY_FLOOR = 1e-12
"""Smallest probability of unmapped ground in a Bayes factor."""


def log_bayes_factor(
    hybrid_map: HybridMap, distribution: PoseDistribution, tracked_pose: PoseInArea, poses: Mapping[int, Pose]
) -> float:
    """log p(scans | kidnapped) / p(scans | not kidnapped), nats, both relative to new ground.

    :param tracked_pose: the pose without a kidnapping; a kidnapped robot is elsewhere.
    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    probabilities = distribution.probabilities
    at_tracked_pose = candidates_at(hybrid_map, distribution, tracked_pose, poses)
    unmapped = max(1.0 - float(probabilities.sum()), _PROBABILITY_FLOOR)
    elsewhere = unmapped + float(probabilities[~at_tracked_pose].sum())
    areas = len(hybrid_map.area_ids())
    prior_odds = KIDNAPPED_UNMAPPED_PRIOR / (1.0 - KIDNAPPED_UNMAPPED_PRIOR)
    stayed = float(probabilities[at_tracked_pose].sum()) / unmapped * prior_odds * areas
    return math.log(elsewhere / unmapped * KIDNAPPED_UNMAPPED_PRIOR) - math.log(max(1.0, stayed))


def prefers_tracked_pose(
    hybrid_map: HybridMap,
    distribution: PoseDistribution,
    tracked_pose: PoseInArea,
    poses: Mapping[int, Pose],
    options: InferenceParameters,
) -> bool:
    """Whether the tracked pose is more probable than all other candidates, and most surfaces are known there.

    Unmapped ground is no alternative here, since any contradiction speaks for it.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    probabilities = distribution.probabilities
    at_tracked_pose = candidates_at(hybrid_map, distribution, tracked_pose, poses)
    known_share = max(
        (c.agreement.matched_share for c, there in zip(distribution.candidates, at_tracked_pose, strict=True) if there),
        default=0.0,
    )
    is_preferred = probabilities[at_tracked_pose].sum() > probabilities[~at_tracked_pose].sum()
    return known_share >= options.relocalization_share and bool(is_preferred)


def decisive_candidate(
    distribution: PoseDistribution, poses: Mapping[int, Pose], options: InferenceParameters
) -> PoseInArea | None:
    """The pose that a search found for a robot kidnapped during mapping, or None.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    best = distribution.best
    if best is None or not is_decisive(*best, options, is_kidnapped=True):
        return None
    return pose_in_area(best[0], poses, max(poses))


def is_decisive(
    candidate: PoseCandidate, probability: float, options: InferenceParameters, *, is_kidnapped: bool
) -> bool:
    """Whether a search determines the pose.

    :param is_kidnapped: whether the robot was kidnapped during mapping.
    """
    min_share = options.relocalization_share if is_kidnapped else 0.0
    is_probable = probability >= options.relocalization_probability
    return is_probable and candidate.agreement.matched_share >= min_share and is_certain(candidate)


def pose_in_area(candidate: PoseCandidate, poses: Mapping[int, Pose], keyframe: int) -> PoseInArea:
    """The pose of a keyframe under a candidate.

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    return PoseInArea(candidate.area, keyframe, se2.compose(candidate.mode.pose.mean, poses[keyframe]))


def candidates_at(
    hybrid_map: HybridMap, distribution: PoseDistribution, pose: PoseInArea, poses: Mapping[int, Pose]
) -> Bool:
    """Which candidates are at a pose, shape (len(distribution.candidates),).

    :param poses: {keyframe: ``reference_T_base``} of those that were searched.
    """
    found = [
        is_same_place(hybrid_map, pose_in_area(candidate, poses, pose.keyframe), pose)
        for candidate in distribution.candidates
    ]
    return np.array(found, dtype=np.bool_)


def is_same_place(hybrid_map: HybridMap, one: PoseInArea, other: PoseInArea) -> bool:
    """Whether two poses of a keyframe are about the same."""
    frames = shortest_path_beliefs(hybrid_map, one.area, targets=(other.area,))
    if other.area not in frames:
        return False
    difference = se2.between(one.pose, se2.compose(frames[other.area].mean, other.pose))
    is_near = math.hypot(difference[0], difference[1]) <= _SAME_DISTANCE
    return bool(is_near and abs(difference[2]) <= _SAME_ANGLE)
