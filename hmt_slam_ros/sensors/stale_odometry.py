"""Stale odometry: readings that fall behind the robot, and then catch up at once.

A driver may repeat a reading while the robot moves on, and later deliver the motion as one jump. Then three things
hold. The first step contradicts the velocity before, since the robot seems to stop. So does the last one, since it
seems to leap. But all steps together agree with it, and no reading lies off the path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import matrix_inverse
from hmt_slam_ros.sensors.relative_motion import RelativeMotion

MAX_STEPS = 100
"""Steps in which a steady motion is looked for, at most: scans may be much closer to each other than readings."""


class SteadyMotionSearch:
    """Looks for the steps over which a robot went on steadily, as more and more of them become known.

    Costs are half squared Mahalanobis distances, nats. What costs more than a fault, by its probability, contradicts.
    """

    def __init__(
        self,
        start: Float64,
        expected: RelativeMotion,
        change: Float64,
        noise: Callable[[Float64], Float64],
        fault_probability: float,
    ) -> None:
        """
        :param start: ``odom_T_base`` (3,) at the last scan.
        :param expected: the motion of the first step by inertia.
        :param change: covariance (3, 3) of the change of motion from step to step.
        :param noise: the covariance (3, 3) of odometry over a motion, a twist (3,).
        :param fault_probability: of stale odometry.
        """
        self._start, self._last, self._expected, self._change, self._noise = start, start, expected, change, noise
        self._velocity, self._fault = se2.log(expected.increment), -math.log(fault_probability)
        # Of each step from the start: the motion, a twist, and the variances of odometry over it.
        self._motions, self._variances = np.empty((MAX_STEPS, 3)), np.empty((MAX_STEPS, 3))
        self.step_count = 0

    def extend(self, poses: Iterable[Float64]) -> int | None:
        """The number of steady steps: 1 where the first is as it was read, None where more poses have to decide.

        :param poses: ``odom_T_base`` (3,) after the next of equal steps of time; at most :data:`MAX_STEPS` in all.
        """
        return next((self.step_count for pose in poses if self._is_decided_by(pose)), None)

    def _is_decided_by(self, pose: Float64) -> bool:
        motion = se2.log(se2.between(self._start, pose))
        noise = self._noise(motion)
        self._motions[self.step_count], self._variances[self.step_count] = motion, noise.diagonal()
        last, self._last = self._last, pose
        self.step_count += 1
        if self.step_count == 1:
            return self._cost(motion, self._expected.covariance, noise) <= self._fault
        step = se2.log(se2.between(last, pose))
        # Velocities walk at random: after n steps by n times the variance of a change, on average by a third of that.
        walked = (self.step_count - 1) * self._change
        if self._cost(step, self._expected.covariance + walked, self._noise(step)) <= self._fault:
            return False
        steady = motion / self.step_count
        cost = self._cost(steady, self._expected.covariance + walked / 3.0, self._noise(steady))
        return cost + self._lag_cost(steady) <= self._fault

    def _cost(self, step: Float64, expected: Float64, noise: Float64) -> float:
        """The cost of a step, a twist (3,), against the velocity before.

        :param expected: covariance (3, 3) of the motion by that velocity; ``noise``, of odometry over the step.
        """
        difference = step - self._velocity
        return 0.5 * float(difference @ matrix_inverse(expected + noise) @ difference)

    def _lag_cost(self, step: Float64) -> float:
        """The cost of motions that should lie between none and the steady one, as readings that lag."""
        motions, variances = self._motions[: self.step_count], self._variances[: self.step_count]
        steady = np.arange(1, self.step_count + 1)[:, None] * step
        differences = motions - np.clip(motions, np.minimum(steady, 0.0), np.maximum(steady, 0.0))
        return 0.5 * float((differences**2 / variances).sum())
