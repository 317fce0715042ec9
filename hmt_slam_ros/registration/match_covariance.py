"""The error of a match with the map, and the part of it that adds to the drift.

The information H of a match takes beams for independent. They are not: an error of the map misleads all beams that hit
the same wall. Blocks of neighboring beams each have a gradient g. With independent errors, the sum of g g^T over the
beams is H; the sum over the blocks, J, is the measured one (the sandwich covariance of Huber 1967, by clusters). With
the information P of the prediction and the inflation c of the match,

    S = (P + H / c)^-1,    covariance S (P + (a H + b J) / c^2) S.

Later keyframes correct a part of this error, since several earlier keyframes made the map. The remaining part is

    (1 + (m - 1) A)^-1,    A = S H / c,

where m is the age of the map in keyframes. Along directions that the match does not determine, all of it remains.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.gaussian import matrix_inverse, rotate_covariance
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration.scan_to_map import AlignmentSettings, linearize

_BLOCK = 16
"""Neighboring beams in a block, whose errors are common: docs/decisions/0005-match-covariance.md."""


class MatchNoise(NamedTuple):
    """The model of the errors of matches.

    :ivar beam_noise: a, weight of the noise of single beams.
    :ivar block_noise: b, weight of the scatter of blocks of beams.
    :ivar map_age: m, age of the map with which a keyframe is matched, in keyframes.
    """

    beam_noise: float
    block_noise: float
    map_age: float


class MatchError(NamedTuple):
    """Covariances (3, 3) of a matched step, in the frame of its end.

    :ivar pose_covariance: of the pose in the map.
    :ivar drift_covariance: of the part that adds to the drift of all later poses.
    :ivar gain: A, the share of the pose that the match determines.
    """

    pose_covariance: Float64
    drift_covariance: Float64
    gain: Float64


def estimate_match_error(
    points: Float64,
    pose: Float64,
    hessian: Float64,
    prior: Float64,
    view: GridView,
    settings: AlignmentSettings,
    noise: MatchNoise,
) -> MatchError:
    """The error of the pose to which points were aligned.

    :param points: surfels (n, 4) that were matched, in the order of the beams.
    :param pose: ``map_T_base`` (3,), the mode.
    :param hessian: information of the points at the mode, map coordinates, (3, 3).
    :param prior: information of the prediction, likewise.
    """
    # All in the frame of the pose.
    share, scatter = 1.0 / settings.inflation, np.zeros((3, 3))
    _add_scatter(points, pose, view, settings, scatter)
    prior, hessian, scatter = (rotate_covariance(matrix, -pose[2]) for matrix in (prior, hessian, scatter))
    spread = matrix_inverse(prior + share * hessian)
    noise_information = share * share * (noise.beam_noise * hessian + noise.block_noise * scatter)
    covariance = spread @ (prior + noise_information) @ spread
    gain = spread @ (share * hessian)
    remaining = np.linalg.inv(np.eye(3) + (noise.map_age - 1.0) * gain)
    return MatchError(covariance, remaining @ covariance @ remaining.T, gain)


@njit(cache=True)
def _add_scatter(points: Float64, pose: Float64, view: GridView, settings: AlignmentSettings, scatter: Float64) -> None:
    """Add J, the sum over blocks of beams of g g^T, map coordinates, to ``scatter`` (3, 3)."""
    for begin in range(0, points.shape[0], _BLOCK):
        _, g, _ = linearize(points[begin : begin + _BLOCK], pose[0], pose[1], pose[2], view, settings)
        for i in range(3):
            for j in range(3):
                scatter[i, j] += g[i] * g[j]
