"""Gaussian beliefs over SE(2): compose, invert, fuse, gate.

A covariance lives in the right tangent space of its mean: T = mean * exp(xi), xi ~ N(0, covariance), in the order
(v_x, v_y, omega), m and rad. Propagation is first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.se2 import inverse_position

Vector: TypeAlias = tuple[float, float, float]

_POSE_DOF = 3
"""Degrees of freedom of a pose."""


_GATES = {(0.95, 3): 7.814727903251179, (0.99, 3): 11.344866730144373, (0.999, 3): 16.26623619623813}
"""{(probability, degrees of freedom): quantile} of what each node needs at its start: scipy takes 0.13 s to load."""


def chi_square_gate(probability: float, degrees_of_freedom: int = _POSE_DOF) -> float:
    """The quantile of chi-square: squared Mahalanobis distances of true pairs are below it with this probability."""
    known = _GATES.get((probability, degrees_of_freedom))
    return chi_square_quantile(probability, degrees_of_freedom) if known is None else known


def chi_square_quantile(probability: float, degrees_of_freedom: int) -> float:
    """The same, computed."""
    # scipy.stats has it too, but takes half a second and 45 MB to load.
    return 2.0 * float(scipy.special.gammaincinv(0.5 * degrees_of_freedom, probability))


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


# Kernels on covariances and information matrices (3, 3), of which every scan needs many: numpy spends its time on calls
# for matrices so small. Kernels that may not take memory for each matrix hold its upper triangle as six numbers.


class Symmetric(NamedTuple):
    """The upper triangle of a symmetric matrix (3, 3) over (x, y, theta)."""

    xx: float
    xy: float
    xt: float
    yy: float
    yt: float
    tt: float


@njit(cache=True)
def symmetric_from_array(matrix: Float64) -> Symmetric:
    """The upper triangle of an array (3, 3)."""
    return Symmetric(matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 1], matrix[1, 2], matrix[2, 2])


@njit(cache=True)
def write_to_array(a: Symmetric, matrix: Float64) -> None:
    """Write the whole matrix into an array (3, 3)."""
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = a.xx, a.yy, a.tt
    matrix[0, 1] = matrix[1, 0] = a.xy
    matrix[0, 2] = matrix[2, 0] = a.xt
    matrix[1, 2] = matrix[2, 1] = a.yt


@njit(cache=True)
def add_scaled(a: Symmetric, b: Symmetric, factor: float) -> Symmetric:
    """a + factor b."""
    return Symmetric(
        a.xx + factor * b.xx,
        a.xy + factor * b.xy,
        a.xt + factor * b.xt,
        a.yy + factor * b.yy,
        a.yt + factor * b.yt,
        a.tt + factor * b.tt,
    )


@njit(cache=True)
def multiply(a: Symmetric, v: Vector) -> Vector:
    """a v."""
    x, y, t = v
    return a.xx * x + a.xy * y + a.xt * t, a.xy * x + a.yy * y + a.yt * t, a.xt * x + a.yt * y + a.tt * t


@njit(cache=True)
def dot(v: Vector, w: Vector) -> float:
    """v' w."""
    return v[0] * w[0] + v[1] * w[1] + v[2] * w[2]


@njit(cache=True)
def sandwich(a: Symmetric, b: Symmetric) -> Symmetric:
    """a b a."""
    x, y, t = (a.xx, a.xy, a.xt), (a.xy, a.yy, a.yt), (a.xt, a.yt, a.tt)
    bx, by, bt = multiply(b, x), multiply(b, y), multiply(b, t)
    return Symmetric(dot(x, bx), dot(x, by), dot(x, bt), dot(y, by), dot(y, bt), dot(t, bt))


@njit(cache=True)
def symmetric_inverse(a: Symmetric) -> Symmetric:
    """The inverse of a positive definite matrix, by cofactors."""
    xx, xy, xt = a.yy * a.tt - a.yt * a.yt, a.yt * a.xt - a.xy * a.tt, a.xy * a.yt - a.yy * a.xt
    scale = 1.0 / (a.xx * xx + a.xy * xy + a.xt * xt)
    yy, yt, tt = a.xx * a.tt - a.xt * a.xt, a.xy * a.xt - a.xx * a.yt, a.xx * a.yy - a.xy * a.xy
    return Symmetric(scale * xx, scale * xy, scale * xt, scale * yy, scale * yt, scale * tt)


@njit(cache=True)
def _decompose(a: Symmetric) -> tuple[Vector, Vector]:
    """L D L' of a positive definite matrix: the diagonal of D, and the entries xy, xt and yt of L."""
    xy, xt = a.xy / a.xx, a.xt / a.xx
    yy = a.yy - xy * a.xy
    yt = (a.yt - xt * a.xy) / yy
    return (a.xx, yy, a.tt - xt * a.xt - yt * yt * yy), (xy, xt, yt)


@njit(cache=True)
def solve(a: Symmetric, v: Vector) -> Vector:
    """a^-1 v for a positive definite matrix, exact also where cofactors would cancel."""
    (xx, yy, tt), (xy, xt, yt) = _decompose(a)
    y = v[1] - xy * v[0]
    t = (v[2] - xt * v[0] - yt * y) / tt
    y = y / yy - yt * t
    return v[0] / xx - xy * y - xt * t, y, t


@njit(cache=True)
def determinant(a: Symmetric) -> float:
    """The determinant of a positive definite matrix."""
    diagonal, _ = _decompose(a)
    return diagonal[0] * diagonal[1] * diagonal[2]


@njit(cache=True)
def matrix_inverse(matrix: Float64) -> Float64:
    """The inverse of a positive definite matrix, by cofactors."""
    result = np.empty((3, 3))
    write_to_array(symmetric_inverse(symmetric_from_array(matrix)), result)
    return result


@njit(cache=True)
def rotate_covariance(matrix: Float64, theta: float) -> Float64:
    """A covariance or information of a frame, in the frame in which its angle is ``theta``, rad."""
    return _apply_adjoint(matrix, 0.0, 0.0, theta)


@njit(cache=True)
def propagate_covariance(covariance: Float64, increment: Float64) -> Float64:
    """The covariance at the end of ``increment`` (3,), from that at its start: Ad^-1 C Ad^-T, right tangent frames."""
    cos, sin = np.cos(increment[2]), np.sin(increment[2])
    x, y = inverse_position(cos, sin, increment[0], increment[1])
    return _apply_adjoint(covariance, x, y, -increment[2])


@njit(cache=True)
def inverse_pose_covariance(covariance: Float64, pose: Float64) -> Float64:
    """The covariance of the inverse of ``pose`` (3,): Ad C Ad^T, right tangent frames."""
    return _apply_adjoint(covariance, pose[0], pose[1], pose[2])


@njit(cache=True)
def _apply_adjoint(covariance: Float64, x: float, y: float, theta: float) -> Float64:
    """Ad C Ad^T for the pose (x, y, theta)."""
    cos, sin = np.cos(theta), np.sin(theta)
    ad = ((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0))
    half = (_row_times(ad[0], covariance), _row_times(ad[1], covariance), _row_times(ad[2], covariance))
    result = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            result[i, j] = half[i][0] * ad[j][0] + half[i][1] * ad[j][1] + half[i][2] * ad[j][2]
    return result


@njit(cache=True)
def _row_times(row: tuple[float, float, float], matrix: Float64) -> tuple[float, float, float]:
    """A row (3,) times a matrix."""
    x, y, z = row
    return (
        x * matrix[0, 0] + y * matrix[1, 0] + z * matrix[2, 0],
        x * matrix[0, 1] + y * matrix[1, 1] + z * matrix[2, 1],
        x * matrix[0, 2] + y * matrix[1, 2] + z * matrix[2, 2],
    )
