"""Where in a candidate's map some keyframes of a query may be: what a search passes by, square by square of shifts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float32, Float64, Int8, Int32
from hmt_slam_ros.topology.area_bounds import Surface, pyramid, sample_cells
from hmt_slam_ros.topology.area_window import Window


class Ground(NamedTuple):
    """Where a keyframe of the query is, one of them at least.

    :ivar cells: above 0 where it may be, candidate frame.
    :ivar keyframes: shape (m, 2), positions of the keyframes, m, query frame; none where they may be anywhere.
    """

    cells: Surface
    keyframes: Float64


class Passable(NamedTuple):
    """A ground, as a search asks for it.

    :ivar levels: running maxima of its cells, as of :class:`area_bounds.Pyramid`, and their ``margin``.
    :ivar keyframes: shape (turns, m, 2), column and row of every keyframe without a shift.
    """

    levels: Int8
    margin: int
    keyframes: Int32


def ground_around(known: Float64, keyframes: Float64, radius: float, cell: float) -> Ground:
    """The ground around the positions ``known``, shape (n, 2), m.

    :param keyframes: shape (m, 2), m, query frame.
    :param radius: how far around, m.
    :param cell: edge of a cell, m.
    """
    # A keyframe anywhere in a cell may be in reach.
    reach = radius + cell
    origin = np.floor((known.min(axis=0) - reach) / cell) * cell
    columns, rows = np.ceil((known.max(axis=0) + reach - origin) / cell).astype(np.int64) + 1
    cells = np.zeros((rows, columns), np.float32)
    _mark(cells, (known - origin) / cell - 0.5, reach / cell)
    return Ground(Surface(cells, origin, cell), keyframes)


def anywhere(cell: float) -> Ground:
    """No limits."""
    return Ground(Surface(np.zeros((1, 1), np.float32), np.zeros(2), cell), np.zeros((0, 2)))


def passable(ground: Ground, window: Window, height: int) -> Passable:
    """A ground for a search of a window down from squares of edge ``2**height``."""
    levels = pyramid(ground.cells.log_ratio, height)
    return Passable(levels.levels, levels.margin, sample_cells(window, ground.cells, ground.keyframes))


@njit(cache=True)
def _mark(cells: Float32, known: Float64, reach: float) -> None:
    """Mark what is within ``reach`` cells of one of the positions ``known``, shape (n, 2), cells."""
    rows, columns = cells.shape
    for n in range(known.shape[0]):
        x, y = known[n, 0], known[n, 1]
        for r in range(max(0, int(np.ceil(y - reach))), min(rows, int(np.floor(y + reach)) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (r - y) ** 2))
            cells[r, max(0, int(np.ceil(x - half))) : min(columns, int(np.floor(x + half)) + 1)] = np.float32(1.0)


@njit(cache=True)
def may_be(ground: Passable, height: int, k: int, i: int, j: int) -> bool:
    """Whether a keyframe is on the ground at turn ``k`` somewhere in the square of shifts that begins at (i, j)."""
    level, margin, cells = ground.levels[height], ground.margin, ground.keyframes[k]
    rows, columns = np.uint32(level.shape[0]), np.uint32(level.shape[1])
    for n in range(cells.shape[0]):
        x, y = np.uint32(cells[n, 0] + i + margin), np.uint32(cells[n, 1] + j + margin)
        if x < columns and y < rows and level[y, x] > 0:
            return True
    return cells.shape[0] == 0
