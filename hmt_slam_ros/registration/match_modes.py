"""Modes of a match from the cells of a search: clusters, their mass by quadrature, peak and curvature."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import rotate_back, transform_point
from hmt_slam_ros.registration.branch_and_bound import SearchCells
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.registration.search_window import SearchWindow

_DIVIDED = 400
"""Cells that are divided for the quadrature, the highest ones; all others count by their center."""


def cluster_cells(cells: SearchCells, saddle: float) -> Int64:
    """The cluster of every cell, shape (n,), numbered from 0 by falling height of the peaks.

    Two peaks are two clusters if the lower one is more than ``saddle`` nats above the pass between them.
    """
    order = np.argsort(-cells.score, kind="stable")
    at = cells.indices - cells.indices.min(axis=0) + 1
    sides = at.max(axis=0) + 2
    keys = (at[:, 0] * sides[1] + at[:, 1]) * sides[2] + at[:, 2]
    by_key = np.argsort(keys, kind="stable")
    peaks = _flood_from_peaks(order, by_key, keys[by_key], sides, cells.score, saddle)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    is_peak = np.zeros(order.size, dtype=np.bool_)
    is_peak[rank[peaks]] = True
    labels: Int64 = (np.cumsum(is_peak) - 1)[rank[peaks]]
    return labels


@njit(cache=True)
def _flood_from_peaks(order: Int64, by_key: Int64, keys: Int64, sides: Int64, score: Float64, saddle: float) -> Int64:
    """The peak (a cell) to which every cell belongs, by flooding from the top.

    :param keys: ascending, of the cells ``by_key``.
    """
    above, rank = np.full(order.size, -1), np.empty(order.size, np.int64)
    rank[by_key] = np.arange(order.size)
    rows = _rows_around(keys, sides)
    for cell in order:
        above[cell] = cell
        for row in range(9):
            for place in range(rows[rank[cell], row, 0], rows[rank[cell], row, 1]):
                if above[by_key[place]] >= 0:
                    _merge_peaks(above, cell, by_key[place], score, saddle)
    for cell in order:
        above[cell] = _peak_of(above, cell)
    return above


@njit(cache=True)
def _rows_around(keys: Int64, sides: Int64) -> Int32:
    """The cells around every cell, by key: first and last + 1 in each of nine rows of three, shape (n, 9, 2)."""
    rows = np.empty((keys.size, 9, 2), np.int32)
    for row in range(9):
        middle = ((row // 3 - 1) * sides[1] + row % 3 - 1) * sides[2]
        first, last = 0, 0
        for n in range(keys.size):
            while first < keys.size and keys[first] < keys[n] + middle - 1:
                first += 1
            while last < keys.size and keys[last] <= keys[n] + middle + 1:
                last += 1
            rows[n, row, 0], rows[n, row, 1] = first, last
    return rows


@njit(cache=True)
def _peak_of(above: Int64, cell: int) -> int:
    while above[cell] != cell:
        above[cell] = above[above[cell]]
        cell = above[cell]
    return cell


@njit(cache=True)
def _merge_peaks(above: Int64, cell: int, other: int, score: Float64, saddle: float) -> None:
    """Merge two peaks that meet at ``cell`` into the higher, unless the lower is prominent."""
    a, b = _peak_of(above, cell), _peak_of(above, other)
    if score[a] < score[b] or (score[a] == score[b] and a > b):
        a, b = b, a
    if a != b and score[b] - score[cell] <= saddle:
        above[b] = a


class _GridSamples(NamedTuple):
    """Samples, and their positions in a grid.

    :ivar x: shape (n,), m, as ``y``.
    :ivar column: shape (n,), of the cell whose center is to the left; ``row``, of the cell above.
    :ivar right: shape (n,), distance from that center, cells; ``down``, the same.
    """

    x: Float64
    y: Float64
    column: Int32
    row: Int32
    right: Float64
    down: Float64


@njit(cache=True)
def _grid_samples(samples: Float64) -> _GridSamples:
    n = samples.shape[0]
    x, y = samples[:, 0].copy(), samples[:, 1].copy()
    return _GridSamples(x, y, np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n), np.empty(n))


@njit(cache=True)
def log_ratio_at(surface: LogRatioGrid, samples: Float64, pose: Float64) -> float:
    """Sum over the samples of the bilinearly interpolated log-ratio, nats, untempered.

    :param samples: shape (n, 2), m, query frame.
    :param pose: shape (3,), ``candidate_T_query``.
    """
    return _log_ratio_at(surface, _grid_samples(samples), pose)


@njit(cache=True)
def _log_ratio_at(surface: LogRatioGrid, points: _GridSamples, pose: Float64) -> float:
    """:func:`log_ratio_at` of prepared samples, in two loops: the compiler vectorizes the first."""
    _locate(surface, points, pose)
    total = 0.0
    for n in range(points.x.size):
        total += _interpolate(surface, points, n)
    return total


@njit(cache=True)
def _locate(surface: LogRatioGrid, points: _GridSamples, pose: Float64) -> None:
    """Set the positions of samples in the grid at a pose."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x0, y0 = pose[0] - surface.origin[0], pose[1] - surface.origin[1]
    for n in range(points.x.size):
        x, y = transform_point(x0, y0, cos, sin, points.x[n], points.y[n])
        u, v = x / surface.cell - 0.5, y / surface.cell - 0.5
        left, above = np.floor(u), np.floor(v)
        points.column[n], points.row[n] = np.int32(left), np.int32(above)
        points.right[n], points.down[n] = u - left, v - above


@njit(cache=True)
def _interpolate(surface: LogRatioGrid, points: _GridSamples, n: int) -> float:
    """The log-ratio at sample n, which is located; 0 beyond the grid."""
    rows, columns = np.uint32(surface.log_ratio.shape[0] - 1), np.uint32(surface.log_ratio.shape[1] - 1)
    one, c, r = np.uint32(1), np.uint32(points.column[n]), np.uint32(points.row[n])
    if not (c < columns and r < rows):
        return 0.0
    a, b = points.right[n], points.down[n]
    low = (1.0 - a) * surface.log_ratio[r, c] + a * surface.log_ratio[r, c + one]
    high = (1.0 - a) * surface.log_ratio[r + one, c] + a * surface.log_ratio[r + one, c + one]
    return (1.0 - b) * low + b * high


@njit(cache=True)
def _score_at(surface: LogRatioGrid, points: _GridSamples, window: SearchWindow, temper: float, pose: Float64) -> float:
    """Tempered log-ratio plus the prior's exponent, without the reverse check."""
    dx, dy = pose[0] - window.mean[0], pose[1] - window.mean[1]
    turn = pose[2] - window.mean[2]
    cos, sin = np.cos(window.mean[2]), np.sin(window.mean[2])
    x, y = rotate_back(cos, sin, dx, dy)
    half_cot = 1.0 if abs(turn) < 1e-5 else 0.5 * turn / np.tan(0.5 * turn)
    twist = np.array((half_cot * x + 0.5 * turn * y, half_cot * y - 0.5 * turn * x, turn))
    exponent = 0.0
    for r in range(3):
        exponent += (
            window.information_root[r, 0] * twist[0]
            + window.information_root[r, 1] * twist[1]
            + window.information_root[r, 2] * twist[2]
        ) ** 2
    return temper * _log_ratio_at(surface, points, pose) - 0.5 * exponent


def integrate_cells(
    surface: LogRatioGrid, samples: Float64, window: SearchWindow, cells: SearchCells, temper: float
) -> tuple[Float64, Float64]:
    """Log of the mean of exp(score) over every cell, shape (n,), and the best pose in it, shape (n, 3).

    Cells are divided by the deviations of the prior: more where the prior is narrower than a cell.
    """
    widths = 1.0 / np.linalg.norm(window.information_root, axis=0)  # conditional deviations of the prior
    turn = turn_step(window)
    divisions = np.array([_division_count(window.cell / widths[:2].min()), _division_count(turn / widths[2])])
    means, poses = cells.score.copy(), _cell_centers(window, cells)
    divided = np.argsort(-cells.score, kind="stable")[:_DIVIDED]
    fine = _integrate_divided(surface, samples, window, temper, poses[divided], divisions, turn)
    means[divided], poses[divided] = fine[0] + cells.contradiction[divided], fine[1]
    return means, poses


@njit(cache=True)
def stretch_log_ratios(
    surface: LogRatioGrid, samples: Float64, stretches: Int64, count: int, poses: Float64
) -> Float64:
    """The part of every stretch of surface in the log-ratio at poses (c, 3), nats, untempered, shape (c, count).

    :param stretches: shape (n,), the stretch of every sample.
    """
    points, parts = _grid_samples(samples), np.zeros((poses.shape[0], count))
    for n in range(poses.shape[0]):
        _locate(surface, points, poses[n])
        for k in range(points.x.size):
            parts[n, stretches[k]] += _interpolate(surface, points, k)
    return parts


def turn_step(window: SearchWindow) -> float:
    """The angle between two turns of a window, rad; 0 for a single turn."""
    return float(window.turns[1] - window.turns[0]) if window.turns.size > 1 else 0.0


def _division_count(ratio: float) -> int:
    """3, 5 or 7 divisions, so that a step is 1.5 deviations of the prior at most, where possible."""
    return 3 if ratio <= 4.5 else (5 if ratio <= 7.5 else 7)


def _cell_centers(window: SearchWindow, cells: SearchCells) -> Float64:
    poses = np.empty((cells.score.size, 3))
    poses[:, :2] = window.mean[:2] + cells.indices[:, 1:] * window.cell
    poses[:, 2] = window.mean[2] + window.turns[cells.indices[:, 0]]
    return poses


@njit(cache=True)
def _integrate_divided(
    surface: LogRatioGrid,
    samples: Float64,
    window: SearchWindow,
    temper: float,
    centers: Float64,
    divisions: Int64,
    turn: float,
) -> tuple[Float64, Float64]:
    count, turns = divisions
    means, best = np.empty(centers.shape[0]), centers.copy()
    points, scores = _grid_samples(samples), np.empty(count * count * turns)
    pose = np.empty(3)
    for n in range(centers.shape[0]):
        top = -np.inf
        for s in range(scores.size):
            pose[0] = centers[n, 0] + window.cell * ((s % count + 0.5) / count - 0.5)
            pose[1] = centers[n, 1] + window.cell * ((s // count % count + 0.5) / count - 0.5)
            pose[2] = centers[n, 2] + turn * ((s // (count * count) + 0.5) / turns - 0.5)
            scores[s] = _score_at(surface, points, window, temper, pose)
            if scores[s] > top:
                top = scores[s]
                best[n] = pose
        means[n] = top + np.log(np.mean(np.exp(scores - top)))
    return means, best


@njit(cache=True)
def climb_to_peak(
    surface: LogRatioGrid,
    samples: Float64,
    window: SearchWindow,
    temper: float,
    start: Float64,
    step: Float64,
    finest: float,
) -> Float64:
    """The highest pose near ``start``, by a pattern search over the 26 neighbors with halving steps.

    :param step: shape (3,), first steps in m, m and rad.
    :param finest: smallest share of the first steps.
    """
    points = _grid_samples(samples)
    best, height = start.copy(), _score_at(surface, points, window, temper, start)
    share = 1.0
    while share >= finest:
        center = best.copy()
        moved = False
        for s in range(27):
            pose = center + share * step * np.array((s % 3 - 1.0, s // 3 % 3 - 1.0, s // 9 - 1.0))
            score = _score_at(surface, points, window, temper, pose)
            if score > height:
                best, height, moved = pose, score, True
        if not moved:
            share *= 0.5
    return best


@njit(cache=True)
def curvature(surface: LogRatioGrid, samples: Float64, pose: Float64, step: Float64) -> Float64:
    """Minus the Hessian of the untempered log-ratio in the right tangent space of ``pose``, shape (3, 3).

    :param step: shape (3,), finite differences in m, m and rad.
    """
    points, corner = _grid_samples(samples), np.empty((3, 3))
    hessian = np.empty((3, 3))
    for a in range(3):
        for b in range(a, 3):
            for p in range(-1, 2):
                for q in range(-1, 2):
                    twist = np.zeros(3)
                    twist[a] += p * step[a]
                    twist[b] += q * step[b]
                    corner[p + 1, q + 1] = _log_ratio_at(surface, points, _perturb(pose, twist))
            mixed = corner[2, 2] - corner[2, 0] - corner[0, 2] + corner[0, 0]
            hessian[a, b] = -mixed / (4.0 * step[a] * step[b])
            hessian[b, a] = hessian[a, b]
    return hessian


@njit(cache=True)
def _perturb(pose: Float64, twist: Float64) -> Float64:
    """``pose * exp(twist)`` for a small twist, to second order."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = twist[0] - 0.5 * twist[2] * twist[1], twist[1] + 0.5 * twist[2] * twist[0]
    x, y = transform_point(pose[0], pose[1], cos, sin, x, y)
    return np.array((x, y, pose[2] + twist[2]))
