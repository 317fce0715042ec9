"""Which keyframes are more than their places need, and to which others the scans are related that were related to them.

A place is what metric SLAM takes for one when it asks whether a keyframe would add anything new: close by, with a like
heading.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import FilterParameters
from hmt_slam_ros.geometry import se2

Pose = NDArray[np.float64]

# Below 1, since the filter step at a keyframe may move the robot a little back towards the last one.
_VIEWPOINT_FRACTION = 0.8


class ReplacementKeyframe(NamedTuple):
    """The keyframe to which scans are related instead of another, and the other's pose in its frame, shape (3,)."""

    keyframe: int
    pose: Pose


def is_same_viewpoint(relative: NDArray[np.float64], settings: FilterParameters) -> NDArray[np.bool_]:
    """Which poses are in one place with the base: near it, and with a like heading.

    :param relative: shape (..., 3), ``base_T_other``, m and rad.
    :returns: shape (...).
    """
    near = np.hypot(relative[..., 0], relative[..., 1]) < _VIEWPOINT_FRACTION * settings.keyframe_distance
    alike = np.abs(relative[..., 2]) < _VIEWPOINT_FRACTION * math.radians(settings.keyframe_angle)
    return np.asarray(near & alike, dtype=np.bool_)


def nearest_replacement(pose: Pose, others: Mapping[int, Pose]) -> ReplacementKeyframe:
    """The nearest of other keyframes; a turn by one radian counts as much as a meter.

    :param pose: shape (3,), ``area_T_base`` of a keyframe that is forgotten.
    :param others: {keyframe: ``area_T_base``} of those that stay, at least one.
    """
    keyframes, poses = list(others), np.array(list(others.values()))
    relative = se2.between(poses, pose)
    nearest = int(np.argmin(np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])))
    return ReplacementKeyframe(keyframes[nearest], relative[nearest])


def redundant_keyframes(
    keyframe_poses: Mapping[int, Pose], protected: Collection[int], max_per_viewpoint: int, settings: FilterParameters
) -> list[int]:
    """The keyframes to be forgotten so that no place holds too many, where others may be.

    One after the other, of all that are in too full a place: the one that is in one place with the most others, and of
    equals the oldest, so that a map follows a world that changes.

    :param keyframe_poses: {keyframe: ``area_T_base``} of one area.
    :param protected: keyframes that stay in any case.
    :param max_per_viewpoint: this many may be in a place, that of any of them.
    :returns: in that order.
    """
    if not keyframe_poses:
        return []
    keyframes, poses = (
        np.array(sorted(keyframe_poses)),
        np.array([keyframe_poses[keyframe] for keyframe in sorted(keyframe_poses)]),
    )
    count = len(keyframes)
    together = is_same_viewpoint(se2.between(np.repeat(poses, count, 0), np.tile(poses, (count, 1))), settings)
    together = together.reshape(count, count)
    may_go = ~np.isin(keyframes, list(protected))
    found: list[int] = []
    while True:
        counts = together.sum(axis=1)
        in_full_place = (together & (counts > max_per_viewpoint)[:, None]).any(axis=0) & may_go
        if not in_full_place.any():
            return found
        gone = int(np.argmax(np.where(in_full_place, counts, 0)))
        found.append(int(keyframes[gone]))
        together[gone], together[:, gone] = False, False
