"""Whether a landmark of the map is there: its probability by all visits, and when it is deleted.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: where a landmark is seen again, what the map believes of it is
averaged with the extraction confidence p_l, Eq. (4); where it should be seen and is not, 1 - p_lmap takes the place of
p_l, Eq. (5); below a minimum it is deleted. Taken literally that never falls below 1/2, however often a landmark is
missed, and what was seen often has to be missed about as often before anything shows.

Two things are in doubt. Whether what was extracted is a landmark at all: scans that show it again say the same again,
and what is none is seen again as surely (94 % of the time where 98 % of the true ones are, on training seeds). So that
stays the mean of p_l over the scans that showed it, Eq. (4). And whether it is still there, r, in a world that changes:
it was still there after one more visit with probability p_S, is seen with p_D if it is, and with p_F if it is not,

    r- = p_S r
    r  = p_D r- / (p_D r- + p_F (1 - r-))                          where it is seen,
    r  = (1 - p_D) r- / ((1 - p_D) r- + (1 - p_F) (1 - r-))        where it is missed, instead of Eq. (5).

As r- is p_S at most, a few misses suffice for what was seen a hundred times. Doors are closed and furniture is moved
while nobody looks rather than between two scans: at the first look after an absence r- is p_A p_S r, so that one look
may suffice. p_lmap is the product of the two.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from hmt_slam_ros.configuration.features import Features


@dataclass(frozen=True)
class Existence:
    """What is known of whether something is there.

    :ivar confidence: mean of the extraction confidences, in [0, 1].
    :ivar presence: r, the probability that it is still there, in [0, 1].
    :ivar seen: at how many visits it was seen, 1 or more.
    :ivar missed: at how many it should have been and was not.
    :ivar away: whether the robot was away since.
    """

    confidence: float
    presence: float = 1.0
    seen: int = 1
    missed: int = 0
    away: bool = False

    @property
    def probability(self) -> float:
        """p_lmap, in [0, 1]."""
        return self.confidence * self.presence

    def after_sight(self, confidence: float, features: Features) -> Existence:
        """It was seen, with an extraction confidence p_l."""
        seen = self.seen + 1
        mean = self.confidence + (confidence - self.confidence) / seen  # Eq. (4)
        presence = self._present(features.landmark_detected, features.landmark_by_chance, features)
        return replace(self, confidence=mean, presence=presence, seen=seen, away=False)

    def after_miss(self, features: Features) -> Existence:
        """It should have been seen and was not."""
        presence = self._present(1.0 - features.landmark_detected, 1.0 - features.landmark_by_chance, features)
        return replace(self, presence=presence, missed=self.missed + 1, away=False)

    def after_absence(self) -> Existence:
        """Nobody looked for a while."""
        return replace(self, away=True)

    def _present(self, likelihood: float, otherwise: float, features: Features) -> float:
        """Bayes' rule, for something that is there or not."""
        lasting = features.landmark_lasting * (features.landmark_lasting_away if self.away else 1.0)
        prior = lasting * self.presence
        return likelihood * prior / (likelihood * prior + otherwise * (1.0 - prior))
