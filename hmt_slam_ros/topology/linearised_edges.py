"""The edges of a pose graph at given poses, and the sparse normal equations that they add up to.

Jacobians are those of the residual ``log(z^-1 * (x_i^-1 * x_j))`` in the right tangent spaces of x_i and x_j.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.sparse import csc_matrix

from hmt_slam_ros.arrays import Float64, Int32, Int64

_SMALL_ANGLE, _SERIES_ANGLE = 1e-4, 1e-2


@njit(cache=True)
def linearised(poses: Float64, sources: Int64, targets: Int64, measured: Float64) -> tuple[Float64, Float64, Float64]:
    """Residuals (m, 3) of the edges and their Jacobians (m, 3, 3) with respect to source and target.

    :param poses: shape (n, 3), of the nodes.
    :param measured: shape (m, 3), ``i_T_j``.
    """
    m = len(sources)
    residuals, of_source, of_target = np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((m, 3, 3))
    back = np.zeros((3, 3))
    for e in range(m):
        i, j = sources[e], targets[e]
        x, y, angle = _between(poses[i], poses[j])
        relative = np.array((x, y, angle))
        x, y, angle = _between(measured[e], relative)
        _log(x, y, angle, residuals[e])
        _right_jacobian_inverse(residuals[e], of_target[e])
        # The adjoint of the inverse of the relative pose.
        cos, sin = np.cos(relative[2]), np.sin(relative[2])
        back[0, 0], back[0, 1], back[0, 2] = cos, sin, sin * relative[0] - cos * relative[1]
        back[1, 0], back[1, 1], back[1, 2] = -sin, cos, cos * relative[0] + sin * relative[1]
        back[2, 2] = 1.0
        for r in range(3):
            for c in range(3):
                value = 0.0
                for k in range(3):
                    value -= of_target[e, r, k] * back[k, c]
                of_source[e, r, c] = value
    return residuals, of_source, of_target


@njit(cache=True)
def _between(a: Float64, b: Float64) -> tuple[float, float, float]:
    cos, sin = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    angle = b[2] - a[2]
    return cos * dx + sin * dy, cos * dy - sin * dx, angle - 2.0 * np.pi * np.floor(angle / (2.0 * np.pi) + 0.5)


@njit(cache=True)
def _log(x: float, y: float, angle: float, twist: Float64) -> None:
    half = 0.5 * angle
    half_cot = 1.0 - angle**2 / 12.0 if abs(angle) < _SMALL_ANGLE else half / np.tan(half)
    twist[0], twist[1], twist[2] = half_cot * x + half * y, half_cot * y - half * x, angle


@njit(cache=True)
def _right_jacobian_inverse(xi: Float64, result: Float64) -> None:
    """As :func:`~hmt_slam_ros.geometry.se2.right_jacobian_inverse`, into (3, 3): 1 + ad / 2 + q ad^2."""
    x, y, omega = xi[0], xi[1], xi[2]
    if abs(omega) < _SERIES_ANGLE:
        q = 1.0 / 12.0 + omega**2 / 720.0 + omega**4 / 30240.0
    else:
        q = (1.0 - 0.5 * omega / np.tan(0.5 * omega)) / omega**2
    result[0, 0] = result[1, 1] = 1.0 - q * omega * omega
    result[0, 1], result[1, 0] = -0.5 * omega, 0.5 * omega
    result[0, 2], result[1, 2] = 0.5 * y + q * omega * x, -0.5 * x + q * omega * y
    result[2, 0] = result[2, 1] = 0.0
    result[2, 2] = 1.0


class Pattern(NamedTuple):
    """Where the blocks of every edge stand in the normal matrix, in compressed columns.

    :ivar indices: rows of the entries; ``starts``, shape (columns + 1,), where each column begins among them.
    :ivar first: shape (m, 4), the first entry of the blocks (source, source), (source, target), (target, source),
        (target, target); -1 where one of the two nodes is fixed.
    :ivar stride: shape (m, 4), entries from one column of the block to the next.
    """

    indices: Int32
    starts: Int32
    first: Int64
    stride: Int64


def pattern(rows: Int64, columns: Int64, nodes: int) -> Pattern:
    """The pattern of blocks that stand at given places.

    :param rows: shape (m, 4), node of each block's rows, -1 where it is fixed; ``columns`` likewise.
    :param nodes: how many are free.
    """
    kept = (rows >= 0) & (columns >= 0)
    places, block_of = np.unique(columns[kept] * max(1, nodes) + rows[kept], return_inverse=True)
    column, row = np.divmod(places, max(1, nodes))
    in_column = np.bincount(column, minlength=nodes)
    before = np.concatenate(([0], np.cumsum(in_column)))
    first, stride = np.full(rows.shape, -1, np.int64), np.zeros(rows.shape, np.int64)
    # A column of nodes is three of numbers, one after the other; each holds three numbers of each of its blocks.
    own = 9 * before[column] + 3 * (np.arange(len(places)) - before[column])
    first[kept], stride[kept] = own[block_of], 3 * in_column[column][block_of]
    starts = np.concatenate(([0], np.cumsum(np.repeat(3 * in_column, 3)))).astype(np.int32)
    indices = np.empty(9 * len(places), np.int32)
    entry = own[:, None, None] + 3 * in_column[column][:, None, None] * np.arange(3)[:, None] + np.arange(3)
    indices[entry] = 3 * row[:, None, None] + np.arange(3)
    return Pattern(indices, starts, first, stride)


def normal_matrix(where: Pattern, of_source: Float64, of_target: Float64, information: Float64) -> csc_matrix:
    """The sum of J^T Omega J over all edges.

    :param information: shape (m, 3, 3), of the edges.
    """
    size = len(where.starts) - 1
    entries = _entries(where.first, where.stride, len(where.indices), of_source, of_target, information)
    return csc_matrix((entries, where.indices, where.starts), shape=(size, size))


@njit(cache=True)
def _entries(
    first: Int64, stride: Int64, count: int, of_source: Float64, of_target: Float64, information: Float64
) -> Float64:
    entries, left = np.zeros(count), np.empty((3, 3))
    for e in range(len(first)):
        for side in range(2):
            one = of_target[e] if side else of_source[e]
            for r in range(3):
                for c in range(3):
                    left[r, c] = (
                        one[0, r] * information[e, 0, c]
                        + one[1, r] * information[e, 1, c]
                        + one[2, r] * information[e, 2, c]
                    )
            for other_side in range(2):
                at, step = first[e, 2 * side + other_side], stride[e, 2 * side + other_side]
                if at < 0:
                    continue
                other = of_target[e] if other_side else of_source[e]
                for r in range(3):
                    for c in range(3):
                        entries[at + c * step + r] += (
                            left[r, 0] * other[0, c] + left[r, 1] * other[1, c] + left[r, 2] * other[2, c]
                        )
    return entries
