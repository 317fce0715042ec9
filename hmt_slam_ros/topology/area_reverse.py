"""The reverse check of a search: what a candidate's points contradict in the query's grid, by blocks of shifts."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float32, Float64
from hmt_slam_ros.topology.area_bounds import BLOCK, Surface
from hmt_slam_ros.topology.area_window import Window


class Reverse(NamedTuple):
    """What is checked.

    :ivar grid: the query's.
    :ivar points: shape (m, 2), the candidate's surface points, m, candidate frame.
    :ivar turned: shape (turns, m, 2), the same as the query sees them without a shift, cells of the grid.
    :ivar negative: of the grid's cells and ``reach`` beyond, whether one within ``reach`` has a log-ratio below 0.
    :ivar reach: cells by which the shifts of a block move a point from where it lies at its middle, at most, and one.
    """

    grid: Surface
    points: Float64
    turned: Float32
    negative: Bool
    reach: int


def reverse_check(window: Window, grid: Surface, points: Float64) -> Reverse:
    """The reverse check of a window; the arguments are those of :func:`area_search.search`."""
    reach = math.ceil(math.sqrt(0.5) * (BLOCK - 1) * window.cell / grid.cell) + 1
    return Reverse(grid, points, _turned(window, grid, points), _negative(grid.log_ratio, reach), reach)


@njit(cache=True)
def _turned(window: Window, grid: Surface, points: Float64) -> Float32:
    turned = np.empty((window.turns.size, points.shape[0], 2), np.float32)
    for k in range(window.turns.size):
        angle = window.mean[2] + window.turns[k]
        cos, sin = np.cos(angle) / grid.cell, np.sin(angle) / grid.cell
        for n in range(points.shape[0]):
            dx, dy = points[n, 0] - window.mean[0], points[n, 1] - window.mean[1]
            turned[k, n, 0] = cos * dx + sin * dy - grid.origin[0] / grid.cell
            turned[k, n, 1] = cos * dy - sin * dx - grid.origin[1] / grid.cell
    return turned


@njit(cache=True)
def _negative(log_ratio: Float32, reach: int) -> Bool:
    rows, columns = log_ratio.shape
    across = np.zeros((rows, columns + 2 * reach), np.bool_)
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(columns):
                across[r, c + shift] |= log_ratio[r, c] < 0.0
    negative = np.zeros((rows + 2 * reach, columns + 2 * reach), np.bool_)
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(across.shape[1]):
                negative[r + shift, c] |= across[r, c]
    return negative


@njit(cache=True)
def points_of_block(check: Reverse, window: Window, node: tuple[int, int, int], points: Float64) -> int:
    """Put those that may contradict at a shift of the block that begins at ``node`` into ``points``: how many."""
    negative, turned = check.negative, check.turned[node[0]]
    angle, ratio = window.mean[2] + window.turns[node[0]], window.cell / check.grid.cell
    cos, sin = ratio * np.cos(angle), ratio * np.sin(angle)
    x, y = node[1] + 0.5 * (BLOCK - 1), node[2] + 0.5 * (BLOCK - 1)
    across, along = np.float32(check.reach - cos * x - sin * y), np.float32(check.reach - cos * y + sin * x)
    rows, columns = np.uint32(negative.shape[0]), np.uint32(negative.shape[1])
    count = 0
    for n in range(turned.shape[0]):
        c, r = np.uint32(np.int32(turned[n, 0] + across)), np.uint32(np.int32(turned[n, 1] + along))
        if c < columns and r < rows and negative[r, c]:
            points[count] = check.points[n]
            count += 1
    return count


@njit(cache=True)
def contradiction(grid: Surface, window: Window, cell: tuple[int, int, int], points: Float64, least: float) -> float:
    """Sum of the negative log-ratios that points meet in the query's grid at a cell, as far as to ``least``."""
    angle = window.mean[2] + window.turns[cell[0]]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = window.mean[0] + cell[1] * window.cell, window.mean[1] + cell[2] * window.cell
    rows, columns = grid.log_ratio.shape
    total = 0.0
    for n in range(points.shape[0]):
        if total < least:
            break
        dx, dy = points[n, 0] - x, points[n, 1] - y
        c = int(np.floor((cos * dx + sin * dy - grid.origin[0]) / grid.cell))
        r = int(np.floor((cos * dy - sin * dx - grid.origin[1]) / grid.cell))
        if 0 <= c < columns and 0 <= r < rows:
            total += min(np.float32(0.0), grid.log_ratio[r, c])
    return total
