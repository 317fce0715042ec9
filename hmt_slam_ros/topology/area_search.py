"""Branch and bound over relative poses: every cell of the search window whose score can matter.

The window is a lattice of turns and shifts around the prior's mean. A node is a square of 2^h x 2^h shifts at one turn.
Its bound reads, for each sample, the largest log-ratio that any of its shifts could read (Olson 2009, Hess et al.
2016), and adds the largest prior density in the square, so no cell is lost. Unlike those, the search does not stop
at the best cell: it returns all within a margin of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.topology.area_bounds import (
    BLOCK,
    Pyramid,
    Surface,
    add_block,
    bound_of_square,
    bounds_of_quarters,
    pyramid,
    sample_cells,
)
from hmt_slam_ros.topology.area_ground import Ground, Passable, anywhere, may_be, passable
from hmt_slam_ros.topology.area_reverse import Reverse, contradiction, points_of_block, reverse_check
from hmt_slam_ros.topology.area_window import Window, prior_bound

_LOWEST, _HIGHEST = 2, 5  # heights of the coarsest nodes; of the lowest, the squares are blocks


class Cells(NamedTuple):
    """Cells of the window, in the order in which they were found.

    :ivar at: shape (n, 3), int64, (k, i, j).
    :ivar score: shape (n,), nats: tempered log-ratio plus the prior's exponent.
    :ivar contradiction: shape (n,), nats, at most 0: the part of the score that the reverse check took.
    """

    at: Int64
    score: Float64
    contradiction: Float64


class _Task(NamedTuple):
    """What is searched; the members are the arguments of :func:`search`.

    :ivar cells: where the samples are, see :func:`sample_cells`.
    """

    window: Window
    surface: Surface
    bounds: Pyramid
    cells: Int32
    ground: Passable
    reverse: Reverse
    temper: float
    margin: float


def search(
    window: Window,
    surface: Surface,
    samples: Float64,
    back: Surface,
    back_samples: Float64,
    temper: float,
    threshold: float,
    margin: float,
    ground: Ground | None = None,
) -> Cells:
    """All cells of the window whose score is within ``margin`` of the best and not below ``threshold``.

    :param window: where to search; its cell is that of ``surface``.
    :param surface: the candidate's grid.
    :param samples: shape (n, 2), the query's surface points, m, query frame.
    :param back: the query's grid, for the reverse check.
    :param back_samples: shape (m, 2), the candidate's surface points, m, candidate frame.
    :param temper: factor on the summed log-ratios.
    :param ground: where one of the query's keyframes has to be, if anywhere.
    """
    if (window.first > window.last).any():
        return Cells(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
    edge = max(1, int((window.last - window.first).max()))
    height = min(_HIGHEST, max(_LOWEST, int(np.ceil(np.log2(edge))) - 2))
    task = _Task(
        window,
        surface,
        pyramid(surface.log_ratio, height),
        sample_cells(window, surface, samples),
        passable(ground or anywhere(window.cell), window, height),
        reverse_check(window, back, back_samples),
        temper,
        margin,
    )
    found = _search(task, height, threshold)
    kept = found[found[:, 3] >= max(threshold, found[:, 3].max(initial=-np.inf) - margin)]
    return Cells(kept[:, :3].astype(np.int64), kept[:, 3].copy(), kept[:, 4].copy())


@njit(cache=True)
def _search(task: _Task, height: int, threshold: float) -> Float64:
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
def _coarse_nodes(task: _Task, height: int) -> tuple[Int64, Float64]:
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
                if prior > -np.inf and may_be(task.ground, height, k, i, j):
                    steps = bound_of_square(task.bounds.levels[height], task.bounds.margin, task.cells[k], i, j)
                    nodes[n, 0], nodes[n, 1], nodes[n, 2] = k, i, j
                    bounds[n] = task.temper * task.bounds.step * steps + prior
                    n += 1
    return nodes[:n], bounds[:n]


@njit(cache=True)
def _push_quarters(
    task: _Task, stack: Int64, bounds: Float64, size: int, node: tuple[int, int, int], height: int, least: float
) -> int:
    """Push those of a node's four squares that may matter, the most promising on top; the new stack size."""
    window, side = task.window, 2**height
    k, i, j = node
    steps = bounds_of_quarters(task.bounds.levels[height], task.bounds.margin, task.cells[k], i, j, side)
    first = size
    for down in range(2):
        for right in range(2):
            x, y = i + right * side, j + down * side
            bound = task.temper * task.bounds.step * steps[down][right]
            if bound < least or x > window.last[0] or y > window.last[1] or not may_be(task.ground, height, k, x, y):
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
    task: _Task, node: tuple[int, int, int], points: Float64, found: Float64, count: int, least: float
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
            if score < least or not may_be(task.ground, 0, k, x, y):
                continue
            if near < 0:
                near = points_of_block(task.reverse, window, node, points)
            against = contradiction(task.reverse.grid, window, (k, x, y), points[:near], (least - score) / task.temper)
            taken = task.temper * against
            score += taken
            if score >= least:
                found[count, 0], found[count, 1], found[count, 2] = k, x, y
                found[count, 3], found[count, 4] = score, taken
                count += 1
                least = max(least, score - task.margin)
    return count, least
