"""Dynamic rejection: segments of a scan that moved are left out of its match.

In a corridor, people alone show how far the robot went, and would pull the match with them. A segment is a run of
points without a gap. It is a suspect if it contradicts the prediction. It has moved if it contradicts the prediction
together with all other segments: several walls outweigh odometry, but a single segment does not.
"""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.gaussian import (
    Symmetric,
    Vector,
    add_scaled,
    chi_square_gate,
    dot,
    multiply,
    sandwich,
    solve,
    symmetric_from_array,
    symmetric_inverse,
    write_to_array,
)
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.registration.scan_to_map import AlignmentSettings, Prior, linearize, pose_difference

_GAP, _GAP_SHARE = 0.1, 0.05
"""Distance of neighboring points from which they are on two segments, m and as a share of the range."""

_GATE = chi_square_gate(0.999)
"""Chi-square beyond which a segment has moved, 3 degrees of freedom: docs/decisions/0007-dynamic-rejection.md."""

_RIDGE = 1e-9
"""Share of its trace that is added to the diagonal of a singular covariance."""


@njit(cache=True)
def reject_dynamic(
    points: Float64, pose: Float64, prior: Prior, view: GridView, settings: AlignmentSettings
) -> Float64:
    """The surfels (k, 4) on static objects, of those given (n, 4).

    A segment has the information L and the gradient g at a pose. If all else gives an error N(m, C) of that pose,
    L m + g is a draw from N(0, L C L + L). The segment with the most unlikely draw is removed until all are likely.

    :param points: in the order of the beams.
    :param pose: shape (3,), ``map_T_base`` of the linearization: the prior's mean, or the pose of a match.
    """
    begins = _segment_starts(points)
    predicted = pose_difference(prior.mean[0], prior.mean[1], prior.mean[2], pose)
    informations, gradients, suspected = _segment_equations(points, begins, pose, predicted, prior, view, settings)
    if not suspected.any():
        return points
    dynamic = _dynamic_segments(np.nonzero(suspected)[0], informations, gradients, predicted, prior.information)
    is_static = np.ones(points.shape[0], np.bool_)
    for k in np.nonzero(dynamic)[0]:
        is_static[begins[k] : begins[k + 1]] = False
    return points[is_static]


@njit(cache=True)
def _segment_starts(points: Float64) -> Int64:
    """The first point of each of k segments, and the number of points, (k + 1,)."""
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
    """Information (k, 3, 3) and gradient (k, 3) of each segment, and whether it contradicts the prior (k,).

    :param predicted: the prior's mean less the pose.
    """
    count = begins.size - 1
    informations, gradients, contradicts = np.empty((count, 3, 3)), np.empty((count, 3)), np.zeros(count, np.bool_)
    plain = AlignmentSettings(settings.sigma * np.sqrt(settings.inflation), np.inf, 1.0, 1)
    covariance = symmetric_inverse(symmetric_from_array(prior.information))
    at_mean = predicted[0] == 0.0 and predicted[1] == 0.0 and predicted[2] == 0.0
    for k in range(count):
        own = points[begins[k] : begins[k + 1]]
        information, gradient, square = linearize(own, pose[0], pose[1], pose[2], view, plain)
        # At the mean of the prior, chi-square is largest for a prior without uncertainty.
        if square > _GATE or not at_mean:
            contradicts[k] = _chi_square(information, gradient, covariance, predicted) > _GATE
        write_to_array(information, informations[k])
        gradients[k, 0], gradients[k, 1], gradients[k, 2] = gradient
    return informations, gradients, contradicts


@njit(cache=True)
def _chi_square(information: Symmetric, gradient: Vector, covariance: Symmetric, shift: Vector) -> float:
    """Chi-square of a segment, where all else gives an error ``shift`` of the pose."""
    expected = add_scaled(sandwich(information, covariance), information, 1.0)
    ridge = _RIDGE * (1.0 + expected.xx + expected.yy + expected.tt)
    expected = add_scaled(expected, Symmetric(1.0, 0.0, 0.0, 1.0, 0.0, 1.0), ridge)
    draw = _add_scaled_vector(gradient, multiply(information, shift), 1.0)
    return dot(draw, solve(expected, draw))


@njit(cache=True)
def _add_scaled_vector(a: Vector, b: Vector, factor: float) -> Vector:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(cache=True)
def _dynamic_segments(
    suspects: Int64, informations: Float64, gradients: Float64, predicted: Vector, prior: Float64
) -> Bool:
    """Whether each segment is a suspect that contradicts all remaining segments, (k,).

    :param predicted: the prediction less the pose; ``prior``, its information.
    """
    dynamic = np.zeros(gradients.shape[0], np.bool_)
    information = symmetric_from_array(prior)
    gradient = _add_scaled_vector((0.0, 0.0, 0.0), multiply(information, predicted), -1.0)
    for k in range(gradients.shape[0]):
        information = add_scaled(information, symmetric_from_array(informations[k]), 1.0)
        gradient = _add_scaled_vector(gradient, _row(gradients, k), 1.0)
    while True:
        worst, largest = -1, _GATE
        for k in suspects:
            if not dynamic[k]:
                own, own_gradient = symmetric_from_array(informations[k]), _row(gradients, k)
                covariance = symmetric_inverse(add_scaled(information, own, -1.0))
                shift = multiply(covariance, _add_scaled_vector(own_gradient, gradient, -1.0))
                chi_square = _chi_square(own, own_gradient, covariance, shift)
                if chi_square > largest:
                    worst, largest = k, chi_square
        if worst < 0:
            return dynamic
        dynamic[worst] = True
        information = add_scaled(information, symmetric_from_array(informations[worst]), -1.0)
        gradient = _add_scaled_vector(gradient, _row(gradients, worst), -1.0)


@njit(cache=True)
def _row(vectors: Float64, k: int) -> Vector:
    return vectors[k, 0], vectors[k, 1], vectors[k, 2]
