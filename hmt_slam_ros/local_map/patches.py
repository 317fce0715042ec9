"""Occupancy and distance field of many particles, in shared patches that are copied only when written to.

A map is a table (T, T) of indices into a pool of square patches; -1 is a patch never seen. Map frame and table are
aligned: the origin lies at the corner between the four middle patches. Each patch holds, for 32 x 32 cells,

- ``odds``: int8, evidence of occupancy in units of 0.05 nats, positive occupied, negative free, 0 unknown;
- ``field``: uint8, distance from the cell's centre to the nearest occupied cell's centre, 255 = the field's radius.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

PATCH = 32
SHIFT = 5
MASK = 31
NO_PATCH = -1
FAR = 255

Table = NDArray[np.int32]

_GROWTH = 1024


class PatchPool:
    """Storage of the patches of all maps of one process.

    :ivar odds: shape (capacity, 32, 32), int8.
    :ivar field: shape (capacity, 32, 32), uint8.
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
        self.radius_cells = int(np.ceil(radius / cell))
        self.odds = np.zeros((0, PATCH, PATCH), dtype=np.int8)
        self.field = np.zeros((0, PATCH, PATCH), dtype=np.uint8)
        self.references = np.zeros(0, dtype=np.int32)
        self._free = np.zeros(0, dtype=np.int32)
        self._free_count = np.zeros(1, dtype=np.int64)
        edge = table_size * PATCH
        self._marks = np.zeros((edge, edge), dtype=np.uint8)
        self._distances = _distance_stamp(self.radius_cells, cell, radius)

    @property
    def used(self) -> int:
        """Patches in use."""
        return self.references.size - int(self._free_count[0])

    @property
    def nbytes(self) -> int:
        """Bytes held, used or not."""
        return self.odds.nbytes + self.field.nbytes + self._marks.nbytes

    def empty_table(self) -> Table:
        """The table of a map in which nothing is known."""
        return np.full((self.table_size, self.table_size), NO_PATCH, dtype=np.int32)

    def share(self, table: Table) -> Table:
        """A further map with the same content; patches are copied when either is written to."""
        _reference(table, self.references)
        return table.copy()

    def release(self, table: Table) -> None:
        """Give up a map; patches that no other map names are free again."""
        self._free_count[0] = _release(table, self.references, self._free, self._free_count[0])

    def insert(
        self, table: Table, pose: NDArray[np.float64], laser: NDArray[np.float64], points: NDArray[np.float64],
        free: NDArray[np.float64], hit: int, miss: int, limit: int,
    ) -> None:
        """Enter a scan into a map: free space along the beams, surfaces at their ends, the distance field around them.

        A cell is counted once per scan, so that many beams through one cell weigh as one.

        :param table: the map, changed in place.
        :param pose: ``map_T_base``, shape (3,).
        :param laser: ``base_T_laser``, shape (3,).
        :param points: end points on surfaces, shape (n, 2), m, base frame.
        :param free: end points of beams that only tell free space, shape (k, 2), m, base frame.
        :param hit: added to the odds of a cell with an end point.
        :param miss: added to the odds of a cell that a beam passes, negative.
        :param limit: bound of the odds' magnitude.
        """
        self._reserve(self.table_size * self.table_size)
        self._free_count[0] = _insert(
            table, self.odds, self.field, self.references, self._free, self._free_count[0], self._marks,
            self._distances, pose, laser, points, free, self.cell, hit, miss, limit,
        )

    def _reserve(self, count: int) -> None:
        missing = count - int(self._free_count[0])
        if missing <= 0:
            return
        old = self.references.size
        grown = max(_GROWTH, missing, old // 4)
        self.odds = np.concatenate((self.odds, np.zeros((grown, PATCH, PATCH), dtype=np.int8)))
        self.field = np.concatenate((self.field, np.full((grown, PATCH, PATCH), FAR, dtype=np.uint8)))
        self.references = np.concatenate((self.references, np.zeros(grown, dtype=np.int32)))
        free = np.empty(old + grown, dtype=np.int32)
        kept = int(self._free_count[0])
        # Free patches are taken from the end: the lowest index first.
        free[:grown] = np.arange(old + grown - 1, old - 1, -1)
        free[grown : grown + kept] = self._free[:kept]
        self._free = free
        self._free_count[0] = grown + kept


def _distance_stamp(radius_cells: int, cell: float, radius: float) -> NDArray[np.uint8]:
    """Quantised distances around an occupied cell, shape (2r+1, 2r+1)."""
    offsets = np.arange(-radius_cells, radius_cells + 1) * cell
    distance = np.hypot(offsets[:, None], offsets[None, :])
    return np.minimum(np.rint(distance / radius * FAR), FAR).astype(np.uint8)


@njit(cache=True)
def _reference(table, references):  # type: ignore[no-untyped-def]
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            if table[row, column] >= 0:
                references[table[row, column]] += 1


@njit(cache=True)
def _release(table, references, free, free_count):  # type: ignore[no-untyped-def]
    for row in range(table.shape[0]):
        for column in range(table.shape[1]):
            patch = table[row, column]
            if patch >= 0:
                references[patch] -= 1
                if references[patch] == 0:
                    free[free_count] = patch
                    free_count += 1
            table[row, column] = NO_PATCH
    return free_count


@njit(cache=True)
def _writable(table, odds, field, references, free, free_count, row, column):  # type: ignore[no-untyped-def]
    """The patch at a place of the table, made or unshared where needed, and the new count of free patches."""
    old = table[row, column]
    if old >= 0 and references[old] == 1:
        return old, free_count
    free_count -= 1
    new = free[free_count]
    references[new] = 1
    table[row, column] = new
    if old >= 0:
        odds[new] = odds[old]
        field[new] = field[old]
        references[old] -= 1
    else:
        odds[new] = 0
        field[new] = FAR
    return new, free_count


@njit(cache=True)
def odds_at(table, odds, column, row):  # type: ignore[no-untyped-def]
    """The odds of a cell, 0 outside the map."""
    if column < 0 or row < 0:
        return 0
    tc, tr = column >> SHIFT, row >> SHIFT
    if tc >= table.shape[1] or tr >= table.shape[0]:
        return 0
    patch = table[tr, tc]
    if patch < 0:
        return 0
    return odds[patch, row & MASK, column & MASK]


@njit(cache=True)
def field_at(table, field, column, row):  # type: ignore[no-untyped-def]
    """The quantised distance at a cell, FAR outside the map."""
    if column < 0 or row < 0:
        return FAR
    tc, tr = column >> SHIFT, row >> SHIFT
    if tc >= table.shape[1] or tr >= table.shape[0]:
        return FAR
    patch = table[tr, tc]
    if patch < 0:
        return FAR
    return field[patch, row & MASK, column & MASK]


@njit(cache=True)
def _insert(  # type: ignore[no-untyped-def]
    table, odds, field, references, free, free_count, marks, stamp, pose, laser, points, open_ends, cell, hit, miss, limit
):
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    half = 0.5 * table.shape[0] * PATCH
    x0 = (pose[0] + cos * laser[0] - sin * laser[1]) / cell + half
    y0 = (pose[1] + sin * laser[0] + cos * laser[1]) / cell + half
    ends = np.empty((points.shape[0] + open_ends.shape[0], 2))
    for i in range(ends.shape[0]):
        p = points[i] if i < points.shape[0] else open_ends[i - points.shape[0]]
        ends[i, 0] = (pose[0] + cos * p[0] - sin * p[1]) / cell + half
        ends[i, 1] = (pose[1] + sin * p[0] + cos * p[1]) / cell + half
    hits = points.shape[0]
    touched = _mark(marks, ends, hits, x0, y0)
    added = np.empty((hits, 2), dtype=np.int32)
    removed = np.empty((touched.shape[0], 2), dtype=np.int32)
    n_added, n_removed = 0, 0
    for k in range(touched.shape[0]):
        column, row = touched[k, 0], touched[k, 1]
        change = hit if marks[row, column] == 2 else miss
        marks[row, column] = 0
        patch, free_count = _writable(
            table, odds, field, references, free, free_count, row >> SHIFT, column >> SHIFT
        )
        old = odds[patch, row & MASK, column & MASK]
        new = min(limit, max(-limit, old + change))
        odds[patch, row & MASK, column & MASK] = new
        if old <= 0 < new:
            added[n_added, 0], added[n_added, 1] = column, row
            n_added += 1
        elif new <= 0 < old:
            removed[n_removed, 0], removed[n_removed, 1] = column, row
            n_removed += 1
    for k in range(n_removed):
        free_count = _raise_field(
            table, odds, field, references, free, free_count, stamp, removed[k, 0], removed[k, 1]
        )
    for k in range(n_added):
        free_count = _lower_field(
            table, odds, field, references, free, free_count, stamp, added[k, 0], added[k, 1]
        )
    return free_count


@njit(cache=True)
def _mark(marks, ends, hits, x0, y0):  # type: ignore[no-untyped-def]
    """Mark the cells that end points (2) and beams (1) touch; each is listed once as (column, row)."""
    edge = marks.shape[0]
    length = 0
    for i in range(ends.shape[0]):
        length += int(abs(ends[i, 0] - x0)) + int(abs(ends[i, 1] - y0)) + 4
    touched = np.empty((length, 2), dtype=np.int32)
    count = 0
    for i in range(hits):
        column, row = int(np.floor(ends[i, 0])), int(np.floor(ends[i, 1]))
        if 0 <= column < edge and 0 <= row < edge and marks[row, column] == 0:
            marks[row, column] = 2
            touched[count, 0], touched[count, 1] = column, row
            count += 1
    for i in range(ends.shape[0]):
        count = _mark_beam(marks, touched, count, x0, y0, ends[i, 0], ends[i, 1])
    return touched[:count]


@njit(cache=True)
def _mark_beam(marks, touched, count, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Mark the cells between the laser and an end point, exclusive, by grid traversal (Amanatides and Woo)."""
    edge = marks.shape[0]
    column, row = int(np.floor(x0)), int(np.floor(y0))
    last_column, last_row = int(np.floor(x1)), int(np.floor(y1))
    dx, dy = x1 - x0, y1 - y0
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    delta_x = abs(1.0 / dx) if dx != 0.0 else np.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else np.inf
    next_x = ((column + 1 - x0) if dx > 0 else (x0 - column)) * delta_x if dx != 0.0 else np.inf
    next_y = ((row + 1 - y0) if dy > 0 else (y0 - row)) * delta_y if dy != 0.0 else np.inf
    for _ in range(abs(last_column - column) + abs(last_row - row)):
        if 0 <= column < edge and 0 <= row < edge and marks[row, column] == 0:
            marks[row, column] = 1
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
def _lower_field(table, odds, field, references, free, free_count, stamp, column, row):  # type: ignore[no-untyped-def]
    """Enter a newly occupied cell into the distance field."""
    radius = stamp.shape[0] // 2
    edge = table.shape[0] * PATCH
    for dr in range(-radius, radius + 1):
        r = row + dr
        if r < 0 or r >= edge:
            continue
        for dc in range(-radius, radius + 1):
            c = column + dc
            value = stamp[dr + radius, dc + radius]
            if c < 0 or c >= edge or value >= field_at(table, field, c, r):
                continue
            patch, free_count = _writable(
                table, odds, field, references, free, free_count, r >> SHIFT, c >> SHIFT
            )
            field[patch, r & MASK, c & MASK] = value
    return free_count


@njit(cache=True)
def _raise_field(table, odds, field, references, free, free_count, stamp, column, row):  # type: ignore[no-untyped-def]
    """Take a cell that is no longer occupied out of the distance field: measure anew around it."""
    radius = stamp.shape[0] // 2
    edge = table.shape[0] * PATCH
    for r in range(max(0, row - radius), min(edge, row + radius + 1)):
        for c in range(max(0, column - radius), min(edge, column + radius + 1)):
            if field_at(table, field, c, r) != stamp[r - row + radius, c - column + radius]:
                continue
            value = _measured_distance(table, odds, stamp, c, r)
            patch, free_count = _writable(
                table, odds, field, references, free, free_count, r >> SHIFT, c >> SHIFT
            )
            field[patch, r & MASK, c & MASK] = value
    return free_count


@njit(cache=True)
def _measured_distance(table, odds, stamp, column, row):  # type: ignore[no-untyped-def]
    radius = stamp.shape[0] // 2
    best = FAR
    for dr in range(-radius, radius + 1):
        for dc in range(-radius, radius + 1):
            value = stamp[dr + radius, dc + radius]
            if value < best and odds_at(table, odds, column + dc, row + dr) > 0:
                best = value
    return best
