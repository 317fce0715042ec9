"""Branch and bound over relative poses: every cell of the search window whose score can matter.

The window is a lattice of turns and shifts around the prior's mean. A node is a square of 2^h x 2^h shifts at one turn.
Its bound reads, for each sample, the largest log-ratio that any of its shifts could read (Olson 2009, Hess et al.
2016), and adds the largest prior density in the square, so no cell is lost. Unlike those, the search does not stop
at the best cell: it returns all within a margin of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int8, Int32, Int64
from hmt_slam_ros.geometry.se2 import rotate_back
from hmt_slam_ros.registration.search_bounds import (
    BLOCK,
    LogRatioGrid,
    Pyramid,
    SearchWindow,
    add_block,
    build_pyramid,
    prior_bound,
    quarter_bounds,
    sample_cells,
    square_bound,
)


class PositionConstraint(NamedTuple):
    """Where a keyframe of the query is, one of them at least.

    :ivar allowed: above 0 where it may be, candidate frame.
    :ivar keyframes: shape (m, 2), positions of the keyframes, m, query frame; none where they may be anywhere.
    """

    allowed: LogRatioGrid
    keyframes: Float64


class ConstraintPyramid(NamedTuple):
    """A ground, as a search asks for it.

    :ivar levels: running maxima of its cells, as of :class:`search_bounds.Pyramid`, and their ``margin``.
    :ivar keyframes: shape (turns, m, 2), column and row of every keyframe without a shift.
    """

    levels: Int8
    margin: int
    keyframes: Int32


def constrain_around(known: Float64, keyframes: Float64, radius: float, cell: float) -> PositionConstraint:
    """The ground around the positions ``known``, shape (n, 2), m.

    :param keyframes: shape (m, 2), m, query frame.
    :param radius: how far around, m.
    :param cell: edge of a cell, m.
    """
    # A keyframe anywhere in a cell may be in reach.
    reach = radius + cell
    origin = np.floor((known.min(axis=0) - reach) / cell) * cell
    columns, rows = np.ceil((known.max(axis=0) + reach - origin) / cell).astype(np.int64) + 1
    cells = np.zeros((rows, columns), np.float32)
    _mark_disks(cells, (known - origin) / cell - 0.5, reach / cell)
    return PositionConstraint(LogRatioGrid(cells, origin, cell), keyframes)


def no_constraint(cell: float) -> PositionConstraint:
    """No limits."""
    return PositionConstraint(LogRatioGrid(np.zeros((1, 1), np.float32), np.zeros(2), cell), np.zeros((0, 2)))


def build_constraint_pyramid(ground: PositionConstraint, window: SearchWindow, height: int) -> ConstraintPyramid:
    """A ground for a search of a window down from squares of edge ``2**height``."""
    levels = build_pyramid(ground.allowed.log_ratio, height)
    return ConstraintPyramid(levels.levels, levels.margin, sample_cells(window, ground.allowed, ground.keyframes))


@njit(cache=True)
def _mark_disks(cells: Float32, known: Float64, reach: float) -> None:
    """Mark what is within ``reach`` cells of one of the positions ``known``, shape (n, 2), cells."""
    rows, columns = cells.shape
    for n in range(known.shape[0]):
        x, y = known[n, 0], known[n, 1]
        for r in range(max(0, int(np.ceil(y - reach))), min(rows, int(np.floor(y + reach)) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (r - y) ** 2))
            cells[r, max(0, int(np.ceil(x - half))) : min(columns, int(np.floor(x + half)) + 1)] = np.float32(1.0)


@njit(cache=True)
def is_admissible(ground: ConstraintPyramid, height: int, k: int, i: int, j: int) -> bool:
    """Whether a keyframe is on the ground at turn ``k`` somewhere in the square of shifts that begins at (i, j)."""
    level, margin, cells = ground.levels[height], ground.margin, ground.keyframes[k]
    rows, columns = np.uint32(level.shape[0]), np.uint32(level.shape[1])
    for n in range(cells.shape[0]):
        x, y = np.uint32(cells[n, 0] + i + margin), np.uint32(cells[n, 1] + j + margin)
        if x < columns and y < rows and level[y, x] > 0:
            return True
    return cells.shape[0] == 0


class ReverseCheck(NamedTuple):
    """What is checked.

    :ivar grid: the query's.
    :ivar points: shape (m, 2), the candidate's surface points, m, candidate frame.
    :ivar rotated_points: shape (turns, m, 2), the same as the query sees them without a shift, cells of the grid.
    :ivar negative: of the grid's cells and ``reach`` beyond, whether one within ``reach`` has a log-ratio below 0.
    :ivar reach: cells by which the shifts of a block move a point from where it lies at its middle, at most, and one.
    """

    grid: LogRatioGrid
    points: Float64
    rotated_points: Float32
    negative: Bool
    reach: int


def make_reverse_check(window: SearchWindow, grid: LogRatioGrid, points: Float64) -> ReverseCheck:
    """The reverse check of a window; the arguments are those of :func:`search_cells`."""
    reach = math.ceil(math.sqrt(0.5) * (BLOCK - 1) * window.cell / grid.cell) + 1
    return ReverseCheck(
        grid, points, _rotate_points(window, grid, points), _near_negative(grid.log_ratio, reach), reach
    )


@njit(cache=True)
def _rotate_points(window: SearchWindow, grid: LogRatioGrid, points: Float64) -> Float32:
    turned = np.empty((window.turns.size, points.shape[0], 2), np.float32)
    for k in range(window.turns.size):
        angle = window.mean[2] + window.turns[k]
        cos, sin = np.cos(angle) / grid.cell, np.sin(angle) / grid.cell
        for n in range(points.shape[0]):
            x, y = rotate_back(cos, sin, points[n, 0] - window.mean[0], points[n, 1] - window.mean[1])
            turned[k, n, 0] = x - grid.origin[0] / grid.cell
            turned[k, n, 1] = y - grid.origin[1] / grid.cell
    return turned


@njit(cache=True)
def _near_negative(log_ratio: Float32, reach: int) -> Bool:
    rows, columns = log_ratio.shape
    across = np.zeros((rows, columns + 2 * reach), np.bool_)
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(columns):
                across[r, c + shift] |= log_ratio[r, c] < 0.0
    negative = np.zeros((rows + 2 * reach, columns + 2 * reach), np.bool_)
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(across.shape[1]):
                negative[r + shift, c] |= across[r, c]
    return negative


@njit(cache=True)
def gather_block_points(check: ReverseCheck, window: SearchWindow, node: tuple[int, int, int], points: Float64) -> int:
    """Put those that may contradict at a shift of the block that begins at ``node`` into ``points``: how many."""
    negative, turned = check.negative, check.rotated_points[node[0]]
    angle, ratio = window.mean[2] + window.turns[node[0]], window.cell / check.grid.cell
    cos, sin = ratio * np.cos(angle), ratio * np.sin(angle)
    x, y = node[1] + 0.5 * (BLOCK - 1), node[2] + 0.5 * (BLOCK - 1)
    across, along = np.float32(check.reach - cos * x - sin * y), np.float32(check.reach - cos * y + sin * x)
    rows, columns = np.uint32(negative.shape[0]), np.uint32(negative.shape[1])
    count = 0
    for n in range(turned.shape[0]):
        c, r = np.uint32(np.int32(turned[n, 0] + across)), np.uint32(np.int32(turned[n, 1] + along))
        if c < columns and r < rows and negative[r, c]:
            points[count] = check.points[n]
            count += 1
    return count


@njit(cache=True)
def sum_contradictions(
    grid: LogRatioGrid, window: SearchWindow, cell: tuple[int, int, int], points: Float64, least: float
) -> float:
    """Sum of the negative log-ratios that points meet in the query's grid at a cell, as far as to ``least``."""
    angle = window.mean[2] + window.turns[cell[0]]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = window.mean[0] + cell[1] * window.cell, window.mean[1] + cell[2] * window.cell
    rows, columns = grid.log_ratio.shape
    total = 0.0
    for n in range(points.shape[0]):
        if total < least:
            break
        seen_x, seen_y = rotate_back(cos, sin, points[n, 0] - x, points[n, 1] - y)
        c = int(np.floor((seen_x - grid.origin[0]) / grid.cell))
        r = int(np.floor((seen_y - grid.origin[1]) / grid.cell))
        if 0 <= c < columns and 0 <= r < rows:
            total += min(np.float32(0.0), grid.log_ratio[r, c])
    return total


_MIN_HEIGHT, _MAX_HEIGHT = 2, 5  # heights of the coarsest nodes; of the lowest, the squares are blocks


class SearchCells(NamedTuple):
    """Cells of the window, in the order in which they were found.

    :ivar indices: shape (n, 3), int64, (k, i, j).
    :ivar score: shape (n,), nats: tempered log-ratio plus the prior's exponent.
    :ivar contradiction: shape (n,), nats, at most 0: the part of the score that the reverse check took.
    """

    indices: Int64
    score: Float64
    contradiction: Float64


class _SearchProblem(NamedTuple):
    """What is searched; the members are the arguments of :func:`search_cells`.

    :ivar cells: where the samples are, see :func:`sample_cells`.
    """

    window: SearchWindow
    surface: LogRatioGrid
    bounds: Pyramid
    cells: Int32
    constraint: ConstraintPyramid
    reverse: ReverseCheck
    temper: float
    margin: float


def search_cells(
    window: SearchWindow,
    surface: LogRatioGrid,
    samples: Float64,
    reverse_grid: LogRatioGrid,
    reverse_samples: Float64,
    temper: float,
    threshold: float,
    margin: float,
    constraint: PositionConstraint | None = None,
) -> SearchCells:
    """All cells of the window whose score is within ``margin`` of the best and not below ``threshold``.

    :param window: where to search; its cell is that of ``surface``.
    :param surface: the candidate's grid.
    :param samples: shape (n, 2), the query's surface points, m, query frame.
    :param reverse_grid: the query's grid, for the reverse check.
    :param reverse_samples: shape (m, 2), the candidate's surface points, m, candidate frame.
    :param temper: factor on the summed log-ratios.
    :param constraint: where one of the query's keyframes has to be, if anywhere.
    """
    if (window.first > window.last).any():
        return SearchCells(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
    edge = max(1, int((window.last - window.first).max()))
    height = min(_MAX_HEIGHT, max(_MIN_HEIGHT, int(np.ceil(np.log2(edge))) - 2))
    task = _SearchProblem(
        window,
        surface,
        build_pyramid(surface.log_ratio, height),
        sample_cells(window, surface, samples),
        build_constraint_pyramid(constraint or no_constraint(window.cell), window, height),
        make_reverse_check(window, reverse_grid, reverse_samples),
        temper,
        margin,
    )
    found = _search_depth_first(task, height, threshold)
    kept = found[found[:, 3] >= max(threshold, found[:, 3].max(initial=-np.inf) - margin)]
    return SearchCells(kept[:, :3].astype(np.int64), kept[:, 3].copy(), kept[:, 4].copy())


@njit(cache=True)
def _search_depth_first(task: _SearchProblem, height: int, threshold: float) -> Float64:
    """Depth first, best bound first: (k, i, j, score, contradiction) of cells, a superset of those wanted."""
    nodes, coarse = _coarse_nodes(task, height)
    stack, bounds = np.empty((4 * height + 8, 4), dtype=np.int64), np.empty(4 * height + 8)
    found, count = np.empty((1024, 5)), 0
    points = np.empty_like(task.reverse.points)
    least = threshold
    for n in np.argsort(-coarse, kind="mergesort"):
        stack[0, :3], stack[0, 3], bounds[0] = nodes[n], height, coarse[n]
        size = 1
        while size > 0:
            size -= 1
            if bounds[size] < least:
                continue
            k, i, j, h = stack[size, 0], stack[size, 1], stack[size, 2], stack[size, 3]
            if 2**h > BLOCK:
                size = _push_quarters(task, stack, bounds, size, (k, i, j), h - 1, least)
                continue
            if count + BLOCK * BLOCK > len(found):
                found = np.concatenate((found, np.empty_like(found)))
            count, least = _take_cells(task, (k, i, j), points, found, count, least)
    return found[:count]


@njit(cache=True)
def _coarse_nodes(task: _SearchProblem, height: int) -> tuple[Int64, Float64]:
    """The coarsest nodes of all turns: (k, i, j) and their bounds."""
    window, side = task.window, 2**height
    across, along = (window.last - window.first) // side + 1
    nodes = np.empty((window.turns.size * across * along, 3), dtype=np.int64)
    bounds = np.empty(nodes.shape[0])
    n = 0
    for k in range(window.turns.size):
        for i in range(window.first[0], window.last[0] + 1, side):
            for j in range(window.first[1], window.last[1] + 1, side):
                prior = prior_bound(window, k, i, j, side)
                if prior > -np.inf and is_admissible(task.constraint, height, k, i, j):
                    steps = square_bound(task.bounds.levels[height], task.bounds.margin, task.cells[k], i, j)
                    nodes[n, 0], nodes[n, 1], nodes[n, 2] = k, i, j
                    bounds[n] = task.temper * task.bounds.step * steps + prior
                    n += 1
    return nodes[:n], bounds[:n]


@njit(cache=True)
def _push_quarters(
    task: _SearchProblem,
    stack: Int64,
    bounds: Float64,
    size: int,
    node: tuple[int, int, int],
    height: int,
    least: float,
) -> int:
    """Push those of a node's four squares that may matter, the most promising on top; the new stack size."""
    window, side = task.window, 2**height
    k, i, j = node
    steps = quarter_bounds(task.bounds.levels[height], task.bounds.margin, task.cells[k], i, j, side)
    first = size
    for down in range(2):
        for right in range(2):
            x, y = i + right * side, j + down * side
            bound = task.temper * task.bounds.step * steps[down][right]
            if (
                bound < least
                or x > window.last[0]
                or y > window.last[1]
                or not is_admissible(task.constraint, height, k, x, y)
            ):
                continue
            bound += prior_bound(window, k, x, y, side)
            if bound < least:
                continue
            place = size
            while place > first and bounds[place - 1] > bound:
                stack[place] = stack[place - 1]
                bounds[place] = bounds[place - 1]
                place -= 1
            stack[place, 0], stack[place, 1], stack[place, 2], stack[place, 3] = k, x, y, height
            bounds[place] = bound
            size += 1
    return size


@njit(cache=True)
def _take_cells(
    task: _SearchProblem, node: tuple[int, int, int], points: Float64, found: Float64, count: int, least: float
) -> tuple[int, float]:
    """Append the cells of a block that reach ``least``: how many are found then, and what the next have to reach.

    :param points: where the block's points are put, no shorter than ``task.reverse.points``.
    """
    window = task.window
    near = -1
    k, i, j = node
    totals = np.zeros((BLOCK, BLOCK))
    add_block(task.surface.log_ratio, task.cells[k], i, j, totals)
    for y in range(j, min(j + BLOCK, window.last[1] + 1)):
        for x in range(i, min(i + BLOCK, window.last[0] + 1)):
            score = task.temper * totals[y - j, x - i]
            if score < least:
                continue
            score += prior_bound(window, k, x, y, 1)
            if score < least or not is_admissible(task.constraint, 0, k, x, y):
                continue
            if near < 0:
                near = gather_block_points(task.reverse, window, node, points)
            against = sum_contradictions(
                task.reverse.grid, window, (k, x, y), points[:near], (least - score) / task.temper
            )
            taken = task.temper * against
            score += taken
            if score >= least:
                found[count, 0], found[count, 1], found[count, 2] = k, x, y
                found[count, 3], found[count, 4] = score, taken
                count += 1
                least = max(least, score - task.margin)
    return count, least
