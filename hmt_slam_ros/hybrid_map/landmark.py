"""A landmark of an area and the probability that it is there, as values.

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

from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian


@dataclass(frozen=True)
class Existence:
    """What is known of whether something is there.

    :ivar confidence: mean of the extraction confidences, in [0, 1].
    :ivar presence: r, the probability that it is still there, in [0, 1].
    :ivar detections: at how many visits it was seen, 1 or more.
    :ivar misses: at how many it should have been and was not.
    :ivar robot_was_away: whether the robot was away since.
    """

    confidence: float
    presence: float = 1.0
    detections: int = 1
    misses: int = 0
    robot_was_away: bool = False

    @property
    def probability(self) -> float:
        """p_lmap, in [0, 1]."""
        return self.confidence * self.presence

    def update_on_detection(self, confidence: float, features: FeatureParameters) -> Existence:
        """It was seen, with an extraction confidence p_l."""
        seen = self.detections + 1
        mean = self.confidence + (confidence - self.confidence) / seen  # Eq. (4)
        presence = self._update_presence(features.landmark_detected, features.landmark_by_chance, features)
        return replace(self, confidence=mean, presence=presence, detections=seen, robot_was_away=False)

    def update_on_miss(self, features: FeatureParameters) -> Existence:
        """It should have been seen and was not."""
        presence = self._update_presence(1.0 - features.landmark_detected, 1.0 - features.landmark_by_chance, features)
        return replace(self, presence=presence, misses=self.misses + 1, robot_was_away=False)

    def mark_absence(self) -> Existence:
        """Nobody looked for a while."""
        return replace(self, robot_was_away=True)

    def _update_presence(self, likelihood: float, otherwise: float, features: FeatureParameters) -> float:
        """Bayes' rule, for something that is there or not."""
        lasting = features.landmark_lasting * (features.landmark_lasting_away if self.robot_was_away else 1.0)
        prior = lasting * self.presence
        return likelihood * prior / (likelihood * prior + otherwise * (1.0 - prior))


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of an area.

    :ivar kind: ``INNER``, ``OUTER`` or ``OPENING`` of `landmarks.landmarks`.
    :ivar pose: the belief over its pose in the area's frame; that of an opening is the middle between its jambs, with
        the heading through it, away from where it was seen from.
    :ivar width: of an opening, m; 0 of a corner.
    :ivar width_deviation: of this, m.
    :ivar existence: whether it is there.
    :ivar scatter: shape (3, 3), sum of the squares of its sightings about their mean, each in deviations.
    :ivar scan_covariance_share: shape (3, 3), what part of their covariances is the scans' own, in deviations, on
        average.
    """

    kind: int
    pose: PoseGaussian
    width: float
    width_deviation: float
    existence: Existence
    scatter: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    scan_covariance_share: Float64 = field(default_factory=lambda: np.zeros((3, 3)))

    def pose_from_scatter(self, ratio: Float64) -> PoseGaussian:
        """The belief over its pose by how far its sightings are apart.

        What is stated of a sighting is scaled by the scatter of all n, one more being as those of its area. Errors of
        n scans average out; those of the places that they were taken from may be one and the same, and do not.

        :param ratio: of its area, see `scatter_ratio`.
        """
        n = self.existence.detections
        own = np.linalg.cholesky(self.pose.covariance) @ np.linalg.cholesky((ratio + self.scatter) / n)
        return PoseGaussian(self.pose.mean, own @ (np.eye(3) - (1.0 - 1.0 / n) * self.scan_covariance_share) @ own.T)
