"""Rigid motions of the plane on single numbers, for kernels: the counterpart of :mod:`hmt_slam_ros.geometry.se2`.

A frame is given by its position (x, y) and the cosine and sine of its angle. Kernels compute these two once for many
points. Both may be divided by the edge of a cell: positions and results are then in cells, points in metres.

Each function is inlined, and the order of its operations is fixed: results are the same, bit for bit, at every place.
Three functions wrap angles: they differ in the last bits, on which recorded results depend.
"""

from __future__ import annotations

import math

from numba import njit
from numba.extending import register_jitable


@njit(cache=True, inline="always")
def transform(x: float, y: float, cos: float, sin: float, px: float, py: float) -> tuple[float, float]:
    """A point (px, py) of a frame, in the frame in which that one stands at (x, y)."""
    return x + cos * px - sin * py, y + sin * px + cos * py


@njit(cache=True, inline="always")
def rotate(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector of a frame, in the frame in which that one is turned."""
    return cos * x - sin * y, sin * x + cos * y


@njit(cache=True, inline="always")
def rotate_back(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector, in a frame that is turned: the inverse of :func:`rotate`.

    For the normal (cos, sin) of a line it is how far a point is across the line, and how far along.
    """
    return cos * x + sin * y, cos * y - sin * x


@njit(cache=True, inline="always")
def inverse_position(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """The position of the inverse of a pose at (x, y)."""
    return -cos * x - sin * y, sin * x - cos * y


@register_jitable
def wrap(angle: float) -> float:
    """The angle in [-pi, pi), rad; one that lies there keeps its bits."""
    if -math.pi <= angle < math.pi:
        return angle
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    # Just below -pi the modulus rounds up to 2 pi itself.
    return wrapped if wrapped < math.pi else -math.pi


@njit(cache=True, inline="always")
def wrap_by_modulus(angle: float) -> float:
    """The angle in [-pi, pi], rad, without a branch, which costs every angle its last bits."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@njit(cache=True, inline="always")
def wrap_by_turns(angle: float) -> float:
    """The angle in [-pi, pi], rad, less whole turns: one that lies there keeps its bits, others differ in the last."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
