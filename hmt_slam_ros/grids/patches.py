"""Patches of cells: how they are found, shared and copied.

A map is a table (T, T) of indices into a store of square patches; -1 is a patch never seen. The axes of map frame and
table are the same, and the origin is the corner between the four middle patches. Each patch holds, for 32 x 32 cells,

- ``odds``: int8, evidence of occupancy in units of 0.05 nats, positive occupied, negative free, 0 unknown;
- ``field``: uint8, distance from the cell's center to the nearest occupied cell's center, 255 = the field's radius;
- ``occupied``: uint32 for each row, bit c is set where the odds of column c are positive.
"""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.arrays import Int8, Int32, Int64, UInt8, UInt32
from hmt_slam_ros.compilation import njit

PATCH = 32
"""Edge of a patch, cells: ``1 << SHIFT``, with the bits ``MASK`` for the cell within the patch."""

SHIFT = 5
MASK = 31

NO_PATCH = -1
"""Index of a patch never seen."""

FAR = 255
"""Largest value of the distance field: its radius and more."""


class GridView(NamedTuple):
    """One map, for the kernels.

    :ivar table: shape (T, T), indices into the pool.
    :ivar odds: shape (capacity, 32, 32), the pool's.
    :ivar field: shape (capacity, 32, 32), the pool's.
    :ivar cell: edge of a cell, m.
    :ivar radius: truncation of the distance field, m.
    """

    table: Int32
    odds: Int8
    field: UInt8
    cell: float
    radius: float


class PatchStore(NamedTuple):
    """The arrays of the pool that writing to a map changes; ``free[:free_count[0]]`` are the free patches."""

    odds: Int8
    field: UInt8
    occupied: UInt32
    references: Int32
    free: Int32
    free_count: Int64


@njit(cache=True)
def odds_at(view: GridView, column: int, row: int) -> int:
    """The odds of a cell, 0 outside the map."""
    if column < 0 or row < 0:
        return 0
    tc, tr = column >> SHIFT, row >> SHIFT
    if tc >= view.table.shape[1] or tr >= view.table.shape[0]:
        return 0
    patch = view.table[tr, tc]
    if patch < 0:
        return 0
    return view.odds[patch, row & MASK, column & MASK]


@njit(cache=True)
def field_at(view: GridView, column: int, row: int) -> int:
    """The quantized distance at a cell, FAR outside the map."""
    if column < 0 or row < 0:
        return FAR
    tc, tr = column >> SHIFT, row >> SHIFT
    if tc >= view.table.shape[1] or tr >= view.table.shape[0]:
        return FAR
    patch = view.table[tr, tc]
    if patch < 0:
        return FAR
    return view.field[patch, row & MASK, column & MASK]


@njit(cache=True, inline="always")
def field_at_four(view: GridView, column: int, row: int) -> tuple[int, int, int, int]:
    """:func:`field_at` of a cell, of the next cell in its row, and of both in the next row."""
    c, r, tc, tr = column & MASK, row & MASK, column >> SHIFT, row >> SHIFT
    if 0 <= tc < view.table.shape[1] and 0 <= tr < view.table.shape[0] and c < MASK and r < MASK:
        # All four lie in one patch.
        patch = view.table[tr, tc]
        if patch < 0:
            return FAR, FAR, FAR, FAR
        field = view.field
        return field[patch, r, c], field[patch, r, c + 1], field[patch, r + 1, c], field[patch, r + 1, c + 1]
    return (
        field_at(view, column, row),
        field_at(view, column + 1, row),
        field_at(view, column, row + 1),
        field_at(view, column + 1, row + 1),
    )


@njit(cache=True)
def add_references(table: Int32, references: Int32) -> None:
    """Count one more reference to every patch of a map."""
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            if table[row, column] >= 0:
                references[table[row, column]] += 1


@njit(cache=True)
def release_table(table: Int32, store: PatchStore) -> None:
    """Empty a map's table; patches that no other table has are free again."""
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            patch = table[row, column]
            if patch >= 0:
                store.references[patch] -= 1
                if store.references[patch] == 0:
                    store.free[store.free_count[0]] = patch
                    store.free_count[0] += 1
            table[row, column] = NO_PATCH


@njit(cache=True)
def writable_patch(table: Int32, store: PatchStore, row: int, column: int) -> int:
    """The patch at a place of the table, a new one or a copy of a shared one where needed."""
    old = table[row, column]
    if old >= 0 and store.references[old] == 1:
        return old
    store.free_count[0] -= 1
    new = store.free[store.free_count[0]]
    store.references[new] = 1
    table[row, column] = new
    if old >= 0:
        store.odds[new] = store.odds[old]
        store.field[new] = store.field[old]
        store.occupied[new] = store.occupied[old]
        store.references[old] -= 1
    else:
        store.odds[new] = 0
        store.field[new] = FAR
        store.occupied[new] = 0
    return new
