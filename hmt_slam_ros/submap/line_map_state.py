"""What a map of lines remembers, as values: its walls, and marks, which are poses that are corrected with them."""

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


NO_CLONES = Marks(np.zeros((0, 3)), np.zeros((0, 3, 3)))
"""Of a map that begins."""


class Wall(NamedTuple):
    """What the map knows of a line beside its place in the state.

    :ivar name: a number that no other line of the map ever has.
    :ivar sightings: scans that showed it.
    :ivar pieces: where the stretches that were seen begin and end, (m, 2), m along its direction
        (-sin(alpha), cos(alpha)) from the foot of the perpendicular.
    """

    name: int
    sightings: int
    pieces: Float64


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
    walls: tuple[Wall, ...]
    next_number: int
    clones: Marks


# A line this near to the robot may be on its other side, in deviations of r.
