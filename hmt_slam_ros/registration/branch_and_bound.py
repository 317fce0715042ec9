"""Branch and bound over relative poses: all cells of the search window within a margin of the best score.

The window is a lattice of turns and shifts around the prior's mean. A node is a square of 2^h x 2^h shifts at one turn.
Its bound is the sum over the samples of the largest log-ratio at any of its shifts (Olson 2009, Hess et al. 2016), plus
the largest prior density in the square, so no cell is lost. Unlike those, the search returns all cells within a margin
of the best, not the best alone.
"""

from __future__ import annotations

import math
import threading
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry.se2 import rotate_back
from hmt_slam_ros.registration.position_constraint import (
    AROUND_STEPS,
    ConstraintPyramid,
    PositionConstraint,
    build_constraint_pyramid,
    is_admissible,
    is_admissible_within,
    is_block_admissible,
    no_constraint,
)
from hmt_slam_ros.registration.search_bounds import (
    BLOCK,
    MAX_HEIGHT,
    MIN_HEIGHT,
    TILES,
    LogRatioGrid,
    PhasedLevel,
    Pyramid,
    SearchMemory,
    SquareRange,
    TurnGroups,
    add_block,
    build_pyramid,
    count_known,
    group_turns,
    lattice_bounds,
    quarter_bounds,
    sample_cells,
    sort_by_phase,
    turns_in_group,
)
from hmt_slam_ros.registration.search_window import SearchWindow, prior_bound


class ReverseCheck(NamedTuple):
    """The check of the candidate's surface points in the free space of the query.

    :ivar grid: the query's.
    :ivar points: shape (m, 2), the candidate's surface points, m, candidate frame.
    :ivar rotated_points: shape (turns, m, 2), the same in the query's frame without a shift, cells of the grid.
    :ivar is_rotated: shape (turns,), at which turns they are computed: few turns have a block that is tested.
    :ivar negative: for cells of the grid and ``reach`` beyond, whether a cell within ``reach`` has a log-ratio below 0.
    :ivar is_marked: shape (1,), whether those are computed: most searches test no block.
    :ivar reach: largest distance between a point at a shift of a block and at its middle, plus one, cells.
    """

    grid: LogRatioGrid
    points: Float64
    rotated_points: Float32
    is_rotated: Bool
    negative: Bool
    is_marked: Bool
    reach: int


def make_reverse_check(window: SearchWindow, grid: LogRatioGrid, points: Float64) -> ReverseCheck:
    """The reverse check of a window; the arguments are those of :func:`search_cells`."""
    reach = math.ceil(math.sqrt(0.5) * (BLOCK - 1) * window.cell / grid.cell) + 1
    turns = window.turns.size
    rotated = np.empty((turns, len(points), 2), np.float32)
    rows, columns = grid.log_ratio.shape
    negative = np.zeros((rows + 2 * reach, columns + 2 * reach), np.bool_)
    return ReverseCheck(grid, points, rotated, np.zeros(turns, np.bool_), negative, np.zeros(1, np.bool_), reach)


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
def _mark_near_negative(check: ReverseCheck) -> Bool:
    """The cells near one with a negative log-ratio, marked at the first call."""
    log_ratio, negative, reach = check.grid.log_ratio, check.negative, check.reach
    if check.is_marked[0]:
        return negative
    rows, columns = log_ratio.shape
    across = np.zeros((rows, columns + 2 * reach), np.bool_)
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(columns):
                across[r, c + shift] |= log_ratio[r, c] < 0.0
    for r in range(rows):
        for shift in range(2 * reach + 1):
            for c in range(across.shape[1]):
                negative[r + shift, c] |= across[r, c]
    check.is_marked[0] = True
    return negative


@njit(cache=True)
def gather_block_points(check: ReverseCheck, window: SearchWindow, node: tuple[int, int, int], points: Float64) -> int:
    """Write to ``points`` those that may contradict in the block that begins at ``node``; returns their number."""
    if check.points.shape[0] == 0:
        return 0
    negative, rotated = _mark_near_negative(check), _rotate_points(check, window, node[0])
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


_LATTICE_SQUARES = 16
"""Squares of a lattice that take as long as one that is read alone."""

_CELL_WORK, _TURN_WORK, _ADMISSION_WORK = 2, 14, 8
"""Work of a cell of the map, of a sample at a turn, and of a square of the lattice, in samples looked up: so many times
the time of one, about 1.5 ns, by least squares over a hundred searches of the hospital log."""


class SearchCells(NamedTuple):
    """Cells of the window, in the order of the search.

    :ivar indices: shape (n, 3), int64, (k, i, j).
    :ivar score: shape (n,), nats: tempered log-ratio plus the prior's exponent.
    :ivar contradiction: shape (n,), nats, at most 0: the part of the score from the reverse check.
    :ivar work: number of samples that were looked up, or of what takes as long.
    """

    indices: Int64
    score: Float64
    contradiction: Float64
    work: int = 0


class _SearchProblem(NamedTuple):
    """A search problem; the members are the arguments of :func:`search_cells`.

    :ivar cells: of the samples, see :func:`sample_cells`.
    :ivar groups: the same for groups of turns.
    """

    window: SearchWindow
    surface: LogRatioGrid
    bounds: Pyramid
    cells: Int32
    groups: TurnGroups
    constraint: ConstraintPyramid
    reverse: ReverseCheck
    temper: float
    margin: float


class _ThreadMemory(threading.local):
    """The memory of the searches of a thread: that of the surface, and that of the constraint."""

    def __init__(self) -> None:
        self.surface, self.constraint = SearchMemory(), SearchMemory()


_memory = _ThreadMemory()


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
    height = min(MAX_HEIGHT, max(MIN_HEIGHT, int(np.ceil(np.log2(edge))) - 2))
    sampled = sample_cells(window, surface, samples)
    bounds = build_pyramid(surface.log_ratio, _memory.surface)
    admissible = build_constraint_pyramid(constraint or no_constraint(window.cell), window, _memory.constraint)
    task = _SearchProblem(
        window,
        surface,
        bounds,
        sampled,
        group_turns(sampled, window.first),
        admissible,
        make_reverse_check(window, reverse_grid, reverse_samples),
        temper,
        margin,
    )
    across, tile = int((window.last[0] - window.first[0]) // 2**height + 1), height - MIN_HEIGHT
    coarsest = (
        sort_by_phase(bounds.levels[tile], across, _memory.surface),
        sort_by_phase(admissible.pyramid.levels[tile], across, _memory.constraint),
    )
    cells, squares = _search_depth_first(task, coarsest, height, threshold)
    cells = cells[cells[:, 3] >= max(threshold, cells[:, 3].max(initial=-np.inf) - margin)]
    lattice = int(np.prod((window.last - window.first) // 2**height + 1)) * _count_groups(task, height)
    work = squares * len(samples) + _CELL_WORK * surface.log_ratio.size
    work += _TURN_WORK * sampled.shape[0] * sampled.shape[1] + _ADMISSION_WORK * lattice
    return SearchCells(cells[:, :3].astype(np.int64), cells[:, 3].copy(), cells[:, 4].copy(), work)


@njit(cache=True)
def _search_depth_first(
    task: _SearchProblem, coarsest: tuple[PhasedLevel, PhasedLevel], height: int, threshold: float
) -> tuple[Float64, int]:
    """Cells (k, i, j, score, contradiction), a superset of the result, and the number of squares that were read.

    Depth first, best bound first.

    :param coarsest: the levels for squares of ``height``, of the surface and of the constraint.
    """
    nodes, coarse, squares = _coarse_nodes(task, coarsest, height, threshold)
    stack, bounds = np.empty((8 * height, 4), dtype=np.int64), np.empty(8 * height)
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
            g, i, j, h = stack[size, 0], stack[size, 1], stack[size, 2], stack[size, 3]
            if h > MIN_HEIGHT:
                squares += 2 * BLOCK
                for half in range(2 * g, min(2 * g + 2, _count_groups(task, h - 1))):
                    size = _push_quarters(task, stack, bounds, size, (half, i, j), h - 1, least)
                continue
            turns = turns_in_group(h)
            for k in range(g * turns, min((g + 1) * turns, task.window.turns.size)):
                if not is_block_admissible(task.constraint, k, i, j):
                    continue
                squares += BLOCK
                if count + BLOCK * BLOCK > len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                count, least = _take_cells(task, (k, i, j), points, found, count, least)
    return found[:count], squares


@njit(cache=True)
def _count_groups(task: _SearchProblem, height: int) -> int:
    return task.groups.first[height + 1 - MIN_HEIGHT] - task.groups.first[height - MIN_HEIGHT]


@njit(cache=True)
def _coarse_nodes(
    task: _SearchProblem, coarsest: tuple[PhasedLevel, PhasedLevel], height: int, threshold: float
) -> tuple[Int64, Float64, int]:
    """The coarsest nodes (g, i, j) with a bound of ``threshold``, their bounds, and the number of squares read.

    Of a lattice that is the rectangle around the squares that the constraint admits.
    """
    tile, groups = height - MIN_HEIGHT, task.groups
    surface, allowed = coarsest
    across, along = (task.window.last - task.window.first) // 2**height + 1
    nodes, bounds = np.empty((1024, 3), dtype=np.int64), np.empty(1024)
    admitted = np.empty((across * along, 2), dtype=np.int64)
    count, squares = 0, 0
    for g in range(_count_groups(task, height)):
        group = groups.first[tile] + g
        size = _find_admitted(task.constraint.groups, allowed, group, across, along, admitted)
        if size == 0:
            continue
        a, b = admitted[:size, 0], admitted[:size, 1]
        box = SquareRange(a.min(), b.min(), a.max() - a.min() + 1, b.max() - b.min() + 1)
        steps = lattice_bounds(surface, groups.corners[group], groups.classes[group], box)
        squares += box.across * box.along
        if count + size > len(nodes):
            nodes = np.concatenate((nodes, np.empty((len(nodes) + size, 3), np.int64)))
            bounds = np.concatenate((bounds, np.empty(len(bounds) + size)))
        for n in range(size):
            bound = task.temper * task.bounds.step * steps[b[n] - box.low, a[n] - box.left]
            if bound < threshold:
                continue
            i, j = task.window.first[0] + (a[n] << height), task.window.first[1] + (b[n] << height)
            bound += _group_prior_bound(task.window, height, g, i, j)
            if bound >= threshold:
                nodes[count, 0], nodes[count, 1], nodes[count, 2], bounds[count] = g, i, j, bound
                count += 1
    return nodes[:count], bounds[:count], squares // _LATTICE_SQUARES


@njit(cache=True)
def _find_admitted(
    keyframes: TurnGroups, allowed: PhasedLevel, group: int, across: int, along: int, admitted: Int64
) -> int:
    """Write the squares (a, b) of a lattice in which the constraint can be met, and return their number."""
    corners, classes = keyframes.corners[group], keyframes.classes[group]
    near, largest = count_known(allowed, corners, classes, SquareRange(0, 0, across, along))
    count = 0
    for b in range(along):
        for a in range(across):
            if len(corners) == 0 or (2 * near[b, a] >= len(corners) and largest[b, a] > AROUND_STEPS):
                admitted[count, 0], admitted[count, 1] = a, b
                count += 1
    return count


@njit(cache=True)
def _group_prior_bound(window: SearchWindow, height: int, g: int, i: int, j: int) -> float:
    """The largest exponent of the prior at a turn of a group in the square that begins at (i, j); -inf for none."""
    turns, largest = turns_in_group(height), -np.inf
    for k in range(g * turns, min((g + 1) * turns, window.turns.size)):
        largest = max(largest, prior_bound(window, k, i, j, 1 << height))
    return largest


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
    """Push four squares at a group of turns with a bound of ``least``, the best on top; returns the stack's new size.

    :param node: the group, and where the first square begins.
    :param height: of the squares.
    """
    window, side, tile = task.window, 2**height, height - MIN_HEIGHT
    g, i, j = node
    group, x, y = task.groups.first[tile] + g, (i - window.first[0]) >> tile, (j - window.first[1]) >> tile
    steps = quarter_bounds(task.bounds.levels[tile], task.groups.corners[group], task.groups.classes[group], x, y)
    first = size
    for down in range(2):
        for right in range(2):
            left, low = i + right * side, j + down * side
            bound = task.temper * task.bounds.step * steps[down][right]
            if (
                bound < least
                or left > window.last[0]
                or low > window.last[1]
                or not is_admissible_within(task.constraint, height, group, x + right * TILES, y + down * TILES)
            ):
                continue
            bound += _group_prior_bound(window, height, g, left, low)
            if bound < least:
                continue
            place = size
            while place > first and bounds[place - 1] > bound:
                stack[place] = stack[place - 1]
                bounds[place] = bounds[place - 1]
                place -= 1
            stack[place, 0], stack[place, 1], stack[place, 2], stack[place, 3] = g, left, low, height
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
            if score < least or not is_admissible(task.constraint, k, x, y):
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
