"""Branch and bound over relative poses: all cells of the search window within a margin of the best score.

The window is a lattice of turns and shifts around the prior's mean. A node is a square of 2^h x 2^h shifts at one turn.
Its bound is the sum over the samples of the largest log-ratio at any of its shifts (Olson 2009, Hess et al. 2016), plus
the largest prior density in the square, so no cell is lost. Unlike those, the search returns all cells within a margin
of the best, not the best alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import rotate_back
from hmt_slam_ros.registration.search_bounds import (
    BLOCK,
    TOP_STEPS,
    LogRatioGrid,
    Pyramid,
    SearchWindow,
    add_block,
    build_pyramid,
    count_known,
    lattice_bounds,
    prior_bound,
    quarter_bounds,
    sample_cells,
    sort_by_phase,
)

_OWN, _AROUND = 1.0, 0.5
"""Values of cells near a position that is searched, and near one around those."""

_AROUND_STEPS = round(_AROUND / _OWN * TOP_STEPS)
"""The latter in a pyramid, steps."""


class PositionConstraint(NamedTuple):
    """Cells in which half of the query's keyframes have to be, one of them in a cell near a searched position.

    :ivar allowed: candidate frame, 1 near a searched position, 0.5 near one around those, 0 elsewhere.
    :ivar keyframes: shape (m, 2), positions of the keyframes, m, query frame; none without a constraint.
    """

    allowed: LogRatioGrid
    keyframes: Float64


class ConstraintPyramid(NamedTuple):
    """A position constraint, prepared for a search.

    :ivar pyramid: running maxima of its cells.
    :ivar keyframes: shape (turns, m, 2), column and row of every keyframe without a shift.
    """

    pyramid: Pyramid
    keyframes: Int32


def constrain_around(
    known: Float64, is_searched: Bool, keyframes: Float64, radius: float, cell: float
) -> PositionConstraint:
    """The constraint to within ``radius``, m, of the positions ``known``, shape (n, 2), m.

    :param is_searched: shape (n,), which of them are searched; the others lie around those.
    :param keyframes: shape (m, 2), m, query frame.
    :param cell: edge of a cell, m.
    """
    # With a keyframe anywhere in a cell.
    reach = radius + cell
    origin = np.floor((known.min(axis=0) - reach) / cell) * cell
    columns, rows = np.ceil((known.max(axis=0) + reach - origin) / cell).astype(np.int64) + 1
    cells = np.zeros((rows, columns), np.float32)
    for positions, value in ((known, _AROUND), (known[is_searched], _OWN)):
        _mark_disks(cells, (positions - origin) / cell - 0.5, reach / cell, value)
    return PositionConstraint(LogRatioGrid(cells, origin, cell), keyframes)


def no_constraint(cell: float) -> PositionConstraint:
    """The constraint that admits all positions."""
    return PositionConstraint(LogRatioGrid(np.zeros((1, 1), np.float32), np.zeros(2), cell), np.zeros((0, 2)))


def build_constraint_pyramid(constraint: PositionConstraint, window: SearchWindow, height: int) -> ConstraintPyramid:
    """A constraint for a search of a window down from squares of edge ``2**height``."""
    pyramid = build_pyramid(constraint.allowed.log_ratio, height)
    return ConstraintPyramid(pyramid, sample_cells(window, constraint.allowed, constraint.keyframes))


@njit(cache=True)
def _mark_disks(cells: Float32, known: Float64, reach: float, value: float) -> None:
    """Write ``value`` to the cells within ``reach`` cells of the positions ``known``, shape (n, 2), cells."""
    rows, columns = cells.shape
    for n in range(known.shape[0]):
        x, y = known[n, 0], known[n, 1]
        for r in range(max(0, int(np.ceil(y - reach))), min(rows, int(np.floor(y + reach)) + 1)):
            half = np.sqrt(max(0.0, reach * reach - (r - y) ** 2))
            cells[r, max(0, int(np.ceil(x - half))) : min(columns, int(np.floor(x + half)) + 1)] = np.float32(value)


@njit(cache=True)
def is_admissible(constraint: ConstraintPyramid, height: int, k: int, i: int, j: int) -> bool:
    """Whether the constraint can be met at turn ``k`` in the square of shifts that begins at (i, j)."""
    level, margin, cells = constraint.pyramid.levels[height], constraint.pyramid.margin, constraint.keyframes[k]
    rows, columns = np.uint32(level.shape[0]), np.uint32(level.shape[1])
    count, outside, largest = cells.shape[0], 0, 0
    for n in range(count):
        x, y = np.uint32(cells[n, 0] + i + margin), np.uint32(cells[n, 1] + j + margin)
        value = level[y, x] if x < columns and y < rows else 0
        largest = max(largest, value)
        outside += value == 0
        if 2 * outside > count:
            return False
    return count == 0 or largest > _AROUND_STEPS


class ReverseCheck(NamedTuple):
    """The check of the candidate's surface points in the free space of the query.

    :ivar grid: the query's.
    :ivar points: shape (m, 2), the candidate's surface points, m, candidate frame.
    :ivar rotated_points: shape (turns, m, 2), the same in the query's frame without a shift, cells of the grid.
    :ivar is_rotated: shape (turns,), at which turns they are computed: few turns have a block that is tested.
    :ivar negative: for cells of the grid and ``reach`` beyond, whether a cell within ``reach`` has a log-ratio below 0.
    :ivar reach: largest distance between a point at a shift of a block and at its middle, plus one, cells.
    """

    grid: LogRatioGrid
    points: Float64
    rotated_points: Float32
    is_rotated: Bool
    negative: Bool
    reach: int


def make_reverse_check(window: SearchWindow, grid: LogRatioGrid, points: Float64) -> ReverseCheck:
    """The reverse check of a window; the arguments are those of :func:`search_cells`."""
    reach = math.ceil(math.sqrt(0.5) * (BLOCK - 1) * window.cell / grid.cell) + 1
    turns = window.turns.size
    rotated = np.empty((turns, len(points), 2), np.float32)
    negative = _near_negative(grid.log_ratio, reach)
    return ReverseCheck(grid, points, rotated, np.zeros(turns, np.bool_), negative, reach)


@njit(cache=True)
def _rotate_points(check: ReverseCheck, window: SearchWindow, k: int) -> Float32:
    """The points at turn ``k``, shape (m, 2), computed at the first call."""
    rotated, grid, points = check.rotated_points[k], check.grid, check.points
    if check.is_rotated[k]:
        return rotated
    angle = window.mean[2] + window.turns[k]
    cos, sin = np.cos(angle) / grid.cell, np.sin(angle) / grid.cell
    for n in range(points.shape[0]):
        x, y = rotate_back(cos, sin, points[n, 0] - window.mean[0], points[n, 1] - window.mean[1])
        rotated[n, 0] = x - grid.origin[0] / grid.cell
        rotated[n, 1] = y - grid.origin[1] / grid.cell
    check.is_rotated[k] = True
    return rotated


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
    """Write to ``points`` those that may contradict in the block that begins at ``node``; returns their number."""
    negative, rotated = check.negative, _rotate_points(check, window, node[0])
    angle, ratio = window.mean[2] + window.turns[node[0]], window.cell / check.grid.cell
    cos, sin = ratio * np.cos(angle), ratio * np.sin(angle)
    x, y = node[1] + 0.5 * (BLOCK - 1), node[2] + 0.5 * (BLOCK - 1)
    across, along = np.float32(check.reach - cos * x - sin * y), np.float32(check.reach - cos * y + sin * x)
    rows, columns = np.uint32(negative.shape[0]), np.uint32(negative.shape[1])
    count = 0
    for n in range(rotated.shape[0]):
        c, r = np.uint32(np.int32(rotated[n, 0] + across)), np.uint32(np.int32(rotated[n, 1] + along))
        if c < columns and r < rows and negative[r, c]:
            points[count] = check.points[n]
            count += 1
    return count


@njit(cache=True)
def sum_contradictions(
    grid: LogRatioGrid, window: SearchWindow, cell: tuple[int, int, int], points: Float64, least: float
) -> float:
    """Sum of the negative log-ratios of points in the query's grid at a cell, stopped below ``least``."""
    angle = window.mean[2] + window.turns[cell[0]]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = window.mean[0] + cell[1] * window.cell, window.mean[1] + cell[2] * window.cell
    rows, columns = grid.log_ratio.shape
    total = 0.0
    for n in range(points.shape[0]):
        if total < least:
            break
        query_x, query_y = rotate_back(cos, sin, points[n, 0] - x, points[n, 1] - y)
        c = int(np.floor((query_x - grid.origin[0]) / grid.cell))
        r = int(np.floor((query_y - grid.origin[1]) / grid.cell))
        if 0 <= c < columns and 0 <= r < rows:
            total += min(np.float32(0.0), grid.log_ratio[r, c])
    return total


_MIN_HEIGHT, _MAX_HEIGHT = 2, 5
"""Heights of the coarsest nodes; squares of the lowest are blocks."""


class SearchCells(NamedTuple):
    """Cells of the window, in the order of the search.

    :ivar indices: shape (n, 3), int64, (k, i, j).
    :ivar score: shape (n,), nats: tempered log-ratio plus the prior's exponent.
    :ivar contradiction: shape (n,), nats, at most 0: the part of the score from the reverse check.
    :ivar work: number of samples that were looked up.
    """

    indices: Int64
    score: Float64
    contradiction: Float64
    work: int = 0


class _SearchProblem(NamedTuple):
    """A search problem; the members are the arguments of :func:`search_cells`.

    :ivar cells: of the samples, see :func:`sample_cells`.
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
    """All cells of the window with a score within ``margin`` of the best and not below ``threshold``.

    :param window: the lattice of poses; its cell is that of ``surface``.
    :param surface: the candidate's grid.
    :param samples: shape (n, 2), the query's surface points, m, query frame.
    :param reverse_grid: the query's grid, for the reverse check.
    :param reverse_samples: shape (m, 2), the candidate's surface points, m, candidate frame.
    :param temper: factor on the summed log-ratios.
    :param constraint: limits on the positions of the query's keyframes, if any.
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
    cells, squares = _search_depth_first(task, height, threshold)
    cells = cells[cells[:, 3] >= max(threshold, cells[:, 3].max(initial=-np.inf) - margin)]
    work = squares * len(samples)
    return SearchCells(cells[:, :3].astype(np.int64), cells[:, 3].copy(), cells[:, 4].copy(), work)


@njit(cache=True)
def _search_depth_first(task: _SearchProblem, height: int, threshold: float) -> tuple[Float64, int]:
    """Cells (k, i, j, score, contradiction), a superset of the result, and the number of squares with a bound.

    Depth first, best bound first.
    """
    nodes, coarse = _coarse_nodes(task, height)
    stack, bounds = np.empty((4 * height + 8, 4), dtype=np.int64), np.empty(4 * height + 8)
    found, count = np.empty((1024, 5)), 0
    points = np.empty_like(task.reverse.points)
    least, squares = threshold, len(nodes)
    for n in np.argsort(-coarse, kind="mergesort"):
        stack[0, :3], stack[0, 3], bounds[0] = nodes[n], height, coarse[n]
        size = 1
        while size > 0:
            size -= 1
            if bounds[size] < least:
                continue
            k, i, j, h = stack[size, 0], stack[size, 1], stack[size, 2], stack[size, 3]
            squares += BLOCK
            if 2**h > BLOCK:
                size = _push_quarters(task, stack, bounds, size, (k, i, j), h - 1, least)
                continue
            if count + BLOCK * BLOCK > len(found):
                found = np.concatenate((found, np.empty_like(found)))
            count, least = _take_cells(task, (k, i, j), points, found, count, least)
    return found[:count], squares


@njit(cache=True)
def _coarse_nodes(task: _SearchProblem, height: int) -> tuple[Int64, Float64]:
    """The coarsest nodes (k, i, j) of all turns, and their bounds."""
    window, side = task.window, 2**height
    across, along = (window.last - window.first) // side + 1
    level = sort_by_phase(task.bounds.levels[height], height, across)
    allowed = sort_by_phase(task.constraint.pyramid.levels[height], height, across)
    x, y = window.first + task.bounds.margin
    nodes = np.empty((window.turns.size * across * along, 3), dtype=np.int64)
    bounds = np.empty(nodes.shape[0])
    count = 0
    for k in range(window.turns.size):
        before = count
        keyframes = task.constraint.keyframes[k]
        near, largest = count_known(allowed, keyframes, x, y, along)
        for a in range(across):
            for b in range(along):
                if keyframes.shape[0] > 0 and (2 * near[b, a] < keyframes.shape[0] or largest[b, a] <= _AROUND_STEPS):
                    continue
                i, j = window.first[0] + a * side, window.first[1] + b * side
                prior = prior_bound(window, k, i, j, side)
                if prior > -np.inf:
                    nodes[count, 0], nodes[count, 1], nodes[count, 2] = k, i, j
                    bounds[count] = prior
                    count += 1
        if count > before:
            steps = lattice_bounds(level, task.cells[k], x, y, along)
            for n in range(before, count):
                a, b = (nodes[n, 1] - window.first[0]) // side, (nodes[n, 2] - window.first[1]) // side
                bounds[n] = task.temper * task.bounds.step * steps[b, a] + bounds[n]
    return nodes[:count], bounds[:count]


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
    """Push a node's four squares with a bound of ``least``, the best on top; returns the new size of the stack."""
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
    """Append the cells of a block with a score of ``least``; returns the number of cells, and the new ``least``.

    :param points: buffer for the block's points, no shorter than ``task.reverse.points``.
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
            limit = (least - score) / task.temper
            contradiction = task.temper * sum_contradictions(task.reverse.grid, window, (k, x, y), points[:near], limit)
            score += contradiction
            if score >= least:
                found[count, 0], found[count, 1], found[count, 2] = k, x, y
                found[count, 3], found[count, 4] = score, contradiction
                count += 1
                least = max(least, score - task.margin)
    return count, least
