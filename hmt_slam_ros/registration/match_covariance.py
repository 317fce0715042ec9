"""How far off a match against the map is, and how much of that lasts.

The information H of a match takes beams for independent. They are not: a wall that a grid has half a cell off misleads
all beams that hit it, and so does a cupboard that was moved. How much they mislead shows in the match itself. Blocks of
neighbouring beams each pull with a gradient g; were their errors independent, the sum over the beams of g g^T would be
H, and the sum over the blocks, J, is what it really is (the sandwich covariance of Huber 1967, by clusters). With the
prediction's information P, of which the match is believed 1 / c of its H, the estimate has

    S = (P + H / c)^-1,    covariance S (P + (a H + b J) / c^2) S.

What lasts of it is less, as the map is older than the last scan: a keyframe is laid onto what several before it made,
its own error has the weight of one of them, and the next keyframe corrects it. Of the error of step k, k + n has

    (1 + (m - 1) A)^-1,    A = S H / c,

where m is the age of the map in keyframes, and all of it along directions A in which the match says nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry.covariance import inverse, rotate_covariance
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration.scan_to_map import AlignmentSettings, linearize

# Neighbouring beams in a block: what is wrong with one is wrong with all.
_BLOCK = 16


class MatchNoise(NamedTuple):
    """What the errors of matches are taken to be.

    :ivar beam_noise: a, the part of the information that is noise of single beams.
    :ivar block_noise: b, the weight of what blocks of beams show.
    :ivar map_age: m, of the map that a keyframe is matched against, in keyframes.
    """

    beam_noise: float
    block_noise: float
    map_age: float


class MatchError(NamedTuple):
    """Covariances (3, 3) of a matched step, in the frame of its end.

    :ivar pose_covariance: of the pose in the map.
    :ivar drift_covariance: of what the pose adds to the drift of all poses after it.
    :ivar gain: A, how much of the pose the match determines.
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
    spread = inverse(prior + share * hessian)
    pulled = share * share * (noise.beam_noise * hessian + noise.block_noise * scatter)
    matched = spread @ (prior + pulled) @ spread
    gain = spread @ (share * hessian)
    lasts = np.linalg.inv(np.eye(3) + (noise.map_age - 1.0) * gain)
    return MatchError(matched, lasts @ matched @ lasts.T, gain)


@njit(cache=True)
def _add_scatter(points: Float64, pose: Float64, view: GridView, settings: AlignmentSettings, scatter: Float64) -> None:
    """Add J, the sum over blocks of beams of g g^T, map coordinates, to ``scatter`` (3, 3)."""
    for begin in range(0, points.shape[0], _BLOCK):
        _, g, _ = linearize(points[begin : begin + _BLOCK], pose[0], pose[1], pose[2], view, settings)
        for i in range(3):
            for j in range(3):
                scatter[i, j] += g[i] * g[j]
