"""Occupancy and distance field of many particles, in shared patches that are copied only when written to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Float64, Int8, Int32, UInt8, UInt32
from hmt_slam_ros.grids import insertion, patches
from hmt_slam_ros.grids.distance_field import make_field_workspace
from hmt_slam_ros.grids.insertion import InverseSensorModel
from hmt_slam_ros.grids.patches import NO_PATCH, PATCH, GridView, PatchStore

# Patches; some 36 MB, of which only what is used is ever touched.
_FIRST_CAPACITY = 1 << 14
_PATCH_BYTES = PATCH * PATCH * 2 + PATCH * 4

Array = TypeVar("Array", Int8, UInt8, UInt32, Int32)


class MappedBeams(NamedTuple):
    """What a scan tells a map; m, base frame.

    :ivar hits: shape (n, 2), ends on surfaces.
    :ivar free: shape (k, 2), ends of beams that only tell free space.
    :ivar origins: shape (n + k, 2), where the laser was at each of them, in that order.
    """

    hits: Float64
    free: Float64
    origins: Float64


@dataclass(frozen=True, eq=False)
class PatchState:
    """The patches of some maps, numbered in the order in which the tables name them first.

    :ivar odds: shape (n, 32, 32), evidence of occupancy of every cell in units of 0.05 nats, positive for occupied.
    :ivar field: shape (n, 32, 32), distance to the nearest occupied cell, 255 for the field's radius and more.
    :ivar occupied: shape (n, 32), of every row the cells whose odds are positive, as bits, the lowest for column 0.
    :ivar peak_patches: patches that were in use at most.
    """

    odds: Int8
    field: UInt8
    occupied: UInt32
    peak_patches: int


class PatchPool:
    """Storage of the patches of all maps of one process.

    :ivar odds: shape (capacity, 32, 32), int8.
    :ivar field: shape (capacity, 32, 32), uint8.
    :ivar occupied: shape (capacity, 32), uint32, a bit for every cell.
    :ivar references: shape (capacity,), int32, how many tables name the patch.
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
        self._masks = insertion.empty_masks(table_size)
        self._field_workspace = make_field_workspace(table_size, cell, radius)

    def state(self, tables: Int32) -> tuple[PatchState, Int32]:
        """The patches that maps name, and the tables (m, T, T) of these maps by the numbers that patches have there.

        :param tables: of all maps, shape (m, T, T).
        """
        named, first = np.unique(tables[tables != NO_PATCH], return_index=True)
        named = named[np.argsort(first)]
        # The last is for NO_PATCH.
        numbers = np.full(self.references.size + 1, NO_PATCH, dtype=np.int32)
        numbers[named] = np.arange(named.size, dtype=np.int32)
        return PatchState(self.odds[named], self.field[named], self.occupied[named], self._peak_patches), numbers[
            tables
        ]

    def load(self, state: PatchState, tables: Int32) -> None:
        """Take over patches into an empty pool.

        :param tables: of all maps, shape (m, T, T), by the numbers that patches have there.
        """
        count = len(state.odds)
        self._reserve(count)
        self.odds[:count], self.field[:count], self.occupied[:count] = state.odds, state.field, state.occupied
        self.references[:count] = np.bincount(tables[tables != NO_PATCH], minlength=count)
        self._free_count[0] -= count
        self._peak_patches = state.peak_patches

    @property
    def patches_in_use(self) -> int:
        """Patches in use."""
        return self.references.size - int(self._free_count[0])

    @property
    def peak_bytes(self) -> int:
        """Bytes of the patches when most of them were in use."""
        return self._peak_patches * _PATCH_BYTES

    def empty_table(self) -> Int32:
        """The table of a map in which nothing is known."""
        return np.full((self.table_size, self.table_size), NO_PATCH, dtype=np.int32)

    def share(self, table: Int32) -> Int32:
        """A further map with the same content; patches are copied when either is written to."""
        patches.add_references(table, self.references)
        return table.copy()

    def release(self, table: Int32) -> None:
        """Give up a map; patches that no other map names are free again."""
        patches.release_table(table, self._store())

    def view(self, table: Int32) -> GridView:
        """The map of ``table`` for the kernels; valid until the next insertion."""
        return GridView(table, self.odds, self.field, self.cell, self.radius)

    def insert(self, tables: Int32, poses: Float64, beams: MappedBeams, model: InverseSensorModel) -> None:
        """Enter a scan into maps: free space along the beams, surfaces at their ends, the distance field around them.

        A cell is counted once per scan, so that many beams through one cell weigh as one.

        :param tables: the maps, shape (m, T, T), changed in place.
        :param poses: ``map_T_base`` in each, shape (m, 3).
        :param model: the inverse sensor model.
        """
        origins = insertion.cell_coordinates(beams.origins, poses, self.cell, self.table_size)
        ends = insertion.cell_coordinates(np.concatenate((beams.hits, beams.free)), poses, self.cell, self.table_size)
        work = self._field_workspace
        self._reserve(insertion.patches_needed(tables, self._store(), work, origins, ends))
        insertion.insert_beams(tables, self._store(), self._masks, work, origins, ends, len(beams.hits), model)
        self._peak_patches = max(self._peak_patches, self.patches_in_use)

    def _store(self) -> PatchStore:
        return PatchStore(self.odds, self.field, self.occupied, self.references, self._free, self._free_count)

    def _reserve(self, count: int) -> None:
        missing = count - int(self._free_count[0])
        if missing <= 0:
            return
        old, kept = self.references.size, int(self._free_count[0])
        capacity = max(_FIRST_CAPACITY, 2 * old, old + missing)
        self.odds, self.field = _enlarge(self.odds, capacity), _enlarge(self.field, capacity)
        self.occupied, self.references = _enlarge(self.occupied, capacity), _enlarge(self.references, capacity)
        # Free patches are taken from the end: the lowest index first.
        self._free = np.concatenate((np.arange(capacity - 1, old - 1, -1, dtype=np.int32), self._free[:kept]))
        self._free = _enlarge(self._free, capacity)
        self._free_count[0] = capacity - old + kept


def _enlarge(array: Array, size: int) -> Array:
    """The array with zeros behind it; zeros that nobody writes to take no memory."""
    enlarged = np.zeros((size, *array.shape[1:]), dtype=array.dtype)
    enlarged[: len(array)] = array
    return enlarged
