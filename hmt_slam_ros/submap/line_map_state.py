"""What a map of lines remembers, as values: its walls, and marks, which are poses that are corrected with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2


class PoseClones(NamedTuple):
    """Poses where the robot was; none of the arrays is ever written to.

    :ivar poses: shape (k, 3), ``map_T_base``, m and rad.
    :ivar cross_covariances: shape (k, 3, n), covariances of x, y and theta with the state of the map.
    """

    poses: Float64
    cross_covariances: Float64

    @classmethod
    def from_fixed_poses(cls, poses: Float64, size: int) -> PoseClones:
        """Poses (k, 3) that nothing corrects, for a state of so many."""
        return cls(poses.copy(), np.zeros((len(poses), 3, size)))

    def add_robot_pose(self, mean: Float64, covariance: Float64) -> PoseClones:
        """With one more where the robot is, by the mean (n,) and the covariance (n, n) of the state."""
        return PoseClones(
            np.concatenate((self.poses, mean[None, :3])), np.concatenate((self.cross_covariances, covariance[None, :3]))
        )

    def select(self, rows: Sequence[int]) -> PoseClones:
        """Some of them, in this order."""
        return PoseClones(self.poses[list(rows)], self.cross_covariances[list(rows)])

    def propagate(self, by_robot: Float64) -> PoseClones:
        """The robot moved, where its pose after that depends on the one before by (3, 3)."""
        common = self.cross_covariances.copy()
        common[:, :, :3] = common[:, :, :3] @ by_robot.T
        return self._replace(cross_covariances=common)

    def correct(self, told: Float64, kept: Float64) -> PoseClones:
        """After an observation of the state.

        :param told: H^T S^-1 times the difference of observation and expectation, (n,).
        :param kept: what the state's errors are multiplied by, 1 - K H, (n, n).
        """
        poses = self.poses + self.cross_covariances @ told
        poses[:, 2] = se2.wrap(poses[:, 2])
        return PoseClones(poses, self.cross_covariances @ kept.T)

    def add_line(self, by_robot: Float64) -> PoseClones:
        """The state has one line more, which depends on the robot's pose by (2, 3)."""
        return self._replace(
            cross_covariances=np.concatenate(
                (self.cross_covariances, self.cross_covariances[:, :, :3] @ by_robot.T), axis=2
            )
        )

    def select_columns(self, columns: Int64) -> PoseClones:
        """Of the state only these are left."""
        return self._replace(cross_covariances=self.cross_covariances[:, :, columns])

    def decorrelate_robot(self) -> PoseClones:
        """The robot is elsewhere."""
        common = self.cross_covariances.copy()
        common[:, :, :3] = 0.0
        return self._replace(cross_covariances=common)


NO_CLONES = PoseClones(np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""Of a map that begins."""


class WallLine(NamedTuple):
    """What the map knows of a line beside its place in the state.

    :ivar number: a number that no other line of the map ever has.
    :ivar sightings: scans that showed it.
    :ivar segments: where the stretches that were seen begin and end, (m, 2), m along its direction
        (-sin(alpha), cos(alpha)) from the foot of the perpendicular.
    """

    number: int
    sightings: int
    segments: Float64


class LineMapState(NamedTuple):
    """A stochastic map as a value.

    :ivar mean: shape (3 + 2 n,), x and y in m, theta in rad, then alpha in rad and r in m of each line.
    :ivar covariance: shape (3 + 2 n, 3 + 2 n).
    :ivar walls: the n lines, in the order of the state.
    :ivar next_number: how many lines were given one.
    :ivar clones: poses where the robot was.
    """

    mean: Float64
    covariance: Float64
    walls: tuple[WallLine, ...]
    next_number: int
    clones: PoseClones


# A line this near to the robot may be on its other side, in deviations of r.
