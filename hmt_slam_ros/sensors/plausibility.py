"""What a scan, an odometry reading and a covariance have to be before any process sees them.

Drivers send NaN, infinities and zero angles, logs are damaged, clocks run wild. Such a measurement is refused with the
value and the remedy, the same in the readers of logs and on the topics; the rest of the log or drive goes on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.sensors.odometry import Odometry
from hmt_slam_ros.sensors.scan import Scan

MAX_BEAMS = 100_000
"""Of a scan; planar range finders have up to some thousands."""

MIN_ANGLE_INCREMENT = 1e-5
"""rad between two beams; the finest lasers have 1e-3."""

MAX_SWEEP_ANGLE = 4.0 * math.pi
"""rad of all beams of a scan together."""

MAX_SWEEP_DURATION = 60.0
"""Seconds from the first beam of a scan to the last."""

MAX_LASER_OFFSET = 100.0
"""m from the robot's base to its laser."""

MAX_COORDINATE = 1e7
"""m from the origin of the odometry, beyond any drive; a float64 keeps 2 nm there."""

MAX_VARIANCE = MAX_COORDINATE**2
"""Magnitude of an element of a covariance, m^2 and rad^2."""

COVARIANCE_FORM = "symmetric, positive definite and within 1e14"
"""What a covariance has to be, as the sentence says that refuses one."""

MAX_STAMP = 2**62
"""ns, in the year 2116; beyond it sums of stamps no longer fit into 64 bits."""

_COVARIANCE_TOLERANCE = 1e-6
"""Rounding of a covariance, as a share of its largest element."""

QUATERNION_TOLERANCE = 1e-2
"""By which the norm of a rotation's quaternion may differ from 1; float32 differs by 1e-7."""


def check_scan(scan: Scan) -> Scan:
    """The scan, where it is one.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    _check_stamp(scan.stamp)
    beams = scan.ranges.size
    _require(beams <= MAX_BEAMS, "ranges", beams, "at most {} beams", MAX_BEAMS)
    for name in ("angle_min", "angle_increment", "range_min", "time_increment"):
        _require(math.isfinite(getattr(scan, name)), name, getattr(scan, name), "a finite number")
    if beams > 1:
        least, most = MIN_ANGLE_INCREMENT, MAX_SWEEP_ANGLE / (beams - 1)
        fits, wanted = least <= abs(scan.angle_increment) <= most, "{:g} to {:g} rad between {} beams"
        _require(fits, "angle_increment", scan.angle_increment, wanted, least, most, beams)
    _require(abs(scan.angle_min) <= MAX_SWEEP_ANGLE, "angle_min", scan.angle_min, "within 4 pi rad")
    _require(scan.range_min >= 0.0, "range_min", scan.range_min, "0 m or more")
    _require(scan.range_max > scan.range_min, "range_max", scan.range_max, "beyond range_min, {:g} m", scan.range_min)
    _require(scan.time_increment >= 0.0, "time_increment", scan.time_increment, "0 s or more")
    _require(
        scan.sweep_duration <= MAX_SWEEP_DURATION, "time_increment", scan.time_increment, "a sweep of at most 60 s"
    )
    check_planar_pose(scan.laser_pose, "the laser's pose", MAX_LASER_OFFSET)
    return scan


def check_odometry(reading: Odometry) -> Odometry:
    """The reading, where it is one.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    _check_stamp(reading.stamp)
    check_planar_pose(reading.pose, "pose", MAX_COORDINATE)
    return reading


def check_planar_pose(pose: NDArray[np.float64], name: str, reach: float) -> None:
    """Check that a pose (x, y, theta) is finite and near.

    :param reach: largest magnitude of x and y, m.
    :raises HmtSlamError: where it is not.
    """
    numbers = pose.tolist()
    near = all(map(math.isfinite, numbers)) and abs(numbers[0]) <= reach and abs(numbers[1]) <= reach
    _require(near, name, numbers, "finite, with x and y within {:g} m", reach)


def check_quaternion(quaternion: Sequence[float], name: str = "orientation") -> None:
    """Check that (x, y, z, w) is a rotation.

    :raises HmtSlamError: where a number is not finite or the norm is not 1.
    """
    norm = math.hypot(*quaternion) if all(map(math.isfinite, quaternion)) else math.nan
    _require(abs(norm - 1.0) <= QUATERNION_TOLERANCE, name, tuple(quaternion), "a quaternion of norm 1")


def find_invalid_covariance(matrices: NDArray[np.float64], min_variance: float | None = None) -> int | None:
    """The index of a matrix that is no covariance, None where all are: ``COVARIANCE_FORM``.

    :param matrices: shape (n, k, k), n of 1 or more.
    :param min_variance: smallest along any direction; None where it may be 0, or below by rounding.
    """
    scale = np.abs(matrices).max(axis=(1, 2), initial=0.0)
    if not (scale <= MAX_VARIANCE).all():
        return int(np.argmax(np.where(np.isfinite(scale), scale, np.inf)))
    asymmetry = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2))
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    least = -_COVARIANCE_TOLERANCE * scale if min_variance is None else min_variance
    invalid = (asymmetry > _COVARIANCE_TOLERANCE * scale) | (smallest < least)
    return int(np.argmax(invalid)) if invalid.any() else None


def _check_stamp(stamp: int) -> None:
    _require(0 <= stamp <= MAX_STAMP, "stamp", stamp, "a time between the years 1970 and 2116")


def _require(holds: bool, name: str, value: object, wanted: str, *limits: float) -> None:
    """Refuse a value; the text is made only then.

    :param wanted: what the value has to be, a format of the limits.
    """
    if not holds:
        raise HmtSlamError(
            f"{name} = {value} is not {wanted.format(*limits)}: correct the driver, or leave the message out"
        )
