"""Real-time localisation: the robot's pose at the rate of the odometry, whatever the other processes are doing.

Section V of Blanco et al. 2008: while scans wait in metric SLAM's queue, the prior p(s_t+k | s_t, u) of the HMT pose
is the last estimate carried on by the odometry since its scan.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import Accepted, Arriving, LocalEstimate, Message, Notice, RealTimePose
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.motion_model import path_covariance

# Beyond the bounds of speed: two readings of one moment may differ by this much without a reset.
_SLACK_DISTANCE = 0.5  # m
_SLACK_ANGLE = math.radians(30.0)
# Readings kept for an estimate that is still to come: half an hour at 50 Hz.
_READINGS_KEPT = 90_000


class Reading(NamedTuple):
    """An odometry reading on the path without resets.

    :ivar stamp: ns.
    :ivar raw: ``odom_T_base`` as measured, shape (3,).
    :ivar smooth: the same with the resets taken out, shape (3,).
    :ivar distance: path length since the start, m.
    :ivar angle: sum of the turns since the start, both ways positive, rad.
    """

    stamp: int
    raw: NDArray[np.float64]
    smooth: NDArray[np.float64]
    distance: float
    angle: float

    def moved_to(self, raw: NDArray[np.float64]) -> Reading:
        """This reading with another measured pose nearby, shape (3,)."""
        return self._replace(raw=raw, smooth=se2.compose(self.smooth, se2.between(self.raw, raw)))


# The map's frame is the first area's: known before TLCA has spoken.
_FIRST = AreaPose(FIRST_AREA, PoseGaussian(np.zeros(3), np.zeros((3, 3))))


@dataclass(frozen=True, eq=False)
class RtlState:
    """RTL between two messages, at first before the first one.

    :ivar readings: odometry since the last estimate, and the reading before that.
    :ivar newest: metric SLAM's last estimate.
    :ivar estimate: the last one whose area's place in the map is known, on which the pose rests.
    :ivar start: the reading at that estimate, None before the next reading.
    :ivar areas: ``map_T_area`` as TLCA told it last, ordered by area.
    :ivar area_pose: that of the area of ``estimate``.
    :ivar ambiguity: of TLCA's last answer, shape (3, 3).
    """

    readings: tuple[Reading, ...] = ()
    newest: LocalEstimate | None = None
    estimate: LocalEstimate | None = None
    start: Reading | None = None
    areas: tuple[AreaPose, ...] = (_FIRST,)
    area_pose: PoseGaussian = _FIRST.pose
    ambiguity: NDArray[np.float64] = field(default_factory=partial(np.zeros, (3, 3)))


class Rtl:
    """The RTL process. Consumes Odometry, Arriving, LocalEstimate, Accepted; produces RealTimePose, Notice."""

    def __init__(self, configuration: Configuration, state: RtlState | None = None) -> None:
        """:param state: to go on from."""
        state = state or RtlState()
        self._motion = configuration.motion
        self._settings = configuration.rtl
        self._readings = deque(state.readings, maxlen=_READINGS_KEPT)
        self._newest, self._estimate, self._start = state.newest, state.estimate, state.start
        self._areas = GlobalPoses(state.areas)
        # That of the estimate's area, kept where another hypothesis leads, which may not know it.
        self._area_pose = state.area_pose
        self._ambiguity = state.ambiguity
        # Estimates of scans before this one are of before the robot arrived; a state is saved when none is under way.
        self._first = 0

    @property
    def state(self) -> RtlState:
        """All that RTL knows, as a value."""
        return RtlState(
            tuple(self._readings),
            self._newest,
            self._estimate,
            self._start,
            self._areas.areas,
            self._area_pose,
            self._ambiguity,
        )

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; an odometry reading is answered with the pose at its stamp, once one is known."""
        if isinstance(message, Odometry):
            return self._hear_odometry(message)
        if isinstance(message, LocalEstimate):
            if message.scan_index >= self._first and (self._newest is None or message.stamp > self._newest.stamp):
                self._newest = message
                self._correct()
        elif isinstance(message, Accepted):
            self._hear_accepted(message)
        elif isinstance(message, Arriving):
            self._first = message.scans
            self._readings.clear()
            self._newest = self._estimate = self._start = None
        return []

    def _hear_accepted(self, accepted: Accepted) -> None:
        self._ambiguity = accepted.ambiguity
        if accepted.global_poses:
            self._areas = GlobalPoses(accepted.global_poses)
            if self._estimate is not None:
                self._area_pose = self._areas.get(self._estimate.area, self._area_pose)
            self._correct()

    def _hear_odometry(self, reading: Odometry) -> list[Message]:
        """Carry the path on to a reading; one that is not newer than its predecessor is passed over."""
        if not self._readings:
            self._readings.append(Reading(reading.stamp, reading.pose, reading.pose, 0.0, 0.0))
            return self._predict()
        last = self._readings[-1]
        if reading.stamp <= last.stamp:
            return []
        said: list[Message] = []
        step = se2.between(last.raw, reading.pose)
        distance, angle = math.hypot(step[0], step[1]), abs(float(step[2]))
        if self._is_reset(distance, angle, 1e-9 * (reading.stamp - last.stamp)):
            said.append(_reset_notice(reading.stamp, distance, angle))
            step, distance, angle = np.zeros(3), 0.0, 0.0
        smooth = se2.compose(last.smooth, step)
        self._readings.append(
            Reading(reading.stamp, reading.pose, smooth, last.distance + distance, last.angle + angle)
        )
        return said + self._predict()

    def _is_reset(self, distance: float, angle: float, seconds: float) -> bool:
        return (
            distance > _SLACK_DISTANCE + self._settings.max_speed * seconds
            or angle > _SLACK_ANGLE + math.radians(self._settings.max_turn_rate) * seconds
        )

    def _correct(self) -> None:
        """Start from the newest estimate, and forget the readings before its scan.

        An area that is new has no place in the map before TLCA's answer is here: until then the former estimate holds.
        """
        if self._newest is None:
            return
        pose: PoseGaussian | None = self._area_pose
        if self._estimate is None or self._newest.area != self._estimate.area:
            pose = self._areas.get(self._newest.area)
        if pose is None:
            return
        self._estimate, self._area_pose, self._start = self._newest, pose, None
        while len(self._readings) > 1 and self._readings[1].stamp <= self._estimate.stamp:
            self._readings.popleft()

    def _predict(self) -> list[Message]:
        """The estimate carried on by the odometry since its scan."""
        estimate = self._estimate
        if estimate is None:
            return []
        if self._start is None:
            self._start = self._readings[0].moved_to(estimate.odometry)
        start, now = self._start, self._readings[-1]
        since = PoseGaussian(
            se2.between(start.smooth, now.smooth),
            path_covariance(now.distance - start.distance, min(now.angle - start.angle, math.pi), self._motion),
        )
        return [RealTimePose(now.stamp, estimate.area, self._area_pose, estimate.pose, since, now.raw, self._ambiguity)]


def _reset_notice(stamp: int, distance: float, angle: float) -> Notice:
    return Notice(
        "rtl",
        f"the odometry jumped by {distance:.2f} m and {math.degrees(angle):.0f} degrees at stamp {stamp} ns: taken for "
        "a reset, with the robot standing; if it does move so fast, raise rtl.max_speed or rtl.max_turn_rate",
    )
