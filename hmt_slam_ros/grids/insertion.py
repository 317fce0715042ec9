"""How a scan enters a map: what its beams passed and where they ended, counted once for each cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int8, Int32, UInt32
from hmt_slam_ros.geometry.se2_kernels import transform
from hmt_slam_ros.grids.distance_field import (
    FieldWorkspace,
    has_bits,
    lower_field,
    lowest_bit,
    mark_dirty,
    patches_in_reach,
    recompute_dirty,
)
from hmt_slam_ros.grids.patches import MASK, PATCH, SHIFT, PatchStore, writable_patch
from hmt_slam_ros.grids.traversal import begin_walk, next_cell


class InverseSensorModel(NamedTuple):
    """The inverse sensor model, in quanta of the odds.

    :ivar hit: added to a cell with an end point.
    :ivar miss: added to a cell that a beam passes, negative.
    :ivar limit: bound of the odds' magnitude.
    """

    hit: int
    miss: int
    limit: int


class BeamMasks(NamedTuple):
    """A bit for every cell of a map, by patch and row: shape (T, T, 32), uint32; zeros between insertions.

    :ivar hit: first the cells in which a beam ends, then those of them that became occupied.
    :ivar passed: first the cells that a beam passes, then those of them that became free.
    """

    hit: UInt32
    passed: UInt32


def empty_masks(table_size: int) -> BeamMasks:
    """Nothing marked."""
    shape = (table_size, table_size, PATCH)
    return BeamMasks(np.zeros(shape, dtype=np.uint32), np.zeros(shape, dtype=np.uint32))


@njit(cache=True)
def cell_coordinates(points: Float64, poses: Float64, cell: float, table_size: int) -> Float64:
    """Points (n, 2) of the base, m, in cells of a map, for each of several ``map_T_base`` (m, 3); shape (m, n, 2)."""
    placed = np.empty((poses.shape[0], points.shape[0], 2))
    half = 0.5 * table_size * PATCH
    for i in range(poses.shape[0]):
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        for n in range(points.shape[0]):
            x, y = transform(poses[i, 0], poses[i, 1], cos, sin, points[n, 0], points[n, 1])
            placed[i, n, 0], placed[i, n, 1] = x / cell + half, y / cell + half
    return placed


@njit(cache=True)
def patches_needed(tables: Int32, store: PatchStore, work: FieldWorkspace, origins: Float64, ends: Float64) -> int:
    """How many new patches :func:`insert_beams` may take at most, with the same arguments."""
    count = 0
    for i in range(tables.shape[0]):
        rows, columns = _patches_around(origins[i], ends[i], tables.shape[1])
        for tr in patches_in_reach(work, tables.shape[1], rows):
            for tc in patches_in_reach(work, tables.shape[1], columns):
                patch = tables[i, tr, tc]
                count += patch < 0 or store.references[patch] > 1
    return count


@njit(cache=True)
def insert_beams(
    tables: Int32,
    store: PatchStore,
    marks: BeamMasks,
    work: FieldWorkspace,
    origins: Float64,
    ends: Float64,
    hits: int,
    model: InverseSensorModel,
) -> None:
    """Enter beams into several maps.

    :param tables: the maps, shape (m, T, T).
    :param origins: where the beams begin in each, shape (m, n, 2), cells.
    :param ends: likewise where they end; the first ``hits`` end on a surface.
    """
    for i in range(tables.shape[0]):
        table = tables[i]
        _mark_beams(marks, origins[i], ends[i], hits)
        rows, columns = _patches_around(origins[i], ends[i], table.shape[0])
        for tr in rows:
            for tc in columns:
                hit, passed = marks.hit[tr, tc], marks.passed[tr, tc]
                if has_bits(hit) or has_bits(passed):
                    patch = writable_patch(table, store, tr, tc)
                    _update_odds(store.odds[patch], store.occupied[patch], hit, passed, model)
        _update_field(table, store, marks, work, rows, columns)


@njit(cache=True)
def _update_field(
    table: Int32, store: PatchStore, marks: BeamMasks, work: FieldWorkspace, rows: range, columns: range
) -> None:
    """Bring the field up to date with the cells that became free or occupied, and empty the marks."""
    for tr in rows:
        for tc in columns:
            if has_bits(marks.passed[tr, tc]):
                mark_dirty(table, store, work, marks.passed[tr, tc], tr, tc)
                marks.passed[tr, tc] = 0
    recompute_dirty(table, store, work, rows, columns)
    for tr in rows:
        for tc in columns:
            if has_bits(marks.hit[tr, tc]):
                lower_field(table, store, work, marks.hit[tr, tc], tr, tc)
                marks.hit[tr, tc] = 0


@njit(cache=True)
def _patches_around(origins: Float64, ends: Float64, table_size: int) -> tuple[range, range]:
    """The rows and the columns of a table that beams (n, 2), in cells, can touch."""
    return _span(origins[:, 1], ends[:, 1], table_size), _span(origins[:, 0], ends[:, 0], table_size)


@njit(cache=True)
def _span(starts: Float64, ends: Float64, table_size: int) -> range:
    if ends.size == 0:
        return range(0, 0)
    low, high = min(starts.min(), ends.min()), max(starts.max(), ends.max())
    # Rounding may lead the traversal of a beam one cell astray.
    first, last = (int(np.floor(low)) - 1) >> SHIFT, (int(np.floor(high)) + 1) >> SHIFT
    return range(max(0, first), min(table_size, last + 1))


@njit(cache=True)
def _mark_beams(marks: BeamMasks, origins: Float64, ends: Float64, hits: int) -> None:
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
    """Mark the cells from the laser to before the end point."""
    edge = passed.shape[0] * PATCH
    walk, steps = begin_walk(from_x, from_y, to_x, to_y)
    for _ in range(steps):
        column, row = walk.column, walk.row
        if 0 <= column < edge and 0 <= row < edge:
            passed[row >> SHIFT, column >> SHIFT, row & MASK] |= np.uint32(1) << np.uint32(column & MASK)
        walk = next_cell(walk)


@njit(cache=True)
def _update_odds(odds: Int8, occupied: UInt32, hit: UInt32, passed: UInt32, model: InverseSensorModel) -> None:
    """Change the odds of a patch's marked cells; a cell in which a beam ends does not count as passed.

    :param odds: shape (32, 32); ``occupied``: shape (32,).
    :param hit: shape (32,), in: where beams end; out: the cells that became occupied.
    :param passed: shape (32,), in: where beams pass; out: the cells that became free.
    """
    for r in range(PATCH):
        if hit[r] | passed[r]:
            passed[r] &= ~hit[r]
            _add_odds(odds, r, hit[r], model.hit, model.limit)
            _add_odds(odds, r, passed[r], model.miss, model.limit)
            before = occupied[r]
            kept = before & ~(hit[r] | passed[r])
            occupied[r] = kept | _occupied_columns(odds, r, hit[r] | (passed[r] & before))
            hit[r] = occupied[r] & ~before
            passed[r] = before & ~occupied[r]


@njit(cache=True, inline="always")
def _add_odds(odds: Int8, row: int, columns: np.uint32, change: int, limit: int) -> None:
    while columns:
        c = lowest_bit(columns)
        columns &= columns - np.uint32(1)
        odds[row, c] = min(limit, max(-limit, odds[row, c] + change))


@njit(cache=True)
def _occupied_columns(odds: Int8, row: int, columns: np.uint32) -> np.uint32:
    """Those of a row's columns, as bits, whose odds are positive."""
    positive = np.uint32(0)
    while columns:
        c = lowest_bit(columns)
        if odds[row, c] > 0:
            positive |= np.uint32(1) << np.uint32(c)
        columns &= columns - np.uint32(1)
    return positive
