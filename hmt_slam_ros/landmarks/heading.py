"""The robot's heading between the walls of a building, after Tomatis, Nourbakhsh and Siegwart (2003), section 3.3.

Walls are parallel or square to each other, so that every line tells the heading up to quarters of a turn, and odometry
tells which of the four: an extended Kalman filter over the heading alone, which needs no map and never drifts. Of what
it does not know, the noise of the lines averages out, and how far walls are from being square does not: that is the
same when they are seen again, and is kept apart.
"""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.sensors.motion_model import RelativeMotion

QUARTER_TURN = 0.5 * math.pi
"""Between two headings from which walls look the same, rad."""


class BuildingHeading:
    """The heading in a frame along whose axes the walls run; unknown until the first lines are seen.

    The axis that the robot is nearest to then is x.

    :ivar angle: rad, from 0 on without wrapping, nan while it is unknown.
    """

    def __init__(self, features: FeatureParameters) -> None:
        self._gate = chi_square_gate(features.pair_probability, 1)
        self._wall_variance = math.radians(features.square_deviation) ** 2
        self.angle = math.nan
        self._line_variance, self._squareness_variance = 0.0, 0.0

    @property
    def is_known(self) -> bool:
        """Whether lines were seen."""
        return not math.isnan(self.angle)

    @property
    def variance(self) -> float:
        """Of the angle, rad^2."""
        return self._line_variance + self._squareness_variance

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self.angle += float(step.increment[2])
        self._line_variance += float(step.covariance[2, 2])

    def observe(self, lines: Lines) -> int:
        """Correct the heading by the lines that are along or across the building.

        :returns: how many these are.
        """
        alphas, noise = lines.parameters[:, 0], lines.covariances[:, 0, 0]
        before = self.variance
        if not self.is_known:
            if not len(lines):
                return 0
            k = _consensus_line(alphas, noise + self._wall_variance)
            self.angle, before = float(_wrap_to_quarter(-alphas[k])), float(noise[k])
            self._line_variance = QUARTER_TURN**2
        differences = _wrap_to_quarter(-alphas - self.angle)
        # Eq. (2), n = 1.
        used = differences**2 <= self._gate * (noise + self._wall_variance + before)
        if used.any():
            self._correct(differences[used], noise[used])
        return int(used.sum())

    def _correct(self, differences: Float64, noise: Float64) -> None:
        """By the weighted mean of what lines tell of the heading, rad, which differ in their noise, rad^2."""
        weights = 1.0 / (noise + self._wall_variance)
        weights /= weights.sum()
        together = float(weights**2 @ noise)
        gain = self._line_variance / (self._line_variance + together)
        self.angle += gain * float(weights @ differences)
        self._line_variance *= 1.0 - gain
        self._squareness_variance = self._wall_variance * float(weights @ weights)


def _consensus_line(alphas: Float64, variances: Float64) -> int:
    """The line with which most others agree, the longest counting most."""
    apart = _wrap_to_quarter(alphas[:, None] - alphas[None, :])
    agreeing = np.exp(-0.5 * apart**2 / (variances[:, None] + variances[None, :])) / np.sqrt(variances)
    return int(agreeing.sum(axis=1).argmax())


def _wrap_to_quarter(angles: Float64) -> Float64:
    """Angles up to quarters of a turn, in [-pi/4, pi/4)."""
    return (angles + 0.5 * QUARTER_TURN) % QUARTER_TURN - 0.5 * QUARTER_TURN
