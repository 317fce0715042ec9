"""Keyframe pruning: which keyframes are redundant, and which others replace them.

A viewpoint is a position with a heading, as in metric SLAM's test whether a keyframe would add anything new.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan

Pose = Float64

_VIEWPOINT_FRACTION = 0.8
"""Size of a viewpoint relative to the distance of keyframes, below 1 as the filter may move a keyframe a little.

From docs/decisions/0012-keyframe-pruning.md.
"""


class ReplacementKeyframe(NamedTuple):
    """A keyframe that replaces another one as a reference of scans, and the other's pose in its frame, shape (3,)."""

    keyframe: int
    pose: Pose


def is_same_viewpoint(relative: Float64, settings: FilterParameters) -> Bool:
    """Which poses are at the base's viewpoint: near it, and with a similar heading.

    :param relative: shape (..., 3), ``base_T_other``, m and rad.
    :returns: shape (...).
    """
    is_near = np.hypot(relative[..., 0], relative[..., 1]) < _VIEWPOINT_FRACTION * settings.keyframe_distance
    is_aligned = np.abs(relative[..., 2]) < _VIEWPOINT_FRACTION * math.radians(settings.keyframe_angle)
    return np.asarray(is_near & is_aligned, dtype=np.bool_)


def looks_alike(mounting: Pose, mountings: Float64, settings: FilterParameters) -> Bool:
    """Which lasers look from the place of another one into its direction, so that one viewpoint is enough for both.

    :param mounting: ``base_T_laser`` of that laser, shape (3,) or (n, 1, 3), m and rad.
    :param mountings: those of the others, shape (n, 3).
    :returns: shape (n,), or (n, n).
    """
    return is_same_viewpoint(se2.between(mounting, mountings), settings)


def nearest_replacement(pose: Pose, others: Mapping[int, Pose]) -> ReplacementKeyframe:
    """The nearest of other keyframes; a turn by one radian counts as much as a meter.

    :param pose: shape (3,), ``area_T_base`` of a keyframe that is pruned.
    :param others: {keyframe: ``area_T_base``} of those that stay, at least one.
    """
    keyframes, poses = list(others), np.array(list(others.values()))
    relative = se2.between(poses, pose)
    nearest = int(np.argmin(np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])))
    return ReplacementKeyframe(keyframes[nearest], relative[nearest])


def redundant_keyframes(
    keyframe_poses: Mapping[int, Pose],
    scans: Mapping[int, Scan],
    protected: Collection[int],
    max_per_viewpoint: int,
    settings: FilterParameters,
) -> list[int]:
    """The keyframes to prune so that no viewpoint has too many.

    They are pruned one after the other: the one that shares its viewpoint with the most others, of those at crowded
    viewpoints, and of equals the oldest, so that a map follows a world that changes.

    :param keyframe_poses: {keyframe: ``area_T_base``} of one area.
    :param scans: {keyframe: its scan}; those of lasers that look elsewhere have other viewpoints.
    :param protected: keyframes that stay in any case.
    :param max_per_viewpoint: most keyframes at the viewpoint of any of them.
    :returns: in that order.
    """
    if not keyframe_poses:
        return []
    keyframes = np.array(sorted(keyframe_poses))
    poses = np.array([keyframe_poses[keyframe] for keyframe in sorted(keyframe_poses)])
    mountings = np.array([scans[keyframe].laser_pose for keyframe in keyframes.tolist()])
    is_shared = is_same_viewpoint(se2.between(poses[:, None], poses), settings)
    is_shared &= looks_alike(mountings[:, None], mountings, settings)
    is_prunable = ~np.isin(keyframes, list(protected))
    pruned: list[int] = []
    while True:
        counts = is_shared.sum(axis=1)
        is_crowded = (is_shared & (counts > max_per_viewpoint)[:, None]).any(axis=0) & is_prunable
        if not is_crowded.any():
            return pruned
        k = int(np.argmax(np.where(is_crowded, counts, 0)))
        pruned.append(int(keyframes[k]))
        is_shared[k], is_shared[:, k] = False, False
