"""The covariance of a planar pose in ROS messages, which have six coordinates: x, y, z, roll, pitch, yaw.

As geometry_msgs/PoseWithCovariance has it: row by row, along the axes of the message's frame, m and rad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Rows and columns of x, y and yaw."""


def planar_covariance(covariance: ArrayLike) -> NDArray[np.float64]:
    """The covariance of (x, y, theta), shape (3, 3), of that in a message, shape (36,)."""
    return np.reshape(np.asarray(covariance, dtype=np.float64), (6, 6))[_PLANAR]


def spatial_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """The covariance in a message, shape (36,), of that of (x, y, theta), shape (3, 3); the rest of it is 0."""
    spatial = np.zeros((6, 6))
    spatial[_PLANAR] = covariance
    return spatial.ravel()
