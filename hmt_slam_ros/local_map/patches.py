"""Patches of cells and the kernels that read and write them.

A map is a table (T, T) of indices into a store of square patches; -1 is a patch never seen. Map frame and table are
aligned: the origin lies at the corner between the four middle patches. Each patch holds, for 32 x 32 cells,

- ``odds``: int8, evidence of occupancy in units of 0.05 nats, positive occupied, negative free, 0 unknown;
- ``field``: uint8, distance from the cell's centre to the nearest occupied cell's centre, 255 = the field's radius.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int8, Int32, Int64, UInt8

PATCH = 32
SHIFT = 5
MASK = 31
NO_PATCH = -1
FAR = 255

_PASSED = 1
_HIT = 2


class MapView(NamedTuple):
    """One map as the kernels see it.

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


class Store(NamedTuple):
    """The arrays of the pool that change when a map is written to; ``free[:free_count[0]]`` are the free patches."""

    odds: Int8
    field: UInt8
    references: Int32
    free: Int32
    free_count: Int64


class InverseModel(NamedTuple):
    """The inverse sensor model, in quanta of the odds.

    :ivar hit: added to a cell with an end point.
    :ivar miss: added to a cell that a beam passes, negative.
    :ivar limit: bound of the odds' magnitude.
    """

    hit: int
    miss: int
    limit: int


@njit(cache=True)
def odds_at(view: MapView, column: int, row: int) -> int:
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
def field_at(view: MapView, column: int, row: int) -> int:
    """The quantised distance at a cell, FAR outside the map."""
    if column < 0 or row < 0:
        return FAR
    tc, tr = column >> SHIFT, row >> SHIFT
    if tc >= view.table.shape[1] or tr >= view.table.shape[0]:
        return FAR
    patch = view.table[tr, tc]
    if patch < 0:
        return FAR
    return view.field[patch, row & MASK, column & MASK]


@njit(cache=True)
def add_references(table: Int32, references: Int32) -> None:
    """Count one reference more to every patch of a map."""
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            if table[row, column] >= 0:
                references[table[row, column]] += 1


@njit(cache=True)
def release(table: Int32, store: Store) -> None:
    """Empty a map's table; patches that no other table names are free again."""
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
def _writable(table: Int32, store: Store, column: int, row: int) -> int:
    """The patch that holds a cell, made or unshared where needed."""
    old = table[row >> SHIFT, column >> SHIFT]
    if old >= 0 and store.references[old] == 1:
        return old
    store.free_count[0] -= 1
    new = store.free[store.free_count[0]]
    store.references[new] = 1
    table[row >> SHIFT, column >> SHIFT] = new
    if old >= 0:
        store.odds[new] = store.odds[old]
        store.field[new] = store.field[old]
        store.references[old] -= 1
    else:
        store.odds[new] = 0
        store.field[new] = FAR
    return new


@njit(cache=True)
def insert(
    table: Int32,
    store: Store,
    marks: UInt8,
    stamp: UInt8,
    origins: Float64,
    ends: Float64,
    hits: int,
    model: InverseModel,
) -> None:
    """Enter beams from ``origins`` to ``ends`` (n, 2), in cells, of which the first ``hits`` end on a surface."""
    touched = _mark(marks, origins, ends, hits)
    added = np.empty((hits, 2), dtype=np.int32)
    removed = np.empty((touched.shape[0], 2), dtype=np.int32)
    n_added, n_removed = 0, 0
    for k in range(touched.shape[0]):
        column, row = touched[k, 0], touched[k, 1]
        change = model.hit if marks[row, column] == _HIT else model.miss
        marks[row, column] = 0
        patch = _writable(table, store, column, row)
        old = store.odds[patch, row & MASK, column & MASK]
        new = min(model.limit, max(-model.limit, old + change))
        store.odds[patch, row & MASK, column & MASK] = new
        if old <= 0 < new:
            added[n_added, 0], added[n_added, 1] = column, row
            n_added += 1
        elif new <= 0 < old:
            removed[n_removed, 0], removed[n_removed, 1] = column, row
            n_removed += 1
    for k in range(n_removed):
        _raise_field(table, store, stamp, removed[k, 0], removed[k, 1])
    for k in range(n_added):
        _lower_field(table, store, stamp, added[k, 0], added[k, 1])


@njit(cache=True)
def _mark(marks: UInt8, origins: Float64, ends: Float64, hits: int) -> Int32:
    """Mark the cells in which beams end and which they pass; each is listed once as (column, row)."""
    edge = marks.shape[0]
    length = 0
    for i in range(ends.shape[0]):
        length += int(abs(ends[i, 0] - origins[i, 0])) + int(abs(ends[i, 1] - origins[i, 1])) + 4
    touched = np.empty((length, 2), dtype=np.int32)
    count = 0
    for i in range(hits):
        column, row = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= column < edge and 0 <= row < edge and marks[row, column] == 0:
            marks[row, column] = _HIT
            touched[count, 0], touched[count, 1] = column, row
            count += 1
    for i in range(ends.shape[0]):
        count = _mark_beam(marks, touched, count, origins[i], ends[i])
    return touched[:count]


@njit(cache=True)
def _mark_beam(marks: UInt8, touched: Int32, count: int, origin: Float64, end: Float64) -> int:
    """Mark the cells from the laser to before the end point, by grid traversal (Amanatides and Woo 1987)."""
    edge = marks.shape[0]
    column, row = int(np.floor(origin[0])), int(np.floor(origin[1]))
    steps = abs(int(np.floor(end[0])) - column) + abs(int(np.floor(end[1])) - row)
    step_x, delta_x, next_x = _axis_steps(origin[0], end[0])
    step_y, delta_y, next_y = _axis_steps(origin[1], end[1])
    for _ in range(steps):
        if 0 <= column < edge and 0 <= row < edge and marks[row, column] == 0:
            marks[row, column] = _PASSED
            touched[count, 0], touched[count, 1] = column, row
            count += 1
        if next_x < next_y:
            next_x += delta_x
            column += step_x
        else:
            next_y += delta_y
            row += step_y
    return count


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
def _lower_field(table: Int32, store: Store, stamp: UInt8, column: int, row: int) -> None:
    """Enter a newly occupied cell into the distance field."""
    radius = stamp.shape[0] // 2
    edge = table.shape[0] * PATCH
    for r in range(max(0, row - radius), min(edge, row + radius + 1)):
        for c in range(max(0, column - radius), min(edge, column + radius + 1)):
            value = stamp[r - row + radius, c - column + radius]
            patch = table[r >> SHIFT, c >> SHIFT]
            if value < (FAR if patch < 0 else store.field[patch, r & MASK, c & MASK]):
                store.field[_writable(table, store, c, r), r & MASK, c & MASK] = value


@njit(cache=True)
def _raise_field(table: Int32, store: Store, stamp: UInt8, column: int, row: int) -> None:
    """Take a cell that is no longer occupied out of the distance field: measure anew where it was the nearest."""
    radius = stamp.shape[0] // 2
    edge = table.shape[0] * PATCH
    for r in range(max(0, row - radius), min(edge, row + radius + 1)):
        for c in range(max(0, column - radius), min(edge, column + radius + 1)):
            patch = table[r >> SHIFT, c >> SHIFT]
            if patch < 0 or store.field[patch, r & MASK, c & MASK] != stamp[r - row + radius, c - column + radius]:
                continue
            value = _measured_distance(table, store.odds, stamp, c, r)
            store.field[_writable(table, store, c, r), r & MASK, c & MASK] = value


@njit(cache=True)
def _measured_distance(table: Int32, odds: Int8, stamp: UInt8, column: int, row: int) -> int:
    """The quantised distance from a cell to the nearest occupied one, by search."""
    radius = stamp.shape[0] // 2
    edge = table.shape[0] * PATCH
    best = FAR
    for r in range(max(0, row - radius), min(edge, row + radius + 1)):
        for c in range(max(0, column - radius), min(edge, column + radius + 1)):
            value = stamp[r - row + radius, c - column + radius]
            patch = table[r >> SHIFT, c >> SHIFT]
            if value < best and patch >= 0 and odds[patch, r & MASK, c & MASK] > 0:
                best = value
    return best
