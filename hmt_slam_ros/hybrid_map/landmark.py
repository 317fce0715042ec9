"""Landmarks of an area, and the probability that they exist.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3: at a detection, the map's belief p_lmap is averaged with the
extraction confidence p_l, Eq. (4). At a miss, 1 - p_lmap takes the place of p_l, Eq. (5). Taken literally the belief
then never falls below 1/2, and a landmark that was seen often has to be missed about as often before that shows.

Here p_lmap is the product of two probabilities. That the detections were of a landmark at all is the mean of p_l,
Eq. (4): false ones are detected again as surely as true ones. That it is still there, r, follows from a world that
changes, with p_S that it stays until the next visit, and p_D and p_F that it is detected if it is there or is not:

    r- = p_S r
    r  = p_D r- / (p_D r- + p_F (1 - r-))                          at a detection,
    r  = (1 - p_D) r- / ((1 - p_D) r- + (1 - p_F) (1 - r-))        at a miss, instead of Eq. (5).

As r- is p_S at most, a few misses suffice for a landmark that was seen a hundred times. Doors close while nobody looks
rather than between two scans, so that r- is p_A p_S r at the first visit after an absence.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import PoseGaussian


@dataclass(frozen=True)
class Existence:
    """The existence of a landmark.

    :ivar confidence: mean of the extraction confidences, in [0, 1].
    :ivar presence: r, the probability that it is still there, in [0, 1].
    :ivar detections: number of visits at which it was detected, 1 or more.
    :ivar misses: number of visits at which it should have been and was not.
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
        """The existence after a detection, with an extraction confidence p_l."""
        detections = self.detections + 1
        mean = self.confidence + (confidence - self.confidence) / detections  # Eq. (4)
        presence = self._update_presence(features.landmark_detected, features.landmark_by_chance, features)
        return replace(self, confidence=mean, presence=presence, detections=detections, robot_was_away=False)

    def update_on_miss(self, features: FeatureParameters) -> Existence:
        """The existence after a miss."""
        presence = self._update_presence(1.0 - features.landmark_detected, 1.0 - features.landmark_by_chance, features)
        return replace(self, presence=presence, misses=self.misses + 1, robot_was_away=False)

    def mark_absence(self) -> Existence:
        """The existence after an absence of the robot."""
        return replace(self, robot_was_away=True)

    def _update_presence(self, likelihood: float, otherwise: float, features: FeatureParameters) -> float:
        """The presence by Bayes' rule.

        :param likelihood: of the observation if the landmark is there; ``otherwise`` if it is not.
        """
        survival = features.landmark_lasting * (features.landmark_lasting_away if self.robot_was_away else 1.0)
        prior = survival * self.presence
        return likelihood * prior / (likelihood * prior + otherwise * (1.0 - prior))


@dataclass(frozen=True, eq=False)
class Landmark:
    """A landmark of an area.

    :ivar kind: ``INNER``, ``OUTER`` or ``OPENING`` of `landmarks.landmarks`.
    :ivar pose: the belief over its pose in the area's frame; that of an opening is the middle between its jambs, with
        the heading through it, away from the robot.
    :ivar width: of an opening, m; 0 of a corner.
    :ivar width_deviation: of this, m.
    :ivar existence: whether it is there.
    :ivar scatter: shape (3, 3), sum of the squares of its observations about their mean, each in deviations.
    :ivar scan_covariance_share: shape (3, 3), mean part of their covariances that is the scans' own, in deviations.
    """

    kind: int
    pose: PoseGaussian
    width: float
    width_deviation: float
    existence: Existence
    scatter: Float64 = field(default_factory=lambda: np.zeros((3, 3)))
    scan_covariance_share: Float64 = field(default_factory=lambda: np.zeros((3, 3)))

    def pose_from_scatter(self, ratio: Float64) -> PoseGaussian:
        """The belief over its pose, with the covariance scaled by the scatter of its n observations.

        The area's ratio counts as one more observation. Errors of n scans average out; those of the robot's poses may
        be common to all, and do not.

        :param ratio: of its area, see `scatter_ratio`.
        """
        n = self.existence.detections
        root = np.linalg.cholesky(self.pose.covariance) @ np.linalg.cholesky((ratio + self.scatter) / n)
        return PoseGaussian(self.pose.mean, root @ (np.eye(3) - (1.0 - 1.0 / n) * self.scan_covariance_share) @ root.T)
