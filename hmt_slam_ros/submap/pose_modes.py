"""Modes of a pose between which the weights have yet to decide: shares of particles, and moments over all modes.

docs/decisions/0050-modes-of-a-match.md has the reasons.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import rotate_covariance


def normalize_weights(log_weights: Float64) -> Float64:
    """Weights that sum to 1, from their logs up to a constant, nats."""
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum())


def log_sum(log_weights: Float64) -> float:
    """Log of the sum of weights, from their logs, nats."""
    return float(np.logaddexp.reduce(log_weights))


def draw_systematically(weights: Float64, count: int, offset: float) -> Int64:
    """``count`` indices into weights that sum to 1, ascending.

    :param offset: of the positions, in [0, 1).
    """
    positions = (np.arange(count) + offset) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), positions), len(weights) - 1)


def allocate_particles(shares: Float64, count: int) -> Int64:
    """Numbers of particles of the modes, ``count`` in all: about by their shares, but at least one for each.

    :param shares: shape (k,), sum to 1; k is ``count`` at most.
    """
    counts = np.maximum(1, np.bincount(draw_systematically(shares, count, 0.5), minlength=len(shares)))
    while counts.sum() > count:
        counts[np.argmax(counts)] -= 1
    return counts


def spread_about(pose: Float64, poses: Float64, shares: Float64) -> Float64:
    """Second moment (3, 3) of poses (k, 3) about a pose (3,), in its tangent space.

    :param shares: shape (k,), sum to 1.
    """
    offsets = se2.log(se2.between(pose, poses))
    return np.asarray(np.einsum("k,ki,kj->ij", shares, offsets, offsets))


def mix_covariances(pose: Float64, poses: Float64, covariances: Sequence[Float64], shares: Float64) -> Float64:
    """Second moment (3, 3) of k Gaussians about a pose (3,), in its tangent space.

    :param poses: shape (k, 3), their means.
    :param covariances: each shape (3, 3), right tangent frame.
    :param shares: shape (k,), sum to 1.
    """
    turned = [rotate_covariance(own, theta) for own, theta in zip(covariances, poses[:, 2] - pose[2], strict=True)]
    return np.asarray(np.einsum("k,kij->ij", shares, np.array(turned))) + spread_about(pose, poses, shares)


def blur_information(information: Float64, spread: Float64) -> Float64:
    """Information (3, 3) on a pose that has a further error, of covariance ``spread`` (3, 3)."""
    blurred = np.linalg.solve(np.eye(3) + information @ spread, information)
    return np.asarray(0.5 * (blurred + blurred.T))
