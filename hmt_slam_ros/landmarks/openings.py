"""Openings: gaps in a wall with free space behind them, such as doors and crossing hallways.

Tomatis, Nourbakhsh and Siegwart (2003), section 2.1: large steps across a wall. Each beam ends before the line of a
wall, on it, or behind it, and there shallow or deeper than a niche. Beams behind the line between two jambs are an
opening if some of them are deep. A jamb is an end of the wall, or another wall that crosses its line, as at the mouth
of a hallway; one of the two jambs is an end. The support of a jamb is the length of the wall that ends there; crossing
surfaces, such as people and furniture, have none.

The log-odds of an opening are linear in the logarithms of the visible length of the wall, of the supports of its jambs,
and of the free share of its width.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.line_fit import variance_at
from hmt_slam_ros.landmarks.rays import Rays

NO_INFORMATION, ON_LINE, SHALLOW_BEHIND, DEEP_BEHIND, IN_FRONT = range(5)
"""Labels of a beam relative to a line."""

STRAY_DEVIATIONS = 3.5
"""Largest distance between a line and the end of a beam on it, in deviations."""

_MAX_LINE_DEVIATION = 0.06
"""Largest deviation of a line where a beam meets it, m."""

_MIN_SINE = 0.05
"""Smallest sine of the angle between a beam and a line."""

_MIN_DEEP_BEAMS = 3
"""Smallest number of deep beams of an opening."""

_MIN_SUPPORT, _MIN_SHARE = 0.1, 0.01
"""Lower bounds of the support of a jamb, m, and of the free share, in the log-odds."""

_SAME_DISTANCE, _SAME_HEADING = 0.6, 0.5
"""Openings nearer to each other than this, m and rad, are one, as on both faces of a wall."""


class BeamLabels(NamedTuple):
    """Labels of beams relative to a line, in the order of bearing.

    :ivar kinds: shape (n,), one of the constants above.
    :ivar along: shape (n,), position on the line where they meet it, m.
    :ivar behind: shape (n,), distance of their ends behind it, m.
    :ivar beams: shape (n,), their numbers.
    """

    kinds: Int8
    along: Float64
    behind: Float64
    beams: Int64


@njit(cache=True)
def empty_beam_labels(beams: int) -> BeamLabels:
    """Uninitialized labels for some beams."""
    return BeamLabels(np.empty(beams, np.int8), np.empty(beams), np.empty(beams), np.empty(beams, np.int64))


@njit(cache=True)
def label_beams(line: Float64, covariance: Float64, rays: Rays, depth: float, labels: BeamLabels) -> int:
    """Write the labels of beams that are informative about a line, and return their number."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    beams, count, start, least = len(rays.free_range), 0, 0, 0.0
    for k in range(beams):
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < least:
            start, least = k, facing
    for n in range(beams):
        k = (start + n) % beams
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < _MIN_SINE:
            continue
        x, y = rays.origins[k, 0], rays.origins[k, 1]
        distance = (line[1] - cos * x - sin * y) / facing
        along = cos * (y + distance * rays.directions[k, 1]) - sin * (x + distance * rays.directions[k, 0])
        behind = (rays.free_range[k] - distance) * facing
        variance = variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], along)
        near = STRAY_DEVIATIONS * math.sqrt(variance + (rays.deviations[k] * facing) ** 2)
        kind = _label_beam(behind, near, rays.hit[k], depth)
        if variance <= _MAX_LINE_DEVIATION * _MAX_LINE_DEVIATION and kind != NO_INFORMATION:
            labels.kinds[count], labels.along[count], labels.behind[count], labels.beams[count] = (
                kind,
                along,
                behind,
                k,
            )
            count += 1
    return count


@njit(cache=True)
def _label_beam(behind: float, near: float, met: bool, depth: float) -> int:
    """Label of a beam that ends ``behind`` a line, m; within ``near`` it is on the line."""
    if behind >= depth:
        return DEEP_BEHIND
    if not met:
        return NO_INFORMATION
    if behind > near:
        return SHALLOW_BEHIND
    return ON_LINE if behind >= -near else IN_FRONT


@njit(cache=True)
def last_beam_behind(labels: BeamLabels, first: int, end: int) -> int:
    """Last of the consecutive beams behind the line from ``first`` on; ``first - 1`` for none."""
    last = first - 1
    while last + 1 < end and (labels.kinds[last + 1] == SHALLOW_BEHIND or labels.kinds[last + 1] == DEEP_BEHIND):
        last += 1
    return last


@njit(cache=True)
def deviation_across(line: Float64, rays: Rays, beam: int) -> float:
    """Deviation of the end of a beam across a line, m."""
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    return rays.deviations[beam] * facing


POSITION, VARIANCE, SUPPORT = range(3)
"""Columns of a jamb: its position on the line, m, the variance of that, m^2, and its support, m."""

# Columns of a gap: its line, the first jamb, the last one, and the free share.
_LINE, _FIRST, _LAST, _SHARE, _SIZE = 0, 1, 4, 7, 8


@njit(cache=True)
def write_wall_end_jamb(
    line: Float64, covariance: Float64, rays: Rays, labels: BeamLabels, k: int, step: int, max_gap: float, jamb: Float64
) -> None:
    """Write the jamb at the end of the wall on which the beams from ``k`` on end, away from the gap.

    The first of them may end on the side of the jamb, in the thickness of the wall.

    :param labels: of the informative beams.
    """
    end = len(labels.kinds)
    while (
        0 <= k + step < end
        and labels.kinds[k + step] == ON_LINE
        and labels.behind[k] > deviation_across(line, rays, labels.beams[k])
    ):
        k += step
    spacing, beam = labels.along[k - step] - labels.along[k], labels.beams[k]
    jamb[POSITION] = labels.along[k] + 0.5 * spacing
    # The end is between two beams, and an error of the line moves it along the beam.
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    slant = (1.0 - facing * facing) / (facing * facing)
    uncertain = abs(spacing) + 2.0 * STRAY_DEVIATIONS * rays.deviations[beam]
    jamb[VARIANCE] = uncertain * uncertain / 12.0
    jamb[VARIANCE] += slant * variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], labels.along[k])
    last = k
    while 0 <= last + step < end and labels.kinds[last + step] == ON_LINE:
        if abs(labels.along[last + step] - labels.along[last]) > max_gap:
            break
        last += step
    jamb[SUPPORT] = abs(labels.along[last] - labels.along[k])


@njit(cache=True)
def write_crossing_wall_jamb(
    line: Float64, rays: Rays, labels: BeamLabels, k: int, step: int, max_gap: float, jamb: Float64
) -> bool:
    """Write the jamb where another wall crosses the line before beam ``k``; False for none."""
    before = labels.beams[k - step]
    x, y = _beam_end(rays, labels.beams[k])
    from_x, from_y = _beam_end(rays, before)
    if not rays.hit[before] or math.hypot(x - from_x, y - from_y) > max_gap:
        return False
    cos, sin = math.cos(line[0]), math.sin(line[0])
    share = labels.behind[k - step] / (labels.behind[k - step] - labels.behind[k])
    crossing_x, crossing_y = from_x + share * (x - from_x), from_y + share * (y - from_y)
    jamb[POSITION] = cos * crossing_y - sin * crossing_x
    beam = labels.beams[k]
    slanted = cos * rays.directions[beam, 1] - sin * rays.directions[beam, 0]
    jamb[VARIANCE] = (rays.deviations[beam] * slanted) ** 2
    jamb[SUPPORT] = 0.0
    return True


@njit(cache=True)
def _beam_end(rays: Rays, beam: int) -> tuple[float, float]:
    """End point of a beam, m."""
    away = rays.free_range[beam]
    x = rays.origins[beam, 0] + away * rays.directions[beam, 0]
    return x, rays.origins[beam, 1] + away * rays.directions[beam, 1]


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
"""No openings, before the first scan."""


def extract_openings(lines: Lines, rays: Rays, features: FeatureParameters) -> Openings:
    """The openings in the walls that lines show."""
    return extract_openings_with_evidence(lines, rays, features)[0]


def extract_openings_with_evidence(lines: Lines, rays: Rays, features: FeatureParameters) -> tuple[Openings, Float64]:
    """The openings, and the evidence of their confidences.

    :returns: the second of shape (n, 3), logarithms of the visible length of the wall, m, of the supports of both
        jambs, m, added, and of the free share of the width.
    """
    parameters = np.ascontiguousarray(lines.parameters)
    gaps = _select_openings(parameters, lines.covariances, rays, features.opening_depth, features.max_gap)
    widths = gaps[:, _LAST] - gaps[:, _FIRST]
    gaps = gaps[(widths >= features.opening_min) & (widths <= features.opening_max)]
    own = gaps[:, _LINE].astype(np.int64)
    alpha, r = lines.parameters[own].T
    middles = 0.5 * (gaps[:, _FIRST] + gaps[:, _LAST])
    variances = gaps[:, _FIRST + VARIANCE] + gaps[:, _LAST + VARIANCE]
    cos, sin = np.cos(alpha), np.sin(alpha)
    poses = np.stack((r * cos - middles * sin, r * sin + middles * cos, alpha), axis=1)
    # In the frame of the opening: r moves it ahead, and alpha rotates it about the origin.
    by_line = np.zeros((len(gaps), 3, 2))
    by_line[:, 0, 0], by_line[:, 0, 1], by_line[:, 1, 0], by_line[:, 2, 0] = -middles, 1.0, r, 1.0
    covariances = by_line @ lines.covariances[own] @ by_line.transpose(0, 2, 1)
    covariances[:, 1, 1] += 0.25 * variances
    evidence = _evidence(gaps, lines)
    weights = np.array([features.opening_wall, features.opening_jambs, features.opening_share])
    confidences = 1.0 / (1.0 + np.exp(-features.opening_bias - evidence @ weights))
    widths = gaps[:, _LAST] - gaps[:, _FIRST]
    openings = Openings(poses, covariances, widths, np.sqrt(variances), confidences)
    kept = _distinct_openings(openings)
    return Openings(*(field[kept] for field in openings)), evidence[kept]


def _evidence(gaps: Float64, lines: Lines) -> Float64:
    """Evidence for gaps (n, 8), shape (n, 3), as of `extract_openings_with_evidence`."""
    lengths = np.zeros(len(lines))
    np.add.at(lengths, lines.owners, lines.segments[:, 1] - lines.segments[:, 0])
    walls = np.log(lengths[gaps[:, _LINE].astype(np.int64)])
    jambs = np.log(np.maximum(gaps[:, [_FIRST + SUPPORT, _LAST + SUPPORT]], _MIN_SUPPORT)).sum(axis=1)
    shares = np.log(np.maximum(gaps[:, _SHARE], _MIN_SHARE))
    return np.stack((walls, jambs, shares), axis=1)


def _distinct_openings(openings: Openings) -> list[int]:
    """Numbers of distinct openings: of duplicates the most confident, to a tenth, and of these the most accurate."""
    kept: list[int] = []
    for k in np.lexsort((openings.covariances[:, 0, 0], -np.round(openings.confidences, 1))).tolist():
        near = np.hypot(*(openings.poses[kept, :2] - openings.poses[k, :2]).T) < _SAME_DISTANCE
        turn = np.abs(se2.wrap(openings.poses[kept, 2] - openings.poses[k, 2]))
        if not np.any(near & (turn < _SAME_HEADING)):
            kept.append(k)
    return kept


@njit(cache=True)
def _select_openings(lines: Float64, covariances: Float64, rays: Rays, depth: float, max_gap: float) -> Float64:
    """All gaps in lines between two jambs with deep beams, (n, 8)."""
    beams, count = len(rays.free_range), 0
    gaps, buffer = np.empty((len(lines) * (beams // _MIN_DEEP_BEAMS) + 1, _SIZE)), empty_beam_labels(beams)
    for own in range(len(lines)):
        last, end = -1, label_beams(lines[own], covariances[own], rays, depth, buffer)
        labels = BeamLabels(buffer.kinds[:end], buffer.along[:end], buffer.behind[:end], buffer.beams[:end])
        while last + 1 < end:
            first = last + 1
            last = last_beam_behind(labels, first, end)
            if last < first:
                last = first
            elif _write_gap(lines[own], covariances[own], rays, labels, first, last, max_gap, gaps[count]):
                gaps[count, _LINE] = own
                count += 1
    return gaps[:count]


@njit(cache=True)
def _write_gap(
    line: Float64,
    covariance: Float64,
    rays: Rays,
    labels: BeamLabels,
    first: int,
    last: int,
    max_gap: float,
    gap: Float64,
) -> bool:
    """Write the gap of the beams from the first to the last; False where it is no opening."""
    before, after = first - 1, last + 1
    if before < 0 or after >= len(labels.kinds) or (labels.kinds[before] != ON_LINE and labels.kinds[after] != ON_LINE):
        return False
    for beam, step, jamb in ((before, -1, gap[_FIRST:_LAST]), (after, 1, gap[_LAST:_SHARE])):
        if labels.kinds[beam] == ON_LINE:
            write_wall_end_jamb(line, covariance, rays, labels, beam, step, max_gap, jamb)
        elif not write_crossing_wall_jamb(line, rays, labels, beam, step, max_gap, jamb):
            return False
    deep, clear = 0, 0.0
    for k in range(first, last + 1):
        if labels.kinds[k] == DEEP_BEHIND:
            deep, clear = deep + 1, clear + 0.5 * abs(labels.along[k + 1] - labels.along[k - 1])
    if gap[_FIRST] > gap[_LAST]:
        for column in range(_SHARE - _LAST):
            one, other = _FIRST + column, _LAST + column
            gap[one], gap[other] = gap[other], gap[one]
    gap[_SHARE] = clear / max(gap[_LAST] - gap[_FIRST], clear)
    return deep >= _MIN_DEEP_BEAMS


def jamb_positions(poses: Float64, widths: Float64) -> Float64:
    """Both jambs of openings, shape (n, 4), x and y of the left one and of the right one, m.

    :param poses: shape (n, 3), their middles with the heading through them, m and rad.
    :param widths: shape (n,), m.
    """
    across = np.stack((np.zeros_like(widths), 0.5 * widths, np.zeros_like(widths)), axis=1)
    return np.concatenate([se2.compose(poses, sign * across)[:, :2] for sign in (1.0, -1.0)], axis=1)


def distance_to_doors(origins: Float64, directions: Float64, doors: Float64) -> Float64:
    """Distance along beams to the first door, m, shape (n,); inf for none.

    :param origins: shape (n, 2), m.
    :param directions: shape (n, 2), unit vectors.
    :param doors: shape (k, 4), x and y of both jambs of each, m.
    """
    along = doors[None, :, 2:] - doors[None, :, :2]
    offsets = doors[None, :, :2] - origins[:, None]
    determinant = _cross_product(directions[:, None], along)
    determinant = np.where(determinant == 0.0, np.nan, determinant)
    distances = _cross_product(offsets, along) / determinant
    shares = _cross_product(offsets, directions[:, None]) / determinant
    passed = np.where((distances > 0.0) & (shares >= 0.0) & (shares <= 1.0), distances, np.inf)
    return np.asarray(passed.min(axis=1, initial=np.inf))


def _cross_product(a: Float64, b: Float64) -> Float64:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
