"""When the robot is where: it drives along a path as fast as its speeds and accelerations allow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.simulation.path import Path

ACCELERATION = 0.5
"""Of the robot at most, m/s^2."""

TURN_ACCELERATION = math.radians(90.0)
"""Likewise, rad/s^2."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive along a path in phases of constant acceleration.

    :ivar path: the way.
    :ivar stretches: shape (n,), stretch of the path of each phase.
    :ivar times: shape (n + 1,), s, when each phase begins, and the end of the last.
    :ivar gone: shape (n,), what lies behind the robot on the stretch when the phase begins, m or rad.
    :ivar speeds: shape (n,), when the phase begins, m/s or rad/s.
    :ivar accelerations: shape (n,), m/s^2 or rad/s^2.
    """

    path: Path
    stretches: NDArray[np.intp]
    times: NDArray[np.float64]
    gone: NDArray[np.float64]
    speeds: NDArray[np.float64]
    accelerations: NDArray[np.float64]

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return float(self.times[-1])

    def poses(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3), m and rad, at times (k,), s; before the start and after the end the robot stands."""
        within = np.clip(seconds, 0.0, self.duration)
        phase = np.clip(np.searchsorted(self.times, within, side="right") - 1, 0, self.stretches.size - 1)
        passed = within - self.times[phase]
        gone = self.gone[phase] + (self.speeds[phase] + 0.5 * self.accelerations[phase] * passed) * passed
        return self.path.pose(self.stretches[phase], gone)


def drive_along(path: Path, speed: float, turn_rate: float) -> Drive:
    """Drive a path from standstill to standstill.

    :param speed: at most, m/s.
    :param turn_rate: at most, rad/s.
    """
    sizes, spots = path.sizes, path.on_the_spot
    limits = np.minimum(speed, turn_rate * path.lengths / np.maximum(np.abs(path.turns), 1e-12))
    limits = np.where(spots, turn_rate, limits)
    accelerations = np.where(spots, TURN_ACCELERATION, ACCELERATION)
    joints = _speeds_at_joints(sizes, spots, limits, accelerations)
    phases: list[tuple[float, ...]] = []
    for k, (size, limit, acceleration) in enumerate(zip(sizes, limits, accelerations, strict=True)):
        phases += [(k, *phase) for phase in _phases(size, joints[k], joints[k + 1], limit, acceleration)]
    stretches, durations, gone, speeds, changes = np.array(phases).T
    times = np.concatenate(([0.0], np.cumsum(durations)))
    return Drive(path, stretches.astype(np.intp), times, gone, speeds, changes)


def _speeds_at_joints(
    sizes: NDArray[np.float64],
    spots: NDArray[np.bool_],
    limits: NDArray[np.float64],
    accelerations: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Speed at the begin of every stretch and at the end of the last, shape (n + 1,); 0 beside turns on the spot."""
    joints = np.zeros(sizes.size + 1)
    moving = ~spots
    joints[1:-1] = np.where(moving[1:] & moving[:-1], np.minimum(limits[1:], limits[:-1]), 0.0)
    for k in range(sizes.size):
        joints[k + 1] = min(joints[k + 1], math.sqrt(joints[k] ** 2 + 2.0 * accelerations[k] * sizes[k]))
    for k in reversed(range(sizes.size)):
        joints[k] = min(joints[k], math.sqrt(joints[k + 1] ** 2 + 2.0 * accelerations[k] * sizes[k]))
    return joints


def _phases(size: float, first: float, last: float, limit: float, acceleration: float) -> list[tuple[float, ...]]:
    """Duration, distance gone before, speed and acceleration of: speeding up, going evenly, slowing down."""
    top = min(limit, math.sqrt(acceleration * size + 0.5 * (first**2 + last**2)))
    up, down = (top - first) / acceleration, (top - last) / acceleration
    risen, fallen = 0.5 * (first + top) * up, 0.5 * (top + last) * down
    even = max(0.0, size - risen - fallen)
    phases = [
        (up, 0.0, first, acceleration),
        (even / top, risen, top, 0.0),
        (down, risen + even, top, -acceleration),
    ]
    return [phase for phase in phases if phase[0] > 0.0]
