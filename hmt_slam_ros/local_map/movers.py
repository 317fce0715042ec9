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
from hmt_slam_ros.geometry.chi_square import gate
from hmt_slam_ros.geometry.covariance import inverse
from hmt_slam_ros.local_map.matching import Alignment, Prior, linearise
from hmt_slam_ros.local_map.patches import MapView

# Neighbouring points farther apart than this, in m and as a share of the range, lie on different things.
_APART, _APART_SHARE = 0.1, 0.05
# Share of the things that stand still which are matched.
_GATE = gate(0.999)
# Of the covariance of what a thing tells, which is 0 in some directions, this share is added to its diagonal.
_RIDGE = 1e-9


@njit(cache=True)
def standing(points: Float64, prior: Prior, view: MapView, settings: Alignment) -> Float64:
    """The surfels (k, 4) of those given (n, 4) that lie on nothing that has moved since it entered the map.

    A thing tells at the prior's mean the information L and the gradient g. If a pose off by N(m, C) is what all else
    tells, L m + g is a draw from N(0, L C L + L). Of the things whose draw is too unlikely the most unlikely one is
    left out, and so on with those that remain.

    :param points: in the order of the beams.
    """
    begins = _things(points)
    informations, gradients, suspected = _told(points, begins, prior, view, settings)
    if not suspected.any():
        return points
    moved = _moved(np.nonzero(suspected)[0], informations, gradients, prior.information)
    kept = np.ones(points.shape[0], np.bool_)
    for k in np.nonzero(moved)[0]:
        kept[begins[k] : begins[k + 1]] = False
    return points[kept]


@njit(cache=True)
def _things(points: Float64) -> Int64:
    """The first point of each of k things, and behind them the number of points, (k + 1,)."""
    begins, count = np.zeros(points.shape[0] + 1, dtype=np.int64), min(1, points.shape[0])
    for n in range(1, points.shape[0]):
        step = np.hypot(points[n, 0] - points[n - 1, 0], points[n, 1] - points[n - 1, 1])
        if step > _APART + _APART_SHARE * np.hypot(points[n, 0], points[n, 1]):
            begins[count] = n
            count += 1
    begins[count] = points.shape[0]
    return begins[: count + 1]


@njit(cache=True)
def _told(
    points: Float64, begins: Int64, prior: Prior, view: MapView, settings: Alignment
) -> tuple[Float64, Float64, Bool]:
    """What each thing tells: information (k, 3, 3), gradient (k, 3), and whether it contradicts the prior (k,)."""
    count = begins.size - 1
    informations, gradients, contradicts = np.empty((count, 3, 3)), np.empty((count, 3)), np.zeros(count, np.bool_)
    plain = Alignment(settings.sigma * np.sqrt(settings.inflation), np.inf, 1.0, 1)
    covariance, unmoved = inverse(prior.information), np.zeros(3)
    for k in range(count):
        own = points[begins[k] : begins[k + 1]]
        informations[k], gradients[k], square = linearise(own, prior.mean, view, plain)
        # No chi-square exceeds that of a prior that is certain.
        if square > _GATE:
            contradicts[k] = _surprise(informations[k], gradients[k], covariance, unmoved) > _GATE
    return informations, gradients, contradicts


@njit(cache=True)
def _surprise(information: Float64, gradient: Float64, covariance: Float64, shift: Float64) -> float:
    """Chi-square of what a thing tells, where all else tells that the pose is off by ``shift``."""
    expected = information @ covariance @ information + information
    ridge = _RIDGE * (1.0 + np.trace(expected))
    for i in range(3):
        expected[i, i] += ridge
    told = gradient + information @ shift
    return np.dot(told, np.linalg.solve(expected, told))


@njit(cache=True)
def _moved(suspects: Int64, informations: Float64, gradients: Float64, prior: Float64) -> Bool:
    """Those of the suspects that contradict all that is not among them, (k,).

    :param prior: information of the prediction.
    """
    moved = np.zeros(gradients.shape[0], np.bool_)
    information, gradient = prior + informations.sum(axis=0), gradients.sum(axis=0)
    while True:
        worst, largest = -1, _GATE
        for k in suspects:
            if not moved[k]:
                covariance = inverse(information - informations[k])
                shift = np.dot(covariance, gradients[k] - gradient)
                surprise = _surprise(informations[k], gradients[k], covariance, shift)
                if surprise > largest:
                    worst, largest = k, surprise
        if worst < 0:
            return moved
        moved[worst] = True
        information = information - informations[worst]
        gradient = gradient - gradients[worst]
