"""Scripted drives: the path through way-points, its timing, and the odometry of the wheels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.relative_motion import path_standard_deviations

ACCELERATION = 0.5
"""Largest acceleration of the robot, m/s^2."""

TURN_ACCELERATION = math.radians(90.0)
"""Largest angular acceleration of the robot, rad/s^2."""

_MAX_ROUNDED_TURN = math.radians(120.0)
"""Largest turn on an arc, rad; for larger ones the robot stops and turns on the spot."""

_EPSILON = 1e-9
"""Lengths, m, and turns, rad, up to this are 0."""

_SLIP_DEVIATIONS = np.array([0.3, 0.0, math.radians(15.0)])
"""Deviations of a slip, m, m, rad."""

_SLIP_DURATION = 1.0
"""Duration of a slip, s."""

_ITERATIONS = 40
"""Iterations of the fixed point of `add_odometry_noise`."""


@dataclass(frozen=True, eq=False)
class DrivePath:
    """A path of segments of constant curvature.

    :ivar starts: shape (n, 3), ``world_T_base`` at the begin of each, m and rad.
    :ivar lengths: shape (n,), m; 0 for a turn on the spot.
    :ivar turns: shape (n,), rad, positive to the left.
    """

    starts: NDArray[np.float64]
    lengths: NDArray[np.float64]
    turns: NDArray[np.float64]

    @cached_property
    def ends(self) -> NDArray[np.float64]:
        """Distance along the path of the end of each segment, shape (n,), m."""
        return np.cumsum(self.lengths)

    @cached_property
    def begins(self) -> NDArray[np.float64]:
        """Distance along the path of the begin of each segment, shape (n,), m."""
        return self.ends - self.lengths

    @property
    def is_turn_in_place(self) -> NDArray[np.bool_]:
        """Whether segments are turns on the spot, shape (n,)."""
        return self.lengths == 0.0

    @cached_property
    def sizes(self) -> NDArray[np.float64]:
        """Size of each segment, shape (n,), m, or rad for turns on the spot."""
        return np.where(self.is_turn_in_place, np.abs(self.turns), self.lengths)

    def poses_at(self, segments: NDArray[np.intp], offsets: NDArray[np.float64]) -> NDArray[np.float64]:
        """``world_T_base`` (k, 3) at offsets on segments, in the unit of `sizes`; both of shape (k,)."""
        share = offsets / self.sizes[segments]
        twists = np.zeros((segments.size, 3))
        twists[:, 0], twists[:, 2] = self.lengths[segments], self.turns[segments]
        return se2.compose(self.starts[segments], se2.exp(share[:, None] * twists))


def path_through(points: NDArray[np.float64], rounding: float) -> DrivePath:
    """The path through way-points.

    :param points: shape (k, 2), m.
    :param rounding: radius of the arcs at corners, m; smaller where a leg is too short.
    :raises HmtSlamError: for way-points that are all equal.
    """
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    apart = lengths > _EPSILON
    if not apart.any():
        raise HmtSlamError("the route has no two different way-points: give at least two.")
    lengths, headings = lengths[apart], np.arctan2(legs[apart, 1], legs[apart, 0])
    turns = se2.wrap(np.diff(headings))
    cuts = _cuts(lengths, turns, rounding)
    segments: list[tuple[float, float]] = []
    for k, length in enumerate(lengths.tolist()):
        before, after = (cuts[k - 1] if k else 0.0), (cuts[k] if k < turns.size else 0.0)
        segments.append((length - before - after, 0.0))
        if k < turns.size and abs(turns[k]) > _EPSILON:
            radius = after / math.tan(0.5 * abs(turns[k])) if after else 0.0
            segments.append((radius * abs(turns[k]), turns[k]))
    segments = [segment for segment in segments if max(map(abs, segment)) > _EPSILON]
    return _chain_segments(np.array([*points[0], headings[0]]), segments)


def _cuts(lengths: NDArray[np.float64], turns: NDArray[np.float64], rounding: float) -> NDArray[np.float64]:
    """Distance from each corner to the begin and the end of its arc, m; 0 for a turn on the spot."""
    room = 0.5 * np.minimum(lengths[:-1], lengths[1:])
    sharp = np.abs(turns) > _MAX_ROUNDED_TURN
    half = 0.5 * np.where(sharp, 0.0, np.abs(turns))
    return np.where(sharp, 0.0, np.minimum(rounding * np.tan(half), room))


def _chain_segments(start: NDArray[np.float64], segments: list[tuple[float, float]]) -> DrivePath:
    starts = [start]
    for length, turn in segments:
        starts.append(se2.compose(starts[-1], se2.exp(np.array([length, 0.0, turn]))))
    lengths, turns = np.array(segments).T
    return DrivePath(np.array(starts[:-1]), lengths, turns)


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive along a path in phases of constant acceleration.

    :ivar path: the path.
    :ivar segments: shape (n,), segment of the path of each phase.
    :ivar times: shape (n + 1,), begin of each phase, and the end of the last, s.
    :ivar offsets: shape (n,), offset on the segment at the begin of the phase, m or rad.
    :ivar speeds: shape (n,), at the begin of the phase, m/s or rad/s.
    :ivar accelerations: shape (n,), m/s^2 or rad/s^2.
    """

    path: DrivePath
    segments: NDArray[np.intp]
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
        phase = np.clip(np.searchsorted(self.times, within, side="right") - 1, 0, self.segments.size - 1)
        passed = within - self.times[phase]
        offsets = self.offsets[phase] + (self.speeds[phase] + 0.5 * self.accelerations[phase] * passed) * passed
        return self.path.poses_at(self.segments[phase], offsets)


def drive_along(path: DrivePath, speed: float, turn_rate: float) -> Drive:
    """A drive along a path, from standstill to standstill.

    :param speed: at most, m/s.
    :param turn_rate: at most, rad/s.
    """
    sizes, in_place = path.sizes, path.is_turn_in_place
    limits = np.minimum(speed, turn_rate * path.lengths / np.maximum(np.abs(path.turns), 1e-12))
    limits = np.where(in_place, turn_rate, limits)
    accelerations = np.where(in_place, TURN_ACCELERATION, ACCELERATION)
    joints = _speeds_at_joints(sizes, in_place, limits, accelerations)
    phases: list[tuple[float, ...]] = []
    for k, (size, limit, acceleration) in enumerate(zip(sizes, limits, accelerations, strict=True)):
        phases += [(k, *phase) for phase in _phases(size, joints[k], joints[k + 1], limit, acceleration)]
    segments, durations, offsets, speeds, changes = np.array(phases).T
    times = np.concatenate(([0.0], np.cumsum(durations)))
    return Drive(path, segments.astype(np.intp), times, offsets, speeds, changes)


def _speeds_at_joints(
    sizes: NDArray[np.float64],
    in_place: NDArray[np.bool_],
    limits: NDArray[np.float64],
    accelerations: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Speed at the begin of each segment and at the end of the last, shape (n + 1,); 0 beside turns on the spot."""
    joints = np.zeros(sizes.size + 1)
    moving = ~in_place
    joints[1:-1] = np.where(moving[1:] & moving[:-1], np.minimum(limits[1:], limits[:-1]), 0.0)
    for k in range(sizes.size):
        joints[k + 1] = min(joints[k + 1], math.sqrt(joints[k] ** 2 + 2.0 * accelerations[k] * sizes[k]))
    for k in reversed(range(sizes.size)):
        joints[k] = min(joints[k], math.sqrt(joints[k + 1] ** 2 + 2.0 * accelerations[k] * sizes[k]))
    return joints


def _phases(size: float, first: float, last: float, limit: float, acceleration: float) -> list[tuple[float, ...]]:
    """Duration, offset, speed and acceleration of the phases of a segment: accelerating, constant, braking."""
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


def noisy_increments(
    increments: NDArray[np.float64], factor: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """Motions from scan to scan as measured by odometry.

    A measured motion is such that the true one, relative to its end, is a draw from the covariance of
    `motion_model.increment_covariance` for the measured motion. So the filters' assumption on odometry is exactly true.

    :param increments: shape (n, 3), true motions, m and rad.
    :param factor: on all deviations.
    :returns: shape (n, 3).
    """
    return add_odometry_noise(increments, factor, random.standard_normal(increments.shape))


def add_odometry_noise(
    increments: NDArray[np.float64], factor: float, draws: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The measured motions of `noisy_increments` for standard normal draws (n, 3)."""
    motion = MotionParameters()
    measured = increments
    for _ in range(_ITERATIONS):
        deviations = factor * _deviations(measured, motion)
        # Half steps reach the fixed point for all draws that have one.
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
    """Errors (n, 3) of the increments by slipping wheels, m, m, rad.

    :param distances: shape (n,), from scan to scan, m.
    :param period: from scan to scan, s.
    :param per_100_m: expected slips on 100 m.
    """
    steps = max(1, round(_SLIP_DURATION / period))
    begins = random.random(distances.size) < 0.01 * per_100_m * distances
    sizes = _SLIP_DEVIATIONS * random.standard_normal((distances.size, 3)) * begins[:, None]
    spread = np.cumsum(sizes, axis=0)
    spread[steps:] -= spread[:-steps].copy()
    return spread / steps


def odometry_readings(poses: NDArray[np.float64], per_scan: int, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Odometry readings of measured motions, whose errors grow linearly between two scans.

    :param poses: shape (n, 3), true poses at the readings, every ``per_scan``-th from the first at a scan.
    :param measured: shape (k - 1, 3), measured motions between the k scans.
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
    """Poses (n + 1, 3) from the origin on by increments (n, 3)."""
    poses = [np.zeros(3)]
    for increment in increments:
        poses.append(se2.compose(poses[-1], increment))
    return np.array(poses)
