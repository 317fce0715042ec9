"""Poses where the robot was, which are corrected with the state of a stochastic map.

Where nothing shows how far the robot went it drifts, and a line that is seen again tells later how far. That corrects
the robot and the lines seen meanwhile by what their errors have in common, and so it does the poses of keyframes that
were taken on the way: their covariances with the state are kept (stochastic cloning, Roumeliotis and Burdick 2002). Of
the marks among each other no covariance is needed, as nothing is observed from one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2


class Marks(NamedTuple):
    """Poses where the robot was; none of the arrays is ever written to.

    :ivar poses: shape (k, 3), ``map_T_base``, m and rad.
    :ivar common: shape (k, 3, n), covariances of x, y and theta with the state of the map.
    """

    poses: Float64
    common: Float64

    @classmethod
    def fixed(cls, poses: Float64, size: int) -> Marks:
        """Poses (k, 3) that nothing corrects, for a state of so many."""
        return cls(poses.copy(), np.zeros((len(poses), 3, size)))

    def and_robot(self, mean: Float64, covariance: Float64) -> Marks:
        """With one more where the robot is, by the mean (n,) and the covariance (n, n) of the state."""
        return Marks(np.concatenate((self.poses, mean[None, :3])), np.concatenate((self.common, covariance[None, :3])))

    def only(self, rows: Sequence[int]) -> Marks:
        """Some of them, in this order."""
        return Marks(self.poses[list(rows)], self.common[list(rows)])

    def after_motion(self, by_robot: Float64) -> Marks:
        """The robot moved, where its pose after that depends on the one before by (3, 3)."""
        common = self.common.copy()
        common[:, :, :3] = common[:, :, :3] @ by_robot.T
        return self._replace(common=common)

    def corrected(self, told: Float64, kept: Float64) -> Marks:
        """After an observation of the state.

        :param told: H^T S^-1 times the difference of observation and expectation, (n,).
        :param kept: what the state's errors are multiplied by, 1 - K H, (n, n).
        """
        poses = self.poses + self.common @ told
        poses[:, 2] = se2.wrap(poses[:, 2])
        return Marks(poses, self.common @ kept.T)

    def with_line(self, by_robot: Float64) -> Marks:
        """The state has one line more, which depends on the robot's pose by (2, 3)."""
        return self._replace(common=np.concatenate((self.common, self.common[:, :, :3] @ by_robot.T), axis=2))

    def left(self, columns: Int64) -> Marks:
        """Of the state only these are left."""
        return self._replace(common=self.common[:, :, columns])

    def without_robot(self) -> Marks:
        """The robot is elsewhere."""
        common = self.common.copy()
        common[:, :, :3] = 0.0
        return self._replace(common=common)


NO_MARKS = Marks(np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""Of a map that begins."""
