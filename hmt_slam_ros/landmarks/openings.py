"""Openings: gaps in a wall through which a scan sees free space, such as doors and crossing hallways.

People, and furniture in the room behind a door, cross the line of a wall as well. The support of a jamb is the length
of the stretch of wall that ends there; what crosses gives none, however long it is.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1: large steps across a wall. A beam ends before the line of a wall,
on it, or passes it, by a little or by more than a niche is deep. The beams that pass a line between two jambs are an
opening where some of them go deep. A jamb is an end of the wall, or another wall that crosses its line, as at the end
of a hallway that another one leaves to the side; one of the two is an end of the wall.

Furniture has ends, too, and so have people who stand in an opening. The log-odds of an opening are linear in the
logarithms of what was seen of its wall, of its jambs, and of what is behind it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int8, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.line_fit import variance_at
from hmt_slam_ros.landmarks.rays import Rays

NO_INFORMATION, ON_LINE, SHALLOW_BEHIND, DEEP_BEHIND, IN_FRONT = range(5)
"""What a beam says of a line."""

STRAY_DEVIATIONS = 3.5
"""A beam ends on a wall within so many deviations of its line."""

# The line has to be known so well there, m.
_MAX_LINE_DEVIATION = 0.06
# A beam flatter to a line than this (sine) says nothing of it.
_GRAZING = 0.05


class BeamLabels(NamedTuple):
    """What beams say of a line, in the order of their bearing.

    :ivar labels: shape (n,), one of the constants above.
    :ivar along: shape (n,), where on the line they meet it, m.
    :ivar behind: shape (n,), how far they go behind it, m.
    :ivar beams: shape (n,), their numbers.
    """

    labels: Int8
    along: Float64
    behind: Float64
    beams: Int64


@njit(cache=True)
def empty_beam_labels(beams: int) -> BeamLabels:
    """Room for what so many beams say."""
    return BeamLabels(np.empty(beams, np.int8), np.empty(beams), np.empty(beams), np.empty(beams, np.int64))


@njit(cache=True)
def label_beams(line: Float64, covariance: Float64, rays: Rays, depth: float, told: BeamLabels) -> int:
    """Write what beams say of a line, and return how many say something."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    beams, count, start, least = len(rays.free_range), 0, 0, 0.0
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
        behind = (rays.free_range[k] - way) * facing
        variance = variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], along)
        near = STRAY_DEVIATIONS * math.sqrt(variance + (rays.deviations[k] * facing) ** 2)
        kind = _label_beam(behind, near, rays.hit[k], depth)
        if variance <= _MAX_LINE_DEVIATION * _MAX_LINE_DEVIATION and kind != NO_INFORMATION:
            told.labels[count], told.along[count], told.behind[count], told.beams[count] = kind, along, behind, k
            count += 1
    return count


@njit(cache=True)
def _label_beam(behind: float, near: float, met: bool, depth: float) -> int:
    """What a beam says of a line that it goes ``behind`` it, m, where within ``near`` is on it."""
    if behind >= depth:
        return DEEP_BEHIND
    if not met:
        return NO_INFORMATION
    if behind > near:
        return SHALLOW_BEHIND
    return ON_LINE if behind >= -near else IN_FRONT


@njit(cache=True)
def last_beam_behind(told: BeamLabels, first: int, end: int) -> int:
    """The last of the beams from the first on that all go behind the line; before the first where that does not."""
    last = first - 1
    while last + 1 < end and (told.labels[last + 1] == SHALLOW_BEHIND or told.labels[last + 1] == DEEP_BEHIND):
        last += 1
    return last


@njit(cache=True)
def deviation_across(line: Float64, rays: Rays, beam: int) -> float:
    """Deviation of the end of a beam across a line, m."""
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    return rays.deviations[beam] * facing


POSITION, VARIANCE, SUPPORT = range(3)
"""Where what is known of a jamb stands in an array: where on the line, m, the variance of that, and support, m."""


@njit(cache=True)
def write_wall_end_jamb(
    line: Float64, covariance: Float64, rays: Rays, told: BeamLabels, k: int, step: int, max_gap: float, jamb: Float64
) -> None:
    """Write the jamb where the wall ends on which the beams from ``k`` on lie, away from the gap.

    The first of them may lie on its other side, in the thickness of the wall.

    :param told: what beams say of the line, all of those that say something.
    """
    end = len(told.labels)
    while (
        0 <= k + step < end
        and told.labels[k + step] == ON_LINE
        and told.behind[k] > deviation_across(line, rays, told.beams[k])
    ):
        k += step
    spacing, beam = told.along[k - step] - told.along[k], told.beams[k]
    jamb[POSITION] = told.along[k] + 0.5 * spacing
    # Where the end is between two beams, and how far the line's error moves it along the beam.
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    slant = (1.0 - facing * facing) / (facing * facing)
    uncertain = abs(spacing) + 2.0 * STRAY_DEVIATIONS * rays.deviations[beam]
    jamb[VARIANCE] = uncertain * uncertain / 12.0
    jamb[VARIANCE] += slant * variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], told.along[k])
    last = k
    while 0 <= last + step < end and told.labels[last + step] == ON_LINE:
        if abs(told.along[last + step] - told.along[last]) > max_gap:
            break
        last += step
    jamb[SUPPORT] = abs(told.along[last] - told.along[k])


@njit(cache=True)
def write_crossing_wall_jamb(
    line: Float64, rays: Rays, told: BeamLabels, k: int, step: int, max_gap: float, jamb: Float64
) -> bool:
    """Write the jamb where another wall crosses the line before beam ``k``; False where none does."""
    before = told.beams[k - step]
    x, y = _beam_end(rays, told.beams[k])
    from_x, from_y = _beam_end(rays, before)
    if not rays.hit[before] or math.hypot(x - from_x, y - from_y) > max_gap:
        return False
    cos, sin = math.cos(line[0]), math.sin(line[0])
    share = told.behind[k - step] / (told.behind[k - step] - told.behind[k])
    crossing_x, crossing_y = from_x + share * (x - from_x), from_y + share * (y - from_y)
    jamb[POSITION] = cos * crossing_y - sin * crossing_x
    beam = told.beams[k]
    slanted = cos * rays.directions[beam, 1] - sin * rays.directions[beam, 0]
    jamb[VARIANCE] = (rays.deviations[beam] * slanted) ** 2
    jamb[SUPPORT] = 0.0
    return True


@njit(cache=True)
def _beam_end(rays: Rays, beam: int) -> tuple[float, float]:
    """Where a beam ends."""
    away = rays.free_range[beam]
    x = rays.origins[beam, 0] + away * rays.directions[beam, 0]
    return x, rays.origins[beam, 1] + away * rays.directions[beam, 1]


# Beams that go deep, at least.
_BEAMS = 3
# A jamb with less support, m, and a lesser share that is seen through count as this much.
_LEAST_JAMB, _LEAST_SHARE = 0.1, 0.01
# Two openings this near to each other (m, rad) are one, seen in both faces of a wall.
_SAME, _SAME_HEADING = 0.6, 0.5

# Columns of a gap that was found: its line, the first jamb, the last one, and the share that is seen through.
_LINE, _FIRST, _LAST, _SHARE, _SIZE = 0, 1, 4, 7, 8


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


NO_OPENINGS = Openings(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0), np.empty(0))
"""What a scan shows before the first one."""


def extract_openings(lines: Lines, rays: Rays, features: FeatureParameters) -> Openings:
    """The openings in the walls that lines show."""
    return extract_openings_with_evidence(lines, rays, features)[0]


def extract_openings_with_evidence(lines: Lines, rays: Rays, features: FeatureParameters) -> tuple[Openings, Float64]:
    """The openings, and what their confidences follow from.

    :returns: the second of shape (n, 3), logarithms of what was seen of the wall, m, of both jambs, m, together, and of
        the share of the width that is seen through.
    """
    parameters = np.ascontiguousarray(lines.parameters)
    found = _select_openings(parameters, lines.covariances, rays, features.opening_depth, features.max_gap)
    widths = found[:, _LAST] - found[:, _FIRST]
    found = found[(widths >= features.opening_min) & (widths <= features.opening_max)]
    own = found[:, _LINE].astype(np.int64)
    alpha, r = lines.parameters[own].T
    middles = 0.5 * (found[:, _FIRST] + found[:, _LAST])
    variances = found[:, _FIRST + VARIANCE] + found[:, _LAST + VARIANCE]
    cos, sin = np.cos(alpha), np.sin(alpha)
    poses = np.stack((r * cos - middles * sin, r * sin + middles * cos, alpha), axis=1)
    # In the frame of the opening: r moves it ahead, and alpha turns it about the origin.
    by_line = np.zeros((len(found), 3, 2))
    by_line[:, 0, 0], by_line[:, 0, 1], by_line[:, 1, 0], by_line[:, 2, 0] = -middles, 1.0, r, 1.0
    covariances = by_line @ lines.covariances[own] @ by_line.transpose(0, 2, 1)
    covariances[:, 1, 1] += 0.25 * variances
    evidence = _evidence(found, lines)
    weights = np.array([features.opening_wall, features.opening_jambs, features.opening_share])
    confidences = 1.0 / (1.0 + np.exp(-features.opening_bias - evidence @ weights))
    widths = found[:, _LAST] - found[:, _FIRST]
    every = Openings(poses, covariances, widths, np.sqrt(variances), confidences)
    kept = _distinct_openings(every)
    return Openings(*(field[kept] for field in every)), evidence[kept]


def _evidence(found: Float64, lines: Lines) -> Float64:
    """What speaks for gaps (n, 8) being openings, shape (n, 3)."""
    seen = np.zeros(len(lines))
    np.add.at(seen, lines.owners, lines.segments[:, 1] - lines.segments[:, 0])
    walls = np.log(seen[found[:, _LINE].astype(np.int64)])
    jambs = np.log(np.maximum(found[:, [_FIRST + SUPPORT, _LAST + SUPPORT]], _LEAST_JAMB)).sum(axis=1)
    shares = np.log(np.maximum(found[:, _SHARE], _LEAST_SHARE))
    return np.stack((walls, jambs, shares), axis=1)


def _distinct_openings(openings: Openings) -> list[int]:
    """Numbers of those that are one the most confident to a tenth, and of these the one whose wall is known best."""
    kept: list[int] = []
    for k in np.lexsort((openings.covariances[:, 0, 0], -np.round(openings.confidences, 1))).tolist():
        near = np.hypot(*(openings.poses[kept, :2] - openings.poses[k, :2]).T) < _SAME
        turn = np.abs(se2.wrap(openings.poses[kept, 2] - openings.poses[k, 2]))
        if not np.any(near & (turn < _SAME_HEADING)):
            kept.append(k)
    return kept


@njit(cache=True)
def _select_openings(lines: Float64, covariances: Float64, rays: Rays, depth: float, max_gap: float) -> Float64:
    """All gaps between two jambs in the lines that beams go deep through, (n, 8)."""
    beams, count = len(rays.free_range), 0
    found, room = np.empty((len(lines) * (beams // _BEAMS) + 1, _SIZE)), empty_beam_labels(beams)
    for own in range(len(lines)):
        last, end = -1, label_beams(lines[own], covariances[own], rays, depth, room)
        told = BeamLabels(room.labels[:end], room.along[:end], room.behind[:end], room.beams[:end])
        while last + 1 < end:
            first = last + 1
            last = last_beam_behind(told, first, end)
            if last < first:
                last = first
            elif _write_gap(lines[own], covariances[own], rays, told, first, last, max_gap, found[count]):
                found[count, _LINE] = own
                count += 1
    return found[:count]


@njit(cache=True)
def _write_gap(
    line: Float64,
    covariance: Float64,
    rays: Rays,
    told: BeamLabels,
    first: int,
    last: int,
    max_gap: float,
    found: Float64,
) -> bool:
    """Write the gap that beams from the first to the last pass; False where it is none."""
    before, after = first - 1, last + 1
    if before < 0 or after >= len(told.labels) or (told.labels[before] != ON_LINE and told.labels[after] != ON_LINE):
        return False
    for beam, step, jamb in ((before, -1, found[_FIRST:_LAST]), (after, 1, found[_LAST:_SHARE])):
        if told.labels[beam] == ON_LINE:
            write_wall_end_jamb(line, covariance, rays, told, beam, step, max_gap, jamb)
        elif not write_crossing_wall_jamb(line, rays, told, beam, step, max_gap, jamb):
            return False
    deep, clear = 0, 0.0
    for k in range(first, last + 1):
        if told.labels[k] == DEEP_BEHIND:
            deep, clear = deep + 1, clear + 0.5 * abs(told.along[k + 1] - told.along[k - 1])
    if found[_FIRST] > found[_LAST]:
        for column in range(_SHARE - _LAST):
            one, other = _FIRST + column, _LAST + column
            found[one], found[other] = found[other], found[one]
    found[_SHARE] = clear / max(found[_LAST] - found[_FIRST], clear)
    return deep >= _BEAMS


def jamb_positions(poses: Float64, widths: Float64) -> Float64:
    """Both jambs of openings, shape (n, 4), x and y of the left one and of the right one, m.

    :param poses: shape (n, 3), their middles with the heading through them, m and rad.
    :param widths: shape (n,), m.
    """
    across = np.stack((np.zeros_like(widths), 0.5 * widths, np.zeros_like(widths)), axis=1)
    return np.concatenate([se2.compose(poses, sign * across)[:, :2] for sign in (1.0, -1.0)], axis=1)


def distance_to_doors(origins: Float64, directions: Float64, doors: Float64) -> Float64:
    """How far it is along beams to the first door that they pass, m, shape (n,); inf where there is none.

    :param origins: shape (n, 2), where beams begin, m.
    :param directions: shape (n, 2), unit vectors.
    :param doors: shape (k, 4), x and y of both jambs of each, m.
    """
    along = doors[None, :, 2:] - doors[None, :, :2]
    to = doors[None, :, :2] - origins[:, None]
    turned = _cross_product(directions[:, None], along)
    turned = np.where(turned == 0.0, np.nan, turned)
    away, share = _cross_product(to, along) / turned, _cross_product(to, directions[:, None]) / turned
    passed = np.where((away > 0.0) & (share >= 0.0) & (share <= 1.0), away, np.inf)
    return np.asarray(passed.min(axis=1, initial=np.inf))


def _cross_product(a: Float64, b: Float64) -> Float64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
