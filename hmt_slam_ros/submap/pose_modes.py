"""Modes of a pose between which the weights have yet to decide: their particles, their leader, and moments over them.

All particles of a mode move by the match of one of them, its head: the leader, whose pose is the filter's, or the
heaviest. There is one mode, until a match has several. Each then has particles by its mass, and goes by its own map,
until the weights decide: docs/decisions/0050-modes-of-a-match.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import rotate_covariance
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors.relative_motion import NO_MOTION
from hmt_slam_ros.submap.local_filter import TrackedMode
from hmt_slam_ros.submap.scan_matcher import coincide

_UNMOVED = TrackedMode(NO_MOTION, NO_MOTION.covariance)
"""A mode after a filter step."""

_LEAD_MARGIN = 3.0
"""Log-likelihood ratio from which another particle leads, nats: docs/decisions/0006-pose-between-keyframes.md."""


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


def share_out(rows: Int64, head: int, log_masses: Float64) -> list[Int64]:
    """The particles ``rows`` of a mode by the k modes of its match, of which the first keeps the head.

    :param log_masses: shape (k,), of masses that sum to 1, nats.
    """
    ordered = np.concatenate(([head], rows[rows != head]))
    counts = allocate_particles(np.exp(log_masses), len(rows))
    return np.split(ordered, np.cumsum(counts)[:-1])


class MotionMixture(NamedTuple):
    """A motion by each of k modes; its moments are about the leader's motion, in the tangent space there.

    :ivar leading: the motion by the leader's mode, shape (3,).
    :ivar motions: by all modes, shape (k, 3).
    :ivar shares: of the modes, shape (k,), sum to 1.
    """

    leading: Float64
    motions: Float64
    shares: Float64

    def spread(self) -> Float64:
        """Second moment of the motions, shape (3, 3)."""
        offsets = se2.log(se2.between(self.leading, self.motions))
        return np.asarray(np.einsum("k,ki,kj->ij", self.shares, offsets, offsets))

    def mix_covariances(self, covariances: Sequence[Float64]) -> Float64:
        """Second moment (3, 3) of k Gaussians about the motions.

        :param covariances: each shape (3, 3), right tangent frame.
        """
        angles = self.motions[:, 2] - self.leading[2]
        turned = [rotate_covariance(own, theta) for own, theta in zip(covariances, angles, strict=True)]
        return np.asarray(np.einsum("k,kij->ij", self.shares, np.array(turned))) + self.spread()

    def mix_errors(self, errors: Sequence[MatchError]) -> MatchError:
        """The error of the leader's motion, from the k errors under each mode."""
        return MatchError(
            self.mix_covariances([error.pose_covariance for error in errors]),
            self.mix_covariances([error.drift_covariance for error in errors]),
            np.einsum("k,kij->ij", self.shares, np.array([error.gain for error in errors])),
        )

    def blur_information(self, information: Float64) -> Float64:
        """Information (3, 3) on the leader's motion, less by the spread."""
        blurred = np.linalg.solve(np.eye(3) + information @ self.spread(), information)
        return np.asarray(0.5 * (blurred + blurred.T))


@dataclass(frozen=True, eq=False)
class PoseModes:
    """The modes of M particles, of which one leads.

    Methods take the number of the leader, and the log-weights of all particles, shape (M,), up to a constant, nats.

    :ivar tracked: what is known of each mode.
    :ivar members: shape (M,), number of the mode of each particle.
    """

    tracked: tuple[TrackedMode, ...]
    members: Int64

    @classmethod
    def single(cls, count: int, residual_covariance: Float64 = _UNMOVED.residual_covariance) -> PoseModes:
        """One mode of all particles, after a filter step."""
        mode = replace(_UNMOVED, residual_covariance=residual_covariance)
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

    def heads(self, leader: int, log_weights: Float64) -> list[int]:
        """The head of each mode."""
        return [self.head(number, leader, log_weights) for number in range(self.count)]

    def shares(self, log_weights: Float64) -> Float64:
        """The share of each mode in the weights."""
        weights = normalize_weights(log_weights)
        return np.asarray(np.bincount(self.members, weights, minlength=self.count), dtype=np.float64)

    def after_filter_step(self) -> PoseModes:
        """The modes after a filter step."""
        return PoseModes((_UNMOVED,) * self.count, self.members)

    def select(self, kept: Sequence[int], members: Int64) -> PoseModes:
        """Some of the modes, of which ``members``, shape (M,), are those of the particles now."""
        rows = [np.flatnonzero(members == number) for number in kept]
        return PoseModes.from_rows(rows, [self.tracked[number] for number in kept], len(members))

    def join_coinciding(self, poses: Float64, leader: int, log_weights: Float64) -> PoseModes:
        """Join modes whose heads are in one basin; of two, the one with the leader or the heavier one remains.

        :param poses: shape (M, 3), of the particles.
        """
        shares, members, own = self.shares(log_weights), self.members, self.number(leader)
        order = sorted(range(self.count), key=lambda number: (number != own, -shares[number]))
        heads, kept = self.heads(leader, log_weights), list[int]()
        for number in order:
            pose = poses[heads[number]]
            into = next((other for other in kept if coincide(pose, poses[heads[other]])), None)
            if into is None:
                kept.append(number)
            else:
                members = np.where(members == number, into, members)
        return self.select(kept, members)

    def end_diverged(self, keyframe_poses: Float64, leader: int, log_weights: Float64) -> tuple[PoseModes, Int64]:
        """The modes whose keyframes lie where the leader's do, and the particle from which each goes on, shape (M,).

        The particles of the other modes go on from the leader.

        :param keyframe_poses: shape (M, K, 3), of the keyframes under each particle.
        """
        sources, kept = np.arange(len(self.members)), list[int]()
        for number, head in enumerate(self.heads(leader, log_weights)):
            pairs = zip(keyframe_poses[head], keyframe_poses[leader], strict=True)
            if all(coincide(pose, leading) for pose, leading in pairs):
                kept.append(number)
            else:
                sources[self.rows(number)] = leader
        return self.select(kept, self.members[sources]), sources

    def elect_leader(self, leader: int, log_weights: Float64) -> int:
        """The particle of largest weight in the heaviest mode; the last mode and leader where none is clearly better.

        Along a corridor all particles fit alike, and the pose would jump from one to the other.
        """
        rows = [self.rows(number) for number in range(self.count)]
        log_shares = np.array([log_sum(log_weights[own]) for own in rows])
        number, own = int(np.argmax(log_shares)), self.number(leader)
        if log_shares[number] - log_shares[own] > _LEAD_MARGIN:
            return self.head(number, leader, log_weights)
        heaviest = int(rows[own][np.argmax(log_weights[rows[own]])])
        return heaviest if log_weights[heaviest] - log_weights[leader] > _LEAD_MARGIN else leader

    def has_refuted(self, log_weights: Float64, least_share: float) -> bool:
        """Whether one of several modes has less than a share of the weights."""
        return self.count > 1 and bool(self.shares(log_weights).min() < least_share)

    def resample(
        self, leader: int, log_weights: Float64, least_share: float, offset: float
    ) -> tuple[Int64, Float64, PoseModes]:
        """Systematic resampling within each mode: ancestors of the M particles, their log-weights, and their modes.

        The leader is kept, and is the first particle afterwards. Other modes of less than ``least_share`` end. The
        remaining ones have particles by their shares, one at least, and weights for the rest.

        :param offset: of the draws, in [0, 1).
        """
        shares, own = self.shares(log_weights), self.number(leader)
        kept = [own] + [number for number in range(self.count) if number != own and shares[number] >= least_share]
        shares = shares[kept] / shares[kept].sum()
        counts, drawn = allocate_particles(shares, len(self.members)), list[Int64]()
        for number, count in zip(kept, counts, strict=True):
            rows = self.rows(number)
            drawn.append(rows[draw_systematically(normalize_weights(log_weights[rows]), count, offset)])
        if leader not in drawn[0]:
            drawn[0][0] = leader
        drawn[0] = drawn[0][np.argsort(drawn[0] != leader, kind="stable")]
        log_weights = np.repeat(np.log(shares / counts), counts)
        modes = PoseModes(tuple(self.tracked[number] for number in kept), np.repeat(np.arange(len(kept)), counts))
        return np.concatenate(drawn), log_weights - log_weights.max(), modes
