"""Says in words when odometry contradicts the scans, or is noisier than its model: once for each occasion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.motion_model import NO_MOTION, NOISY_FACTOR, OdometryNoise, RelativeMotion
from hmt_slam_ros.submap.local_filter import TrackedMotion

# An episode ends when for so long the scans contradicted no more, s.
_QUIET = 1.0
# Time between two sentences at least, s.
_PAUSE = 60.0
# A smaller difference over a whole episode is one of stamps, made up for by the next readings.
_DISTANCE, _ANGLE = 0.2, math.radians(10.0)
# An episode goes on while the headings part by more than this from scan to scan.
_GROWTH = math.radians(1.0)
_SECOND = 1e-9


@dataclass(frozen=True, eq=False)
class OdometryDisagreement:
    """From the first contradicted scan until odometry and scans go on alike.

    :ivar begin: stamp of the scan before the first one, ns.
    :ivar last_contradiction: stamp of the last contradicted scan, ns.
    :ivar end: stamp of the scan by which their headings had parted, ns.
    :ivar odometry_motion: the motion from ``begin`` to ``end`` by odometry, shape (3,), m and rad.
    :ivar scan_motion: the same by the scans.
    :ivar odometry_motion_now: the motion from ``begin`` to the last scan by odometry, shape (3,), m and rad.
    :ivar scan_motion_now: the same by the scans.
    """

    begin: int
    last_contradiction: int
    end: int
    odometry_motion: Float64
    scan_motion: Float64
    odometry_motion_now: Float64
    scan_motion_now: Float64

    @classmethod
    def from_stamp(cls, begin: int) -> OdometryDisagreement:
        """One in which nothing was heard yet."""
        return cls(begin, begin, begin, *[NO_MOTION.increment] * 4)

    def extend(self, stamp: int, step: RelativeMotion, tracked: TrackedMotion) -> OdometryDisagreement:
        """With one scan more."""
        odometry = se2.compose(self.odometry_motion_now, step.increment)
        scans = se2.compose(self.scan_motion_now, tracked.increment)
        last = stamp if tracked.contradicts_odometry else self.last_contradiction
        if (
            tracked.contradicts_odometry
            or _motion_difference(odometry, scans)[1]
            > _motion_difference(self.odometry_motion, self.scan_motion)[1] + _GROWTH
        ):
            return OdometryDisagreement(self.begin, last, stamp, odometry, scans, odometry, scans)
        return OdometryDisagreement(self.begin, last, self.end, self.odometry_motion, self.scan_motion, odometry, scans)

    def is_significant(self) -> bool:
        """Whether odometry was wrong altogether, not early or late."""
        distance, angle = _motion_difference(self.odometry_motion, self.scan_motion)
        return distance >= _DISTANCE or angle >= _ANGLE


@dataclass(frozen=True, eq=False)
class OdometryMonitorState:
    """What was heard of odometry and scans, and what was said of it.

    :ivar last_stamp: stamp of the last scan, ns.
    :ivar disagreement: the one that is open.
    :ivar last_notice: when the last one ended of which something was said, s, None where nothing was said.
    :ivar unreported: those since then of which nothing was said.
    :ivar noise_reported: whether it was said that odometry is noisy.
    """

    last_stamp: int = 0
    disagreement: OdometryDisagreement | None = None
    last_notice: float | None = None
    unreported: int = 0
    noise_reported: bool = False


class OdometryMonitor:
    """Collects what odometry and scans say while they contradict each other."""

    def __init__(self, state: OdometryMonitorState | None = None) -> None:
        """:param state: to go on from."""
        self._state = state or OdometryMonitorState()

    @property
    def state(self) -> OdometryMonitorState:
        """All that was heard and said."""
        return self._state

    def add_scan(self, stamp: int, step: RelativeMotion | None, tracked: TrackedMotion) -> str | None:
        """Take note of a scan; the sentence about an episode that is over, if there is one.

        :param stamp: of the scan, ns.
        :param step: odometry's motion since the scan before, None where it is unknown.
        """
        episode = self._state.disagreement
        if tracked.contradicts_odometry and episode is None:
            episode = OdometryDisagreement.from_stamp(self._state.last_stamp)
        self._state = replace(self._state, last_stamp=stamp, disagreement=episode)
        if episode is None:
            return None
        lasts = tracked.contradicts_odometry or (stamp - episode.last_contradiction) * _SECOND <= _QUIET
        if step is None or not lasts:
            return self.end_disagreement()
        self._state = replace(self._state, disagreement=episode.extend(stamp, step, tracked))
        return None

    def end_disagreement(self) -> str | None:
        """The sentence about the episode that is open, if it matters and none was said of late."""
        episode, self._state = self._state.disagreement, replace(self._state, disagreement=None)
        if episode is None or not episode.is_significant():
            return None
        last, unreported = self._state.last_notice, self._state.unreported
        if last is not None and episode.end * _SECOND - last < _PAUSE:
            self._state = replace(self._state, unreported=unreported + 1)
            return None
        since = f" ({unreported} times more since it was last said)" if unreported else ""
        self._state = replace(self._state, last_notice=episode.end * _SECOND, unreported=0)
        return (
            f"odometry {_motion_text(episode.odometry_motion)} from {episode.begin * _SECOND:.3f} s to "
            f"{episode.end * _SECOND:.3f} s, where the scans say that it {_motion_text(episode.scan_motion)}{since}: "
            "the scans are believed; look for slipping wheels and late stamps."
        )

    def check_noise(self, noise: OdometryNoise) -> str | None:
        """The sentence about odometry that is much noisier than its model, once."""
        translation, rotation = noise.factors
        if self._state.noise_reported or max(translation, rotation) < NOISY_FACTOR:
            return None
        self._state = replace(self._state, noise_reported=True)
        return (
            f"odometry and scans differ {translation:.1f} times as much in distance and {rotation:.1f} times as much "
            "in heading as the noise model of odometry expects, so it is trusted less: raise "
            "motion.rotation_from_rotation and its neighbors if it stays so."
        )


def _motion_difference(odometry: Float64, scans: Float64) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two motions."""
    difference = se2.between(odometry, scans)
    return math.hypot(difference[0], difference[1]), abs(float(difference[2]))


def _motion_text(increment: Float64) -> str:
    distance = math.hypot(increment[0], increment[1])
    return f"turned by {math.degrees(increment[2]):.0f} degrees and went {distance:.2f} m"
