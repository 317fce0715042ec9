"""Covariances and information matrices (3, 3) of poses, of which every scan needs many.

Each function is a compiled kernel; on matrices so small numpy would spend its time on calls.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Matrix = NDArray[np.float64]


@njit(cache=True)
def inverse(matrix: Matrix) -> Matrix:
    """The inverse of a positive definite matrix, by cofactors."""
    a = matrix[1, 1] * matrix[2, 2] - matrix[1, 2] * matrix[2, 1]
    b = matrix[1, 2] * matrix[2, 0] - matrix[1, 0] * matrix[2, 2]
    c = matrix[1, 0] * matrix[2, 1] - matrix[1, 1] * matrix[2, 0]
    scale = 1.0 / (matrix[0, 0] * a + matrix[0, 1] * b + matrix[0, 2] * c)
    found = np.empty((3, 3))
    found[0, 0] = scale * a
    found[0, 1] = found[1, 0] = scale * b
    found[0, 2] = found[2, 0] = scale * c
    found[1, 1] = scale * (matrix[0, 0] * matrix[2, 2] - matrix[0, 2] * matrix[2, 0])
    found[1, 2] = found[2, 1] = scale * (matrix[0, 1] * matrix[2, 0] - matrix[0, 0] * matrix[2, 1])
    found[2, 2] = scale * (matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0])
    return found


@njit(cache=True)
def turned(matrix: Matrix, theta: float) -> Matrix:
    """A covariance, or information, of a frame in one that sees it turned by ``theta``."""
    return _moved(matrix, 0.0, 0.0, theta)


@njit(cache=True)
def carried(covariance: Matrix, increment: NDArray[np.float64]) -> Matrix:
    """The covariance at the end of ``increment`` (3,), from that at its start: Ad^-1 C Ad^-T, right tangent frames."""
    cos, sin = np.cos(increment[2]), np.sin(increment[2])
    x, y = -cos * increment[0] - sin * increment[1], sin * increment[0] - cos * increment[1]
    return _moved(covariance, x, y, -increment[2])


@njit(cache=True)
def of_inverse(covariance: Matrix, pose: NDArray[np.float64]) -> Matrix:
    """The covariance of the inverse of ``pose`` (3,): Ad C Ad^T, right tangent frames."""
    return _moved(covariance, pose[0], pose[1], pose[2])


@njit(cache=True)
def _moved(covariance: Matrix, x: float, y: float, theta: float) -> Matrix:
    """Ad C Ad^T for the pose (x, y, theta)."""
    cos, sin = np.cos(theta), np.sin(theta)
    ad = ((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0))
    half, found = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            half[i, j] = ad[i][0] * covariance[0, j] + ad[i][1] * covariance[1, j] + ad[i][2] * covariance[2, j]
    for i in range(3):
        for j in range(3):
            found[i, j] = half[i, 0] * ad[j][0] + half[i, 1] * ad[j][1] + half[i, 2] * ad[j][2]
    return found
