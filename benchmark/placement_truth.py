"""Placements of one map in another, right or wrong by the true poses of both."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.evaluation import StampedPoses
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.join import Meeting
from hmt_slam_ros.team.placement import Placement

RIGHT = 1.0
"""Largest error of a right placement, m."""

RIGHT_ANGLE = math.radians(15.0)

COMMON = 2.0
"""Distance of positions of two drives within which they are on common ground, m."""

MIN_OVERLAP = 10.0
"""Path on common ground from which a join counts as due, m."""


class KeyframePoses(NamedTuple):
    """Poses of the keyframes of a map in the order of the drive, each of shape (n, 3), m and rad.

    :ivar in_map: in the frame of the map.
    :ivar true: in the frame of the truth.
    """

    in_map: Float64
    true: Float64

    @classmethod
    def of_scans(cls, scans: Mapping[int, Scan], trajectory: StampedPoses, truth: StampedPoses) -> KeyframePoses:
        """The poses at the times of some keyframes.

        :param scans: {keyframe: scan}.
        :param trajectory: poses in the map.
        """
        stamps = np.array([scans[keyframe].stamp for keyframe in sorted(scans)])
        return cls(trajectory.poses[trajectory.nearest_indices(stamps)], truth.poses[truth.nearest_indices(stamps)])


def window_errors(met: Meeting, placement: Placement, first: StampedPoses, second: StampedPoses) -> Float64:
    """Distance, m, and angle, rad, of every window of a placement from the truth, shape (n, 2).

    :param first: true poses of the first robot; ``second`` likewise.
    """
    errors = []
    for number, match in placement.matches.items():
        known, area_T_known = next(iter(met.pair.hybrid_map.keyframes(match.area).items()))
        reference = next(iter(met.windows[number].poses))
        true = se2.between(_true_pose(met, first, known), _true_pose(met, second, reference))
        error = se2.between(true, se2.between(area_T_known, match.belief.mean))
        errors.append((math.hypot(error[0], error[1]), abs(float(error[2]))))
    return np.array(errors)


def _true_pose(met: Meeting, truth: StampedPoses, keyframe: int) -> Float64:
    stamps = np.array([met.pair.scans[keyframe].stamp])
    return np.asarray(truth.poses[truth.nearest_indices(stamps)[0]], dtype=np.float64)


def rigid_errors(pose: Float64, first: KeyframePoses, second: KeyframePoses) -> Float64:
    """Distance, m, and angle, rad, of keyframes of a map that is placed as a whole, from the truth, shape (n, 2).

    They are those on common ground, or the nearest one, as seen from the nearest keyframe of the first map: the drift
    of either map elsewhere does not count.

    :param pose: ``first_T_second``, shape (3,), between the frames of the maps.
    """
    distances = distances_between(second.true[:, :2], first.true[:, :2])
    nearest, gaps = distances.argmin(axis=1), distances.min(axis=1)
    true = se2.between(first.true[nearest], second.true)
    placed = se2.between(first.in_map[nearest], se2.compose(pose, second.in_map))
    error = se2.between(true, placed)[gaps <= max(COMMON, gaps.min())]
    return np.stack([np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])], axis=1)


def are_right(errors: Float64) -> bool:
    """Whether most windows, or keyframes, are where they truly are.

    :param errors: those of :func:`window_errors` or :func:`rigid_errors`.
    """
    return bool(np.mean((errors[:, 0] <= RIGHT) & (errors[:, 1] <= RIGHT_ANGLE)) > 0.5)


def on_common_ground(first: Float64, second: Float64) -> Bool:
    """Which positions of the second drive are on ground of the first, shape (n,).

    :param first: true poses, shape (m, 3); ``second`` likewise, shape (n, 3).
    """
    return np.asarray((distances_between(second[:, :2], first[:, :2]) <= COMMON).any(axis=1))


def distances_between(one: Float64, other: Float64) -> Float64:
    """Distances of positions (n, 2) from others (m, 2), shape (n, m), m."""
    return np.asarray(np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1)))
