"""Goal poses, held by a keyframe beside them, so that they move with the map.

A pose in the frame of the whole map would point elsewhere after a loop closure moved the areas. Areas themselves are
cut and merged; a keyframe stays with its surroundings.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.frontiers import KEYFRAME_RANGE
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.tasks import AnchoredPose, GoalError, TaskError


def anchor_pose(hybrid_map: HybridMap, area_poses: Mapping[int, PoseGaussian], pose: Float64) -> AnchoredPose:
    """A pose of the whole map, held by the nearest keyframe.

    :param area_poses: {area: ``map_T_area``}.
    :param pose: ``map_T_goal`` (3,), m and rad.
    :raises GoalError: far from all keyframes.
    """
    nearest, anchor = math.inf, None
    for area in hybrid_map.area_ids():
        if area in area_poses:
            in_area = se2.between(area_poses[area].mean, pose)
            keyframe, distance = _nearest(hybrid_map.keyframes(area), in_area)
            if distance < nearest:
                nearest = distance
                anchor = AnchoredPose(keyframe, se2.between(hybrid_map.keyframes(area)[keyframe], in_area))
    if anchor is None or nearest > KEYFRAME_RANGE:
        raise GoalError(
            f"the goal ({pose[0]:.2f}, {pose[1]:.2f}) is outside the map: give one within {KEYFRAME_RANGE:g} m of "
            "where the robot has been",
            TaskError.GOAL_OUTSIDE_MAP,
        )
    return anchor


def anchor_elsewhere(anchor: AnchoredPose, hybrid_map: HybridMap, pruned: Collection[int]) -> AnchoredPose:
    """The same pose, held by another keyframe of the area where its own is about to be pruned; else as it was."""
    if anchor.keyframe not in pruned:
        return anchor
    for area in hybrid_map.area_ids():
        poses = hybrid_map.keyframes(area)
        rest = {keyframe: pose for keyframe, pose in poses.items() if keyframe not in pruned}
        if anchor.keyframe in poses and rest:
            in_area = se2.compose(poses[anchor.keyframe], anchor.pose)
            keyframe, _ = _nearest(rest, in_area)
            return AnchoredPose(keyframe, se2.between(rest[keyframe], in_area))
    return anchor


def _nearest(keyframes: Mapping[int, Float64], pose: Float64) -> tuple[int, float]:
    """The keyframe nearest to a pose in their area, and its distance, m; inf for none."""
    distances = {keyframe: math.dist(own[:2], pose[:2]) for keyframe, own in keyframes.items()}
    keyframe = min(distances, key=distances.__getitem__, default=-1)
    return keyframe, distances.get(keyframe, math.inf)
