"""The exact distance field of a map whose cells become occupied and free again.

A cell that becomes occupied lowers the field around it. Where a cell becomes free, the rows of patches in which it was
the nearest are recomputed from all occupied cells in reach, by the separable transform of squared distances: along the
rows first, then across (Felzenszwalb and Huttenlocher 2012).

Functions that are called for every cell are inlined: a call with arrays counts references, which costs as much as the
work. Squared distances are integers: for the minimum of floats the compiler emits a masked store, which is ten times
slower on AMD's processors.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from hmt_slam_ros.arrays import Int32, UInt8, UInt32
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.grids.patches import FAR, MASK, PATCH, SHIFT, PatchStore, writable_patch


@intrinsic
def lowest_bit(_context: Any, word: Any) -> Any:  # noqa: ANN401  numba's own types
    """The number of the lowest bit that is set; undefined for 0."""

    def count_trailing_zeros(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:  # noqa: ANN401
        zeros = builder.cttz(arguments[0], cgutils.true_bit)
        return builder.zext(zeros, context.get_value_type(types.int64))

    return types.int64(word), count_trailing_zeros


@njit(cache=True)
def has_bits(words: UInt32) -> bool:
    """Whether a bit is set in any of the words (n,)."""
    bits = np.uint32(0)
    for word in words:
        bits |= word
    return bits != 0


class FieldWorkspace(NamedTuple):
    """Tables of distances around an occupied cell, and buffers; r is the field's radius in cells.

    The tables have 31 columns of "far" on both sides, so that a row of a patch always overlaps 32 columns.

    :ivar quanta: shape (r^2 + 2,), the field's value of a squared distance; the last is FAR.
    :ivar stamp: shape (2r + 1, 2r + 63), the field's values around an occupied cell.
    :ivar squares: shape (2r + 63,), squared distances along a row.
    :ivar empty: shape (32, 32), the field of a patch never seen.
    :ivar dirty: shape (T, T), a bit for each row of a patch that has to be recomputed; zeros between insertions.
    :ivar across: shape (32,), squared distances to the occupied cells of one row.
    :ivar nearest: shape (32, 32), squared distances to the nearest occupied cells.
    """

    quanta: UInt8
    stamp: UInt8
    squares: Int32
    empty: UInt8
    dirty: UInt32
    across: Int32
    nearest: Int32


def make_field_workspace(table_size: int, cell: float, radius: float) -> FieldWorkspace:
    """The tables for cells of edge ``cell``, m, and a field of ``radius``, m."""
    reach = int(np.ceil(radius / cell))
    far = reach * reach + 1
    quanta = np.minimum(np.rint(np.sqrt(np.arange(far + 1)) * cell / radius * FAR), FAR).astype(np.uint8)
    quanta[far] = FAR
    square = np.arange(-reach, reach + 1) ** 2
    stamp = quanta[np.minimum(square[:, None] + square, far)]
    return FieldWorkspace(
        quanta,
        np.pad(stamp, ((0, 0), (MASK, MASK)), constant_values=FAR),
        np.pad(square, MASK, constant_values=far).astype(np.int32),
        np.full((PATCH, PATCH), FAR, dtype=np.uint8),
        np.zeros((table_size, table_size), dtype=np.uint32),
        np.empty(PATCH, dtype=np.int32),
        np.empty((PATCH, PATCH), dtype=np.int32),
    )


@njit(cache=True)
def patches_in_reach(work: FieldWorkspace, table_size: int, patches: range) -> range:
    """The rows or columns of patches that the field around the range ``patches`` reaches."""
    margin = (work.stamp.shape[0] // 2 + MASK) >> SHIFT
    return range(max(0, patches.start - margin), min(table_size, patches.stop + margin))


@njit(cache=True)
def lower_field(table: Int32, store: PatchStore, work: FieldWorkspace, cells: UInt32, tr: int, tc: int) -> None:
    """Lower the field around the newly occupied cells of a patch, bits of shape (32,)."""
    for r in patches_in_reach(work, table.shape[0], range(tr, tr + 1)):
        for c in patches_in_reach(work, table.shape[0], range(tc, tc + 1)):
            row, column = (tr - r) << SHIFT, (tc - c) << SHIFT
            patch = table[r, c]
            if patch < 0 or store.references[patch] > 1:
                field = work.empty if patch < 0 else store.field[patch]
                if not _would_lower(field, work.stamp, cells, row, column):
                    continue
                patch = writable_patch(table, store, r, c)
            _apply_stamps(store.field[patch], work.stamp, cells, row, column)


@njit(cache=True)
def mark_dirty(table: Int32, store: PatchStore, work: FieldWorkspace, cells: UInt32, tr: int, tc: int) -> None:
    """Mark the rows in which newly free cells of a patch, bits of shape (32,), were the nearest."""
    for r in patches_in_reach(work, table.shape[0], range(tr, tr + 1)):
        for c in patches_in_reach(work, table.shape[0], range(tc, tc + 1)):
            patch = table[r, c]
            if patch >= 0:
                row, column = (tr - r) << SHIFT, (tc - c) << SHIFT
                work.dirty[r, c] |= _rows_sharing_value(store.field[patch], work.stamp, cells, row, column)


@njit(cache=True)
def _span_in_reach(reach: int, at: int) -> tuple[int, int]:
    """The rows or columns, from ... to, of a patch that begins ``at`` relative to another and is in its reach."""
    return max(0, -reach - at), max(0, min(PATCH, PATCH + reach - at))


@njit(cache=True)
def _column_bits(begin: int, end: int) -> np.uint32:
    """The bits of the columns from ... to."""
    if begin >= end:
        return np.uint32(0)
    return (np.uint32(0xFFFFFFFF) >> np.uint32(PATCH - end + begin)) << np.uint32(begin)


@njit(cache=True, inline="always")
def _stamp_overlap(stamp: UInt8, row: int, column: int) -> tuple[int, int, int, int]:
    """Rows of a patch, from ... to, under the stamp around a cell, and the stamp's row and column at cell (0, 0)."""
    reach = stamp.shape[0] // 2
    return max(0, row - reach), min(PATCH, row + reach + 1), reach - row, MASK + reach - column


@njit(cache=True)
def _would_lower(field: UInt8, stamp: UInt8, cells: UInt32, row: int, column: int) -> bool:
    """Whether cells lower the field, in a patch that begins at (row, column) relative to the field's."""
    reach = stamp.shape[0] // 2
    columns = _column_bits(*_span_in_reach(reach, column))
    begin, end = _span_in_reach(reach, row)
    for r in range(begin, end):
        bits = cells[r] & columns
        while bits:
            top, bottom, above, left = _stamp_overlap(stamp, row + r, column + lowest_bit(bits))
            bits &= bits - np.uint32(1)
            for k in range(top, bottom):
                if _any_lower(field[k], stamp[above + k, left : left + PATCH]):
                    return True
    return False


@njit(cache=True, inline="always")
def _any_lower(field: UInt8, values: UInt8) -> bool:
    lower = False
    for c in range(field.size):
        lower |= values[c] < field[c]
    return lower


@njit(cache=True)
def _apply_stamps(field: UInt8, stamp: UInt8, cells: UInt32, row: int, column: int) -> None:
    """Lower a field by cells in a patch that begins at (row, column) relative to the field's."""
    reach = stamp.shape[0] // 2
    columns = _column_bits(*_span_in_reach(reach, column))
    begin, end = _span_in_reach(reach, row)
    for r in range(begin, end):
        bits = cells[r] & columns
        while bits:
            top, bottom, above, left = _stamp_overlap(stamp, row + r, column + lowest_bit(bits))
            bits &= bits - np.uint32(1)
            for k in range(top, bottom):
                _take_minimum(field[k], stamp[above + k, left : left + PATCH])


@njit(cache=True, inline="always")
def _take_minimum(minimum: UInt8 | Int32, values: UInt8 | Int32) -> None:
    for c in range(minimum.size):
        minimum[c] = min(minimum[c], values[c])


@njit(cache=True)
def _rows_sharing_value(field: UInt8, stamp: UInt8, cells: UInt32, row: int, column: int) -> np.uint32:
    """The rows, as bits, of a field that may come from cells in a patch that begins at (row, column) relative to it."""
    reach = stamp.shape[0] // 2
    columns = _column_bits(*_span_in_reach(reach, column))
    begin, end = _span_in_reach(reach, row)
    rows = np.uint32(0)
    for r in range(begin, end):
        bits = cells[r] & columns
        while bits:
            top, bottom, above, left = _stamp_overlap(stamp, row + r, column + lowest_bit(bits))
            bits &= bits - np.uint32(1)
            for k in range(top, bottom):
                rows |= np.uint32(_shares_value(field[k], stamp[above + k, left : left + PATCH])) << np.uint32(k)
    return rows


@njit(cache=True, inline="always")
def _shares_value(field: UInt8, values: UInt8) -> bool:
    """Whether both have a value below FAR in common."""
    shared = False
    for c in range(field.size):
        shared |= (values[c] == field[c]) & (values[c] < FAR)
    return shared


@njit(cache=True)
def recompute_dirty(table: Int32, store: PatchStore, work: FieldWorkspace, rows: range, columns: range) -> None:
    """Recompute the dirty rows, in a part of the table and around it."""
    for tr in patches_in_reach(work, table.shape[0], rows):
        for tc in patches_in_reach(work, table.shape[0], columns):
            dirty = work.dirty[tr, tc]
            if dirty:
                work.dirty[tr, tc] = 0
                _find_nearest(table, store, work, dirty, tr, tc)
                _write_rows(store.field[writable_patch(table, store, tr, tc)], dirty, work.nearest, work.quanta)


@njit(cache=True)
def _write_rows(field: UInt8, rows: np.uint32, nearest: Int32, quanta: UInt8) -> None:
    """Write squared distances into rows, given as bits, of a field."""
    while rows:
        r = lowest_bit(rows)
        rows &= rows - np.uint32(1)
        for c in range(PATCH):
            field[r, c] = quanta[nearest[r, c]]


@njit(cache=True)
def _find_nearest(table: Int32, store: PatchStore, work: FieldWorkspace, rows: np.uint32, tr: int, tc: int) -> None:
    """Write to ``work`` the squared distances from cells of a patch, in rows given as bits, to the nearest occupied."""
    reach = work.stamp.shape[0] // 2
    top, bottom = lowest_bit(rows), PATCH
    while not rows >> np.uint32(bottom - 1):
        bottom -= 1
    work.nearest[top:bottom] = work.quanta.size - 1
    patches = patches_in_reach(work, table.shape[0], range(tc, tc + 1))
    first = tr << SHIFT
    for row in range(max(0, first + top - reach), min(table.shape[0] * PATCH, first + bottom + reach)):
        any_occupied = False
        for t in patches:
            patch = table[row >> SHIFT, t]
            if patch >= 0 and store.occupied[patch, row & MASK]:
                if not any_occupied:
                    work.across[:] = work.quanta.size - 1
                any_occupied = True
                _measure_across(store.occupied[patch, row & MASK], (t - tc) << SHIFT, work.squares, work.across)
        if any_occupied:
            begin, end = max(top, row - first - reach), min(bottom, row - first + reach + 1)
            _take_nearer(work.nearest[begin:end], work.across, begin - row + first)


@njit(cache=True, inline="always")
def _measure_across(occupied: np.uint32, column: int, squares: Int32, across: Int32) -> None:
    """Lower ``across`` to squared distances from columns to occupied ones of a patch that begins at ``column``."""
    reach = squares.size // 2 - MASK
    occupied &= _column_bits(*_span_in_reach(reach, column))
    while occupied:
        left = reach + MASK - column - lowest_bit(occupied)
        occupied &= occupied - np.uint32(1)
        _take_minimum(across, squares[left : left + PATCH])


@njit(cache=True, inline="always")
def _take_nearer(nearest: Int32, across: Int32, offset: int) -> None:
    """Lower squared distances to those by the row that is ``offset`` rows before the first."""
    for r in range(nearest.shape[0]):
        square = (r + offset) * (r + offset)
        for c in range(nearest.shape[1]):
            nearest[r, c] = min(nearest[r, c], np.int32(across[c] + square))
