"""The lattice of relative poses of a search, and bounds of the score on squares of it.

The pyramid has bytes, rounded up, so that a level of a large map stays in the processor's cache. Neighboring squares
are read together, sample by sample, which costs hardly more than a single square.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float32, Float64, Int8, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import rotate


class SearchWindow(NamedTuple):
    """The lattice of relative poses, and the Gaussian prior on it.

    A pose of the lattice is the prior's mean shifted by (i, j) cells along the axes of the candidate's frame, and
    turned by ``turns[k]``. Its twist from the mean is affine in the shift, so the prior's exponent is -1/2 of the
    squared norm of ``whitening[k] @ shift + offsets[k]``.

    :ivar mean: shape (3,), the prior's mean.
    :ivar cell: edge of a cell, m.
    :ivar turns: shape (t,), rad, ascending, equally spaced.
    :ivar first: shape (2,), int64, smallest shift along x and y, cells; ``last``, the largest.
    :ivar information_root: shape (3, 3), the square root of the prior's information, ``root.T @ root``.
    :ivar whitening: shape (t, 3, 2), 1/m.
    :ivar offsets: shape (t, 3).
    :ivar gate: largest squared Mahalanobis distance that is searched.
    """

    mean: Float64
    cell: float
    turns: Float64
    first: Int64
    last: Int64
    information_root: Float64
    whitening: Float64
    offsets: Float64
    gate: float


def make_search_window(
    mean: Float64, covariance: Float64, cell: float, turn: float, gate: float, bounds: Float64 | None = None
) -> SearchWindow:
    """The smallest lattice that contains the gate's ellipsoid, within bounds.

    :param mean: shape (3,), ``candidate_T_query``.
    :param covariance: shape (3, 3), right tangent frame.
    :param cell: edge of a cell, m.
    :param turn: angle between turns, rad.
    :param gate: squared Mahalanobis distance at the gate, 3 degrees of freedom.
    :param bounds: shape (2, 2), the smallest and the largest (x, y) of the poses, m.
    """
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    rotation = np.array([[cos, -sin], [sin, cos]])
    half = np.sqrt(gate * np.diag(rotation @ covariance[:2, :2] @ rotation.T))
    count = int(np.ceil(min(np.sqrt(gate * covariance[2, 2]), np.pi) / turn))
    turns = np.asarray(np.arange(-count, count + 1) * turn, dtype=np.float64)
    root = np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T, dtype=np.float64)
    # log() of the twist at a fixed turn: v = V(omega)^-1 R(mean)^T shift, geometry.se2.log.
    half_cot = np.where(np.abs(turns) < 1e-5, 1.0, 0.5 * turns / np.tan(0.5 * np.where(turns == 0.0, 1.0, turns)))
    inverse_v: Float64 = np.empty((turns.size, 2, 2))
    inverse_v[:, 0, 0] = inverse_v[:, 1, 1] = half_cot
    inverse_v[:, 0, 1], inverse_v[:, 1, 0] = 0.5 * turns, -0.5 * turns
    whitening: Float64 = root[:, :2] @ inverse_v @ rotation.T
    offsets: Float64 = turns[:, None] * root[:, 2]
    reach = np.ceil(half / cell)
    first, last = -reach, reach
    if bounds is not None:
        first = np.maximum(first, np.floor((bounds[0] - mean[:2]) / cell))
        last = np.minimum(last, np.ceil((bounds[1] - mean[:2]) / cell))
    return SearchWindow(
        mean, cell, turns, first.astype(np.int64), last.astype(np.int64), root, whitening, offsets, gate
    )


@njit(cache=True)
def prior_bound(window: SearchWindow, k: int, i: int, j: int, side: int) -> float:
    """The largest exponent of the prior in the square of shifts that begins at a cell; -inf outside the gate."""
    whitening, offset = window.whitening[k], window.offsets[k]
    half = 0.5 * (side - 1) * window.cell
    x, y = i * window.cell + half, j * window.cell + half
    center, spread_plus, spread_minus = 0.0, 0.0, 0.0
    for r in range(3):
        a, b = whitening[r, 0], whitening[r, 1]
        center += (a * x + b * y + offset[r]) ** 2
        spread_plus += ((a + b) * half) ** 2
        spread_minus += ((a - b) * half) ** 2
    # Triangle inequality: the norm over the square is at least that at its center less that of the farthest corner.
    nearest = max(0.0, np.sqrt(center) - np.sqrt(max(spread_plus, spread_minus)))
    return -np.inf if nearest * nearest > window.gate else -0.5 * nearest * nearest


BLOCK = 4
"""Edge of a block of cells, a power of 2."""

TOP_STEPS = 64
"""The largest log-ratio in steps; log-ratios below -128 steps are rounded up to that."""


class LogRatioGrid(NamedTuple):
    """A log-ratio grid: ``log_ratio`` (rows, columns) float32, indexed [y, x], its corner ``origin`` (2,), ``cell``."""

    log_ratio: Float32
    origin: Float64
    cell: float


class Pyramid(NamedTuple):
    """Running maxima of log-ratios.

    :ivar levels: shape (h + 1, rows + 2 margin, columns + 2 margin), int8, steps. Element [l, y, x] is no less than the
        log-ratios in the square of 2^l x 2^l cells that begins at cell (x, y) - margin; beyond the grid they are 0.
    :ivar margin: 2^h.
    :ivar step: nats.
    """

    levels: Int8
    margin: int
    step: float


def build_pyramid(log_ratio: Float32, height: int) -> Pyramid:
    """The pyramid of a grid, with levels 0 to ``height``."""
    margin = 2**height
    step = max(float(log_ratio.max()), 1e-6) / TOP_STEPS
    rows, columns = log_ratio.shape
    levels = np.zeros((height + 1, rows + 2 * margin, columns + 2 * margin), dtype=np.int8)
    _round_up(log_ratio, 1.0 / step, levels[0, margin:, margin:])
    for level in range(height):
        _widen(levels[level], levels[level + 1], 2**level)
    return Pyramid(levels, margin, step)


@njit(cache=True)
def _round_up(log_ratio: Float32, scale: float, steps: Int8) -> None:
    for r in range(log_ratio.shape[0]):
        for c in range(log_ratio.shape[1]):
            steps[r, c] = np.int8(max(-128.0, np.ceil(log_ratio[r, c] * scale)))


@njit(cache=True)
def _widen(below: Int8, above: Int8, side: int) -> None:
    """Write maxima over squares twice as large; the last rows and columns are outside the grid and stay 0."""
    rows, columns = below.shape[0] - side, below.shape[1] - side
    for r in range(rows):
        first, right = below[r, :columns], below[r, side:]
        second, both = below[r + side, :columns], below[r + side, side:]
        for c in range(columns):
            above[r, c] = max(first[c], right[c], second[c], both[c])


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


class PhasedLevel(NamedTuple):
    """A level of a pyramid, sorted by position within the squares of a lattice.

    A sample reads all squares of the lattice at the same position within them, so these are neighbors here.

    :ivar rows: shape (side, side, n), int8, steps: for each position [y, x] within a square the elements at it, row by
        row of the lattice; before every row and after the last one there are ``across`` elements of 0.
    :ivar shape: number of the lattice's rows and columns.
    :ivar height: the squares have an edge of ``2**height``.
    :ivar across: largest number of squares that are read along x.
    """

    rows: Int8
    shape: tuple[int, int]
    height: int
    across: int


@njit(cache=True)
def sort_by_phase(level: Int8, height: int, across: int) -> PhasedLevel:
    """The level for squares of edge ``2**height``, of which ``across`` at most are read along x."""
    side = 1 << height
    rows, columns = (level.shape[0] + side - 1) >> height, (level.shape[1] + side - 1) >> height
    width = columns + across
    phases = np.zeros((side, side, across + rows * width), np.int8)
    for y in range(level.shape[0]):
        first = across + (y >> height) * width
        for x in range(side):
            row = phases[y & (side - 1), x]
            for c in range((level.shape[1] - x + side - 1) >> height):
                row[first + c] = level[y, (c << height) + x]
    return PhasedLevel(phases, (rows, columns), height, across)


@njit(cache=True)
def lattice_bounds(level: PhasedLevel, cells: Int32, i: int, j: int, along: int) -> Int32:
    """Bounds of the sum over the samples (n, 2) in the squares of a lattice, steps, shape (along, at least across).

    The compiler vectorizes the additions: all squares take less than a tenth of their time one by one.

    :param level: of the pyramid, for squares of this size.
    :param i: shift along x of the lattice's first square, from the corner of the level, cells; ``j``, along y.
    :param along: number of squares along y.
    """
    rows, columns = level.shape
    across, width, last = level.across, columns + level.across, (1 << level.height) - 1
    totals = np.zeros(along * width, np.int32)
    for n in range(cells.shape[0]):
        x, y = cells[n, 0] + i, cells[n, 1] + j
        column, row = x >> level.height, y >> level.height
        if -across < column < columns and -along < row < rows:
            low, high = max(0, -row), min(along, rows - row)
            count = (high - low - 1) * width + across
            first = across + (row + low) * width + column
            part, sums = level.rows[y & last, x & last, first : first + count], totals[low * width :]
            for c in range(count):
                sums[c] += part[c]
    return totals.reshape(along, width)


@njit(cache=True)
def count_known(level: PhasedLevel, cells: Int32, i: int, j: int, along: int) -> tuple[Int32, Int8]:
    """How many of the cells (n, 2) are not 0 in the squares of a lattice, and the largest of them, steps.

    The arguments and the shapes are those of :func:`lattice_bounds`.
    """
    rows, columns = level.shape
    across, width, last = level.across, columns + level.across, (1 << level.height) - 1
    counts, largest = np.zeros(along * width, np.int32), np.zeros(along * width, np.int8)
    for n in range(cells.shape[0]):
        x, y = cells[n, 0] + i, cells[n, 1] + j
        column, row = x >> level.height, y >> level.height
        if -across < column < columns and -along < row < rows:
            low, high = max(0, -row), min(along, rows - row)
            count = (high - low - 1) * width + across
            first = across + (row + low) * width + column
            part = level.rows[y & last, x & last, first : first + count]
            known, values = counts[low * width :], largest[low * width :]
            for c in range(count):
                known[c] += part[c] != 0
                values[c] = max(values[c], part[c])
    return counts.reshape(along, width), largest.reshape(along, width)


# Below, an unsigned negative index is a large one: a single comparison tests whether it is in the grid.


@njit(cache=True)
def quarter_bounds(
    level: Int8, margin: int, cells: Int32, i: int, j: int, side: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Bounds of the sum over the samples (n, 2) in the square of shifts that begins at (i, j), and in those beside it.

    :param level: of the pyramid, for squares of edge ``side``.
    :returns: bounds of that square and the one right of it, and of the two below, steps.
    """
    rows, columns = np.uint32(level.shape[0] - side), np.uint32(level.shape[1] - side)
    beside = np.uint32(side)
    first, right, below, both = 0, 0, 0, 0
    for n in range(cells.shape[0]):
        x, y = np.uint32(cells[n, 0] + i + margin), np.uint32(cells[n, 1] + j + margin)
        if x < columns and y < rows:
            first += level[y, x]
            right += level[y, x + beside]
            below += level[y + beside, x]
            both += level[y + beside, x + beside]
    return (first, right), (below, both)


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
