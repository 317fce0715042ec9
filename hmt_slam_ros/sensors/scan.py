"""A laser scan that carries its own geometry, so that nothing about the sensor is assumed constant over a log."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float32, Float64
from hmt_slam_ros.geometry import se2

_MICROSECONDS = 1e6


@lru_cache(maxsize=4)
def _directions(count: int, first: float, increment: float) -> NDArray[np.float64]:
    """Unit vectors (n, 2) of evenly spaced angles, rad; the same for all scans of a laser."""
    angles = first + increment * np.arange(count)
    return np.stack((np.cos(angles), np.sin(angles)), axis=1)


@njit(cache=True)
def _beam_ends(ranges: Float32, directions: Float64, laser: Float64, valid: Bool) -> Float64:
    """Where the valid beams of a laser at ``laser`` end, (k, 2)."""
    ends, k = np.empty((valid.sum(), 2)), 0
    for n in range(ranges.size):
        if valid[n]:
            ends[k, 0] = laser[0] + np.float64(ranges[n]) * directions[n, 0]
            ends[k, 1] = laser[1] + np.float64(ranges[n]) * directions[n, 1]
            k += 1
    return ends


@njit(cache=True)
def _valid_mask(ranges: Float32, nearest: np.float32, farthest: np.float32) -> Bool:
    """Which ranges are from ``nearest`` on and below ``farthest``; NaN is not."""
    valid = np.empty(ranges.size, np.bool_)
    for n in range(ranges.size):
        valid[n] = nearest <= ranges[n] < farthest
    return valid


def _zeros() -> NDArray[np.float64]:
    return np.zeros(3)


class BeamRevision(NamedTuple):
    """What a scan does not say any more, because the world changed.

    :ivar removed: numbers of the beams whose end is gone; they say nothing.
    :ivar occluded: numbers of the beams in whose way something came to stand.
    :ivar starts: from where on each of these still holds, m from the laser.
    """

    removed: tuple[int, ...]
    occluded: tuple[int, ...]
    starts: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep of a planar range finder.

    Angles, range limits and ``time_increment`` are kept in the precision of sensor_msgs/LaserScan, float32, so that a
    log, the bag made from it and its replay are one and the same.

    Points and origins are those of the base at ``stamp``: a beam that came later is carried back along the motion, at
    constant velocity in between.

    :ivar stamp: time of the first beam, integer nanoseconds, increasing within one source.
    :ivar ranges: shape (n,), float32, metres. NaN, inf, values below ``range_min`` and values at or beyond
        ``range_max`` are beams without a return.
    :ivar angle_min: angle of beam 0 in the laser frame, rad.
    :ivar angle_increment: angle from one beam to the next, rad; negative for a laser mounted upside down.
    :ivar range_min: smallest valid range, metres.
    :ivar range_max: smallest range that means "no return", metres.
    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar time_increment: seconds from one beam to the next, 0 where unknown.
    :ivar motion: shape (3,), the base's motion from the first beam to the last as a twist, m, m, rad: its exponential
        is the base at the last beam as seen from the base at the first. Zeros where it is not known.
    :ivar starts: shape (n,), float32, m: nearer than this a beam says nothing any more, since something came to stand
        in its way; smaller than its range. None where every beam says all from the laser on.
    """

    stamp: int
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser_pose: NDArray[np.float64] = field(default_factory=_zeros)
    time_increment: float = 0.0
    motion: NDArray[np.float64] = field(default_factory=_zeros)
    starts: NDArray[np.float32] | None = None
    _revised: tuple[BeamRevision, Scan] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("angle_min", "angle_increment", "range_min", "range_max", "time_increment"):
            object.__setattr__(self, name, float(np.float32(getattr(self, name))))

    @property
    def sweep_duration(self) -> float:
        """Seconds from the first beam to the last."""
        return max(0, self.ranges.size - 1) * self.time_increment

    @property
    def end_stamp(self) -> int:
        """Time of the last beam, ns, to the microsecond that float32 is good for; needs a finite ``time_increment``."""
        return self.stamp + 1000 * round(self.sweep_duration * _MICROSECONDS)

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Beams with a return, shape (n,)."""
        return _valid_mask(self.ranges, np.float32(max(self.range_min, 1e-3)), np.float32(self.range_max))

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """End points of the beams with a return, shape (k, 2), metres, robot base frame."""
        return self._deskew(self._points_along_beams(self.ranges))

    def _points_along_beams(self, ranges: NDArray[np.float32]) -> NDArray[np.float64]:
        """Places on the beams with a return, shape (k, 2), from the base at each beam.

        :param ranges: shape (n,), how far from the laser, m.
        """
        first = self.angle_min + float(self.laser_pose[2])
        directions = _directions(self.ranges.size, first, self.angle_increment)
        return _beam_ends(ranges, directions, self.laser_pose, self.valid)

    def revise(self, revision: BeamRevision) -> Scan:
        """The same scan with beams that say less; one and the same object for the same revision."""
        if self._revised is None or self._revised[0] != revision:
            ranges = self.ranges.copy()
            ranges[list(revision.removed)] = np.nan
            starts, cut = self.starts, list(revision.occluded)
            if cut:
                starts = np.zeros_like(ranges) if starts is None else starts.copy()
                starts[cut] = np.maximum(starts[cut], np.array(revision.starts, dtype=np.float32))
            object.__setattr__(self, "_revised", (revision, replace(self, ranges=ranges, starts=starts)))
        assert self._revised is not None
        return self._revised[1]

    @property
    def origins(self) -> NDArray[np.float64]:
        """Where each of those beams begins to say something, shape (k, 2), metres, robot base frame.

        That is where the laser was, but for ``starts``.
        """
        if self.starts is not None:
            return self._deskew(self._points_along_beams(self.starts))
        origins = np.empty((len(self.points), 2))
        origins[:] = self.laser_pose[:2]
        return self._deskew(origins)

    @property
    def beams(self) -> NDArray[np.float64]:
        """From there to the end point, for each of those beams, shape (k, 2), metres, robot base frame."""
        return self.points - self.origins

    def _deskew(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """One point (k, 2) for each beam with a return, from the base at that beam to the base at the first."""
        if not self.motion.any():
            return points
        passed = np.flatnonzero(self.valid) / max(1, self.ranges.size - 1)
        return se2.transform(se2.exp(passed[:, None] * self.motion), points)
