"""Odometry against the motion that scans show."""

from __future__ import annotations

import math

import numpy as np

from hmt_slam_ros.configuration.robot import RealTimeLocalization
from hmt_slam_ros.doctor.comparison import Comparison, Estimate
from hmt_slam_ros.doctor.finding import Finding, Severity, graded, times
from hmt_slam_ros.doctor.statistics import OdometryStatistics, Statistics, seconds_between
from hmt_slam_ros.geometry import se2

# Relative errors of scales, rad of yaw and m of the laser's place: doubtful from these on, wrong from so many times.
_SCALE, _YAW, _PLACE, _WRONG = 0.06, math.radians(3.0), 0.12, 2.5
_BACKWARDS = math.radians(150.0)
# Shares of the moving time in which wheels slip, and in which odometry is frozen: doubtful, and wrong.
_SLIPPED, _FROZEN = (0.05, 0.3), (0.03, 0.1)


def findings(statistics: Statistics, comparison: Comparison | None) -> list[Finding]:
    """What odometry and scans together tell."""
    found = [*_not_finite(statistics.odometry), *_jumps(statistics.odometry)]
    if comparison is None:
        text = (
            f"Odometry could not be compared with the scans: of {len(statistics.motions.starts)} motions from scan to "
            "scan too few could be matched; give a longer part in which the robot drives among walls."
        )
        return [*found, Finding("fine", "odometry not judged", text)]
    faults = [
        *_mirrored(comparison),
        *_rotation(comparison.rotation),
        *_translation(comparison.translation),
        *_yaw(comparison.yaw),
        *_place(comparison),
        *_frozen(comparison),
        *_slipped(comparison),
    ]
    return [*found, *faults, _summary(comparison)]


def _severity(sureness: float) -> Severity:
    return "wrong" if sureness >= _WRONG else "doubtful" if sureness >= 1.0 else "fine"


def _not_finite(odometry: OdometryStatistics) -> list[Finding]:
    if not odometry.not_finite:
        return []
    text = (
        f"{odometry.not_finite} odometry readings are NaN or infinite and were left out: look for a division by zero "
        "in the odometry's driver, or a quaternion of zeros."
    )
    return [Finding("wrong", "odometry not finite", text)]


def _jumps(odometry: OdometryStatistics) -> list[Finding]:
    limits = RealTimeLocalization()
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
        f"The odometry jumps {times(int(jumps.sum()))}, the farthest by {distance[k]:.2f} m, "
        f"{(odometry.stamps[k] - odometry.stamps[0]) * 1e-9:.1f} s after its first reading: it was reset, or two "
        "sources publish it; it must be one path without jumps (REP 105)."
    )
    return [Finding("wrong", "odometry jumps", text)]


def _mirrored(comparison: Comparison) -> list[Finding]:
    if not comparison.mirrored:
        return []
    text = (
        "The scans turn to the right where the odometry turns to the left: the laser is mounted upside down and its "
        "transform does not say so (roll of 180 degrees), its beams count the wrong way round (angle_increment), or "
        "the odometry's heading has the wrong sign (counter-clockwise is positive, REP 103)."
    )
    return [Finding("wrong", "mirrored", text)]


def _rotation(rotation: Estimate | None) -> list[Finding]:
    if rotation is None:
        text = "The robot hardly turned where scans show it, so that clock, turns and place of the laser stay open."
        return [Finding("fine", "rotation not judged", text)]
    severity = _severity(rotation.beyond(_SCALE, 1.0))
    if severity == "fine":
        return []
    text = (
        f"The odometry turns {_factor(rotation)} times as far as the scans: correct the distance of the wheels in the "
        f"odometry by that factor, or the laser's angle_increment."
    )
    return [Finding(severity, "rotation scale", text)]


def _translation(translation: Estimate | None) -> list[Finding]:
    if translation is None:
        text = "The robot hardly went where scans show how far, so that ways and the laser's yaw could not be judged."
        return [Finding("fine", "translation not judged", text)]
    severity = _severity(translation.beyond(_SCALE, 1.0))
    if severity == "fine":
        return []
    text = (
        f"The odometry goes {_factor(translation)} times as far as the scans: correct the radius of the wheels in the "
        "odometry by that factor, or the unit of the ranges."
    )
    return [Finding(severity, "translation scale", text)]


def _factor(estimate: Estimate) -> str:
    return f"{estimate.value:.3f} (+- {estimate.deviation:.3f})"


def _yaw(yaw: Estimate | None) -> list[Finding]:
    if yaw is None or (severity := _severity(yaw.beyond(_YAW))) == "fine":
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


def _place(comparison: Comparison) -> list[Finding]:
    if comparison.forward is None or comparison.left is None:
        return []
    severity = _severity(max(part.beyond(_PLACE) for part in (comparison.forward, comparison.left)))
    if severity == "fine":
        return []
    text = (
        f"The laser is {comparison.forward.value:+.2f} m ahead and {comparison.left.value:+.2f} m to the left of where "
        "its transform says, by how it moves when the robot turns: correct base_link -> laser, or the odometry's "
        "child frame if that is not between the wheels."
    )
    return [Finding(severity, "laser place", text)]


def _frozen(comparison: Comparison) -> list[Finding]:
    share = comparison.frozen / max(1, comparison.moving)
    if (severity := graded(share, *_FROZEN)) == "fine":
        return []
    text = (
        f"The odometry stands still in {100.0 * share:.0f} % of the time in which the scans move: its readings are "
        "repeated, or it is not published while the robot moves by other means; look at its driver."
    )
    return [Finding(severity, "odometry frozen", text)]


def _slipped(comparison: Comparison) -> list[Finding]:
    if (severity := graded(comparison.slipped, *_SLIPPED)) == "fine":
        return []
    text = (
        f"Odometry and scans contradict each other in {100.0 * comparison.slipped:.0f} % of the time in which the "
        "robot moves: wheels slip, or the odometry is poor; the scans are believed, so keep to places that they "
        "show well, and raise motion.rotation_from_rotation and its neighbours."
    )
    return [Finding(severity, "slip", text)]


def _summary(comparison: Comparison) -> Finding:
    said = [f"{comparison.compared} motions from scan to scan were compared with odometry"]
    for estimate, name in ((comparison.rotation, "turns"), (comparison.translation, "ways")):
        if estimate is not None:
            said.append(f"its {name} are {_factor(estimate)} times the scans'")
    if comparison.yaw is not None:
        said.append(f"the laser's yaw is off by {math.degrees(comparison.yaw.value):.1f} degrees")
    said.append(f"{100.0 * comparison.slipped:.1f} % contradict")
    return Finding("fine", "odometry", "; ".join(said) + ".")
