"""Early estimates: where the robot is at scans that wait for the answer to a keyframe event, or for later odometry.

Nobody waits for these: such a scan is matched with the map of the last event, on a copy of the most probable
hypothesis's filter, while metric SLAM works the scans off as in lock-step. So no decision depends on early estimates,
nor on when an answer comes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import matrix_inverse, propagate_covariance
from hmt_slam_ros.messages.messages import EarlyEstimate, LocalEstimate
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import MotionModel, Prediction
from hmt_slam_ros.sensors.odometry import deskew_scan
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion
from hmt_slam_ros.submap.local_filter import TrackedMotion
from hmt_slam_ros.submap.local_mapping import PreparedScan


class LookAhead:
    """Tracks the robot through scans that wait, in the map that metric SLAM has.

    Where metric SLAM gets further, or its map changes, tracking goes on in that map: from the pose that metric SLAM has
    reached, by the motion that was tracked since. So an answer costs as little as a scan, however many scans wait.
    """

    def __init__(self, configuration: Configuration, slam: MetricSlam) -> None:
        """:param slam: metric SLAM, from whose last scan on this tracks."""
        self._limits, self._mapping = configuration.rtl, slam.mapping
        self._motion = MotionModel(configuration.motion, slam.intake.motion.state)
        # {number of a scan: the motion from the first on}
        self._path = {slam.processed_scans - 1: NO_MOTION}
        self._newest = slam.processed_scans - 1
        self._change_map(slam, NO_MOTION)

    def _change_map(self, slam: MetricSlam, since_map: RelativeMotion) -> None:
        """:param since_map: the motion from the pose that metric SLAM has reached to the newest scan."""
        live = slam.best_hypothesis
        self._live: LiveHypothesis | None = replace(live, filter=copy(live.filter))
        self._since_map, self._map_scan = since_map, slam.processed_scans - 1

    def add_odometry(self, reading: Odometry) -> None:
        """Add a reading."""
        self._motion.odometry.add(reading)

    def leave_map(self) -> None:
        """Go on in the map that metric SLAM has at the next :meth:`follow`."""
        self._live = None

    def follow(self, slam: MetricSlam, oldest: int) -> bool:
        """Go on in the map of metric SLAM; returns whether the motion since its last scan is known.

        :param oldest: number of the first scan to which metric SLAM may go back.
        """
        while self._path and next(iter(self._path)) < oldest - 1:
            del self._path[next(iter(self._path))]
        last = slam.processed_scans - 1
        if self._live is not None and last == self._map_scan:
            return True
        if last not in self._path or last == self._newest:
            return False
        self._change_map(slam, _motion_between(self._path[last], self._path[self._newest]))
        return True

    def estimate(self, scans: Sequence[Scan], first: int, event: int) -> Iterator[EarlyEstimate]:
        """The estimates of scans that were not tracked yet.

        :param first: number of the first of them.
        :param event: the last keyframe event.
        """
        begin = max(first, self._newest + 1)
        for number, scan in enumerate(scans[begin - first :], begin):
            live = self._track(number, scan)
            pose, odometry = live.pose_belief(), self._motion.odometry_pose
            yield EarlyEstimate(scan.stamp, number, event, live.filter.area, pose, odometry)

    def _track(self, number: int, scan: Scan) -> LiveHypothesis:
        assert self._live is not None
        # Whether odometry is stale may show later; the match counts until then.
        self._motion.settle_odometry(scan.stamp)
        prediction, before = self._motion.predict(scan.stamp), self._since_map
        prepared = PreparedScan(self._mapping, deskew_scan(scan, self._motion.odometry, self._limits))
        tracked = self._live.filter.track(prepared, _predict_after(before, prediction))
        increment = se2.between(before.increment, tracked.increment)
        self._motion.observe(increment, tracked.information, tracked.contradicts_odometry)
        step = RelativeMotion(increment, _matched_covariance(prediction, tracked))
        self._path[number] = self._path[self._newest].compose(step)
        self._newest, self._since_map = number, NO_MOTION
        return self._live


def _motion_between(first: RelativeMotion, second: RelativeMotion) -> RelativeMotion:
    """The motion from the end of one to the end of another that goes on from it."""
    increment = se2.between(first.increment, second.increment)
    return RelativeMotion(increment, second.covariance - propagate_covariance(first.covariance, increment))


def _predict_after(before: RelativeMotion, prediction: Prediction) -> Prediction:
    """The prediction of both motions, one after the other."""
    if before is NO_MOTION:
        return prediction
    return prediction._replace(
        odometry=None if prediction.odometry is None else before.compose(prediction.odometry),
        inertia=before.compose(prediction.inertia),
        fused=before.compose(prediction.fused),
    )


def _matched_covariance(prediction: Prediction, tracked: TrackedMotion) -> Float64:
    """Covariance (3, 3) of a motion by its prediction and the match, in the frame of its end."""
    predicted = prediction.inertia if tracked.contradicts_odometry else prediction.fused
    return np.asarray(matrix_inverse(matrix_inverse(predicted.covariance) + tracked.information))


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
