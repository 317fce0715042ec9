"""Gaussian beliefs over SE(2): compose, invert, fuse, gate.

A covariance lives in the right tangent space of its mean: T = mean * exp(xi), xi ~ N(0, covariance), in the order
(v_x, v_y, omega), m and rad. Propagation is first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2

_POSE_DOF = 3
"""Degrees of freedom of a pose."""


def chi_square_gate(probability: float, degrees_of_freedom: int = _POSE_DOF) -> float:
    """The quantile of chi-square: squared Mahalanobis distances of true pairs are below it with this probability.

    scipy.stats has it too, but takes half a second and 45 MB to load.
    """
    return 2.0 * float(gammaincinv(0.5 * degrees_of_freedom, probability))


ELLIPSE_95 = 2.4477
"""Half axes of the 95 % ellipse of a position, in standard deviations: the root of chi-square's quantile, 2 dof."""


class Ellipse(NamedTuple):
    """An ellipse around a position.

    :ivar semi_major: longer half axis, m.
    :ivar semi_minor: shorter half axis, m.
    :ivar angle: of the longer axis, rad.
    """

    semi_major: float
    semi_minor: float
    angle: float


@dataclass(frozen=True, eq=False, slots=True)
class PoseGaussian:
    """N(mean, covariance) over the poses ``a_T_b``.

    :ivar mean: shape (3,), (x, y, theta), m and rad.
    :ivar covariance: shape (3, 3), right tangent frame.
    """

    mean: Float64
    covariance: Float64

    @classmethod
    def from_pose(cls, pose: Float64) -> PoseGaussian:
        """A belief without uncertainty, in the pose (3,)."""
        return cls(pose, np.zeros((3, 3)))

    def inverse(self) -> PoseGaussian:
        """The belief over ``b_T_a``."""
        ad = se2.adjoint(self.mean)
        return PoseGaussian(se2.inverse(self.mean), ad @ self.covariance @ ad.T)

    def compose(self, other: PoseGaussian) -> PoseGaussian:
        """The belief over ``a_T_c``, from independent beliefs over ``a_T_b`` and ``b_T_c``."""
        ad = se2.adjoint(se2.inverse(other.mean))
        return PoseGaussian(
            se2.compose(self.mean, other.mean),
            ad @ self.covariance @ ad.T + other.covariance,
        )

    def position_ellipse(self) -> Ellipse:
        """The 95 % ellipse of the position of b, in the axes of a."""
        sin, cos = math.sin(self.mean[2]), math.cos(self.mean[2])
        turn = np.array([[cos, -sin], [sin, cos]])
        values, vectors = np.linalg.eigh(turn @ self.covariance[:2, :2] @ turn.T)
        shorter, longer = (ELLIPSE_95 * np.sqrt(np.maximum(values, 0.0))).tolist()
        return Ellipse(longer, shorter, math.atan2(vectors[1, 1], vectors[0, 1]))

    def mahalanobis2(self, other: PoseGaussian) -> float:
        """Squared Mahalanobis distance between two independent beliefs over the same pose; chi-square with 3 dof.

        The difference is taken on the manifold, so the value does not depend on the frame.
        """
        xi = se2.log(se2.between(self.mean, other.mean))
        ad = se2.adjoint(se2.between(other.mean, self.mean))
        spread = self.covariance_at(other.mean, ad) + other.covariance
        return float(xi @ np.linalg.solve(spread, xi))

    def covariance_at(self, mean: Float64, ad: Float64 | None = None) -> Float64:
        """This belief's covariance, shape (3, 3), in the tangent space of the nearby pose ``mean``, (3,)."""
        ad = se2.adjoint(se2.between(mean, self.mean)) if ad is None else ad
        return ad @ self.covariance @ ad.T


def fuse(beliefs: list[PoseGaussian], iterations: int = 10) -> PoseGaussian:
    """The normalized product of independent Gaussians over the same pose, Eq. (10).

    Gauss-Newton on the manifold, started at the first mean. The result depends neither on the order of the beliefs nor
    on the direction of the poses.

    :raises numpy.linalg.LinAlgError: where a covariance is singular.
    """
    mean = beliefs[0].mean
    covariance = beliefs[0].covariance
    for _ in range(iterations):
        information, vector = np.zeros((3, 3)), np.zeros(3)
        for belief in beliefs:
            residual = se2.log(se2.between(belief.mean, mean))
            jacobian = se2.right_jacobian_inverse(residual)
            weighted = jacobian.T @ np.linalg.inv(belief.covariance)
            information += weighted @ jacobian
            vector -= weighted @ residual
        covariance = np.linalg.inv(information).astype(np.float64, copy=False)
        step = covariance @ vector
        mean = se2.compose(mean, se2.exp(step))
        if np.abs(step).max() < 1e-12:
            break
    return PoseGaussian(mean, covariance)


def match_moments(weighted: Sequence[tuple[PoseGaussian, float]]) -> PoseGaussian:
    """The second moment of several beliefs about the mean of the heaviest.

    :param weighted: every belief with the log of its weight, at least one.
    """
    total = np.logaddexp.reduce([log_weight for _, log_weight in weighted])
    mean = max(weighted, key=lambda pair: pair[1])[0].mean
    covariance = np.zeros((3, 3))
    for belief, log_weight in weighted:
        offset = se2.log(se2.between(mean, belief.mean))
        covariance += math.exp(log_weight - total) * (belief.covariance_at(mean) + np.outer(offset, offset))
    return PoseGaussian(mean, covariance)
