"""A laser scan that carries its own geometry, so that nothing about the sensor is assumed constant over a log."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


def _laser_at_base() -> NDArray[np.float64]:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep of a planar range finder.

    Angles, range limits and ``time_increment`` are kept in the precision of sensor_msgs/LaserScan, float32, so that a
    log, the bag made from it and its replay are one and the same.

    :ivar stamp: time of the first beam, integer nanoseconds, increasing within one source.
    :ivar ranges: shape (n,), float32, metres. NaN, inf, values below ``range_min`` and values at or beyond
        ``range_max`` are beams without a return.
    :ivar angle_min: angle of beam 0 in the laser frame, rad.
    :ivar angle_increment: angle from one beam to the next, rad; negative for a laser mounted upside down.
    :ivar range_min: smallest valid range, metres.
    :ivar range_max: smallest range that means "no return", metres.
    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar time_increment: seconds from one beam to the next, 0 where unknown.
    """

    stamp: int
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser_pose: NDArray[np.float64] = field(default_factory=_laser_at_base)
    time_increment: float = 0.0

    def __post_init__(self) -> None:
        for name in ("angle_min", "angle_increment", "range_min", "range_max", "time_increment"):
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Beams with a return, shape (n,)."""
        with np.errstate(invalid="ignore"):
            return (self.ranges >= max(self.range_min, 1e-3)) & (self.ranges < self.range_max)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """End points of the beams with a return, shape (k, 2), metres, robot base frame."""
        angles = (self.angle_min + self.laser_pose[2] + self.angle_increment * np.arange(self.ranges.size))[self.valid]
        ranges = self.ranges[self.valid].astype(np.float64)
        points = np.empty((ranges.size, 2))
        points[:, 0] = self.laser_pose[0] + ranges * np.cos(angles)
        points[:, 1] = self.laser_pose[1] + ranges * np.sin(angles)
        return points
