"""The final map of a robot that used the ground of others: its own ground is refined, and theirs follows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap, has_foreign_keyframes
from hmt_slam_ros.results.recorder import Recording, keyframe_poses


def without_foreign_ground(recording: Recording) -> Recording:
    """The recording of the robot's own ground; the same one where its map has no other.

    Scans that were relative to keyframes of other robots are relative to the nearest of its own.
    """
    whole = recording.hybrid_map
    if not any(has_foreign_keyframes(whole.keyframes(area)) for area in whole.area_ids()):
        return recording
    from hmt_slam_ros.team.own_ground import own_ground  # noqa: PLC0415  networkx takes long to load

    hybrid_map = own_ground(whole)
    area_poses = {area: recording.area_poses[area] for area in hybrid_map.area_ids()}
    own = keyframe_poses(hybrid_map, area_poses)
    relative = recording.relative_trajectory.relative_to(own, keyframe_poses(whole, recording.area_poses))
    return with_map(replace(recording, area_poses=area_poses, relative_trajectory=relative), hybrid_map)


def with_foreign_ground(refined: Recording, before: Recording) -> Recording:
    """A refined recording of the robot's own ground with the ground of other robots.

    Each area of theirs keeps its pose relative to the nearest area with own ground. Their keyframes keep their poses in
    areas.

    :param before: the recording with all ground, before the refinement.
    """
    own = refined.hybrid_map
    area_poses = {area: _moved_with(area, refined.area_poses, before.area_poses) for area in before.area_poses}
    hybrid_map = before.hybrid_map.branch()
    for area in own.area_ids():
        for keyframe, pose in own.keyframes(area).items():
            hybrid_map.set_keyframe(keyframe, area, pose)
    for a, b, arc in list(hybrid_map.all_arcs()):
        mean = se2.between(area_poses[a].mean, area_poses[b].mean)
        hybrid_map.set_arc(a, b, PoseGaussian(mean, arc.pose.covariance), closure=arc.closure)
    return with_map(replace(refined, area_poses=area_poses), hybrid_map)


def _moved_with(area: int, refined: Mapping[int, PoseGaussian], before: Mapping[int, PoseGaussian]) -> PoseGaussian:
    """``map_T_area`` of an area, with the refined areas; one that is not among them moves with the nearest."""
    if area in refined:
        return refined[area]
    nearest = min(refined, key=lambda other: (_distance(before[other].mean, before[area].mean), other))
    pose = se2.compose(refined[nearest].mean, se2.between(before[nearest].mean, before[area].mean))
    return PoseGaussian(pose, before[area].covariance)


def _distance(one: Float64, other: Float64) -> float:
    return float(np.hypot(*(one - other)[:2]))


def with_map(recording: Recording, hybrid_map: HybridMap) -> Recording:
    """The recording with another map of its most probable hypothesis."""
    maps = recording.replica.maps | {recording.replica.best_hypothesis: hybrid_map}
    return replace(recording, replica=replace(recording.replica, maps=maps))
