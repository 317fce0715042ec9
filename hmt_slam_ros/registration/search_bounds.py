"""Bounds of the score of a search on squares of its lattice of relative poses.

The pyramid has bytes, rounded up, so that a level of a large map stays in the processor's cache. Neighboring squares
are read together, sample by sample, which costs hardly more than a single square.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float32, Float64, Int8, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import rotate
from hmt_slam_ros.registration.search_window import SearchWindow

BLOCK = 4
"""Edge of a block of cells, a power of 2."""

TOP_STEPS = 64
"""The largest log-ratio in steps; log-ratios below -128 steps are rounded up to that."""


class LogRatioGrid(NamedTuple):
    """A log-ratio grid: ``log_ratio`` (rows, columns) float32, indexed [y, x], its corner ``origin`` (2,), ``cell``."""

    log_ratio: Float32
    origin: Float64
    cell: float


MIN_HEIGHT, MAX_HEIGHT = 2, 4
"""Heights of the lowest squares, which are blocks, and of the highest: an edge of height h has 2^h cells."""

TILES = 4
"""Tiles along the edge of a square; those of the lowest squares are cells."""

WIDTHS = (5, 6, 8)
"""Tiles along the edge of the larger squares of which a pyramid has the maxima, for classes of points."""

TOO_WIDE = len(WIDTHS)
"""Class of points that move so far in a group of turns that no such square has all of their squares."""

PAD = WIDTHS[-1]
"""Tiles of 0 on every side of a level."""


class SearchMemory:
    """Arrays that each search of a thread uses again.

    Those of a search hold some megabytes; new ones each time take longer than what is computed in them.
    """

    def __init__(self) -> None:
        self._arrays: dict[str, Int8] = {}

    def empty(self, name: str, shape: tuple[int, ...]) -> Int8:
        """An array of any values; the last one of that name is invalid."""
        size = math.prod(shape)
        array = self._arrays.get(name)
        if array is None or array.size < size:
            array = self._arrays[name] = np.empty(size, dtype=np.int8)
        return array[:size].reshape(shape)


class Pyramid(NamedTuple):
    """Maxima of log-ratios, in steps.

    :ivar cells: shape (rows + 2 PAD, columns + 2 PAD), int8, the log-ratios; 0 beyond the grid.
    :ivar levels: for every height from MIN_HEIGHT on, shape (len(WIDTHS), rows + 2 PAD, columns + 2 PAD), int8. Element
        [c, y, x] is no less than the log-ratios in the square of WIDTHS[c] x WIDTHS[c] tiles that begins at tile
        (x, y) - PAD; beyond the grid they are 0.
    :ivar step: nats.
    """

    cells: Int8
    levels: tuple[Int8, ...]
    step: float


def build_pyramid(log_ratio: Float32, memory: SearchMemory) -> Pyramid:
    """The pyramid of a grid, in a search's memory: valid until the next of that memory is built."""
    step = max(float(log_ratio.max()), 1e-6) / TOP_STEPS
    # Whole tiles of all heights.
    largest = 2 ** (MAX_HEIGHT - MIN_HEIGHT)
    rows, columns = (-(-size // largest) * largest for size in log_ratio.shape)
    cells = tiles = memory.empty("cells", (rows + 2 * PAD, columns + 2 * PAD))
    _round_up(log_ratio, 1.0 / step, tiles)
    levels = []
    for height in range(MIN_HEIGHT, MAX_HEIGHT + 1):
        two, four = memory.empty("two tiles", tiles.shape), memory.empty("four tiles", tiles.shape)
        levels.append(memory.empty(f"level {height}", (len(WIDTHS), *tiles.shape)))
        _widen_all(tiles, two, four, levels[-1])
        if height < MAX_HEIGHT:
            rows, columns = rows // 2, columns // 2
            merged = memory.empty(f"tiles {height}", (rows + 2 * PAD, columns + 2 * PAD))
            _merge_tiles(tiles, merged)
            tiles = merged
    return Pyramid(cells, tuple(levels), step)


@njit(cache=True)
def _merge_tiles(tiles: Int8, merged: Int8) -> None:
    """Write maxima of two by two tiles, with the same number of tiles of 0 around."""
    rows, columns = merged.shape[0] - 2 * PAD, merged.shape[1] - 2 * PAD
    merged[:] = 0
    for r in range(rows):
        above, below, row = tiles[PAD + 2 * r], tiles[PAD + 2 * r + 1], merged[PAD + r]
        for c in range(columns):
            x = PAD + 2 * c
            row[PAD + c] = max(above[x], above[x + 1], below[x], below[x + 1])


@njit(cache=True)
def _widen_all(tiles: Int8, two: Int8, four: Int8, wide: Int8) -> None:
    """Write to ``wide`` the maxima over the squares of all widths that begin at a tile, (len(WIDTHS), *tiles.shape).

    :param two: buffer, of the shape of ``tiles``, as ``four``.
    """
    _widen(tiles, two, 1)
    _widen(two, four, 2)
    for c in range(len(WIDTHS)):
        _widen(four, wide[c], WIDTHS[c] - TILES)


@njit(cache=True)
def _round_up(log_ratio: Float32, scale: float, steps: Int8) -> None:
    """Write log-ratios in steps, with 0 in the ``PAD`` tiles on every side and beyond the grid."""
    rows, columns = log_ratio.shape
    steps[:PAD], steps[PAD + rows :] = 0, 0
    for r in range(rows):
        row = steps[PAD + r]
        row[:PAD], row[PAD + columns :] = 0, 0
        for c in range(columns):
            row[PAD + c] = np.int8(max(-128.0, np.ceil(log_ratio[r, c] * scale)))


@njit(cache=True)
def _widen(below: Int8, above: Int8, side: int) -> None:
    """Write maxima over squares larger by ``side``, all rows in one loop.

    A square that begins in the last columns goes on in the next row, where the first ``PAD`` tiles are 0 as well.
    """
    values, wide, down = below.reshape(-1), above.reshape(-1), side * below.shape[1]
    size = values.size - down - side
    right, second, both = values[side:], values[down:], values[down + side :]
    for n in range(size):
        wide[n] = max(values[n], right[n], second[n], both[n])
    wide[size:] = 0


@njit(cache=True)
def sample_cells(window: SearchWindow, surface: LogRatioGrid, samples: Float64) -> Int32:
    """Column and row of every sample at every turn without a shift, shape (turns, samples, 2)."""
    cells = np.empty((window.turns.size, samples.shape[0], 2), np.int32)
    x0, y0 = window.mean[0] - surface.origin[0], window.mean[1] - surface.origin[1]
    for k in range(window.turns.size):
        angle = window.mean[2] + window.turns[k]
        cos, sin = np.cos(angle), np.sin(angle)
        for n in range(samples.shape[0]):
            x, y = rotate(cos, sin, samples[n, 0], samples[n, 1])
            cells[k, n, 0], cells[k, n, 1] = np.floor((x + x0) / surface.cell), np.floor((y + y0) / surface.cell)
    return cells


class TurnGroups(NamedTuple):
    """Where points lie at any turn of a group, so that one bound holds for all its turns.

    :ivar corners: shape (groups, n, 2), int32, column and row of the tile with the smallest column and row of a point
        in its group, at the smallest shift of the window.
    :ivar classes: shape (groups, n), int8, the class of every point: the number of the smallest of ``WIDTHS`` so that
        the square which begins there has all the squares that begin at the point; ``TOO_WIDE`` for none.
    :ivar first: shape (MAX_HEIGHT + 2 - MIN_HEIGHT,), int64, the number of the first group of every height, and of all.
    """

    corners: Int32
    classes: Int8
    first: Int64


@njit(cache=True)
def turns_in_group(height: int) -> int:
    """Number of turns in a group: they move most points by less than half a square's edge."""
    return 1 << (height - 1)


@njit(cache=True)
def group_turns(cells: Int32, window_first: Int64) -> TurnGroups:
    """The groups of all heights, of points with columns and rows (turns, n, 2).

    :param window_first: smallest shift of the window, shape (2,).
    """
    turns, count = cells.shape[0], cells.shape[1]
    first = np.zeros(MAX_HEIGHT + 2 - MIN_HEIGHT, np.int64)
    for h in range(MIN_HEIGHT, MAX_HEIGHT + 1):
        first[h + 1 - MIN_HEIGHT] = first[h - MIN_HEIGHT] + (turns - 1) // turns_in_group(h) + 1
    corners = np.empty((first[-1], count, 2), np.int32)
    classes = np.empty((first[-1], count), np.int8)
    limits = np.empty((2, count, 2), np.int32)
    for h in range(MIN_HEIGHT, MAX_HEIGHT + 1):
        size, start = turns_in_group(h), first[h - MIN_HEIGHT]
        for g in range(first[h + 1 - MIN_HEIGHT] - start):
            group = cells[g * size : (g + 1) * size]
            _find_limits(group, limits)
            _bound_group(limits, window_first, h - MIN_HEIGHT, corners[start + g], classes[start + g])
    return TurnGroups(corners, classes, first)


@njit(cache=True)
def _find_limits(cells: Int32, limits: Int32) -> None:
    """Write the smallest and the largest column and row of every point, (2, n, 2), of (turns, n, 2)."""
    low, high = limits[0].reshape(-1), limits[1].reshape(-1)
    low[:], high[:] = cells[0].reshape(-1), cells[0].reshape(-1)
    for k in range(1, cells.shape[0]):
        values = cells[k].reshape(-1)
        for n in range(values.size):
            low[n], high[n] = min(low[n], values[n]), max(high[n], values[n])


@njit(cache=True)
def _bound_group(limits: Int32, window_first: Int64, tile: int, corners: Int32, classes: Int8) -> None:
    """Write corners and classes of a group in which the columns and rows of the points have these limits, (2, n, 2).

    :param tile: tiles have an edge of ``2**tile`` cells.
    """
    low, high = limits
    x, y = np.int32(window_first[0]), np.int32(window_first[1])
    for n in range(classes.size):
        left, bottom = (low[n, 0] + x) >> tile, (low[n, 1] + y) >> tile
        corners[n, 0], corners[n, 1] = left, bottom
        widest = max(high[n, 0] + x - (left << tile), high[n, 1] + y - (bottom << tile))
        classes[n] = 0
        for width in WIDTHS:
            classes[n] += (width - TILES) << tile < widest


class PhasedLevel(NamedTuple):
    """A level of a pyramid, sorted by position within the squares of a lattice.

    A sample reads all squares of the lattice at the same tile within them, so these are neighbors here.

    :ivar rows: shape (len(WIDTHS), TILES, TILES, n), int8, steps: for each class and tile [y, x] of a square the
        elements at it, row by row of the lattice; before every row and after the last one are ``across`` zeros.
    :ivar shape: number of the lattice's rows and columns.
    :ivar across: largest number of squares that are read along x.
    """

    rows: Int8
    shape: tuple[int, int]
    across: int


def sort_by_phase(level: Int8, across: int, memory: SearchMemory) -> PhasedLevel:
    """A level of a pyramid for a lattice of its squares, of which ``across`` at most are read along x.

    It is in a search's memory: valid until the next of that memory is sorted.
    """
    rows, columns = -(-level.shape[1] // TILES), -(-level.shape[2] // TILES)
    phases = memory.empty("phases", (len(WIDTHS), TILES, TILES, across + rows * (columns + across)))
    _write_phases(level, across, columns + across, phases)
    return PhasedLevel(phases, (rows, columns), across)


@njit(cache=True)
def _write_phases(level: Int8, across: int, width: int, phases: Int8) -> None:
    phases[:] = 0
    for c in range(len(WIDTHS)):
        for y in range(level.shape[1]):
            first = across + y // TILES * width
            for x in range(level.shape[2]):
                phases[c, y % TILES, x % TILES, first + x // TILES] = level[c, y, x]


_SHORT_SUM = 255
"""Samples whose log-ratios, in steps of a byte each, add up to two bytes at most."""


class SquareRange(NamedTuple):
    """A rectangle of squares of a lattice: the first one along x and along y, and their numbers."""

    left: int
    low: int
    across: int
    along: int


@njit(cache=True)
def _overlap(level: PhasedLevel, column: int, row: int, squares: SquareRange) -> tuple[int, int, int]:
    """The squares of a lattice in which a point meets the level, as one run over the rows of both.

    :param column: tile of the point without a shift, as ``row``.
    :returns: the first row of the squares, the first value of the level, and their number, 0 where none meets it.
    """
    rows, columns = level.shape
    width, column, row = columns + level.across, column + squares.left, row + squares.low
    if not (-squares.across < column < columns and -squares.along < row < rows):
        return 0, 0, 0
    bottom, top = max(0, -row), min(squares.along, rows - row)
    return bottom, level.across + (row + bottom) * width + column, (top - bottom - 1) * width + squares.across


@njit(cache=True)
def lattice_bounds(level: PhasedLevel, corners: Int32, classes: Int8, squares: SquareRange) -> Int32:
    """Bounds of the sum over the samples of a group in the squares of a lattice, steps.

    The compiler vectorizes the additions: all squares take less than a tenth of their time one by one. They take two
    thirds as long with sums of two bytes as with sums of four.

    :param level: of the pyramid.
    :param corners: shape (n, 2), of the group; ``classes``, shape (n,).
    :returns: shape (along, at least across).
    """
    along, width = squares.along, level.shape[1] + level.across
    totals, sums, anywhere = np.zeros(along * width, np.int32), np.zeros(along * width, np.int16), 0
    for n in range(corners.shape[0]):
        if n % _SHORT_SUM == 0:
            totals += sums
            sums[:] = 0
        if classes[n] == TOO_WIDE:
            anywhere += TOP_STEPS
            continue
        x, y = corners[n, 0] + PAD, corners[n, 1] + PAD
        bottom, first, count = _overlap(level, x // TILES, y // TILES, squares)
        if count > 0:
            part, met = level.rows[classes[n], y % TILES, x % TILES, first : first + count], sums[bottom * width :]
            for c in range(count):
                met[c] += part[c]
    return (totals + sums).reshape(along, width) + np.int32(anywhere)


@njit(cache=True)
def count_known(level: PhasedLevel, corners: Int32, classes: Int8, squares: SquareRange) -> tuple[Int32, Int8]:
    """How many of the points may not be at 0 in the squares of a lattice, and the largest that one may be at, steps.

    The arguments and the shapes are those of :func:`lattice_bounds`.
    """
    along, width = squares.along, level.shape[1] + level.across
    counts, largest = np.zeros(along * width, np.int32), np.zeros(along * width, np.int8)
    for n in range(corners.shape[0]):
        if classes[n] == TOO_WIDE:
            counts += 1
            largest[:] = TOP_STEPS
            continue
        x, y = corners[n, 0] + PAD, corners[n, 1] + PAD
        bottom, first, count = _overlap(level, x // TILES, y // TILES, squares)
        if count > 0:
            part = level.rows[classes[n], y % TILES, x % TILES, first : first + count]
            known, values = counts[bottom * width :], largest[bottom * width :]
            for c in range(count):
                known[c] += part[c] != 0
                values[c] = max(values[c], part[c])
    return counts.reshape(along, width), largest.reshape(along, width)


# Below, an unsigned negative index is a large one: a single comparison tests whether it is in the grid.


@njit(cache=True)
def quarter_bounds(
    level: Int8, corners: Int32, classes: Int8, x: int, y: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Bounds of the sum over the samples of a group in a square of shifts, and in those beside it, steps.

    :param level: of the pyramid.
    :param corners: shape (n, 2), of the group; ``classes``, shape (n,).
    :param x: where the square begins along x, tiles from the smallest shift of the window; ``y``, along y.
    :returns: bounds of that square and the one right of it, and of the two below.
    """
    rows, columns = np.uint32(level.shape[1] - TILES), np.uint32(level.shape[2] - TILES)
    beside = np.uint32(TILES)
    first, right, below, both, anywhere = 0, 0, 0, 0, 0
    for n in range(corners.shape[0]):
        c = np.uint32(classes[n])
        if c == TOO_WIDE:
            anywhere += TOP_STEPS
            continue
        column, row = np.uint32(corners[n, 0] + x + PAD), np.uint32(corners[n, 1] + y + PAD)
        if column < columns and row < rows:
            first += level[c, row, column]
            right += level[c, row, column + beside]
            below += level[c, row + beside, column]
            both += level[c, row + beside, column + beside]
    return (first + anywhere, right + anywhere), (below + anywhere, both + anywhere)


@njit(cache=True)
def add_block(log_ratio: Float32, cells: Int32, i: int, j: int, totals: Float64) -> None:
    """Add the log-ratios at the samples (n, 2) for every shift of the block that begins at (i, j), nats.

    :param totals: shape (BLOCK, BLOCK), [j, i].
    """
    rows, columns = log_ratio.shape
    for n in range(cells.shape[0]):
        x, y = cells[n, 0] + i, cells[n, 1] + j
        if 0 <= x <= columns - BLOCK and 0 <= y <= rows - BLOCK:
            for r in range(BLOCK):
                for c in range(BLOCK):
                    totals[r, c] += log_ratio[y + r, x + c]
        elif -BLOCK < x < columns and -BLOCK < y < rows:
            for r in range(max(0, -y), min(BLOCK, rows - y)):
                for c in range(max(0, -x), min(BLOCK, columns - x)):
                    totals[r, c] += log_ratio[y + r, x + c]
