"""Real-time localization: the robot's pose at the rate of the odometry, independent of the other processes.

Section V of Blanco et al. 2008: while scans wait in metric SLAM's queue, the prior p(s_t+k | s_t, u) of the HMT pose
is the last estimate, propagated by the odometry since its scan.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EarlyEstimate,
    LocalEstimate,
    Message,
    Notice,
    RealTimePose,
    TrackingReset,
)
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.sensors.relative_motion import path_covariance

_SLACK_DISTANCE, _SLACK_ANGLE = 0.5, math.radians(30.0)
"""Jump of the odometry beyond the bounds of speed that is no reset yet, m and rad."""

_READINGS_KEPT = 90_000
"""Odometry readings that are kept without an estimate: half an hour at 50 Hz."""

_MAX_CORRECTION, _MAX_CORRECTION_ANGLE = 2.0, math.radians(45.0)
"""Largest correction that is shown little by little, m and rad; beyond it the robot is elsewhere."""


class OdometryPathPoint(NamedTuple):
    """An odometry reading on the path without resets.

    :ivar stamp: ns.
    :ivar measured: ``odom_T_base`` as measured, shape (3,).
    :ivar reset_free: the same without resets, shape (3,).
    :ivar distance: path length since the start, m.
    :ivar angle: sum of the absolute turns since the start, rad.
    """

    stamp: int
    measured: Float64
    reset_free: Float64
    distance: float
    angle: float

    def with_measured(self, pose: Float64) -> OdometryPathPoint:
        """This reading with another measured pose nearby, shape (3,)."""
        return self._replace(measured=pose, reset_free=se2.compose(self.reset_free, se2.between(self.measured, pose)))


_FIRST_AREA_POSE = AreaPose(FIRST_AREA, PoseGaussian(np.zeros(3), np.zeros((3, 3))))
"""The map frame is that of the first area, before TLCA has answered."""


@dataclass(frozen=True, eq=False)
class RtlState:
    """State of RTL between two messages, by default before the first.

    :ivar readings: odometry since the last estimate, and the reading before that.
    :ivar newest_estimate: metric SLAM's last estimate.
    :ivar base_estimate: the last estimate in an area whose pose in the map is known; the pose is based on it.
    :ivar base_reading: the reading at that estimate, None before the next reading.
    :ivar area_poses: ``map_T_area`` in TLCA's last answer, ordered by area.
    :ivar base_area_pose: that of the area of ``base_estimate``, which the hypothesis that leads now may not have.
    :ivar ambiguity: in TLCA's last answer, shape (3, 3).
    """

    readings: tuple[OdometryPathPoint, ...] = ()
    newest_estimate: LocalEstimate | None = None
    base_estimate: LocalEstimate | None = None
    base_reading: OdometryPathPoint | None = None
    area_poses: tuple[AreaPose, ...] = (_FIRST_AREA_POSE,)
    base_area_pose: PoseGaussian = _FIRST_AREA_POSE.pose
    ambiguity: Float64 = field(default_factory=partial(np.zeros, (3, 3)))


class _Base(NamedTuple):
    """What the pose is based on.

    :ivar estimate: of a scan.
    :ivar area_pose: ``map_T_area`` of its area.
    :ivar reading: at the scan.
    """

    estimate: LocalEstimate | EarlyEstimate
    area_pose: PoseGaussian
    reading: OdometryPathPoint


class Rtl:
    """The RTL process.

    Consumes Odometry, TrackingReset, LocalEstimate, EarlyEstimate, ClosureDecision; produces RealTimePose, Notice.
    """

    def __init__(self, configuration: Configuration, state: RtlState | None = None) -> None:
        """:param state: to go on from."""
        state = state or RtlState()
        self._motion = configuration.motion
        self._settings = configuration.rtl
        self._readings = deque(state.readings, maxlen=_READINGS_KEPT)
        # All but the readings, which change at the rate of the odometry.
        self._state = replace(state, readings=())
        # Estimates of earlier scans are from before a reset; a state is saved when none of these is pending.
        self._first_valid_scan, self._first_valid_event = 0, 0
        # Not part of the state either: it holds until the next estimate.
        self._early: EarlyEstimate | None = None
        self._early_reading: OdometryPathPoint | None = None

    @property
    def state(self) -> RtlState:
        """The whole state, as a value."""
        return replace(self._state, readings=tuple(self._readings))

    def handle(self, message: Message) -> list[Message]:
        """The answer to a message: to an odometry reading, the pose at its stamp, once that is known."""
        if isinstance(message, Odometry):
            return self._on_odometry(message)
        if isinstance(message, LocalEstimate):
            newest = self._state.newest_estimate
            if message.scan_index >= self._first_valid_scan and (newest is None or message.stamp > newest.stamp):
                self._state = replace(self._state, newest_estimate=message)
                self._update_base()
        elif isinstance(message, EarlyEstimate):
            self._on_early_estimate(message)
        elif isinstance(message, ClosureDecision):
            self._on_closure_decision(message)
        elif isinstance(message, TrackingReset):
            self._first_valid_scan, self._first_valid_event = message.scans_before, message.event
            self._early = None
            self._readings.clear()
            self._state = replace(self._state, newest_estimate=None, base_estimate=None, base_reading=None)
        return []

    def _on_early_estimate(self, estimate: EarlyEstimate) -> None:
        """Keep the newest early estimate, with the reading at its scan."""
        is_newer = self._early is None or estimate.stamp > self._early.stamp
        if not is_newer or estimate.event < self._first_valid_event or not self._readings:
            return
        before = next((reading for reading in reversed(self._readings) if reading.stamp <= estimate.stamp), None)
        reading = self._readings[0] if before is None else before
        self._early, self._early_reading = estimate, reading.with_measured(estimate.odometry)

    def _on_closure_decision(self, decision: ClosureDecision) -> None:
        self._state = replace(self._state, ambiguity=decision.ambiguity)
        if decision.global_poses:
            base, pose = self._state.base_estimate, self._state.base_area_pose
            if base is not None:
                pose = GlobalPoses(decision.global_poses).get(base.area, pose)
            self._state = replace(self._state, area_poses=decision.global_poses, base_area_pose=pose)
            self._update_base()

    def _on_odometry(self, reading: Odometry) -> list[Message]:
        """Append a reading to the path; a reading that is not newer than the last is ignored."""
        if not self._readings:
            self._readings.append(OdometryPathPoint(reading.stamp, reading.pose, reading.pose, 0.0, 0.0))
            return self._predict()
        last = self._readings[-1]
        if reading.stamp <= last.stamp:
            return []
        notices: list[Message] = []
        step = se2.between(last.measured, reading.pose)
        distance, angle = math.hypot(step[0], step[1]), abs(float(step[2]))
        if self._is_reset(distance, angle, 1e-9 * (reading.stamp - last.stamp)):
            notices.append(_reset_notice(reading.stamp, distance, angle))
            step, distance, angle = np.zeros(3), 0.0, 0.0
        reset_free = se2.compose(last.reset_free, step)
        self._readings.append(
            OdometryPathPoint(reading.stamp, reading.pose, reset_free, last.distance + distance, last.angle + angle)
        )
        return notices + self._predict()

    def _is_reset(self, distance: float, angle: float, seconds: float) -> bool:
        return (
            distance > _SLACK_DISTANCE + self._settings.max_speed * seconds
            or angle > _SLACK_ANGLE + math.radians(self._settings.max_turn_rate) * seconds
        )

    def _update_base(self) -> None:
        """Base the pose on the newest estimate, and drop the readings before its scan.

        A new area has no pose in the map before TLCA's answer: until then the former estimate remains the base.
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
        """The estimate, propagated by the odometry since its scan."""
        base, now = self._base(), self._readings[-1]
        base = self._early_base() or base
        if base is None:
            return []
        estimate, start = base.estimate, base.reading
        since = PoseGaussian(
            se2.between(start.reset_free, now.reset_free),
            path_covariance(now.distance - start.distance, min(now.angle - start.angle, math.pi), self._motion),
        )
        return [
            RealTimePose(
                now.stamp, estimate.area, base.area_pose, estimate.pose, since, now.measured, self._state.ambiguity
            )
        ]

    def _base(self) -> _Base | None:
        """The last estimate in an area whose pose in the map is known."""
        estimate, reading = self._state.base_estimate, self._state.base_reading
        if estimate is None:
            return None
        if reading is None:
            reading = self._readings[0].with_measured(estimate.odometry)
            self._state = replace(self._state, base_reading=reading)
        return _Base(estimate, self._state.base_area_pose, reading)

    def _early_base(self) -> _Base | None:
        """The early estimate, where it is newer than the last estimate, and its area's pose in the map is known."""
        early, reading, newest = self._early, self._early_reading, self._state.newest_estimate
        if early is None or reading is None or (newest is not None and early.stamp <= newest.stamp):
            return None
        base = self._state.base_estimate
        known = self._state.base_area_pose if base is not None and base.area == early.area else None
        pose = known or GlobalPoses(self._state.area_poses).get(early.area)
        return None if pose is None else _Base(early, pose, reading)


def _reset_notice(stamp: int, distance: float, angle: float) -> Notice:
    return Notice(
        "rtl",
        f"the odometry jumped by {distance:.2f} m and {math.degrees(angle):.0f} degrees at stamp {stamp} ns: taken for "
        "a reset, with the robot standing; if it does move so fast, raise rtl.max_speed or rtl.max_turn_rate",
    )


class CorrectionSmoother:
    """Smoothing of map -> odom, so that corrections of the pose reach it little by little.

    The remaining correction is a motion of the robot, so that a turn does not swing a robot that is far from the origin
    of the odometry. It decays as exp(-t / time_constant).
    """

    def __init__(self) -> None:
        self._stamp = 0
        self._map_T_odom: Float64 | None = None

    def smooth(
        self,
        stamp: int,
        map_T_odom: Float64,
        odom_T_base: Float64,
        time_constant: float,
    ) -> Float64:
        """The smoothed ``map_T_odom``, shape (3,).

        :param stamp: of the odometry, ns.
        :param map_T_odom: as estimated, shape (3,).
        :param odom_T_base: shape (3,).
        :param time_constant: time in which a correction falls to a third, s; 0 for at once.
        """
        seconds = 1e-9 * (stamp - self._stamp)
        if self._map_T_odom is None or time_constant <= 0.0 or seconds < 0.0:
            self._map_T_odom = map_T_odom
        else:
            target = se2.compose(map_T_odom, odom_T_base)
            remaining = se2.log(se2.between(target, se2.compose(self._map_T_odom, odom_T_base)))
            if math.hypot(remaining[0], remaining[1]) > _MAX_CORRECTION or abs(remaining[2]) > _MAX_CORRECTION_ANGLE:
                remaining = np.zeros(3)
            base = se2.compose(target, se2.exp(math.exp(-seconds / time_constant) * remaining))
            self._map_T_odom = se2.compose(base, se2.inverse(odom_T_base))
        self._stamp = stamp
        return self._map_T_odom
