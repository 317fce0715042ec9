"""Odometry compared with the motion by scans: constant faults of clock, mounting and scale, and the checks on them.

The scans give the motion of the laser at its stated mounting. With E the true mounting relative to the stated one,
odometry_motion E = E scan_motion. In the plane this is linear in E and in the scale of the odometry (Censi et al.,
Simultaneous calibration of odometry and sensor parameters for mobile robots, 2013).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64
from hmt_slam_ros.doctor.finding import Finding, Severity, grade
from hmt_slam_ros.doctor.readings import MIN_DISTANCE, MIN_MATCHED, MIN_TURN, is_moving, is_observable, reading_findings
from hmt_slam_ros.doctor.statistics import OdometryStatistics, ScanMotions, Statistics
from hmt_slam_ros.geometry import se2

_OFFSET_STEP, _MAX_INTERVAL = 0.02, 0.6
"""Step between clock offsets that are tried, s, and longest time between scans that shows them, s."""

_OFFSETS = np.arange(-1.0, 1.001, _OFFSET_STEP)
"""Clock offsets that are tried, s."""

_MIN_EXPLAINED = 0.35
"""Least share of the difference of headings that a clock offset must explain."""

_MIN_TOTAL_TURN, _MIN_TOTAL_DISTANCE, _MIN_MOTIONS = math.radians(120.0), 3.0, 15
"""Sum of turns, rad, sum of translations, m, and number of motions from which a fault is estimated."""

_ROUNDS = 30
"""Iterations of a robust fit."""

_SIGNIFICANCE = 3.0
"""Standard deviations that are subtracted from a deviation before it is judged."""

_SCALE, _YAW, _PLACE, _WRONG_FACTOR = 0.06, math.radians(3.0), 0.12, 2.5
"""Doubtful errors of scales, of the laser's yaw, rad, and of its place, m; factor from which they are wrong."""

_BACKWARDS = math.radians(150.0)
"""Yaw error of a laser that looks backwards, rad."""

_SLIPPED = (0.05, 0.3)
"""Shares of the moving time with slip: doubtful, and wrong."""


@dataclass(frozen=True, eq=False)
class ScalarEstimate:
    """A value with its standard deviation."""

    value: float
    deviation: float

    def excess(self, tolerance: float, neutral: float = 0.0) -> float:
        """The significant deviation from the neutral value, in tolerances."""
        return max(0.0, abs(self.value - neutral) - _SIGNIFICANCE * self.deviation) / tolerance


@dataclass(frozen=True, eq=False)
class OdometryComparison:
    """Differences between odometry and scans over the same motions.

    :ivar clock_offset: odometry time less scan stamp, s; None where it is not observable.
    :ivar is_mirrored: whether scans and odometry turn to opposite sides.
    :ivar rotation_scale: ratio of the odometry's turns to the scans'; None where the robot hardly turned.
    :ivar translation_scale: ratio of the odometry's translations to the scans'; None where the robot hardly moved.
    :ivar laser_yaw: true yaw of the laser less the stated one, rad; None as above.
    :ivar laser_forward: true place of the laser less the stated one, forward, m; None where the robot hardly turned.
    :ivar laser_left: the same to the left, m.
    :ivar motion_count: number of motions between well matched scans.
    :ivar slip_share: share of large differences among those in which the robot moved, by the scans and the odometry.
    """

    clock_offset: float | None
    is_mirrored: bool
    rotation_scale: ScalarEstimate | None
    translation_scale: ScalarEstimate | None
    laser_yaw: ScalarEstimate | None
    laser_forward: ScalarEstimate | None
    laser_left: ScalarEstimate | None
    motion_count: int
    slip_share: float


def compare_odometry(odometry: OdometryStatistics, motions: ScanMotions) -> OdometryComparison | None:
    """The comparison of odometry with the motions by scans; None where too few motions are comparable."""
    if len(odometry.stamps) < 2:
        return None
    inside = (motions.starts >= odometry.stamps[0]) & (motions.ends <= odometry.stamps[-1])
    motions = motions.select(inside & (motions.matched >= MIN_MATCHED))
    if len(motions.starts) < _MIN_MOTIONS:
        return None
    offset = _clock_offset(odometry, motions)
    measured = _odometry_motions(odometry, motions, offset or 0.0)
    frozen = _is_frozen(measured, motions.motions)
    rotation = _rotation_scale(measured[~frozen, 2], motions.motions[~frozen, 2])
    mirrored = False
    if rotation is not None and rotation.value < 0.0:
        mirrored = True
        motions, rotation = _mirror(motions), ScalarEstimate(-rotation.value, rotation.deviation)
    return _estimate_comparison(measured, motions, frozen, offset, mirrored, rotation)


def _odometry_motions(odometry: OdometryStatistics, motions: ScanMotions, offset: float) -> Float64:
    """The motions by odometry, shape (p, 3), with unwrapped headings."""
    starts, ends = (
        odometry.poses_at(stamps.astype(np.float64) + offset * 1e9) for stamps in (motions.starts, motions.ends)
    )
    increments = se2.between(starts, ends)
    increments[:, 2] = ends[:, 2] - starts[:, 2]
    return increments


def _is_frozen(measured: Float64, scanned: Float64) -> Bool:
    """Whether the odometry of each motion stands still although the scans clearly move."""
    return is_moving(scanned, 2.0) & (np.abs(measured) < 1e-6).all(axis=1)


def _clock_offset(odometry: OdometryStatistics, motions: ScanMotions) -> float | None:
    """The offset, s, at which turns by odometry and by scans correlate best; 0 where none explains much more."""
    seconds = (motions.ends - motions.starts) * 1e-9
    chosen = motions.select(seconds < _MAX_INTERVAL)
    turns = chosen.motions[:, 2]
    if np.abs(turns[np.abs(turns) > MIN_TURN]).sum() < _MIN_TOTAL_TURN:
        return None
    correlations = np.array(
        [abs(_correlation(_odometry_motions(odometry, chosen, offset)[:, 2], turns)) for offset in _OFFSETS]
    )
    best, zero = int(np.argmax(correlations)), int(np.argmin(np.abs(_OFFSETS)))
    if 1.0 - correlations[best] > (1.0 - _MIN_EXPLAINED) * (1.0 - correlations[zero]) or best in (0, len(_OFFSETS) - 1):
        return 0.0
    before, at, after = correlations[best - 1 : best + 2]
    curvature = before - 2.0 * at + after
    return float(_OFFSETS[best] + (_OFFSET_STEP * 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0))


def _correlation(one: Float64, other: Float64) -> float:
    """The correlation of two series (n,) without a mean, each clipped at its 98th percentile."""
    a, b = _clip_outliers(one), _clip_outliers(other)
    return float(a @ b) / math.sqrt(max(float(a @ a) * float(b @ b), 1e-24))


def _clip_outliers(series: Float64) -> Float64:
    limit = max(MIN_TURN, float(np.percentile(np.abs(series), 98)))
    return np.clip(series, -limit, limit)


def _rotation_scale(measured: Float64, scanned: Float64) -> ScalarEstimate | None:
    """The ratio of turns by odometry to turns by scans, each of shape (n,)."""
    turning = np.abs(scanned) > MIN_TURN
    if turning.sum() < _MIN_MOTIONS or np.abs(scanned[turning]).sum() < _MIN_TOTAL_TURN:
        return None
    values, covariance = _robust_fit(scanned[turning, None], measured[turning], np.ones(turning.sum()))
    return ScalarEstimate(float(values[0]), math.sqrt(covariance[0, 0]))


def _mirror(motions: ScanMotions) -> ScanMotions:
    """The motions with left and right exchanged."""
    mirror = np.array([1.0, -1.0, -1.0])
    information = motions.information * np.outer(mirror, mirror)
    return replace(motions, motions=motions.motions * mirror, information=information)


def _estimate_comparison(
    measured: Float64,
    motions: ScanMotions,
    frozen: Bool,
    offset: float | None,
    mirrored: bool,
    rotation: ScalarEstimate | None,
) -> OdometryComparison:
    scanned = motions.motions
    turn_scale = rotation.value if rotation is not None else 1.0
    usable = ~frozen & (np.abs(measured[:, 2] - turn_scale * scanned[:, 2]) < np.radians(5.0))
    turning = np.abs(scanned[:, 2]) > MIN_TURN
    going = usable & (is_observable(motions) > 0.0) & (np.hypot(scanned[:, 0], scanned[:, 1]) > MIN_DISTANCE)
    translation = yaw = forward = left = None
    lever = rotation is not None and (usable & turning).sum() >= _MIN_MOTIONS
    values = np.array([0.0, 0.0, 1.0, 0.0])
    if going.sum() >= _MIN_MOTIONS and np.hypot(*scanned[going, :2].T).sum() >= _MIN_TOTAL_DISTANCE:
        rows = np.flatnonzero(usable & (going | turning))
        values, covariance = _fit_mounting(measured[rows], motions.select(rows), lever=lever)
        scale = math.hypot(values[2], values[3])
        sigma = math.sqrt(max(covariance[2, 2], covariance[3, 3]))
        translation = ScalarEstimate(scale, sigma)
        yaw = ScalarEstimate(math.atan2(values[3], values[2]), sigma / scale)
        if lever:
            forward, left = (ScalarEstimate(float(values[k]), math.sqrt(covariance[k, k])) for k in (0, 1))
    differences = _residuals(measured, scanned, values, turn_scale)
    moving = is_moving(scanned, 1.0)
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
        slipped,
    )


def _fit_mounting(measured: Float64, motions: ScanMotions, *, lever: bool) -> tuple[Float64, Float64]:
    """Forward and left, m, and scale times cosine and sine of the yaw, shape (4,), with their covariance (4, 4).

    :param lever: whether the place of the laser is estimated too.
    """
    scanned = motions.motions
    cos, sin = np.cos(scanned[:, 2]), np.sin(scanned[:, 2])
    x, y = scanned[:, 0], scanned[:, 1]
    # (R - 1) e - scale R(yaw) t = -t_odometry, two rows per motion.
    rows = np.stack([np.stack([cos - 1.0, -sin, -x, y], axis=1), np.stack([sin, cos - 1.0, -y, -x], axis=1)], axis=1)
    if not lever:
        rows[:, :, :2] = 0.0
    weights = is_observable(motions)
    return _robust_fit(rows.reshape(-1, 4), -measured[:, :2].reshape(-1), np.repeat(weights, 2))


def _residuals(measured: Float64, scanned: Float64, values: Float64, turn_scale: float) -> Float64:
    """Differences of odometry and scans, shape (p, 3), along the odometry's axes, without the constant faults."""
    cos, sin = np.cos(scanned[:, 2]), np.sin(scanned[:, 2])
    ex, ey, a, b = values
    x = (cos - 1.0) * ex - sin * ey - a * scanned[:, 0] + b * scanned[:, 1] + measured[:, 0]
    y = sin * ex + (cos - 1.0) * ey - a * scanned[:, 1] - b * scanned[:, 0] + measured[:, 1]
    return np.stack([x, y, measured[:, 2] - turn_scale * scanned[:, 2]], axis=1)


def _slip_share(differences: Float64, motions: ScanMotions, moving: Bool) -> float:
    """Share of large differences among the moving motions, a mask of shape (p,)."""
    observable = is_observable(motions) > 0.0
    away = np.hypot(differences[:, 0], differences[:, 1])
    length = np.hypot(motions.motions[:, 0], motions.motions[:, 1])
    turned = np.abs(differences[:, 2])
    slips = (turned > np.radians(4.0) + 0.3 * np.abs(motions.motions[:, 2])) | (
        observable & (away > 0.15 + 0.3 * length)
    )
    return float(slips[moving].mean()) if moving.any() else 0.0


def _robust_fit(rows: Float64, targets: Float64, weights: Float64) -> tuple[Float64, Float64]:
    """Least squares with Cauchy's weight at the scale of the residuals: values (k,) and covariance (k, k)."""
    values: Float64 = np.zeros(rows.shape[1])
    regularization = 1e-9 * np.eye(rows.shape[1])
    for _ in range(_ROUNDS):
        residuals = targets - rows @ values
        scale = max(1.4826 * float(np.median(np.abs(residuals[weights > 0.0]))) if weights.any() else 1.0, 1e-4)
        robust = weights / (1.0 + (residuals / scale) ** 2)
        information = rows.T @ (robust[:, None] * rows) + regularization
        values = np.asarray(np.linalg.solve(information, rows.T @ (robust * targets)), np.float64)
    covariance = np.asarray(scale**2 * np.linalg.inv(information), np.float64)
    return values, covariance


def odometry_findings(statistics: Statistics, comparison: OdometryComparison | None) -> Iterator[Finding]:
    """Findings on the odometry, alone and compared with the scans."""
    offset = (comparison.clock_offset if comparison else None) or 0.0
    yield from reading_findings(statistics.odometry, statistics.motions, offset)
    if comparison is None:
        text = (
            f"Odometry could not be compared with the scans: of {len(statistics.motions.starts)} motions from scan to "
            "scan too few could be matched; give a longer part in which the robot drives among walls."
        )
        yield Finding("fine", "odometry not judged", text)
        return
    yield from _check_mirrored(comparison)
    yield from _check_rotation(comparison.rotation_scale)
    yield from _check_translation(comparison.translation_scale)
    yield from _check_laser_yaw(comparison.laser_yaw)
    yield from _check_laser_position(comparison)
    yield from _check_slip(comparison)
    yield _summary(comparison)


def _severity(excess: float) -> Severity:
    return "wrong" if excess >= _WRONG_FACTOR else "doubtful" if excess >= 1.0 else "fine"


def _check_mirrored(comparison: OdometryComparison) -> Iterator[Finding]:
    if not comparison.is_mirrored:
        return
    text = (
        "The scans turn to the right where the odometry turns to the left: the laser is mounted upside down and its "
        "transform does not say so (roll of 180 degrees), its beams count the wrong way round (angle_increment), or "
        "the odometry's heading has the wrong sign (counter-clockwise is positive, REP 103)."
    )
    yield Finding("wrong", "mirrored", text)


def _check_rotation(rotation: ScalarEstimate | None) -> Iterator[Finding]:
    if rotation is None:
        text = "The robot hardly turned where the scans show it, so clock, turns and the laser's place are unknown."
        yield Finding("fine", "rotation not judged", text)
        return
    severity = _severity(rotation.excess(_SCALE, 1.0))
    if severity == "fine":
        return
    text = (
        f"The odometry turns {_factor_text(rotation)} times as far as the scans: correct the distance of the wheels "
        f"in the odometry by that factor, or the laser's angle_increment."
    )
    yield Finding(severity, "rotation scale", text)


def _check_translation(translation: ScalarEstimate | None) -> Iterator[Finding]:
    if translation is None:
        text = (
            "The robot hardly moved where the scans show it, so translations and the laser's yaw could not be judged."
        )
        yield Finding("fine", "translation not judged", text)
        return
    severity = _severity(translation.excess(_SCALE, 1.0))
    if severity == "fine":
        return
    text = (
        f"The odometry goes {_factor_text(translation)} times as far as the scans: correct the radius of the wheels "
        "in the odometry by that factor, or the unit of the ranges."
    )
    yield Finding(severity, "translation scale", text)


def _factor_text(estimate: ScalarEstimate) -> str:
    return f"{estimate.value:.3f} (+- {estimate.deviation:.3f})"


def _check_laser_yaw(yaw: ScalarEstimate | None) -> Iterator[Finding]:
    if yaw is None or (severity := _severity(yaw.excess(_YAW))) == "fine":
        return
    degrees = math.degrees(yaw.value)
    if abs(yaw.value) > _BACKWARDS:
        text = (
            f"The laser looks backwards against what its transform says ({degrees:.0f} degrees): turn the transform "
            "base_link -> laser by 180 degrees about z."
        )
        yield Finding("wrong", "laser backwards", text)
        return
    text = (
        f"The laser is turned by {degrees:.1f} (+- {math.degrees(yaw.deviation):.1f}) degrees to the "
        f"{'left' if degrees > 0.0 else 'right'} against what its transform says: add that to the yaw of "
        "base_link -> laser."
    )
    yield Finding(severity, "laser yaw", text)


def _check_laser_position(comparison: OdometryComparison) -> Iterator[Finding]:
    if comparison.laser_forward is None or comparison.laser_left is None:
        return
    severity = _severity(max(part.excess(_PLACE) for part in (comparison.laser_forward, comparison.laser_left)))
    if severity == "fine":
        return
    text = (
        f"The laser is {comparison.laser_forward.value:+.2f} m ahead and {comparison.laser_left.value:+.2f} m to the "
        "left of where its transform says, by how it moves when the robot turns: correct base_link -> laser, or the "
        "odometry's child frame if that is not between the wheels."
    )
    yield Finding(severity, "laser place", text)


def _check_slip(comparison: OdometryComparison) -> Iterator[Finding]:
    if (severity := grade(comparison.slip_share, *_SLIPPED)) == "fine":
        return
    text = (
        f"Odometry and scans contradict each other in {100.0 * comparison.slip_share:.0f} % of the time in which the "
        "robot moves: wheels slip, or the odometry is poor; the scans are believed, so keep to places that they "
        "show well, and raise motion.rotation_from_rotation and its neighbors."
    )
    yield Finding(severity, "slip", text)


def _summary(comparison: OdometryComparison) -> Finding:
    parts = [f"{comparison.motion_count} motions from scan to scan were compared with odometry"]
    for estimate, name in ((comparison.rotation_scale, "turns"), (comparison.translation_scale, "translations")):
        if estimate is not None:
            parts.append(f"its {name} are {_factor_text(estimate)} times the scans'")
    if comparison.laser_yaw is not None:
        parts.append(f"the laser's yaw is off by {math.degrees(comparison.laser_yaw.value):.1f} degrees")
    parts.append(f"{100.0 * comparison.slip_share:.1f} % contradict")
    return Finding("fine", "odometry", "; ".join(parts) + ".")
