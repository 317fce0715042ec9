"""Which points of a scan are left out of its match, since what they lie on has moved.

The map stands still, people do not, and in a corridor they alone show how far the robot went: it would go with them. A
thing is a run of points without a gap. It may have moved where it contradicts the prediction, and has where it
contradicts what the prediction and all other things tell together: wall beside wall stands against odometry, but no
thing alone does.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry.covariance import (
    Symmetric,
    Vector,
    add_scaled,
    dot,
    multiply,
    sandwich,
    solve,
    symmetric_from_array,
    symmetric_inverse,
    write_to_array,
)
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration.scan_to_map import AlignmentSettings, Prior, linearize, pose_difference

# Neighbouring points farther apart than this, in m and as a share of the range, lie on different things.
_GAP, _GAP_SHARE = 0.1, 0.05
# Share of the things that stand still which are matched.
_GATE = chi_square_gate(0.999)
# Of the covariance of what a thing tells, which is 0 in some directions, this share is added to its diagonal.
_RIDGE = 1e-9


@njit(cache=True)
def reject_dynamic(
    points: Float64, pose: Float64, prior: Prior, view: GridView, settings: AlignmentSettings
) -> Float64:
    """The surfels (k, 4) of those given (n, 4) that lie on nothing that has moved since it entered the map.

    A thing tells at a pose the information L and the gradient g. If a pose off by N(m, C) is what all else tells,
    L m + g is a draw from N(0, L C L + L). Of the things whose draw is too unlikely the most unlikely one is left out,
    and so on with those that remain.

    :param points: in the order of the beams.
    :param pose: shape (3,), ``map_T_base``, where things meet the map: the prior's mean, or where a match ended.
    """
    begins = _segment_starts(points)
    predicted = pose_difference(prior.mean[0], prior.mean[1], prior.mean[2], pose)
    informations, gradients, suspected = _segment_equations(points, begins, pose, predicted, prior, view, settings)
    if not suspected.any():
        return points
    moved = _dynamic_segments(np.nonzero(suspected)[0], informations, gradients, predicted, prior.information)
    kept = np.ones(points.shape[0], np.bool_)
    for k in np.nonzero(moved)[0]:
        kept[begins[k] : begins[k + 1]] = False
    return points[kept]


@njit(cache=True)
def _segment_starts(points: Float64) -> Int64:
    """The first point of each of k things, and behind them the number of points, (k + 1,)."""
    begins, count = np.zeros(points.shape[0] + 1, dtype=np.int64), min(1, points.shape[0])
    for n in range(1, points.shape[0]):
        step = np.hypot(points[n, 0] - points[n - 1, 0], points[n, 1] - points[n - 1, 1])
        if step > _GAP + _GAP_SHARE * np.hypot(points[n, 0], points[n, 1]):
            begins[count] = n
            count += 1
    begins[count] = points.shape[0]
    return begins[: count + 1]


@njit(cache=True)
def _segment_equations(
    points: Float64,
    begins: Int64,
    pose: Float64,
    predicted: Vector,
    prior: Prior,
    view: GridView,
    settings: AlignmentSettings,
) -> tuple[Float64, Float64, Bool]:
    """What each thing tells: information (k, 3, 3), gradient (k, 3), and whether it contradicts the prior (k,).

    :param predicted: the prior's mean, seen from the pose.
    """
    count = begins.size - 1
    informations, gradients, contradicts = np.empty((count, 3, 3)), np.empty((count, 3)), np.zeros(count, np.bool_)
    plain = AlignmentSettings(settings.sigma * np.sqrt(settings.inflation), np.inf, 1.0, 1)
    covariance = symmetric_inverse(symmetric_from_array(prior.information))
    there = predicted[0] == 0.0 and predicted[1] == 0.0 and predicted[2] == 0.0
    for k in range(count):
        own = points[begins[k] : begins[k + 1]]
        information, gradient, square = linearize(own, pose[0], pose[1], pose[2], view, plain)
        # At its mean, no chi-square exceeds that of a prior that is certain.
        if square > _GATE or not there:
            contradicts[k] = _chi_square(information, gradient, covariance, predicted) > _GATE
        write_to_array(information, informations[k])
        gradients[k, 0], gradients[k, 1], gradients[k, 2] = gradient
    return informations, gradients, contradicts


@njit(cache=True)
def _chi_square(information: Symmetric, gradient: Vector, covariance: Symmetric, shift: Vector) -> float:
    """Chi-square of what a thing tells, where all else tells that the pose is off by ``shift``."""
    expected = add_scaled(sandwich(information, covariance), information, 1.0)
    ridge = _RIDGE * (1.0 + expected.xx + expected.yy + expected.tt)
    expected = add_scaled(expected, Symmetric(1.0, 0.0, 0.0, 1.0, 0.0, 1.0), ridge)
    told = _add_scaled_vector(gradient, multiply(information, shift), 1.0)
    return dot(told, solve(expected, told))


@njit(cache=True)
def _add_scaled_vector(a: Vector, b: Vector, factor: float) -> Vector:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True)
def _dynamic_segments(
    suspects: Int64, informations: Float64, gradients: Float64, predicted: Vector, prior: Float64
) -> Bool:
    """Those of the suspects that contradict all that is not among them, (k,).

    :param predicted: the prediction, seen from the pose; ``prior``, its information.
    """
    moved = np.zeros(gradients.shape[0], np.bool_)
    information = symmetric_from_array(prior)
    gradient = _add_scaled_vector((0.0, 0.0, 0.0), multiply(information, predicted), -1.0)
    for k in range(gradients.shape[0]):
        information = add_scaled(information, symmetric_from_array(informations[k]), 1.0)
        gradient = _add_scaled_vector(gradient, _row(gradients, k), 1.0)
    while True:
        worst, largest = -1, _GATE
        for k in suspects:
            if not moved[k]:
                own, told = symmetric_from_array(informations[k]), _row(gradients, k)
                covariance = symmetric_inverse(add_scaled(information, own, -1.0))
                surprise = _chi_square(
                    own, told, covariance, multiply(covariance, _add_scaled_vector(told, gradient, -1.0))
                )
                if surprise > largest:
                    worst, largest = k, surprise
        if worst < 0:
            return moved
        moved[worst] = True
        information = add_scaled(information, symmetric_from_array(informations[worst]), -1.0)
        gradient = _add_scaled_vector(gradient, _row(gradients, worst), -1.0)


@njit(cache=True)
def _row(vectors: Float64, k: int) -> Vector:
    return vectors[k, 0], vectors[k, 1], vectors[k, 2]
