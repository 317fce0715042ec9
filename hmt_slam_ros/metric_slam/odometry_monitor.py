"""Says in words when odometry contradicts the scans, or is noisier than its model: once for each occasion."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.motion_model import NO_STEP, NOISY, OdometryNoise, Step
from hmt_slam_ros.submap.local_filter import Tracked

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
class Episode:
    """From the first contradicted scan until odometry and scans go on alike.

    :ivar begin: stamp of the scan before the first one, ns.
    :ivar last: stamp of the last contradicted scan, ns.
    :ivar end: stamp of the scan by which their headings had parted, ns.
    :ivar odometry: the motion from ``begin`` to ``end`` by odometry, shape (3,), m and rad.
    :ivar scans: the same by the scans.
    :ivar odometry_now: the motion from ``begin`` to the last scan by odometry, shape (3,), m and rad.
    :ivar scans_now: the same by the scans.
    """

    begin: int
    last: int
    end: int
    odometry: Float64
    scans: Float64
    odometry_now: Float64
    scans_now: Float64

    @classmethod
    def begun(cls, begin: int) -> Episode:
        """One in which nothing was heard yet."""
        return cls(begin, begin, begin, *[NO_STEP.increment] * 4)

    def and_then(self, stamp: int, step: Step, tracked: Tracked) -> Episode:
        """With one scan more."""
        odometry = se2.compose(self.odometry_now, step.increment)
        scans = se2.compose(self.scans_now, tracked.moved)
        last = stamp if tracked.contradicted else self.last
        if tracked.contradicted or _apart(odometry, scans)[1] > _apart(self.odometry, self.scans)[1] + _GROWTH:
            return Episode(self.begin, last, stamp, odometry, scans, odometry, scans)
        return Episode(self.begin, last, self.end, self.odometry, self.scans, odometry, scans)

    def matters(self) -> bool:
        """Whether odometry was wrong altogether, not early or late."""
        distance, angle = _apart(self.odometry, self.scans)
        return distance >= _DISTANCE or angle >= _ANGLE


@dataclass(frozen=True, eq=False)
class OdometryWatchState:
    """What was heard of odometry and scans, and what was said of it.

    :ivar before: stamp of the last scan, ns.
    :ivar episode: the one that is open.
    :ivar told: when the last one ended of which something was said, s, None where nothing was said.
    :ivar untold: those since then of which nothing was said.
    :ivar noise_told: whether it was said that odometry is noisy.
    """

    before: int = 0
    episode: Episode | None = None
    told: float | None = None
    untold: int = 0
    noise_told: bool = False


class OdometryWatch:
    """Collects what odometry and scans say while they contradict each other."""

    def __init__(self, state: OdometryWatchState | None = None) -> None:
        """:param state: to go on from."""
        state = state or OdometryWatchState()
        self._before, self._episode = state.before, state.episode
        self._told, self._untold, self._noise_told = state.told, state.untold, state.noise_told

    @property
    def state(self) -> OdometryWatchState:
        """All that was heard and said."""
        return OdometryWatchState(self._before, self._episode, self._told, self._untold, self._noise_told)

    def hear(self, stamp: int, step: Step | None, tracked: Tracked) -> str | None:
        """Take note of a scan; the sentence about an episode that is over, if there is one.

        :param stamp: of the scan, ns.
        :param step: odometry's motion since the scan before, None where it is unknown.
        """
        before, self._before = self._before, stamp
        if tracked.contradicted and self._episode is None:
            self._episode = Episode.begun(before)
        if self._episode is None:
            return None
        if step is not None and (tracked.contradicted or (stamp - self._episode.last) * _SECOND <= _QUIET):
            self._episode = self._episode.and_then(stamp, step, tracked)
            return None
        return self.close()

    def close(self) -> str | None:
        """The sentence about the episode that is open, if it matters and none was said of late."""
        episode, self._episode = self._episode, None
        if episode is None or not episode.matters():
            return None
        if self._told is not None and episode.end * _SECOND - self._told < _PAUSE:
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
