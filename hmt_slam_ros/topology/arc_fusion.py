"""Fusion of several observations of one arc, Eq. (10), without the confidence that correlated ones would pretend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse

_DEGREES_OF_FREEDOM = 3


def fused(old: PoseGaussian, new: PoseGaussian, shared: float) -> PoseGaussian:
    """The belief over ``a_T_b`` from two traversals of an arc.

    Eq. (10) takes the traversals for independent. Two things speak against it, and both inflate the two covariances:

    * the same scans in both: with all of them shared the factor is 2, and the product of equal beliefs is then no more
      certain than one of them, as in covariance intersection with equal weights;
    * a disagreement beyond what the covariances admit: then at least one of them is too small, and both are scaled by
      their chi-square per degree of freedom (Birge's ratio).

    :param shared: share of the new observation's keyframes that the old one had too, in [0, 1].
    """
    inflation = (1.0 + shared) * max(1.0, old.mahalanobis2(new) / _DEGREES_OF_FREEDOM)
    return fuse([PoseGaussian(belief.mean, inflation * belief.covariance) for belief in (old, new)])  # Eq. (10)


def floored(belief: PoseGaussian, sigma: float, angle: float) -> PoseGaussian:
    """A belief no more certain than the maps that both traversals were matched against.

    :param sigma: smallest deviation of the translation along each axis, m.
    :param angle: smallest deviation of the heading, rad.
    """
    lack = np.array([sigma, sigma, angle]) ** 2 - np.diag(belief.covariance)
    covariance: NDArray[np.float64] = belief.covariance + np.diag(np.maximum(lack, 0.0))
    return PoseGaussian(belief.mean, covariance)
