"""What the wheels say: odometry with the noise that the motion model states, and slips that it does not know."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.motion_model import path_standard_deviations

_SLIP = np.array([0.3, 0.0, math.radians(15.0)])  # deviation of a slip, m, m, rad
_ITERATIONS = 40


def noisy_increments(
    increments: NDArray[np.float64], factor: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """What odometry measures of motions from one scan to the next.

    The measured motion is the one for which the truth, seen from its end, is a draw from the covariance that
    `motion_model.increment_covariance` states for that measured motion: what the filters assume of the
    odometry is exactly true.

    :param increments: shape (n, 3), true motions, m and rad.
    :param factor: on all deviations.
    :returns: shape (n, 3).
    """
    return add_odometry_noise(increments, factor, random.standard_normal(increments.shape))


def add_odometry_noise(
    increments: NDArray[np.float64], factor: float, draws: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What `noisy_increments` makes of standard normal draws (n, 3)."""
    motion = MotionParameters()
    measured = increments
    for _ in range(_ITERATIONS):
        deviations = factor * _deviations(measured, motion)
        # Half of the way: the fixed point is reached for all draws that have one.
        measured = se2.interpolate(measured, se2.compose(increments, se2.exp(-deviations * draws)), 0.5)
    return measured


def _deviations(increments: NDArray[np.float64], motion: MotionParameters) -> NDArray[np.float64]:
    """Deviations (n, 3) of x, y and heading, m, m, rad, that the motion model states for increments (n, 3)."""
    distances = np.hypot(increments[:, 0], increments[:, 1])
    translation, rotation = path_standard_deviations(distances, np.abs(increments[:, 2]), motion)
    return np.stack((translation, translation, rotation), axis=1)


def draw_slips(
    distances: NDArray[np.float64], period: float, per_100_m: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Errors (n, 3) that wheels which slip add to the increments, m, m, rad; each slip lasts about a second.

    :param distances: shape (n,), driven from one scan to the next, m.
    :param period: from one scan to the next, s.
    :param per_100_m: slips to be expected on 100 m.
    """
    steps = max(1, round(1.0 / period))
    begins = random.random(distances.size) < 0.01 * per_100_m * distances
    sizes = _SLIP * random.standard_normal((distances.size, 3)) * begins[:, None]
    spread = np.cumsum(sizes, axis=0)
    spread[steps:] -= spread[:-steps].copy()
    return spread / steps


def odometry_readings(poses: NDArray[np.float64], per_scan: int, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Odometry readings with given motions from scan to scan, whose errors grow evenly between two scans.

    :param poses: shape (n, 3), true poses at the readings, the first of them and every ``per_scan``-th at a scan.
    :param measured: shape (k - 1, 3), what odometry says of the motion between the k scans.
    :returns: shape (n, 3), ``odom_T_base``, from the origin on.
    """
    starts = poses[::per_scan]
    errors = se2.log(se2.between(se2.between(starts[:-1], starts[1:]), measured))
    odometry = np.empty_like(poses)
    odometry[::per_scan] = integrate_increments(measured)
    for k in range(1, per_scan):
        true = se2.between(starts[:-1], poses[k::per_scan])
        odometry[k::per_scan] = se2.compose(odometry[:-1:per_scan], se2.compose(true, se2.exp(k / per_scan * errors)))
    return odometry


def integrate_increments(increments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (n + 1, 3) that begin at the origin and follow increments (n, 3)."""
    poses = [np.zeros(3)]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment))
    return np.array(poses)
