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
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Samples = NDArray[np.int32]
Pyramid = NDArray[np.float32]


class Window(NamedTuple):
    """The lattice of relative poses, and the Gaussian prior on it.

    A pose of the lattice is the prior's mean shifted by (i, j) cells along the axes of the candidate's frame, and
    turned by ``turns[k]``. Its twist from the mean is affine in the shift, so the prior's exponent is -1/2 of the
    squared norm of ``whitening[k] @ shift + offsets[k]``.

    :ivar mean: shape (3,), the prior's mean.
    :ivar cell: edge of a cell, m.
    :ivar turns: shape (t,), rad, ascending, equally spaced.
    :ivar first: shape (2,), int64, smallest shift along x and y, cells; ``last``, the largest.
    :ivar root: shape (3, 3), the square root of the prior's information, ``root.T @ root``.
    :ivar whitening: shape (t, 3, 2), 1/m.
    :ivar offsets: shape (t, 3).
    :ivar gate: largest squared Mahalanobis distance that is searched.
    """

    mean: Array
    cell: float
    turns: Array
    first: Indices
    last: Indices
    root: Array
    whitening: Array
    offsets: Array
    gate: float


class Cells(NamedTuple):
    """Cells of the window, in the order in which they were found.

    :ivar at: shape (n, 3), int64, (k, i, j).
    :ivar score: shape (n,), nats: tempered log-ratio plus the prior's exponent.
    :ivar contradiction: shape (n,), nats, at most 0: the part of the score that the reverse check took.
    """

    at: Indices
    score: Array
    contradiction: Array


class Surface(NamedTuple):
    """A log-ratio grid: ``log_ratio`` (rows, columns) float32, indexed [y, x], its corner ``origin`` (2,), ``cell``."""

    log_ratio: NDArray[np.float32]
    origin: Array
    cell: float


def make_window(
    mean: Array, covariance: Array, cell: float, turn: float, gate: float, bounds: Array | None = None
) -> Window:
    """The smallest lattice that holds the gate's ellipsoid, as far as it lies within bounds.

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
    inverse_v: Array = np.empty((turns.size, 2, 2))
    inverse_v[:, 0, 0] = inverse_v[:, 1, 1] = half_cot
    inverse_v[:, 0, 1], inverse_v[:, 1, 0] = 0.5 * turns, -0.5 * turns
    whitening: Array = root[:, :2] @ inverse_v @ rotation.T
    offsets: Array = turns[:, None] * root[:, 2]
    reach = np.ceil(half / cell)
    first, last = -reach, reach
    if bounds is not None:
        first = np.maximum(first, np.floor((bounds[0] - mean[:2]) / cell))
        last = np.minimum(last, np.ceil((bounds[1] - mean[:2]) / cell))
    return Window(mean, cell, turns, first.astype(np.int64), last.astype(np.int64), root, whitening, offsets, gate)


def search(
    window: Window, surface: Surface, samples: Array, back: Surface, back_samples: Array, temper: float,
    threshold: float, margin: float,
) -> Cells:
    """All cells of the window whose score is within ``margin`` of the best and not below ``threshold``.

    :param window: where to search; its cell is that of ``surface``.
    :param surface: the candidate's grid.
    :param samples: shape (n, 2), the query's surface points, m, query frame.
    :param back: the query's grid, for the reverse check.
    :param back_samples: shape (m, 2), the candidate's surface points, m, candidate frame.
    :param temper: factor on the summed log-ratios.
    """
    if (window.first > window.last).any():
        return Cells(np.empty((0, 3), dtype=np.int64), np.empty(0), np.empty(0))
    levels = min(5, max(1, int(np.ceil(np.log2(max(2, int((window.last - window.first).max()) // 4))))))
    found = _search(
        pyramid(surface.log_ratio, levels), _sample_cells(window, surface, samples, 2**levels), window, temper,
        back, back_samples, threshold, margin,
    )  # fmt: skip
    keep = found[1] >= max(threshold, found[1].max(initial=-np.inf) - margin)
    return Cells(found[0][keep], found[1][keep], found[2][keep])


def _sample_cells(window: Window, surface: Surface, samples: Array, border: int) -> Samples:
    """Column and row in the pyramid of every sample at every turn without a shift, shape (turns, samples, 2)."""
    angles = window.mean[2] + window.turns
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    x = cos * samples[:, 0] - sin * samples[:, 1] + (window.mean[0] - surface.origin[0])
    y = sin * samples[:, 0] + cos * samples[:, 1] + (window.mean[1] - surface.origin[1])
    return np.floor(np.stack((x, y), axis=-1) / surface.cell).astype(np.int32) + np.int32(border)


def pyramid(log_ratio: NDArray[np.float32], levels: int) -> Pyramid:
    """Running maxima, shape (levels + 1, rows + 2^levels, columns + 2^levels).

    Element [h, y, x] is the maximum over the square of 2^h x 2^h cells that begins at cell (x, y) - 2^levels; beyond
    the grid the log-ratio is 0.
    """
    margin = 2**levels
    rows, columns = log_ratio.shape
    result = np.zeros((levels + 1, rows + margin, columns + margin), dtype=np.float32)
    result[0, margin:, margin:] = log_ratio
    for level in range(1, levels + 1):
        _widen(result[level - 1], result[level], 2 ** (level - 1))
    return result


@njit(cache=True)
def _widen(below: Pyramid, above: Pyramid, step: int) -> None:
    rows, columns = below.shape
    for r in range(rows):
        for c in range(columns):
            beyond_row, beyond_column = r + step >= rows, c + step >= columns
            right = np.float32(0.0) if beyond_column else below[r, c + step]
            down = np.float32(0.0) if beyond_row else below[r + step, c]
            both = np.float32(0.0) if beyond_row or beyond_column else below[r + step, c + step]
            above[r, c] = max(below[r, c], right, down, both)


@njit(cache=True)
def _bound(level: Pyramid, cells: Samples, node: Indices, side: int, window: Window, temper: float) -> float:
    """An upper bound of the score of the square of shifts that begins at a node; -inf outside the gate."""
    whitening, offset = window.whitening[node[0]], window.offsets[node[0]]
    half = 0.5 * (side - 1) * window.cell
    x, y = node[1] * window.cell + half, node[2] * window.cell + half
    centre, spread_plus, spread_minus = 0.0, 0.0, 0.0
    for r in range(3):
        a, b = whitening[r, 0], whitening[r, 1]
        centre += (a * x + b * y + offset[r]) ** 2
        spread_plus += ((a + b) * half) ** 2
        spread_minus += ((a - b) * half) ** 2
    # Triangle inequality: the norm over the square is at least that at its centre less that of the farthest corner.
    nearest = max(0.0, np.sqrt(centre) - np.sqrt(max(spread_plus, spread_minus)))
    if nearest * nearest > window.gate:
        return -np.inf
    total = 0.0
    rows, columns = level.shape
    for n in range(cells.shape[0]):
        c, r = cells[n, 0] + node[1], cells[n, 1] + node[2]
        if 0 <= c < columns and 0 <= r < rows:
            total += level[r, c]
    return temper * total - 0.5 * nearest * nearest


@njit(cache=True)
def _contradiction(back: Surface, points: Array, window: Window, node: Indices) -> float:
    """Sum of the negative log-ratios that the candidate's points meet in the query's grid."""
    angle = window.mean[2] + window.turns[node[0]]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = window.mean[0] + node[1] * window.cell, window.mean[1] + node[2] * window.cell
    rows, columns = back.log_ratio.shape
    total = 0.0
    for n in range(points.shape[0]):
        dx, dy = points[n, 0] - x, points[n, 1] - y
        c = int(np.floor((cos * dx + sin * dy - back.origin[0]) / back.cell))
        r = int(np.floor((cos * dy - sin * dx - back.origin[1]) / back.cell))
        if 0 <= c < columns and 0 <= r < rows:
            total += min(np.float32(0.0), back.log_ratio[r, c])
    return total


@njit(cache=True)
def _coarse_nodes(levels: Pyramid, cells: Samples, window: Window, temper: float) -> tuple[Indices, Array]:
    """The coarsest nodes of all turns: (k, i, j) and their bounds."""
    height = levels.shape[0] - 1
    side = 2**height
    across, along = (window.last - window.first) // side + 1
    nodes = np.empty((cells.shape[0] * across * along, 3), dtype=np.int64)
    bounds = np.empty(nodes.shape[0])
    n = 0
    for k in range(cells.shape[0]):
        for a in range(across):
            for b in range(along):
                nodes[n, 0], nodes[n, 1], nodes[n, 2] = k, window.first[0] + a * side, window.first[1] + b * side
                bounds[n] = _bound(levels[height], cells[k], nodes[n], side, window, temper)
                n += 1
    return nodes, bounds


@njit(cache=True)
def _push_children(
    stack: Indices, bounds: Array, size: int, node: Indices, levels: Pyramid, cells: Samples, window: Window,
    temper: float, least: float,
) -> int:
    """Push those of a node's four squares that may matter, the most promising on top; the new stack size."""
    height = node[3] - 1
    side = 2**height
    child = np.empty(3, dtype=np.int64)
    first = size
    for quarter in range(4):
        child[0] = node[0]
        child[1] = node[1] + side * (quarter % 2)
        child[2] = node[2] + side * (quarter // 2)
        if child[1] > window.last[0] or child[2] > window.last[1]:
            continue
        bound = _bound(levels[height], cells[child[0]], child, side, window, temper)
        if bound < least:
            continue
        place = size
        while place > first and bounds[place - 1] > bound:
            stack[place] = stack[place - 1]
            bounds[place] = bounds[place - 1]
            place -= 1
        stack[place, :3], stack[place, 3], bounds[place] = child, height, bound
        size += 1
    return size


@njit(cache=True)
def _search(
    levels: Pyramid, cells: Samples, window: Window, temper: float, back: Surface, back_samples: Array,
    threshold: float, margin: float,
) -> tuple[Indices, Array, Array]:
    """Depth first, best bound first: (index, score, contradiction) of the cells found, a superset of those wanted."""
    height = levels.shape[0] - 1
    nodes, coarse = _coarse_nodes(levels, cells, window, temper)
    stack, bounds = np.empty((4 * height + 8, 4), dtype=np.int64), np.empty(4 * height + 8)
    found, scores, against = np.empty((1024, 3), dtype=np.int64), np.empty(1024), np.empty(1024)
    count = 0
    least = threshold
    for n in np.argsort(-coarse, kind="mergesort"):
        if coarse[n] < least:
            break
        stack[0, :3], stack[0, 3], bounds[0] = nodes[n], height, coarse[n]
        size = 1
        while size > 0:
            size -= 1
            node, bound = stack[size].copy(), bounds[size]
            if bound < least:
                continue
            if node[3] > 0:
                size = _push_children(stack, bounds, size, node, levels, cells, window, temper, least)
                continue
            taken = temper * _contradiction(back, back_samples, window, node)
            if bound + taken < least:
                continue
            if count == scores.size:
                found, scores, against = _doubled(found, scores, against)
            found[count], scores[count], against[count] = node[:3], bound + taken, taken
            count += 1
            least = max(least, bound + taken - margin)
    return found[:count], scores[:count], against[:count]


@njit(cache=True)
def _doubled(found: Indices, scores: Array, against: Array) -> tuple[Indices, Array, Array]:
    """The same arrays with room for as much again."""
    return (
        np.concatenate((found, np.empty_like(found))),
        np.concatenate((scores, np.empty_like(scores))),
        np.concatenate((against, np.empty_like(against))),
    )
