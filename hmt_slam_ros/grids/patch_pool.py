"""Occupancy and distance field of many particles, in shared patches that are copied only when written to.

A scan enters a map by its beams: the cells that they pass, and those in which they end, each counted once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8, Int32, UInt8, UInt32
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import transform_point
from hmt_slam_ros.grids import patches
from hmt_slam_ros.grids.distance_field import (
    FieldWorkspace,
    has_bits,
    lower_field,
    lowest_bit,
    make_field_workspace,
    mark_dirty,
    patches_in_reach,
    recompute_dirty,
)
from hmt_slam_ros.grids.patches import MASK, NO_PATCH, PATCH, SHIFT, GridView, PatchStore, writable_patch
from hmt_slam_ros.grids.traversal import begin_walk, next_cell

_FIRST_CAPACITY = 1 << 14
"""Patches of a new pool; some 36 MB, of which only used patches take memory."""

_PATCH_BYTES = PATCH * PATCH * 2 + PATCH * 4

Array = TypeVar("Array", Int8, UInt8, UInt32, Int32)


class MappedBeams(NamedTuple):
    """The beams of a scan that enter a map; m, base frame.

    :ivar hits: shape (n, 2), ends on surfaces.
    :ivar free: shape (k, 2), ends of beams that only show free space.
    :ivar origins: shape (n + k, 2), position of the laser at each of them, in that order.
    """

    hits: Float64
    free: Float64
    origins: Float64


class InverseSensorModel(NamedTuple):
    """The inverse sensor model, in quanta of the log-odds.

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


@dataclass(frozen=True, eq=False)
class PatchState:
    """The patches of some maps, numbered in the order in which they appear in the tables.

    :ivar odds: shape (n, 32, 32), evidence of occupancy of every cell in units of 0.05 nats, positive for occupied.
    :ivar field: shape (n, 32, 32), distance to the nearest occupied cell, 255 for the field's radius and more.
    :ivar occupied: shape (n, 32), bits of the cells of each row whose odds are positive, the lowest for column 0.
    """

    odds: Int8
    field: UInt8
    occupied: UInt32


class PatchPool:
    """Storage of the patches of all maps of one process.

    :ivar odds: shape (capacity, 32, 32), int8.
    :ivar field: shape (capacity, 32, 32), uint8.
    :ivar occupied: shape (capacity, 32), uint32, a bit for every cell.
    :ivar references: shape (capacity,), int32, number of tables that have the patch.
    """

    def __init__(self, table_size: int, cell: float, radius: float) -> None:
        """An empty pool.

        :param table_size: T, patches along one edge of a map; even.
        :param cell: edge of a cell, m.
        :param radius: truncation of the distance field, m.
        """
        self.table_size = table_size
        self.cell = cell
        self.radius = radius
        self.odds = np.zeros((0, PATCH, PATCH), dtype=np.int8)
        self.field = np.zeros((0, PATCH, PATCH), dtype=np.uint8)
        self.occupied = np.zeros((0, PATCH), dtype=np.uint32)
        self.references = np.zeros(0, dtype=np.int32)
        self._free = np.zeros(0, dtype=np.int32)
        self._free_count = np.zeros(1, dtype=np.int64)
        self._peak_patches = 0
        masks = np.zeros((2, table_size, table_size, PATCH), dtype=np.uint32)
        self._masks = BeamMasks(masks[0], masks[1])
        self._field_workspace = make_field_workspace(table_size, cell, radius)

    def state(self, tables: Int32) -> tuple[PatchState, Int32]:
        """The patches of maps, and the tables (m, T, T) of these maps with the numbers of patches in the state.

        :param tables: of all maps, shape (m, T, T).
        """
        used, first = np.unique(tables[tables != NO_PATCH], return_index=True)
        used = used[np.argsort(first)]
        # The last is for NO_PATCH.
        numbers = np.full(self.references.size + 1, NO_PATCH, dtype=np.int32)
        numbers[used] = np.arange(used.size, dtype=np.int32)
        state = PatchState(self.odds[used], self.field[used], self.occupied[used])
        return state, numbers[tables]

    def load(self, state: PatchState, tables: Int32) -> None:
        """Load patches into an empty pool.

        :param tables: of all maps, shape (m, T, T), with the numbers of patches in the state.
        """
        count = len(state.odds)
        self._reserve(count)
        self.odds[:count], self.field[:count], self.occupied[:count] = state.odds, state.field, state.occupied
        self.references[:count] = np.bincount(tables[tables != NO_PATCH], minlength=count)
        self._free_count[0] -= count
        self._peak_patches = count

    @property
    def patches_in_use(self) -> int:
        """Number of patches in use."""
        return self.references.size - int(self._free_count[0])

    @property
    def peak_bytes(self) -> int:
        """Largest number of bytes that patches took."""
        return self._peak_patches * _PATCH_BYTES

    def empty_table(self) -> Int32:
        """The table of an unknown map."""
        return np.full((self.table_size, self.table_size), NO_PATCH, dtype=np.int32)

    def share(self, table: Int32) -> Int32:
        """Another map with the same content; patches are copied when either is written to."""
        patches.add_references(table, self.references)
        return table.copy()

    def release(self, table: Int32) -> None:
        """Free a map; patches that no other map has are free again."""
        patches.release_table(table, self._store())

    def view(self, table: Int32) -> GridView:
        """The map of a table, for the kernels; valid until the next insertion."""
        return GridView(table, self.odds, self.field, self.cell, self.radius)

    def insert(self, tables: Int32, poses: Float64, beams: MappedBeams, model: InverseSensorModel) -> None:
        """Insert a scan into maps: free space along the beams, surfaces at their ends, and the distance field.

        A cell is counted once per scan, however many beams cross it.

        :param tables: the maps, shape (m, T, T), changed in place.
        :param poses: ``map_T_base`` in each, shape (m, 3).
        :param model: the inverse sensor model.
        """
        origins = cell_coordinates(beams.origins, poses, self.cell, self.table_size)
        ends = cell_coordinates(np.concatenate((beams.hits, beams.free)), poses, self.cell, self.table_size)
        work = self._field_workspace
        self._reserve(patches_needed(tables, self._store(), work, origins, ends))
        insert_beams(tables, self._store(), self._masks, work, origins, ends, len(beams.hits), model)
        self._peak_patches = max(self._peak_patches, self.patches_in_use)

    def _store(self) -> PatchStore:
        return PatchStore(self.odds, self.field, self.occupied, self.references, self._free, self._free_count)

    def _reserve(self, count: int) -> None:
        missing = count - int(self._free_count[0])
        if missing <= 0:
            return
        old, free = self.references.size, int(self._free_count[0])
        capacity = max(_FIRST_CAPACITY, 2 * old, old + missing)
        self.odds, self.field = _enlarge(self.odds, capacity), _enlarge(self.field, capacity)
        self.occupied, self.references = _enlarge(self.occupied, capacity), _enlarge(self.references, capacity)
        # Free patches are taken from the end: the lowest index first.
        self._free = np.concatenate((np.arange(capacity - 1, old - 1, -1, dtype=np.int32), self._free[:free]))
        self._free = _enlarge(self._free, capacity)
        self._free_count[0] = capacity - old + free


def _enlarge(array: Array, size: int) -> Array:
    """The array followed by zeros, which take no memory before they are written to."""
    enlarged = np.zeros((size, *array.shape[1:]), dtype=array.dtype)
    enlarged[: len(array)] = array
    return enlarged


@njit(cache=True)
def cell_coordinates(points: Float64, poses: Float64, cell: float, table_size: int) -> Float64:
    """Points (n, 2) of the base, m, in cells of a map, for each of several ``map_T_base`` (m, 3); shape (m, n, 2)."""
    coordinates = np.empty((poses.shape[0], points.shape[0], 2))
    half = 0.5 * table_size * PATCH
    for i in range(poses.shape[0]):
        cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        for n in range(points.shape[0]):
            x, y = transform_point(poses[i, 0], poses[i, 1], cos, sin, points[n, 0], points[n, 1])
            coordinates[i, n, 0], coordinates[i, n, 1] = x / cell + half, y / cell + half
    return coordinates


@njit(cache=True)
def patches_needed(tables: Int32, store: PatchStore, work: FieldWorkspace, origins: Float64, ends: Float64) -> int:
    """The largest number of new patches that :func:`insert_beams` may take, with the same arguments."""
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
    """Insert beams into several maps.

    :param tables: the maps, shape (m, T, T).
    :param origins: start points of the beams in each map, shape (m, n, 2), cells.
    :param ends: end points, likewise; the first ``hits`` are on a surface.
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
    """Update the field for the cells that became free or occupied, and clear the marks."""
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
    # Rounding may lead the traversal of a beam one cell off.
    first, last = (int(np.floor(low)) - 1) >> SHIFT, (int(np.floor(high)) + 1) >> SHIFT
    return range(max(0, first), min(table_size, last + 1))


@njit(cache=True)
def _mark_beams(marks: BeamMasks, origins: Float64, ends: Float64, hits: int) -> None:
    """Mark the cells in which beams end, and those that they pass."""
    edge = marks.hit.shape[0] * PATCH
    for i in range(hits):
        column, row = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= column < edge and 0 <= row < edge:
            marks.hit[row >> SHIFT, column >> SHIFT, row & MASK] |= np.uint32(1) << np.uint32(column & MASK)
    for i in range(ends.shape[0]):
        _mark_beam(marks.passed, origins[i, 0], origins[i, 1], ends[i, 0], ends[i, 1])


@njit(cache=True)
def _mark_beam(passed: UInt32, from_x: float, from_y: float, to_x: float, to_y: float) -> None:
    """Mark the cells from the laser up to the end point, without that."""
    edge = passed.shape[0] * PATCH
    walk, steps = begin_walk(from_x, from_y, to_x, to_y)
    for _ in range(steps):
        column, row = walk.column, walk.row
        if 0 <= column < edge and 0 <= row < edge:
            passed[row >> SHIFT, column >> SHIFT, row & MASK] |= np.uint32(1) << np.uint32(column & MASK)
        walk = next_cell(walk)


@njit(cache=True)
def _update_odds(odds: Int8, occupied: UInt32, hit: UInt32, passed: UInt32, model: InverseSensorModel) -> None:
    """Update the odds of a patch's marked cells; a cell in which a beam ends does not count as passed.

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
            unmarked = before & ~(hit[r] | passed[r])
            occupied[r] = unmarked | _occupied_columns(odds, r, hit[r] | (passed[r] & before))
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
    """Those of a row's columns, given as bits, whose odds are positive."""
    positive = np.uint32(0)
    while columns:
        c = lowest_bit(columns)
        if odds[row, c] > 0:
            positive |= np.uint32(1) << np.uint32(c)
        columns &= columns - np.uint32(1)
    return positive
