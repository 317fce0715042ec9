"""The distribution of a lost robot's pose over candidates in the map and unmapped ground; whether it is localized."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate

UNMAPPED_PRIOR = 0.2
"""Prior probability that a lost robot is on unmapped ground (docs/decisions/0025-global-localization.md)."""

MIN_PROBABILITY = 1e-300
"""Smallest probability that is not 0, for logarithms."""


class PoseDistribution(NamedTuple):
    """The probability of every pose candidate; the rest is unmapped ground.

    :ivar candidates: ways in which the robot's keyframes lie in the map.
    :ivar probabilities: shape (len(candidates),).
    """

    candidates: tuple[PoseCandidate, ...]
    probabilities: Float64

    @property
    def best(self) -> tuple[PoseCandidate, float] | None:
        """The most probable candidate and its probability."""
        if not self.candidates:
            return None
        n = int(self.probabilities.argmax())
        return self.candidates[n], float(self.probabilities[n])

    def reweight(self, log_weights: Sequence[float] | Float64) -> PoseDistribution:
        """The distribution after more evidence for every candidate, relative to unmapped ground, nats."""
        unmapped = max(1.0 - float(self.probabilities.sum()), MIN_PROBABILITY)
        logs = np.log(np.maximum(self.probabilities, MIN_PROBABILITY)) + log_weights
        shift = max(0.0, float(logs.max(initial=0.0)))
        weights = np.exp(logs - shift)
        return PoseDistribution(self.candidates, weights / (weights.sum() + unmapped * math.exp(-shift)))

    def with_unmapped_prior(self, prior: float) -> PoseDistribution:
        """The distribution for another prior of unmapped ground than ``UNMAPPED_PRIOR``."""
        weights = (1.0 - prior) / prior * UNMAPPED_PRIOR / (1.0 - UNMAPPED_PRIOR) * self.probabilities
        unmapped = max(0.0, 1.0 - float(self.probabilities.sum()))
        return PoseDistribution(self.candidates, weights / max(unmapped + float(weights.sum()), MIN_PROBABILITY))

    def with_false_alarm(self, at_tracked_pose: Bool, probability: float, areas: int) -> PoseDistribution:
        """The distribution for a robot that may not have been moved.

        At the tracked pose its scans are as likely as on new ground at least, since furniture may have been moved.

        :param at_tracked_pose: which candidates are the tracked pose, shape (len(candidates),).
        :param probability: that the robot was not moved.
        :param areas: number of known areas, over which the prior of a moved robot is flat.
        """
        unmapped = max(1.0 - float(self.probabilities.sum()), MIN_PROBABILITY)
        moved = UNMAPPED_PRIOR / unmapped * self.probabilities
        stayed = np.where(at_tracked_pose, areas / (1.0 - UNMAPPED_PRIOR) * moved, 0.0)
        weights = (1.0 - probability) * moved + probability * stayed
        rest = (1.0 - probability) * UNMAPPED_PRIOR + probability * max(0.0, 1.0 - float(stayed.sum()))
        return PoseDistribution(self.candidates, weights / (rest + weights.sum()))


class LocalizationStatus(NamedTuple):
    """Whether the robot is localized.

    :ivar localized: whether the hypotheses are improbable under which it is lost, or elsewhere.
    :ivar entropy: of the belief over the robot's area, nats; 0 where it is certain.
    """

    localized: bool
    entropy: float


def summarize_localization(
    area_probabilities: Mapping[int, float],
    lost: float,
    unexamined: float,
    known: int,
    distribution: PoseDistribution | None,
    max_lost_probability: float,
    elsewhere: float = 0.0,
) -> LocalizationStatus:
    """The localization status of all hypotheses together.

    :param area_probabilities: {area: probability that a tracked robot is in it}.
    :param lost: probability of the lost hypotheses.
    :param unexamined: probability that no hypothesis is right.
    :param known: number of areas in which a lost robot can be.
    :param distribution: of the pose of a lost robot; None before the first search.
    :param max_lost_probability: largest probability of the lost hypotheses of a localized robot, and of those under
        which it is elsewhere.
    :param elsewhere: probability of tracked hypotheses under which the robot is in another place than under the most
        probable one.
    """
    lost_areas = [lost * probability for probability in _lost_distribution(known, distribution)]
    probabilities = np.array([*area_probabilities.values(), *lost_areas, unexamined])
    probabilities = probabilities[probabilities > 0.0]
    entropy = abs(float(probabilities @ np.log(probabilities)))
    return LocalizationStatus(lost + elsewhere <= max_lost_probability, entropy)


def _lost_distribution(known: int, distribution: PoseDistribution | None) -> list[float]:
    """The probability of every area and, last, of unmapped ground."""
    if distribution is None:
        return [*[(1.0 - UNMAPPED_PRIOR) / max(1, known)] * known, UNMAPPED_PRIOR if known else 1.0]
    areas: dict[int, float] = {}
    for candidate, probability in zip(distribution.candidates, distribution.probabilities.tolist(), strict=True):
        areas[candidate.area] = areas.get(candidate.area, 0.0) + probability
    return [*areas.values(), max(0.0, 1.0 - sum(areas.values()))]
