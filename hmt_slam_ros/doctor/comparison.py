"""Odometry against the motion by scans: what constant fault of clock, mounting or scale explains their difference.

The scans give the motion of where the laser is said to be. With E the pose of where it truly would be on the robot
that the odometry moves, odometry_motion E = E scan_motion; for a plane that is linear in E and in the scale of
the odometry (Censi et al., Simultaneous calibration of odometry and sensor parameters for mobile robots, 2013).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.doctor.statistics import OdometryStatistics, ScanMotions
from hmt_slam_ros.geometry import se2

# Of the points of a scan, so many have to meet a wall of the other for a motion to count.
_MIN_MATCHED = 0.45
# A motion along a direction counts where the scans show it by so much, against a point that shows all of it.
_MIN_OBSERVABILITY = 0.1
# A motion is a turn beyond this, and a way beyond that.
_MIN_TURN, _MIN_DISTANCE = math.radians(1.5), 0.03
# Clock offsets that are tried, s, and the longest time between scans over which they show.
_OFFSETS, _LONGEST = np.arange(-1.0, 1.001, 0.02), 0.6
# An offset has to explain so much of what the headings differ, or there is none.
_MIN_EXPLAINED = 0.35
# Turns in all, rad, and way in all, m, and motions from which a fault is judged.
_MIN_TOTAL_TURN, _MIN_TOTAL_DISTANCE, _MIN_MOTIONS = math.radians(120.0), 3.0, 15
_ROUNDS = 30
# A value is off only as far as it is beyond so many of its deviations: poor odometry and bare walls make them large.
_SIGNIFICANCE = 3.0


@dataclass(frozen=True, eq=False)
class ScalarEstimate:
    """A value with its standard deviation."""

    value: float
    deviation: float

    def excess(self, tolerance: float, neutral: float = 0.0) -> float:
        """By how many tolerances it is surely off its neutral value."""
        return max(0.0, abs(self.value - neutral) - _SIGNIFICANCE * self.deviation) / tolerance


@dataclass(frozen=True, eq=False)
class OdometryComparison:
    """What odometry and scans say of the same motions.

    :ivar clock_offset: what has to be added to a scan's stamp to have the odometry's time of it, s; None if it cannot
        be told.
    :ivar is_mirrored: whether scans and odometry turn to opposite sides.
    :ivar rotation_scale: the odometry's turns as a factor on the scans'; None where the robot hardly turned.
    :ivar translation_scale: the odometry's ways as a factor on the scans'; None where the robot hardly went.
    :ivar laser_yaw: by which the laser is turned against what is said of it, rad; None as above.
    :ivar laser_forward: by which it is farther ahead than is said, m; None where the robot hardly turned.
    :ivar laser_left: likewise, to the left.
    :ivar motion_count: motions by scans that were good enough.
    :ivar moving_count: of these, those in which the scans say that the robot moved.
    :ivar frozen_count: of these, those in which the odometry says that it stood.
    :ivar slip_share: share of the moving, apart from the frozen, in which the two differ by far.
    """

    clock_offset: float | None
    is_mirrored: bool
    rotation_scale: ScalarEstimate | None
    translation_scale: ScalarEstimate | None
    laser_yaw: ScalarEstimate | None
    laser_forward: ScalarEstimate | None
    laser_left: ScalarEstimate | None
    motion_count: int
    moving_count: int
    frozen_count: int
    slip_share: float


def compare_odometry(odometry: OdometryStatistics, motions: ScanMotions) -> OdometryComparison | None:
    """Compare odometry with the motions by scans; None where there is nothing to compare."""
    if len(odometry.stamps) < 2:
        return None
    inside = (motions.starts >= odometry.stamps[0]) & (motions.ends <= odometry.stamps[-1])
    motions = motions.select(inside & (motions.matched >= _MIN_MATCHED))
    if len(motions.starts) < _MIN_MOTIONS:
        return None
    offset = _clock_offset(odometry, motions)
    driven = _odometry_motions(odometry, motions, offset or 0.0)
    frozen = _is_frozen(driven, motions.motions)
    rotation = _rotation_scale(driven[~frozen, 2], motions.motions[~frozen, 2])
    mirrored = False
    if rotation is not None and rotation.value < 0.0:
        mirrored = True
        motions, rotation = _mirror(motions), ScalarEstimate(-rotation.value, rotation.deviation)
    return _estimate_comparison(driven, motions, frozen, offset, mirrored, rotation)


def _odometry_motions(odometry: OdometryStatistics, motions: ScanMotions, offset: float) -> Float64:
    """The motions (p, 3) by odometry, headings not wrapped."""
    starts, ends = (
        odometry.poses_at(stamps.astype(np.float64) + offset * 1e9) for stamps in (motions.starts, motions.ends)
    )
    increments = se2.between(starts, ends)
    increments[:, 2] = ends[:, 2] - starts[:, 2]
    return increments


def _is_frozen(driven: Float64, scanned: Float64) -> Bool:
    """Where odometry says to the last bit that nothing moved, and the scans that much did."""
    return _is_moving(scanned, 2.0) & (np.abs(driven) < 1e-6).all(axis=1)


def _is_moving(motions: Float64, times: float) -> Bool:
    return (np.hypot(motions[:, 0], motions[:, 1]) > times * _MIN_DISTANCE) | (
        np.abs(motions[:, 2]) > times * _MIN_TURN
    )


def _clock_offset(odometry: OdometryStatistics, motions: ScanMotions) -> float | None:
    """The offset, s, for which turns by odometry and by scans correlate best; 0 where none explains much more."""
    seconds = (motions.ends - motions.starts) * 1e-9
    chosen = motions.select(seconds < _LONGEST)
    turns = chosen.motions[:, 2]
    if np.abs(turns[np.abs(turns) > _MIN_TURN]).sum() < _MIN_TOTAL_TURN:
        return None
    likeness = np.array(
        [abs(_correlation(_odometry_motions(odometry, chosen, offset)[:, 2], turns)) for offset in _OFFSETS]
    )
    best, none = int(np.argmax(likeness)), int(np.argmin(np.abs(_OFFSETS)))
    if 1.0 - likeness[best] > (1.0 - _MIN_EXPLAINED) * (1.0 - likeness[none]) or best in (0, len(_OFFSETS) - 1):
        return 0.0
    before, at, after = likeness[best - 1 : best + 2]
    curvature = before - 2.0 * at + after
    return float(_OFFSETS[best] + (0.02 * 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0))


def _correlation(one: Float64, other: Float64) -> float:
    """Of two series (n,), each cut off at what few of its values exceed, so that single ones do not decide."""
    a, b = _clip_outliers(one), _clip_outliers(other)
    return float(a @ b) / math.sqrt(max(float(a @ a) * float(b @ b), 1e-24))


def _clip_outliers(series: Float64) -> Float64:
    limit = max(_MIN_TURN, float(np.percentile(np.abs(series), 98)))
    return np.clip(series, -limit, limit)


def _rotation_scale(driven: Float64, scanned: Float64) -> ScalarEstimate | None:
    """The factor between turns (n,)."""
    turning = np.abs(scanned) > _MIN_TURN
    if turning.sum() < _MIN_MOTIONS or np.abs(scanned[turning]).sum() < _MIN_TOTAL_TURN:
        return None
    values, covariance = _robust_fit(scanned[turning, None], driven[turning], np.ones(turning.sum()))
    return ScalarEstimate(float(values[0]), math.sqrt(covariance[0, 0]))


def _mirror(motions: ScanMotions) -> ScanMotions:
    """As they would be with left and right exchanged."""
    mirror = np.array([1.0, -1.0, -1.0])
    information = motions.information * np.outer(mirror, mirror)
    return ScanMotions(motions.starts, motions.ends, motions.motions * mirror, information, motions.matched)


def _estimate_comparison(
    driven: Float64,
    motions: ScanMotions,
    frozen: Bool,
    offset: float | None,
    mirrored: bool,
    rotation: ScalarEstimate | None,
) -> OdometryComparison:
    scanned = motions.motions
    turn_scale = rotation.value if rotation is not None else 1.0
    usable = ~frozen & (np.abs(driven[:, 2] - turn_scale * scanned[:, 2]) < np.radians(5.0))
    turning = np.abs(scanned[:, 2]) > _MIN_TURN
    going = usable & (_is_observable(motions) > 0.0) & (np.hypot(scanned[:, 0], scanned[:, 1]) > _MIN_DISTANCE)
    translation = yaw = forward = left = None
    lever = rotation is not None and (usable & turning).sum() >= _MIN_MOTIONS
    values = np.array([0.0, 0.0, 1.0, 0.0])
    if going.sum() >= _MIN_MOTIONS and np.hypot(*scanned[going, :2].T).sum() >= _MIN_TOTAL_DISTANCE:
        rows = np.flatnonzero(usable & (going | turning))
        values, covariance = _fit_mounting(driven[rows], motions.select(rows), lever=lever)
        scale = math.hypot(values[2], values[3])
        sigma = math.sqrt(max(covariance[2, 2], covariance[3, 3]))
        translation = ScalarEstimate(scale, sigma)
        yaw = ScalarEstimate(math.atan2(values[3], values[2]), sigma / scale)
        if lever:
            forward, left = (ScalarEstimate(float(values[k]), math.sqrt(covariance[k, k])) for k in (0, 1))
    differences = _residuals(driven, scanned, values, turn_scale)
    moving = _is_moving(scanned, 1.0)
    slipped = _slip_share(differences, motions, moving & ~frozen)
    return OdometryComparison(
        offset,
        mirrored,
        rotation,
        translation,
        yaw,
        forward,
        left,
        len(scanned),
        int(moving.sum()),
        int(frozen.sum()),
        slipped,
    )


def _fit_mounting(driven: Float64, motions: ScanMotions, *, lever: bool) -> tuple[Float64, Float64]:
    """Forward, left, m, and scale times cosine and sine of the yaw; with their covariance (4, 4)."""
    scanned = motions.motions
    cos, sin = np.cos(scanned[:, 2]), np.sin(scanned[:, 2])
    x, y = scanned[:, 0], scanned[:, 1]
    # (R - 1) e - scale R(yaw) t = -t_odometry, two rows each.
    rows = np.stack([np.stack([cos - 1.0, -sin, -x, y], axis=1), np.stack([sin, cos - 1.0, -y, -x], axis=1)], axis=1)
    if not lever:
        rows[:, :, :2] = 0.0
    weights = _is_observable(motions)
    return _robust_fit(rows.reshape(-1, 4), -driven[:, :2].reshape(-1), np.repeat(weights, 2))


def _is_observable(motions: ScanMotions) -> Float64:
    """Which motions (p,) the scans show in all directions: 1, else 0."""
    spectra = np.linalg.eigvalsh(motions.information[:, :2, :2])
    return (spectra[:, 0] > _MIN_OBSERVABILITY * spectra[:, 1]).astype(np.float64)


def _residuals(driven: Float64, scanned: Float64, values: Float64, turn_scale: float) -> Float64:
    """What odometry and scans differ by (p, 3), along the odometry's axes, once the constant faults are gone."""
    cos, sin = np.cos(scanned[:, 2]), np.sin(scanned[:, 2])
    ex, ey, a, b = values
    x = (cos - 1.0) * ex - sin * ey - a * scanned[:, 0] + b * scanned[:, 1] + driven[:, 0]
    y = sin * ex + (cos - 1.0) * ey - a * scanned[:, 1] - b * scanned[:, 0] + driven[:, 1]
    return np.stack([x, y, driven[:, 2] - turn_scale * scanned[:, 2]], axis=1)


def _slip_share(differences: Float64, motions: ScanMotions, moving: Bool) -> float:
    """Share of the moving (p,) in which wheels and scans differ by far."""
    shown = _is_observable(motions) > 0.0
    away = np.hypot(differences[:, 0], differences[:, 1])
    length = np.hypot(motions.motions[:, 0], motions.motions[:, 1])
    turned = np.abs(differences[:, 2])
    slips = (turned > np.radians(4.0) + 0.3 * np.abs(motions.motions[:, 2])) | (shown & (away > 0.15 + 0.3 * length))
    return float(slips[moving].mean()) if moving.any() else 0.0


def _robust_fit(rows: Float64, wanted: Float64, weights: Float64) -> tuple[Float64, Float64]:
    """Least squares with Cauchy's weight at the scale of the residuals; the values (k,) and their covariance (k, k)."""
    values: Float64 = np.zeros(rows.shape[1])
    loose = 1e-9 * np.eye(rows.shape[1])
    for _ in range(_ROUNDS):
        residuals = wanted - rows @ values
        scale = max(1.4826 * float(np.median(np.abs(residuals[weights > 0.0]))) if weights.any() else 1.0, 1e-4)
        robust = weights / (1.0 + (residuals / scale) ** 2)
        information = rows.T @ (robust[:, None] * rows) + loose
        values = np.asarray(np.linalg.solve(information, rows.T @ (robust * wanted)), np.float64)
    covariance = np.asarray(scale**2 * np.linalg.inv(information), np.float64)
    return values, covariance
