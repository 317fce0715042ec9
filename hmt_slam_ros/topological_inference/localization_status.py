"""Whether the robot knows where it is, and how much is open of that: the entropy of the belief over areas."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.topological_inference.global_localization import UNMAPPED_PRIOR, PoseDistribution


class LocalizationStatus(NamedTuple):
    """What is known of the robot's place.

    :ivar localized: whether it is known in all probability.
    :ivar entropy: of the belief over the area that the robot is in, nats; 0 where it is certain.
    """

    localized: bool
    entropy: float


class HypothesisSummary(NamedTuple):
    """A live hypothesis.

    :ivar probability: its own.
    :ivar area: the robot's.
    :ivar lost: whether the robot may be anywhere.
    """

    probability: float
    area: int
    lost: bool


def summarize_localization(
    summaries: Iterable[HypothesisSummary],
    unexamined: float,
    known: int,
    distribution: PoseDistribution | None,
    max_lost_probability: float,
) -> LocalizationStatus:
    """What hypotheses say together.

    :param unexamined: probability that none of them is right.
    :param known: number of areas in which a robot that may be anywhere can be.
    :param distribution: what is known of the place of such a robot, None before it was looked for.
    :param max_lost_probability: probability of lost hypotheses up to which the robot counts as localized.
    """
    areas: dict[int, float] = {}
    lost = 0.0
    for standing in summaries:
        if standing.lost:
            lost += standing.probability
        else:
            areas[standing.area] = areas.get(standing.area, 0.0) + standing.probability
    open_places = [lost * share for share in _lost_distribution(known, distribution)]
    shares = np.array([*areas.values(), *open_places, unexamined])
    shares = shares[shares > 0.0]
    return LocalizationStatus(lost <= max_lost_probability, abs(float(shares @ np.log(shares))))


def _lost_distribution(known: int, distribution: PoseDistribution | None) -> list[float]:
    """The probability of every area and, last, of ground that the map does not hold."""
    if distribution is None:
        return [*[(1.0 - UNMAPPED_PRIOR) / max(1, known)] * known, UNMAPPED_PRIOR if known else 1.0]
    areas: dict[int, float] = {}
    for located, probability in zip(distribution.candidates, distribution.probabilities.tolist(), strict=True):
        areas[located.area] = areas.get(located.area, 0.0) + probability
    return [*areas.values(), max(0.0, 1.0 - sum(areas.values()))]
