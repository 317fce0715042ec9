"""A robot that is carried somewhere else while it drives: it goes on from there, and its wheels know nothing of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation.driver import Drive
from hmt_slam_ros.simulation.settings import Settings


@dataclass(frozen=True)
class CarriedDrive:
    """A drive of which a part is left out or driven once more; where it goes on, the robot first turns to its way.

    :ivar drive: without that.
    :ivar at: s, when the robot is carried, in no time.
    :ivar to: s, the time at which the drive passes where it is put.
    :ivar turned: rad, by how much more than there it is turned to the left when it is put down.
    :ivar turning: s, that it takes to turn back.
    """

    drive: Drive
    at: float
    to: float
    turned: float
    turning: float

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return self.at + self.turning + self.drive.duration - self.to

    def poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3), m and rad, at times (k,), s."""
        since = seconds - self.at
        poses = self.drive.poses(np.where(since < 0.0, seconds, self.to + np.maximum(0.0, since - self.turning)))
        left = 1.0 - np.clip(since / max(self.turning, 1e-9), 0.0, 1.0)
        poses[:, 2] = se2.wrap(poses[:, 2] + np.where(since < 0.0, 0.0, left * self.turned))
        return poses

    def rolled(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same as exact wheels have it, (k, 3): nothing happened when it was carried."""
        poses = self.poses(seconds)
        before = self.drive.poses(np.array([self.at]))[0]
        jump = se2.compose(before, se2.inverse(self.poses(np.array([self.at]))[0]))
        late = seconds >= self.at
        poses[late] = se2.compose(jump, poses[late])
        return poses


def carried(drive: Drive, settings: Settings) -> CarriedDrive | None:
    """The drive with what settings say of a robot that is carried, None where it never is."""
    if settings.carried == 0.0:
        return None
    turned = math.radians(settings.turned)
    turning = abs(settings.turned) / settings.turn_rate
    return CarriedDrive(drive, settings.carried * drive.duration, settings.to * drive.duration, turned, turning)
