"""Covariances and information matrices (3, 3) of poses, of which every scan needs many.

Each function is a compiled kernel; on matrices so small numpy would spend its time on calls.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2_kernels, symmetric

Matrix = NDArray[np.float64]


@njit(cache=True)
def inverse(matrix: Matrix) -> Matrix:
    """The inverse of a positive definite matrix, by cofactors."""
    found = np.empty((3, 3))
    symmetric.write_to_array(symmetric.inverse(symmetric.symmetric_from_array(matrix)), found)
    return found


@njit(cache=True)
def rotate_covariance(matrix: Matrix, theta: float) -> Matrix:
    """A covariance, or information, of a frame in one that sees it turned by ``theta``."""
    return _apply_adjoint(matrix, 0.0, 0.0, theta)


@njit(cache=True)
def propagate_covariance(covariance: Matrix, increment: NDArray[np.float64]) -> Matrix:
    """The covariance at the end of ``increment`` (3,), from that at its start: Ad^-1 C Ad^-T, right tangent frames."""
    cos, sin = np.cos(increment[2]), np.sin(increment[2])
    x, y = se2_kernels.inverse_position(cos, sin, increment[0], increment[1])
    return _apply_adjoint(covariance, x, y, -increment[2])


@njit(cache=True)
def inverse_pose_covariance(covariance: Matrix, pose: NDArray[np.float64]) -> Matrix:
    """The covariance of the inverse of ``pose`` (3,): Ad C Ad^T, right tangent frames."""
    return _apply_adjoint(covariance, pose[0], pose[1], pose[2])


@njit(cache=True)
def _apply_adjoint(covariance: Matrix, x: float, y: float, theta: float) -> Matrix:
    """Ad C Ad^T for the pose (x, y, theta)."""
    cos, sin = np.cos(theta), np.sin(theta)
    ad = ((cos, -sin, y), (sin, cos, -x), (0.0, 0.0, 1.0))
    half = (_row_times(ad[0], covariance), _row_times(ad[1], covariance), _row_times(ad[2], covariance))
    found = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            found[i, j] = half[i][0] * ad[j][0] + half[i][1] * ad[j][1] + half[i][2] * ad[j][2]
    return found


@njit(cache=True)
def _row_times(row: tuple[float, float, float], matrix: Matrix) -> tuple[float, float, float]:
    """A row (3,) times a matrix."""
    x, y, z = row
    return (
        x * matrix[0, 0] + y * matrix[1, 0] + z * matrix[2, 0],
        x * matrix[0, 1] + y * matrix[1, 1] + z * matrix[2, 1],
        x * matrix[0, 2] + y * matrix[1, 2] + z * matrix[2, 2],
    )
