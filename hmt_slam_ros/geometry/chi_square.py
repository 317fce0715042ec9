"""Bounds of squared Mahalanobis distances between poses."""

from __future__ import annotations

from scipy.special import gammaincinv

_DEGREES_OF_FREEDOM = 3


def gate(probability: float) -> float:
    """The bound below which ``PoseGaussian.mahalanobis2`` of true pairs stays with this probability.

    It is the quantile of chi-square. scipy.stats, which has it too, takes half a second and 45 MB to load.
    """
    return 2.0 * float(gammaincinv(0.5 * _DEGREES_OF_FREEDOM, probability))
