"""Odometry against the motion that scans show."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.configuration.robot import RealTimeParameters
from hmt_slam_ros.doctor.comparison import OdometryComparison, ScalarEstimate
from hmt_slam_ros.doctor.finding import Finding, Severity, grade, times_text
from hmt_slam_ros.doctor.statistics import OdometryStatistics, Statistics, seconds_between
from hmt_slam_ros.geometry import se2

# Relative errors of scales, rad of yaw and m of the laser's place: doubtful from these on, wrong from so many times.
_SCALE, _YAW, _PLACE, _WRONG_FACTOR = 0.06, math.radians(3.0), 0.12, 2.5
_BACKWARDS = math.radians(150.0)
# Shares of the moving time in which wheels slip, and in which odometry is frozen: doubtful, and wrong.
_SLIPPED, _FROZEN = (0.05, 0.3), (0.03, 0.1)


def findings(statistics: Statistics, comparison: OdometryComparison | None) -> list[Finding]:
    """What odometry and scans together tell."""
    found = [*_check_finite(statistics.odometry), *_check_jumps(statistics.odometry)]
    if comparison is None:
        text = (
            f"Odometry could not be compared with the scans: of {len(statistics.motions.starts)} motions from scan to "
            "scan too few could be matched; give a longer part in which the robot drives among walls."
        )
        return [*found, Finding("fine", "odometry not judged", text)]
    faults = [
        *_check_mirrored(comparison),
        *_check_rotation(comparison.rotation_scale),
        *_check_translation(comparison.translation_scale),
        *_check_laser_yaw(comparison.laser_yaw),
        *_check_laser_position(comparison),
        *_check_frozen(comparison),
        *_check_slip(comparison),
    ]
    return [*found, *faults, _summary(comparison)]


def _severity(excess: float) -> Severity:
    return "wrong" if excess >= _WRONG_FACTOR else "doubtful" if excess >= 1.0 else "fine"


def _check_finite(odometry: OdometryStatistics) -> list[Finding]:
    if not odometry.non_finite_count:
        return []
    text = (
        f"{odometry.non_finite_count} odometry readings are NaN or infinite and were left out: look for a division by "
        "zero in the odometry's driver, or a quaternion of zeros."
    )
    return [Finding("wrong", "odometry not finite", text)]


def _check_jumps(odometry: OdometryStatistics) -> list[Finding]:
    limits = RealTimeParameters()
    if len(odometry.stamps) < 2:
        return []
    # Stamps of arrival lie close together now and then; that is no jump.
    seconds = np.maximum(seconds_between(odometry.stamps), 0.2)
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    distance = np.hypot(steps[:, 0], steps[:, 1])
    jumps = distance > limits.max_speed * seconds
    if not jumps.any():
        return []
    k = int(np.argmax(np.where(jumps, distance, 0.0)))
    text = (
        f"The odometry jumps {times_text(int(jumps.sum()))}, the farthest by {distance[k]:.2f} m, "
        f"{(odometry.stamps[k] - odometry.stamps[0]) * 1e-9:.1f} s after its first reading: it was reset, or two "
        "sources publish it; it must be one path without jumps (REP 105)."
    )
    return [Finding("wrong", "odometry jumps", text)]


def _check_mirrored(comparison: OdometryComparison) -> list[Finding]:
    if not comparison.is_mirrored:
        return []
    text = (
        "The scans turn to the right where the odometry turns to the left: the laser is mounted upside down and its "
        "transform does not say so (roll of 180 degrees), its beams count the wrong way round (angle_increment), or "
        "the odometry's heading has the wrong sign (counter-clockwise is positive, REP 103)."
    )
    return [Finding("wrong", "mirrored", text)]


def _check_rotation(rotation: ScalarEstimate | None) -> list[Finding]:
    if rotation is None:
        text = "The robot hardly turned where scans show it, so that clock, turns and place of the laser stay open."
        return [Finding("fine", "rotation not judged", text)]
    severity = _severity(rotation.excess(_SCALE, 1.0))
    if severity == "fine":
        return []
    text = (
        f"The odometry turns {_factor_text(rotation)} times as far as the scans: correct the distance of the wheels "
        f"in the odometry by that factor, or the laser's angle_increment."
    )
    return [Finding(severity, "rotation scale", text)]


def _check_translation(translation: ScalarEstimate | None) -> list[Finding]:
    if translation is None:
        text = "The robot hardly went where scans show how far, so that ways and the laser's yaw could not be judged."
        return [Finding("fine", "translation not judged", text)]
    severity = _severity(translation.excess(_SCALE, 1.0))
    if severity == "fine":
        return []
    text = (
        f"The odometry goes {_factor_text(translation)} times as far as the scans: correct the radius of the wheels "
        "in the odometry by that factor, or the unit of the ranges."
    )
    return [Finding(severity, "translation scale", text)]


def _factor_text(estimate: ScalarEstimate) -> str:
    return f"{estimate.value:.3f} (+- {estimate.deviation:.3f})"


def _check_laser_yaw(yaw: ScalarEstimate | None) -> list[Finding]:
    if yaw is None or (severity := _severity(yaw.excess(_YAW))) == "fine":
        return []
    degrees = math.degrees(yaw.value)
    if abs(yaw.value) > _BACKWARDS:
        text = (
            f"The laser looks backwards against what its transform says ({degrees:.0f} degrees): turn the transform "
            "base_link -> laser by 180 degrees about z."
        )
        return [Finding("wrong", "laser backwards", text)]
    text = (
        f"The laser is turned by {degrees:.1f} (+- {math.degrees(yaw.deviation):.1f}) degrees to the "
        f"{'left' if degrees > 0.0 else 'right'} against what its transform says: add that to the yaw of "
        "base_link -> laser."
    )
    return [Finding(severity, "laser yaw", text)]


def _check_laser_position(comparison: OdometryComparison) -> list[Finding]:
    if comparison.laser_forward is None or comparison.laser_left is None:
        return []
    severity = _severity(max(part.excess(_PLACE) for part in (comparison.laser_forward, comparison.laser_left)))
    if severity == "fine":
        return []
    text = (
        f"The laser is {comparison.laser_forward.value:+.2f} m ahead and {comparison.laser_left.value:+.2f} m to the "
        "left of where its transform says, by how it moves when the robot turns: correct base_link -> laser, or the "
        "odometry's child frame if that is not between the wheels."
    )
    return [Finding(severity, "laser place", text)]


def _check_frozen(comparison: OdometryComparison) -> list[Finding]:
    share = comparison.frozen_count / max(1, comparison.moving_count)
    if (severity := grade(share, *_FROZEN)) == "fine":
        return []
    text = (
        f"The odometry stands still in {100.0 * share:.0f} % of the time in which the scans move: its readings are "
        "repeated, or it is not published while the robot moves by other means; look at its driver."
    )
    return [Finding(severity, "odometry frozen", text)]


def _check_slip(comparison: OdometryComparison) -> list[Finding]:
    if (severity := grade(comparison.slip_share, *_SLIPPED)) == "fine":
        return []
    text = (
        f"Odometry and scans contradict each other in {100.0 * comparison.slip_share:.0f} % of the time in which the "
        "robot moves: wheels slip, or the odometry is poor; the scans are believed, so keep to places that they "
        "show well, and raise motion.rotation_from_rotation and its neighbors."
    )
    return [Finding(severity, "slip", text)]


def _summary(comparison: OdometryComparison) -> Finding:
    said = [f"{comparison.motion_count} motions from scan to scan were compared with odometry"]
    for estimate, name in ((comparison.rotation_scale, "turns"), (comparison.translation_scale, "ways")):
        if estimate is not None:
            said.append(f"its {name} are {_factor_text(estimate)} times the scans'")
    if comparison.laser_yaw is not None:
        said.append(f"the laser's yaw is off by {math.degrees(comparison.laser_yaw.value):.1f} degrees")
    said.append(f"{100.0 * comparison.slip_share:.1f} % contradict")
    return Finding("fine", "odometry", "; ".join(said) + ".")
