"""The evidence of scans for a kidnapping before one of them.

After an ordinary motion it is the CUSUM statistic, as the scans themselves show the onset (Page 1954,
docs/decisions/0026-kidnapping-detection.md). After a fault of odometry or a gap of scans it is the likelihood ratio
since then: a robot in a similar place shows it only where that place ends (docs/decisions/0068-after-a-gap.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

CUSUM_DRIFT = 1.0
"""Drift of the CUSUM statistic per keyframe, nats: people contradict the map in several keyframes.

From docs/decisions/0026-kidnapping-detection.md.
"""

EVIDENCE_WINDOW = 30
"""Keyframe events for which evidence of a kidnapping is kept."""

_SIMILARITY_END = 0.1
"""Probability per keyframe event that the surroundings stop to look similar: they do so for 5 m."""


def cusum_since(evidence: Mapping[int, float], first: int) -> float:
    """The CUSUM statistic of the scans from an event on, nats.

    :param evidence: {keyframe event: increment, nats}.
    """
    return sum(nats for event, nats in evidence.items() if event >= first)


def log_displacement_ratio(evidence: Mapping[int, float], first: int, similar: float) -> float:
    """log p(scans | displaced before an event) / p(scans | not displaced), nats.

    A displaced robot is in a similar place, where its scans are as probable as without a displacement, until that ends
    (hidden Markov model, Rabiner 1989, forward algorithm). So scans that agree say no more than that places may be
    similar, however many there are.

    :param evidence: {keyframe event: CUSUM increment, nats}, in order.
    :param first: the event.
    :param similar: probability that the robot was put into a similar place.
    """
    log_similar, log_different = math.log(similar), math.log1p(-similar)
    for event, nats in evidence.items():
        if event < first:
            continue
        if event > first:
            log_different = float(np.logaddexp(log_different, log_similar + math.log(_SIMILARITY_END)))
            log_similar += math.log1p(-_SIMILARITY_END)
        log_different += nats + CUSUM_DRIFT
    return float(np.logaddexp(log_similar, log_different))
