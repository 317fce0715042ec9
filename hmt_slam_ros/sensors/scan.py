"""A laser scan with its own geometry, and its end points with the normals of their surfaces.

A wall shows its distance, but not the robot's position along it. The cells of a map seem to show that, too: far end
points look like posts, a slanting wall has steps, and a wall ends where the last scan ended. So a point with a normal
informs the pose along that normal only. Points on no surface, such as posts and corners, inform it in all directions.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from statistics import median
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2

_MICROSECONDS = 1e6

_FLOAT32_FIELDS = ("angle_min", "angle_increment", "range_min", "range_max", "time_increment")
"""Fields of a scan that have the precision of sensor_msgs/LaserScan."""


@lru_cache(maxsize=4)
def _directions(count: int, first: float, increment: float) -> Float64:
    """Unit vectors (n, 2) of evenly spaced angles, rad; the same for all scans of a laser."""
    angles = first + increment * np.arange(count)
    return np.stack((np.cos(angles), np.sin(angles)), axis=1)


@njit(cache=True)
def _beam_ends(ranges: Float32, directions: Float64, laser: Float64, valid: Bool) -> Float64:
    """End points of the valid beams of a laser at ``laser``, (k, 2)."""
    ends, k = np.empty((valid.sum(), 2)), 0
    for n in range(ranges.size):
        if valid[n]:
            ends[k, 0] = laser[0] + np.float64(ranges[n]) * directions[n, 0]
            ends[k, 1] = laser[1] + np.float64(ranges[n]) * directions[n, 1]
            k += 1
    return ends


@njit(cache=True)
def _valid_mask(ranges: Float32, nearest: np.float32, farthest: np.float32) -> Bool:
    """Whether ranges are from ``nearest`` on and below ``farthest``; NaN is not."""
    valid = np.empty(ranges.size, np.bool_)
    for n in range(ranges.size):
        valid[n] = nearest <= ranges[n] < farthest
    return valid


class BeamRevision(NamedTuple):
    """The parts of a scan that do not hold any more, because the world changed.

    :ivar removed: numbers of the beams whose surface is gone; they show nothing.
    :ivar occluded: numbers of the beams that a new object blocks.
    :ivar starts: range from which each of these still holds, m.
    """

    removed: tuple[int, ...]
    occluded: tuple[int, ...]
    starts: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep of a planar range finder.

    Angles, range limits and ``time_increment`` have the precision of sensor_msgs/LaserScan, float32, so that a log, the
    bag made from it and its replay are the same.

    Points and origins are in the frame of the base at ``stamp``. Later beams are corrected for the motion, at constant
    velocity.

    :ivar stamp: time of the first beam, integer nanoseconds, increasing within one source.
    :ivar ranges: shape (n,), float32, meters. NaN, inf, values below ``range_min`` and values at or beyond
        ``range_max`` are beams without a return.
    :ivar angle_min: angle of beam 0 in the laser frame, rad.
    :ivar angle_increment: angle from one beam to the next, rad; negative for a laser mounted upside down.
    :ivar range_min: smallest valid range, meters.
    :ivar range_max: smallest range that means "no return", meters.
    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar time_increment: seconds from one beam to the next, 0 where unknown.
    :ivar motion: shape (3,), twist of the base's motion from the first beam to the last, m, m, rad: its exponential is
        the pose of the base at the last beam in the base at the first. Zeros where it is unknown.
    :ivar starts: shape (n,), float32, range below which a beam does not hold any more, m, since a new object blocks it;
        smaller than its range. None where all beams hold from the laser on.
    """

    stamp: int
    ranges: Float32
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser_pose: Float64 = field(default_factory=partial(np.zeros, 3))
    time_increment: float = 0.0
    motion: Float64 = field(default_factory=partial(np.zeros, 3))
    starts: Float32 | None = None
    _revised: tuple[BeamRevision, Scan] | None = field(default=None, init=False, repr=False)
    _points: Float64 | None = field(default=None, init=False, repr=False)
    _keeps_points: bool = field(default=True, init=False, repr=False)

    def __post_init__(self) -> None:
        numbers = (self.angle_min, self.angle_increment, self.range_min, self.range_max, self.time_increment)
        # Beyond float32 a number is infinite, which the checks of a scan refuse.
        for name, rounded in zip(_FLOAT32_FIELDS, array("f", numbers), strict=True):
            object.__setattr__(self, name, rounded)

    @property
    def sweep_duration(self) -> float:
        """Seconds from the first beam to the last."""
        return max(0, self.ranges.size - 1) * self.time_increment

    @property
    def end_stamp(self) -> int:
        """Time of the last beam, ns, to the microsecond that float32 is good for; needs a finite ``time_increment``."""
        return self.stamp + 1000 * round(self.sweep_duration * _MICROSECONDS)

    @cached_property
    def valid(self) -> Bool:
        """Beams with a return, shape (n,)."""
        return _valid_mask(self.ranges, np.float32(max(self.range_min, 1e-3)), np.float32(self.range_max))

    @property
    def points(self) -> Float64:
        """End points of the beams with a return, shape (k, 2), meters, robot base frame."""
        if self._points is not None:
            return self._points
        points = self._deskew(self._points_along_beams(self.ranges))
        if self._keeps_points:
            object.__setattr__(self, "_points", points)
        return points

    def forget_points(self) -> None:
        """Keep the ranges alone; the points, of four times their memory, are computed at each use from now on."""
        object.__setattr__(self, "_points", None)
        object.__setattr__(self, "_keeps_points", False)

    def _points_along_beams(self, ranges: Float32) -> Float64:
        """Points on the beams with a return, shape (k, 2), in the frame of the base at each beam.

        :param ranges: shape (n,), distances from the laser, m.
        """
        first = self.angle_min + float(self.laser_pose[2])
        directions = _directions(self.ranges.size, first, self.angle_increment)
        return _beam_ends(ranges, directions, self.laser_pose, self.valid)

    def revise(self, revision: BeamRevision) -> Scan:
        """The scan without the parts that do not hold any more; the same object for the same revision."""
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
    def origins(self) -> Float64:
        """Start points of the beams with a return, shape (k, 2), meters, robot base frame.

        A beam starts at the laser, or at its ``starts``.
        """
        if self.starts is not None:
            return self._deskew(self._points_along_beams(self.starts))
        origins = np.empty((len(self.points), 2))
        origins[:] = self.laser_pose[:2]
        return self._deskew(origins)

    @property
    def beams(self) -> Float64:
        """Vectors from ``origins`` to ``points``, shape (k, 2), meters, robot base frame."""
        return self.points - self.origins

    def _deskew(self, points: Float64) -> Float64:
        """Points (k, 2), one on each beam with a return, from the base at that beam to the base at the first."""
        if not self.motion.any():
            return points
        fractions = np.flatnonzero(self.valid) / max(1, self.ranges.size - 1)
        return se2.transform(se2.exp(fractions[:, None] * self.motion), points)


_MAX_SWEEP = 1.0
"""Longest duration of a sweep, s; scanners turn ten times faster."""

_MIN_PERIODS, _PERIODS = 5, 9
"""Periods between scans from which a sweep is checked, and those that are kept for their median."""

_JITTER = 1.2
"""Duration of a sweep at most, as a factor on the median period: stamps jitter."""


_MAX_LASERS = 32
"""Lasers whose periods are kept, those of the last scans."""


@dataclass(frozen=True, eq=False)
class LaserPeriods:
    """Times between the scans of one laser.

    :ivar laser_pose: ``base_T_laser``, shape (3,), m and rad, by which lasers are distinguished.
    :ivar last_stamp: of the last scan, ns.
    :ivar periods: the last times between two scans, s.
    """

    laser_pose: Float64
    last_stamp: int
    periods: tuple[float, ...] = ()


@dataclass(frozen=True)
class SweepState:
    """Times between scans.

    :ivar lasers: the times of each laser, that of the last scan at the end.
    """

    lasers: tuple[LaserPeriods, ...] = ()


class SweepCheck:
    """Check whether the sweeps of each laser can have the duration that ``time_increment`` gives.

    The result depends on the sequence of scans alone, not on how they mix with odometry.

    :ivar state: the times between the last scans.
    """

    def __init__(self, state: SweepState | None = None) -> None:
        """:param state: to go on from."""
        self.state = state or SweepState()

    def check(self, scan: Scan) -> tuple[Scan, str | None]:
        """The scan and the fault of its ``time_increment``, or None; a scan with a fault comes back without it."""
        is_own = [np.array_equal(laser.laser_pose, scan.laser_pose) for laser in self.state.lasers]
        own = self.state.lasers[is_own.index(True)] if any(is_own) else None
        others = tuple(laser for laser in self.state.lasers if laser is not own)
        periods = () if own is None else (*own.periods, (scan.stamp - own.last_stamp) * 1e-9)[-_PERIODS:]
        self.state = SweepState((*others, LaserPeriods(scan.laser_pose, scan.stamp, periods))[-_MAX_LASERS:])
        fault = _sweep_fault(scan, periods)
        if fault is None:
            return scan, None
        return replace(scan, time_increment=0.0), (
            f"The scan at {scan.stamp * 1e-9:.6f} s has time_increment = {scan.time_increment:g} s, {fault}; "
            "such scans are taken as if measured at one moment: correct it in the laser's driver, or set it to 0."
        )


def _sweep_fault(scan: Scan, periods: tuple[float, ...]) -> str | None:
    """What is wrong with the ``time_increment`` of a scan, None where it can be.

    :param periods: the last times between two scans of its laser, s.
    """
    if not (math.isfinite(scan.time_increment) and scan.time_increment >= 0.0):
        return "which is no time from one beam to the next"
    if scan.sweep_duration > _MAX_SWEEP:
        return (
            f"so that its {scan.ranges.size} beams would take {scan.sweep_duration:.2f} s, more than {_MAX_SWEEP:g} s"
        )
    if len(periods) < _MIN_PERIODS or scan.sweep_duration <= _JITTER * median(periods):
        return None
    return (
        f"so that its {scan.ranges.size} beams would take {scan.sweep_duration:.3f} s, longer than the "
        f"{median(periods):.3f} s from one scan to the next"
    )


_REACH = 0.5
"""Distance of the points to each side to which a surface is fitted, m; the next points where beams are sparser."""

_GAP = 0.4
"""Distance of neighboring points from which they are on different surfaces, as a share of their range."""

_FLAT = 0.03
"""Largest deviation of the points across a surface, m."""

_OFF, _DEVIATIONS = 0.03, 3.0
"""Largest distance of a point from the surface around it, m, plus this many of the deviations across the surface."""

_DEPTH_STEP, _DEPTH_STEP_SHARE = 0.1, 0.05
"""Distance from which a point and a nearer neighbor are on two objects, m and as a share of the range."""


class FlatnessLimits(NamedTuple):
    """Limits within which points form a wall.

    :ivar min_along: deviation of the points along it at least, m.
    :ivar max_across_ratio: that across it at most, as a share of that along it.
    """

    min_along: float
    max_across_ratio: float


_FLATNESS = FlatnessLimits(0.1, 0.2)
"""Limits for surfels."""


@njit(cache=True)
def extract_surfels(points: Float64, origins: Float64, stride: int = 1) -> Float64:
    """One point out of ``stride``, with its normal, which is fitted to all points.

    :param points: shape (n, 2), m, in the order of the beams.
    :param origins: shape (n, 2), position of the laser at each.
    :returns: shape (k, 4): x, y, and the unit normal, of either sign, or zeros for a point on no surface. Points at the
        edge of the shadow of a nearer object are left out.
    """
    surfels, beams = np.zeros((-(-len(points) // stride), 4)), points - origins
    for k in range(len(surfels)):
        surfels[k, 0], surfels[k, 1] = points[k * stride, 0], points[k * stride, 1]
    return surfels[_find_normals(beams, np.hypot(beams[:, 0], beams[:, 1]), stride, surfels)]


def transform_surfels(a_T_b: Float64, surfels: Float64) -> Float64:
    """Surfels (n, 4) of frame b in frame a, for one pose (3,)."""
    normals = se2.transform((0.0, 0.0, a_T_b[2]), surfels[:, 2:])
    return np.concatenate((se2.transform(a_T_b, surfels[:, :2]), normals), axis=1)


@njit(cache=True)
def _find_normals(beams: Float64, ranges: Float64, stride: int, surfels: Float64) -> Bool:
    """Write the normals into surfels (k, 4); at an edge, the normal of the surface on one side of it.

    :param beams: shape (n, 2), m, from the laser to the points.
    :returns: whether each of the points shows more than the edge of a shadow, (k,).
    """
    sums, shown = running_sums(beams, ranges), np.ones(len(surfels), np.bool_)
    for k in range(len(surfels)):
        i, normal = k * stride, surfels[k, 2:]
        low, high = _last_within(beams, ranges, i, -1, 1), _last_within(beams, ranges, i, 1, 1)
        if low < i < high and fit_surface(beams, sums, low, i, high, _FLATNESS, normal):
            continue
        low, high = _last_within(beams, ranges, i, -1, 2), _last_within(beams, ranges, i, 1, 2)
        if i - low >= 2 and fit_surface(beams, sums, low, i, i, _FLATNESS, normal):
            continue
        if high - i >= 2 and fit_surface(beams, sums, i, i, high, _FLATNESS, normal):
            continue
        shown[k] = not _is_shadow_edge(beams, ranges, i)
    return shown


@njit(cache=True)
def _last_within(beams: Float64, ranges: Float64, i: int, step: int, fewest: int) -> int:
    """The first point out of reach of those that follow ``i`` without a gap, or else the last of them."""
    j = i
    while 0 <= j + step < len(beams):
        dx, dy = beams[j + step, 0] - beams[j, 0], beams[j + step, 1] - beams[j, 1]
        if dx * dx + dy * dy > (_GAP * max(ranges[j], ranges[j + step])) ** 2:
            break
        j += step
        dx, dy = beams[j, 0] - beams[i, 0], beams[j, 1] - beams[i, 1]
        if abs(j - i) >= fewest and dx * dx + dy * dy >= _REACH * _REACH:
            break
    return j


@njit(cache=True)
def running_sums(beams: Float64, ranges: Float64) -> Float64:
    """Sums over the beams before each beam, shape (n + 1, 10).

    Columns are cos^2, cos sin, sin^2, cos / r, sin / r of the directions, and x, y, x^2, x y, y^2 of the points.
    """
    sums = np.zeros((len(beams) + 1, 10))
    for k in range(len(beams)):
        x, y, inverse = beams[k, 0], beams[k, 1], 1.0 / ranges[k]
        cos, sin = x * inverse, y * inverse
        terms = (cos * cos, cos * sin, sin * sin, cos * inverse, sin * inverse, x, y, x * x, x * y, y * y)
        for n in range(10):
            sums[k + 1, n] = sums[k, n] + terms[n]
    return sums


@njit(cache=True)
def fit_surface(
    beams: Float64, sums: Float64, low: int, own: int, high: int, wall: FlatnessLimits, normal: Float64
) -> bool:
    """Fit a line to the points from ``low`` to ``high``, and return whether they and the point ``own`` are on one.

    On a line the inverse of the range is linear in the direction of the beam. Ranges are uncertain and directions exact
    in this fit: total least squares would bias all normals to the same side. The point itself is left out, since its
    own error would turn its normal.

    :param beams: shape (n, 2), m, from the laser to the points.
    :param sums: of :func:`running_sums`.
    :param normal: (2,), written to.
    """
    xx, xy = _sum_without(sums, 0, low, own, high), _sum_without(sums, 1, low, own, high)
    yy = _sum_without(sums, 2, low, own, high)
    x, y = _sum_without(sums, 3, low, own, high), _sum_without(sums, 4, low, own, high)
    across_x, across_y = yy * x - xy * y, xx * y - xy * x
    length = np.hypot(across_x, across_y)
    if length == 0.0:
        return False
    across_x, across_y, distance = across_x / length, across_y / length, (xx * yy - xy * xy) / length
    share = 1.0 / (high - low)
    x, y = share * _sum_without(sums, 5, low, own, high), share * _sum_without(sums, 6, low, own, high)
    xx, xy = share * _sum_without(sums, 7, low, own, high), share * _sum_without(sums, 8, low, own, high)
    yy = share * _sum_without(sums, 9, low, own, high)
    square = across_x * across_x * xx + 2.0 * across_x * across_y * xy + across_y * across_y * yy
    off = np.sqrt(max(0.0, square - 2.0 * distance * (across_x * x + across_y * y) + distance * distance))
    square = across_x * across_x * yy - 2.0 * across_x * across_y * xy + across_y * across_y * xx
    spread = np.sqrt(max(0.0, square - (across_x * y - across_y * x) ** 2))
    own_off = abs(across_x * beams[own, 0] + across_y * beams[own, 1] - distance)
    if (
        spread < wall.min_along
        or off > min(_FLAT, wall.max_across_ratio * spread)
        or own_off > _OFF + _DEVIATIONS * off
    ):
        return False
    normal[0], normal[1] = across_x, across_y
    return True


@njit(cache=True)
def _sum_without(sums: Float64, column: int, low: int, own: int, high: int) -> float:
    """The sum over the points from ``low`` to ``high`` without the point ``own`` among them."""
    return sums[high + 1, column] - sums[low, column] - (sums[own + 1, column] - sums[own, column])


@njit(cache=True)
def _is_shadow_edge(beams: Float64, ranges: Float64, i: int) -> bool:
    """Whether a point is beside a nearer object, so that the gap shows the edge of that object."""
    limit = _DEPTH_STEP + _DEPTH_STEP_SHARE * ranges[i]
    for j in (i - 1, i + 1):
        if not 0 <= j < len(beams) or ranges[j] >= ranges[i]:
            continue
        if np.hypot(beams[i, 0] - beams[j, 0], beams[i, 1] - beams[j, 1]) > limit:
            return True
    return False
