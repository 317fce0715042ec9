"""Real-time localization: the robot's pose at the rate of the odometry, whatever the other processes are doing.

Section V of Blanco et al. 2008: while scans wait in metric SLAM's queue, the prior p(s_t+k | s_t, u) of the HMT pose
is the last estimate carried on by the odometry since its scan.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import ClosureDecision, LocalEstimate, Message, Notice, RealTimePose, TrackingReset
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.motion_model import path_covariance

# Beyond the bounds of speed: two readings of one moment may differ by this much without a reset.
_SLACK_DISTANCE = 0.5  # m
_SLACK_ANGLE = math.radians(30.0)
# Readings kept for an estimate that is still to come: half an hour at 50 Hz.
_READINGS_KEPT = 90_000


class OdometryPathPoint(NamedTuple):
    """An odometry reading on the path without resets.

    :ivar stamp: ns.
    :ivar measured: ``odom_T_base`` as measured, shape (3,).
    :ivar reset_free: the same with the resets taken out, shape (3,).
    :ivar distance: path length since the start, m.
    :ivar angle: sum of the turns since the start, both ways positive, rad.
    """

    stamp: int
    measured: NDArray[np.float64]
    reset_free: NDArray[np.float64]
    distance: float
    angle: float

    def with_measured(self, raw: NDArray[np.float64]) -> OdometryPathPoint:
        """This reading with another measured pose nearby, shape (3,)."""
        return self._replace(measured=raw, reset_free=se2.compose(self.reset_free, se2.between(self.measured, raw)))


# The map's frame is the first area's: known before TLCA has spoken.
_FIRST_AREA_POSE = AreaPose(FIRST_AREA, PoseGaussian(np.zeros(3), np.zeros((3, 3))))


@dataclass(frozen=True, eq=False)
class RtlState:
    """RTL between two messages, at first before the first one.

    :ivar readings: odometry since the last estimate, and the reading before that.
    :ivar newest_estimate: metric SLAM's last estimate.
    :ivar base_estimate: the last one whose area's place in the map is known, on which the pose rests.
    :ivar base_reading: the reading at that estimate, None before the next reading.
    :ivar area_poses: ``map_T_area`` as TLCA told it last, ordered by area.
    :ivar base_area_pose: that of the area of ``base_estimate``, kept where another hypothesis leads, which may not
        know it.
    :ivar ambiguity: of TLCA's last answer, shape (3, 3).
    """

    readings: tuple[OdometryPathPoint, ...] = ()
    newest_estimate: LocalEstimate | None = None
    base_estimate: LocalEstimate | None = None
    base_reading: OdometryPathPoint | None = None
    area_poses: tuple[AreaPose, ...] = (_FIRST_AREA_POSE,)
    base_area_pose: PoseGaussian = _FIRST_AREA_POSE.pose
    ambiguity: NDArray[np.float64] = field(default_factory=partial(np.zeros, (3, 3)))


class Rtl:
    """The RTL process. Consumes Odometry, TrackingReset, LocalEstimate, ClosureDecision; produces RealTimePose,
    Notice."""

    def __init__(self, configuration: Configuration, state: RtlState | None = None) -> None:
        """:param state: to go on from."""
        state = state or RtlState()
        self._motion = configuration.motion
        self._settings = configuration.rtl
        self._readings = deque(state.readings, maxlen=_READINGS_KEPT)
        # All but the readings, which come and go at the rate of the odometry.
        self._state = replace(state, readings=())
        # Estimates of scans before this one are of before the robot arrived; a state is saved when none is under way.
        self._first_valid_scan = 0

    @property
    def state(self) -> RtlState:
        """All that RTL knows, as a value."""
        return replace(self._state, readings=tuple(self._readings))

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; an odometry reading is answered with the pose at its stamp, once one is known."""
        if isinstance(message, Odometry):
            return self._on_odometry(message)
        if isinstance(message, LocalEstimate):
            newest = self._state.newest_estimate
            if message.scan_index >= self._first_valid_scan and (newest is None or message.stamp > newest.stamp):
                self._state = replace(self._state, newest_estimate=message)
                self._update_base()
        elif isinstance(message, ClosureDecision):
            self._on_closure_decision(message)
        elif isinstance(message, TrackingReset):
            self._first_valid_scan = message.scans_before
            self._readings.clear()
            self._state = replace(self._state, newest_estimate=None, base_estimate=None, base_reading=None)
        return []

    def _on_closure_decision(self, accepted: ClosureDecision) -> None:
        self._state = replace(self._state, ambiguity=accepted.ambiguity)
        if accepted.global_poses:
            base, pose = self._state.base_estimate, self._state.base_area_pose
            if base is not None:
                pose = GlobalPoses(accepted.global_poses).get(base.area, pose)
            self._state = replace(self._state, area_poses=accepted.global_poses, base_area_pose=pose)
            self._update_base()

    def _on_odometry(self, reading: Odometry) -> list[Message]:
        """Carry the path on to a reading; one that is not newer than its predecessor is passed over."""
        if not self._readings:
            self._readings.append(OdometryPathPoint(reading.stamp, reading.pose, reading.pose, 0.0, 0.0))
            return self._predict()
        last = self._readings[-1]
        if reading.stamp <= last.stamp:
            return []
        said: list[Message] = []
        step = se2.between(last.measured, reading.pose)
        distance, angle = math.hypot(step[0], step[1]), abs(float(step[2]))
        if self._is_reset(distance, angle, 1e-9 * (reading.stamp - last.stamp)):
            said.append(_reset_notice(reading.stamp, distance, angle))
            step, distance, angle = np.zeros(3), 0.0, 0.0
        smooth = se2.compose(last.reset_free, step)
        self._readings.append(
            OdometryPathPoint(reading.stamp, reading.pose, smooth, last.distance + distance, last.angle + angle)
        )
        return said + self._predict()

    def _is_reset(self, distance: float, angle: float, seconds: float) -> bool:
        return (
            distance > _SLACK_DISTANCE + self._settings.max_speed * seconds
            or angle > _SLACK_ANGLE + math.radians(self._settings.max_turn_rate) * seconds
        )

    def _update_base(self) -> None:
        """Start from the newest estimate, and forget the readings before its scan.

        An area that is new has no place in the map before TLCA's answer is here: until then the former estimate holds.
        """
        newest, base = self._state.newest_estimate, self._state.base_estimate
        if newest is None:
            return
        pose: PoseGaussian | None = self._state.base_area_pose
        if base is None or newest.area != base.area:
            pose = GlobalPoses(self._state.area_poses).get(newest.area)
        if pose is None:
            return
        self._state = replace(self._state, base_estimate=newest, base_area_pose=pose, base_reading=None)
        while len(self._readings) > 1 and self._readings[1].stamp <= newest.stamp:
            self._readings.popleft()

    def _predict(self) -> list[Message]:
        """The estimate carried on by the odometry since its scan."""
        estimate, start, now = self._state.base_estimate, self._state.base_reading, self._readings[-1]
        if estimate is None:
            return []
        if start is None:
            start = self._readings[0].with_measured(estimate.odometry)
            self._state = replace(self._state, base_reading=start)
        since = PoseGaussian(
            se2.between(start.reset_free, now.reset_free),
            path_covariance(now.distance - start.distance, min(now.angle - start.angle, math.pi), self._motion),
        )
        return [
            RealTimePose(
                now.stamp,
                estimate.area,
                self._state.base_area_pose,
                estimate.pose,
                since,
                now.measured,
                self._state.ambiguity,
            )
        ]


def _reset_notice(stamp: int, distance: float, angle: float) -> Notice:
    return Notice(
        "rtl",
        f"the odometry jumped by {distance:.2f} m and {math.degrees(angle):.0f} degrees at stamp {stamp} ns: taken for "
        "a reset, with the robot standing; if it does move so fast, raise rtl.max_speed or rtl.max_turn_rate",
    )
