"""The prior probability of a kidnapping before a keyframe event, by what the motion to the event rests on.

Each condition of the motion has a Beta prior, and counts of this map: of events, and of kidnappings before them. The
prior of an event is the posterior mean (docs/decisions/0057-displacement-prior.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.messages import MotionCondition

_PRIOR_WEIGHT = 0.5
"""Events that a prior of a rate counts as, as Jeffreys' does (docs/decisions/0057-displacement-prior.md)."""


class EventCounts(NamedTuple):
    """Keyframe events after motions of one condition.

    :ivar events: their number.
    :ivar kidnappings: number of the kidnappings before them.
    """

    events: int = 0
    kidnappings: int = 0


KidnappingCounts = Mapping[MotionCondition, EventCounts]
"""{condition of the motion: counts of this map}."""


def add_counts(
    counts: KidnappingCounts, condition: MotionCondition, *, events: int = 0, kidnappings: int = 0
) -> KidnappingCounts:
    """The counts with more events, or more kidnappings, after motions of one condition."""
    before = counts.get(condition, EventCounts())
    return {**counts, condition: EventCounts(before.events + events, before.kidnappings + kidnappings)}


class KidnappingPriors(NamedTuple):
    """Prior means of rates per keyframe event.

    :ivar kidnapping: of kidnappings.
    :ivar fault: of motions of each condition that is not ordinary, without a kidnapping.
    :ivar aliasing: probability that a robot is put where the map looks as at its tracked pose.
    """

    kidnapping: float
    fault: float
    aliasing: float

    @classmethod
    def from_configuration(cls, configuration: Configuration) -> KidnappingPriors:
        """The priors of a configuration."""
        tsbi = configuration.tsbi
        return cls(tsbi.kidnapping_prior, configuration.motion.fault_probability, tsbi.aliasing_prior)

    def log_odds(self, condition: MotionCondition, counts: KidnappingCounts) -> float:
        """Log-odds of a kidnapping before an event, by the posterior mean.

        :param condition: of the motion to the event, which is counted.
        """
        events, kidnappings = counts.get(condition, EventCounts())
        mean = self.kidnapping if condition == "ordinary" else self._mean_after_fault(events - kidnappings, counts)
        # Beta(a, b), with a = _PRIOR_WEIGHT and the mean a / (a + b).
        others = _PRIOR_WEIGHT * (1.0 - mean) / mean + events - kidnappings
        return math.log(_PRIOR_WEIGHT + kidnappings) - math.log(others)

    def _mean_after_fault(self, faults: int, counts: KidnappingCounts) -> float:
        """The prior mean after motions of one condition, before any kidnapping was counted.

        To the tracker a kidnapping is a fault of odometry or a gap of scans, and so a share of these. The rate of such
        faults is learnt where they are usual; rare ones say no more than those of which none was counted.

        :param faults: number of such motions without a kidnapping.
        """
        total = sum(count.events for count in counts.values())
        rate = max(self.fault, (_PRIOR_WEIGHT + faults) / (_PRIOR_WEIGHT / self.fault + total))
        return self.kidnapping / (self.kidnapping + rate)
