"""Bounds of squared Mahalanobis distances."""

from __future__ import annotations

from scipy.special import gammaincinv

_OF_A_POSE = 3


def gate(probability: float, degrees_of_freedom: int = _OF_A_POSE) -> float:
    """The bound below which the squared Mahalanobis distance of true pairs stays with this probability.

    It is the quantile of chi-square. scipy.stats, which has it too, takes half a second and 45 MB to load.

    :param degrees_of_freedom: those of a pose unless others are given.
    """
    return 2.0 * float(gammaincinv(0.5 * degrees_of_freedom, probability))
