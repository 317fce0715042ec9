"""State of a line map, as values: its walls, and clones of earlier poses that are corrected with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2


class PoseClones(NamedTuple):
    """Earlier poses of the robot, correlated with the state of the map; the arrays are never written to.

    :ivar poses: shape (k, 3), ``map_T_base``, m and rad.
    :ivar cross_covariances: shape (k, 3, n), covariances of x, y and theta with the state of the map.
    """

    poses: Float64
    cross_covariances: Float64

    @classmethod
    def from_fixed_poses(cls, poses: Float64, size: int) -> PoseClones:
        """Poses (k, 3) without correlations, for a state of ``size`` numbers."""
        return cls(poses.copy(), np.zeros((len(poses), 3, size)))

    def add_robot_pose(self, mean: Float64, covariance: Float64) -> PoseClones:
        """The clones and the robot's pose, from the mean (n,) and the covariance (n, n) of the state."""
        return PoseClones(
            np.concatenate((self.poses, mean[None, :3])), np.concatenate((self.cross_covariances, covariance[None, :3]))
        )

    def select(self, rows: Sequence[int]) -> PoseClones:
        """The clones ``rows``, in this order."""
        return PoseClones(self.poses[list(rows)], self.cross_covariances[list(rows)])

    def propagate(self, by_robot: Float64) -> PoseClones:
        """The clones after a motion of the robot.

        :param by_robot: Jacobian of its new pose by the old one, (3, 3).
        """
        cross_covariances = self.cross_covariances.copy()
        cross_covariances[:, :, :3] = cross_covariances[:, :, :3] @ by_robot.T
        return self._replace(cross_covariances=cross_covariances)

    def correct(self, innovation: Float64, remaining: Float64) -> PoseClones:
        """The clones after an observation of the state.

        :param innovation: H^T S^-1 times the difference of observation and expectation, (n,).
        :param remaining: factor on the state's errors, 1 - K H, (n, n).
        """
        poses = self.poses + self.cross_covariances @ innovation
        poses[:, 2] = se2.wrap(poses[:, 2])
        return PoseClones(poses, self.cross_covariances @ remaining.T)

    def add_line(self, by_robot: Float64) -> PoseClones:
        """The clones after a new line enters the state.

        :param by_robot: Jacobian of the line by the robot's pose, (2, 3).
        """
        with_line = self.cross_covariances[:, :, :3] @ by_robot.T
        return self._replace(cross_covariances=np.concatenate((self.cross_covariances, with_line), axis=2))

    def select_columns(self, columns: Int64) -> PoseClones:
        """The clones after all but these numbers leave the state."""
        return self._replace(cross_covariances=self.cross_covariances[:, :, columns])

    def decorrelate_robot(self) -> PoseClones:
        """The clones after the robot was moved without odometry."""
        cross_covariances = self.cross_covariances.copy()
        cross_covariances[:, :, :3] = 0.0
        return self._replace(cross_covariances=cross_covariances)


NO_CLONES = PoseClones(np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""The clones of a new map."""


class WallLine(NamedTuple):
    """A line of the map, beside its numbers in the state.

    :ivar number: unique in the map, also over time.
    :ivar sightings: number of scans that showed it.
    :ivar segments: begin and end of its visible segments, (m, 2), m along its direction (-sin(alpha), cos(alpha)) from
        the foot of the perpendicular.
    """

    number: int
    sightings: int
    segments: Float64


class LineMapState(NamedTuple):
    """A stochastic map, as a value.

    :ivar mean: shape (3 + 2 n,), x and y in m, theta in rad, then alpha in rad and r in m of each line.
    :ivar covariance: shape (3 + 2 n, 3 + 2 n).
    :ivar walls: the n lines, in the order of the state.
    :ivar next_number: number of the next new line.
    :ivar clones: earlier poses of the robot.
    """

    mean: Float64
    covariance: Float64
    walls: tuple[WallLine, ...]
    next_number: int
    clones: PoseClones
