"""Observations of marks: poses of the robot in frames with names, such as tags (docs/decisions/0080-marks.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.sensors.plausibility import (
    COVARIANCE_FORM,
    MAX_COORDINATE,
    MAX_STAMP,
    check_planar_pose,
    find_invalid_covariance,
)
from hmt_slam_ros.untrusted_input import shorten

MAX_NAME_LENGTH = 100
"""Characters of the name of a mark at most."""

MAX_HEADING_DEVIATION = 0.5
"""Deviation of a heading above which an observation cannot be used, rad."""

_MIN_VARIANCE = 1e-12
"""Smallest variance along any direction, m^2 and rad^2."""


@dataclass(frozen=True, eq=False, slots=True)
class MarkObservation:
    """An observation of a mark with a name.

    :ivar stamp: integer nanoseconds.
    :ivar name: of the mark.
    :ivar pose: belief over ``mark_T_base``, of the robot's base in the mark's frame.
    """

    stamp: int
    name: str
    pose: PoseGaussian


def check_mark(observation: MarkObservation) -> MarkObservation:
    """The observation, where it can be used.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    name, covariance = observation.name, observation.pose.covariance
    _require(0 <= observation.stamp <= MAX_STAMP, "stamp", observation.stamp, "a time between the years 1970 and 2116")
    is_name = 0 < len(name) <= MAX_NAME_LENGTH and name.isprintable()
    _require(is_name, "frame_id", shorten(name), f"the name of a mark, of 1 to {MAX_NAME_LENGTH} characters")
    check_planar_pose(observation.pose.mean, "pose", MAX_COORDINATE)
    is_covariance = find_invalid_covariance(covariance[None], _MIN_VARIANCE) is None
    _require(is_covariance, "covariance", covariance.tolist(), COVARIANCE_FORM)
    deviation = math.sqrt(covariance[2, 2])
    wanted = f"a deviation of the heading of at most {MAX_HEADING_DEVIATION:g} rad"
    _require(deviation <= MAX_HEADING_DEVIATION, "covariance", f"{deviation:.3g} rad", wanted)
    return observation


def _require(holds: bool, name: str, value: object, wanted: str) -> None:
    if not holds:
        raise HmtSlamError(f"{name} of a mark = {value} is not {wanted}: correct the detector, or leave the mark out")
