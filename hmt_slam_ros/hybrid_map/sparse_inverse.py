"""Entries of the inverse of a sparse matrix, from its factors (Takahashi, Fagan and Chin 1973).

With A = L D L^T and Z = A^-1, for j from the last column to the first:

    Z_ij = -sum_k Z_ik L_kj,    Z_jj = 1 / D_j - sum_k L_kj Z_kj,    i and k over the rows below j in L.

All entries of Z on the right are in the pattern of L, so the cost is that of the factorization; a solution for every
column costs as much as the whole inverse.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.compilation import njit


def inverse_blocks(indices: Int32, starts: Int32, factor: Any, size: int) -> Float64:  # noqa: ANN401  SuperLU of scipy
    """The diagonal blocks of the inverse of a symmetric, positive definite matrix, shape (n / size, size, size).

    :param indices: rows of the entries of the n columns, of which column j has those from ``starts[j]`` to before
        ``starts[j + 1]``; blocks on the diagonal are full.
    :param factor: of the matrix, factored without pivoting.
    :param size: rows of a block.
    """
    assert (factor.perm_r == factor.perm_c).all()
    lower, order = factor.L, factor.perm_c.astype(np.int64)
    rows, first = _factor_pattern(indices, starts, order)
    below = _entries_below(rows, first, lower.indices, lower.indptr, lower.data)
    inverse, diagonal = _invert(rows, first, below, factor.U.diagonal())
    return _take_blocks(rows, first, inverse, diagonal, order, size)


@njit(cache=True)
def _factor_pattern(indices: Int32, starts: Int32, order: Int64) -> tuple[Int64, Int64]:
    """The rows below the diagonal of L in each column, ascending, and where each column begins among them.

    Those of a column are its own, and those of the columns whose first row it is, also where they are zero by chance.

    :param order: shape (n,), the column of L for each column of the matrix.
    """
    n = len(order)
    former = np.empty(n, np.int64)
    for column in range(n):
        former[order[column]] = column
    rows, first = np.empty(4 * len(indices) + n, np.int64), np.zeros(n + 1, np.int64)
    # Columns with the same first row, as a linked list: the last one, and the one before each.
    last, before = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    mark, found = np.full(n, -1, np.int64), np.empty(n, np.int64)
    for j in range(n):
        count = 0
        for k in range(starts[former[j]], starts[former[j] + 1]):
            row = order[indices[k]]
            if row > j and mark[row] != j:
                mark[row], found[count] = j, row
                count += 1
        child = last[j]
        while child >= 0:
            for k in range(first[child], first[child + 1]):
                row = rows[k]
                if row > j and mark[row] != j:
                    mark[row], found[count] = j, row
                    count += 1
            child = before[child]
        end = first[j] + count
        if end > len(rows):
            longer = np.empty(2 * end, np.int64)
            longer[: first[j]] = rows[: first[j]]
            rows = longer
        rows[first[j] : end] = np.sort(found[:count])
        first[j + 1] = end
        if count:
            parent = rows[first[j]]
            before[j], last[parent] = last[parent], j
    return rows[: first[n]], first


@njit(cache=True)
def _entries_below(rows: Int64, first: Int64, indices: Int32, starts: Int32, entries: Float64) -> Float64:
    """The entries of L at the rows of its pattern; the factor may lack those that are zero."""
    below, column = np.zeros(len(rows)), np.zeros(len(first) - 1)
    for j in range(len(first) - 1):
        for k in range(starts[j], starts[j + 1]):
            column[indices[k]] = entries[k]
        for k in range(first[j], first[j + 1]):
            below[k] = column[rows[k]]
        for k in range(starts[j], starts[j + 1]):
            column[indices[k]] = 0.0
    return below


@njit(cache=True)
def _invert(rows: Int64, first: Int64, below: Float64, pivots: Float64) -> tuple[Float64, Float64]:
    """The entries of the inverse at the rows of the pattern, and on the diagonal (n,)."""
    n = len(pivots)
    inverse, diagonal = np.zeros(len(rows)), np.empty(n)
    place = np.full(n, -1, np.int64)
    for j in range(n - 1, -1, -1):
        begin, end = first[j], first[j + 1]
        for k in range(begin, end):
            place[rows[k]] = k
        for k in range(begin, end):
            column = rows[k]
            inverse[k] -= diagonal[column] * below[k]
            for m in range(first[column], first[column + 1]):
                other = place[rows[m]]
                if other >= 0:
                    inverse[other] -= inverse[m] * below[k]
                    inverse[k] -= inverse[m] * below[other]
        diagonal[j] = 1.0 / pivots[j]
        for k in range(begin, end):
            diagonal[j] -= below[k] * inverse[k]
            place[rows[k]] = -1
    return inverse, diagonal


@njit(cache=True)
def _take_blocks(rows: Int64, first: Int64, inverse: Float64, diagonal: Float64, order: Int64, size: int) -> Float64:
    """The blocks on the diagonal, in the order of the matrix."""
    blocks = np.empty((len(order) // size, size, size))
    for column in range(len(order)):
        block, at = blocks[column // size], column % size
        block[at, at] = diagonal[order[column]]
        for other in range(at):
            low, high = order[column], order[column - at + other]
            if low > high:
                low, high = high, low
            k = first[low] + np.searchsorted(rows[first[low] : first[low + 1]], high)
            block[at, other] = block[other, at] = inverse[k]
    return blocks
