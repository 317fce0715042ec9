"""One filter step for all particles of a hypothesis, each against its own map, in a single compiled call."""

from __future__ import annotations

import numpy as np
from numba import njit

from hmt_slam_ros.local_map.matching import align, log_ratio

_STEPS = 5
_GRID = _STEPS**3


@njit(cache=True)
def proposal(  # type: ignore[no-untyped-def]
    points, mode, hessian, prior, information, table, odds, field, cell, in_unknown, in_known, sharp, tempered
):
    """The optimal proposal around a mode, from the likelihood volume.

    Prior times likelihood is evaluated on 5 x 5 x 5 poses along the principal axes of the Gauss-Newton covariance,
    two standard deviations to each side; its moments are the proposal (Grisetti 2007). The evidence
    p(z | x_{t-1}, u) is the Laplace integral of prior times the ``tempered`` likelihood, relative to unknown space.

    :returns: mean (3,), covariance (3, 3), map frame, and log-evidence, nats.
    """
    values, vectors = np.linalg.eigh(np.linalg.inv(sharp * hessian + information))
    spread = np.sqrt(values)
    offsets, scores = np.empty((_GRID, 3)), np.empty(_GRID)
    local = np.empty(3)
    best = -np.inf
    for n in range(_GRID):
        local[0] = (n // (_STEPS * _STEPS) - _STEPS // 2) * spread[0]
        local[1] = (n // _STEPS % _STEPS - _STEPS // 2) * spread[1]
        local[2] = (n % _STEPS - _STEPS // 2) * spread[2]
        offsets[n] = vectors @ local
        difference = mode + offsets[n] - prior
        difference[2] = (difference[2] + np.pi) % (2.0 * np.pi) - np.pi
        log_prior = -0.5 * np.dot(difference, information @ difference)
        ratio = log_ratio(
            points, mode[0] + offsets[n, 0], mode[1] + offsets[n, 1], mode[2] + offsets[n, 2],
            table, odds, field, cell, in_unknown, in_known,
        )
        scores[n] = log_prior + sharp * ratio
        best = max(best, log_prior + tempered * ratio)
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    shift = np.zeros(3)
    for n in range(_GRID):
        shift += weights[n] * offsets[n]
    covariance = np.zeros((3, 3))
    for n in range(_GRID):
        centred = offsets[n] - shift
        for i in range(3):
            for j in range(3):
                covariance[i, j] += weights[n] * centred[i] * centred[j]
    occam = 0.5 * np.log(np.linalg.det(information) / np.linalg.det(information + tempered * hessian))
    return mode + shift, covariance, best + occam


@njit(cache=True)
def propose_all(  # type: ignore[no-untyped-def]
    points, starts, priors, information, tables, odds, field, cell, radius, sigma, robust, iterations,
    in_unknown, in_known, sharp, tempered,
):
    """The optimal proposal of every particle.

    :param starts: (m, 3) poses to start matching from; ``priors``: (m, 3) poses that odometry predicts.
    :param tables: (m, T, T).
    :returns: modes (m, 3), means (m, 3), covariances (m, 3, 3), log-evidences (m,).
    """
    m = starts.shape[0]
    modes, means = np.empty((m, 3)), np.empty((m, 3))
    covariances, evidences = np.empty((m, 3, 3)), np.empty(m)
    for i in range(m):
        modes[i], hessian = align(
            points, starts[i], priors[i], information, tables[i], field, cell, radius, sigma, robust, iterations
        )
        means[i], covariances[i], evidences[i] = proposal(
            points, modes[i], hessian, priors[i], information, tables[i], odds, field, cell, in_unknown, in_known,
            sharp, tempered,
        )
    return modes, means, covariances, evidences
