"""Says in words when odometry contradicts the scans, or is noisier than its model: once for each occasion."""

from __future__ import annotations

import math

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.local_map.tracking import Tracked
from hmt_slam_ros.sensing.motion import NO_STEP, NOISY, OdometryNoise, Step

# An episode ends when for so long the scans contradicted no more, s.
_QUIET = 1.0
# Time between two sentences at least, s.
_PAUSE = 60.0
# A smaller difference over a whole episode is one of stamps, made up for by the next readings.
_DISTANCE, _ANGLE = 0.2, math.radians(10.0)
# An episode goes on while the headings part by more than this from scan to scan.
_GROWTH = math.radians(1.0)
_SECOND = 1e-9


class _Episode:
    """From the first contradicted scan until odometry and scans go on alike.

    :ivar begin: stamp of the scan before the first one, ns.
    :ivar last: stamp of the last contradicted scan, ns.
    :ivar end: stamp of the scan by which their headings had parted, ns.
    :ivar odometry: the motion in between by odometry, shape (3,).
    :ivar scans: the same by the scans.
    """

    def __init__(self, begin: int) -> None:
        self.begin = self.last = self.end = begin
        self.odometry = self.scans = self._odometry = self._scans = NO_STEP.increment

    def add(self, stamp: int, step: Step, tracked: Tracked) -> None:
        """Go on by a scan."""
        self._odometry = se2.compose(self._odometry, step.increment)
        self._scans = se2.compose(self._scans, tracked.moved)
        if tracked.contradicted:
            self.last = stamp
        turned, angle = _apart(self._odometry, self._scans)[1], _apart(self.odometry, self.scans)[1]
        if tracked.contradicted or turned > angle + _GROWTH:
            self.end, self.odometry, self.scans = stamp, self._odometry, self._scans

    def matters(self) -> bool:
        """Whether odometry was wrong altogether, not early or late."""
        distance, angle = _apart(self.odometry, self.scans)
        return distance >= _DISTANCE or angle >= _ANGLE


class OdometryWatch:
    """Collects what odometry and scans say while they contradict each other."""

    def __init__(self) -> None:
        self._before = 0
        self._episode: _Episode | None = None
        self._told = -math.inf
        self._untold = 0
        self._noise_told = False

    def hear(self, stamp: int, step: Step | None, tracked: Tracked) -> str | None:
        """Take note of a scan; the sentence about an episode that is over, if there is one.

        :param stamp: of the scan, ns.
        :param step: odometry's motion since the scan before, None where it is unknown.
        """
        before, self._before = self._before, stamp
        if tracked.contradicted and self._episode is None:
            self._episode = _Episode(before)
        if self._episode is None:
            return None
        if step is not None and (tracked.contradicted or (stamp - self._episode.last) * _SECOND <= _QUIET):
            self._episode.add(stamp, step, tracked)
            return None
        return self.close()

    def close(self) -> str | None:
        """The sentence about the episode that is open, if it matters and none was said of late."""
        episode, self._episode = self._episode, None
        if episode is None or not episode.matters():
            return None
        if episode.end * _SECOND - self._told < _PAUSE:
            self._untold += 1
            return None
        since = f" ({self._untold} times more since it was last said)" if self._untold else ""
        self._told, self._untold = episode.end * _SECOND, 0
        return (
            f"odometry {_motion(episode.odometry)} from {episode.begin * _SECOND:.3f} s to "
            f"{episode.end * _SECOND:.3f} s, where the scans say that it {_motion(episode.scans)}{since}: the scans "
            "are believed; look for slipping wheels and late stamps."
        )

    def judge(self, noise: OdometryNoise) -> str | None:
        """The sentence about odometry that is much noisier than its model, once."""
        translation, rotation = noise.factors
        if self._noise_told or max(translation, rotation) < NOISY:
            return None
        self._noise_told = True
        return (
            f"odometry and scans differ {translation:.1f} times as much in distance and {rotation:.1f} times as much "
            "in heading as the noise model of odometry expects, so it is trusted less: raise "
            "motion.rotation_from_rotation and its neighbours if it stays so."
        )


def _apart(odometry: Float64, scans: Float64) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two motions."""
    difference = se2.between(odometry, scans)
    return math.hypot(difference[0], difference[1]), abs(float(difference[2]))


def _motion(increment: Float64) -> str:
    distance = math.hypot(increment[0], increment[1])
    return f"turned by {math.degrees(increment[2]):.0f} degrees and went {distance:.2f} m"
