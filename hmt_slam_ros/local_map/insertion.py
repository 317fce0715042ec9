"""How a scan enters a map: what its beams passed and where they ended, counted once for each cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int8, Int32, UInt32
from hmt_slam_ros.local_map.bits import any_set, lowest
from hmt_slam_ros.local_map.distance_field import FieldWork, lower, mark_dirty, measure_dirty
from hmt_slam_ros.local_map.patches import MASK, PATCH, SHIFT, Store, writable


class InverseModel(NamedTuple):
    """The inverse sensor model, in quanta of the odds.

    :ivar hit: added to a cell with an end point.
    :ivar miss: added to a cell that a beam passes, negative.
    :ivar limit: bound of the odds' magnitude.
    """

    hit: int
    miss: int
    limit: int


class Marks(NamedTuple):
    """A bit for every cell of a map, by patch and row: shape (T, T, 32), uint32; zeros between insertions.

    :ivar hit: first the cells in which a beam ends, then those of them that became occupied.
    :ivar passed: first the cells that a beam passes, then those of them that became free.
    """

    hit: UInt32
    passed: UInt32


def marks(table_size: int) -> Marks:
    """Nothing marked."""
    shape = (table_size, table_size, PATCH)
    return Marks(np.zeros(shape, dtype=np.uint32), np.zeros(shape, dtype=np.uint32))


@njit(cache=True)
def insert(
    table: Int32,
    store: Store,
    marks: Marks,
    work: FieldWork,
    origins: Float64,
    ends: Float64,
    hits: int,
    model: InverseModel,
) -> None:
    """Enter beams from ``origins`` to ``ends`` (n, 2), in cells, of which the first ``hits`` end on a surface."""
    if not len(ends):
        return
    _mark(marks, origins, ends, hits)
    top, bottom, left, right = patches_around(origins, ends, table.shape[0])
    for tr in range(top, bottom):
        for tc in range(left, right):
            hit, passed = marks.hit[tr, tc], marks.passed[tr, tc]
            if any_set(hit) or any_set(passed):
                patch = writable(table, store, tr, tc)
                _count(store.odds[patch], store.occupied[patch], hit, passed, model)
                if any_set(passed):
                    mark_dirty(table, store, work, passed, tr, tc)
                    passed[:] = 0
    _measure_dirty(table, store, work, top, bottom, left, right)
    for tr in range(top, bottom):
        for tc in range(left, right):
            hit = marks.hit[tr, tc]
            if any_set(hit):
                lower(table, store, work, hit, tr, tc)
                hit[:] = 0


@njit(cache=True)
def patches_around(origins: Float64, ends: Float64, table_size: int) -> tuple[int, int, int, int]:
    """The part of a table that beams can touch: rows from, to, columns from, to."""
    low_x, high_x = min(origins[:, 0].min(), ends[:, 0].min()), max(origins[:, 0].max(), ends[:, 0].max())
    low_y, high_y = min(origins[:, 1].min(), ends[:, 1].min()), max(origins[:, 1].max(), ends[:, 1].max())
    # Rounding may lead the traversal of a beam one cell astray.
    return (
        min(table_size, max(0, (int(np.floor(low_y)) - 1) >> SHIFT)),
        max(0, min(table_size, ((int(np.floor(high_y)) + 1) >> SHIFT) + 1)),
        min(table_size, max(0, (int(np.floor(low_x)) - 1) >> SHIFT)),
        max(0, min(table_size, ((int(np.floor(high_x)) + 1) >> SHIFT) + 1)),
    )


@njit(cache=True)
def _mark(marks: Marks, origins: Float64, ends: Float64, hits: int) -> None:
    """Mark the cells in which beams end and which they pass."""
    edge = marks.hit.shape[0] * PATCH
    for i in range(hits):
        column, row = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= column < edge and 0 <= row < edge:
            marks.hit[row >> SHIFT, column >> SHIFT, row & MASK] |= np.uint32(1) << np.uint32(column & MASK)
    for i in range(ends.shape[0]):
        _mark_beam(marks.passed, origins[i, 0], origins[i, 1], ends[i, 0], ends[i, 1])


@njit(cache=True)
def _mark_beam(passed: UInt32, from_x: float, from_y: float, to_x: float, to_y: float) -> None:
    """Mark the cells from the laser to before the end point, by grid traversal (Amanatides and Woo 1987)."""
    edge = passed.shape[0] * PATCH
    column, row = int(np.floor(from_x)), int(np.floor(from_y))
    steps = abs(int(np.floor(to_x)) - column) + abs(int(np.floor(to_y)) - row)
    step_x, delta_x, next_x = _axis_steps(from_x, to_x)
    step_y, delta_y, next_y = _axis_steps(from_y, to_y)
    for _ in range(steps):
        if 0 <= column < edge and 0 <= row < edge:
            passed[row >> SHIFT, column >> SHIFT, row & MASK] |= np.uint32(1) << np.uint32(column & MASK)
        if next_x < next_y:
            next_x += delta_x
            column += step_x
        else:
            next_y += delta_y
            row += step_y


@njit(cache=True)
def _axis_steps(start: float, end: float) -> tuple[int, float, float]:
    """Along one axis: the cell step, the beam's length per cell, and its length up to the first boundary."""
    if end == start:
        return 0, np.inf, np.inf
    delta = 1.0 / abs(end - start)
    if end > start:
        return 1, delta, (np.floor(start) + 1.0 - start) * delta
    return -1, delta, (start - np.floor(start)) * delta


@njit(cache=True)
def _count(odds: Int8, occupied: UInt32, hit: UInt32, passed: UInt32, model: InverseModel) -> None:
    """Change the odds of a patch's marked cells; a cell in which a beam ends does not count as passed.

    :param odds: shape (32, 32); ``occupied``: shape (32,).
    :param hit: shape (32,), in: where beams end; out: the cells that became occupied.
    :param passed: shape (32,), in: where beams pass; out: the cells that became free.
    """
    for r in range(PATCH):
        if hit[r] | passed[r]:
            passed[r] &= ~hit[r]
            _add(odds, r, hit[r], model.hit, model.limit)
            _add(odds, r, passed[r], model.miss, model.limit)
            before = occupied[r]
            kept = before & ~(hit[r] | passed[r])
            occupied[r] = kept | _positive(odds, r, hit[r] | (passed[r] & before))
            hit[r] = occupied[r] & ~before
            passed[r] = before & ~occupied[r]


@njit(cache=True)
def _add(odds: Int8, row: int, columns: np.uint32, change: int, limit: int) -> None:
    while columns:
        c = lowest(columns)
        columns &= columns - np.uint32(1)
        odds[row, c] = min(limit, max(-limit, odds[row, c] + change))


@njit(cache=True)
def _positive(odds: Int8, row: int, columns: np.uint32) -> np.uint32:
    """Those of a row's columns, as bits, whose odds are positive."""
    positive = np.uint32(0)
    while columns:
        c = lowest(columns)
        if odds[row, c] > 0:
            positive |= np.uint32(1) << np.uint32(c)
        columns &= columns - np.uint32(1)
    return positive


@njit(cache=True)
def _measure_dirty(
    table: Int32, store: Store, work: FieldWork, top: int, bottom: int, left: int, right: int
) -> None:
    """Measure anew what is dirty in a part of the table, and around it as far as the field reaches."""
    margin = (work.stamp.shape[0] // 2 + MASK) >> SHIFT
    for tr in range(max(0, top - margin), min(table.shape[0], bottom + margin)):
        for tc in range(max(0, left - margin), min(table.shape[0], right + margin)):
            if work.dirty[tr, tc]:
                measure_dirty(table, store, work, tr, tc)
