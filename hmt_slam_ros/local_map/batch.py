"""One filter step for all particles of a hypothesis, each against its own map, in a single compiled call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.local_map.matching import Alignment, BeamModel, Prior, align, log_prior, log_ratio
from hmt_slam_ros.local_map.patches import MapView

_STEPS = 5
_GRID = _STEPS**3


class Proposals(NamedTuple):
    """The optimal proposals of m particles, in map coordinates.

    :ivar modes: shape (m, 3).
    :ivar hessians: information of the points at the modes, shape (m, 3, 3).
    :ivar means: shape (m, 3).
    :ivar covariances: shape (m, 3, 3).
    :ivar evidences: log p(z | x_{t-1}, u), shape (m,), nats.
    """

    modes: Float64
    hessians: Float64
    means: Float64
    covariances: Float64
    evidences: Float64


@njit(cache=True)
def proposal(
    points: Float64,
    mode: Float64,
    hessian: Float64,
    prior: Prior,
    view: MapView,
    model: BeamModel,
    sharpness: float,
    temper: float,
) -> tuple[Float64, Float64, float]:
    """The optimal proposal around a mode, from the likelihood volume.

    Prior times likelihood is evaluated on 5 x 5 x 5 poses along the principal axes of the Gauss-Newton covariance,
    two standard deviations to each side; its moments are the proposal (Grisetti et al. 2007). The evidence
    p(z | x_{t-1}, u) is the Laplace integral of prior times tempered likelihood, relative to unknown space.

    :param hessian: (3, 3) information of the points at the mode.
    :param sharpness: exponent on the likelihood in the proposal.
    :param temper: exponent on the likelihood in the evidence.
    :returns: mean (3,), covariance (3, 3), map coordinates, and log-evidence, nats.
    """
    values, vectors = np.linalg.eigh(np.linalg.inv(sharpness * hessian + prior.information))
    spread = np.sqrt(values)
    offsets, scores = np.empty((_GRID, 3)), np.empty(_GRID)
    local = np.empty(3)
    best = -np.inf
    for n in range(_GRID):
        local[0] = (n // (_STEPS * _STEPS) - _STEPS // 2) * spread[0]
        local[1] = (n // _STEPS % _STEPS - _STEPS // 2) * spread[1]
        local[2] = (n % _STEPS - _STEPS // 2) * spread[2]
        offsets[n] = vectors @ local
        pose = mode + offsets[n]
        expected = log_prior(pose, prior)
        ratio = log_ratio(points, pose[0], pose[1], pose[2], view, model)
        scores[n] = expected + sharpness * ratio
        best = max(best, expected + temper * ratio)
    mean, covariance = _moments(offsets, scores)
    occam = np.linalg.det(prior.information) / np.linalg.det(prior.information + temper * hessian)
    return mode + mean, covariance, best + 0.5 * np.log(occam)


@njit(cache=True)
def _moments(offsets: Float64, scores: Float64) -> tuple[Float64, Float64]:
    """Mean (3,) and covariance (3, 3) of offsets (n, 3) under the log-weights (n,)."""
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    mean, covariance = np.zeros(3), np.zeros((3, 3))
    for n in range(weights.size):
        mean += weights[n] * offsets[n]
    for n in range(weights.size):
        for i in range(3):
            for j in range(3):
                covariance[i, j] += weights[n] * (offsets[n, i] - mean[i]) * (offsets[n, j] - mean[j])
    return mean, covariance


@njit(cache=True)
def propose_all(
    points: Float64,
    starts: Float64,
    priors: Float64,
    information: Float64,
    tables: Int32,
    view: MapView,
    settings: Alignment,
    model: BeamModel,
    sharpness: float,
    temper: float,
) -> Proposals:
    """The optimal proposal of every particle.

    :param starts: (m, 3) poses to start matching from; ``priors``: (m, 3) poses that odometry predicts.
    :param tables: (m, T, T), the particles' maps; ``view`` is any view of the same pool.
    """
    m = starts.shape[0]
    modes, hessians, means = np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((m, 3))
    covariances, evidences = np.empty((m, 3, 3)), np.empty(m)
    for i in range(m):
        own = MapView(tables[i], view.odds, view.field, view.cell, view.radius)
        prior = Prior(priors[i], information)
        modes[i], hessians[i] = align(points, starts[i], prior, own, settings)
        means[i], covariances[i], evidences[i] = proposal(
            points, modes[i], hessians[i], prior, own, model, sharpness, temper
        )
    return Proposals(modes, hessians, means, covariances, evidences)
