"""Walls as the outline of cells: what joins floor plans of rectangles with occupancy images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_DECIMALS = 3  # of metres: corners meant to be the same are the same


def outline_of_cells(
    inside: NDArray[np.bool_], xs: NDArray[np.float64], ys: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The segments between cells that are inside and cells that are not, as long as they go straight on.

    :param inside: shape (rows, columns); what lies beyond the grid is not inside.
    :param xs: shape (columns + 1,), x of the cells' sides, m, increasing.
    :param ys: shape (rows + 1,), y of the cells' sides, m, increasing.
    :returns: shape (n, 4), x and y of both ends, m.
    """
    padded = np.pad(inside, 1)
    upright, begin, end = _runs((padded[1:-1, :-1] != padded[1:-1, 1:]).T)
    vertical = np.stack((xs[upright], ys[begin], xs[upright], ys[end]), axis=1)
    level, begin, end = _runs(padded[:-1, 1:-1] != padded[1:, 1:-1])
    return np.concatenate((vertical, np.stack((xs[begin], ys[level], xs[end], ys[level]), axis=1)))


def outline_of_rectangles(rectangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The outline of the union of rectangles.

    :param rectangles: shape (n, 4), smallest x and y, largest x and y, m; to the millimetre.
    :returns: shape (k, 4), x and y of both ends, m.
    """
    corners = np.round(rectangles, _DECIMALS)
    xs, ys = np.unique(corners[:, [0, 2]]), np.unique(corners[:, [1, 3]])
    inside = np.zeros((ys.size - 1, xs.size - 1), dtype=np.bool_)
    left, right = np.searchsorted(xs, corners[:, 0]), np.searchsorted(xs, corners[:, 2])
    low, high = np.searchsorted(ys, corners[:, 1]), np.searchsorted(ys, corners[:, 3])
    for k in range(len(corners)):
        inside[low[k] : high[k], left[k] : right[k]] = True
    return outline_of_cells(inside, xs, ys)


def _runs(marked: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Row, first column and column behind the last of every run of marked cells."""
    changes = np.diff(np.pad(marked.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, begin = np.nonzero(changes == 1)
    return rows, begin, np.nonzero(changes == -1)[1]
