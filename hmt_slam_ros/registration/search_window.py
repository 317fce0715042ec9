"""The lattice of relative poses of a search, and the prior on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.compilation import njit


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
