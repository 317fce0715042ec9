"""A replacement of metric SLAM, area abstraction and acceptance for TSBI: dead reckoning, and scripted cuts.

TSBI gets the same messages as from them, and decides on topologies alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import (
    AreaEvent,
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    Message,
)
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.event_work import EventWork

STEP = np.diag([0.02, 0.02, math.radians(0.5)]) ** 2
"""Covariance of the odometry between two keyframes."""

_START = np.diag([1e-8, 1e-8, 1e-8])


@dataclass(frozen=True, eq=False)
class Robot:
    """The belief of metric SLAM under one hypothesis.

    :ivar area: the robot's.
    :ivar pose: belief over ``area_T_base``.
    """

    area: int = FIRST_AREA
    pose: PoseGaussian = field(default_factory=lambda: PoseGaussian(np.zeros(3), _START))

    def move(self, step: Float64, noise: float) -> Robot:
        """The robot after a motion (3,) by odometry, with the deviations of ``STEP`` times ``noise``."""
        return Robot(self.area, self.pose.compose(PoseGaussian(step, noise**2 * STEP)))

    def enter(self, area: int, rebase: PoseGaussian | None, keyframes: int, noise: float) -> Robot:
        """The robot after TSBI's answer.

        :param keyframes: number of keyframes that moved into the area.
        :param noise: as for :meth:`moved`.
        """
        if rebase is None:
            return self
        drift = max(1, keyframes) * noise**2 * STEP
        return Robot(area, PoseGaussian(se2.compose(rebase.mean, self.pose.mean), drift))


class UnboundedWork(EventWork):
    """Work of an event that has no bound, where no area abstraction repeats a cut."""

    @property
    def is_exhausted(self) -> bool:
        """False."""
        return False

    @property
    def admits_comparison(self) -> bool:
        """True."""
        return True


class Script:
    """Sends keyframe events to TSBI.

    :ivar sequence: number of the last keyframe event.
    :ivar robots: {hypothesis: belief of metric SLAM}.
    :ivar hypotheses: the last answer.
    """

    def __init__(self, tsbi: Process, noise: float = 1.0) -> None:
        """:param noise: factor on the deviations of the odometry."""
        self._tsbi = tsbi
        self._noise = noise
        self.sequence = -1
        self.robots = {FIRST_HYPOTHESIS: Robot()}
        self.hypotheses = Hypotheses(self.sequence, (Hypothesis(FIRST_HYPOTHESIS, FIRST_HYPOTHESIS, 1.0, FIRST_AREA),))

    def keyframe(self, step: Float64, scan: Scan, cut: int = 0) -> Hypotheses:
        """Send a keyframe event; return TSBI's answer.

        :param step: the motion (3,) since the last one as the odometry has it.
        :param cut: number of newest keyframes that leave the area, under every hypothesis; 0 for none.
        """
        self.robots = {hypothesis: robot.move(step, self._noise) for hypothesis, robot in self.robots.items()}
        newest = tuple(range(self.sequence + 2 - cut, self.sequence + 2))
        events = [AreaEvent(h, "cut", newest, robot.area, 0.0) for h, robot in sorted(self.robots.items()) if cut]
        return self._event(scan, events)

    def go_to(self, area: int, scan: Scan) -> None:
        """Move to the origin of a known area, under the only hypothesis."""
        (hypothesis,) = self.robots
        self._event(scan, [AreaEvent(hypothesis, "moved", (), area, 1.0)], stored=False)
        self.robots = {hypothesis: Robot(area)}

    def accept(self, hypothesis: int, global_poses: tuple[AreaPose, ...] = ()) -> None:
        """Accept a hypothesis."""
        self._send(ClosureDecision(self.sequence, hypothesis, global_poses=global_poses))
        self.robots = {hypothesis: self.robots[hypothesis]}

    def _event(self, scan: Scan, events: Sequence[AreaEvent], *, stored: bool = True) -> Hypotheses:
        self.sequence += 1
        estimates = tuple(
            HypothesisEstimate(hypothesis, robot.area, robot.pose, stored, 0.0, 0.0, Clutter(), 1.0)
            for hypothesis, robot in sorted(self.robots.items())
        )
        self._send(Keyframe(self.sequence, scan, 0.0, estimates))
        (answer,) = self._send(AreaEvents(self.sequence, tuple(events)))
        assert isinstance(answer, Hypotheses)
        before = self.robots
        self.robots = {
            hypothesis.id: before[hypothesis.parent].enter(
                hypothesis.area, hypothesis.frame_change, len(hypothesis.moved_keyframes), self._noise
            )
            for hypothesis in answer.hypotheses
        }
        self.hypotheses = answer
        return answer

    def _send(self, message: Message) -> list[Message]:
        return self._tsbi.handle(message)
