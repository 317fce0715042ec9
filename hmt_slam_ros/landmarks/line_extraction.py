"""Line extraction from scans, real or virtual.

A beam costs the square of its residual in range, in deviations; a line costs a penalty, and a beam on no line another.
The cheapest partition follows by dynamic programming over the beams (optimal partitioning, Jackson et al. 2005), with
pruning of starts that cannot become better (PELT, Killick et al. 2012). So all beams on both sides decide where a wall
ends, not a threshold on one of them. No line of the partition crosses a gap without returns; lines on both sides of a
gap may be merged later.

A grid has other errors than a laser: across its surfaces, and common to neighboring beams that end in the same cells.
So each end of a line of a virtual scan has an independent deviation of ``features.map_deviation`` in addition.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.grids.virtual_scan import VirtualScan
from hmt_slam_ros.landmarks.line_fit import Beams, MergeGate, fit_line, merge_lines, relabel
from hmt_slam_ros.landmarks.rays import range_deviations_of_map
from hmt_slam_ros.sensors import Scan

_NONE = -1
"""Label of a beam on no line."""

_AMBIGUOUS = 3.0
"""A beam at the common end of two lines that is within so many deviations of the other one belongs to neither."""

_STRAY = 3.5
"""A beam more than so many deviations from its line does not belong to it."""

_MAX_BEND = 1.0
"""Largest second-order change of r over the uncertainty of alpha, in deviations of r."""

_CORRELATED_BEAMS = 2.0
"""Neighboring beams of a virtual scan with a common error: the factor on its penalties."""


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
        if start == _NONE:
            labels[end - 1] = _NONE
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
    """First beam of the line that ends with each beam in the cheapest partition up to it; -1 for no line."""
    count = len(rays)
    costs, starts = np.zeros(count + 1), np.empty(count, np.int32)
    for last in range(count):
        best, start = costs[last] + stray_penalty, _NONE
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
            # No line with an earlier start can cost less than this one without its penalty.
            if cost >= best:
                break
            if cost + line_penalty < best:
                best, start = cost + line_penalty, first
        costs[last + 1], starts[last] = best, start
    return starts


@dataclass(frozen=True, eq=False)
class Lines:
    """Infinite lines n(alpha) p = r with their visible segments, in the robot's frame at the scan's stamp.

    :ivar parameters: shape (n, 2), alpha in [-pi, pi) and r >= 0: direction and length of the perpendicular from the
        origin, rad and m.
    :ivar covariances: shape (n, 2, 2), of alpha and r.
    :ivar segments: shape (m, 2), begin and end of each visible segment, m along its line's direction
        (-sin(alpha), cos(alpha)) from the foot of the perpendicular.
    :ivar owners: shape (m,), the line of each segment, increasing.
    :ivar labels: shape (k,), the line of each beam with a return, -1 for none.
    """

    parameters: Float64
    covariances: Float64
    segments: Float64
    owners: Int64
    labels: Int32

    def __len__(self) -> int:
        return len(self.parameters)


def extract_lines(scan: Scan, features: FeatureParameters, deviations: Float64 | None = None) -> Lines:
    """The lines of a scan with any field of view; none for a scan without returns.

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
    """The lines of a scan for a stochastic map, which merges lines itself when it knows more."""
    return extract_lines(scan, replace(features, merge_deviation=features.map_merge_deviation))


def _is_nearly_linear(lines: Float64) -> Bool:
    """Whether lines (n, 5) are so certain that a Gaussian over alpha and r is valid, shape (n,).

    r depends on alpha as n(alpha) c for the middle c of the visible part, with the second derivative -r. Where this
    term exceeds the uncertainty of r at an exact alpha, no covariance is valid.
    """
    aa, ar, rr = lines[:, 2], lines[:, 3], lines[:, 4]
    return lines[:, 1] * aa <= _MAX_BEND * np.sqrt(rr - ar * ar / aa)


def _select_lines(found: Float64, pieces: Float64, owners: Int64, labels: Int32, chosen: Bool) -> Lines:
    """The chosen lines, renumbered."""
    numbers = np.where(chosen, np.cumsum(chosen) - 1, _NONE)
    labels = np.append(numbers, _NONE)[labels].astype(np.int32)
    own, found = chosen[owners], found[chosen]
    covariances = found[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    return Lines(found[:, :2], covariances, pieces[own], numbers[owners[own]], labels)


@njit(cache=True)
def _gap_starts(points: Float64, numbers: Int64, max_gap: float) -> Int32:
    """The first beam (n,) behind the last gap before each: two beams or more without a return, and wide enough."""
    begins, begin = np.empty(len(points), np.int32), 0
    for k in range(len(points)):
        if k:
            away = math.hypot(points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1])
            begin = k if away > max_gap and _is_gap(numbers[k - 1], numbers[k]) else begin
        begins[k] = begin
    return begins


@njit(cache=True)
def _is_gap(before: int, after: int) -> bool:
    """Whether two or more beams are between two beam numbers; a single one may be lost."""
    return after - before > 2


@njit(cache=True)
def _extract(beams: Beams, labels: Int32, count: int, min_beams: int, gate: MergeGate) -> Float64:
    """Fit the segments of a partition, merge those of one line, and drop ambiguous beams.

    :param labels: shape (k,), the segment of each beam, -1 for none; written to: the line.
    :param count: number of segments.
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
    """Fit a line to each label, drop those with too few beams, and return the number of the rest."""
    kept = 0
    for line in range(count):
        enough = fit_line(beams, labels, line, lines[kept]) >= min_beams
        relabel(labels, line, kept if enough else _NONE)
        kept += enough
    return kept


@njit(cache=True)
def _drop_ambiguous_beams(beams: Beams, labels: Int32, lines: Float64) -> None:
    """Remove the beams at the common end of two lines that may belong to either.

    The partition gives such a beam to the line that fits better, so that both would be fitted to errors of one sign.
    """
    given = labels.copy()
    for k in range(1, len(labels)):
        before, after = given[k - 1], given[k]
        if before != after and min(before, after) != _NONE:
            _unlabel_near(beams, labels, lines[after], k - 1, -1, before)
            _unlabel_near(beams, labels, lines[before], k, 1, after)


@njit(cache=True)
def _drop_run_ends(labels: Int32) -> None:
    """Remove the first and the last beam of each run, which may have met an edge or a surface behind it."""
    before = labels[0] if len(labels) else _NONE
    for k in range(1, len(labels)):
        own = labels[k]
        if own != before:
            labels[k - 1] = labels[k] = _NONE
        before = own


@njit(cache=True)
def _unlabel_near(beams: Beams, labels: Int32, neighbor: Float64, k: int, step: int, own: int) -> None:
    """Remove the beams from ``k`` on that are near the neighboring line."""
    while 0 <= k < len(labels) and labels[k] == own and _is_on_line(beams, k, neighbor, _AMBIGUOUS):
        labels[k] = _NONE
        k += step


@njit(cache=True)
def _drop_stray_beams(beams: Beams, labels: Int32, lines: Float64) -> None:
    """Remove beams that are too far from their line."""
    for k in range(len(labels)):
        if labels[k] != _NONE and not _is_on_line(beams, k, lines[labels[k]], _STRAY):
            labels[k] = _NONE


@njit(cache=True)
def _extend_lines(beams: Beams, labels: Int32, lines: Float64, step: int) -> None:
    """Add the beams beside a line that are on it, without a new fit."""
    last = _NONE
    for n in range(len(labels)):
        k = n if step > 0 else len(labels) - 1 - n
        if labels[k] == _NONE and last != _NONE and _is_on_line(beams, k, lines[last], _STRAY):
            labels[k] = last
        last = labels[k]


@njit(cache=True)
def _is_on_line(beams: Beams, k: int, line: Float64, deviations: float) -> bool:
    """Whether a beam ends within some deviations of its range from a line (5,)."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    off = cos * beams.points[k, 0] + sin * beams.points[k, 1] - line[1]
    facing = abs(cos * beams.directions[k, 0] + sin * beams.directions[k, 1])
    return abs(off) <= deviations * beams.deviations[k] * facing


@njit(cache=True)
def _visible_segments(
    points: Float64, numbers: Int64, labels: Int32, lines: Float64, max_gap: float
) -> tuple[Float64, Int64]:
    """The visible segments of lines, (m, 2), m along them, and the line of each, (m,).

    A segment ends where the next beam of the line is farther than a gap, with two beams or more in between.
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
    variance = features.map_deviation**2
    middles, turn, shift = 0.5 * (begins + ends), 2.0 * variance / (ends - begins) ** 2, 0.5 * variance
    entries = (turn, middles * turn, middles * turn, middles * middles * turn + shift)
    of_grid = np.stack(entries, axis=1).reshape(-1, 2, 2)
    return replace(lines, covariances=lines.covariances + of_grid)
