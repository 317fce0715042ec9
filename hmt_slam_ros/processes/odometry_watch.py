"""Says in words when odometry contradicts the scans, or is noisier than its model: once for each occasion."""

from __future__ import annotations

import math

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.local_map.tracking import Tracked
from hmt_slam_ros.sensing.motion import NO_STEP, OdometryNoise, Prediction

# An episode ends when for so long the scans contradicted no more, s.
_QUIET = 1.0
# Time between two sentences at least, s.
_PAUSE = 60.0
# A smaller difference over a whole episode is one of stamps, made up for by the next readings.
_DISTANCE, _ANGLE = 0.1, math.radians(5.0)
# Noise beyond this many times the model's is said.
_NOISY = 2.0
_SECOND = 1e-9


class OdometryWatch:
    """Collects what odometry and scans say while they contradict each other."""

    def __init__(self) -> None:
        self._begin: int | None = None
        self._last = 0
        self._odometry: Float64 = NO_STEP.increment
        self._scans: Float64 = NO_STEP.increment
        self._told = -math.inf
        self._untold = 0
        self._noise_told = False

    def hear(self, stamp: int, prediction: Prediction, tracked: Tracked) -> str | None:
        """Take note of a scan; the sentence about an episode that is over, if there is one.

        :param stamp: of the scan, ns.
        """
        if tracked.contradicted:
            if self._begin is None:
                self._begin, self._odometry, self._scans = stamp, NO_STEP.increment, NO_STEP.increment
            self._last = stamp
        if self._begin is None:
            return None
        if prediction.odometry is not None and (stamp - self._last) * _SECOND <= _QUIET:
            self._odometry = se2.compose(self._odometry, prediction.odometry.increment)
            self._scans = se2.compose(self._scans, tracked.moved)
            return None
        begin, self._begin = self._begin, None
        return self._sentence(begin)

    def _sentence(self, begin: int) -> str | None:
        difference = se2.between(self._odometry, self._scans)
        if math.hypot(difference[0], difference[1]) < _DISTANCE and abs(difference[2]) < _ANGLE:
            return None
        if self._last * _SECOND - self._told < _PAUSE:
            self._untold += 1
            return None
        since = f" ({self._untold} times more since it was last said)" if self._untold else ""
        self._told, self._untold = self._last * _SECOND, 0
        return (
            f"odometry {_motion(self._odometry)} from {begin * _SECOND:.3f} s to {self._last * _SECOND:.3f} s, where "
            f"the scans say that it {_motion(self._scans)}{since}: the scans are believed; look for slipping wheels "
            "and late stamps."
        )

    def judge(self, noise: OdometryNoise) -> str | None:
        """The sentence about odometry that is much noisier than its model, once."""
        translation, rotation = noise.factors
        if self._noise_told or max(translation, rotation) < _NOISY:
            return None
        self._noise_told = True
        return (
            f"odometry differs from the scans {translation:.1f} times as much in distance and {rotation:.1f} times as "
            "much in heading as its noise model expects, and is trusted less: raise "
            "motion.translation_from_translation and its neighbours if it stays so."
        )


def _motion(increment: Float64) -> str:
    distance = math.hypot(increment[0], increment[1])
    return f"turned by {math.degrees(increment[2]):.0f} degrees and went {distance:.2f} m"
