"""The lines that a scan shows.

A beam costs the square of its residual in range, in deviations; a line costs a penalty, and a beam on no line another.
The cheapest partition follows by dynamic programming over the beams (optimal partitioning, Jackson et al. 2005), in
which starts that cannot become better any more are left out (PELT, Killick et al. 2012). So where a wall ends is
decided by all beams on both sides of its end, not by one threshold on one of them. Across a gap in which no beam
returned nothing is sorted into one line: that it goes on there, only its two pieces can tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.grids.virtual_scan import VirtualScan
from hmt_slam_ros.landmarks.line_fit import Beams, MergeGate, fit_line, merge_lines, relabel
from hmt_slam_ros.landmarks.rays import range_deviations_of_map
from hmt_slam_ros.sensors import Scan

_NO_LINE = -1


@njit(cache=True)
def partition_beams(
    rays: Float64, begins: Int32, deviations: Float64, line_penalty: float, stray_penalty: float, labels: Int32
) -> int:
    """Number the lines of a scan.

    :param rays: shape (n, 2), m, from the laser to the end points, in the order of the beams; none of length 0.
    :param begins: shape (n,), the first beam behind the last gap before each.
    :param deviations: shape (n,), of the ranges, m.
    :param line_penalty: what a line costs, in squared deviations.
    :param stray_penalty: what a beam on no line costs, likewise.
    :param labels: shape (n,), written to: the number of each beam's line, from 0, or -1.
    :returns: number of lines.
    """
    starts = _optimal_starts(rays, begins, deviations, line_penalty, stray_penalty)
    end, count = len(rays), 0
    while end > 0:
        start = starts[end - 1]
        if start == _NO_LINE:
            labels[end - 1] = _NO_LINE
            end -= 1
        else:
            labels[start:end] = count
            count += 1
            end = start
    return count


@njit(cache=True)
def _optimal_starts(
    rays: Float64, begins: Int32, deviations: Float64, line_penalty: float, stray_penalty: float
) -> Int32:
    """Where the line begins that ends with each beam in the cheapest partition up to it; -1 where it is on none."""
    count = len(rays)
    costs, starts = np.zeros(count + 1), np.empty(count, np.int32)
    for last in range(count):
        best, start = costs[last] + stray_penalty, _NO_LINE
        # Sums over the beams from `first` to `last` of r^4 d d', r^3 d and r^2 by the variance of r, d being the
        # direction: on a line the inverse of the range is linear in d, and its deviation is that of the range by r^2.
        xx = xy = yy = x = y = square = 0.0
        for first in range(last, begins[last] - 1, -1):
            px, py = rays[first, 0], rays[first, 1]
            squared = (px * px + py * py) / (deviations[first] * deviations[first])
            xx, xy, yy = xx + squared * px * px, xy + squared * px * py, yy + squared * py * py
            x, y, square = x + squared * px, y + squared * py, square + squared
            determinant = xx * yy - xy * xy
            misfit = 0.0
            if last - first > 1 and determinant > 0.0:
                misfit = square - (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
            cost = costs[first] + max(0.0, misfit)
            # No line that begins before this one can cost less than it does without its penalty.
            if cost >= best:
                break
            if cost + line_penalty < best:
                best, start = cost + line_penalty, first
        costs[last + 1], starts[last] = best, start
    return starts


# A beam this near to its neighbour's line, in deviations, may belong to either of the two.
_AMBIGUOUS = 3.0
# A beam this far from its line, in deviations, does not belong to it.
_STRAY = 3.5
# What a line bends over its uncertainty, in deviations across it.
_MAX_BEND = 1.0
_NONE = -1


@dataclass(frozen=True, eq=False)
class Lines:
    """Infinite lines n(alpha) p = r with what was seen of them, in the robot's frame at the scan's stamp.

    :ivar parameters: shape (n, 2), alpha in [-pi, pi) and r >= 0: direction and length of the perpendicular from the
        origin, rad and m.
    :ivar covariances: shape (n, 2, 2), of alpha and r.
    :ivar segments: shape (m, 2), where each stretch that was seen begins and ends, m along its line's direction
        (-sin(alpha), cos(alpha)) from the foot of the perpendicular.
    :ivar owners: shape (m,), the line of each of them, increasing.
    :ivar labels: shape (k,), the line of each beam with a return, -1 where it shows none.
    """

    parameters: Float64
    covariances: Float64
    segments: Float64
    owners: Int64
    labels: Int32

    def __len__(self) -> int:
        return len(self.parameters)


def extract_lines(scan: Scan, features: FeatureParameters, deviations: Float64 | None = None) -> Lines:
    """The lines of a scan of any field of view and number of beams; none where it has no return.

    :param deviations: shape (k,), of the ranges of the beams with a return, m; ``features.range_deviation`` for all
        where None.
    """
    points, rays = scan.points, scan.beams
    numbers, labels = np.flatnonzero(scan.valid), np.empty(len(points), np.int32)
    if deviations is None:
        deviations = np.full(len(points), features.range_deviation)
    beams = Beams(points, rays / np.maximum(np.hypot(*rays.T), 1e-9)[:, None], deviations)
    count = partition_beams(
        points - scan.laser_pose[:2],
        _gap_starts(points, numbers, features.max_gap),
        deviations,
        features.line_penalty,
        features.stray_penalty,
        labels,
    )
    gate = MergeGate(chi_square_gate(features.merge_probability, 2), features.merge_deviation)
    found = _extract(beams, labels, count, features.min_beams, gate)
    pieces, owners = _visible_segments(points, numbers, labels, found, features.max_gap)
    seen = np.zeros(len(found))
    np.add.at(seen, owners, pieces[:, 1] - pieces[:, 0])
    return _select_lines(found, pieces, owners, labels, (seen >= features.min_length) & _is_nearly_linear(found))


def extract_for_map(scan: Scan, features: FeatureParameters) -> Lines:
    """The lines of a scan that a stochastic map observes: it joins them itself when it knows more."""
    return extract_lines(scan, replace(features, merge_deviation=features.map_merge_deviation))


def _is_nearly_linear(lines: Float64) -> Bool:
    """Which of the lines (n, 5) are so certain that a Gaussian over alpha and r is right.

    r follows from alpha as n(alpha) c for the middle c of what was seen, whose second derivative is -r: where that
    bends by more than r is uncertain at an exact alpha, no covariance says what is known.
    """
    aa, ar, rr = lines[:, 2], lines[:, 3], lines[:, 4]
    return lines[:, 1] * aa <= _MAX_BEND * np.sqrt(rr - ar * ar / aa)


def _select_lines(found: Float64, pieces: Float64, owners: Int64, labels: Int32, kept: Bool) -> Lines:
    """The lines that are kept, numbered anew."""
    numbers = np.where(kept, np.cumsum(kept) - 1, _NONE)
    labels = np.append(numbers, _NONE)[labels].astype(np.int32)
    own, found = kept[owners], found[kept]
    covariances = found[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Lines(found[:, :2], covariances, pieces[own], numbers[owners[own]], labels)


@njit(cache=True)
def _gap_starts(points: Float64, numbers: Int64, max_gap: float) -> Int32:
    """The first beam (n,) behind the last gap before each: of two beams or more without a return, and as wide."""
    begins, begin = np.empty(len(points), np.int32), 0
    for k in range(len(points)):
        if k:
            away = math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            begin = k if away > max_gap and _is_gap(numbers[k - 1], numbers[k]) else begin
        begins[k] = begin
    return begins


@njit(cache=True)
def _is_gap(before: int, after: int) -> bool:
    """Whether between two beams of these numbers there are two or more, and not just one that was lost."""
    return after - before > 2


@njit(cache=True)
def _extract(beams: Beams, labels: Int32, count: int, min_beams: int, gate: MergeGate) -> Float64:
    """Fit the segments that beams were sorted into, join those that are one line, and leave out what is doubtful.

    :param labels: shape (k,), the segment of each beam, -1 for none; written to: the line.
    :param count: of the segments.
    :param gate: of segments that are one line.
    :returns: the lines (n, 5), as of `fit_line`, numbered as the labels.
    """
    lines = np.empty((count, 5))
    count = _fit_all(beams, labels, lines, count, min_beams)
    count = merge_lines(beams, labels, lines, count, gate)
    _drop_ambiguous_beams(beams, labels, lines)
    _drop_run_ends(labels)
    count = _fit_all(beams, labels, lines, count, min_beams)
    count = merge_lines(beams, labels, lines, count, gate)
    _drop_stray_beams(beams, labels, lines)
    lines = lines[: _fit_all(beams, labels, lines, count, min_beams)]
    for step in (1, -1):
        _extend_lines(beams, labels, lines, step)
    return lines


@njit(cache=True)
def _fit_all(beams: Beams, labels: Int32, lines: Float64, count: int, min_beams: int) -> int:
    """Fit every label, give up those of too few beams, and return how many there are."""
    kept = 0
    for line in range(count):
        enough = fit_line(beams, labels, line, lines[kept]) >= min_beams
        relabel(labels, line, kept if enough else _NONE)
        kept += enough
    return kept


@njit(cache=True)
def _drop_ambiguous_beams(beams: Beams, labels: Int32, lines: Float64) -> None:
    """Take from both lines the beams at their common end that may belong to either.

    Where two walls meet, the partition gives a beam to that line which it fits better, so that both lines would be
    fitted to errors of one sign at their ends.
    """
    given = labels.copy()
    for k in range(1, len(labels)):
        before, after = given[k - 1], given[k]
        if before != after and min(before, after) != _NONE:
            _unlabel_near(beams, labels, lines[after], k - 1, -1, before)
            _unlabel_near(beams, labels, lines[before], k, 1, after)


@njit(cache=True)
def _drop_run_ends(labels: Int32) -> None:
    """Take the label from the first and the last beam of every run, which may have met an edge or what is behind it."""
    before = labels[0] if len(labels) else _NONE
    for k in range(1, len(labels)):
        own = labels[k]
        if own != before:
            labels[k - 1] = labels[k] = _NONE
        before = own


@njit(cache=True)
def _unlabel_near(beams: Beams, labels: Int32, neighbour: Float64, k: int, step: int, own: int) -> None:
    """Take the label from the beams from ``k`` on that are near to the neighbour's line."""
    while 0 <= k < len(labels) and labels[k] == own and _is_on_line(beams, k, neighbour, _AMBIGUOUS):
        labels[k] = _NONE
        k += step


@njit(cache=True)
def _drop_stray_beams(beams: Beams, labels: Int32, lines: Float64) -> None:
    """Take the label from beams that are too far from their line."""
    for k in range(len(labels)):
        if labels[k] != _NONE and not _is_on_line(beams, k, lines[labels[k]], _STRAY):
            labels[k] = _NONE


@njit(cache=True)
def _extend_lines(beams: Beams, labels: Int32, lines: Float64, step: int) -> None:
    """Label the beams on no line beside those on one as far as they are on it too; it stays as it was fitted."""
    last = _NONE
    for n in range(len(labels)):
        k = n if step > 0 else len(labels) - 1 - n
        if labels[k] == _NONE and last != _NONE and _is_on_line(beams, k, lines[last], _STRAY):
            labels[k] = last
        last = labels[k]


@njit(cache=True)
def _is_on_line(beams: Beams, k: int, line: Float64, deviations: float) -> bool:
    """Whether a beam ends so few deviations of its range from a line (5,)."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    off = cos * beams.points[k, 0] + sin * beams.points[k, 1] - line[1]
    facing = abs(cos * beams.directions[k, 0] + sin * beams.directions[k, 1])
    return abs(off) <= deviations * beams.deviations[k] * facing


@njit(cache=True)
def _visible_segments(
    points: Float64, numbers: Int64, labels: Int32, lines: Float64, max_gap: float
) -> tuple[Float64, Int64]:
    """What was seen of each line, (m, 2), m along it, and whose each is.

    A stretch ends where the next beam of the line is farther away than a gap, with two beams or more in between.
    """
    pieces, owners, count = np.empty((len(points), 2)), np.empty(len(points), np.int64), 0
    for line in range(len(lines)):
        cos, sin = math.cos(lines[line, 0]), math.sin(lines[line, 0])
        before, last = -1, 0.0
        for k in range(len(points)):
            if labels[k] != line:
                continue
            along = cos * points[k, 1] - sin * points[k, 0]
            if before < 0 or (abs(along - last) > max_gap and _is_gap(numbers[before], numbers[k])):
                pieces[count, 0] = pieces[count, 1] = along
                owners[count] = line
                count += 1
            pieces[count - 1, 0] = min(pieces[count - 1, 0], along)
            pieces[count - 1, 1] = max(pieces[count - 1, 1], along)
            before, last = k, along
    return pieces[:count], owners[:count]


# Beams that err alike; what one more line explains has to be so many times as much.
_CORRELATED_BEAMS = 2.0


def extract_map_lines(virtual: VirtualScan, features: FeatureParameters) -> Lines:
    """The lines of a virtual scan."""
    costs = replace(
        features,
        line_penalty=_CORRELATED_BEAMS * features.line_penalty,
        stray_penalty=_CORRELATED_BEAMS * features.stray_penalty,
    )
    lines = extract_lines(virtual.scan, costs, range_deviations_of_map(virtual, features)[virtual.scan.valid])
    begins, ends = np.full(len(lines), np.inf), np.full(len(lines), -np.inf)
    np.minimum.at(begins, lines.owners, lines.segments[:, 0])
    np.maximum.at(ends, lines.owners, lines.segments[:, 1])
    of_ends = features.map_deviation**2
    middles, turn, off = 0.5 * (begins + ends), 2.0 * of_ends / (ends - begins) ** 2, 0.5 * of_ends
    own = np.stack((turn, middles * turn, middles * turn, middles * middles * turn + off), axis=1).reshape(-1, 2, 2)
    return replace(lines, covariances=lines.covariances + own)
