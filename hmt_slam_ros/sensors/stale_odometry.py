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


def count_steady_steps(
    start: Float64,
    poses: Iterable[Float64],
    expected: RelativeMotion,
    change: Float64,
    noise: Callable[[Float64], Float64],
    fault_probability: float,
) -> int | None:
    """Steps over which the robot went on steadily: 1 where the first is as it was read, None where more poses decide.

    Costs are half squared Mahalanobis distances, nats. What costs more than a fault, by its probability, contradicts.

    :param start: ``odom_T_base`` (3,) at the last scan.
    :param poses: ``odom_T_base`` (3,) after equal steps of time since then.
    :param expected: the motion of the first step by inertia.
    :param change: covariance (3, 3) of the change of motion from step to step.
    :param noise: the covariance (3, 3) of odometry over a motion, a twist (3,).
    :param fault_probability: of stale odometry.
    """
    fault, velocity = -math.log(fault_probability), se2.log(expected.increment)
    motions: list[Float64] = []
    last = start
    for count, pose in enumerate(poses, start=1):
        step, last = se2.log(se2.between(last, pose)), pose
        # Velocities walk at random: after n steps by n times the variance of a change, on average by a third of that.
        walked = (count - 1) * change
        contradicts = _cost(step - velocity, expected.covariance + walked + noise(step)) > fault
        if count == 1 and not contradicts:
            return 1
        motions.append(se2.log(se2.between(start, pose)))
        if count == 1 or not contradicts:
            continue
        steady = motions[-1] / count
        cost = _cost(steady - velocity, expected.covariance + walked / 3.0 + noise(steady))
        cost += sum(_lag_cost(motion, k * steady, noise(motion)) for k, motion in enumerate(motions, start=1))
        if cost <= fault:
            return count
    return None


def _cost(difference: Float64, covariance: Float64) -> float:
    return 0.5 * float(difference @ matrix_inverse(covariance) @ difference)


def _lag_cost(motion: Float64, steady: Float64, noise: Float64) -> float:
    """The cost of a motion, a twist (3,), that should lie between none and the steady one, as a reading that lags."""
    difference = motion - np.clip(motion, np.minimum(steady, 0.0), np.maximum(steady, 0.0))
    return 0.5 * float((difference**2 / np.diag(noise)).sum())
