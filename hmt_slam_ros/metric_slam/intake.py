"""Scans and odometry on their way into metric SLAM: the queue of scans, their motion, and notices of faults."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from itertools import islice

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import Message, Notice
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import NOISY_FACTOR, MotionModel, MotionState, OdometryNoise, Prediction
from hmt_slam_ros.sensors.odometry import OdometryBuffer
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion
from hmt_slam_ros.sensors.scan import SweepCheck, SweepState
from hmt_slam_ros.submap.local_filter import TrackedMotion

_LATE = 4
"""Factor on the scans that may wait once there was odometry: more than a paced robot sends without acknowledgement."""

_QUIET = 1.0
"""Time without a contradiction that ends a disagreement, s."""

_PAUSE = 60.0
"""Time between two notices of disagreements at least, s."""

_DISTANCE, _ANGLE = 0.2, math.radians(10.0)
"""Difference of the motions over a disagreement from which it is reported, m and rad; less is due to stamps."""

_GROWTH = math.radians(1.0)
"""Growth of the difference in heading from scan to scan above which a disagreement goes on, rad."""

_SECOND = 1e-9


@dataclass(frozen=True, eq=False)
class ScanQueueState:
    """State of the queue between two messages.

    :ivar scans: scans that wait.
    :ivar last_stamp: of the last scan received, ns, -1 before the first.
    :ivar sweeps: the times between scans.
    :ivar reported_faults: faults that were reported.
    :ivar waits_for_odometry: whether scans wait for odometry.
    """

    scans: tuple[Scan, ...] = ()
    last_stamp: int = -1
    sweeps: SweepState = field(default_factory=SweepState)
    reported_faults: frozenset[str] = frozenset()
    waits_for_odometry: bool = True


class ScanQueue:
    """The queue of scans that wait for odometry, or for the answer to a keyframe event."""

    def __init__(self, max_waiting: int, odometry: OdometryBuffer, state: ScanQueueState) -> None:
        """:param max_waiting: scans that may wait for the first odometry.

        :param odometry: the readings for which scans wait.
        :param state: to go on from.
        """
        self._max_waiting = max_waiting
        self._odometry = odometry
        self._scans = deque(state.scans)
        self._ready = 0  # of the scans, which odometry covers
        self._sweeps = SweepCheck(state.sweeps)
        # All but the two parts above, which change in place.
        self._state = replace(state, scans=(), sweeps=SweepState())

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def state(self) -> ScanQueueState:
        """The whole state, as a value."""
        return replace(self._state, scans=tuple(self._scans), sweeps=self._sweeps.state)

    @property
    def waits_for_odometry(self) -> bool:
        """Whether scans wait for odometry."""
        return self._state.waits_for_odometry

    def add_odometry(self, odometry: Odometry) -> None:
        """Add a reading."""
        self._odometry.add(odometry)
        if not self._state.waits_for_odometry:
            self._state = replace(self._state, waits_for_odometry=True)

    def add_scan(self, scan: Scan) -> list[Message]:
        """Add a scan; returns notices of its faults, once for each fault."""
        notices: list[Message] = []
        scan, fault = self._sweeps.check(scan)
        if fault is not None:
            notices += self._notice("sweep", fault)
        if scan.stamp <= self._state.last_stamp:
            notices += self._notice(
                "order",
                f"A scan is stamped {scan.stamp / 1e9:.6f} s, not after its predecessor "
                f"({self._state.last_stamp / 1e9:.6f} s); scans are taken in the order of their arrival: check the "
                "clocks or the order of the log.",
            )
        if not scan.valid.any():
            notices += self._notice(
                "empty",
                f"The scan at {scan.stamp / 1e9:.6f} s has no return between {scan.range_min:g} and {scan.range_max:g} "
                "m; such scans are placed by odometry alone: check the laser and its range limits.",
            )
        self._scans.append(scan)
        self._state = replace(self._state, last_stamp=scan.stamp)
        return notices + self._stop_waiting()

    def is_ready(self, *, ended: bool) -> bool:
        """Whether the next scan can be processed: its odometry is known, or it does not wait for odometry.

        :param ended: whether the odometry has ended.
        """
        return bool(self._scans) and (
            ended or not self._state.waits_for_odometry or self._odometry.covers(self._scans[0].end_stamp)
        )

    def ready_count(self) -> int:
        """Number of the first scans that can be processed."""
        if not self._state.waits_for_odometry:
            return len(self._scans)
        while self._ready < len(self._scans) and self._odometry.covers(self._scans[self._ready].end_stamp):
            self._ready += 1
        return self._ready

    def waiting_scans(self, begin: int, end: int) -> list[Scan]:
        """Some of the scans, by their places in the queue, where they stay."""
        return list(islice(self._scans, begin, end))

    @property
    def next_scan(self) -> Scan:
        """The next scan, which stays in the queue."""
        return self._scans[0]

    def pop(self) -> Scan:
        """The next scan."""
        self._ready = max(0, self._ready - 1)
        return self._scans.popleft()

    def _stop_waiting(self) -> list[Message]:
        """Process scans without odometry until there is a reading, where too many wait."""
        first = self._scans[0]
        too_many = len(self._scans) > self._max_waiting * (1 if self._odometry.is_empty else _LATE)
        if not too_many or not self._state.waits_for_odometry or self._odometry.covers(first.end_stamp):
            return []
        self._state = replace(self._state, waits_for_odometry=False)
        return self._notice(
            "odometry",
            f"{len(self._scans)} scans wait for odometry at {first.stamp / 1e9:.6f} s and are matched without from "
            "here on, until there is a reading: check the odometry topic and its stamps.",
        )

    def _notice(self, fault: str, text: str) -> list[Message]:
        if fault in self._state.reported_faults:
            return []
        self._state = replace(self._state, reported_faults=self._state.reported_faults | {fault})
        return [Notice("slam", text)]


@dataclass(frozen=True, eq=False)
class OdometryDisagreement:
    """The motion by odometry and by scans, from the first contradiction until both agree again.

    :ivar begin: stamp of the scan before the first contradiction, ns.
    :ivar last_contradiction: stamp of the last scan that contradicts odometry, ns.
    :ivar end: stamp of the last scan up to which the difference in heading grew, ns.
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
        """A disagreement that begins at a stamp."""
        return cls(begin, begin, begin, *[NO_MOTION.increment] * 4)

    def extend(self, stamp: int, step: RelativeMotion, tracked: TrackedMotion) -> OdometryDisagreement:
        """The disagreement with one more scan."""
        odometry = se2.compose(self.odometry_motion_now, step.increment)
        scans = se2.compose(self.scan_motion_now, tracked.increment)
        if tracked.contradicts_odometry:
            return OdometryDisagreement(self.begin, stamp, stamp, odometry, scans, odometry, scans)
        extended = replace(self, odometry_motion_now=odometry, scan_motion_now=scans)
        last_angle = _motion_difference(self.odometry_motion, self.scan_motion)[1]
        if _motion_difference(odometry, scans)[1] > last_angle + _GROWTH:
            return replace(extended, end=stamp, odometry_motion=odometry, scan_motion=scans)
        return extended

    def is_significant(self) -> bool:
        """Whether the motions differ, and not only the stamps."""
        distance, angle = _motion_difference(self.odometry_motion, self.scan_motion)
        return distance >= _DISTANCE or angle >= _ANGLE


@dataclass(frozen=True, eq=False)
class OdometryMonitorState:
    """State of the monitor between two scans.

    :ivar last_stamp: stamp of the last scan, ns.
    :ivar disagreement: the current one, None where odometry and scans agree.
    :ivar last_notice: end of the last disagreement that was reported, s, None before the first.
    :ivar unreported: number of disagreements since then that were not reported.
    :ivar noise_reported: whether noisy odometry was reported.
    :ivar last_stale_notice: stamp of the scan at which stale odometry was last reported, s, None before the first.
    :ivar unreported_stale: number of times since then that were not reported.
    """

    last_stamp: int = 0
    disagreement: OdometryDisagreement | None = None
    last_notice: float | None = None
    unreported: int = 0
    noise_reported: bool = False
    last_stale_notice: float | None = None
    unreported_stale: int = 0


class OdometryMonitor:
    """Notices of odometry that contradicts the scans, or that is noisier than its model.

    :ivar state: the whole state, as a value.
    """

    def __init__(self, state: OdometryMonitorState | None = None) -> None:
        """:param state: to go on from."""
        self.state = state or OdometryMonitorState()

    def add_scan(self, stamp: int, step: RelativeMotion | None, tracked: TrackedMotion) -> str | None:
        """Update the disagreement by a scan; returns the notice of one that has ended, if it is due.

        :param stamp: of the scan, ns.
        :param step: motion by odometry since the last scan, None where it is unknown.
        """
        episode = self.state.disagreement
        if tracked.contradicts_odometry and episode is None:
            episode = OdometryDisagreement.from_stamp(self.state.last_stamp)
        self.state = replace(self.state, last_stamp=stamp, disagreement=episode)
        if episode is None:
            return None
        lasts = tracked.contradicts_odometry or (stamp - episode.last_contradiction) * _SECOND <= _QUIET
        if step is None or not lasts:
            return self.end_disagreement()
        self.state = replace(self.state, disagreement=episode.extend(stamp, step, tracked))
        return None

    def end_disagreement(self) -> str | None:
        """End the current disagreement; returns its notice, if it is significant and the last notice is old."""
        episode, self.state = self.state.disagreement, replace(self.state, disagreement=None)
        if episode is None or not episode.is_significant():
            return None
        last, unreported = self.state.last_notice, self.state.unreported
        if last is not None and episode.end * _SECOND - last < _PAUSE:
            self.state = replace(self.state, unreported=unreported + 1)
            return None
        self.state = replace(self.state, last_notice=episode.end * _SECOND, unreported=0)
        return (
            f"odometry {_motion_text(episode.odometry_motion)} from {episode.begin * _SECOND:.3f} s to "
            f"{episode.end * _SECOND:.3f} s, where the scans say that it {_motion_text(episode.scan_motion)}"
            f"{_since_text(unreported)}: the scans are believed; look for slipping wheels and late stamps."
        )

    def add_stale_odometry(self, stamp: int, seconds: float) -> str | None:
        """The notice of odometry that fell behind the robot, if the last one is old.

        :param stamp: of the first scan concerned, ns.
        :param seconds: for which it fell behind.
        """
        now, last, unreported = stamp * _SECOND, self.state.last_stale_notice, self.state.unreported_stale
        if last is not None and 0.0 <= now - last < _PAUSE:
            self.state = replace(self.state, unreported_stale=unreported + 1)
            return None
        self.state = replace(self.state, last_stale_notice=now, unreported_stale=0)
        return (
            f"odometry fell behind the robot for {seconds:.2f} s at {now:.3f} s{_since_text(unreported)}, and caught "
            "up by a jump: that motion is taken as steady; look for a driver that repeats readings or sends them late."
        )

    def check_noise(self, noise: OdometryNoise) -> str | None:
        """The notice of odometry that is much noisier than its model, once."""
        translation, rotation = noise.factors
        if self.state.noise_reported or max(translation, rotation) < NOISY_FACTOR:
            return None
        self.state = replace(self.state, noise_reported=True)
        return (
            f"odometry and scans differ {translation:.1f} times as much in distance and {rotation:.1f} times as much "
            "in heading as the noise model of odometry expects, so it is trusted less: raise "
            "motion.rotation_from_rotation and its neighbors if it stays so."
        )


class Intake:
    """Scans and odometry on their way into the filters.

    :ivar motion: the motion between scans.
    :ivar queue: the scans that wait.
    """

    def __init__(
        self,
        configuration: Configuration,
        motion: MotionState,
        odometry_monitor: OdometryMonitorState,
        scan_queue: ScanQueueState,
    ) -> None:
        """:param motion: to go on from, as the other two."""
        self._configuration = configuration
        self.motion = MotionModel(configuration.motion, motion)
        self._monitor = OdometryMonitor(odometry_monitor)
        most = configuration.filter.max_scans_waiting_for_odometry
        self.queue = ScanQueue(most, self.motion.odometry, scan_queue)

    @property
    def state(self) -> tuple[MotionState, OdometryMonitorState, ScanQueueState]:
        """The whole state, as values."""
        return self.motion.state, self._monitor.state, self.queue.state

    def copy(self) -> Intake:
        """A copy in the same state."""
        return Intake(self._configuration, *self.state)

    def restart(self) -> Intake:
        """Without measurements, for those of any other time; reports no fault of scans again."""
        faults = ScanQueueState(reported_faults=self.queue.state.reported_faults)
        return Intake(self._configuration, MotionState(), OdometryMonitorState(), faults)

    def add(self, measurement: Odometry | Scan) -> list[Message]:
        """Add a measurement; returns notices of its faults."""
        if isinstance(measurement, Scan):
            return self.queue.add_scan(measurement)
        self.queue.add_odometry(measurement)
        return []

    def take(self, *, ended: bool) -> tuple[Scan, list[Message]] | None:
        """The next scan, which is ready, and notices of its odometry; None as long as it may be stale.

        :param ended: whether the odometry has ended.
        """
        stamp = self.queue.next_scan.stamp
        stale = self.motion.settle_odometry(stamp)
        if stale is None and not ended:
            return None
        notices = _slam_notices(self._monitor.add_stale_odometry(stamp, stale)) if stale else []
        return self.queue.pop(), notices

    def observe(self, stamp: int, prediction: Prediction, tracked: TrackedMotion) -> list[Message]:
        """Learn from the motion of a scan that was matched; returns notices of odometry that contradicts it."""
        self.motion.observe(tracked.increment, tracked.information, tracked.contradicts_odometry)
        return _slam_notices(self._monitor.add_scan(stamp, prediction.odometry, tracked))

    def check_noise(self) -> list[Message]:
        """The notice of noisy odometry, once."""
        return _slam_notices(self._monitor.check_noise(self.motion.noise))

    def end(self) -> list[Message]:
        """The notice of a disagreement that lasts to the end."""
        return _slam_notices(self._monitor.end_disagreement())


def _slam_notices(text: str | None) -> list[Message]:
    return [] if text is None else [Notice("slam", text)]


def _since_text(unreported: int) -> str:
    return f" ({unreported} times more since the last notice)" if unreported else ""


def _motion_difference(odometry: Float64, scans: Float64) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two motions."""
    difference = se2.between(odometry, scans)
    return math.hypot(difference[0], difference[1]), abs(float(difference[2]))


def _motion_text(increment: Float64) -> str:
    distance = math.hypot(increment[0], increment[1])
    return f"turned by {math.degrees(increment[2]):.0f} degrees and went {distance:.2f} m"
