"""Modes of a pose between which the weights have yet to decide: shares of particles, and moments over all modes.

docs/decisions/0050-modes-of-a-match.md has the reasons.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import rotate_covariance
from hmt_slam_ros.sensors.relative_motion import NO_MOTION
from hmt_slam_ros.submap.local_filter import TrackedMode

UNMOVED = TrackedMode(NO_MOTION, NO_MOTION.covariance)
"""A mode after a filter step."""


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


@dataclass(frozen=True, eq=False)
class PoseModes:
    """The modes of M particles.

    :ivar tracked: what is known of each mode.
    :ivar members: shape (M,), number of the mode of each particle.
    """

    tracked: tuple[TrackedMode, ...]
    members: Int64

    @classmethod
    def single(cls, count: int, mode: TrackedMode = UNMOVED) -> PoseModes:
        """One mode of all particles."""
        return cls((mode,), np.zeros(count, dtype=np.int64))

    @classmethod
    def from_rows(cls, rows: Sequence[Int64], tracked: Sequence[TrackedMode], count: int) -> PoseModes:
        """Modes with the numbers of their particles, ``count`` in all."""
        members = np.zeros(count, dtype=np.int64)
        for number, own in enumerate(rows):
            members[own] = number
        return cls(tuple(tracked), members)

    @property
    def count(self) -> int:
        """Number of modes."""
        return len(self.tracked)

    def number(self, particle: int) -> int:
        """The mode of a particle."""
        return int(self.members[particle])

    def rows(self, number: int) -> Int64:
        """The particles of a mode."""
        return np.flatnonzero(self.members == number)

    def head(self, number: int, leader: int, log_weights: Float64) -> int:
        """The particle from which a mode is matched: the leader or the heaviest."""
        if self.members[leader] == number:
            return leader
        rows = self.rows(number)
        return int(rows[np.argmax(log_weights[rows])])

    def shares(self, log_weights: Float64) -> Float64:
        """The share of each mode in the weights."""
        weights = normalize_weights(log_weights)
        return np.asarray(np.bincount(self.members, weights, minlength=self.count), dtype=np.float64)

    def after_filter_step(self) -> PoseModes:
        """The modes after a filter step."""
        return PoseModes((UNMOVED,) * self.count, self.members)

    def select(self, kept: Sequence[int], members: Int64) -> PoseModes:
        """Some of the modes, of which ``members``, shape (M,), are those of the particles now."""
        rows = [np.flatnonzero(members == number) for number in kept]
        return PoseModes.from_rows(rows, [self.tracked[number] for number in kept], len(members))
