"""Placement of the scans between keyframes: each is registered with the keyframes around it, which stay."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.topological import Refinement
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.refinement.registration import normal_equations, weighting
from hmt_slam_ros.refinement.surfaces import Surfaces

# A scan is where metric SLAM matched it, so that few steps suffice.
_STEPS = 2


def place(
    surfaces: Surfaces,
    poses: NDArray[np.float64],
    scans: Surfaces,
    initial: NDArray[np.float64],
    around: list[NDArray[np.int64]],
    options: Refinement,
) -> NDArray[np.float64]:
    """Register scans with keyframes that stay where they are.

    :param surfaces: of n keyframes.
    :param poses: shape (n, 3), theirs.
    :param scans: m scans.
    :param initial: shape (m, 3), where they are thought to be, with the deviations ``options.scan_sigma`` and
        ``options.scan_angle``.
    :param around: for every scan the rows of the keyframes to register with.
    :returns: shape (m, 3).
    """
    scan_of = np.repeat(np.arange(len(around)), [len(rows) for rows in around])
    keyframe_of = np.concatenate([np.zeros(0, np.int64), *around])
    prior = np.diag([options.scan_sigma**-2, options.scan_sigma**-2, math.radians(options.scan_angle) ** -2])
    placed = initial
    for _ in range(_STEPS):
        relative = se2.between(poses[keyframe_of], placed[scan_of])
        information, gradient, share = normal_equations(
            scans, scan_of, surfaces, keyframe_of, relative, options.last_gate, weighting(options), 1
        )
        meets = share >= options.min_share
        total, slope = np.broadcast_to(prior, (len(around), 3, 3)).copy(), se2.log(se2.between(initial, placed)) @ prior
        np.add.at(total, scan_of[meets], information[meets])
        np.add.at(slope, scan_of[meets], gradient[meets])
        placed = se2.compose(placed, se2.exp(-np.linalg.solve(total, slope[..., None])[..., 0]))
    return placed
