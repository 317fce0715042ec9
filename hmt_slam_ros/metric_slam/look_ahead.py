"""Early estimates: where the robot is at scans that wait for the answer to a keyframe event, or for later odometry.

Nobody waits for these: such a scan is matched with the map of the last event, on a copy of the most probable
hypothesis's filter. The copy is dropped when metric SLAM goes on, which works the scans off as in lock-step. So no
decision depends on early estimates, nor on when an answer comes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import EarlyEstimate, LocalEstimate
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import MotionModel, MotionState
from hmt_slam_ros.sensors.odometry import deskew_scan
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan


class LookAhead:
    """Tracks the robot through waiting scans, from the last estimate on until the next.

    Of several scans that have no estimate at the first call only the newest gets one: however many wait, the robot's
    pose is known at once.

    :ivar next_scan: number of the first scan after those that had their turn.
    """

    def __init__(
        self,
        configuration: Configuration,
        mapping: LocalMapping,
        live: LiveHypothesis,
        motion: MotionState,
        event: int,
        next_scan: int = 0,
    ) -> None:
        """:param mapping: the mapping of the hypothesis's filter.

        :param live: the most probable hypothesis; its filter does not change meanwhile.
        :param motion: of metric SLAM.
        :param event: the last keyframe event.
        :param next_scan: number of the first scan that may have an estimate.
        """
        self._limits, self._mapping, self._event = configuration.rtl, mapping, event
        self._motion = MotionModel(configuration.motion, motion)
        self._live = replace(live, filter=copy(live.filter))
        self.next_scan, self._has_begun = next_scan, False

    def add_odometry(self, reading: Odometry) -> None:
        """Add a reading."""
        self._motion.odometry.add(reading)

    def estimate(self, scans: Sequence[Scan], first: int) -> list[EarlyEstimate]:
        """The estimates of scans that have none yet.

        :param scans: those that wait, as far as their odometry is known.
        :param first: number of the first of them.
        """
        begin = max(first, self.next_scan, 0 if self._has_begun else first + len(scans) - 1)
        estimates = []
        for number, scan in enumerate(scans[begin - first :], begin):
            # Whether odometry is stale may show later; the match counts until then.
            self._motion.settle_odometry(scan.stamp)
            estimates.append(self._track(number, scan))
            self.next_scan, self._has_begun = number + 1, True
        return estimates

    def _track(self, number: int, scan: Scan) -> EarlyEstimate:
        prediction = self._motion.predict(scan.stamp)
        prepared = PreparedScan(self._mapping, deskew_scan(scan, self._motion.odometry, self._limits))
        tracked = self._live.filter.track(prepared, prediction)
        self._motion.observe(tracked.increment, tracked.information, tracked.contradicts_odometry)
        area, belief = self._live.filter.area, self._live.pose_belief()
        return EarlyEstimate(scan.stamp, number, self._event, area, belief, self._motion.odometry_pose)


class EarlyEstimateRecord:
    """How far early estimates were from the estimates that followed them."""

    def __init__(self) -> None:
        self._waiting: dict[int, EarlyEstimate] = {}
        self._count, self._elsewhere, self._largest = 0, 0, 0.0

    def add(self, estimate: EarlyEstimate) -> None:
        """Add an early estimate."""
        self._waiting[estimate.scan_index] = estimate
        self._count += 1

    def compare(self, estimate: LocalEstimate) -> None:
        """Compare an estimate with the early one of its scan, if there was one."""
        early = self._waiting.pop(estimate.scan_index, None)
        if early is None:
            return
        if early.area != estimate.area:
            self._elsewhere += 1
            return
        difference = se2.between(early.pose.mean, estimate.pose.mean)
        self._largest = max(self._largest, math.hypot(difference[0], difference[1]))

    def clear(self) -> None:
        """Forget those whose scans were dropped."""
        self._waiting.clear()

    def __str__(self) -> str:
        return f"{self._count}, {self._elsewhere} of them then in another area, the others off by {self._largest:.2f} m"
