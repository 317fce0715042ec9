"""Openings: gaps in a wall through which a scan sees free space, such as doors and crossing hallways.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1: large steps across a wall. A beam ends before the line of a wall,
on it, or passes it, by a little or by more than a niche is deep. The beams that pass a line between two jambs are an
opening where some of them go deep. A jamb is an end of the wall, or another wall that crosses its line, as at the end
of a hallway that another one leaves to the side; one of the two is an end of the wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int8, Int64
from hmt_slam_ros.configuration.features import Features
from hmt_slam_ros.features.corners import size_confidence
from hmt_slam_ros.features.extraction import Lines
from hmt_slam_ros.features.line_fit import variance_at
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensing import Scan

_NOTHING, _ON, _SHALLOW, _DEEP, _BEFORE = range(5)  # what a beam says of a line
# A beam ends on a wall within so many deviations of its line, which has to be known so well there, m.
_STRAY, _KNOWN = 3.5, 0.06
# A beam flatter to a line than this (sine) says nothing of it.
_GRAZING = 0.05
# Beams that go deep, at least.
_BEAMS = 3
# Two openings this near to each other (m, rad) are one, seen in both faces of a wall.
_SAME, _SAME_HEADING = 0.6, 0.5

# Columns of a gap that was found: its line, then place, variance and support of the first jamb and of the last.
_LINE, _FIRST, _LAST, _SHARE, _SIZE = 0, 1, 4, 7, 8
_PLACE, _VARIANCE, _SUPPORT = 0, 1, 2


class Rays(NamedTuple):
    """How far beams go through free space, in the order of their bearing.

    :ivar origins: shape (n, 2), where they begin, m.
    :ivar directions: shape (n, 2), unit vectors.
    :ivar free: shape (n,), m.
    :ivar deviations: shape (n,), of these, m.
    :ivar met: shape (n,), whether there is a surface; else it is not known how the beam goes on.
    """

    origins: Float64
    directions: Float64
    free: Float64
    deviations: Float64
    met: Bool


class Openings(NamedTuple):
    """Openings in the frame of the beams.

    :ivar poses: shape (n, 3), the middle between the jambs, m, and the heading through it, away from the robot, rad.
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    :ivar widths: shape (n,), m.
    :ivar width_deviations: shape (n,), m.
    :ivar confidences: shape (n,), in (0, 1).
    """

    poses: Float64
    covariances: Float64
    widths: Float64
    width_deviations: Float64
    confidences: Float64


def rays_of(scan: Scan, features: Features) -> Rays:
    """The beams of a scan with a return."""
    beams = scan.beams
    lengths = np.hypot(*beams.T)
    deviations = np.full(len(beams), features.range_deviation)
    directions = beams / np.maximum(lengths, 1e-9)[:, None]
    return Rays(scan.origins, directions, lengths, deviations, np.ones(len(beams), np.bool_))


class Told(NamedTuple):
    """What beams say of a line, in the order of their bearing.

    :ivar kinds: shape (n,), one of the constants above.
    :ivar along: shape (n,), where on the line they meet it, m.
    :ivar behind: shape (n,), how far they go behind it, m.
    :ivar beams: shape (n,), their numbers.
    """

    kinds: Int8
    along: Float64
    behind: Float64
    beams: Int64


def openings_of(lines: Lines, rays: Rays, features: Features) -> Openings:
    """The openings in the walls that lines show."""
    parameters = np.ascontiguousarray(lines.parameters)
    found = _openings(parameters, lines.covariances, rays, features.opening_depth, features.max_gap)
    widths = found[:, _LAST] - found[:, _FIRST]
    found = found[(widths >= features.opening_min) & (widths <= features.opening_max)]
    own = found[:, _LINE].astype(np.int64)
    alpha, r = lines.parameters[own].T
    middles = 0.5 * (found[:, _FIRST] + found[:, _LAST])
    variances = found[:, _FIRST + _VARIANCE] + found[:, _LAST + _VARIANCE]
    cos, sin = np.cos(alpha), np.sin(alpha)
    poses = np.stack((r * cos - middles * sin, r * sin + middles * cos, alpha), axis=1)
    # In the frame of the opening: r moves it ahead, and alpha turns it about the origin.
    by_line = np.zeros((len(found), 3, 2))
    by_line[:, 0, 0], by_line[:, 0, 1], by_line[:, 1, 0], by_line[:, 2, 0] = -middles, 1.0, r, 1.0
    covariances = by_line @ lines.covariances[own] @ by_line.transpose(0, 2, 1)
    covariances[:, 1, 1] += 0.25 * variances
    support = found[:, _FIRST + _SUPPORT] + found[:, _LAST + _SUPPORT]
    confidences = size_confidence(support, features) * (1.0 - np.exp(-found[:, _SHARE] / features.opening_share))
    widths = found[:, _LAST] - found[:, _FIRST]
    return _without_repetitions(Openings(poses, covariances, widths, np.sqrt(variances), confidences))


def _without_repetitions(openings: Openings) -> Openings:
    """Of those that are one the most confident to a tenth, and of these the one whose wall is known best."""
    kept: list[int] = []
    for k in np.lexsort((openings.covariances[:, 0, 0], -np.round(openings.confidences, 1))).tolist():
        near = np.hypot(*(openings.poses[kept, :2] - openings.poses[k, :2]).T) < _SAME
        turn = np.abs(se2.wrap(openings.poses[kept, 2] - openings.poses[k, 2]))
        if not np.any(near & (turn < _SAME_HEADING)):
            kept.append(k)
    return Openings(*(field[kept] for field in openings))


@njit(cache=True)
def _openings(lines: Float64, covariances: Float64, rays: Rays, depth: float, max_gap: float) -> Float64:
    """All gaps between two jambs in the lines that beams go deep through, (n, 8)."""
    beams, count = len(rays.free), 0
    found = np.empty((len(lines) * (beams // _BEAMS) + 1, _SIZE))
    told = Told(np.empty(beams, np.int8), np.empty(beams), np.empty(beams), np.empty(beams, np.int64))
    for line in range(len(lines)):
        last, end = -1, _sort_out(lines[line], covariances[line], rays, depth, told)
        while last + 1 < end:
            first = last + 1
            last = _last_behind(told, first, end)
            if last < first:
                last = first
            elif _gap(lines[line], covariances[line], rays, told, first, last, end, max_gap, found[count]):
                found[count, _LINE] = line
                count += 1
    return found[:count]


@njit(cache=True)
def _sort_out(line: Float64, covariance: Float64, rays: Rays, depth: float, told: Told) -> int:
    """Write what beams say of a line, and return how many say something."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    beams, count, start, least = len(rays.free), 0, 0, 0.0
    for k in range(beams):
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < least:
            start, least = k, facing
    for n in range(beams):
        k = (start + n) % beams
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < _GRAZING:
            continue
        x, y = rays.origins[k, 0], rays.origins[k, 1]
        way = (line[1] - cos * x - sin * y) / facing
        along = cos * (y + way * rays.directions[k, 1]) - sin * (x + way * rays.directions[k, 0])
        behind = (rays.free[k] - way) * facing
        variance = variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], along)
        near = _STRAY * math.sqrt(variance + (rays.deviations[k] * facing) ** 2)
        kind = _kind(behind, near, rays.met[k], depth)
        if variance <= _KNOWN * _KNOWN and kind != _NOTHING:
            told.kinds[count], told.along[count], told.behind[count], told.beams[count] = kind, along, behind, k
            count += 1
    return count


@njit(cache=True)
def _kind(behind: float, near: float, met: bool, depth: float) -> int:
    """What a beam says of a line that it goes ``behind`` it, m, where within ``near`` is on it."""
    if behind >= depth:
        return _DEEP
    if not met:
        return _NOTHING
    if behind > near:
        return _SHALLOW
    return _ON if behind >= -near else _BEFORE


@njit(cache=True)
def _last_behind(told: Told, first: int, end: int) -> int:
    """The last of the beams from the first on that all go behind the line; before the first where that does not."""
    last = first - 1
    while last + 1 < end and (told.kinds[last + 1] == _SHALLOW or told.kinds[last + 1] == _DEEP):
        last += 1
    return last


@njit(cache=True)
def _gap(
    line: Float64, covariance: Float64, rays: Rays, told: Told, first: int, last: int, end: int, max_gap: float,
    found: Float64,
) -> bool:
    """Write the gap that beams from the first to the last pass; False where it is none."""
    before, after = first - 1, last + 1
    if before < 0 or after >= end or (told.kinds[before] != _ON and told.kinds[after] != _ON):
        return False
    for own, step, jamb in ((before, -1, found[_FIRST:_LAST]), (after, 1, found[_LAST:_SHARE])):
        if told.kinds[own] == _ON:
            _wall_end(line, covariance, rays, told, own, step, end, max_gap, jamb)
        elif not _crossing_wall(line, rays, told, own, step, max_gap, jamb):
            return False
    deep, clear = 0, 0.0
    for k in range(first, last + 1):
        if told.kinds[k] == _DEEP:
            deep, clear = deep + 1, clear + 0.5 * abs(told.along[k + 1] - told.along[k - 1])
    if found[_FIRST] > found[_LAST]:
        for column in range(_SHARE - _LAST):
            one, other = _FIRST + column, _LAST + column
            found[one], found[other] = found[other], found[one]
    found[_SHARE] = clear / max(found[_LAST] - found[_FIRST], clear)
    return deep >= _BEAMS


@njit(cache=True)
def _wall_end(
    line: Float64, covariance: Float64, rays: Rays, told: Told, k: int, step: int, end: int, max_gap: float,
    jamb: Float64,
) -> None:
    """Write the jamb where the wall ends on which the beams from ``k`` on lie, away from the gap.

    The first of them may lie on its other side, in the thickness of the wall.
    """
    while 0 <= k + step < end and told.kinds[k + step] == _ON and told.behind[k] > _across(line, rays, told.beams[k]):
        k += step
    spacing, beam = told.along[k - step] - told.along[k], told.beams[k]
    jamb[_PLACE] = told.along[k] + 0.5 * spacing
    # Where the end is between two beams, and how far the line's error moves it along the beam.
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    slant = (1.0 - facing * facing) / (facing * facing)
    uncertain = abs(spacing) + 2.0 * _STRAY * rays.deviations[beam]
    jamb[_VARIANCE] = uncertain * uncertain / 12.0
    jamb[_VARIANCE] += slant * variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], told.along[k])
    last = k
    while 0 <= last + step < end and told.kinds[last + step] == _ON:
        if abs(told.along[last + step] - told.along[last]) > max_gap:
            break
        last += step
    jamb[_SUPPORT] = abs(told.along[last] - told.along[k])


@njit(cache=True)
def _across(line: Float64, rays: Rays, beam: int) -> float:
    """Deviation of the end of a beam across a line, m."""
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    return rays.deviations[beam] * facing


@njit(cache=True)
def _crossing_wall(
    line: Float64, rays: Rays, told: Told, k: int, step: int, max_gap: float, jamb: Float64
) -> bool:
    """Write the jamb where another wall crosses the line before beam ``k``; False where none does."""
    before = told.beams[k - step]
    x, y = _end(rays, told.beams[k])
    from_x, from_y = _end(rays, before)
    if not rays.met[before] or math.hypot(x - from_x, y - from_y) > max_gap:
        return False
    cos, sin = math.cos(line[0]), math.sin(line[0])
    share = told.behind[k - step] / (told.behind[k - step] - told.behind[k])
    crossing_x, crossing_y = from_x + share * (x - from_x), from_y + share * (y - from_y)
    jamb[_PLACE] = cos * crossing_y - sin * crossing_x
    beam = told.beams[k]
    slanted = cos * rays.directions[beam, 1] - sin * rays.directions[beam, 0]
    jamb[_VARIANCE] = (rays.deviations[beam] * slanted) ** 2
    jamb[_SUPPORT] = 0.0
    return True


@njit(cache=True)
def _end(rays: Rays, beam: int) -> tuple[float, float]:
    """Where a beam ends."""
    away = rays.free[beam]
    x = rays.origins[beam, 0] + away * rays.directions[beam, 0]
    return x, rays.origins[beam, 1] + away * rays.directions[beam, 1]
