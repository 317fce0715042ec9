"""Constraints of a search over relative poses on the positions of the query's keyframes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int8, Int32
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.registration.search_bounds import (
    MIN_HEIGHT,
    PAD,
    TOO_WIDE,
    TOP_STEPS,
    LogRatioGrid,
    Pyramid,
    SearchMemory,
    TurnGroups,
    build_pyramid,
    group_turns,
    sample_cells,
)
from hmt_slam_ros.registration.search_window import SearchWindow

_OWN, _AROUND = 1.0, 0.5
"""Values of cells near a position that is searched, and near one around those."""

AROUND_STEPS = round(_AROUND / _OWN * TOP_STEPS)
"""The latter in a pyramid, steps."""


class PositionConstraint(NamedTuple):
    """Cells in which half of the query's keyframes have to be, one of them in a cell near a searched position.

    :ivar allowed: candidate frame, 1 near a searched position, 0.5 near one around those, 0 elsewhere.
    :ivar keyframes: shape (m, 2), positions of the keyframes, m, query frame; none without a constraint.
    """

    allowed: LogRatioGrid
    keyframes: Float64


class ConstraintPyramid(NamedTuple):
    """A position constraint, prepared for a search.

    :ivar pyramid: running maxima of its cells.
    :ivar keyframes: shape (turns, m, 2), column and row of every keyframe without a shift.
    :ivar groups: the same for groups of turns.
    """

    pyramid: Pyramid
    keyframes: Int32
    groups: TurnGroups


def constrain_around(
    known: Float64, is_searched: Bool, keyframes: Float64, radius: float, cell: float
) -> PositionConstraint:
    """The constraint to within ``radius``, m, of the positions ``known``, shape (n, 2), m.

    :param is_searched: shape (n,), which of them are searched; the others lie around those.
    :param keyframes: shape (m, 2), m, query frame.
    :param cell: edge of a cell, m.
    """
    # With a keyframe anywhere in a cell.
    reach = radius + cell
    origin = np.floor((known.min(axis=0) - reach) / cell) * cell
    columns, rows = np.ceil((known.max(axis=0) + reach - origin) / cell).astype(np.int64) + 1
    cells = np.zeros((rows, columns), np.float32)
    for positions, value in ((known, _AROUND), (known[is_searched], _OWN)):
        _mark_disks(cells, (positions - origin) / cell - 0.5, reach / cell, value)
    return PositionConstraint(LogRatioGrid(cells, origin, cell), keyframes)


def no_constraint(cell: float) -> PositionConstraint:
    """The constraint that admits all positions."""
    return PositionConstraint(LogRatioGrid(np.zeros((1, 1), np.float32), np.zeros(2), cell), np.zeros((0, 2)))


def build_constraint_pyramid(
    constraint: PositionConstraint, window: SearchWindow, memory: SearchMemory
) -> ConstraintPyramid:
    """A constraint for a search of a window, valid until the next of that memory is built."""
    pyramid = build_pyramid(constraint.allowed.log_ratio, memory)
    cells = sample_cells(window, constraint.allowed, constraint.keyframes)
    return ConstraintPyramid(pyramid, cells, group_turns(cells, window.first))


@njit(cache=True)
def _mark_disks(cells: Float32, known: Float64, reach: float, value: float) -> None:
    """Write ``value`` to the cells within ``reach`` cells of the positions ``known``, shape (n, 2), cells."""
    rows, columns = cells.shape
    for n in range(known.shape[0]):
        x, y = known[n, 0], known[n, 1]
        for r in range(max(0, int(np.ceil(y - reach))), min(rows, int(np.floor(y + reach)) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (r - y) ** 2))
            cells[r, max(0, int(np.ceil(x - half))) : min(columns, int(np.floor(x + half)) + 1)] = np.float32(value)


@njit(cache=True)
def is_admissible(constraint: ConstraintPyramid, k: int, i: int, j: int) -> bool:
    """Whether the constraint is met at turn ``k`` and the shift (i, j)."""
    level, cells = constraint.pyramid.cells, constraint.keyframes[k]
    return _is_met(level.reshape(1, *level.shape), cells, np.zeros(cells.shape[0], np.int8), i, j)


@njit(cache=True)
def is_block_admissible(constraint: ConstraintPyramid, k: int, i: int, j: int) -> bool:
    """Whether the constraint can be met at turn ``k`` in the block of shifts that begins at (i, j)."""
    cells = constraint.keyframes[k]
    return _is_met(constraint.pyramid.levels[0], cells, np.zeros(cells.shape[0], np.int8), i, j)


@njit(cache=True)
def is_admissible_within(constraint: ConstraintPyramid, height: int, group: int, x: int, y: int) -> bool:
    """Whether the constraint can be met at a turn of a group in a square of shifts.

    :param group: its number among those of all heights.
    :param x: where the square begins along x, tiles from the smallest shift of the window; ``y``, along y.
    """
    groups = constraint.groups
    return _is_met(constraint.pyramid.levels[height - MIN_HEIGHT], groups.corners[group], groups.classes[group], x, y)


@njit(cache=True)
def _is_met(level: Int8, corners: Int32, classes: Int8, x: int, y: int) -> bool:
    """Whether at most half of the keyframes are at 0, and one near a searched position."""
    rows, columns = np.uint32(level.shape[1]), np.uint32(level.shape[2])
    count, outside, largest = corners.shape[0], 0, 0
    for n in range(count):
        if classes[n] == TOO_WIDE:
            largest = TOP_STEPS
            continue
        column, row = np.uint32(corners[n, 0] + x + PAD), np.uint32(corners[n, 1] + y + PAD)
        value = level[np.uint32(classes[n]), row, column] if column < columns and row < rows else 0
        largest = max(largest, value)
        outside += value == 0
        if 2 * outside > count:
            return False
    return count == 0 or largest > AROUND_STEPS
