"""A laser scan that carries its own geometry, and its end points with the normals of the surfaces they lie on.

A wall tells a scan how far away it is, and nothing of where along it the robot is. The cells of a map do, falsely: far
beams meet a wall so sparsely that their end points look like posts, a slanting wall has steps, a wall ends where the
last scan did. So what a point may say of the pose is limited to the direction of its normal, which the scan itself
shows. Points that lie on no surface, such as posts and corners, may say everything.
"""

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


# A surface is fitted to the points up to this far on each side, m, or to the next ones where beams are sparser.
_REACH = 0.5
# Neighbouring points farther apart than this share of their range lie on different surfaces.
_GAP = 0.4
# Deviation of the points across a surface at most, m.
_FLAT = 0.03
# A point lies on the surface of those around it within so much, m, and within so many of their deviations across it.
_OFF, _DEVIATIONS = 0.03, 3.0
# A point and one in front of it show two things if they are farther apart than this, in m and as a share of the range.
_DEPTH_STEP, _DEPTH_STEP_SHARE = 0.1, 0.05


class FlatnessLimits(NamedTuple):
    """What points are taken for a wall.

    :ivar min_along: deviation of the points along it at least, m.
    :ivar max_across_ratio: that across it at most, as a share of that along it.
    """

    min_along: float
    max_across_ratio: float


_FLATNESS = FlatnessLimits(0.1, 0.2)


@njit(cache=True)
def extract_surfels(points: Float64, origins: Float64, stride: int = 1) -> Float64:
    """Every so many of the points, with their normals, which all points show.

    :param points: shape (n, 2), m, in the order of the beams.
    :param origins: shape (n, 2), where the laser was at each.
    :returns: shape (k, 4): x, y, and the unit normal, of either sign, or zeros for a point on no surface. Points that
        only show where the shadow of something nearer ends are left out.
    """
    found, beams = np.zeros((-(-len(points) // stride), 4)), points - origins
    for k in range(len(found)):
        found[k, 0], found[k, 1] = points[k * stride, 0], points[k * stride, 1]
    return found[_find_normals(beams, np.hypot(beams[:, 0], beams[:, 1]), stride, found)]


def transform_surfels(a_T_b: Float64, surfels: Float64) -> Float64:
    """Surfels (n, 4) of frame b in frame a, for one pose (3,)."""
    turned = se2.transform((0.0, 0.0, a_T_b[2]), surfels[:, 2:])
    return np.concatenate((se2.transform(a_T_b, surfels[:, :2]), turned), axis=1)


@njit(cache=True)
def _find_normals(beams: Float64, ranges: Float64, stride: int, found: Float64) -> Bool:
    """Write the normals of the surfaces around every so many points; at an edge, of the surface on one side of it.

    :param beams: shape (n, 2), m, from the laser to the points.
    :returns: which of the points show more than a shadow.
    """
    sums, shown = running_sums(beams, ranges), np.ones(len(found), np.bool_)
    for k in range(len(found)):
        i, normal = k * stride, found[k, 2:]
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
    """The first point of those that follow ``i`` without a gap that is out of reach, or else the last of them."""
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
    """Sums over the beams before each, shape (n + 1, 10).

    They are of cos^2, cos sin, sin^2, cos / r, sin / r over the directions, and of x, y, x^2, x y, y^2 over the points.
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
    """Fit a line to the points from ``low`` to ``high``; False where they, or the point itself, do not lie on one.

    On a line the inverse of the range is linear in the direction of the beam. The fit takes the ranges for uncertain
    and the directions for exact: total least squares would turn all normals a little to the same side, and what is
    seen ahead would draw the robot back. The point itself is left out of it, or its own error would turn its normal,
    and the two together push along the wall.

    :param beams: shape (n, 2), m, from the laser to the points.
    :param sums: of :func:`running_sums`.
    :param normal: (2,), written to.
    """
    xx, xy, yy = (
        _sum_without(sums, 0, low, own, high),
        _sum_without(sums, 1, low, own, high),
        _sum_without(sums, 2, low, own, high),
    )
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
    """The sum over the points from ``low`` to ``high`` without ``own``, which is one of them."""
    return sums[high + 1, column] - sums[low, column] - (sums[own + 1, column] - sums[own, column])


@njit(cache=True)
def _is_shadow_edge(beams: Float64, ranges: Float64, i: int) -> bool:
    """Whether a point is beside one in front of it, so that the two do not show where it ends but where that does."""
    limit = _DEPTH_STEP + _DEPTH_STEP_SHARE * ranges[i]
    for j in (i - 1, i + 1):
        if not 0 <= j < len(beams) or ranges[j] >= ranges[i]:
            continue
        if np.hypot(beams[i, 0] - beams[j, 0], beams[i, 1] - beams[j, 1]) > limit:
            return True
    return False
