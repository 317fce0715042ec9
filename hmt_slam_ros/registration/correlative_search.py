"""Search for a scan's pose where the prediction is too wide for Gauss-Newton: on a lattice of poses, all of them tried.

Points are (n, 2) in m in the base frame, or surfels (n, 4), poses ``map_T_base``, as in ``scan_to_map.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry.se2_kernels import transform
from hmt_slam_ros.grids.patches import PATCH, GridView, field_at, odds_at
from hmt_slam_ros.registration.scan_to_map import BeamModel, Prior, log_prior


class Lattice(NamedTuple):
    """The poses that a search tries: around a centre, along the axes of the map and in heading.

    :ivar stride: from one pose to the next, cells.
    :ivar turn: from one heading to the next, rad.
    :ivar counts: (3,), int64, steps to each side in x, y and heading.
    """

    stride: int
    turn: float
    counts: Int64


@njit(cache=True)
def correlative_search(
    points: Float64, prior: Prior, lattice: Lattice, view: GridView, model: BeamModel, temper: float, most: int
) -> Float64:
    """The highest peaks of tempered likelihood ratio times prior on a lattice around the prior's mean (Olson 2009).

    :param most: how many peaks at most.
    :returns: (k, 3) poses, the best first; no two are neighbours or neighbours' neighbours on the lattice.
    """
    counts = lattice.counts
    sizes = (2 * counts[0] + 1, 2 * counts[1] + 1, 2 * counts[2] + 1)
    scores, pose = np.empty(sizes), np.empty(3)
    columns, rows = np.empty(points.shape[0], dtype=np.int64), np.empty(points.shape[0], dtype=np.int64)
    for k in range(sizes[2]):
        pose[2] = prior.mean[2] + (k - counts[2]) * lattice.turn
        _find_cells(points, prior.mean[0], prior.mean[1], pose[2], view, columns, rows)
        for i in range(sizes[0]):
            right = (i - counts[0]) * lattice.stride
            pose[0] = prior.mean[0] + right * view.cell
            for j in range(sizes[1]):
                up = (j - counts[1]) * lattice.stride
                pose[1] = prior.mean[1] + up * view.cell
                ratio = _log_ratio_of_cells(columns, rows, right, up, view, model)
                scores[i, j, k] = log_prior(pose, prior) + temper * ratio
    return _extract_peaks(scores, prior.mean, lattice, view.cell, most)


@njit(cache=True)
def _find_cells(points: Float64, x: float, y: float, theta: float, view: GridView, columns: Int64, rows: Int64) -> None:
    """Write the columns and rows, each (n,), of the points at the pose (x, y, theta)."""
    cos, sin = np.cos(theta) / view.cell, np.sin(theta) / view.cell
    half = 0.5 * view.table.shape[0] * PATCH
    u, v = x / view.cell + half, y / view.cell + half
    for n in range(points.shape[0]):
        at_u, at_v = transform(u, v, cos, sin, points[n, 0], points[n, 1])
        columns[n], rows[n] = int(at_u), int(at_v)


@njit(cache=True)
def _log_ratio_of_cells(columns: Int64, rows: Int64, right: int, up: int, view: GridView, model: BeamModel) -> float:
    """Sum of the log-likelihood ratios of end points in these cells, all shifted, nats."""
    total = 0.0
    for n in range(columns.size):
        distance = field_at(view, columns[n] + right, rows[n] + up)
        if odds_at(view, columns[n] + right, rows[n] + up) == 0:
            total += model.in_unknown[distance]
        else:
            total += model.in_known[distance]
    return total


@njit(cache=True)
def _extract_peaks(scores: Float64, centre: Float64, lattice: Lattice, cell: float, most: int) -> Float64:
    """The poses (k, 3) of the highest scores, each at least three steps from those before it; empties ``scores``."""
    found = np.empty((most, 3))
    counts, apart = lattice.counts, lattice.stride * cell
    for n in range(most):
        best = np.argmax(scores)
        i, rest = divmod(best, scores.shape[1] * scores.shape[2])
        j, k = divmod(rest, scores.shape[2])
        if scores[i, j, k] == -np.inf:
            return found[:n]
        found[n, 0] = centre[0] + apart * (i - counts[0])
        found[n, 1] = centre[1] + apart * (j - counts[1])
        found[n, 2] = centre[2] + lattice.turn * (k - counts[2])
        scores[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3, max(0, k - 2) : k + 3] = -np.inf
    return found
