"""The robot's way through way-points, and when it is where on it.

What the wheels say: odometry with the noise that the motion model states, and slips that it does not know."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.motion_model import path_standard_deviations

_MAX_ROUNDED_TURN = math.radians(120.0)  # beyond it the robot stops and turns on the spot
_EPSILON = 1e-9


class DrivePath(NamedTuple):
    """Stretches of constant curvature, one after the other.

    :ivar starts: shape (n, 3), ``world_T_base`` where each begins, m and rad.
    :ivar lengths: shape (n,), m; 0 for a turn on the spot.
    :ivar turns: shape (n,), rad, positive to the left.
    """

    starts: NDArray[np.float64]
    lengths: NDArray[np.float64]
    turns: NDArray[np.float64]

    @property
    def is_turn_in_place(self) -> NDArray[np.bool_]:
        """Stretches on which the robot only turns, shape (n,)."""
        return self.lengths == 0.0

    @property
    def sizes(self) -> NDArray[np.float64]:
        """How far to go on each stretch, shape (n,): m, or rad on the spot."""
        return np.where(self.is_turn_in_place, np.abs(self.turns), self.lengths)

    def poses_at(self, stretch: NDArray[np.intp], gone: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3) after going a part of a stretch, in the unit of `sizes`; both of shape (k,)."""
        share = gone / self.sizes[stretch]
        twists = np.stack((self.lengths[stretch], np.zeros(stretch.size), self.turns[stretch]), axis=1)
        return se2.compose(self.starts[stretch], se2.exp(share[:, None] * twists))


def path_through(points: NDArray[np.float64], rounding: float) -> DrivePath:
    """The way through way-points.

    :param points: shape (k, 2), m.
    :param rounding: radius of the arcs at corners, m; smaller where a leg is too short for it.
    :raises HmtSlamError: where all way-points are one.
    """
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    apart = lengths > _EPSILON
    if not apart.any():
        raise HmtSlamError("the route has no two different way-points: give at least two.")
    lengths, headings = lengths[apart], np.arctan2(legs[apart, 1], legs[apart, 0])
    turns = se2.wrap(np.diff(headings))
    cuts = _cuts(lengths, turns, rounding)
    stretches: list[tuple[float, float]] = []
    for k, length in enumerate(lengths.tolist()):
        before, after = (cuts[k - 1] if k else 0.0), (cuts[k] if k < turns.size else 0.0)
        stretches.append((length - before - after, 0.0))
        if k < turns.size and abs(turns[k]) > _EPSILON:
            radius = after / math.tan(0.5 * abs(turns[k])) if after else 0.0
            stretches.append((radius * abs(turns[k]), turns[k]))
    return _chain_segments(
        np.array([*points[0], headings[0]]), [part for part in stretches if max(map(abs, part)) > _EPSILON]
    )


def _cuts(lengths: NDArray[np.float64], turns: NDArray[np.float64], rounding: float) -> NDArray[np.float64]:
    """How far before and behind each corner its arc begins and ends, m; 0 for a turn on the spot."""
    room = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    sharp = np.abs(turns) > _MAX_ROUNDED_TURN
    half = 0.5 * np.where(sharp, 0.0, np.abs(turns))
    return np.where(sharp, 0.0, np.minimum(rounding * np.tan(half), room))


def _chain_segments(start: NDArray[np.float64], stretches: list[tuple[float, float]]) -> DrivePath:
    starts = [start]
    for length, turn in stretches:
        starts.append(se2.compose(starts[-1], se2.exp(np.array([length, 0.0, turn]))))
    lengths, turns = np.array(stretches).T
    return DrivePath(np.array(starts[:-1]), lengths, turns)


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
    :ivar offsets: shape (n,), what lies behind the robot on the stretch when the phase begins, m or rad.
    :ivar speeds: shape (n,), when the phase begins, m/s or rad/s.
    :ivar accelerations: shape (n,), m/s^2 or rad/s^2.
    """

    path: DrivePath
    stretches: NDArray[np.intp]
    times: NDArray[np.float64]
    offsets: NDArray[np.float64]
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
        gone = self.offsets[phase] + (self.speeds[phase] + 0.5 * self.accelerations[phase] * passed) * passed
        return self.path.poses_at(self.stretches[phase], gone)


def drive_along(path: DrivePath, speed: float, turn_rate: float) -> Drive:
    """Drive a path from standstill to standstill.

    :param speed: at most, m/s.
    :param turn_rate: at most, rad/s.
    """
    sizes, spots = path.sizes, path.is_turn_in_place
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


_SLIP = np.array([0.3, 0.0, math.radians(15.0)])  # deviation of a slip, m, m, rad
_ITERATIONS = 40


def noisy_increments(
    increments: NDArray[np.float64], factor: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """What odometry measures of motions from one scan to the next.

    The measured motion is the one for which the truth, seen from its end, is a draw from the covariance that
    `motion_model.increment_covariance` states for that measured motion: what the filters assume of the
    odometry is exactly true.

    :param increments: shape (n, 3), true motions, m and rad.
    :param factor: on all deviations.
    :returns: shape (n, 3).
    """
    return add_odometry_noise(increments, factor, random.standard_normal(increments.shape))


def add_odometry_noise(
    increments: NDArray[np.float64], factor: float, draws: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What `noisy_increments` makes of standard normal draws (n, 3)."""
    motion = MotionParameters()
    measured = increments
    for _ in range(_ITERATIONS):
        deviations = factor * _deviations(measured, motion)
        # Half of the way: the fixed point is reached for all draws that have one.
        measured = se2.interpolate(measured, se2.compose(increments, se2.exp(-deviations * draws)), 0.5)
    return measured


def _deviations(increments: NDArray[np.float64], motion: MotionParameters) -> NDArray[np.float64]:
    """Deviations (n, 3) of x, y and heading, m, m, rad, that the motion model states for increments (n, 3)."""
    distances = np.hypot(increments[:, 0], increments[:, 1])
    translation, rotation = path_standard_deviations(distances, np.abs(increments[:, 2]), motion)
    return np.stack((translation, translation, rotation), axis=1)


def draw_slips(
    distances: NDArray[np.float64], period: float, per_100_m: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Errors (n, 3) that wheels which slip add to the increments, m, m, rad; each slip lasts about a second.

    :param distances: shape (n,), driven from one scan to the next, m.
    :param period: from one scan to the next, s.
    :param per_100_m: slips to be expected on 100 m.
    """
    steps = max(1, round(1.0 / period))
    begins = random.random(distances.size) < 0.01 * per_100_m * distances
    sizes = _SLIP * random.standard_normal((distances.size, 3)) * begins[:, None]
    spread = np.cumsum(sizes, axis=0)
    spread[steps:] -= spread[:-steps].copy()
    return spread / steps


def odometry_readings(poses: NDArray[np.float64], per_scan: int, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Odometry readings with given motions from scan to scan, whose errors grow evenly between two scans.

    :param poses: shape (n, 3), true poses at the readings, the first of them and every ``per_scan``-th at a scan.
    :param measured: shape (k - 1, 3), what odometry says of the motion between the k scans.
    :returns: shape (n, 3), ``odom_T_base``, from the origin on.
    """
    starts = poses[::per_scan]
    errors = se2.log(se2.between(se2.between(starts[:-1], starts[1:]), measured))
    odometry = np.empty_like(poses)
    odometry[::per_scan] = integrate_increments(measured)
    for k in range(1, per_scan):
        true = se2.between(starts[:-1], poses[k::per_scan])
        odometry[k::per_scan] = se2.compose(odometry[:-1:per_scan], se2.compose(true, se2.exp(k / per_scan * errors)))
    return odometry


def integrate_increments(increments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (n + 1, 3) that begin at the origin and follow increments (n, 3)."""
    poses = [np.zeros(3)]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment))
    return np.array(poses)
